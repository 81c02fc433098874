"""brax's registry, wrappers, trainers, checkpoints and pictures work on the environment."""

import functools
import json
import runpy
from pathlib import Path

import brax.envs
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from brax.envs.wrappers import training
from brax.io import json as brax_json
from brax.training.agents.ppo import checkpoint as brax_checkpoint
from brax.training.agents.ppo.networks import make_ppo_networks
from brax.training.agents.sac import networks as sac_networks
from brax.training.agents.sac import train as brax_sac

import tiny_runs
from bounce_mjx import EnvConfig
from bounce_mjx.adapters.brax import (
    BraxTaskEnv,
    device_put_replicated,
    load_brax_policy,
    ppo,
)
from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.task import term_names
from bounce_mjx.task.bounce_rewards import Rewards


def all_finite(tree) -> bool:
    return all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tree))


def test_brax_makes_the_environment():
    env = brax.envs.get_environment("bounce_ball", target_height_range=(0.7, 0.7))
    assert isinstance(env, BraxTaskEnv) and isinstance(env.core, brax.envs.Env)
    config = EnvConfig(target_height_range=(0.7, 0.7), control_dt=0.02)
    wrapped = brax.envs.create(
        "bounce_ball", episode_length=5, batch_size=2, config=config, control_dt=0.01
    )
    assert wrapped.dt == 0.01
    state = jax.jit(wrapped.reset)(jax.random.PRNGKey(0))
    assert state.obs.shape == (2, 29)
    np.testing.assert_allclose(state.obs[:, 28], 0.7, rtol=1e-6)


def test_folder_without_a_checkpoint_gives_one_sentence(tmp_path):
    with pytest.raises(UserError, match="no checkpoint of brax's PPO; give"):
        load_brax_policy(tmp_path)


def test_unknown_settings_are_refused():
    with pytest.raises(UserError, match="unexpected keyword argument 'debug'; give"):
        brax.envs.get_environment("bounce_ball", debug=True)


@pytest.mark.slow
def test_randomization_by_brax_acts_on_the_physics():
    """After a step of free fall, the ball's speed is that of the world's gravity; a time-out keeps
    the world."""
    env = brax.envs.get_environment("bounce_ball")
    strengths = jnp.array([0.0, -3.0, -9.81])

    def randomize(system):
        gravity = jnp.zeros((3, 3)).at[:, 2].set(strengths)
        axes = jax.tree.map(lambda _: None, system).tree_replace({"opt.gravity": 0})
        return system.tree_replace({"opt.gravity": gravity}), axes

    wrapped = training.wrap(env, episode_length=1, randomization_fn=randomize)
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    for _ in range(2):
        state = jax.jit(wrapped.step)(state, jnp.zeros((3, 6)))
        np.testing.assert_array_equal(state.done, 1.0)
    task = state.pipeline_state.task
    np.testing.assert_allclose(task.parameters.entries["opt.gravity[2]"], strengths)
    # brax restores the first state at the end of an episode; one more step without an end.
    plain = jax.tree.map(lambda x: x[1], state)
    after = jax.jit(env.step)(plain, jnp.zeros(6))
    np.testing.assert_allclose(
        after.pipeline_state.qd[8] - plain.pipeline_state.qd[8], -3.0 * env.dt, rtol=1e-4
    )


def test_brax_draws_the_links_where_mujoco_has_them(opengl):
    """The page of `brax.io.html` shows every geom of the model at the links' poses, and a picture
    shows the ball."""
    env = brax.envs.get_environment("bounce_ball")
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    data = mujoco.MjData(env.mj_model)
    data.qpos[:] = state.pipeline_state.q
    mujoco.mj_forward(env.mj_model, data)
    drawn = json.loads(brax_json.dumps(env.sys, [state.pipeline_state]))
    np.testing.assert_allclose(drawn["states"]["x"][0]["pos"], data.xpos[1:], atol=1e-6)
    np.testing.assert_allclose(drawn["states"]["x"][0]["rot"], data.xquat[1:], atol=1e-6)
    assert sum(map(len, drawn["geoms"].values())) == env.mj_model.ngeom
    physics = state.pipeline_state.task.physics
    raised = physics._replace(qpos=physics.qpos.at[8].add(0.2))
    moved = state.pipeline_state.replace(task=state.pipeline_state.task._replace(physics=raised))
    first, second = env.render([state.pipeline_state, moved], 60, 80, camera="overview")
    assert first.shape == (60, 80, 3) and not np.array_equal(first, second)


def test_torchrl_walks_the_state(need):
    """Its `BraxEnv` makes a tensor of each array, and drops what holds none; a step of the state
    that comes back is traced as that of the state itself."""
    jax_utils = need("torchrl.envs.libs.jax_utils")
    env = brax.envs.get_environment("bounce_ball")
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    tensors = jax_utils._object_to_tensordict(state, "cpu", ())
    back = jax_utils._tensordict_to_object(tensors, state)
    jax.tree.map(np.testing.assert_array_equal, jax.tree.leaves(back), jax.tree.leaves(state))
    stepped, expected = (jax.eval_shape(env.step, x, jnp.zeros(6)) for x in (back, state))
    assert jax.tree.structure(stepped) == jax.tree.structure(expected)
    np.testing.assert_array_equal(back.pipeline_state.q, state.pipeline_state.q)


@pytest.mark.slow
def test_step_keeps_what_wrappers_added(env):
    """A step keeps unknown metrics and info, as every brax environment does."""
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    state = state.replace(metrics=state.metrics | {"mine": jnp.ones(())}, info={"lap": jnp.ones(3)})
    after = jax.jit(env.step)(state, jnp.zeros(6))
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert after.metrics["mine"] == 1.0
    np.testing.assert_array_equal(after.info["lap"], 1.0)
    assert after.metrics["reward/height"] > 0.0


def train(trainer, env, networks, **settings):
    """brax's trainer with small networks: its results, and the metrics of each evaluation."""
    history = []
    with device_put_replicated():
        results = trainer.train(
            env,
            episode_length=20,
            num_eval_envs=4,
            max_devices_per_host=1,
            network_factory=networks,
            progress_fn=lambda step, metrics: history.append(metrics),
            **settings,
        )
    return results, history


def assert_evaluated(metrics):
    """The evaluation reports the return and its terms, and the terms sum to the return."""
    terms = [float(metrics[f"eval/episode_reward/{name}"]) for name in term_names(Rewards)]
    np.testing.assert_allclose(metrics["eval/episode_reward"], sum(terms), rtol=1e-4)
    assert 0.0 < metrics["eval/avg_episode_length"] <= 20.0
    assert all_finite(list(metrics.values()))


def example(name: str) -> dict:
    """The functions of a file in examples/."""
    return runpy.run_path(str(Path(__file__).parents[1] / "examples" / name))


@pytest.fixture(scope="module")
def ppo_example(tmp_path_factory):
    """The folder and the evaluations of `examples/brax_ppo.py`."""
    folder = tmp_path_factory.mktemp("brax")
    small = {
        "rollout_steps": 2, "num_timesteps": 400, "episode_length": 20, "num_evals": 2,
        "num_envs": 8, "num_eval_envs": 4, "unroll_length": 5, "batch_size": 8,
        "num_minibatches": 2, "num_updates_per_batch": 2, "max_devices_per_host": 1,
    }  # fmt: skip
    with tiny_runs.quick_compilation():
        history = example("brax_ppo.py")["main"](folder, **small)
    return folder, history


@pytest.mark.slow
def test_brax_ppo_trains_and_evaluates(ppo_example):
    folder, history = ppo_example
    assert len(history) == 2
    for metrics in history:
        assert_evaluated(metrics)
    assert "viewer.js" in (folder / "rollout.html").read_text()


def test_brax_gets_the_settings_that_it_has():
    """The networks of the config, and the weight of the value loss, which brax halves."""
    trainer = PPOConfig(
        hidden_layers=(16, 8), critic_layers=(32,), activation="tanh", value_cost=0.3
    )
    networks = make_ppo_networks(29, 6, **ppo.network_settings(TrainConfig(ppo=trainer)))
    params = networks.policy_network.init(jax.random.key(0))
    observation = np.linspace(-1.0, 1.0, 29, dtype=np.float32)
    x = observation
    for layer in params["params"]["MLP_0"].values():
        x = np.tanh(x @ layer["kernel"] + layer["bias"])
    expected = x @ params["params"]["Dense_0"]["kernel"] + params["params"]["Dense_0"]["bias"]
    result = networks.policy_network.apply(None, params, observation)
    np.testing.assert_allclose(result[0], expected, rtol=1e-4, atol=1e-5)
    critic = networks.value_network.init(jax.random.key(0))["params"]
    assert [layer["bias"].shape for layer in critic.values()] == [(32,), (1,)]
    assert ppo.ppo_settings(TrainConfig(ppo=trainer))["vf_loss_coefficient"] == 0.6
    shared = TrainConfig(ppo=PPOConfig(shared_critic=True))
    with pytest.raises(UserError, match=r"share no layers; set ppo\.shared_critic to false"):
        ppo.network_settings(shared)


@pytest.mark.slow
def test_brax_checkpoint_has_the_trained_policy(ppo_example):
    """The action of the loaded policy equals that of a network written out in NumPy."""
    folder, _ = ppo_example
    (checkpoint,) = (child for child in folder.iterdir() if child.name.isdigit())
    normalizer, policy, *_ = brax_checkpoint.load(checkpoint)
    assert normalizer.count.lo > 0 and np.any(normalizer.mean != 0.0)
    observation = np.linspace(-1.0, 1.0, 29, dtype=np.float32)
    x = (observation - normalizer.mean) / normalizer.std
    for layer in policy["params"]["MLP_0"].values():
        x = x @ layer["kernel"] + layer["bias"]
        x = x / (1.0 + np.exp(-x))
    expected = x @ policy["params"]["Dense_0"]["kernel"] + policy["params"]["Dense_0"]["bias"]
    for path in (folder, checkpoint):
        action, _ = load_brax_policy(path)(observation, jax.random.key(0))
        np.testing.assert_allclose(action, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_brax_sac_trains_and_evaluates(env, quick_compilation):
    (make_policy, trained, _), history = train(
        brax_sac,
        env,
        functools.partial(sac_networks.make_sac_networks, hidden_layer_sizes=(8,)),
        num_timesteps=96,
        num_evals=2,
        num_envs=4,
        batch_size=8,
        min_replay_size=32,
        max_replay_size=128,
        grad_updates_per_step=1,
    )
    assert len(history) == 2
    for metrics in history:
        assert_evaluated(metrics)
    action, _ = make_policy(trained, deterministic=True)(jnp.zeros(29), jax.random.key(0))
    assert action.shape == (6,) and all_finite((action, trained))


@pytest.mark.slow
def test_brax_apg_learns(quick_compilation):
    """Gradients through the physics and the reward raise the return."""
    history = example("brax_apg.py")["main"](
        policy_updates=30, num_evals=2, num_envs=8, num_eval_envs=4, episode_length=20
    )
    first, last = (metrics["eval/episode_reward"] for metrics in history)
    assert_evaluated(history[-1])
    assert last > first


def test_device_put_replicated_exists_only_in_the_context(monkeypatch):
    monkeypatch.delattr(jax, "device_put_replicated", raising=False)
    with pytest.raises(KeyError), ppo.device_put_replicated():
        assert jax.device_put_replicated is ppo.replicate
        raise KeyError
    assert not hasattr(jax, "device_put_replicated")
    own = object()
    monkeypatch.setattr(jax, "device_put_replicated", own, raising=False)
    with ppo.device_put_replicated():
        assert jax.device_put_replicated is own
    assert jax.device_put_replicated is own


def test_replicate_copies_arrays_numbers_and_keys():
    tree = {"a": np.arange(3, dtype=np.int8), "b": 2.5, "key": jax.random.key(3)}
    copies = ppo.replicate(tree, jax.local_devices()[:1])
    assert copies["a"].dtype == jnp.int8
    np.testing.assert_array_equal(copies["a"], [[0, 1, 2]])
    np.testing.assert_array_equal(copies["b"], [2.5])
    data, expected = jax.random.key_data(copies["key"]), jax.random.key_data(tree["key"])
    np.testing.assert_array_equal(data, expected[None])
