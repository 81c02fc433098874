"""One Ctrl-C ends a command at once, even while XLA compiles."""

import contextlib
import gc
import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from bounce_mjx import interrupt
from bounce_mjx.commands import adopt, export, play, plot, report, robustness, view
from bounce_mjx.commands import eval as eval_command
from bounce_mjx.interrupt import StopRequest, interruptible, run_interruptible
from bounce_mjx.runs import folders
from bounce_mjx.training import setup

TIMEOUT = 120.0


def test_results_and_exceptions_are_passed_on() -> None:
    assert run_interruptible(divmod, 7, 2) == (3, 1)
    assert run_interruptible(int, "ff", base=16) == 255
    with pytest.raises(ZeroDivisionError):
        run_interruptible(divmod, 7, 0)
    with pytest.raises(SystemExit):
        run_interruptible(sys.exit, 2)


def test_the_work_runs_outside_the_thread_that_handles_signals() -> None:
    assert run_interruptible(threading.current_thread) is not threading.main_thread()


def test_ctrl_c_does_not_wait_for_the_work() -> None:
    started, finish = threading.Event(), threading.Event()

    def work() -> None:
        started.set()
        finish.wait(TIMEOUT)

    def press() -> None:
        started.wait(TIMEOUT)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=press).start()
    with pytest.raises(KeyboardInterrupt):
        run_interruptible(work)
    assert not finish.is_set()
    finish.set()


@pytest.mark.parametrize(
    "command",
    [
        (eval_command, []),
        (robustness, []),
        (play, []),
        (view, []),
        (adopt, ["arm.xml"]),
        (plot, []),
        (report, []),
        (export, ["--onnx", "a.onnx"]),
    ],
    ids=lambda command: command[0].__name__.split(".")[-1],
)
def test_ctrl_c_counts_where_python_drops_exceptions(
    command: tuple, tmp_path: Path, monkeypatch
) -> None:
    """It comes in a callback of the garbage collection, as JAX has one."""
    monkeypatch.chdir(tmp_path)
    finish = threading.Event()

    def press(*_) -> None:
        def callback(*_) -> None:
            gc.callbacks.remove(callback)
            os.kill(os.getpid(), signal.SIGINT)

        gc.callbacks.append(callback)
        gc.collect()
        sys.exit("Ctrl-C is lost" if not finish.wait(10) else None)

    monkeypatch.setattr(setup, "set_up_jax", press)
    monkeypatch.setattr(folders, "named_run", press)
    monkeypatch.setattr(interrupt, "leave", lambda: sys.exit(130))
    module, args = command
    with pytest.raises(SystemExit) as exit_info:
        module.main(args)
    assert exit_info.value.code == 130
    finish.set()


def test_the_innermost_request_receives_the_signal() -> None:
    """A viewer ends, and the command that shows it continues."""

    @interruptible
    def command() -> str:
        with StopRequest() as stop:
            os.kill(os.getpid(), signal.SIGINT)
            while not stop.requested:
                time.sleep(0.01)
        return "the viewer is closed"

    assert command() == "the viewer is closed"


def test_ctrl_c_leaves_the_cursor_visible() -> None:
    script = """
import os, signal, time
from rich.console import Console
from bounce_mjx.interrupt import interruptible

@interruptible
def command():
    with Console().status("compiling"):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)

command()
"""
    terminal, stdout = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", script], stdout=stdout, env=os.environ | {"TERM": "xterm"}
    )
    os.close(stdout)
    assert process.wait(TIMEOUT) == 130
    said = b""
    # The end of a terminal is an error on Linux.
    with contextlib.suppress(OSError):
        while part := os.read(terminal, 2**16):
            said += part
    os.close(terminal)
    hidden, shown = b"\x1b[?25l", b"\x1b[?25h"
    assert said.rfind(shown) > said.rfind(hidden) >= 0


COMMANDS = {
    "eval": ("bounce_mjx.eval --physics mjx --episodes 4", "go_on"),
    "play": ("bounce_mjx play --physics mjx --viewer browser --port 8321", "_advance"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", COMMANDS.values(), ids=COMMANDS)
def test_ctrl_c_ends_a_command_that_compiles(case: tuple, tmp_path: Path) -> None:
    """The signal comes while XLA compiles the largest program, and takes effect before the
    compilation ends.

    MJX's programs take XLA more than a second.
    """
    command, program = case
    log = tmp_path / "log"
    environment = {
        "JAX_LOG_COMPILES": "1",
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache"),
    }
    # The command itself decides that XLA joins no loops of MJX, on which it would abort.
    without_flags = {name: x for name, x in os.environ.items() if name != "XLA_FLAGS"}
    with log.open("w") as stdout:
        process = subprocess.Popen(
            [sys.executable, "-u", "-m", *command.split()],
            cwd=tmp_path,
            env=without_flags | environment,
            stdout=stdout,
            stderr=subprocess.PIPE,
            text=True,
        )
    try:
        said = ""
        for line in process.stderr:
            said += line
            if re.search(rf"to MLIR module conversion jit\({program}\)", line):
                # Python still runs a few lines before XLA takes over.
                time.sleep(0.3)
                process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT) == 130, said
    finally:
        process.kill()
        process.wait()
    assert f"conversion jit({program})" in said
    assert f"Finished XLA compilation of jit({program})" not in said
    assert "Traceback" not in said
