"""Estimates a robot's world from its logs: `bounce-mjx identify LOG... --out world.yaml`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from bounce_mjx.config.command_line import Flag, parse
from bounce_mjx.config.settings import NonNegative, StrictModel
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError
from bounce_mjx.identify import Topics
from bounce_mjx.runs.settings import read_preset


class IdentifyCommand(StrictModel):
    """Estimates the world of a robot from logs of its runs, and writes it for --world."""

    logs: Annotated[tuple[Path, ...], Flag(is_positional=True)] = ()
    """CSV files of Recorder, or ROS bags (folders, .mcap, .db3 or .bag files)."""
    robot: Path | None = None
    """Config of a robot: the file that bounce-mjx adopt wrote, or the name of one in
    configs/robots/ (ur5e, panda or iiwa); the project's own arm by default."""
    out: Path = Path("world.yaml")
    """YAML file for the world; the page about it has the same name with .html."""
    check: Path | None = None
    """World that was identified earlier; compare the logs with it, and write nothing."""
    camera_rotation: NonNegative = 0.0
    """Standard deviation of the camera's rotation to the base, rad; 0 for a calibrated one."""
    joint_names: tuple[str, ...] = ()
    """The driver's names of the joints in the logs, in the policy's order; by default the robot's
    own."""
    topics: Topics = Topics()
    """Topics of a bag."""


def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 1 if --check finds another robot, 2 on a mistake."""
    command = parse(IdentifyCommand, args, prog="bounce-mjx identify")
    if not command.logs:
        raise UserError("no log is given; name the CSV files or bags to identify from")
    from bounce_mjx.identify.reading import read_log
    from bounce_mjx.identify.stages import identify, join
    from bounce_mjx.identify.world import compare, estimates, sentences, to_yaml
    from bounce_mjx.reports.identification import identification_page
    from bounce_mjx.robot.model import joint_names, load_model
    from bounce_mjx.runs.files import check_output, write_output
    from bounce_mjx.training.setup import set_up_jax
    from bounce_mjx.world.named import read_world

    known = None if command.check is None else read_world(command.check)
    page = command.out.with_suffix(".html")
    for path in (command.out, page) if known is None else ():
        check_output(path, "--out")
    config = read_preset(Path("default"), command.robot).env
    if known is not None:
        # Its ranges are of this robot's joints.
        ranges = known.applied({})["randomization"]
        validate(type(config), config.model_dump() | {"randomization": ranges}, str(command.check))
    model = load_model(config.mjcf, config.physics_dt, visual=False, robot=config.robot)
    names = joint_names(model)
    logs = [read_log(path, model, command.topics, command.joint_names) for path in command.logs]
    log = join(logs)
    for warning in log.notes:
        print(f"warning: {warning}")
    set_up_jax(config)
    found = identify(config, log, command.camera_rotation, lambda line: print(f"  {line}"))
    for entry in estimates(found, names):
        seen = "" if entry.seen else "  (not shown by the log)"
        interval = f"{entry.low:.5g} to {entry.high:.5g} {entry.unit}".rstrip()
        print(f"{entry.label}: {entry.value:.5g}, {interval}{seen}")
    for line in sentences(found, names):
        print(line)
    if known is not None:
        changed = compare(known, found, names)
        for line in changed or [f"the robot still matches {command.check}"]:
            print(line)
        sys.exit(1 if changed else 0)
    files = {
        command.out: to_yaml(found, log, names, command.robot and str(command.robot)),
        page: identification_page(found, log.source, names, command.out),
    }
    for path, content in files.items():
        write_output(path, content)
        print(str(path))
