"""Shows a trained policy, or a robot's log: `bounce-mjx play [CHECKPOINT]`."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from bounce_mjx.commands.run_options import (
    MIRROR,
    TopicsConfig,
    WorldCommand,
    parse_with_commands,
)
from bounce_mjx.config.command_line import stdout
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.runs.config import TrainConfig, in_world, read_preset
from bounce_mjx.viewers.options import MAX_ENVS, ViewerOptions
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import RandomizationConfig

if TYPE_CHECKING:
    from bounce_mjx.env.env import Env
    from bounce_mjx.runs.folders import Checkpoint
    from bounce_mjx.viewers.controllers import Controller
    from bounce_mjx.viewers.show import Shown


class PlayCommand(WorldCommand):
    """Shows a trained policy, or several side by side."""

    checkpoints: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="[CHECKPOINT ...]"),
    ] = ()
    """A run's folder (its best checkpoint), a checkpoint in it, latest for the newest run, or a
    policy that comes with the package: pretrained, robust, robust_small, or the name of a task or
    an arm. Several are shown side by side. The default is the newest run, or the task's policy in
    the package if there is no run. mirror stands for the mirror law, a model-based baseline."""
    actions: Literal["policy", "mirror"] = "policy"
    """policy: those of the checkpoints; mirror: those of the mirror law, like the checkpoint
    mirror."""
    physics: Literal["config", "fused", "mjx"] = "config"
    """Physics engine; config is the engine used in training."""
    randomization: RandomizationConfig = RandomizationConfig()
    """World of the episodes, if a term is given, in place of the world of the training."""
    log: Path | None = None
    """Log of a robot's run, as for bounce-mjx identify; writes a page (--html, by default the log's
    name with _replay.html) with the measured run next to its simulation in --world. --robot is the
    robot's config."""
    topics: TopicsConfig = TopicsConfig()
    """Topics of a log that is a bag."""
    viewing: Annotated[ViewerOptions, tyro.conf.arg(name="")] = ViewerOptions()


@exit_on_user_error()
def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 2 on a mistake."""
    command, given_commands = parse_with_commands(PlayCommand, args, prog="bounce-mjx play")
    if command.log is not None:
        _replay_log(command, given_commands)
        return
    if len(command.checkpoints) > MAX_ENVS:
        raise UserError(f"{len(command.checkpoints)} policies are given; give at most {MAX_ENVS}")
    from bounce_mjx.training.setup import set_up_jax
    from bounce_mjx.viewers.show import show

    console = stdout()
    default = None if command.actions == "policy" else Path(MIRROR)
    if default and command.checkpoints:
        raise UserError(
            "--actions mirror and checkpoints cannot be combined; to show the mirror law next to a "
            "policy, give mirror as a checkpoint"
        )
    chosen = [command.choose(path, console) for path in command.checkpoints or (default,)]
    configs = [_config(checkpoint, command) for checkpoint in chosen]
    (commands, *_) = [given_commands(config.env) for config in configs]
    set_up_jax(*(config.env for config in configs))
    show(
        [load_shown(*shown, console) for shown in zip(chosen, configs, strict=True)],
        command.viewing,
        commands=commands,
        console=console,
    )


def _config(checkpoint: "Checkpoint", command: PlayCommand) -> TrainConfig:
    """The config of a checkpoint's training, with the engine and the world that are to be shown."""
    config = command.config_of(checkpoint)
    changes = {} if command.physics == "config" else {"physics": command.physics}
    if command.randomization.terms:
        changes["randomization"] = command.randomization
    env = validate(type(config.env), dict(config.env) | changes, "play")
    return config.model_copy(update={"env": env})


def _replay_log(
    command: PlayCommand, given_commands: Callable[[WorldConfig], dict[str, float]]
) -> None:
    """Writes the page of a log."""
    viewing = command.viewing
    others = {
        "a checkpoint": command.checkpoints,
        "--actions": command.actions != "policy",
        "--task": command.task,
        "--physics": command.physics != "config",
        "--randomization": command.randomization.terms,
        "--viewer": viewing.viewer != "auto",
        "--video": viewing.video,
        "--num-envs": viewing.num_envs > 1,
    }
    if refused := [name for name, given in others.items() if given]:
        raise UserError(
            f"--log writes a page of the recorded run, and {' and '.join(refused)} cannot be "
            "combined with it; omit one of the two"
        )
    page = viewing.html or Path(f"{command.log.stem}_replay.html")
    from bounce_mjx.env.env import Env
    from bounce_mjx.identify.bags import Topics
    from bounce_mjx.identify.reading import read_log
    from bounce_mjx.identify.replay import replay_log
    from bounce_mjx.runs.files import check_output
    from bounce_mjx.training.setup import set_up_jax
    from bounce_mjx.viewers.comparison import recording
    from bounce_mjx.viewers.page import SUFFIXES, write_page

    check_output(page, "--html", SUFFIXES)
    preset = read_preset(Path("default"), command.robot, world=command.world)
    estimates, shown = {}, "the model's own world"
    if command.world is not None:
        estimates = in_world(preset, command.world)[1].estimates
        kind = "the estimates" if estimates else "the middle of each range"
        shown = f"{kind} of {command.world}"
    commands, console = given_commands(preset.env), stdout(highlight=False)
    set_up_jax(preset.env)
    env, topics = Env(preset.env), Topics(**command.topics.model_dump())
    log, _ = read_log(command.log, env.mj_model, topics)
    with console.status("simulating"):
        found = replay_log(preset.env, log, estimates, viewing.seconds)
        frames = recording(env, found, commands)
        write_page(page, env, frames, viewing.fps, ("measured", "simulated"))
    angles, ball = found.distances
    off = f"joint angles differ by {1e3 * angles:.2f} mrad"
    off += " (no bounce is shown)" if math.isnan(ball) else f", the ball by {1e3 * ball:.1f} mm"
    console.out(f"simulated in {shown}; root mean square: {off}")
    console.out(f"written: {page}")


def load_shown(checkpoint: "Checkpoint", config: TrainConfig, console: Console) -> "Shown":
    """The environment and the policy of a checkpoint."""
    from bounce_mjx.reports.tables import count_text
    from bounce_mjx.runs.folders import MIRROR_LAW
    from bounce_mjx.runs.reading import read_actor
    from bounce_mjx.viewers.controllers import make_policy_controller
    from bounce_mjx.viewers.show import Shown

    checkpoint, policy, actor = read_actor(checkpoint, config)
    console.out(f"checkpoint: {checkpoint.folder}", highlight=False)

    def make_controller(env: "Env") -> "Controller":
        return make_policy_controller(actor(env), policy)

    title = checkpoint.run.name
    if checkpoint is not MIRROR_LAW:
        title += f", {count_text(checkpoint.steps)} steps"
    return Shown(config.env, make_controller, title)
