"""Motions of the arm without a ball that show its servos: each joint alone, slow and fast, then all
together, without contacts."""

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.contacts import ContactChecker
from bounce_mjx.robot.actuators import largest_torques
from bounce_mjx.robot.model import find_addresses, joint_names, joint_ranges
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import world_model

MARGIN = 0.01
"""Least distance between two parts of the arm, and from the arm to the floor or a table, m."""
_LARGEST_AMPLITUDE = 0.3
_SMALLEST_AMPLITUDE = 0.005
_SLOW = 0.25
# Height by which the paddle is lifted first, m, and the time for it and for the way back, s.
_LIFT = 0.2
_LIFTING = 1.5
# Frequencies of a sweep, Hz. A delay and a servo's time constant part at the high ones alone.
_FAST = (0.6, 10.0)
_RAMP = 0.5
# Distance from the ends of a joint's range, rad.
_FROM_END = 0.02
# Least distance from there that the lift leaves a joint, rad.
_ROOM = 0.1
# Share of a limit that targets use.
_BELOW_LIMIT = 0.9
_TOGETHER = (0.53, 0.71, 0.89, 1.13, 1.37, 1.61, 1.83, 2.11)
# Time between two poses that are checked for contacts, s.
_CHECKED = 0.02
# Poses whose torques are computed; share of its largest acceleration from which a joint moves in
# one, and acceleration below which it rests, rad/s^2.
_POSES = 2000
_MOVES = 0.2
_AT_REST = 0.05


class Excitation(NamedTuple):
    """Servo targets over time."""

    joint_names: tuple[str, ...]
    times: np.ndarray
    """Times [T], s."""
    targets: np.ndarray
    """Servo targets [T, n], rad."""
    amplitudes: np.ndarray
    """Largest distance [n] of each joint from the start pose, rad."""


def excite(
    config: WorldConfig,
    seconds: float,
    max_velocity: float | Sequence[float],
    table_height: float | None = None,
    max_acceleration: float | Sequence[float] = np.inf,
) -> Excitation:
    """Plans an excitation that starts and ends at `config.default_joint_angles`.

    The arm first lifts the paddle, for room above the floor. The amplitude of the joint that is
    farthest out is halved until no pose has a contact; and the accelerations of the joints that
    move are, until no joint needs more than `_BELOW_LIMIT` of its servo's torque. Of a robot with
    `robot.limits`, all targets keep to them.

    Args:
      max_velocity: largest speed of a target, of each joint or of all, rad/s.
      table_height: height of a table under the arm, m; None for the floor alone.
      max_acceleration: largest acceleration of a target, of each joint or of all, rad/s^2.

    Raises:
      UserError: the start pose has a contact with the floor or the table, a joint cannot move, or
        its servo cannot hold it.
    """
    model = world_model(config, visual=False)
    n = config.num_joints
    dt = config.control_dt
    home = np.array(config.default_joint_angles)
    names = joint_names(model)
    limits = config.robot.limits
    given = limits.velocity, limits.acceleration, limits.jerk
    bounds = _BELOW_LIMIT * np.array([[np.inf] * n if x is None else x for x in given])
    bounds[0] = np.minimum(bounds[0], max_velocity)
    bounds[1] = np.minimum(bounds[1], max_acceleration)
    low, high = joint_ranges(model, find_addresses(model))
    # Lifted, each joint has room to both sides, or as much as in the start pose.
    reach = _FROM_END + _ROOM
    lowest = np.minimum(low + reach, home)
    highest = np.maximum(high - reach, home)
    centre = _lift_paddle(model, home, lowest, highest)
    room = np.minimum(centre - low, high - centre) - _FROM_END
    if np.min(room) < _SMALLEST_AMPLITUDE:
        joint = int(np.argmin(room))
        raise UserError(
            f"{names[joint]} cannot move, as it starts at {home[joint]:.3g} rad and its range is "
            f"{low[joint]:.3g} to {high[joint]:.3g} rad; change default_joint_angles"
        )
    amplitudes = np.minimum(_LARGEST_AMPLITUDE, room)
    contacts = ContactChecker(config, MARGIN, table_height)
    # Parts of the arm that overlap or nearly touch in its start pose are modelled so.
    near = ContactChecker(config, 2.0 * MARGIN).touching(home)
    allowed = {pair for pair in near if min(pair) >= 0}
    if below := sorted(contacts.touching(home) - allowed):
        raise UserError(
            f"the start pose has {_contact(contacts, below[0])}; change default_joint_angles or "
            "--table-height"
        )
    times = np.arange(round(seconds / dt)) * dt
    lifting = max(_LIFTING, _time_of_step(np.abs(centre - home), bounds))
    shortest = 2.0 * lifting + 1.0 * n
    if not len(times) or times[-1] < shortest:
        raise UserError(
            f"{seconds:g} s are too short to move {n} joints; give at least "
            f"{math.ceil(shortest + dt)} s"
        )
    rests = home + np.outer(
        _smooth_step(np.minimum(times, times[-1] - times) / lifting), centre - home
    )
    inner = (times >= lifting) & (times <= times[-1] - lifting)
    checked = range(0, len(times), max(round(_CHECKED / dt), 1))
    while True:
        targets = rests.copy()
        targets[inner] += _plan(times[inner] - times[inner][0], amplitudes, bounds)
        poses = (
            (t, pair) for t in checked for pair in sorted(contacts.touching(targets[t]) - allowed)
        )
        if (hit := next(poses, None)) is None:
            slower = _within_torques(model, targets, dt, bounds, names)
            if slower is not None:
                bounds = slower
                continue
            return Excitation(names, times, targets, np.max(np.abs(targets - home), axis=0))
        step, pair = hit
        joint = int(np.argmax(np.abs(targets[step] - rests[step])))
        amplitudes[joint] *= 0.5
        is_at_rest = pair in contacts.touching(rests[step])
        if is_at_rest or amplitudes[joint] < _SMALLEST_AMPLITUDE:
            mover = "the lifted arm" if is_at_rest else names[joint]
            raise UserError(
                f"{mover} cannot move around the start pose without {_contact(contacts, pair)}; "
                "change default_joint_angles or --table-height"
            )


def _within_torques(
    model: mujoco.MjModel,
    targets: np.ndarray,
    dt: float,
    bounds: np.ndarray,
    names: Sequence[str],
) -> np.ndarray | None:
    """Bounds [3, n] of a motion that is slower where one along the targets [T, n] needs more torque
    than the servos have; None if it needs no more.

    Raises:
      UserError: a servo is too weak to hold its joint at rest.
    """
    addresses = find_addresses(model)
    joints = list(addresses.arm_joints)
    most = _BELOW_LIMIT * largest_torques(model, joints, list(addresses.actuators))
    if not np.any(np.isfinite(most)):
        return None
    rates = np.gradient(targets, dt, axis=0)
    accelerations = np.gradient(rates, dt, axis=0)
    data = mujoco.MjData(model)
    dofs = list(addresses.arm_qvel)
    # Without contacts and servos: what a motion needs.
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    fastest = np.max(np.abs(accelerations), axis=0)
    every = range(0, len(targets), max(len(targets) // _POSES, 1))
    slower = bounds.copy()
    for t in every:
        data.qpos[list(addresses.arm_qpos)] = targets[t]
        data.qvel[dofs] = rates[t]
        data.qacc[dofs] = accelerations[t]
        mujoco.mj_inverse(model, data)
        over = np.flatnonzero(np.abs(data.qfrc_inverse[dofs]) > most)
        if not len(over):
            continue
        moving = np.abs(accelerations[t]) > _MOVES * fastest
        if np.max(fastest) < _AT_REST or not np.any(moving):
            joint = int(over[0])
            raise UserError(
                f"{names[joint]} needs {abs(data.qfrc_inverse[dofs[joint]]):.3g} N m at rest, and "
                f"its servo has {most[joint] / _BELOW_LIMIT:.3g} N m; change its force limit or "
                "default_joint_angles"
            )
        slower[1, moving] = 0.5 * fastest[moving]
    return None if np.array_equal(slower, bounds) else np.minimum(slower, bounds)


def _contact(contacts: ContactChecker, pair: tuple[int, int]) -> str:
    return "a contact of " + " and ".join(map(contacts.name, pair))


def _lift_paddle(
    model: mujoco.MjModel, home: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Joint angles [n] within limits [n] at which the paddle is higher, by steps of the
    pseudo-inverse."""
    addresses = find_addresses(model)
    data = mujoco.MjData(model)
    body = model.geom_bodyid[addresses.paddle_geom]
    angles = home.copy()
    jacobian = np.zeros((3, model.nv))
    for _ in range(20):
        data.qpos[list(addresses.arm_qpos)] = angles
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[addresses.paddle_geom], body)
        part = jacobian[:, list(addresses.arm_qvel)]
        damped = part @ part.T + 1e-3 * np.eye(3)
        step = part.T @ np.linalg.solve(damped, [0.0, 0.0, _LIFT / 20])
        angles = np.clip(angles + step, low, high)
    return angles


def _smooth_step(share: np.ndarray) -> np.ndarray:
    """A step from 0 to 1 without a jump of acceleration, clipped outside."""
    share = np.clip(share, 0.0, 1.0)
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


def _time_of_step(distances: np.ndarray, bounds: np.ndarray) -> float:
    """Shortest duration of `_smooth_step` over a distance of each joint [n], within bounds
    [3, n]: its derivatives are at most 1.9, 5.8 and 60."""
    powers = 1.0 / np.arange(1, 4)[:, None]
    return float(np.max((np.outer([1.9, 5.8, 60.0], distances) / bounds) ** powers))


def _plan(times: np.ndarray, amplitudes: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Displacements [T, n]: a slot of each joint alone, slow and then fast; then one of all.

    Args:
      bounds: of each joint's velocity, acceleration and jerk [3, n].
    """
    n = len(amplitudes)
    dt = times[1] - times[0]
    length = times[-1] + dt
    alone = 0.7 * length / n
    moved = np.zeros((len(times), n))
    for j, limits in enumerate(bounds.T):
        t = times - j * alone
        half = 0.5 * alone
        for start, wave in ((0.0, _slow_sine), (half, _sweep)):
            path = wave(t - start, half, amplitudes[j], limits)
            moved[:, j] += _shrink(path * ((t >= start) & (t < start + half)), dt, limits)
        t = times - n * alone
        ramp = (t >= 0.0) * _smooth_step(np.minimum(t, length - n * alone - t) / _RAMP)
        rates = 2.0 * np.pi * np.array(_TOGETHER[j % 4 :: 4])
        size = 0.5 * min(amplitudes[j], 0.6 * float(_largest_sine(limits, np.max(rates))))
        waves = np.mean(np.sin(rates * t[:, None] + j), axis=1)
        moved[:, j] += _shrink(ramp * size * waves, dt, limits)
    return moved


def _largest_sine(limits: np.ndarray, rate: np.ndarray | float) -> np.ndarray:
    """Largest amplitude of a sine with an angular frequency (rad/s) within a joint's limits [3]."""
    return np.min([limit / rate**order for order, limit in enumerate(limits, 1)], axis=0)


def _shrink(path: np.ndarray, dt: float, limits: np.ndarray) -> np.ndarray:
    """A path [T], smaller where its ramps exceed the limits [3]."""
    most = [np.max(np.abs(np.diff(path, order))) / dt**order for order in (1, 2, 3)]
    return path * min(1.0, *(limits / np.maximum(most, 1e-9)))


def _slow_sine(t: np.ndarray, length: float, amplitude: float, limits: np.ndarray) -> np.ndarray:
    """A sine there and back at a quarter of the speed, from rest to rest, which shows dry
    friction."""
    rate = 2.0 * np.pi / length
    size = min(amplitude, _SLOW * float(_largest_sine(limits, rate)))
    return size * np.sin(rate * t) * _smooth_step(np.minimum(t, length - t) / (0.25 * length))


def _sweep(t: np.ndarray, length: float, amplitude: float, limits: np.ndarray) -> np.ndarray:
    """A sine of rising frequency, whose derivatives stay within the limits."""
    low, high = _FAST
    rate = 2.0 * np.pi * (low + (high - low) * np.clip(t / length, 0.0, 1.0))
    phase = 2.0 * np.pi * (low * t + 0.5 * (high - low) * t * t / length)
    window = _smooth_step(np.minimum(t, length - t) / (0.2 * length))
    return np.minimum(amplitude, 0.7 * _largest_sine(limits, rate)) * window * np.sin(phase)


def to_csv(motion: Excitation) -> str:
    """The motion as CSV: a column for the time and one for each joint's target."""
    titles = ["time [s]", *(f"servo_targets.{joint} [rad]" for joint in motion.joint_names)]
    rows = np.column_stack([motion.times, motion.targets])
    lines = [",".join(titles), *(",".join(f"{x:.6f}" for x in row) for row in rows)]
    return "\n".join(lines) + "\n"
