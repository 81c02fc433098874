"""Shows the environment without a policy: `bounce-mjx view`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.garbage import no_garbage_collection
from bounce_mjx.interrupt import interruptible
from bounce_mjx.runs.config import ROBOTS, load_config, named_file
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.training.command import path_flag
from bounce_mjx.training.loop_fusion import join_loops
from bounce_mjx.viewers.options import ViewerOptions


class ViewCommand(StrictModel):
    """The command line."""

    actions: Literal["random", "zero", "scripted"] = "random"
    """random: uniform; zero: the servos hold their angles; scripted: a hand-written juggler."""
    robot: Path | None = None
    """Config of a robot: the file that bounce-mjx adopt wrote, or the name of one in
    configs/robots/ (ur5e, panda or iiwa)."""
    viewing: Annotated[ViewerOptions, tyro.conf.arg(name="")] = ViewerOptions()
    env: Annotated[WorldConfig, tyro.conf.arg(name="")] = WorldConfig()


@interruptible
def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line; exits with 2 on a mistake."""
    with exit_on_user_error():
        args = sys.argv[1:] if args is None else args
        robot = path_flag(args, "--robot")
        robot = robot and named_file(robot, ROBOTS)
        command = parse(
            ViewCommand,
            args,
            prog="bounce-mjx view",
            description="Shows the environment under random, zero or scripted actions.",
            default=ViewCommand() if robot is None else ViewCommand(env=load_config(robot).env),
        )
        with no_garbage_collection():
            join_loops(command.env)
            from bounce_mjx.training.setup import set_up_jax
            from bounce_mjx.viewers.controllers import (
                make_random_controller,
                make_scripted_controller,
                make_zero_controller,
            )
            from bounce_mjx.viewers.show import Shown, show

        controllers = {
            "random": make_random_controller,
            "zero": make_zero_controller,
            "scripted": make_scripted_controller,
        }
        set_up_jax()
        show(
            [Shown(command.env, controllers[command.actions], f"{command.actions} actions")],
            command.viewing,
            target_height=None,
            console=Console(),
        )
