"""Servo targets over time, as `bounce-mjx excite` writes them."""

import csv
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bounce_mjx.errors import UserError

_TIME = "time [s]"
_TARGET = "servo_targets."
_UNIT = " [rad]"


class Trajectory(NamedTuple):
    """Servo targets over time."""

    joint_names: tuple[str, ...]
    times: np.ndarray
    """Times [T], s, from 0."""
    targets: np.ndarray
    """Servo targets [T, J], rad."""

    def at(self, time: float) -> np.ndarray:
        """The targets [J] at a time (s), between those of the two times around it."""
        return np.array([np.interp(time, self.times, column) for column in self.targets.T])


def read_trajectory(path: str | os.PathLike) -> Trajectory:
    """The trajectory in a CSV file of `bounce-mjx excite`.

    Raises:
      UserError: the file is missing, or is none.
    """
    try:
        titles, *rows = csv.reader(Path(path).read_text(encoding="utf-8").splitlines())
        joints = tuple(title.removeprefix(_TARGET).removesuffix(_UNIT) for title in titles[1:])
        expected = [_TIME, *(f"{_TARGET}{joint}{_UNIT}" for joint in joints)]
        numbers = np.array(rows, float)
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}); name another file") from error
    except ValueError as error:
        raise UserError(f"{path} is no motion of bounce-mjx excite ({error})") from error
    is_motion = titles == expected and len(numbers) > 1 and np.all(np.isfinite(numbers))
    if not (is_motion and np.all(np.diff(numbers[:, 0]) > 0.0)):
        raise UserError(
            f"{path} is no motion of bounce-mjx excite; its first line must name {_TIME} and "
            f"{_TARGET}JOINT{_UNIT} for each joint, and rows of numbers follow, later ones below"
        )
    return Trajectory(joints, numbers[:, 0] - numbers[0, 0], numbers[:, 1:])
