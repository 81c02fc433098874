"""Trains a policy with the PPO of a PyTorch library and writes a run's folder
(`bounce-mjx train-torch`).

At its end, or when it is stopped, it writes the networks and the optimizer as `model.pt`, in the
format of rsl_rl's runner.
"""

import functools
import importlib
from collections.abc import Sequence
from typing import Literal, get_args

from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.runs.config import default_preset, has_accelerator, has_plugin
from bounce_mjx.training.command import TrainCommand, read_command

PROG = "bounce-mjx train-torch"

Library = Literal["rsl_rl", "skrl"]


class TorchTrainCommand(TrainCommand):
    """Trains a policy with PyTorch; by default, one that keeps the ball bouncing."""

    library: Library | None = None
    """Library whose PPO is used: rsl_rl by default; a resumed run keeps its library."""


@exit_on_user_error()
def main(args: Sequence[str]) -> None:
    """Runs the command line."""
    read = functools.partial(read_command, args, kind=TorchTrainCommand, prog=PROG)
    command = read(machine=default_preset(has_plugin()))
    from bounce_mjx.runs.folders import latest_checkpoint
    from bounce_mjx.training.job import library_of
    from bounce_mjx.training.run_command import run_command
    from bounce_mjx.training.setup import set_up_jax

    set_up_jax(command.env)
    if has_plugin() != has_accelerator():
        command = read()
    library = command.library
    if library is None:
        began = library_of(latest_checkpoint(command.resume)) if command.resume else None
        library = began if began in get_args(Library) else "rsl_rl"
    # PyTorch takes seconds to import, and is optional.
    trainer = importlib.import_module("bounce_mjx.adapters.torch.trainer")
    run_command(command, functools.partial(trainer.TorchTrainer, library), PROG)
