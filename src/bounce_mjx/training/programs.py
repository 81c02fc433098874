"""Compiled programs, kept from one process to the next.

JAX's compilation cache saves XLA's work, but each process still traces and lowers a program to find
its entry there. The key here needs no tracing: it is a hash of everything that the programs of a
training are made of.

A compiled program is code. Like the files of JAX's own cache, these files therefore stay in the
user's cache, and only files that no other user can write are read.
"""

import concurrent.futures
import contextlib
import hashlib
import importlib
import os
import pickle
import platform
import sys
import threading
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental import serialize_executable
from jax.sharding import Mesh

import bounce_mjx
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.files import PARTIAL
from bounce_mjx.training.helpers import NOT_COMPILED, Helpers

_VARIABLES = ("BOUNCE_MJX_", "CUDA_", "JAX_", "NVIDIA_", "XLA_")
# A training has three programs, of a few MB each.
_MOST_FILES = 60
_HASH_BYTES = 32

EVALUATE = "evaluate"
"""Name of the evaluation's program, which helpers compile."""


class Programs:
    """Compiles the programs of a training in the background, or loads the programs that an equal
    training left behind."""

    def __init__(
        self,
        pool: concurrent.futures.Executor,
        folder: Path | None = None,
        helpers: Helpers | None = None,
    ):
        """
        Args:
          pool: threads for the work.
          folder: of the kept programs of equal trainings (`kept_programs`); None keeps none.
          helpers: processes that prepare the training, too; needless if the programs are kept.
        """
        self._pool, self._folder, self._helpers = pool, folder, helpers
        if helpers is None:
            return
        if folder is None or folder.is_dir():
            if folder is not None:
                helpers.remember()
            helpers.close()
            self._helpers = None
        else:
            helpers.keep_in(folder)

    def get(
        self, name: str, mesh: Mesh, lower: Callable[[], jax.stages.Lowered]
    ) -> "concurrent.futures.Future[jax.stages.Compiled]":
        """A program. If no training has left it, it is lowered before this returns: Python traces
        one program at a time, so the order of the calls counts.

        Args:
          name: of the program in this training.
          mesh: the devices that run it.
          lower: traces and lowers it.
        """
        path = None if self._folder is None else self._folder / name
        if path is not None and path.is_file():
            return self._pool.submit(self._load_or_compile, path, mesh, lower)
        if self._helpers is not None and name == EVALUATE:
            return self._pool.submit(self._load_from_helper, path, mesh, lower)
        return self._pool.submit(self._compile, name, lower())

    def _load_from_helper(
        self, path: Path, mesh: Mesh, lower: Callable[[], jax.stages.Lowered]
    ) -> jax.stages.Compiled:
        self._helpers.wait_for_evaluation()
        return self._load_or_compile(path, mesh, lower)

    def _load_or_compile(
        self, path: Path, mesh: Mesh, lower: Callable[[], jax.stages.Lowered]
    ) -> jax.stages.Compiled:
        # Any file that this process cannot use is replaced.
        with contextlib.suppress(Exception):
            return _load(path, mesh)
        return self._compile(path.name, lower())

    def _compile(self, name: str, lowered: jax.stages.Lowered) -> jax.stages.Compiled:
        hits = _hits.count
        compiled = lowered.compile()
        # A program that JAX has read from its own cache cannot be written again: the copy lacks
        # functions on a CPU.
        if self._folder is not None and _hits.count == hits:
            with contextlib.suppress(Exception):
                # Not later, because on a CPU XLA cannot serialise a program that has run a sort.
                serialized = serialize_executable.serialize(compiled)
                self._pool.submit(self._keep, name, compiled, serialized)
        return compiled

    def _keep(self, name: str, compiled: jax.stages.Compiled, serialized: tuple) -> None:
        # The training does not depend on a kept program: a full disk, for example, is no error.
        with contextlib.suppress(Exception):
            modules = [module for module in list(sys.modules) if module.startswith("jax")]
            content = pickle.dumps((modules, calls_lapack(compiled), serialized))
            self._folder.mkdir(parents=True, exist_ok=True)
            partial = self._folder / f"{name}.{os.getpid()}{PARTIAL}"
            partial.touch(mode=0o600)
            partial.write_bytes(hashlib.sha256(content).digest() + content)
            partial.rename(self._folder / name)
            _remove_oldest(self._folder.parent)
            if self._helpers is not None:
                self._helpers.remember()


def calls_lapack(program: jax.stages.Compiled) -> bool:
    """Whether a program calls LAPACK, as a user's reward term may."""
    return "lapack" in program.as_text()


def kept_programs(
    config: TrainConfig, mj_model: mujoco.MjModel, mesh: Mesh, modules: Sequence[str] | None
) -> Path | None:
    """Folder of the programs of all trainings that compile the same programs as this one.

    Args:
      modules: the modules before the training's imports (`imported_modules`); None keeps nothing.

    Returns:
      A folder inside JAX's compilation cache; None if that cache is off, or if several processes
      share the training.
    """
    cache = jax.config.jax_compilation_cache_dir
    off = modules is None or not cache or not jax.config.jax_enable_compilation_cache
    if off or jax.process_count() > 1:
        return None
    model = np.empty(mujoco.mj_sizeModel(mj_model), np.uint8)
    mujoco.mj_saveModel(mj_model, buffer=model)
    sources = sorted(Path(bounce_mjx.__file__).parent.rglob("*.py"))
    device = mesh.devices.flat[0]
    parts = (
        config.model_dump_json(exclude=set(NOT_COMPILED)),
        model.tobytes(),
        *(path.read_bytes() for path in sources),
        modules,
        [metadata.version(name) for name in ("jax", "jaxlib", "mujoco", "numpy", "optax")],
        (sys.version, platform.machine(), _cpu_features()),
        (device.platform, device.device_kind, device.client.platform_version),
        [device.id for device in mesh.devices.flat],
        sorted(jax.config.values.items()),
        sorted(item for item in os.environ.items() if item[0].startswith(_VARIABLES)),
    )
    key = hashlib.sha256()
    for part in parts:
        content = part if isinstance(part, bytes) else repr(part).encode()
        key.update(hashlib.sha256(content).digest())
    return Path(cache) / "programs" / key.hexdigest()[:40]


def _load(path: Path, mesh: Mesh) -> jax.stages.Compiled:
    with path.open("rb") as file:
        status = os.fstat(file.fileno())
        if status.st_uid != os.getuid() or status.st_mode & 0o022:
            raise ValueError("another user may have written the file")
        content = file.read()
    digest, content = content[:_HASH_BYTES], content[_HASH_BYTES:]
    if hashlib.sha256(content).digest() != digest:
        raise ValueError("the file is damaged")
    modules, lapack, program = pickle.loads(content)
    # JAX registers the functions that a program calls when it imports their modules, and LAPACK's
    # when it lowers a first call, which takes a third of a second; without them the process would
    # crash.
    for module in modules:
        with contextlib.suppress(ImportError):
            importlib.import_module(module)
    devices = list(mesh.devices.flat)
    if lapack:
        jax.jit(jnp.linalg.qr).lower(np.eye(2, dtype=np.float32))
    os.utime(path.parent)
    return serialize_executable.deserialize_and_load(*program, execution_devices=devices)


def _remove_oldest(programs: Path) -> None:
    """Removes the files of all folders but of those that were used last."""
    folders = sorted(programs.iterdir(), key=lambda folder: -folder.stat().st_mtime)
    files = [file for folder in folders for file in folder.iterdir()]
    for old in files[_MOST_FILES:]:
        old.unlink(missing_ok=True)
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


class _Hits(threading.local):
    """Programs that this thread has read from JAX's cache."""

    count = 0

    def listen(self, event: str, **_: object) -> None:
        """Counts one of JAX's events."""
        self.count += event == "/jax/compilation_cache/cache_hits"


_hits = _Hits()
jax.monitoring.register_event_listener(_hits.listen)


def _cpu_features() -> str:
    """Instructions of the CPU, for which XLA compiles; empty where Linux does not list them."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                return line
    return ""
