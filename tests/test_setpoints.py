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


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("lag", [None, 0.003, 0.05])
def test_late_and_lagged_commands_go_on_without_a_gap(smooth: bool, lag: float | None) -> None:
    """The command at a negative time is that of the step before, and a lag follows both."""
    limits, rng = limits_of(smooth), np.random.default_rng(2)
    steps = [Setpoint(*(np.zeros(2) for _ in range(3)))]
    for target in rng.uniform(-1.0, 1.0, (6, 2)):
        steps.append(next_setpoint(limits, steps[-1], target, T, np))
    before, start, after = steps[-3:]

    def of(piece: Setpoint, acceleration, time, lag=lag):
        earlier = (T, steps[-3 if piece is start else -4].acceleration) if smooth else None
        return command(piece, acceleration, time, np, limits.smoothing, lag, earlier)

    if lag is None:
        for time in np.linspace(0.0, T, 7):
            last = of(before, start.acceleration, time)
            np.testing.assert_allclose(of(start, after.acceleration, time - T), last, atol=1e-12)
        return
    # The lag solves its differential equation: lag * y' = u - y.
    for time in np.linspace(-0.9 * T, 0.9 * T, 13):
        h = 1e-6
        y, ahead, behind = (of(start, after.acceleration, time + d) for d in (0.0, h, -h))
        u = of(start, after.acceleration, time, None)
        np.testing.assert_allclose(lag * (ahead - behind) / (2 * h), u - y, atol=1e-7)
