"""Recordings of an evaluation's episodes: their content, and the figures from them."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.statistics import accumulate, empty_statistics, paddle_points
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy, make_networks
from bounce_mjx.learning.statistics import init_normalizer
from bounce_mjx.task import Histogram, Hits, Kinematics, Moment, Recording
from bounce_mjx.task.bounce import Bounce

EPISODES, RECORDED = 6, 4
LAYOUT = EnvConfig().layout


@pytest.fixture(scope="module")
def env() -> BounceBall:
    """Episodes of 1.5 s in which the ball bounces a few times, or falls off a paddle that sinks."""
    return BounceBall(EnvConfig(episode_seconds=1.5))


@pytest.fixture(scope="module")
def networks(env: BounceBall):
    return make_networks(PPOConfig(hidden_layers=(8,)), env.observation_size, env.action_size)


@pytest.fixture(scope="module")
def policy(networks) -> Policy:
    params = networks.policy_network.init(jax.random.PRNGKey(1))
    return Policy(init_normalizer(29), jax.tree.map(lambda x: 3.0 * x, params))


@pytest.fixture(scope="module")
def evaluated(env: BounceBall, networks, policy: Policy):
    evaluate = make_evaluator(env, networks, EPISODES, RECORDED)
    return jax.device_get(evaluate(policy, jax.random.PRNGKey(2)))


@pytest.fixture(scope="module")
def stepped(env: BounceBall, networks, policy: Policy):
    """States [T, ..., K] of the recorded episodes, computed by stepping the environment."""
    keys = jax.random.split(jax.random.PRNGKey(2), EPISODES)[:RECORDED]
    states = jax.jit(jax.vmap(env.reset))(keys)
    step = jax.jit(lambda states: jax.vmap(env.step)(states, networks.act(policy, states.obs)))
    history = []
    for _ in range(env.config.episode_steps):
        states = step(states)
        history.append(jax.device_get(states))
    return jax.tree.map(lambda *x: np.moveaxis(np.stack(x), 1, -1), *history)


@pytest.mark.slow
def test_an_evaluation_counts_the_steps_of_each_episode(
    env: BounceBall, evaluated, stepped
) -> None:
    """Up to its end; `test_evaluation.py` has what is counted in a step."""
    found, _ = evaluated
    add = jax.jit(functools.partial(accumulate, env))
    expected = empty_statistics(env, jax.tree.map(lambda x: x[0], stepped))
    for i in range(env.config.episode_steps):
        now = jax.tree.map(lambda x, i=i: jnp.asarray(x[i]), stepped)
        expected = add(expected, now, jnp.int32(i))
    assert expected.tally.sums["rising_steps"].all() and expected.tally.maxima["n_bounces"].any()
    for ours, theirs in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        # Each contact magnifies the rounding of the differently compiled steps.
        np.testing.assert_allclose(ours[:RECORDED], theirs, rtol=1e-2)


@pytest.mark.slow
def test_a_recording_holds_the_first_episodes(evaluated, stepped) -> None:
    statistics, recording = evaluated
    ended = np.cumsum(stepped.done, axis=0) > 0
    running = np.concatenate([np.ones((1, RECORDED), bool), ~ended[:-1]])
    assert ended.any() and not ended[:50].any()
    # The loop ends when the last episode ends.
    steps = int(statistics.steps.max())
    np.testing.assert_array_equal(recording.running[:steps], running[:steps])
    assert not recording.running[steps:].any()
    np.testing.assert_array_equal(
        recording.terminated[:steps], (running & (stepped.done > 0))[:steps]
    )
    parts = {
        "joint_angles": recording.joint_angles,
        "ball_position": recording.ball,
        "paddle_position": recording.paddle,
        "target_height": recording.goal["target_height"][:, None],
    }
    for name, recorded in parts.items():
        expected = stepped.obs[:, LAYOUT[name]]
        up_to_end = np.broadcast_to(running[:, None], expected.shape)
        np.testing.assert_allclose(
            recorded[up_to_end], expected[up_to_end], rtol=1e-3, atol=1e-3, err_msg=name
        )
    bounces = (stepped.metrics["bounced"] > 0) & running
    assert bounces.sum() >= RECORDED
    np.testing.assert_array_equal((recording.metrics["bounced"] > 0) & recording.running, bounces)
    np.testing.assert_allclose(statistics.steps[:RECORDED], running.sum(axis=0))


def drawn(recording: Recording, **settings) -> tuple[Histogram, Hits]:
    """What the task draws; every bounce has settled but one of the first step."""
    # A copy is not validated: no world has control steps of 1 s.
    config = EnvConfig(episode_seconds=4.0).model_copy(update=settings)
    return Bounce(config).plots(recording)


def made_up(steps: int, episodes: int) -> Recording:
    return Recording(
        joint_angles=np.zeros((steps, 6, episodes), np.float32),
        ball=np.zeros((steps, 3, episodes), np.float32),
        paddle=np.zeros((steps, 3, episodes), np.float32),
        goal={"target_height": np.zeros((steps, episodes), np.float32)},
        running=np.ones((steps, episodes), bool),
        terminated=np.zeros((steps, episodes), bool),
        metrics={
            "bounced": np.zeros((steps, episodes), np.float32),
            "apex_offset": np.zeros((steps, episodes), np.float32),
        },
    )


def test_drawn_bounces_are_settled_and_before_the_end() -> None:
    """Control steps of 1 s, of which the first two end within 2 s."""
    recording = made_up(6, 2)
    recording.metrics["bounced"][[0, 2, 4], :] = 1.0
    recording.running[3:, 1] = False
    _, hits = drawn(recording, control_dt=1.0)
    assert np.argwhere(hits.steps).tolist() == [[2, 0], [2, 1], [4, 0]]
    assert (recording.metrics["bounced"][0] == 1.0).all()


def test_no_bounce_is_drawn_that_the_result_does_not_judge() -> None:
    """Of two episodes whose target changes: drawn are the tally's `settled_bounces`."""
    recording = made_up(8, 2)
    recording.metrics["bounced"][:] = 1.0
    recording.goal["target_height"][:] = 0.5
    # Within the first 2 s, and after them.
    changes = {0: 1, 1: 4}
    for episode, change in changes.items():
        recording.goal["target_height"][change:, episode] = 0.6
    _, hits = drawn(recording, control_dt=1.0)
    task = Bounce(EnvConfig(episode_seconds=8.0).model_copy(update={"control_dt": 1.0}))
    truth = Kinematics(None, jnp.zeros(3), None, None, jnp.zeros(3), None, None)
    metrics = {"bounced": 1.0, "n_bounces": 1.0, "apex_error": 0.0, "apex_offset": 0.0}
    for step, episode in np.ndindex(8, 2):
        seconds = step + 1.0
        since_change = step - changes[episode]
        moment = Moment(
            truth=truth,
            goal={},
            state=None,
            metrics=metrics,
            seconds=seconds,
            goal_seconds=seconds if since_change < 0 else float(since_change),
        )
        assert hits.steps[step, episode] == task.tally(moment).sums["settled_bounces"]


def test_apex_errors_have_a_sign() -> None:
    """In cm, at the bounces."""
    recording = made_up(6, 1)
    recording.metrics["apex_offset"][:, 0] = (0.0, 0.0, 0.3, -0.2, 0.12, 0.45)
    recording.metrics["bounced"][3:5] = 1.0
    errors, _ = drawn(recording, control_dt=1.0)
    np.testing.assert_allclose(errors.values, [-20.0, 12.0], atol=1e-4)
    assert errors.bound == 10.0


def test_hit_points_are_in_the_paddles_frame(env: BounceBall) -> None:
    """A ball placed above a known point of a rotated paddle is found at that point."""
    rng = np.random.default_rng(0)
    recording = made_up(5, 3)
    data = mujoco.MjData(env.mj_model)
    points = rng.uniform(-0.05, 0.05, (5, 3, 2))
    for step, episode in np.ndindex(5, 3):
        data.qpos[:6] = rng.uniform(-1.0, 1.0, 6)
        mujoco.mj_forward(env.mj_model, data)
        paddle = data.geom("blocker")
        local = [*points[step, episode], 0.0225]
        recording.joint_angles[step, :, episode] = data.qpos[:6]
        recording.paddle[step, :, episode] = paddle.xpos
        recording.ball[step, :, episode] = paddle.xpos + paddle.xmat.reshape(3, 3) @ local
    bounces = rng.random((5, 3)) < 0.5
    assert 0 < bounces.sum() < bounces.size
    np.testing.assert_allclose(paddle_points(env, recording, bounces), points[bounces], atol=1e-6)
