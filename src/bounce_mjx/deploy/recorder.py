"""A log of a robot's run: one CSV file, from which `bounce-mjx identify` estimates its world."""

import csv
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bounce_mjx.errors import UserError

# Two pictures closer than this are one, s.
_SAME_PICTURE = 1e-4


def columns(joint_names: Iterable[str], commands: Mapping[str, str] | None = None) -> list[str]:
    """The header of a log: each column's name and, in brackets, its unit.

    Args:
      commands: unit of each command by its name.
    """
    joints = list(joint_names)
    return [
        "time [s]",
        *(f"joint_angles.{joint} [rad]" for joint in joints),
        *(f"joint_velocities.{joint} [rad/s]" for joint in joints),
        *(f"servo_targets.{joint} [rad]" for joint in joints),
        *(f"ball_position.{axis} [m]" for axis in "xyz"),
        "ball_time [s]",
        *(f"{name} [{unit}]" for name, unit in (commands or {}).items()),
    ]


class Recorder:
    """Writes what a policy saw and sent into a CSV file, a row for each control step.

    A row has the ball's cells filled if a picture arrived since the last row; pictures between two
    control steps have rows of their own. A context manager closes the file.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        joint_names: Iterable[str],
        commands: Mapping[str, str] | None = None,
    ):
        """Makes the file.

        Args:
          joint_names: order of the joints in every array, such as `policy.metadata.joint_names`.
          commands: unit of each command by its name.

        Raises:
          UserError: the file exists, or cannot be made.
        """
        self._joints, self._commands = tuple(joint_names), dict(commands or {})
        try:
            # A row reaches the file at once, as a robot's program may end at any time.
            self._file = Path(path).open("x", buffering=1, newline="", encoding="utf-8")
        except FileExistsError as error:
            raise UserError(f"the log {path} exists; choose another name") from error
        except OSError as error:
            raise UserError(
                f"the log {path} cannot be created ({error.strerror}); choose another folder"
            ) from error
        self._rows = csv.writer(self._file, lineterminator="\n")
        self._rows.writerow(columns(self._joints, self._commands))
        self._last: tuple[float, np.ndarray] | None = None

    def step(self, measurements: Mapping[str, Any], servo_targets: Any) -> None:
        """Writes the row of a control step.

        Args:
          measurements: as for `DeployedPolicy.step`, with `time`. A missing one, or one that is not
            finite, leaves its cells empty. `ball_position` counts as a new picture if it was taken
            (`time` - `ball_age`) at another time than the last one; without `ball_age`, if it
            differs.
          servo_targets: sent in this step [J], rad.

        Raises:
          UserError: a measurement has another size.
        """
        count, time = len(self._joints), float(np.ravel(measurements["time"])[0])
        row = [time]
        for name in ("joint_angles", "joint_velocities"):
            row += _cells(name, measurements.get(name), count)
        row += _cells("servo_targets", servo_targets, count)
        row += self._new_picture(time, measurements)
        row += [cell for name in self._commands for cell in _cells(name, measurements.get(name), 1)]
        self._write(row)

    def picture(self, time: float, position: Any, taken: float | None = None) -> None:
        """Writes a row for a picture that no control step sees, as a later one arrives before it.

        Args:
          time: of its arrival, s.
          position: of the ball [3], m.
          taken: time at which it was taken, s; by default, that of its arrival.
        """
        self._last = (time if taken is None else taken), np.array(position, float)
        joints = [None] * (3 * len(self._joints))
        picture = [*_cells("ball_position", position, 3), self._last[0]]
        self._write([time, *joints, *picture, *[None] * len(self._commands)])

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _new_picture(self, time: float, measurements: Mapping[str, Any]) -> list[float | None]:
        """Cells of the picture, empty if it is none or the last one."""
        cells = _cells("ball_position", measurements.get("ball_position"), 3)
        if None in cells:
            return [None] * 4
        position, age = np.array(cells), measurements.get("ball_age")
        taken = time if age is None else time - float(np.ravel(age)[0])
        if self._last is not None:
            last, seen = self._last
            same_time = age is not None and abs(taken - last) < _SAME_PICTURE
            if same_time or (age is None and np.array_equal(position, seen)):
                return [None] * 4
        self._last = taken, position
        return [*cells, taken]

    def _write(self, row: list[float | None]) -> None:
        self._rows.writerow(["" if x is None else repr(float(x)) for x in row])


def _cells(name: str, values: Any, count: int) -> list[float | None]:
    """A measurement's cells, empty if it is missing or not finite."""
    if values is None:
        return [None] * count
    values = np.ravel(np.asarray(values, float))
    if len(values) != count:
        raise UserError(f"{name} has {len(values)} numbers, and the log has {count} cells for it")
    return values.tolist() if np.all(np.isfinite(values)) else [None] * count
