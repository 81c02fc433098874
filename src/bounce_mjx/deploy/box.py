"""The box that a supervised paddle does not leave, and the flags by which a robot's program asks
for one: without a box, it runs only where the user says so."""

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np

from bounce_mjx.errors import UserError

Box = tuple[Sequence[float], Sequence[float]]
"""The lowest and the highest x, y and z that the paddle's centre may reach, m."""

# Of an end of a box from the base, m.
_FARTHEST_END = 30.0


def checked_box(box: Any) -> np.ndarray:
    """The ends [2, 3] of a box, m; UserError if it is none."""
    try:
        ends = np.array(box, float)
    except (TypeError, ValueError):
        ends = np.zeros(0)
    if ends.shape != (2, 3) or not np.all(ends[0] < ends[1]):
        raise UserError(f"the box is {box}; give its lowest and its highest x, y and z, m")
    farthest = np.max(np.abs(ends), where=np.isfinite(ends), initial=0.0)
    if farthest > _FARTHEST_END:
        raise UserError(
            f"the box is {box}, and ends {farthest:g} from the base, but no arm reaches "
            f"{_FARTHEST_END:g} m; give metres, or inf for an end that is not there"
        )
    return ends


def add_box(parser: argparse.ArgumentParser) -> None:
    """Adds the flags `--box` and `--no-box`, of which one has to be given."""
    group = parser.add_mutually_exclusive_group(required=True)
    group.add_argument(
        "--box",
        type=float,
        nargs=6,
        metavar=("X", "Y", "Z", "X2", "Y2", "Z2"),
        help="the lowest and the highest x, y and z that the paddle may reach, m",
    )
    group.add_argument("--no-box", action="store_true", help="let the paddle go anywhere")


def box_of(arguments: argparse.Namespace) -> dict[str, Box]:
    """The `box` of `DeployedPolicy.supervise` for the flags of `add_box`; empty for none."""
    if arguments.no_box:
        return {}
    return {"box": (arguments.box[:3], arguments.box[3:])}
