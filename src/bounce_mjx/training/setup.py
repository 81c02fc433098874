"""JAX's settings in a command."""

import contextlib
import os
from pathlib import Path

import jax

from bounce_mjx.world.config import WorldConfig

LOOPS = "--xla_backend_extra_options"
JOINED_LOOPS = f"{LOOPS}=xla_cpu_use_multi_output_fusion"


def set_up_jax(*configs: WorldConfig) -> None:
    """Sets JAX up for a command; the user's environment variables have priority.

    Args:
      configs: the environments that the command simulates, for `join_loops`.
    """
    if configs:
        join_loops(*configs)
    set_up_gpu()
    cache_compilations()


def cache_compilations() -> None:
    """Caches compiled programs in the user's cache folder, so that a second start is quick; a
    folder that the user chose (`JAX_COMPILATION_CACHE_DIR`) has priority. JAX's default is to cache
    only programs that take a second to compile.

    A user without a home, such as a number without a name in a container, has no cache. JAX warns
    where it cannot write.
    """
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if jax.config.jax_compilation_cache_dir is None:
        with contextlib.suppress(RuntimeError):
            caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
            jax.config.update("jax_compilation_cache_dir", str(caches / "bounce_mjx/jax"))


def set_up_gpu() -> None:
    """Makes JAX start sooner on a GPU; the user's environment variables have priority.

    Memory is allocated as needed: allocating three quarters at once, JAX's default, takes a second
    (`XLA_PYTHON_CLIENT_PREALLOCATE=true` restores it). Random numbers come from a precompiled
    kernel of JAX, because XLA would take a second to compile one; the numbers are the same
    (`JAX_THREEFRY_GPU_KERNEL_LOWERING=false` restores XLA's).
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    # TensorBoardX sets this variable when it is imported, which a thread does while XLA starts
    # ptxas many times. A new variable moves the environment in memory, and a process that is being
    # started with it fails.
    os.environ.setdefault("CRC32C_SW_MODE", "auto")
    # Otherwise the address of a Python function is a part of the key of each program with a kernel
    # (`gpu/elementwise.py`) for several devices, and no later process finds it in the cache.
    if "JAX_REMOVE_CUSTOM_PARTITIONING_PTR_FROM_CACHE_KEY" not in os.environ:
        jax.config.update("jax_remove_custom_partitioning_ptr_from_cache_key", True)
    if "JAX_THREEFRY_GPU_KERNEL_LOWERING" not in os.environ:
        jax.config.update("jax_threefry_gpu_kernel_lowering", True)


def compiler_options(
    runs_once: bool = False, tunes_products: bool = False
) -> dict[str, bool | int | str]:
    """Options of XLA for `jax.jit`.

    On a GPU, XLA may time several kernels for each matrix product and for some other operations,
    which doubles the time of the compilation. The quickest is not the same one each time, and then
    the last bits of the results differ.

    On a CPU, XLA leaves matrix products and sums to YNNPACK, which takes one thread for products as
    small as those of a minibatch. One option leaves YNNPACK only convolutions, of which there are
    none; Eigen shares each product among the threads. The other lets loops use the widest vectors
    that the CPU has.

    Args:
      runs_once: whether the program runs only once, so that on a CPU, where LLVM takes most of the
        time to compile it, it is not worth optimising.
      tunes_products: whether XLA times kernels on a GPU. It does not check that their results
        agree, which would take as long again.
    """
    if jax.default_backend() == "gpu":
        return {"xla_gpu_autotune_level": int(tunes_products)}
    # XLA refuses options that it does not know.
    if jax.default_backend() != "cpu":
        return {}
    if runs_once:
        # XLA's older code generator, which jax 0.11 no longer has, is the quicker one.
        older = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}
        return {"xla_backend_optimization_level": 0, **older}
    return {
        "xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_CONVOLUTION",
        "xla_cpu_prefer_vector_width": 512,
    }


def join_loops(*configs: WorldConfig) -> None:
    """Joins loops on a CPU if all these environments have the fused physics.

    XLA emits one loop for each result by default, and repeats the intermediate values that results
    share. With its option for multi-output fusion, one loop computes several results: the programs
    compile in about half the time, and the physics runs several times as fast (figures in
    benchmarks/notes.md). XLA aborts the process on a few programs with it, such as MJX's step. XLA
    reads the option when JAX starts its devices. It is added to the user's `XLA_FLAGS`, unless
    these are empty or name it.

    Raises:
      UserError: an MJCF file does not fit the task.
    """
    from bounce_mjx.physics.engine import is_fused
    from bounce_mjx.world.model import world_model

    flags = os.environ.get("XLA_FLAGS")
    # Without a dash, it is empty on purpose or the name of a file with flags.
    if flags is not None and (LOOPS in flags or "--" not in flags):
        return
    # One config of each model and engine.
    different = {}
    for c in configs:
        different[c.physics, c.mjcf, c.physics_dt, c.robot, c.num_balls] = c
    if all(is_fused(world_model(c, visual=False), c.physics) for c in different.values()):
        os.environ["XLA_FLAGS"] = JOINED_LOOPS if flags is None else f"{flags} {JOINED_LOOPS}"
