"""MuJoCo Playground's registry, wrappers, renderer and training program work on the tasks."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.errors import UserError

pytest.importorskip("mujoco_playground")

from mujoco_playground import manipulation, registry, wrapper
from mujoco_playground._src import mjx_env
from mujoco_playground.config import manipulation_params

from bounce_mjx.adapters import playground  # noqa: F401
from bounce_mjx.adapters.gymnasium.registration import TASKS
from bounce_mjx.task.registry import find_task

ENV_NAME = "BounceBall"


@pytest.mark.slow
def test_playground_loads_the_environment_without_a_network(monkeypatch, quick_compilation):
    # Playground fetches its own robots before it loads one of its environments.
    monkeypatch.setattr(mjx_env, "ensure_menagerie_exists", lambda: pytest.fail("fetched"))
    assert ENV_NAME in registry.ALL_ENVS and ENV_NAME in manipulation.ALL_ENVS
    config = registry.get_default_config(ENV_NAME)
    assert (config.ctrl_dt, config.episode_length) == (0.01, 2000)
    config.task.target_height_range = (0.7, 0.7)
    env = registry.load(ENV_NAME, config=config, config_overrides={"impl": "jax"})
    assert (env.observation_size, env.action_size, env.n_substeps) == (29, 6, 10)
    task = BounceBall(EnvConfig(target_height_range=(0.7, 0.7)))
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    vector = wrapper.wrap_for_brax_training(env, episode_length=5)
    state = jax.jit(vector.reset)(keys)
    np.testing.assert_allclose(state.obs[:, 28], 0.7, rtol=1e-6)

    # The same states in the plain environment.
    start = state
    expected = jax.vmap(task.reset)(keys)
    physics = expected.pipeline_state.physics._replace(qpos=state.data.qpos, qvel=state.data.qvel)
    expected = expected.replace(
        pipeline_state=state.data.task._replace(physics=physics), obs=state.obs
    )
    actions = jnp.full((2, 6), 0.5)
    step, plain_step = jax.jit(vector.step), jax.jit(jax.vmap(task.step))
    for i in range(4):
        state, expected = step(state, actions), plain_step(expected, actions)
        np.testing.assert_allclose(state.obs, expected.obs, atol=1e-4)
        np.testing.assert_allclose(state.reward, expected.reward, rtol=1e-3)
        np.testing.assert_allclose(state.data.time, 0.01 * (i + 1), rtol=1e-5)
    state = step(state, actions)
    assert state.done.tolist() == [1.0, 1.0]
    np.testing.assert_allclose(state.obs, start.obs, atol=1e-6)
    np.testing.assert_array_equal(state.data.time, 0.0)


@pytest.mark.parametrize("task", TASKS)
def test_playground_has_the_other_tasks(task):
    """With their time limits, their own PPO parameters, and worlds of their model."""
    name = f"BounceMjx{task.title()}"
    assert name in registry.ALL_ENVS
    env = registry.load(name)
    assert isinstance(env.core.task, find_task(task))
    limit = find_task(task).Config().episode_steps
    assert registry.get_default_config(name).episode_length == limit
    parameters = manipulation_params.brax_ppo_config(name)
    bounce = manipulation_params.brax_ppo_config(ENV_NAME)
    assert bounce.batch_size * bounce.num_minibatches == bounce.num_envs == 4096
    assert manipulation_params.brax_ppo_config("PandaPickCube", "jax").num_envs != 4096
    assert parameters.episode_length == limit and parameters.num_timesteps != bounce.num_timesteps
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    model, axes = registry.get_domain_randomizer(name)(env.mjx_model, keys)
    worlds = wrapper.wrap_for_brax_training(env, randomization_fn=lambda _: (model, axes))
    assert jax.eval_shape(worlds.reset, keys).obs.shape == (2, env.observation_size)


@pytest.mark.slow
def test_randomization_by_playground_acts_on_the_physics(quick_compilation):
    """Worlds of Playground's own randomiser: the ball falls with the gravity of its world."""
    env = registry.load(ENV_NAME)
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    model, axes = registry.get_domain_randomizer(ENV_NAME)(env.mjx_model, keys)
    assert axes.body_mass == 0 and axes.qpos0 is None
    worlds = wrapper.wrap_for_brax_training(env, randomization_fn=lambda _: (model, axes))
    state = jax.jit(worlds.reset)(jax.random.split(jax.random.PRNGKey(1), 3))
    before = state.data.qvel[:, 6:9]
    state = jax.jit(worlds.step)(state, jnp.zeros((3, 6)))
    assert np.ptp(np.asarray(model.opt.gravity), axis=0).min() > 1e-3
    np.testing.assert_allclose(
        state.data.qvel[:, 6:9] - before, model.opt.gravity * env.dt, rtol=1e-3, atol=1e-6
    )
    ball = env.mj_model.body("ball_link").id
    entries = state.data.task.parameters.entries
    np.testing.assert_allclose(entries[f"body_mass[{ball}]"], model.body_mass[:, ball])
    # Outside the randomised worlds, the model is the environment's own.
    assert env.mjx_model.body_mass.shape == (env.mj_model.nbody,)


def test_torchrl_wraps_playgrounds_environment(need):
    libs = need("torchrl.envs")
    env = libs.MujocoPlaygroundEnv(ENV_NAME, batch_size=[2], device="cpu")
    env.set_seed(0)
    observation = env.reset()["observation"]
    assert env.observation_spec["observation"].shape == observation.shape == (2, 29)
    assert env.action_spec.shape == (2, 6)


def test_wrong_settings_of_playground_give_one_sentence():
    with pytest.raises(UserError, match="control_dt"):
        registry.load(ENV_NAME, config_overrides={"ctrl_dt": 0.0})


def test_playground_renders_states(opengl):
    env = registry.load(ENV_NAME)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    raised = state.tree_replace({"data.qpos": state.data.qpos.at[8].add(0.2)})
    scene = mujoco.MjvOption()
    pictures = env.render([state, raised], 60, 80, camera="overview", scene_option=scene)
    assert pictures[0].shape == (60, 80, 3) and not np.array_equal(*pictures)


def test_example_films_randomised_worlds(tmp_path, opengl, need):
    need("mediapy")
    main = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "playground_rollout.py"))[
        "main"
    ]
    heights = main(video=tmp_path / "video.mp4", steps=4, num_envs=3)
    assert (tmp_path / "video.mp4").stat().st_size > 1000
    # 0.04 s of free fall from 0.45 m, in tilted gravity.
    np.testing.assert_allclose(heights, 0.45, atol=0.02)
    assert len(set(heights.tolist())) == 3


@pytest.mark.slow
def test_playgrounds_program_runs_to_its_end(tmp_path, opengl, need, quick_compilation):
    """`train-jax-ppo` trains in randomised worlds, saves a checkpoint and films the policy."""
    need("mediapy")
    flags = (
        f"--env_name={ENV_NAME} --num_timesteps=64 --num_evals=1 --run_evals=False --num_envs=8 "
        "--unroll_length=4 --batch_size=8 --num_minibatches=2 --num_updates_per_batch=1 "
        "--episode_length=4 --policy_hidden_layer_sizes=8 --value_hidden_layer_sizes=8 "
        f"--domain_randomization=True --logdir={tmp_path}"
    )
    command = [sys.executable, "-m", "bounce_mjx.adapters.playground", *flags.split()]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    (video,) = tmp_path.glob("BounceBall-*/rollout0.mp4")
    assert video.stat().st_size > 1000
    (config,) = tmp_path.glob("BounceBall-*/checkpoints/*/ppo_network_config.json")
    assert json.loads(config.read_text())["action_size"] == 6
