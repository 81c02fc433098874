"""A process that does a part of another process's training start (`helpers.py`).

`python -m bounce_mjx.training.helper_process kernels KIND...` lowers and compiles kernels of these
kinds, and `... evaluation` compiles the evaluation. Both read the training's config from the
standard input, and write lines of JSON to the standard output.
"""

import base64
import concurrent.futures
import contextlib
import ctypes
import importlib
import json
import os
import sys
import threading
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

from bounce_mjx.garbage import no_garbage_collection
from bounce_mjx.training.helpers import encoded, module_files

if TYPE_CHECKING:
    from bounce_mjx.runs.config import TrainConfig

_writing = threading.Lock()


def prepare_kernels(kinds: Collection[str]) -> None:
    """Sends each kernel when it is lowered, and a program that contains it when it is compiled."""
    import jax
    from jax.experimental import serialize_executable
    from jax.experimental.pallas import mosaic_gpu  # noqa: F401

    from bounce_mjx.gpu.kernel_calls import LoweredKernel, lower_for_another
    from bounce_mjx.task.env import BounceBall
    from bounce_mjx.training.ppo_trainer import PPOTrainer

    # Only the training's own process writes there.
    jax.config.update("jax_enable_compilation_cache", False)
    config = _receive_config()

    def compile_kernel(program: jax.stages.Lowered) -> None:
        content, *structures = serialize_executable.serialize(program.compile())
        counts = [structure.num_leaves for structure in structures]
        _send(program=base64.b64encode(content).decode(), counts=counts)

    with concurrent.futures.ThreadPoolExecutor() as pool:

        def receive(kernel: LoweredKernel) -> None:
            _send(name=kernel.name, attributes=encoded(kernel.attributes))
            pool.submit(compile_kernel, kernel.program)

        lower_for_another(kinds, receive)
        PPOTrainer(config, BounceBall(config.env)).trace()


def compile_evaluation() -> None:
    """Leaves the program in the folder that the second line of the standard input names."""
    from bounce_mjx.task.env import BounceBall
    from bounce_mjx.training.devices import make_mesh
    from bounce_mjx.training.evaluators import Evaluators
    from bounce_mjx.training.programs import Programs

    config = _receive_config()
    env = BounceBall(config.env)
    mesh = make_mesh(config.num_devices, config.ppo, config.num_seeds)
    folder = sys.stdin.readline().strip()
    if folder:
        with concurrent.futures.ThreadPoolExecutor() as pool:
            Evaluators(config, env, mesh, Programs(pool, Path(folder))).wait()


def _receive_config() -> "TrainConfig":
    # A process whose modules are not the same as these would train something else.
    for command in ("main", "train"):
        importlib.import_module(f"bounce_mjx.commands.{command}")
    from bounce_mjx.runs.config import TrainConfig

    line = sys.stdin.readline()
    if not line:
        sys.exit("the training has ended")
    # Only now, because nobody may read what fills a pipe.
    _send(files=module_files())
    return TrainConfig.model_validate_json(line)


def admits_one_process() -> bool:
    """Whether a GPU is in a mode in which only one process can use it: the training's own."""
    with contextlib.suppress(OSError, AttributeError):
        nvml = ctypes.CDLL("libnvidia-ml.so.1")
        count, device, mode = ctypes.c_uint(), ctypes.c_void_p(), ctypes.c_int()
        if nvml.nvmlInit_v2() or nvml.nvmlDeviceGetCount_v2(ctypes.byref(count)):
            return False
        for index in range(count.value):
            found = nvml.nvmlDeviceGetHandleByIndex_v2(index, ctypes.byref(device)) == 0
            told = found and nvml.nvmlDeviceGetComputeMode(device, ctypes.byref(mode)) == 0
            # 0 is NVML_COMPUTEMODE_DEFAULT.
            if told and mode.value != 0:
                return True
    return False


def _send(**message: object) -> None:
    with _writing:
        print(json.dumps(message), flush=True)


def main() -> None:
    """Runs the command line."""
    what, *kinds = sys.argv[1:]
    if admits_one_process():
        sys.exit("only one process can use the GPU")
    with no_garbage_collection():
        from bounce_mjx.training.setup import find_devices, set_up_jax

        set_up_jax()
        find_devices()
        if what == "kernels":
            prepare_kernels(kinds)
        else:
            compile_evaluation()
    # An end in order would take longer.
    os._exit(0)


if __name__ == "__main__":
    main()
