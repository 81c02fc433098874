"""One Ctrl-C ends a command at once, even while XLA compiles."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bounce_mjx.interrupt import StopRequest

TIMEOUT = 120.0
# A shell reports it as status 130.
BY_CTRL_C = -signal.SIGINT


def test_the_innermost_request_receives_the_signal() -> None:
    """A viewer ends, and the command that shows it continues."""
    with StopRequest() as outer:
        with StopRequest() as stop:
            os.kill(os.getpid(), signal.SIGINT)
        assert stop.requested and not outer.requested


@pytest.mark.slow
def test_ctrl_c_ends_a_command_that_compiles(tmp_path: Path) -> None:
    """The signal comes while XLA compiles the largest program, and takes effect before the
    compilation ends.

    MJX's programs take XLA more than a second.
    """
    command, program = "bounce_mjx.eval --physics mjx --episodes 4", "run"
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
        assert process.wait(TIMEOUT) == BY_CTRL_C, said
    finally:
        process.kill()
        process.wait()
    assert f"conversion jit({program})" in said
    assert f"Finished XLA compilation of jit({program})" not in said
    assert "Traceback" not in said
