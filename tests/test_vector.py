"""A batch steps as single environments do, and reports and resets what has ended."""

import jax
import numpy as np
import pytest

from bounce_mjx.env import vector

NUM_ENVS = 4
STEPS = 70
NO_LIMIT = 10**6
RESET_KEY = jax.random.key(11)
STEP_KEYS = jax.random.split(jax.random.key(12), STEPS)


@pytest.fixture(scope="module")
def single(env):
    return jax.jit(env.reset), jax.jit(env.step)


@pytest.fixture(scope="module")
def reset(env):
    return jax.jit(lambda key: vector.reset(env, key, NUM_ENVS))


@pytest.fixture(scope="module")
def step(env):
    """(state, action, key, episode_steps) -> (state, result), compiled once for every limit."""
    return jax.jit(lambda *args: vector.step(env, *args))


@pytest.fixture(scope="module")
def actions():
    """Random actions [STEPS, NUM_ENVS, 6]; in the last environment they are so small that the ball
    bounces."""
    drawn = np.random.default_rng(2).uniform(-1, 1, (STEPS, NUM_ENVS, 6)).astype(np.float32)
    drawn[:, -1] = 0
    return drawn


def run(reset, step, actions, episode_steps):
    """The results of each step, stacked [STEPS, NUM_ENVS, ...], and the states before each."""
    state, states, results = reset(RESET_KEY), [], []
    for action, key in zip(actions, STEP_KEYS, strict=False):
        states.append(state)
        state, result = step(state, action, key, episode_steps)
        results.append(result)
    return jax.tree.map(lambda *x: np.stack(x), *results), [*states, state]


@pytest.fixture(scope="module")
def unlimited(reset, step, actions):
    """A run in which episodes end only by termination."""
    results, states = run(reset, step, actions, NO_LIMIT)
    assert results.terminated.any() and results.metrics["bounced"].any()
    return results, states


@pytest.fixture(scope="module")
def limited(reset, step, actions):
    """A run with a time-out after 25 steps, before any ball has come down to the paddle."""
    results, states = run(reset, step, actions, 25)
    assert results.truncated.sum() == 2 * NUM_ENVS and not results.terminated.any()
    return results, states


def python_loop(single, actions, episode_steps, i):
    """Environment i alone, in plain Python, with the results that `VectorStep` describes."""
    reset_one, step_one = single
    state = reset_one(jax.random.split(RESET_KEY, NUM_ENVS)[i])
    episode_return, length, rows = 0.0, 0, []
    for action, key in zip(actions[:, i], STEP_KEYS, strict=True):
        state = step_one(state, action)
        length += 1
        episode_return += float(state.reward)
        terminated = bool(state.done)
        truncated = length == episode_steps and not terminated
        row = {
            "final_observation": state.obs,
            "reward": state.reward,
            "terminated": terminated,
            "truncated": truncated,
            "episode_return": episode_return,
            "episode_length": length,
            "n_bounces": state.metrics["n_bounces"],
        }
        if terminated or truncated:
            state = reset_one(jax.random.split(key, NUM_ENVS)[i])
            episode_return, length = 0.0, 0
        rows.append(row | {"observation": state.obs})
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


@pytest.mark.parametrize("i", (0, NUM_ENVS - 1))
@pytest.mark.parametrize(("fixture", "episode_steps"), [("unlimited", NO_LIMIT), ("limited", 25)])
def test_run_equals_a_loop_over_single_environments(
    i, fixture, episode_steps, single, actions, request
):
    results, _ = request.getfixturevalue(fixture)
    expected = python_loop(single, actions, episode_steps, i)
    for name in ("terminated", "truncated", "episode_length"):
        np.testing.assert_array_equal(getattr(results, name)[:, i], expected[name], err_msg=name)
    for name in ("reward", "episode_return"):
        np.testing.assert_allclose(
            getattr(results, name)[:, i], expected[name], rtol=1e-3, atol=1e-3, err_msg=name
        )
    # The contact magnifies the rounding of a differently compiled step.
    for name in ("observation", "final_observation"):
        np.testing.assert_allclose(
            getattr(results, name)[:, i], expected[name], rtol=0, atol=5e-3, err_msg=name
        )
    np.testing.assert_array_equal(results.metrics["n_bounces"][:, i], expected["n_bounces"])


def test_termination_at_the_limit_is_not_a_time_out(unlimited, reset, step, actions):
    ended_at, i = np.argwhere(unlimited[0].terminated)[0]
    episode_steps = ended_at + 1
    at_limit, _ = run(reset, step, actions[: episode_steps + 1], int(episode_steps))
    assert at_limit.terminated[ended_at, i] and not at_limit.truncated[ended_at, i]
    one_less, _ = run(reset, step, actions[: episode_steps + 1], int(ended_at))
    assert one_less.truncated[ended_at - 1, i] and not one_less.terminated[ended_at - 1, i]
    assert not one_less.terminated[ended_at, i]
