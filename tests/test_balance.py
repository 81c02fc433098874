"""Balancing: the point's path, the rough paddle, and the results."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx import task
from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.c_episodes import episode_models
from bounce_mjx.physics import PhysicsParameters
from bounce_mjx.task.balance import Balance, Config
from bounce_mjx.world.randomization import RandomizationConfig

REACH, SPEED, FRICTION, HALF_SIZE, RADIUS = 0.03, 0.05, 0.3, 0.0035, 0.019


@pytest.fixture(scope="module")
def env() -> Env:
    return Env(Config())


def paths(start: jax.Array, speed: jax.Array, draws: jax.Array, steps: int) -> np.ndarray:
    """The point after each step [steps, 2, N], from its start [2, N]."""
    balance = Balance(Config())

    def path(start: jax.Array, speed: jax.Array, draws: jax.Array) -> jax.Array:
        centre = balance.reset(task.Start(None, {}, draws))

        def move(goal: dict, _: None) -> tuple[dict, jax.Array]:
            goal = balance.next_goal(centre, goal)
            return goal, jnp.stack([goal["point_x"], goal["point_y"]])

        goal = {"point_x": start[0], "point_y": start[1], "point_speed": speed}
        return jax.lax.scan(move, goal, length=steps)[1]

    batched = jax.vmap(path, in_axes=-1, out_axes=-1)
    return np.asarray(jax.jit(batched)(start, speed, draws))


def test_the_point_moves_within_reach_at_the_commanded_speed() -> None:
    rng = np.random.default_rng(0)
    start = rng.uniform(-REACH, REACH, (2, 256))
    speed = rng.uniform(-SPEED, SPEED, 256)
    point = paths(start, speed, rng.uniform(size=(4, 256)), 2000)
    distance, moved = np.hypot(*np.moveaxis(point, 1, 0)), np.diff(point, axis=0)
    assert np.max(distance) <= REACH + 1e-6
    speeds = np.hypot(*np.moveaxis(moved, 1, 0)) / 0.01
    assert np.all(speeds <= np.abs(speed) + 1e-4)
    # Most points have a circle of at least 1 cm, on which they keep their speed.
    assert np.mean(np.median(speeds, axis=0) > 0.99 * np.abs(speed) - 1e-4) > 0.6
    # A smooth path: no corner after the first steps, in which a point may arrive at the rim.
    turns = np.linalg.norm(np.diff(moved[-500:], axis=0), axis=1) / 0.01
    assert np.max(turns) < 0.01
    visited = np.histogram2d(*np.moveaxis(point, 1, 0).reshape(2, -1), bins=6)[0]
    assert np.mean(visited > 0) > 0.8


def test_the_ball_is_laid_on_the_paddle(env: Env) -> None:
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 256))
    truth = jax.vmap(env.kinematics)(state.pipeline_state)
    offset = np.asarray(truth.ball_position - truth.paddle_position)
    gap = offset[:, 2] - HALF_SIZE - RADIUS
    assert 0.0 < gap.min() and gap.max() < 0.006
    assert 0.014 < np.abs(offset[:, :2]).max() < 0.02
    np.testing.assert_allclose(truth.paddle_position.mean(0), env.task.focus(), atol=5e-4)


def test_the_friction_stays_in_every_world(env: Env) -> None:
    """In that of an episode on C, and without randomisation; so does the hollow ball."""
    pushed = episode_models(env, PhysicsParameters(ball_mass=np.full((1,), 0.003)))[0]
    nominal = Env(Config(randomization=RandomizationConfig()))
    for model in (pushed, nominal.mj_model):
        assert model.pair_dim[0] == 3
        np.testing.assert_allclose(model.pair_friction[0, :2], FRICTION)
        ball = model.body("ball_link")
        np.testing.assert_allclose(ball.inertia, 2.0 / 3.0 * ball.mass[0] * RADIUS**2)
    as_in_file = Env(Config(ball_inertia=None)).mj_model.body("ball_link")
    np.testing.assert_allclose(as_in_file.inertia, 0.4 * as_in_file.mass[0] * RADIUS**2)
    assert Env(Config(friction=None)).mj_model.pair_dim[0] == 1


def episodes(error: np.ndarray, lasted: np.ndarray) -> task.Episodes:
    """Episodes of 20 s with a constant error [E], m, of which 19 s are judged."""
    balance = Balance(Config())
    sums = {"steps": np.zeros(len(error)), "squares": np.zeros(len(error))}
    for seconds in np.arange(1, 2001) / 100:
        moment = task.Moment(None, {}, None, {"error": error}, seconds, seconds)
        for name, value in balance.tally(moment).sums.items():
            sums[name] += value
    return task.Episodes(sums, {}, lasted, {})


def test_the_results_are_judged_with_pushes_and_without() -> None:
    error, lasted = np.array([0.006] * 50 + [0.014] * 50), np.arange(100) > 0
    pushed, alone = Config(), Config(randomization=RandomizationConfig())
    judged = [Balance(config).results(episodes(error, lasted)) for config in (pushed, alone)]
    rms = 100 * np.sqrt((0.006**2 + 0.014**2) / 2)
    for stable, distance in judged:
        assert stable.passed and stable.value == 99.0
        np.testing.assert_allclose(distance.value, rms)
    # 1.08 cm: within 1.5 cm with pushes, beyond 1 cm without.
    assert [distance.passed for _, distance in judged] == [True, False]
    assert episodes(error, lasted).sums["steps"] == pytest.approx(1900)
    worse = Balance(pushed).results(episodes(1.4 * error, np.arange(100) > 1))
    assert [result.passed for result in worse] == [False, False]
