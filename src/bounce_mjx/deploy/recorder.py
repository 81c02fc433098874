"""A log of a robot's run: one CSV file, from which `bounce-mjx identify` estimates its world."""

import contextlib
import csv
import itertools
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bounce_mjx.errors import UserError

_OF_JOINTS = {"joint_angles": "rad", "joint_velocities": "rad/s", "servo_targets": "rad"}
# Two pictures closer than this are one, s.
_SAME_PICTURE = 1e-4


class Recorder(contextlib.AbstractContextManager):
    """Writes what a policy saw and sent into a CSV file, a row for each control step.

    A row has the ball's cells filled if a picture arrived since the last row; pictures between two
    control steps have rows of their own. A context manager closes the file.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        joint_names: Iterable[str],
        goals: Mapping[str, str] | None = None,
        num_balls: int | None = None,
    ):
        """Makes the file. The first row makes its header, which names each column and, in brackets,
        its unit.

        Args:
          joint_names: order of the joints in every array, such as `policy.metadata.joint_names`.
          goals: unit of each goal by its name.
          num_balls: how many balls a picture shows, such as `policy.metadata.num_balls`; by default
            as many as the first row has. The columns of several are `ball_position.1.x [m]` and so
            on.

        Raises:
          UserError: the file exists, or cannot be made.
        """
        self._joints = tuple(joint_names)
        self._goals = dict(goals or {})
        self._num_balls = num_balls
        self._sizes: dict[str, int] | None = None
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
        self._last: tuple[float, Any] = -np.inf, None

    def step(self, measurements: Mapping[str, Any], servo_targets: Any) -> None:
        """Writes the row of a control step. Call it after the commands are sent, as it may raise.

        Args:
          measurements: as for `DeployedPolicy.step`, with `time`. Any other that is missing, or
            not finite, leaves its cells empty. `ball_position` ([3], of several balls [N, 3])
            counts as a new picture if it was taken (`time` - `ball_age`) at another time than the
            last one; without `ball_age`, if it differs.
          servo_targets: sent in this step [J], rad.

        Raises:
          UserError: the time is missing, or a measurement has another size.
        """
        if "time" not in measurements:
            raise UserError("a row of the log has no time; give the measurements a time (s)")
        picture = self._new_picture(measurements)
        self._write({**measurements, "servo_targets": servo_targets, **picture})

    def picture(self, time: float, position: Any, taken: float | None = None) -> None:
        """Writes a row for a picture that no control step sees, as a later one arrives before it.

        Args:
          time: of its arrival, s.
          position: of the ball [3], or of each [N, 3], m.
          taken: time at which it was taken, s; by default, that of its arrival.
        """
        self._last = (time if taken is None else taken), np.array(position, float)
        self._write({"time": time, "ball_position": position, "ball_time": self._last[0]})

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _new_picture(self, measurements: Mapping[str, Any]) -> dict[str, Any]:
        """The measured picture; without a position if it is none or the last one, or was taken at
        no known time."""
        time = float(np.ravel(measurements["time"])[0])
        age = measurements.get("ball_age")
        position = np.array(measurements.get("ball_position"), float)
        taken = time if age is None else time - float(np.ravel(age)[0])
        last, seen = self._last
        is_old = (
            np.array_equal(position, seen) if age is None else abs(taken - last) < _SAME_PICTURE
        )
        if is_old or not np.isfinite(taken) or not np.any(np.isfinite(position)):
            return {"ball_position": None}
        self._last = taken, position
        return {"ball_position": position, "ball_time": taken}

    def _write(self, values: Mapping[str, Any]) -> None:
        """Writes a row; the cells of what is missing or not finite are empty, ball by ball."""
        if self._sizes is None:
            self._write_header(values.get("ball_position"))
        row = []
        for name, size in self._sizes.items():
            numbers = np.ravel(np.array(values.get(name, np.nan), float))
            if len(numbers) != size and values.get(name) is not None:
                balls = " (num_balls)" if name == "ball_position" else ""
                raise UserError(
                    f"{name} has {len(numbers)} numbers, and the log has {size} cells for it{balls}"
                )
            if values.get(name) is None:
                numbers = np.full(size, np.nan)
            groups = numbers.reshape(-1, 3) if name == "ball_position" else [numbers]
            for group in groups:
                is_given = np.all(np.isfinite(group))
                row += [repr(x) for x in group.tolist()] if is_given else [""] * len(group)
        self._rows.writerow(row)

    def _write_header(self, ball_position: Any) -> None:
        """Writes the titles, for as many balls as were told, or as a position has."""
        if self._num_balls is None:
            shown = 3 if ball_position is None else np.size(ball_position)
            self._num_balls = max(shown // 3, 1)
        columns = {"time": ["time [s]"]}
        for name, unit in _OF_JOINTS.items():
            columns[name] = [f"{name}.{joint} [{unit}]" for joint in self._joints]
        balls = [f"ball_position.{i}" for i in range(1, self._num_balls + 1)]
        if self._num_balls == 1:
            balls = ["ball_position"]
        columns["ball_position"] = [f"{ball}.{axis} [m]" for ball in balls for axis in "xyz"]
        columns["ball_time"] = ["ball_time [s]"]
        columns |= {name: [f"{name} [{unit}]"] for name, unit in self._goals.items()}
        self._sizes = {name: len(titles) for name, titles in columns.items()}
        self._rows.writerow(itertools.chain(*columns.values()))
