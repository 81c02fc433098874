"""A run that is small enough for a test, the trained runs that all tests share, and a process that
trains one."""

import contextlib
import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest

from bounce_mjx.commands import train as train_command
from bounce_mjx.runs.folders import Checkpoint
from bounce_mjx.runs.presets import default_preset, has_accelerator
from bounce_mjx.runs.storage import MANIFEST_FILE, check_integrity

TRAIN_SCRIPT = Path(__file__).parent.parent / "train_jax.py"
STEPS = 256
# As many environments as eight devices can share.
TINY = (
    "--num-envs 16 --rollout-length 4 --num-minibatches 2 --num-epochs 1 --hidden-layers 16 "
    "--block-steps 64 --eval-every 128 --eval-episodes 4 --screening-episodes 0 "
    "--no-stop-when-solved --episode-seconds 0.5"
).split()
# Generous, because a busy machine compiles slowly.
TIMEOUT = 300.0


@contextlib.contextmanager
def quick_compilation() -> Iterator[None]:
    """Within it, and in the processes that are started in it, XLA compiles quickly and optimises
    little: for programs of a few steps, most of whose time is compilation.

    A program is another one with than without it, and rounds otherwise.
    """
    before = jax.config.read("jax_disable_most_optimizations")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
        jax.config.update("jax_disable_most_optimizations", True)
        try:
            yield
        finally:
            jax.config.update("jax_disable_most_optimizations", before)


def settings_of(words: Sequence[str], machine: Path | None = None) -> train_command.Settings:
    """What a command line of `bounce-mjx train` trains, by default on this machine."""
    preset = machine or default_preset(has_accelerator())
    return train_command.read_command(words).settings(preset)


def shared_run(name: str = "straight", *flags: str) -> Path:
    """The folder of a run of 256 steps, in `NAME/runs/bounce_ball`, for reading alone.

    The first test that asks for a name trains the run, and another process waits for it.
    """
    assert not jax.config.read("jax_disable_most_optimizations"), "all tests share it"
    folder = Path(os.environ["BOUNCE_MJX_TESTS_RUNS"]) / name
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "trained").exists():
            log_dir = ["--log-dir", str(folder / "runs/bounce_ball")]
            train_command.main([*TINY, "--total-steps", str(STEPS), *log_dir, *flags])
            (folder / "trained").touch()
    (run,) = (folder / "runs/bounce_ball").iterdir()
    return run


def arrays(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    """Every array of the training state in a checkpoint."""
    if (checkpoint.folder / MANIFEST_FILE).exists():
        check_integrity(checkpoint.folder)
    stored = ocp.StandardCheckpointer().restore(checkpoint.folder.absolute() / "training")
    leaves = jax.tree_util.tree_leaves_with_path(stored)
    return {jax.tree_util.keystr(p, simple=True, separator="."): x for p, x in leaves}


def contents(folder: Path) -> dict[Path, bytes | None]:
    """Every path under a folder, with the bytes of each file."""
    return {p: p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


class Job:
    def __init__(self, log: Path, args: list[str], program: list[str]):
        self._log = log
        with log.open("wb") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-u", *program, *args],
                stdout=file,
                stderr=subprocess.STDOUT,
                env=os.environ | {"PYTHONUNBUFFERED": "1"},
            )

    @property
    def said(self) -> str:
        return self._log.read_text()

    def wait_until_said(self, text: str, times: int = 1) -> None:
        """Waits until the process has printed a text so many times."""
        deadline = time.monotonic() + TIMEOUT
        while self.said.count(text) < times:
            assert self.process.poll() is None, self.said
            assert time.monotonic() < deadline, self.said
            time.sleep(0.01)

    def wait(self) -> int:
        return self.process.wait(TIMEOUT)


@contextlib.contextmanager
def job(
    log: Path, *args: object, code: str | None = None, script: Path = TRAIN_SCRIPT
) -> Iterator[Job]:
    """Starts `train_jax.py args`, or another script or Python code with these arguments, and ends
    the process after the test."""
    program = [str(script)] if code is None else ["-c", code]
    started = Job(log, [str(arg) for arg in args], program)
    try:
        yield started
    finally:
        started.process.kill()
        started.process.wait()
