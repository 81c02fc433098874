"""The two edges between a robot's program and a policy: measurements by name become arrays in the
policy's order of the joints, and commands the driver's order. Nothing within knows another order.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bounce_mjx.deploy.metadata import (
    MEASURED_PER_JOINT,
    PER_BALL,
    UNITS,
    Metadata,
    in_driver_order,
    measurement_sizes,
)
from bounce_mjx.deploy.samples import Measurements
from bounce_mjx.errors import UserError

LARGEST = 1e6
"""Measurements beyond it are not of a robot."""
_LARGEST_TIME = 1e15
# A goal that is farther outside its range than the range is long, and than this (in its unit),
# is in another unit.
_ROOM = 0.5
# Two values of a goal that are one.
_SAME_GOAL = 1e-6
# Resolution of a time as a share of a control step.
_FINE = 0.25
_PER_JOINT = frozenset(MEASURED_PER_JOINT)


class Driver:
    """Reads what a robot's driver measures, and gives commands in its order of the joints."""

    def __init__(
        self,
        metadata: Metadata,
        needs: Sequence[str],
        names: Sequence[str] | Mapping[str, str] | None = None,
    ):
        """The driver of a policy's robot.

        Args:
          metadata: of the policy.
          needs: measurements required in every step.
          names: as `joint_names` of `load_policy`; None for the policy's own.

        Raises:
          UserError: the names are not those of the policy's robot.
        """
        self._order: np.ndarray | None = None
        """Index of each of the driver's joints among the policy's."""
        self._places: np.ndarray | None = None
        """Index of each of the policy's joints among the driver's."""
        self.metadata = metadata
        """The metadata in the driver's order."""
        self.policy_metadata = metadata
        """The metadata in the policy's order, with the driver's names of the joints."""
        if names is not None:
            order = _joint_order(names, metadata)
            self._order = np.array(order)
            self._places = np.argsort(order)
            self.metadata = in_driver_order(metadata, tuple(names), order)
            own_names = tuple(self.metadata.joint_names[place] for place in self._places)
            self.policy_metadata = metadata._replace(joint_names=own_names)
        self.needs = tuple(needs)
        self.units = UNITS | {name: c.unit or "no unit" for name, c in metadata.goals.items()}
        """Measurements that a step accepts, and their units."""
        self._sizes = measurement_sizes(metadata)
        balls = metadata.num_balls
        self._defaults = {
            "ball_quaternion": np.tile([1.0, 0.0, 0.0, 0.0], balls),
            "ball_angular_velocity": np.zeros(3 * balls),
        }
        self._observed: dict[str, slice] = {}
        self._observation_size = 0

    def use_observations(self, places: Mapping[str, slice], size: int) -> None:
        """As `DeployedPolicy.use_observations`."""
        if missing := [name for name in self.needs if name not in places]:
            raise UserError(
                f"an observation has no {', '.join(missing)}, which this policy measures; use "
                "Run(...).policy_in(env)"
            )
        self._observed = dict(places)
        self._observation_size = size

    def check(
        self, measurements: Mapping[str, Any], needs: Sequence[str] | None = None
    ) -> Measurements:
        """Copies of the measurements as arrays, with defaults for optional ones.

        Here what is no measurement at all is refused, at once; `samples.Samples.take` bridges what
        is one, but cannot be true.

        Args:
          measurements: as for `DeployedPolicy.step`.
          needs: those that may not be missing; by default, those of the policy.

        Raises:
          UserError: they have no names; or one is missing, unknown, of another shape, not finite,
            or a goal in another unit.
        """
        if not isinstance(measurements, Mapping):
            measurements = self._in_observation(measurements)
        for name in self.needs if needs is None else needs:
            if name not in measurements:
                raise UserError(
                    f"the measurement {name} is missing; this policy needs "
                    f"{', '.join(self.needs if needs is None else needs)} in every step"
                )
        checked = dict(self._defaults)
        for name, value in measurements.items():
            if name not in self.units:
                raise UserError(
                    f"{name} is not a measurement; a step takes {', '.join(self.units)}"
                )
            limit = _LARGEST_TIME if name == "time" else LARGEST
            rows = self.metadata.num_balls if name in PER_BALL else 1
            label = "the measurement " + name
            checked[name] = _array(label, value, self._sizes[name], self.units[name], limit, rows)
        if self.metadata.velocity != "measured":
            checked.pop("ball_velocity", None)
        for name, (ends, unit) in self.metadata.goals.items():
            if name in checked:
                _check_goal(name, float(checked[name][0]), ends, unit or "no unit")
        if "time" in measurements:
            self._check_resolution(measurements["time"])
        for name in _PER_JOINT & checked.keys():
            checked[name] = self.to_policy(checked[name])
        return checked

    def to_policy(self, values: np.ndarray) -> np.ndarray:
        """Values [..., J] of the joints in the policy's own order."""
        return values if self._places is None else values[..., self._places]

    def to_driver(self, values: np.ndarray) -> np.ndarray:
        """Values [..., J] of the joints in the driver's order."""
        return values if self._order is None else values[..., self._order]

    def read_joints(self, label: str, values: Any, unit: str, limit: float) -> np.ndarray:
        """A user's numbers [J] in the driver's order as an array in the policy's order; UserError
        for another shape or kind, or numbers beyond a limit."""
        return self.to_policy(_array(label, values, len(self.metadata.joint_names), unit, limit))

    def _in_observation(self, observation: Any) -> dict[str, Any]:
        """The newest measurements in an observation.

        Raises:
          UserError: the policy was loaded without the environment; or there is not one observation.
        """
        if not self._observed:
            raise UserError(
                f"a step got {type(observation).__name__}, and takes measurements by name; for an "
                "environment's observations, load_policy(..., env=env)"
            )
        array = np.asarray(observation)
        if array.shape != (self._observation_size,):
            raise UserError(
                f"the observation has the shape {list(array.shape)}, but must have "
                f"{[self._observation_size]}; for many at once, use Run(...).policy_in(env)"
            )
        return {name: array[self._observed[name]] for name in self.needs}

    def _check_resolution(self, time: Any) -> None:
        """Raises UserError for a time whose type cannot tell one control step from the next."""
        kind = getattr(time, "dtype", None)
        if kind is None or str(kind).endswith("64"):
            return
        spacing = float(np.spacing(np.ravel(np.abs(time))[0]))
        if spacing > _FINE * self.metadata.control_dt:
            raise UserError(
                f"the time {np.ravel(time)[0]} s is a {kind}, whose next number is {spacing:.3g} s "
                "later; give 64 bits, or the seconds since the start"
            )


def _joint_order(names: Sequence[str] | Mapping[str, str], metadata: Metadata) -> list[int]:
    """Index among the policy's joints of each of a driver's joints.

    Raises:
      UserError: the names are not those of the policy's robot.
    """
    joints = metadata.joint_names
    if isinstance(names, Mapping):
        order = [joints.index(name) if name in joints else -1 for name in names.values()]
    else:
        order = [_index_of(joints, name) for name in dict.fromkeys(names)]
    if len(names) != len(joints) or sorted(order) != list(range(len(joints))):
        raise UserError(
            f"joint_names has {', '.join(names)}, but the policy is for {metadata.robot}, whose "
            f"joints are {', '.join(joints)}; give the names of this robot, each once, or a "
            "mapping from the driver's names to these"
        )
    return order


def _index_of(joints: Sequence[str], name: str) -> int:
    """Index of the joint of a driver's name: that of this name, else the only one whose name ends
    it; -1 if there is none."""
    if name in joints:
        return joints.index(name)
    fitting = [i for i, joint in enumerate(joints) if name.endswith(joint)]
    return fitting[0] if len(fitting) == 1 else -1


def _check_goal(name: str, value: float, ends: tuple[float, float], unit: str) -> None:
    """Raises UserError for a goal that no world of the training can hold, or for another one
    than the only one of the training."""
    low, high = ends
    if low == high:
        # The network has never seen another value, and cannot heed it.
        if abs(value - low) > _SAME_GOAL:
            raise UserError(
                f"{name} is {value:.3g}, but the training had {low:.3g} alone ({unit}); give that, "
                f"or train with a range of {name}"
            )
        return
    room = max(high - low, _ROOM)
    if not low - room <= value <= high + room:
        raise UserError(
            f"{name} is {value:.3g}, but the training had {low:.3g} to {high:.3g} ({unit}); give "
            "this unit"
        )


def _array(label: str, value: Any, size: int, unit: str, limit: float, rows: int = 1) -> np.ndarray:
    """A copy of a user's numbers, which may come in rows, as an array [size]; UserError for another
    shape or kind, or numbers beyond a limit. Hidden entries of a masked array are not finite."""
    is_masked = isinstance(value, np.ma.MaskedArray)
    try:
        array = value if is_masked else np.asarray(value)
        # Text, truth values, dates and complex numbers are no measurements.
        if array.dtype.kind not in "fiuO":
            raise TypeError
        array = array.astype(float)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{label} is {str(value)[:100]!r}; give {_count(size)} ({unit})") from error
    if array.shape not in ((size,), (rows, size // rows)) and not (size == 1 and not array.shape):
        raise UserError(f"{label} has the shape {list(array.shape)}; give {_count(size)} ({unit})")
    if is_masked:
        array = np.ma.filled(array, np.nan)
    array = array.reshape(size)
    # Of so few numbers, Python's comparisons are the faster.
    for number in array.tolist():
        if not abs(number) <= limit + 1e-6:
            raise UserError(f"{label} holds {number}; give finite numbers ({unit})")
    return array


def _count(size: int) -> str:
    return "one number" if size == 1 else f"{size} numbers"
