"""Shows the environment without a policy: `bounce-mjx view`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from bounce_mjx.config.command_line import flag_names, parse, read_flags, stdout
from bounce_mjx.config.files import flat
from bounce_mjx.config.settings import StrictModel, fields_in
from bounce_mjx.runs.layers import CommandLine, read_layers
from bounce_mjx.runs.start import Choice
from bounce_mjx.task.registry import DEFAULT
from bounce_mjx.viewers.options import ViewerOptions

PROG = "bounce-mjx view"
_TITLES = {"random": "random actions", "zero": "zero actions", "mirror": "mirror law"}


class ViewCommand(StrictModel):
    """Shows the environment under random or zero actions, or the mirror law."""

    actions: Literal["random", "zero", "mirror"] = "random"
    """random: uniform; zero: the servos hold their angles; mirror: the mirror law, a model-based
    controller."""
    task: str = DEFAULT
    """Name of the task."""
    robot: Path | None = None
    """Config of a robot: the file that bounce-mjx adopt wrote, or the name of one in
    configs/robots/ (ur5e, panda or iiwa)."""
    viewing: ViewerOptions = ViewerOptions()


def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 2 on a mistake."""
    # The task and the robot, read first, decide which flags of the environment there are. The
    # second reading gives the command's own flags again, and they are left out.
    command = parse(ViewCommand, args, prog=PROG, is_first=True)
    choice = Choice(word=command.task, config=(Path("default"),), robot=command.robot)
    layers = read_layers(choice)
    of_env = {key: field for key, field in layers.fields.items() if key.startswith("env.")}
    fields = fields_in(ViewCommand) | of_env
    defaults = flat(ViewCommand().model_dump()) | flat(layers.config().model_dump())
    about = ViewCommand.__doc__ or ""
    given = read_flags(fields, args, prog=PROG, description=about, defaults=defaults)
    said = {key: value for key, value in given.items() if key in of_env}
    env = layers.config(said, CommandLine(PROG, flag_names(fields))).env
    from bounce_mjx.baselines.mirror import MirrorLaw, observing
    from bounce_mjx.training.setup import set_up_jax
    from bounce_mjx.viewers import simulation
    from bounce_mjx.viewers.show import Shown, show

    make_controller = {
        "random": simulation.make_random_controller,
        "zero": simulation.make_zero_controller,
        "mirror": lambda env: simulation.make_policy_controller(MirrorLaw(env)),
    }
    env = observing(env) if command.actions == "mirror" else env
    set_up_jax(env)
    shown = Shown(env, make_controller[command.actions], _TITLES[command.actions])
    show([shown], command.viewing, goals={}, console=stdout())
