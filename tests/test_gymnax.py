"""The gymnax interface, and the example of PureJaxRL."""

import functools
import runpy
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx import environment
from bounce_mjx.adapters.gymnax_env import GymnaxTaskEnv, PureJaxRLTaskEnv
from bounce_mjx.errors import UserError

LIMIT = 3


@pytest.fixture(scope="module")
def env() -> PureJaxRLTaskEnv:
    return PureJaxRLTaskEnv(
        environment(episode_seconds=0.01 * LIMIT, target_height_range=(0.4, 0.6))
    )


@pytest.fixture
def gymnax(need, monkeypatch):
    # gymnax imports its own environments, one of which has seaborn's colours.
    monkeypatch.setitem(sys.modules, "seaborn", types.ModuleType("seaborn"))
    need("gymnax")
    return need("gymnax.wrappers")


@pytest.mark.slow
@pytest.mark.usefixtures("quick_compilation")
def test_steps_are_those_of_the_task_until_the_time_limit(env):
    """The plain environment is the reference; at the limit the observation is a new episode's, and
    the last one is in the info of gymnax's form. PureJaxRL, which keeps every info, gets none of
    it."""
    observation, state = env.reset(jax.random.key(0))
    plain = jax.jit(env.core.reset)(jax.random.key(0))
    np.testing.assert_array_equal(observation, plain.obs)
    plain_step = jax.jit(env.core.step)
    step = functools.partial(GymnaxTaskEnv.step, env)
    assert env.default_params.max_steps_in_episode == LIMIT
    for i in range(LIMIT):
        action = 0.1 * jax.random.normal(jax.random.key(i), (6,))
        given = jax.random.key(10 + i), state, action
        *_, done, purejaxrl_info = env.step(*given)
        observation, state, reward, terminated, truncated, info = step(*given)
        plain = plain_step(plain, action)
        np.testing.assert_allclose(info["final_observation"], plain.obs, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(reward, plain.reward, rtol=1e-5)
        assert bool(done) == bool(truncated) == (i == LIMIT - 1) and not terminated
        assert purejaxrl_info == {"terminated": terminated, "truncated": truncated}
    # The target height never changes within an episode.
    assert observation[28] != info["final_observation"][28]
    assert state.time == 0
    fresh, _ = env.reset(jax.random.key(10 + LIMIT - 1))
    np.testing.assert_allclose(observation, fresh, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("quick_compilation")
def test_the_parameters_set_the_time_limit_and_a_fall_terminates(env):
    """In the form of gymnax 1.x, whose steps tell the two ends apart."""
    step = functools.partial(GymnaxTaskEnv.step, env)
    params = env.default_params.replace(max_steps_in_episode=1)
    _, state = env.reset(jax.random.key(0), params)
    *_, terminated, truncated, _ = step(jax.random.key(1), state, jnp.zeros(6), params)
    assert truncated and not terminated
    under = state.env.pipeline_state.physics
    under = under._replace(qpos=under.qpos.at[8].set(0.0))
    state = state.replace(
        env=state.env.replace(pipeline_state=state.env.pipeline_state._replace(physics=under))
    )
    *_, terminated, truncated, _ = step(jax.random.key(1), state, jnp.zeros(6), params)
    assert terminated and not truncated


def test_spaces_and_settings(env, gymnax):
    """The spaces are gymnax's own, which its wrappers ask for."""
    assert env.observation_space().shape == (29,) and env.num_actions == 6
    assert gymnax.FlattenObservationWrapper(env).observation_space(None).shape == (29,)
    actions = jax.vmap(env.action_space().sample)(jax.random.split(jax.random.key(0), 100))
    assert actions.shape == (100, 6) and np.ptp(actions) > 1.9
    assert env.action_space().contains(actions) and not env.action_space().contains(2.0 * actions)
    with pytest.raises(UserError, match="'target_hight_range'; did you mean target_height_range"):
        environment(target_hight_range=(0.3, 0.4))
    with pytest.raises(UserError, match="reward.heigth; did you mean reward.height"):
        environment(reward={"heigth": {"weight": 2.0}})
    # NumPy's rules would give every joint the one number.
    state = jax.eval_shape(env.reset, jax.random.key(0))[1]
    for wrong in (jnp.zeros(()), jnp.zeros(1), jnp.zeros((2, 6))):
        with pytest.raises(UserError, match=r"the action has the shape .*; give \(6,\) for one"):
            jax.eval_shape(env.step, jax.random.key(0), state, wrong)


def test_gymnax_own_wrapper_logs_episodes(gymnax):
    wrapped = gymnax.LogWrapper(GymnaxTaskEnv(environment(episode_seconds=0.02)))
    _, state = wrapped.reset(jax.random.key(0))
    rewards = []
    for i in range(2):
        _, state, reward, _, truncated, info = wrapped.step(jax.random.key(i), state, jnp.zeros(6))
        rewards.append(float(reward))
    assert truncated and info["returned_episode_lengths"] == 2
    np.testing.assert_allclose(info["returned_episode_returns"], sum(rewards), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.usefixtures("quick_compilation")
def test_example_of_purejaxrl_trains():
    """No random key of it is used twice, which JAX can tell."""
    main = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "purejaxrl.py"))["main"]
    with jax.debug_key_reuse(True):
        lengths = np.array(main(num_envs=8, rollout=60, updates=3))
    assert lengths.shape == (3,) and np.all(lengths > 5.0) and np.ptp(lengths) > 0.0


@pytest.mark.slow
@pytest.mark.usefixtures("quick_compilation")
def test_example_of_evosax_searches(need):
    need("evosax")
    names = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "evosax_search.py"))
    mean = np.array(names["main"](population=16, generations=3, steps=10))
    # The reward of the first steps lies near its bound, and no candidate exceeds it.
    assert mean.shape == (3,) and np.all(np.isfinite(mean)) and np.all(mean > 0.0)
    # A return has the reward of the step that ends the episode, and none of a later one.
    weights = jnp.zeros((6, 30)).at[:, -1].set(-5.0)
    step = jax.jit(names["env"].step)
    state = names["env"].reset(jax.random.key(0))
    rewards = []
    while not state.done and len(rewards) < 100:
        state = step(state, jnp.tanh(weights[:, -1]))
        rewards.append(float(state.reward))
    total = names["episode_return"](weights, jax.random.key(0), num_steps=2 * len(rewards))
    assert state.done and abs(rewards[-1]) > 0.1
    np.testing.assert_allclose(total, sum(rewards), rtol=1e-4)
