"""Plans a motion from which an arm can be identified: `bounce-mjx excite --robot R --out FILE`."""

from collections.abc import Sequence
from pathlib import Path

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import Finite, Positive, StrictModel
from bounce_mjx.runs.layers import read_preset


class ExciteCommand(StrictModel):
    """Plans a motion of the arm without a ball, from which bounce-mjx identify estimates the arm:
    each joint slow and fast, then all together, free of contacts."""

    robot: Path | None = None
    """Config of a robot: the file that bounce-mjx adopt wrote, or the name of one in
    configs/robots/ (ur5e, panda or iiwa); the project's own arm by default."""
    out: Path = Path("excitation.csv")
    """CSV file for the servo targets over time."""
    seconds: Positive = 20.0
    """Length, s."""
    max_velocity: Positive = 1.0
    """Largest speed of a joint's target, rad/s; give less than the robot's own limit."""
    max_acceleration: Positive | None = None
    """Largest acceleration of a joint's target, rad/s^2; by default as much as the servos' torques
    and the robot's own limits allow."""
    table_height: Finite | None = None
    """Height of a table that the arm must not touch, m; the floor is at 0."""


def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 2 on a mistake."""
    command = parse(ExciteCommand, args, prog="bounce-mjx excite")
    from bounce_mjx.identify.excitation import excite, to_csv
    from bounce_mjx.runs.storage import write_output

    config = read_preset(Path("default"), command.robot).env
    motion = excite(
        config,
        command.seconds,
        command.max_velocity,
        command.table_height,
        command.max_acceleration or float("inf"),
    )
    write_output(command.out, to_csv(motion))
    for name, amplitude in zip(motion.joint_names, motion.amplitudes, strict=True):
        print(f"  {name}: up to {amplitude:.3f} rad from the start pose")
    print(f"motion: {command.out} ({motion.times[-1]:.0f} s)")
