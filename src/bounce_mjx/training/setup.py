"""How JAX is set up for a command."""

import os
from pathlib import Path

import jax


def set_up_jax() -> None:
    """Sets JAX up for a command, unless the user has.

    Compiled programs are kept in the user's cache folder, so that a second start is quick
    (`JAX_COMPILATION_CACHE_DIR` chooses another).
    """
    set_up_gpu()
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(caches / "bounce_mjx" / "jax"))


def set_up_gpu() -> None:
    """Makes JAX start sooner on a GPU, unless the user has set it up; on a CPU nothing changes.

    Of the memory only what is needed is taken, as taking three quarters at once, JAX's way, costs
    a second (`XLA_PYTHON_CLIENT_PREALLOCATE=true`). Random numbers come from a kernel of JAX's own
    instead of XLA's: the same numbers, with a second less to compile
    (`JAX_THREEFRY_GPU_KERNEL_LOWERING=false`).
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if "JAX_THREEFRY_GPU_KERNEL_LOWERING" not in os.environ:
        jax.config.update("jax_threefry_gpu_kernel_lowering", True)


def compiler_options() -> dict[str, bool | int | str]:
    """Options of XLA for `jax.jit` that save time in compiling, of a program that runs as fast.

    On a GPU, XLA times several kernels for each matrix product. It need not check as well that
    their results agree, which takes as long again.
    """
    return {"xla_gpu_autotune_level": 1} if jax.default_backend() == "gpu" else {}
