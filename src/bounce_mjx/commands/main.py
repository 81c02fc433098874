"""The console script.

`bounce-mjx train|eval|robustness|play|view|adopt|plot|report|export|...`
"""

import contextlib
import gc
import importlib
import os
import sys
from collections.abc import Sequence

from bounce_mjx.errors import UserError, exit_on_user_error, needed, suggest
from bounce_mjx.interrupt import end_on_ctrl_c
from bounce_mjx.resources import VERSION

COMMANDS = {
    "train": "train a policy",
    "eval": "measure the results of a trained policy",
    "robustness": "measure the results in perturbed worlds",
    "play": "show a trained policy",
    "view": "show the environment under random or zero actions, or the mirror law",
    "adopt": "write the config of another robot arm",
    "plot": "draw the learning curves of runs, and an evaluation",
    "report": "write the report of a run, report.html",
    "export": "write a trained policy as an ONNX file",
    "rehearse": "run a policy or a motion on a simulated arm, as on a real one",
    "excite": "plan a motion from which an arm can be identified",
    "identify": "estimate the world of a robot from its logs",
    "doctor": "print versions, devices and what is missing",
}
_HELP = """usage: bounce-mjx COMMAND [ARGUMENTS]

A robot arm learns tasks with a ball, such as bouncing it on a paddle.

{commands}

bounce-mjx COMMAND --help lists the arguments of a command. bounce-mjx --version prints the version.
--import FILE.py, of any command, brings your own tasks and algorithms.
"""


def main(args: Sequence[str] | None = None) -> None:
    """Runs a command line, whose first word names the command.

    Only the chosen command is imported, because each command imports libraries that take seconds.
    """
    end_on_ctrl_c()
    # Python looks for garbage after so many new objects. Those of imports and of JAX's programs are
    # hardly ever garbage.
    gc.set_threshold(10_000)
    # After two minutes of a compilation, as on a busy machine, XLA would print a banner. What fails
    # in it is an exception too. XLA reads this when JAX is imported, which a command does later; a
    # Python program of the user's chooses itself.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    with exit_on_user_error():
        name, *rest = (sys.argv[1:] if args is None else args) or ["--help"]
        if name in ("--help", "-h"):
            lines = (f"  {command:<13}{meaning}" for command, meaning in COMMANDS.items())
            print(_HELP.format(commands="\n".join(lines)), end="")
            return
        if name == "--version":
            print(f"bounce_mjx {VERSION}")
            return
        if name not in COMMANDS:
            advice = suggest(name, COMMANDS) or f"choose {', '.join(COMMANDS)}"
            raise UserError(f"unknown command {name}; {advice} (see bounce-mjx --help)")
        if opengl := os.environ.get("MUJOCO_GL"):
            # Where this library is missing, MuJoCo's import would fail, also in a command that
            # draws nothing; one that draws tries the library itself (`viewers.offscreen`).
            # A robot's computer has no MuJoCo.
            os.environ["MUJOCO_GL"] = "disabled"
            with contextlib.suppress(ImportError):
                importlib.import_module("mujoco")
            os.environ["MUJOCO_GL"] = opengl
        with needed(f"bounce-mjx {name}", "bounce_mjx"):
            command = importlib.import_module(f"bounce_mjx.commands.{name}")
        try:
            from bounce_mjx.config.user_code import do_imports
        except ImportError:
            # A robot's computer has no pydantic: doctor, which runs there, needs no code of a user.
            command.main(rest)
            return
        # The user's own tasks and algorithms, which then have names.
        command.main(do_imports(rest, prog=("bounce-mjx", name)))
