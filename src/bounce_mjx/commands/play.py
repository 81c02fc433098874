"""Shows a trained policy: `python -m bounce_mjx.play [CHECKPOINT]` (see --help)."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro
from pydantic import Field
from rich.console import Console

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import choose_checkpoint
from bounce_mjx.runs.reading import load_policy
from bounce_mjx.task.config import EnvConfig
from bounce_mjx.task.env import BounceBall
from bounce_mjx.training.setup import set_up_jax
from bounce_mjx.viewers.controllers import make_policy_controller
from bounce_mjx.viewers.show import ViewerOptions, show


class PlayCommand(StrictModel):
    """The command line."""

    checkpoint: Annotated[Path | None, tyro.conf.Positional] = None
    """A run's folder (its best checkpoint), or a checkpoint in it; left out: the newest run, or
    the policy that comes with the package where there is none."""
    target_height: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] | None = None
    """Target height, m; left out: drawn at each reset from the range of the run's config."""
    physics: Literal["config", "fused", "mjx"] = "config"
    """Engine; config is the one that the run was trained on."""
    log_dir: Path = Path("runs/bounce_ball")
    """Where to look for the newest run."""
    viewing: Annotated[ViewerOptions, tyro.conf.arg(name="")] = ViewerOptions()


def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line; exits with 2 on a mistake."""
    with exit_on_user_error():
        command = parse(
            PlayCommand,
            sys.argv[1:] if args is None else args,
            prog="python -m bounce_mjx.play",
            description="Shows a trained policy.",
        )
        console = Console()
        set_up_jax()
        checkpoint = choose_checkpoint(command.checkpoint, command.log_dir, console)
        config = load_run_config(checkpoint.run)
        console.print(f"checkpoint: {checkpoint.folder}", highlight=False, soft_wrap=True)
        changes = {} if command.physics == "config" else {"physics": command.physics}
        env = BounceBall(validate(EnvConfig, dict(config.env) | changes, "play"))
        networks = make_networks(config.ppo, env.observation_size, env.action_size)
        policy = load_policy(checkpoint, config)
        show(
            env,
            make_policy_controller(networks, policy),
            command.viewing,
            title=f"policy of {checkpoint.run.name}, {checkpoint.steps:,} steps",
            target_height=command.target_height,
            console=console,
        )
