"""Setpoints within an arm's limits: formulas against brute force, and the engines that use them."""

import numpy as np
import pytest

from bounce_mjx.robot.setpoints import JointLimits, Setpoint, command, next_setpoint

T, RATE = 0.01, 1000
# A Panda's: velocity, acceleration and jerk.
V, A, J = np.array([2.175, 2.61]), np.array([7.5, 20.0]), np.array([3750.0, 10000.0])


def trajectory(targets: np.ndarray, limits: JointLimits, rate: int = RATE) -> np.ndarray:
    """Commands [N] of a list of targets at a rate, from rest at 0."""
    start = Setpoint(*(np.zeros(2) for _ in range(3)))
    times = np.arange(1, round(T * rate) + 1)[:, None] / rate
    rows = []
    for target in targets:
        after = next_setpoint(limits, start, target, T, np)
        rows.append(command(start, after.acceleration, times, np, limits.smoothing))
        start = after
    return np.concatenate(rows)


def limits_of(smooth: bool, span: float = 0.6) -> JointLimits:
    return JointLimits(V, A, 2.0 * A / J if smooth else None, (np.full(2, -span), np.full(2, span)))


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("rate", [500, 1000, 4000])
def test_no_command_is_beyond_a_limit(smooth: bool, rate: int) -> None:
    """Differences of the commands at the controller's rate, for targets that jump anywhere."""
    rng = np.random.default_rng(0)
    # Jumps far and near, for some steps each, and many beyond the range.
    sizes, steps = rng.choice([0.02, 1.0], (500, 1)), rng.integers(1, 40, 500)
    targets = np.repeat(rng.uniform(-2.0, 2.0, (500, 2)) * sizes, steps, axis=0)
    limits = limits_of(smooth)
    rows = trajectory(targets, limits, rate)
    assert np.abs(rows).max() <= 0.6 + 1e-12
    assert np.abs(rows).max() > 0.59
    velocity = np.diff(rows, axis=0, prepend=[[0.0, 0.0]]) * rate
    acceleration = np.diff(velocity, axis=0, prepend=[[0.0, 0.0]]) * rate
    jerk = np.diff(acceleration, axis=0, prepend=[[0.0, 0.0]]) * rate
    for values, limit in [(velocity, V), (acceleration, A), *([(jerk, J)] if smooth else [])]:
        most = np.abs(values).max(axis=0)
        assert np.all(most <= limit * (1 + 1e-6))
        # They are used, too.
        assert np.all(most > 0.8 * limit)


@pytest.mark.parametrize("smooth", [False, True])
def test_the_commands_are_the_motion_of_their_acceleration(smooth: bool) -> None:
    """Against small steps of semi-implicit Euler and their running mean."""
    rng = np.random.default_rng(1)
    targets = np.repeat(rng.uniform(-1.5, 1.5, (20, 2)), 5, 0)
    limits = limits_of(smooth)
    small, start = 100_000, Setpoint(*(np.zeros(2) for _ in range(3)))
    position, velocity, rows = np.zeros(2), np.zeros(2), [np.zeros((1000, 2))]
    for target in targets:
        after = next_setpoint(limits, start, target, T, np)
        pieces = velocity + np.arange(0.5, T * small)[:, None] / small * after.acceleration
        rows.append(position + np.cumsum(pieces, axis=0) / small)
        position, velocity = rows[-1][-1], velocity + T * after.acceleration
        np.testing.assert_allclose([position, velocity], after[:2], atol=1e-9)
        start = after
    fine = np.concatenate(rows)
    if smooth:
        widths = np.rint(2.0 * A / J * small).astype(int)
        total = np.concatenate([np.zeros((1, 2)), np.cumsum(fine, axis=0)])
        fine = np.stack(
            [(total[w:] - total[:-w])[-len(fine) + 1000 :, i] / w for i, w in enumerate(widths)], 1
        )
    else:
        fine = fine[1000:]
    np.testing.assert_allclose(trajectory(targets, limits), fine[99::100], atol=2e-5)
