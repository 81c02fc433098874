"""Policies with a memory: gradients through time, resets, and their exported form."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx import load_policy
from bounce_mjx.config.validation import validate
from bounce_mjx.deploy.export import export_jax
from bounce_mjx.errors import UserError
from bounce_mjx.learning import ppo
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import (
    Policy,
    act_with_memory,
    make_networks,
    respond_in_sequence,
)
from bounce_mjx.learning.statistics import init_normalizer
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.folders import find_checkpoint, save_config
from bounce_mjx.runs.writing import CheckpointWriter
from bounce_mjx.task.state import State


def settings(**changes) -> PPOConfig:
    values = {
        "network": "gru", "gru_size": 8, "hidden_layers": (16,), "num_envs": 64,
        "rollout_length": 6, "num_minibatches": 4, "num_epochs": 4, "learning_rate": 3e-3,
        "max_learning_rate": 3e-3, "target_kl": 0.0, "decay_steps": 10**9, "discount": 0.5,
        "init_noise_std": 0.2, "reward_scale": 1.0, "critic_metrics": (),
    }  # fmt: skip
    return PPOConfig(**values | changes)


# The gradient through time


def means_by_definition(params: dict, inputs, hidden, starts) -> np.ndarray:
    """Means [B, T, A] of the actions in NumPy, by the equations of Cho et al. 2014 with the reset
    gate behind the recurrent product."""
    sigmoid = lambda x: 1.0 / (1.0 + np.exp(-x))  # noqa: E731
    layer, gru, output = params["MLP_0"]["hidden_0"], params["gru"], params["Dense_0"]

    def linear(name: str, value: np.ndarray) -> np.ndarray:
        return value @ gru[name]["kernel"] + gru[name].get("bias", 0.0)

    means = []
    for t in range(inputs.shape[1]):
        hidden = np.where(starts[:, t, None], 0.0, hidden)
        x = inputs[:, t] @ layer["kernel"] + layer["bias"]
        x = x * sigmoid(x)
        r = sigmoid(linear("ir", x) + linear("hr", hidden))
        z = sigmoid(linear("iz", x) + linear("hz", hidden))
        new = np.tanh(linear("in", x) + r * linear("hn", hidden))
        hidden = (1.0 - z) * new + z * hidden
        means.append(hidden @ output["kernel"] + output["bias"])
    return np.stack(means, axis=1)


@pytest.mark.usefixtures("float64")
def test_gradient_through_time_equals_difference_quotients() -> None:
    network = make_networks(settings(gru_size=4, hidden_layers=(5,)), 3, 2).policy_network
    rng = np.random.default_rng(0)
    params = jax.tree.map(
        lambda x: rng.normal(size=x.shape), jax.eval_shape(network.init, jax.random.PRNGKey(0))
    )
    inputs, hidden = rng.normal(size=(2, 7, 3)), rng.normal(size=(2, 4))
    starts = np.zeros((2, 7), bool)
    starts[0, 3] = starts[1, 0] = True
    weights = rng.normal(size=(2, 7, 2))

    def loss(params: dict, hidden: jax.Array) -> jax.Array:
        means = respond_in_sequence(network, params, inputs, (hidden,), starts).mean
        return jnp.sum(weights * means**2)

    def reference(params: dict, hidden: np.ndarray) -> float:
        return np.sum(weights * means_by_definition(params["params"], inputs, hidden, starts) ** 2)

    value, gradients = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))(params, hidden)
    assert value == pytest.approx(reference(params, hidden), rel=1e-12)
    for _ in range(10):
        direction = jax.tree.map(lambda x: rng.normal(size=x.shape), (params, hidden))
        ends = [
            reference(*jax.tree.map(lambda x, d, s=s: x + s * d, (params, hidden), direction))
            for s in (1e-6, -1e-6)
        ]
        slope = sum(jax.tree.leaves(jax.tree.map(lambda g, d: np.sum(g * d), gradients, direction)))
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-6, abs=1e-6)
    # The memory before a sequence that starts an episode has no effect.
    assert np.all(gradients[1][1] == 0.0) and np.all(gradients[1][0] != 0.0)


# The trainer


class Recall:
    """The first observation of an episode shows a sign. In later steps, the best action is the
    sign, which is not seen any more."""

    observation_size, action_size, backend = 2, 1, "none"

    def reset(self, rng: jax.Array) -> State:
        sign = jnp.where(jax.random.bernoulli(rng), 0.5, -0.5)
        return self._state(sign, jnp.float32(0.0), jnp.float32(0.0))

    def step(self, state: State, action: jax.Array) -> State:
        sign, time = state.pipeline_state
        reward = jnp.where(time > 0, -jnp.square(action[0] - sign), 0.0)
        return self._state(sign, time + 1.0, reward)

    def _state(self, sign: jax.Array, time: jax.Array, reward: jax.Array) -> State:
        names = ("bounced", "ball_xy_error", "apex_error", "non_finite", "n_bounces")
        is_first = time == 0
        obs = jnp.stack([jnp.where(is_first, sign, 0.0), is_first.astype(jnp.float32)])
        metrics = dict.fromkeys(names, jnp.zeros(()))
        return State((sign, time), obs, reward, (time >= 4).astype(jnp.float32), metrics)


class Training(NamedTuple):
    start: ppo.TrainingState
    step: Callable[[ppo.TrainingState], tuple[ppo.TrainingState, dict]]
    """One iteration."""


@pytest.fixture(scope="module")
def training() -> Training:
    trainer = ppo.make_trainer(settings(min_learning_rate=1e-12), Recall(), episode_steps=1000)
    start = jax.jit(trainer.init)(jax.random.PRNGKey(0))
    return Training(start, jax.jit(lambda state: trainer.run(state, 1)))


def test_a_task_that_needs_a_memory_is_solved(training: Training) -> None:
    """Without a memory, the best action is 0: -0.25 in three of four steps, -0.1875 on average."""
    state, step = training
    for _ in range(150):
        state, metrics = step(state)
    assert metrics["reward"][0] > -0.01


def test_update_sees_the_memory_of_the_rollout(training: Training) -> None:
    """If the policy does not change and the normaliser hardly does, the update computes the policy
    of the rollout: across rollouts, and with episodes that end within them."""
    state = training.start._replace(learning_rate=jnp.float32(1e-12))
    for steps in range(6, 241, 6):
        state, metrics = training.step(state)
        # An episode has four steps, and its last one empties the memory.
        is_empty = np.all(state.memory[0] == 0.0, axis=0)
        assert is_empty.shape == (64,) and np.all(is_empty == (steps % 4 == 0))
    assert metrics["policy/kl"][0] < 1e-7


def test_minibatches_of_a_gru_are_whole_environments() -> None:
    values = {"network": "gru", "num_envs": 8, "rollout_length": 32, "num_minibatches": 16}
    with pytest.raises(UserError, match="whole environments"):
        validate(PPOConfig, values, "here")


# The exported policy


def test_exported_memory_is_that_of_jax(tmp_path: Path) -> None:
    seen = {"target_height": 1, "joint_angles": 2, "velocity": "differences"}
    hidden = ("joint_velocities", "ball_position", "ball_velocity", "ball_quaternion")
    observation = dict.fromkeys((*hidden, "ball_angular_velocity", "paddle_position"), 0) | seen
    config = TrainConfig(
        env={"observation": observation},
        ppo={"network": "gru", "gru_size": 12, "hidden_layers": (10,)},
    )
    size = config.env.layout.size
    networks = make_networks(config.ppo, size, config.env.num_joints)
    params = networks.policy_network.init(jax.random.PRNGKey(1))
    params["params"]["Dense_0"]["kernel"] *= 50.0
    weights = Policy(init_normalizer(size), params)
    save_config(tmp_path, config)
    writer = CheckpointWriter(tmp_path, config)
    writer.save(("best",), 64, weights)
    writer.close()
    policy = load_policy(tmp_path)
    artefact = jax.export.deserialize(export_jax(find_checkpoint(tmp_path)))
    call = jax.jit(artefact.call)
    respond = jax.jit(lambda observed, memory: act_with_memory(networks, weights, observed, memory))
    rng = np.random.default_rng(0)
    for _ in range(2):
        policy.reset()
        memory = networks.policy_network.start_memory((1,))
        exported = {"memory": np.zeros((1, 12), np.float32)}
        for _ in range(10):
            measured = {"joint_angles": rng.normal(size=6), "target_height": rng.normal()}
            action = policy.step(measured)
            observed = np.asarray(policy.observation, np.float32)[None]
            expected, memory = respond(observed, memory)
            np.testing.assert_allclose(action, expected[0], atol=1e-5)
            exported["joint_angles"] = observed[:, :12].reshape(1, 2, 6)
            exported["target_height"] = observed[:, 12:].reshape(1, 1, 1)
            actions, exported["memory"] = call(exported)
            np.testing.assert_allclose(actions, expected, atol=1e-5)
        assert np.abs(memory[0]).max() > 0.01
