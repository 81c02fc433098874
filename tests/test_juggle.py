"""The task juggle: the start, alternating hits, touching balls, and the next ball."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bounce_mjx import task
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.robot.model import find_addresses, load_model
from bounce_mjx.task.juggle import Config, Juggle, Rewards

JUGGLE = Juggle(Config())
HOME = np.array(JUGGLE.config.home)
REST = 0.0225


def landing_times(z: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """When balls at heights over the paddle (m) with upward speeds (m/s) land, s."""
    return np.array(
        [max(np.roots([-0.5 * 9.81, v, h]).real) for h, v in zip(z, speed, strict=True)]
    )


@pytest.mark.parametrize("count", [2, 3])
def test_the_balls_start_in_columns_and_land_in_turns(count: int) -> None:
    juggle = Juggle(Config(num_balls=count))
    for height in (0.41, 0.58):
        balls, speeds = (
            np.asarray(x, float)
            for x in juggle.throw(jnp.zeros(0), {"target_height": jnp.float32(height)})
        )
        np.testing.assert_allclose(np.diff(balls[:, 1]), juggle.config.spacing, atol=1e-6)
        np.testing.assert_allclose(balls[:, :2].mean(axis=0), HOME[:2], atol=1e-6)
        period = 2.0 * np.sqrt(2.0 * (height - HOME[2] - REST) / 9.81)
        times = landing_times(balls[:, 2] - HOME[2] - REST, speeds[:, 2])
        np.testing.assert_allclose(np.diff(times), period / count, atol=1e-5)
        assert 0.1 < times[0] < period / count
        # The energy is that of an apex at the height.
        np.testing.assert_allclose(balls[:, 2] + speeds[:, 2] ** 2 / 19.62, height, atol=1e-5)


def truth(balls: np.ndarray, velocities: np.ndarray) -> task.Kinematics:
    zero = jnp.zeros(6)
    still = jnp.zeros_like(jnp.asarray(balls))
    return task.Kinematics(
        zero, jnp.array(balls), None, zero, jnp.array(velocities), still, jnp.array(HOME)
    )


@jax.jit
def stepped(
    state: tuple, balls: jax.Array, velocities: jax.Array, height: float = 0.5
) -> task.TaskStep:
    goal, action = {"target_height": jnp.float32(height)}, jnp.zeros(6)
    return JUGGLE.step(state, task.Step(truth(balls, velocities), goal, action, action))


def test_hits_count_in_turns() -> None:
    """A ball that is hit twice, and two balls that are hit at once, are out of turn."""
    columns = np.array(JUGGLE.config.columns(0.0)) + [0.0, 0.0, 0.2]
    state, counted = (jnp.array([False, True]), jnp.float32(1.0)), []
    # Which balls rise after each step: 1 is hit, 2, 1, 1 again, and both.
    for rising in [(1, 1), (1, 0), (1, 1), (0, 1), (1, 1), (0, 1), (1, 1), (0, 0), (1, 1)]:
        done = stepped(state, columns, np.outer(2.0 * np.array(rising) - 1.0, [0.0, 0.0, 1.0]))
        state = done.state
        counted.append((int(done.metrics["hits"]), int(done.metrics["in_turn"])))
    assert counted[::2] == [(1, 1), (1, 1), (1, 1), (1, 0), (2, 1)]
    assert counted[1::2] == [(0, 0)] * 4


@pytest.mark.parametrize("height", [0.4, 0.6])
def test_an_episode_ends_with_a_lost_ball_or_a_touch(height: float) -> None:
    """And not while one ball is hit and the other one is at its apex."""
    columns = np.array(JUGGLE.config.columns(height))
    up, state = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 0.0]]), (jnp.array([False, True]), 1.0)

    def ends(first: list[float]) -> bool:
        return bool(stepped(state, np.array([first, columns[1]]), up, height).ended)

    x, y, _ = columns[0]
    assert not ends([x, y, HOME[2] + REST])
    assert not ends([x, y, height])
    assert ends([x, y, HOME[2] - 0.01])
    assert ends([x + 0.8, y, height])
    assert ends([x, columns[1, 1] - 0.03, height])


def unlike(second: float) -> Juggle:
    """The task with two balls of which the second has another radius, m."""
    juggle = Juggle(Config())
    first = juggle.geometry.ball_radius
    juggle.geometry = juggle.geometry._replace(ball_radii=(first, second))
    return juggle


@pytest.mark.parametrize("factor", [None, 0.5])
def test_balls_of_unlike_radii_touch_where_their_surfaces_do(factor: float | None) -> None:
    """In an episode with other radii, both in proportion."""
    juggle = unlike(0.04)
    radius = None if factor is None else factor * 0.019
    touch = (0.019 + 0.04) * (factor or 1.0)
    for distance, touches in ((touch - 1e-3, True), (touch + 1e-3, False)):
        balls = jnp.array([[0.6, 0.0, 0.5], [0.6, distance, 0.5]])
        truth = task.Kinematics(None, balls, None, None, jnp.zeros((2, 3)), None, None)
        step = task.Step(truth, {}, None, None, radius)
        assert bool(juggle._touched(step)) == touches


def test_columns_in_which_the_balls_touch_are_refused() -> None:
    with pytest.raises(
        UserError, match="spacing is 0.01 m, but balls of the radii 0.019 and 0.019"
    ):
        Env(Config(spacing=0.01))
    with pytest.raises(
        UserError, match="radii 0.038 and 0.038 m touch in columns that are 0.065 m"
    ):
        Env(Config(randomization={"ball_radius": (1.0, 2.0)}))
    with pytest.raises(UserError, match="balls of the radii 0.019 and 0.05 m touch in columns"):
        unlike(0.05).check()
    unlike(0.04).check()


def test_balls_touch_as_in_mujoco() -> None:
    """Pairs of balls that pass each other fast, some of which touch, mostly between two control
    steps."""
    model = load_model(None, 0.001, num_balls=2)
    data, addresses = mujoco.MjData(model), find_addresses(model)
    rng, found, closest = np.random.default_rng(0), [], jax.jit(task.closest)
    for _ in range(200):
        mujoco.mj_resetData(model, data)
        aside = rng.uniform(0.0, 0.08)
        for ball, (y, z, speed) in zip(
            addresses.balls, [(0.0, 0.5, rng.uniform(1, 3)), (aside, 1.0, -3.0)], strict=True
        ):
            data.qpos[list(ball.qpos[:3])] = [1.0, y, z]
            data.qvel[list(ball.qvel[:3])] = [0.0, rng.uniform(-0.1, 0.1), speed]
        touched = seen = False
        for _ in range(15):
            for _ in range(10):
                mujoco.mj_step(model, data)
                touched |= data.ncon > 0
            position, velocity = (
                np.array([x[list(getattr(b, n)[:3])] for b in addresses.balls])
                for x, n in ((data.qpos, "qpos"), (data.qvel, "qvel"))
            )
            seen |= bool(closest(position, velocity, 0.01) < 2.0 * 0.019)
        found.append((touched, seen))
    touched, seen = np.array(found).T
    assert 50 < touched.sum() < 150
    # Some graze each other by less than the 1 ms between MuJoCo's steps.
    assert np.sum(touched != seen) <= 2 and np.all(seen[touched])


def test_the_reward_of_turns_is_greatest_half_a_period_apart() -> None:
    """At each instant of the flights."""
    columns, period = (
        np.array(JUGGLE.config.columns(0.5)),
        2 * np.sqrt(2 * (0.5 - HOME[2] - REST) / 9.81),
    )

    def turn(delay: float, flown: float) -> float:
        """Of two flights, of which the second starts `delay` periods later."""
        rise = (0.5 - np.array([flown, (flown - delay) % 1.0])) * period
        balls = columns - np.outer(0.5 * 9.81 * rise**2, [0.0, 0.0, 1.0])
        done = stepped((rise > 0, 0.0), balls, np.outer(9.81 * rise, [0.0, 0.0, 1.0]))
        return float(done.reward["turn"])

    for flown in (0.1, 0.3, 0.6, 0.9):
        rewards = [turn(delay, flown) for delay in (0.2, 0.4, 0.5, 0.6, 0.8)]
        assert rewards[0] < rewards[1] < rewards[2] > rewards[3] > rewards[4]
        assert rewards[2] == pytest.approx(JUGGLE.config.reward.turn.weight, rel=1e-3)


def test_a_term_without_a_formula_is_refused() -> None:
    """A subclass that adds a term to the reward has to compute it."""

    class MoreRewards(Rewards):
        far: task.Near = task.Near()

    class MoreConfig(Config):
        reward: MoreRewards = MoreRewards()

    class JuggleMore(Juggle):
        Config = MoreConfig

    still = jnp.zeros((2, 3))
    step = task.Step(
        truth(still, still), {"target_height": jnp.float32(0.5)}, jnp.zeros(6), jnp.zeros(6)
    )
    juggle = JuggleMore(MoreConfig())
    with pytest.raises(UserError, match="lacks the term of the reward far"):
        jax.eval_shape(lambda: juggle.step((jnp.zeros(2, bool), 1.0), step))


def test_the_policy_sees_the_ball_that_lands_next() -> None:
    rng = np.random.default_rng(1)
    observe = jax.jit(lambda measured: JUGGLE.first_quantities(measured)[1]["next_ball"])
    columns = np.array(JUGGLE.config.columns(0.5))
    for _ in range(20):
        balls = columns + rng.uniform(-0.1, 0.0, (2, 3))
        velocities, paddle = rng.uniform(-0.5, 0.5, (2, 3)), HOME + rng.uniform(-0.02, 0.02, 3)
        seen = observe(
            {
                "ball_position": balls,
                "ball_velocity": velocities,
                "paddle_position": paddle,
                "target_height": np.array([0.5]),
            }
        )
        times = landing_times(balls[:, 2] - HOME[2] - REST, velocities[:, 2])
        ball = np.argmin(times)
        there = balls[ball, :2] + times[ball] * velocities[ball, :2]
        top = balls[ball, 2] + velocities[ball, 2] ** 2 / 19.62 - 0.5
        expected = [there - paddle[:2], there - columns[ball, :2], velocities[ball, :2]]
        expected += [[top, times[ball], times.mean() - times[ball]]]
        np.testing.assert_allclose(seen, np.concatenate(expected), atol=2e-6)


def test_each_result_is_judged_by_its_own_figure() -> None:
    """Each result turns with its own figure alone."""
    count = 200
    good = task.Episodes(
        sums={
            "hits": np.full(count, 70.0),
            "in_turn": np.full(count, 70.0),
            "apexes": np.full(count, 60.0),
            "accurate": np.full(count, 58.0),
        },
        maxima={"touched": np.zeros(count)},
        lasted=np.ones(count, bool),
        goals={},
    )
    assert all(result.passed for result in JUGGLE.results(good))
    few = np.arange(count) < 3
    cases = {
        "kept": good._replace(lasted=~few),
        "turns": good._replace(sums=good.sums | {"in_turn": np.full(count, 69.0)}),
        "apart": good._replace(maxima={"touched": few.astype(float)}),
        "height": good._replace(sums=good.sums | {"accurate": np.full(count, 56.0)}),
    }
    for name, episodes in cases.items():
        assert [r.name for r in JUGGLE.results(episodes) if not r.passed] == [name]
