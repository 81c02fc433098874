"""Trains a policy with the PPO of a PyTorch library and writes a run's folder
(`bounce-mjx train-torch`).

At its end, or when it is stopped, it writes the networks and the optimizer as `model.pt`, in the
format of rsl_rl's runner.
"""

import functools
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.interrupt import interruptible_imports
from bounce_mjx.runs.config import (
    TrainConfig,
    default_preset,
    has_accelerator,
    has_plugin,
    load_run_config,
)
from bounce_mjx.training.command import (
    TrainingCommand,
    asks_for_help,
    early_flag,
    path_flag,
    read_command,
    run_command,
)
from bounce_mjx.training.loop_fusion import join_loops

if TYPE_CHECKING:
    from bounce_mjx.env.env import Env
    from bounce_mjx.training.trainer import Trainer

PROG = "bounce-mjx train-torch"

Library = Literal["rsl_rl", "skrl"]


class TorchTrainCommand(TrainingCommand):
    """The command line: the config's keys as flags, the preset or run to start from, and the
    library."""

    library: Library = "rsl_rl"
    """Library whose PPO is used; a resumed run keeps its library."""


def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        args = sys.argv[1:] if args is None else args
        if not asks_for_help(args):
            with interruptible_imports():
                from bounce_mjx.training import job  # noqa: F401
                from bounce_mjx.training.setup import set_up_jax

            set_up_jax()
        resume, defaults = path_flag(args, "--resume"), {}
        if resume:
            from bounce_mjx.runs.folders import find_run, latest_checkpoint
            from bounce_mjx.training.job import library_of

            run = find_run(resume)
            load_run_config(run, early_flag(args, "--task"))
            library = library_of(latest_checkpoint(run))
            if library in get_args(Library):
                defaults = {"library": library}
        description = "Trains a policy with PyTorch; by default, one that keeps the ball bouncing."
        read = functools.partial(
            read_command, TorchTrainCommand, args, prog=PROG, description=description, **defaults
        )
        command = read(preset=default_preset(has_plugin()))
        join_loops(command.env)
        if has_plugin() != has_accelerator():
            command = read()
        # PyTorch takes seconds to import, and is optional.
        trainer = importlib.import_module("bounce_mjx.adapters.torch.trainer")
        made = []

        def make_trainer(config: TrainConfig, env: "Env") -> "Trainer":
            made.append(trainer.TorchTrainer(command.library, config, env))
            return made[0]

        def save_models(runs: Sequence[Path]) -> None:
            made[0].save_models(runs)

        outcomes = run_command(command, make_trainer, PROG, stopped=save_models)
        save_models([outcome.run for outcome in outcomes])


if __name__ == "__main__":
    main()
