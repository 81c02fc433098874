"""Processes that take over a part of a first training's start on a GPU.

Python traces and lowers one program at a time, and XLA compiles a part of each program while all
others wait. So three processes lower the largest kernels while the training's own process traces
the program around them, and one compiles the evaluation. They start before the training's own
imports, and do the same imports. This module is imported before JAX.
"""

import base64
import contextlib
import hashlib
import importlib.util
import json
import os
import subprocess
import sys
import sysconfig
import threading
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import bounce_mjx
from bounce_mjx.files import private_folder

if TYPE_CHECKING:
    from bounce_mjx.gpu.kernel_calls import Attributes
    from bounce_mjx.runs.config import TrainConfig

EVALUATION = ("evaluation",)
# What each process does: the kinds of kernels that it lowers take about the same time.
_WORK = (
    ("kernels", "minibatch", "sums"),
    ("kernels", "elementwise"),
    ("kernels", "outputs"),
    EVALUATION,
)
_MODULE = "bounce_mjx.training.helper_process"
# With fewer processor cores the processes would slow the training's own start down.
_MIN_CORES = 8
_MOST_NOTES = 100
# Time after which a process does not help any more, s.
_PATIENCE = 120.0

# "off" never starts them; "on" starts them in every program, whatever it has changed in memory.
_SWITCH = "BOUNCE_MJX_HELPERS"
# Console script, and the names in `train_jax.py`.
_SCRIPT, _NAMES = "bounce-mjx", {"main", "refuse", "sys"}

NOT_COMPILED = ("seed", "eval_seed", "total_steps", "eval_every", "stop_when_solved", "log_dir")
"""Keys of a training's config that do not change its programs."""


def cache_folder() -> Path:
    """Folder of the compiled programs: the one that the user chose, or one in the user's cache,
    which is made; compiled programs are code, which no other user may write.

    Raises:
      OSError: the folder in the cache cannot be made, or is a link or another user's.
    """
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(chosen) if chosen else private_folder(private_folder(caches / "bounce_mjx") / "jax")


def start_helpers(args: Sequence[str]) -> "Helpers | None":
    """Starts helpers if they can prepare the training of this process; None if they cannot, or if
    the training's programs seem to be kept from an earlier start.

    Args:
      args: the command's arguments.
    """
    # Without a home or working folder, the training itself tells what is wrong.
    with contextlib.suppress(OSError, RuntimeError):
        if _are_of_use() and not (note := _note(args)).exists():
            return Helpers(note)
    return None


def _are_of_use() -> bool:
    """Whether this machine seems to have a GPU of NVIDIA's and enough processor cores, and this
    process trains with the package alone."""
    switch = os.environ.get(_SWITCH)
    platforms = os.environ.get("JAX_PLATFORMS") or "cuda"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    return (
        switch != "off"
        and cores >= _MIN_CORES
        and ("cuda" in platforms or "gpu" in platforms)
        and importlib.util.find_spec("jax_plugins") is not None
        and any(importlib.util.find_spec(f"jax_plugins.xla_cuda{n}") for n in (12, 13))
        and (switch == "on" or _is_own_program())
    )


def _is_own_program() -> bool:
    """Whether this process runs the package's own program: a user's program may change the package
    in memory, which the helpers would not know."""
    main = sys.modules["__main__"]
    package = Path(bounce_mjx.__file__).resolve().parent
    script = Path(getattr(main, "__file__", None) or "").resolve()
    if script == package.parent.parent / "train_jax.py":
        # Its user may have added lines.
        return {name for name in vars(main) if not name.startswith("__")} <= _NAMES
    return script in (package / "train.py", Path(sysconfig.get_path("scripts")).resolve() / _SCRIPT)


def _note(args: Sequence[str]) -> Path:
    """The empty file that tells that the programs of this command line are kept. It may be wrong:
    then a start takes as long as it does without helpers."""
    words = list(args)
    for flag in NOT_COMPILED:
        words = _without(words, flag)
    files = [*map(str, Path(bounce_mjx.__file__).parent.rglob("*.py"))]
    files += filter(os.path.isfile, words)
    changed = sorted((name, os.stat(name).st_mtime_ns) for name in files)
    described = repr((words, changed, os.getcwd(), sys.version))
    return cache_folder() / "starts" / hashlib.sha256(described.encode()).hexdigest()[:40]


def _without(words: list[str], flag: str) -> list[str]:
    """A command line without one flag and its value."""
    rest, skip = [], False
    for word in words:
        name, equals, _ = word.partition("=")
        if name.replace("_", "-") == "--" + flag.replace("_", "-"):
            skip = not equals
        elif skip and not word.startswith("--"):
            skip = False
        else:
            rest.append(word)
            skip = False
    return rest


class Helpers:
    """The processes; a `kernel_calls.Helper`."""

    def __init__(self, note: Path) -> None:
        """Starts them.

        Args:
          note: the file that will tell that the training's programs are kept.
        """
        self._note = note
        self._files = set() if os.environ.get(_SWITCH) == "on" else set(module_files())
        self._processes = {what: _start(*what) for what in _WORK}
        self._changed = threading.Condition()
        self._lowered: dict[str, Attributes] = {}
        # What is still being done.
        self._busy: set[tuple[str, ...]] = set()

    def begin(self, config: "TrainConfig") -> None:
        """Makes them prepare a training."""
        self._busy = set(_WORK)
        for what in _WORK:
            self._send(what, config.model_dump_json())
            threading.Thread(target=self._receive, args=(what,), daemon=True).start()

    def _send(self, what: tuple[str, ...], line: str) -> None:
        # A process that has ended helps with nothing.
        with contextlib.suppress(OSError):
            self._processes[what].stdin.write(line + "\n")
            self._processes[what].stdin.flush()

    def _receive(self, what: tuple[str, ...]) -> None:
        """What a process does not do, the training's own process does."""
        process = self._processes[what]
        with contextlib.suppress(Exception):
            for line in process.stdout:
                message = json.loads(line)
                if "files" in message:
                    if not self._files <= set(message["files"]):
                        break
                elif "name" in message:
                    with self._changed:
                        self._lowered[message["name"]] = _decoded(message["attributes"])
                        self._changed.notify_all()
                else:
                    _load_kernel(**message)
        _end(process)
        with self._changed:
            self._busy.discard(what)
            self._changed.notify_all()

    def lowers(self, kind: Hashable) -> bool:
        return any(kind in what for what in self._busy)

    def wait_for(self, kind: Hashable, name: str) -> "Attributes | None":
        with self._changed:
            self._changed.wait_for(
                lambda: name in self._lowered or not self.lowers(kind), timeout=_PATIENCE
            )
            return self._lowered.get(name)

    def keep_in(self, folder: Path) -> None:
        """Tells where the evaluation is to be kept (`programs.kept_programs`)."""
        self._send(EVALUATION, str(folder))

    def wait_for_evaluation(self) -> None:
        """Waits until the evaluation is compiled and kept, or cannot be."""
        with self._changed:
            self._changed.wait_for(lambda: EVALUATION not in self._busy, timeout=_PATIENCE)
        _end(self._processes[EVALUATION])

    def remember(self) -> None:
        """Notes that the programs of this command line are kept, so that its next start needs no
        helpers."""
        folder = self._note.parent
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            self._note.touch()
            newest = sorted(folder.iterdir(), key=lambda note: -note.stat().st_mtime)
            for old in newest[_MOST_NOTES:]:
                old.unlink(missing_ok=True)

    def close(self) -> None:
        """Ends the processes."""
        for process in self._processes.values():
            _end(process)


def module_files() -> list[str]:
    """The files of all imported modules but the main one."""
    main = sys.modules["__main__"]
    files = {getattr(module, "__file__", None) for module in list(sys.modules.values())}
    return sorted(filter(None, files - {getattr(main, "__file__", None)}))


def _load_kernel(program: str, counts: Sequence[int]) -> None:
    """Loads a program that contains a kernel; XLA keeps every compiled kernel for the process.

    Args:
      counts: numbers of the program's arguments and results.
    """
    import jax
    from jax.experimental import serialize_executable

    num_args, num_results = counts
    structures = (jax.tree.structure(((0,) * num_args, {})), jax.tree.structure((0,) * num_results))
    serialize_executable.deserialize_and_load(
        base64.b64decode(program), *structures, execution_devices=jax.devices()[:1]
    )


def encoded(attributes: "Attributes") -> dict[str, str | bool]:
    """A kernel's attributes as data for JSON."""
    return {
        name: base64.b64encode(x).decode() if isinstance(x, bytes) else x
        for name, x in attributes.items()
    }


def _decoded(attributes: dict[str, str | bool]) -> "Attributes":
    return {
        name: base64.b64decode(x) if isinstance(x, str) else x for name, x in attributes.items()
    }


def _start(*arguments: str) -> subprocess.Popen:
    return subprocess.Popen(
        # Without the working folder among those of the modules, where Python would put it.
        [sys.executable, "-P", "-m", _MODULE, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        # The memory is the training's, whatever its user has set.
        env=os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"},
        # Ctrl-C is for the training, which ends its helpers.
        start_new_session=True,
    )


def _end(process: subprocess.Popen) -> None:
    process.kill()
    process.wait()
