"""Shows the environment without a policy: `bounce-mjx view`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import pydantic

from bounce_mjx.commands.run_options import ActorCommand
from bounce_mjx.config.command_line import parse, stdout
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.runs.config import read_preset, train_config
from bounce_mjx.tasks.registry import DEFAULT
from bounce_mjx.viewers.options import ViewerOptions
from bounce_mjx.world.config import WorldConfig


class ViewCommand(StrictModel):
    """Shows the environment under random or zero actions, or the mirror law."""

    actions: Literal["random", "zero", "mirror"] = "random"
    """random: uniform; zero: the servos hold their angles; mirror: the mirror law, a model-based
    controller."""
    task: str = DEFAULT
    """Name of the task, or FILE.py:CLASS for your own."""
    robot: Path | None = None
    """Config of a robot: the file that bounce-mjx adopt wrote, or the name of one in
    configs/robots/ (ur5e, panda or iiwa)."""
    viewing: ViewerOptions = ViewerOptions()
    env: pydantic.SerializeAsAny[WorldConfig]


def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 2 on a mistake."""
    # The task and the robot decide the other flags.
    first = parse(ActorCommand, args, prog="bounce-mjx view", is_first=True)
    env = read_preset(Path("default"), first.robot, first.task).env
    own_class = train_config(env.task, ViewCommand)
    command = parse(own_class, args, prog="bounce-mjx view", default=own_class(env=env))
    from bounce_mjx.baselines.mirror import MirrorLaw, observing
    from bounce_mjx.training.setup import set_up_jax
    from bounce_mjx.viewers import simulation
    from bounce_mjx.viewers.show import Shown, show

    make_controller = {
        "random": simulation.make_random_controller,
        "zero": simulation.make_zero_controller,
        "mirror": lambda env: simulation.make_policy_controller(MirrorLaw(env)),
    }
    env = observing(command.env) if command.actions == "mirror" else command.env
    set_up_jax(env)
    shown = Shown(env, make_controller[command.actions], f"{command.actions} actions")
    show([shown], command.viewing, commands={}, console=stdout())
