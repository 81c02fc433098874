"""MuJoCo Playground lists the environment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx.errors import UserError


def test_playground_loads_the_environment(monkeypatch):
    pytest.importorskip("mujoco_playground")
    from mujoco_playground import manipulation, registry, wrapper
    from mujoco_playground._src import mjx_env

    import bounce_mjx.adapters.playground.environment

    # Playground fetches its own robots before it loads any environment.
    monkeypatch.setattr(mjx_env, "ensure_menagerie_exists", lambda: None)
    assert "BounceBall" in manipulation.ALL_ENVS
    config = registry.get_default_config("BounceBall")
    assert (config.ctrl_dt, config.episode_length) == (0.01, 2000)
    config.task.target_height_range = (0.7, 0.7)
    env = registry.load("BounceBall", config=config)
    assert (env.observation_size, env.action_size, env.n_substeps) == (29, 6, 10)
    task = bounce_mjx.BounceBall(bounce_mjx.EnvConfig(target_height_range=(0.7, 0.7)))
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    vector = wrapper.wrap_for_brax_training(env, episode_length=5)
    state = jax.jit(vector.reset)(keys)
    np.testing.assert_allclose(state.obs[:, 28], 0.7, rtol=1e-6)
    start = jax.vmap(task.reset)(keys).replace(pipeline_state=state.data, obs=state.obs)
    expected = start
    actions = jnp.full((2, 6), 0.5)
    step, plain_step = jax.jit(vector.step), jax.jit(jax.vmap(task.step))
    for _ in range(4):
        state, expected = step(state, actions), plain_step(expected, actions)
        np.testing.assert_allclose(state.obs, expected.obs, atol=1e-4)
        np.testing.assert_allclose(state.reward, expected.reward, rtol=1e-3)
    state = step(state, actions)
    assert state.done.tolist() == [1.0, 1.0]
    np.testing.assert_allclose(state.obs, start.obs, atol=1e-6)


def test_randomization_by_playground_is_refused():
    """Playground's randomisation replaces an MJX model that no step uses, so all randomised worlds
    would be equal."""
    pytest.importorskip("mujoco_playground")
    from mujoco_playground import wrapper

    from bounce_mjx.adapters.playground import PlaygroundBounceBall

    env = PlaygroundBounceBall()
    randomized = wrapper.wrap_for_brax_training(
        env,
        randomization_fn=lambda model: (model, jax.tree.map(lambda _: None, model)),
    )
    with pytest.raises(UserError, match="randomization_fn .* no effect"):
        randomized.reset(jax.random.split(jax.random.PRNGKey(0), 2))
    assert env.mjx_model.nq == env.mj_model.nq
