"""JAX's settings in a command."""

import os
from pathlib import Path

import jax

MULTI_OUTPUT_FUSION = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion"


def set_up_jax() -> None:
    """Sets JAX up for a command; the user's environment variables have priority."""
    set_up_cpu()
    set_up_gpu()
    cache_compilations()


def cache_compilations() -> None:
    """Caches compiled programs in the user's cache folder, so that a second start is quick; a
    folder that the user chose (`JAX_COMPILATION_CACHE_DIR`) has priority. JAX's default is to cache
    only programs that take a second to compile."""
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if jax.config.jax_compilation_cache_dir is None:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(caches / "bounce_mjx" / "jax"))


def set_up_cpu() -> None:
    """Lets XLA compute the physics once per step on a CPU; `xla_backend_extra_options` in the
    user's `XLA_FLAGS` has priority.

    By default XLA makes one loop for each group of results, and each loop repeats most of the
    physics: compiling an evaluation then takes twice as long, and running it almost three times.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "--xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {MULTI_OUTPUT_FUSION}".strip()


def set_up_gpu() -> None:
    """Makes JAX start sooner on a GPU; the user's environment variables have priority.

    Memory is allocated as needed: allocating three quarters at once, JAX's default, takes a second
    (`XLA_PYTHON_CLIENT_PREALLOCATE=true` restores it). Random numbers come from a precompiled
    kernel of JAX, because XLA would take a second to compile one; the numbers are the same
    (`JAX_THREEFRY_GPU_KERNEL_LOWERING=false` restores XLA's).
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if "JAX_THREEFRY_GPU_KERNEL_LOWERING" not in os.environ:
        jax.config.update("jax_threefry_gpu_kernel_lowering", True)


def compiler_options() -> dict[str, bool | int | str]:
    """Options of XLA for `jax.jit` that shorten the compilation and keep the program's speed.

    On a GPU, XLA times several kernels for each matrix product. This skips its check that their
    results agree, which doubles that time.
    """
    return {"xla_gpu_autotune_level": 1} if jax.default_backend() == "gpu" else {}
