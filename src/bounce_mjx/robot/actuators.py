"""The actuators of a model: which joint each one moves, whether it is a position servo, and the
torques that it can exert there.

An acting joint of the task has exactly one actuator, a position servo, whose control is the target
position of the joint, times the gear. An arm that is adopted may have other ones, such as motors.

MuJoCo counts actuators (`nactuator`) and controls (`nu`) apart, as a `<pid>` has several controls:
`actuator_ctrladr` is the first control of each actuator. It limits an actuator by its `forcerange`,
which the `gear` multiplies, and a joint by its `actuatorfrcrange`; `servo_settings` also finds the
limit of an actuator that is no servo, whose control may limit it too.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.robot.names import joint_name

ACTING_KINDS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
"""Joints of one number, which a position servo can move."""
_CONTROL_BOUNDS_ACTIVATION = (
    mujoco.mjtDyn.mjDYN_NONE,
    mujoco.mjtDyn.mjDYN_FILTER,
    mujoco.mjtDyn.mjDYN_FILTEREXACT,
)
"""Dynamics of an actuator whose activation, if it has one, never leaves the range of its
control."""
_BIASES_BY_NUMBERS = (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
"""Biases that are 0 where their numbers are."""
_KNOWN_GAINS = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_PID)
"""Of a motor or a controller: without a range, its force has no limit."""
JOINT_TRANSMISSIONS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
"""Of an actuator that drives a joint; for a hinge or a slide, both are the same."""


class ServoSettings(NamedTuple):
    """A position servo of one joint. Of another actuator, such as a motor, stiffness and damping
    are None."""

    stiffness: float | None
    """N m/rad, or N/m."""
    damping: float | None
    """N m s/rad, or N s/m."""
    force_limit: float | None
    """N m, or N; None for no limit."""


def joint_actuators(model: mujoco.MjModel) -> dict[int, list[int]]:
    """The actuators of each joint that has some, the joints in the model's order."""
    actuators_of: dict[int, list[int]] = {}
    for actuator in range(model.nactuator):
        if int(model.actuator_trntype[actuator]) in JOINT_TRANSMISSIONS:
            joint = int(model.actuator_trnid[actuator, 0])
            actuators_of.setdefault(joint, []).append(actuator)
    return dict(sorted(actuators_of.items()))


def single_actuators(model: mujoco.MjModel, joints: Collection[int]) -> dict[int, int]:
    """The actuators of those of some joints that have one, by joint, in the model's order.

    Raises:
      UserError: a joint has several; the text starts with what is wrong.
    """
    single = {}
    for joint, actuators in joint_actuators(model).items():
        if joint not in joints:
            continue
        if len(actuators) > 1:
            name = joint_name(model, joint)
            raise UserError(f"several actuators on {name}; give it one")
        single[joint] = actuators[0]
    return single


def is_position_servo(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator acts as a position servo, whose target is a joint position times the
    gear. `is_direct` tells whether the target is the control itself, not a filtered or an
    integrated one.

    MuJoCo's force is gain * control + offset + factor * position + ...; a servo has the gain as its
    stiffness, and no offset.
    """
    gain = model.actuator_gainprm[actuator, 0]
    offset = model.actuator_biasprm[actuator, 0]
    factor = model.actuator_biasprm[actuator, 1]
    return bool(
        model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
        and gain > 0.0
        and model.actuator_gear[actuator, 0] != 0.0
        and offset == 0.0
        # Otherwise the joint would rest at another position than the control.
        and np.isclose(factor, -gain)
    )


def is_direct(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether the control itself acts, not a filtered or an integrated one."""
    return bool(model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE)


def servo_settings(model: mujoco.MjModel, joint: int, actuator: int) -> ServoSettings:
    """The settings of the actuator that drives a joint.

    Raises:
      UserError: it pushes one way only, or its force limit is unknown.
    """
    limit = _force_limit(model, joint, actuator)
    if not (is_direct(model, actuator) and is_position_servo(model, actuator)):
        return ServoSettings(None, None, limit)
    gear = float(model.actuator_gear[actuator, 0])
    stiffness = float(model.actuator_gainprm[actuator, 0]) * gear**2
    # Without a damping the bias is -0.0, which would be printed.
    damping = 0.0 - float(model.actuator_biasprm[actuator, 2]) * gear**2
    return ServoSettings(stiffness, damping, limit)


def servo_range(model: mujoco.MjModel, actuator: int) -> tuple[float, float]:
    """Joint positions that the targets of a position servo reach, rad or m; infinite for another
    actuator, and without a range of the control."""
    control = model.actuator_ctrladr[actuator]
    # The control of an integrator is a velocity.
    is_integrator = model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_INTEGRATOR
    is_servo = not is_integrator and is_position_servo(model, actuator)
    if not (is_servo and model.actuator_ctrllimited[control]):
        return -np.inf, np.inf
    low, high = sorted(model.actuator_ctrlrange[control] / model.actuator_gear[actuator, 0])
    return float(low), float(high)


def force_ranges(mj_model: mujoco.MjModel, servos: Sequence[int]) -> np.ndarray:
    """Lower and upper ends [2, n] of the `forcerange` of actuators [n]; infinite without a
    limit."""
    low, high = mj_model.actuator_forcerange[list(servos)].T
    is_limited = mj_model.actuator_forcelimited[list(servos)].astype(bool)
    return np.stack([np.where(is_limited, low, -np.inf), np.where(is_limited, high, np.inf)])


def torque_ranges(
    mj_model: mujoco.MjModel, joints: Sequence[int], servos: Sequence[int]
) -> np.ndarray:
    """Least and greatest torque [2, n] (N m, or N of a slide) of the servos [n] of joints [n];
    infinite without a limit."""
    gears = mj_model.actuator_gear[list(servos), 0]
    low, high = np.sort(gears * force_ranges(mj_model, servos), axis=0)
    joint_low, joint_high = mj_model.jnt_actfrcrange[list(joints)].T
    is_limited = mj_model.jnt_actfrclimited[list(joints)].astype(bool)
    return np.stack(
        [
            np.where(is_limited, np.maximum(low, joint_low), low),
            np.where(is_limited, np.minimum(high, joint_high), high),
        ]
    )


def largest_torques(
    mj_model: mujoco.MjModel, joints: Sequence[int], servos: Sequence[int]
) -> np.ndarray:
    """Largest torque [n] (N m, or N of a slide) that the servos exert in either direction: the
    smaller of both ends; infinite without a limit."""
    low, high = torque_ranges(mj_model, joints, servos)
    return np.minimum(-low, high)


def limit_torques(
    mj_model: mujoco.MjModel, servos: Sequence[int], torques: Sequence[float]
) -> None:
    """Narrows the `forcerange` of servos [n] to torques [n] (N m) at their joints; a weaker servo
    keeps its own. Each has 0 in its range (`model.check_servos`)."""
    forces = np.asarray(torques) / np.abs(mj_model.actuator_gear[list(servos), 0])
    low, high = force_ranges(mj_model, servos)
    narrowed = np.stack([np.maximum(low, -forces), np.minimum(high, forces)], axis=1)
    mj_model.actuator_forcerange[list(servos)] = narrowed
    mj_model.actuator_forcelimited[list(servos)] = True


class _ForceRange(NamedTuple):
    """One of MuJoCo's limits of an actuator's force."""

    name: str
    """In the MJCF."""
    is_limited: bool
    range: np.ndarray
    """[2], in its own unit."""
    factor: float
    """Force at the joint per unit."""


def _force_limit(model: mujoco.MjModel, joint: int, actuator: int) -> float | None:
    """Largest force of a joint's actuator in both directions, N m or N; None for no limit: by the
    force range, by the range of a motor's control or activation, or by the joint's own limit. Of a
    servo it is that of `largest_torques`.

    Raises:
      UserError: the actuator pushes one way only, or not at all, or its limit is unknown.
    """
    _check_pushes(model, joint, actuator)
    gear = float(model.actuator_gear[actuator, 0])
    gain = float(model.actuator_gainprm[actuator, 0])
    control = model.actuator_ctrladr[actuator]
    dynamics = int(model.actuator_dyntype[actuator])
    # The force of a motor is its gain times its activation, which may be the control itself.
    gain_type = int(model.actuator_gaintype[actuator])
    has_bias = int(model.actuator_biastype[actuator]) not in _BIASES_BY_NUMBERS or np.any(
        model.actuator_biasprm[actuator, :3]
    )
    is_motor = gain_type == mujoco.mjtGain.mjGAIN_FIXED and not has_bias
    has_activation = dynamics != mujoco.mjtDyn.mjDYN_NONE
    ranges = (
        _ForceRange(
            name="forcerange",
            is_limited=bool(model.actuator_forcelimited[actuator]),
            range=model.actuator_forcerange[actuator],
            factor=gear,
        ),
        _ForceRange(
            name="ctrlrange",
            is_limited=bool(
                is_motor
                and dynamics in _CONTROL_BOUNDS_ACTIVATION
                and model.actuator_ctrllimited[control]
            ),
            range=model.actuator_ctrlrange[control],
            factor=gear * gain,
        ),
        _ForceRange(
            name="actrange",
            is_limited=bool(is_motor and has_activation and model.actuator_actlimited[actuator]),
            range=model.actuator_actrange[actuator],
            factor=gear * gain,
        ),
        _ForceRange(
            name="actuatorfrcrange",
            is_limited=bool(model.jnt_actfrclimited[joint]),
            range=model.jnt_actfrcrange[joint],
            factor=1.0,
        ),
    )
    limits = []
    for force_range in ranges:
        if not force_range.is_limited:
            continue
        low, high = force_range.range.tolist()
        # Stricter than `model.check_servos`: the limit also becomes that of a made servo, which
        # pushes both ways.
        if not low < 0.0 < high:
            most = max(-low, high)
            raise UserError(
                f"the {force_range.name} {low:g} to {high:g} on {joint_name(model, joint)}, so its "
                f"actuator pushes one way only; give a range around 0, such as {-most:g} to "
                f"{most:g}"
            )
        limits.append(min(-low, high) * abs(force_range.factor))
    if not limits and gain_type not in _KNOWN_GAINS:
        raise UserError(
            f"an actuator on {joint_name(model, joint)} whose strength follows from more than its "
            "control; give it a forcerange, or drive the joint by a <position> or <motor>"
        )
    limit = min(limits, default=np.inf)
    return limit if np.isfinite(limit) else None


def _check_pushes(model: mujoco.MjModel, joint: int, actuator: int) -> None:
    """Refuses a muscle, which only pulls, and a damper, which only brakes."""
    gain_type = model.actuator_gaintype[actuator]
    offset_and_stiffness = model.actuator_gainprm[actuator, :2]
    is_affine = gain_type == mujoco.mjtGain.mjGAIN_AFFINE
    if gain_type == mujoco.mjtGain.mjGAIN_MUSCLE:
        kind = "muscle"
    elif is_affine and not np.any(offset_and_stiffness):
        kind = "damper"
    else:
        return
    raise UserError(
        f"a {kind} on {joint_name(model, joint)}, which cannot push both ways; drive the joint by "
        "a <position> or <motor> with a force limit"
    )
