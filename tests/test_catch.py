"""Catching: the throws, and what counts as caught."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bounce_mjx import task
from bounce_mjx.env.env import Env
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.task.catch import MAX_DISTANCE, Catch, Config

DT, REST_HEIGHT = 0.01, 0.0225


@pytest.mark.slow
def test_throws_have_their_distribution() -> None:
    env = Env(Config(reset={"joint_angles": 0.0}))
    reset = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 4096))
    state = reset.pipeline_state
    truth = jax.vmap(env.kinematics)(state)
    start, velocity = np.asarray(truth.ball_position), np.asarray(truth.ball_velocity)
    data, model = mujoco.MjData(env.mj_model), env.mj_model
    at = find_addresses(model)
    data.qpos[list(at.arm_qpos)] = Config().default_joint_angles
    mujoco.mj_kinematics(model, data)
    paddle = data.geom_xpos[at.paddle_geom]
    # The time at which a free ball falls through the height of its rest on the paddle.
    gravity, rest = -model.opt.gravity[2], paddle[2] + REST_HEIGHT
    rising = velocity[:, 2]
    flight = (rising + np.sqrt(rising**2 + 2 * gravity * (start[:, 2] - rest))) / gravity
    aim = start[:, :2] + velocity[:, :2] * flight[:, None]
    speed, away = (np.hypot(*x[:, :2].T) for x in (velocity, start))
    for values, low, high in (
        (flight, 0.6, 0.7),
        (speed, 1.0, 2.0),
        (np.hypot(*(aim - paddle[:2]).T), 0.0, 0.05),
        (away, 1.0, 2.0),
    ):
        assert low - 1e-3 < values.min() and values.max() < high + 1e-3
    for values, low, high in ((flight, 0.605, 0.695), (speed, 1.05, 1.95), (away, 1.2, 1.9)):
        assert values.min() < low and high < values.max()
    np.testing.assert_allclose(aim.mean(0), paddle[:2], atol=2e-3)
    # The slowest ball falls at 2.9 m/s and the fastest at 3.4 m/s.
    assert np.all((2.9 < gravity * flight - rising) & (gravity * flight - rising < 3.5))


def test_no_throw_starts_beyond_the_greatest_distance() -> None:
    """Also at a paddle so far out that the slowest throw would start beyond it."""
    catch = Catch(Config(ball_init_pos=(1.2, 1.5, 0.1)))
    draws = jax.random.uniform(jax.random.PRNGKey(0), (1000, catch.num_draws))
    start, velocity = jax.vmap(lambda numbers: catch.throw(numbers, {}))(draws)
    away = np.hypot(start[:, 0], start[:, 1])
    assert 1.95 < away.max() < MAX_DISTANCE + 1e-3
    assert np.hypot(velocity[:, 0], velocity[:, 1]).max() < 0.3


def steps(ball: np.ndarray, velocity: np.ndarray, paddle: np.ndarray) -> task.TaskStep:
    """The steps of an episode from its kinematics [T, 3]; the first is the reset."""
    catch = Catch(Config())

    def truth(ball: jax.Array, velocity: jax.Array, paddle: jax.Array) -> task.Kinematics:
        zeros = jnp.zeros(6)
        still = jnp.zeros(3)
        return task.Kinematics(zeros, ball, jnp.zeros(4), zeros, velocity, still, paddle)

    def step(state: tuple, now: tuple) -> tuple[tuple, task.TaskStep]:
        zeros = jnp.zeros(6)
        done = catch.step(state, task.Step(truth(*now), {}, zeros, zeros))
        return done.state, done

    states = jax.tree.map(jnp.asarray, (ball, velocity, paddle))
    first = catch.reset(task.Start(truth(*(x[0] for x in states)), {}, jnp.zeros(5)))
    return jax.lax.scan(step, first, jax.tree.map(lambda x: x[1:], states))[1]


def landing(contact: float, seconds: float = 3.0, height: float = 0.05) -> tuple[np.ndarray, ...]:
    """A ball that falls freely until a time, and then rests on a still paddle."""
    time = np.arange(round(seconds / DT) + 1) * DT
    fall = np.minimum(time, contact) - contact
    ball, velocity, paddle = np.zeros((3, len(time), 3))
    paddle[:, 2] = height
    ball[:, 2] = height + REST_HEIGHT + 0.5 * 9.81 * (contact**2 - (fall + contact) ** 2)
    velocity[:, 2] = np.where(time < contact, -9.81 * time, 0.0)
    return ball, velocity, paddle


def test_a_ball_is_caught_after_half_a_second_at_rest() -> None:
    caught = np.asarray(steps(*landing(0.3)).metrics["caught"])
    # The step of the first contact is the 30th; it is at rest from the next one on.
    assert not caught[: 30 + 49].any() and caught[30 + 51 :].all()
    # A hop starts the rest anew.
    ball, velocity, paddle = landing(0.3)
    hop = round(0.7 / DT)
    velocity[hop:, 2] -= 9.81 * DT
    caught = np.asarray(steps(ball, velocity, paddle).metrics["caught"])
    assert not caught[: hop + 48].any() and caught[hop + 52 :].all()


def test_a_resting_ball_moves_with_the_paddle() -> None:
    ball, velocity, paddle = landing(0.3)
    carried = np.linspace(0.0, 0.3, len(ball))
    for x in (ball, paddle):
        x[:, 0] += carried
    velocity[:, 0] += 0.1
    assert steps(ball, velocity, paddle).metrics["caught"][-1]
    # Relative to the paddle, this one slides at 6 cm/s, the next one at 4 cm/s.
    for speed, is_caught in ((0.06, False), (0.04, True)):
        ball, velocity, paddle = landing(0.3)
        ball[:, 0] = speed * DT * np.arange(len(ball))
        velocity[:, 0] = speed
        assert steps(ball, velocity, paddle).metrics["caught"][-1] == is_caught


def test_a_resting_ball_pays_more_the_less_it_moves_against_the_paddle() -> None:
    """Not just below the limit: there the noise of a training hides for how long a ball rests."""
    paid = {}
    for speed in (0.0, 0.03, 0.048, 0.052):
        ball, velocity, paddle = landing(0.3)
        ball[:, 0] = speed * DT * np.arange(len(ball))
        velocity[:, 0] = speed
        paid[speed] = float(steps(ball, velocity, paddle).reward["rest"][-1])
    weight = Config().reward.rest.weight
    assert paid[0.0] == pytest.approx(2.0 * weight, rel=1e-3) and paid[0.052] == 0.0
    assert paid[0.0] > paid[0.03] + 0.3 * weight > paid[0.048] + 0.6 * weight
    # A ball that flies over the paddle at its speed does not rest.
    ball, velocity, paddle = landing(2.9)
    ball[:, 0] = paddle[:, 0]
    assert not steps(ball, velocity, paddle).reward["rest"][:100].any()


@pytest.mark.parametrize(("until", "is_caught"), [(1.4, True), (1.6, False)])
def test_the_rest_must_come_within_two_seconds_of_the_first_contact(
    until: float, is_caught: bool
) -> None:
    """The ball slides until a time after the first contact."""
    ball, velocity, paddle = landing(0.3)
    time = np.clip(np.arange(len(ball)) * DT - 0.3, 0.0, until)
    ball[:, 0] = 0.1 * time
    velocity[:, 0] = np.where((0.0 < time) & (time < until), 0.1, 0.0)
    assert steps(ball, velocity, paddle).metrics["caught"][-1] == is_caught


def test_the_episode_ends_when_the_ball_is_lost_or_the_paddle_at_the_floor() -> None:
    ball, velocity, paddle = landing(0.3)
    assert not steps(ball, velocity, paddle).ended.any()
    ball[100:, 2] = paddle[100:, 2] - 0.06
    ended = np.asarray(steps(ball, velocity, paddle).ended)
    assert not ended[:99].any() and ended[99:].all()
    # The floor is nothing in the physics, but in the room of the robot.
    assert steps(*landing(0.3, height=0.01)).ended.all()


def test_a_ball_that_is_lost_later_is_not_caught() -> None:
    caught = {"caught": np.array([1.0] * 96 + [0.0] * 4)}
    for lost, share, passed in ((0, 96.0, True), (2, 94.0, False)):
        lasted = np.arange(100) >= lost
        (result,) = Catch(Config()).results(task.Episodes({}, caught, lasted, {}))
        assert result.value == share and result.passed == passed
