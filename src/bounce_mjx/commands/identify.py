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
from bounce_mjx.runs.layers import read_preset


class IdentifyCommand(StrictModel):
    """Estimates the world of a robot from logs of its runs, and writes it for --world."""

    logs: Annotated[tuple[Path, ...], Flag(is_positional=True)] = ()
    """CSV files of Recorder, or ROS bags (folders, .mcap, .db3 or .bag files)."""
    robot: Path | None = None
    """Config of a robot: the file that bounce-mjx adopt wrote, or the name of one in
    configs/robots/ (ur5e, panda or iiwa); the project's own arm by default."""
    out: Path = Path("world.yaml")
    """YAML file for the world; the page about it has the same name with .html."""
    inspect: bool = False
    """Look at the logs alone: name their faults and draw them on the page, without a fit."""
    force: bool = False
    """Fit logs with faults, and write a world that does not explain them, with that sentence in
    it, or compare it (--check)."""
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
    """Runs the command line; exits with 1 if --check finds another robot, 2 on a mistake, a faulty
    log, or a world that does not explain it."""
    command = parse(IdentifyCommand, args, prog="bounce-mjx identify")
    if not command.logs:
        raise UserError("no log is given; name the CSV files or bags to identify from")
    from bounce_mjx.identify.estimates import estimates, total_delay
    from bounce_mjx.identify.hypotheses import describe_choice
    from bounce_mjx.identify.identification import identify
    from bounce_mjx.identify.inspection import describe, examine
    from bounce_mjx.identify.log import join
    from bounce_mjx.identify.reading import read_log
    from bounce_mjx.identify.sentences import describe_doubts, sentences
    from bounce_mjx.identify.world_file import compare, to_yaml
    from bounce_mjx.reports.identification import identification_page, inspection_page
    from bounce_mjx.robot.model import joint_names
    from bounce_mjx.runs.storage import check_output, write_output
    from bounce_mjx.runs.worlds import robot_in_world
    from bounce_mjx.training.setup import set_up_jax
    from bounce_mjx.world.model import world_model
    from bounce_mjx.world.named import read_world

    known = None if command.check is None else read_world(command.check)
    page = command.out.with_suffix(".html")
    if known is None:
        check_output(command.out, "--out")
        check_output(page, "--out")
    config = read_preset(Path("default"), command.robot).env
    if known is not None:
        # Its ranges are of this robot's joints.
        ranges = known.settings.get("randomization", {})
        validate(type(config), config.model_dump() | {"randomization": ranges}, str(command.check))
    model = world_model(config, visual=False)
    names = joint_names(model)
    logs = [read_log(path, model, command.topics, command.joint_names) for path in command.logs]
    log = join(logs)
    for warning in log.notes:
        print(f"warning: {warning}")
    checkups = examine(logs, names)
    for line in describe(logs, checkups):
        print(line)
    faults = [fault for checkup in checkups for fault in checkup.faults]
    if known is None:
        write_output(page, inspection_page(logs, checkups))
    if command.inspect:
        if known is None:
            print(str(page))
        sys.exit(2 if faults else 0)
    if faults and not command.force:
        raise UserError(
            f"the logs have {len(faults)} faults, which a fit would blame on the robot; mend them, "
            f"or fit them all the same with --force{'' if known else f' ({page} draws them)'}"
        )
    set_up_jax(config)
    found = identify(config, log, command.camera_rotation, lambda line: print(f"  {line}"))
    for line in describe_choice(found.choice):
        print(line)
    print(total_delay(found, model))
    for entry in estimates(found, names):
        if entry.chosen:
            print(f"{entry.label}: {entry.value:.5g} {entry.unit}".rstrip() + "  (chosen)")
            continue
        seen = "" if entry.seen else "  (not shown by the log)"
        interval = f"{entry.low:.5g} to {entry.high:.5g} {entry.unit}".rstrip()
        print(f"{entry.label}: {entry.value:.5g}, {interval}{seen}")
    for line in sentences(found, names):
        print(line)
    doubts = [*map(str, faults), *describe_doubts(found, names)]
    if known is not None:
        if doubts and not command.force:
            raise UserError(
                f"the log cannot be compared with {command.check}, because no world explains it: "
                f"{doubts[0]} Compare all the same with --force"
            )
        changed = compare(known, found, names)
        for line in changed or [f"the robot still matches {command.check}"]:
            print(line)
        sys.exit(1 if changed else 0)
    robot = command.robot and str(command.robot)
    text = identification_page(found, logs, checkups, names, command.out, doubts, robot)
    write_output(page, text)
    print(str(page))
    if doubts and not command.force:
        raise UserError(
            f"{command.out} is not written, because no world explains the log: {doubts[0]} "
            "Read the page, or write the world all the same with --force"
        )
    robot_here = command.robot and robot_in_world(command.robot, command.out)
    write_output(command.out, to_yaml(found, log, names, robot_here, doubts))
    print(str(command.out))
