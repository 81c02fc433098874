"""Motions of the arm without a ball that show its servos: each joint alone, slow and fast, then all
together, without contacts."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.deploy.recorder import Recorder
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.contacts import ContactChecker
from bounce_mjx.robot.model import find_addresses, joint_names, load_model
from bounce_mjx.world.config import WorldConfig

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
# Share of a limit that targets use.
_BELOW_LIMIT = 0.9
_TOGETHER = (0.53, 0.71, 0.89, 1.13, 1.37, 1.61, 1.83, 2.11)
# Time between two poses that are checked for contacts, s.
_CHECKED = 0.02


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
) -> Excitation:
    """Plans an excitation that starts and ends at `config.default_joint_angles`.

    The arm first lifts the paddle, for room above the floor. The joints' amplitudes are halved
    until no pose has a contact. Of a robot with `robot.limits`, all targets keep to them.

    Args:
      max_velocity: largest speed of a target, of each joint or of all, rad/s.
      table_height: height of a table under the arm, m; None for the floor alone.

    Raises:
      UserError: the start pose has a contact with the floor or the table, or a joint cannot move.
    """
    model = load_model(config.mjcf, config.physics_dt, visual=False, robot=config.robot)
    addresses, n = find_addresses(model), config.num_joints
    home = np.array(config.default_joint_angles)
    bounds = _read_bounds(config, max_velocity)
    ranges = model.jnt_range[list(addresses.arm_joints)]
    limited = ranges[:, 0] < ranges[:, 1]
    centre = _lift_paddle(model, home)
    room = np.where(limited, np.min(np.abs(ranges - centre[:, None]), axis=1) - 0.02, np.inf)
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
    times = np.arange(round(seconds / config.control_dt)) * config.control_dt
    every = max(round(_CHECKED / config.control_dt), 1)
    names = joint_names(model)
    lifting = np.maximum(_LIFTING, np.max(bounds.time_of_step(np.abs(centre - home))))
    if times[-1] < 2.0 * lifting + 1.0 * n:
        raise UserError(
            f"{seconds:g} s are too short to move {n} joints; give at least "
            f"{2.0 * lifting + 1.0 * n:.0f} s"
        )
    lift = _smooth_step(np.minimum(times, times[-1] - times) / lifting)[:, None] * (centre - home)
    inner = times[(times >= lifting) & (times <= times[-1] - lifting)]
    while True:
        targets = home + lift
        moving = np.isin(times, inner)
        targets[moving] += _plan(inner - inner[0], amplitudes, bounds)
        poses = (
            (t, pair)
            for t in range(0, len(times), every)
            for pair in sorted(contacts.touching(targets[t]) - allowed)
        )
        hit = next(poses, None)
        if hit is None:
            return Excitation(names, times, targets, np.max(np.abs(targets - home), axis=0))
        step, pair = hit
        moving = _find_movers(contacts, pair, targets[step], home + lift[step])
        amplitudes = np.where(moving, 0.5 * amplitudes, amplitudes)
        if not np.any(moving) or np.min(amplitudes) < _SMALLEST_AMPLITUDE:
            mover = names[int(np.argmax(moving))] if np.any(moving) else "the lifted arm"
            raise UserError(
                f"{mover} cannot move around the start pose without {_contact(contacts, pair)}; "
                "change default_joint_angles or --table-height"
            )


def _find_movers(
    contacts: ContactChecker, pair: tuple[int, int], pose: np.ndarray, rest: np.ndarray
) -> np.ndarray:
    """Which joints [n] bring a pair of parts together in a pose [n]: those without whose motion
    from the rest [n] it is apart, or all if none is alone."""
    moved = np.abs(pose - rest) > 1e-3
    if pair in contacts.touching(rest):
        return np.zeros_like(moved)
    trials = np.where(np.eye(len(pose), dtype=bool), rest, pose)
    alone = moved & [pair not in contacts.touching(trial) for trial in trials]
    return alone if np.any(alone) else moved


def _contact(contacts: ContactChecker, pair: tuple[int, int]) -> str:
    return "a contact of " + " and ".join(map(contacts.name, pair))


def _lift_paddle(model: mujoco.MjModel, home: np.ndarray) -> np.ndarray:
    """Joint angles [n] at which the paddle is higher, by steps of the pseudo-inverse."""
    addresses, data = find_addresses(model), mujoco.MjData(model)
    body = model.geom_bodyid[addresses.paddle_geom]
    limits = model.jnt_range[list(addresses.arm_joints)]
    limited = limits[:, 0] < limits[:, 1]
    low, high = (np.where(limited, limits[:, i], side) for i, side in ((0, -np.inf), (1, np.inf)))
    dofs, angles, jacobian = list(addresses.arm_qvel), home.copy(), np.zeros((3, model.nv))
    for _ in range(20):
        data.qpos[list(addresses.arm_qpos)] = angles
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[addresses.paddle_geom], body)
        part = jacobian[:, dofs]
        damped = part @ part.T + 1e-3 * np.eye(3)
        step = part.T @ np.linalg.solve(damped, [0.0, 0.0, _LIFT / 20])
        angles = np.clip(angles + step, low + 0.02, high - 0.02)
    return angles


class _Bounds(NamedTuple):
    """Largest derivatives of each joint's target [n]."""

    velocity: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray

    def amplitude(self, joint: int, rate: np.ndarray | float) -> np.ndarray:
        """Largest amplitude of a sine with an angular frequency, rad/s."""
        return np.minimum(
            np.minimum(self.velocity[joint] / rate, self.acceleration[joint] / rate**2),
            self.jerk[joint] / rate**3,
        )

    def shrink(self, joint: int, path: np.ndarray, times: np.ndarray) -> np.ndarray:
        """A path [T], smaller where its ramps exceed the limits of acceleration and jerk."""
        share, dt = 1.0, times[1] - times[0]
        for order, limit in ((2, self.acceleration[joint]), (3, self.jerk[joint])):
            largest = np.max(np.abs(np.diff(path, order))) / dt**order
            share = min(share, limit / max(largest, 1e-9))
        return share * path

    def time_of_step(self, distance: np.ndarray) -> np.ndarray:
        """Shortest duration [n] of `_smooth_step` over a distance [n]."""
        by_jerk = np.cbrt(60.0 * distance / self.jerk)
        by_acceleration = np.sqrt(5.8 * distance / self.acceleration)
        return np.maximum(np.maximum(1.9 * distance / self.velocity, by_acceleration), by_jerk)


def _read_bounds(config: WorldConfig, max_velocity: float | Sequence[float]) -> _Bounds:
    limits, n = config.robot.limits, config.num_joints
    velocity, acceleration, jerk = (
        np.full(n, np.inf) if given is None else _BELOW_LIMIT * np.array(given)
        for given in (limits.velocity, limits.acceleration, limits.jerk)
    )
    return _Bounds(np.minimum(velocity, max_velocity), acceleration, jerk)


def _smooth_step(share: np.ndarray) -> np.ndarray:
    """A step from 0 to 1 without a jump of acceleration, clipped outside."""
    share = np.clip(share, 0.0, 1.0)
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


def _plan(times: np.ndarray, amplitudes: np.ndarray, bounds: _Bounds) -> np.ndarray:
    """Displacements [T, n]: a slot of each joint alone, slow and then fast; then one of all."""
    n, length = len(amplitudes), times[-1] + times[1] - times[0]
    alone = 0.7 * length / n
    moved = np.zeros((len(times), n))
    for j in range(n):
        t = times - j * alone
        slow = (t >= 0.0) & (t < 0.5 * alone)
        fast = (t >= 0.5 * alone) & (t < alone)
        by_slow = slow * _slow_sine(t, 0.5 * alone, amplitudes[j], bounds, j)
        by_fast = fast * _sweep(t - 0.5 * alone, 0.5 * alone, amplitudes[j], bounds, j)
        moved[:, j] += sum(bounds.shrink(j, part, times) for part in (by_slow, by_fast))
    t = times - n * alone
    ramp = _smooth_step(np.minimum(t, length - n * alone - t) / _RAMP)
    for j in range(n):
        rates = 2.0 * np.pi * np.array(_TOGETHER[j % 4 :: 4])
        wave = np.sum(np.sin(rates * t[:, None] + j), axis=1) / len(rates)
        size = 0.5 * min(amplitudes[j], 0.6 * float(bounds.amplitude(j, np.max(rates))))
        moved[:, j] += bounds.shrink(j, (t >= 0.0) * ramp * size * wave, times)
    return moved


def _slow_sine(
    t: np.ndarray, length: float, amplitude: float, bounds: _Bounds, joint: int
) -> np.ndarray:
    """A sine there and back at a quarter of the speed, which shows dry friction."""
    rate = 2.0 * np.pi / length
    size = min(amplitude, _SLOW * float(bounds.amplitude(joint, rate)))
    # From rest to rest.
    return size * np.sin(rate * t) * _smooth_step(np.minimum(t, length - t) / (0.25 * length))


def _sweep(
    t: np.ndarray, length: float, amplitude: float, bounds: _Bounds, joint: int
) -> np.ndarray:
    """A sine of rising frequency, whose derivatives stay within the limits."""
    low, high = _FAST
    rate = 2.0 * np.pi * (low + (high - low) * np.clip(t / length, 0.0, 1.0))
    phase = 2.0 * np.pi * (low * t + 0.5 * (high - low) * t * t / length)
    window = _smooth_step(np.minimum(t, length - t) / (0.2 * length))
    size = np.minimum(amplitude, 0.7 * bounds.amplitude(joint, rate))
    return size * window * np.sin(phase)


def to_csv(motion: Excitation) -> str:
    """The motion as CSV: a column for the time and one for each joint's target."""
    titles = ["time [s]", *(f"servo_targets.{joint} [rad]" for joint in motion.joint_names)]
    rows = np.column_stack([motion.times, motion.targets])
    lines = [",".join(titles), *(",".join(f"{x:.6f}" for x in row) for row in rows)]
    return "\n".join(lines) + "\n"


def simulate_arm(config: WorldConfig, motion: Excitation, path: Path) -> None:
    """Writes the log of a motion on the model's own arm, on MuJoCo's C engine.

    Raises:
      UserError: the log exists or cannot be made.
    """
    model = load_model(config.mjcf, config.physics_dt, visual=False, robot=config.robot)
    addresses, data = find_addresses(model), mujoco.MjData(model)
    qpos, qvel = list(addresses.arm_qpos), list(addresses.arm_qvel)
    servos = list(addresses.actuators)
    data.qpos[qpos] = config.default_joint_angles
    with Recorder(path, motion.joint_names) as recorder:
        for time, target in zip(motion.times, motion.targets, strict=True):
            measured = {"time": time, "joint_angles": data.qpos[qpos]}
            recorder.step(measured | {"joint_velocities": data.qvel[qvel]}, target)
            data.ctrl[servos] = target * model.actuator_gear[servos, 0]
            for _ in range(config.num_substeps):
                mujoco.mj_step(model, data)
