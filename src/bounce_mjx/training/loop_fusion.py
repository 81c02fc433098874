"""Joined loops on a CPU: an option of XLA, and another start without it where XLA fails.

On a CPU, XLA emits one loop for each result by default, and repeats the intermediate values that
results share. With its option for multi-output fusion, one loop computes several results: the
programs compile in about half the time, and the physics runs several times as fast (figures in
benchmarks/RESULTS.md). XLA still aborts the process on a few programs with it, such as MJX's step.
"""

import ctypes
import os
import signal
import sys
from pathlib import Path

OPTION = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion"
_COMPILER = str(Path("jax", "_src", "compiler.py"))


def join_loops(physics: str | None = None) -> None:
    """Switches the option on for this process, before JAX is imported. If XLA aborts while it
    compiles, the command starts again without the option.

    `XLA_FLAGS` of the user has priority. A process that has imported JAX is not the command's own,
    and stays as it is; so does a system without POSIX signals.

    Args:
      physics: the engine that the user asks for, if any; MJX is compiled without the option.
    """
    if physics == "mjx" or "XLA_FLAGS" in os.environ or "jax" in sys.modules or os.name != "posix":
        return
    os.environ["XLA_FLAGS"] = OPTION
    # Python's own handlers run between two bytecodes, which an aborting process does not reach.
    ctypes.CDLL(None).signal(signal.SIGABRT, _start_again)


@ctypes.CFUNCTYPE(None, ctypes.c_int)
def _start_again(_: int) -> None:
    """Replaces the process; returns, and so lets it end, if nothing is being compiled."""
    if not any(map(_compiles, sys._current_frames().values())):
        return
    os.write(2, b"XLA cannot join the loops of this program; the command starts again without.\n")
    command = [sys.executable, *sys.orig_argv[1:]]
    os.execve(sys.executable, command, os.environ | {"XLA_FLAGS": ""})


def _compiles(frame) -> bool:
    """Whether a frame of a thread, or one of its callers, is JAX's compiler."""
    while frame is not None:
        if frame.f_code.co_filename.endswith(_COMPILER):
            return True
        frame = frame.f_back
    return False
