"""FlashSAC (Kim et al., arXiv 2604.04539) in `jax_vs_torch.py`: its authors' own script.

    git clone https://github.com/Holiday-Robot/FlashSAC benchmarks/sources/FlashSAC

Their `train.py` runs as it is, with `TorchVectorEnv` in place of MuJoCo Playground, and ours in
place of each of its evaluations. The settings are those of their `scripts/run_mujoco_playground.sh`
(1,024 environments, batches of 2,048, two updates a step, a critic that sees more than the policy),
except for `compile_mode`: theirs for today's PyTorch, max-autotune, was still compiling after 355 s
on an H100; and the episodes begin at different times, so that not all time out together. The script
needs the packages hydra-core and gymnasium.
"""

import argparse
import contextlib
import time
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space
from trainer_interface import OnBlock, TrainingEnded, use_source

from bounce_mjx.adapters.torch import TorchVectorEnv
from bounce_mjx.env.bounce_ball import BounceBall
from bounce_mjx.runs.config import TrainConfig

SOURCE = Path(__file__).with_name("sources") / "FlashSAC"
OVERRIDES = {
    "env": "mujoco_playground",
    "num_env_steps": 50_000_896,
    "num_train_envs": 1024,
    "agent": "flashSAC",
    "agent.buffer_max_length": 10_000_000,
    "agent.buffer_min_length": 100_000,
    "agent.buffer_device_type": "cuda",
    "agent.sample_batch_size": 2048,
    "agent.use_amp": "true",
    "updates_per_interaction_step": 2,
    "agent.asymmetric_observation": "true",
    "agent.compile_mode": "default",
    "gamma": 0.97,
    "n_step": 1,
}


class NumpyEnv:
    """B environments with the interface of the script's environments, whose arrays are NumPy's. Its
    observations are the critic's: the policy's, then the critic metrics."""

    def __init__(self, env: TorchVectorEnv):
        self._env = env
        num_inputs = env.num_observations + len(env.critic_metrics)
        self.observation_space = batch_space(Box(-np.inf, np.inf, (num_inputs,)), env.num_envs)
        self.action_space = batch_space(Box(-1.0, 1.0, (env.num_actions,)), env.num_envs)
        self.steps = 0
        """Environment steps so far, of all environments together."""

    def reset(self) -> tuple[np.ndarray, dict[str, Any]]:
        observation, critic_metrics = self._env.reset()
        # The script starts all episodes together; their time-outs are spread, as in our trainer.
        self._env.clock = torch.randint_like(self._env.clock, self._env.episode_steps)
        sizes = {"actor_observation_size": (self._env.num_observations,)}
        return _joined(observation, critic_metrics), sizes

    def step(self, actions: np.ndarray) -> tuple:
        result = self._env.step(torch.from_numpy(actions).to(self._env.device))
        self.steps += self._env.num_envs
        return (
            _joined(result.observation, result.critic_metrics),
            result.reward.cpu().numpy(),
            result.terminated.cpu().numpy(),
            result.truncated.cpu().numpy(),
            {"final_obs": _joined(result.final_observation, result.final_critic_metrics)},
        )

    def close(self) -> None:
        """Does nothing: the environments hold no resources."""


class MeanActor:
    """The script's actor without noise, in JAX."""

    def act(self, policy: dict[str, jax.Array], observation: jax.Array) -> jax.Array:
        x = _batch_norm(policy, "embedder.norm", observation) @ policy["embedder.w.w.weight"].T
        blocks = {name.split(".")[1] for name in policy if name.startswith("encoder.")}
        for block in sorted(blocks, key=int):
            part = f"encoder.{block}"
            hidden = x @ policy[f"{part}.w1.w.weight"].T
            hidden = jax.nn.relu(_batch_norm(policy, f"{part}.norm1", hidden))
            hidden = hidden @ policy[f"{part}.w2.w.weight"].T
            x = x + jax.nn.relu(_batch_norm(policy, f"{part}.norm2", hidden))
        mean_square = jnp.mean(jnp.square(x), axis=-1, keepdims=True)
        x = x * jax.lax.rsqrt(mean_square + 1e-6) * policy["post_norm.weight"]
        mean = x @ policy["predictor.mean_w.w.weight"].T + policy["predictor.mean_bias"]
        return jnp.tanh(mean)


def _batch_norm(weights: dict[str, jax.Array], name: str, x: jax.Array) -> jax.Array:
    mean = weights[f"{name}.running_mean"]
    variance = weights[f"{name}.running_var"]
    x = (x - mean) * jax.lax.rsqrt(variance + 1e-5)
    return x * weights[f"{name}.weight"] + weights[f"{name}.bias"]


def policy_of(actor: torch.nn.Module) -> dict[str, jax.Array]:
    """The arrays of the script's actor by name."""
    # A compiled module names its parameters by the module that it wraps.
    named = getattr(actor, "_orig_mod", actor).state_dict()
    return {name: jnp.asarray(x.float().cpu().numpy()) for name, x in named.items()}


def train(config: TrainConfig, on_block: OnBlock, **overrides: Any) -> None:
    """Runs the script until `on_block` returns True.

    Args:
      overrides: of the script's config, besides those above.
    """
    use_source(SOURCE)
    import train as script

    env: NumpyEnv | None = None
    started = 0.0

    def create_envs(num_train_envs: int, **_) -> tuple[NumpyEnv, NumpyEnv, NumpyEnv]:
        nonlocal env
        env = NumpyEnv(TorchVectorEnv(BounceBall(config.env), num_train_envs, seed=config.seed))
        # Of the three, the script steps only the first: what uses the others is replaced below.
        return env, env, env

    def evaluate(agent: Any, *_) -> dict[str, float]:
        nonlocal started
        policy = jax.block_until_ready(policy_of(agent._actor.network))
        if env.steps == 0:
            on_block.prepare(MeanActor(), policy)
        elif on_block(env.steps, time.perf_counter() - started, policy):
            raise TrainingEnded
        started = time.perf_counter()
        return {}

    nothing = types.SimpleNamespace(
        update_metric=lambda **_: None, log_metric=lambda **_: None, reset=lambda: None
    )
    script.create_envs = create_envs
    script.evaluate = evaluate
    script.record_video = lambda *_: {}
    script.create_logger = lambda _: nothing
    interval = max(1, round(config.eval_every / OVERRIDES["num_train_envs"]))
    settings = {"seed": config.seed, "evaluation_per_interaction_step": interval}
    settings = OVERRIDES | settings | overrides
    words = [f"{name}={value}" for name, value in settings.items()]
    paths = {"config_path": "./configs", "config_name": "flashSAC_base"}
    with contextlib.suppress(TrainingEnded):
        script.run(argparse.Namespace(**paths, overrides=words))


def _joined(observation: torch.Tensor, critic_metrics: torch.Tensor) -> np.ndarray:
    return torch.cat([observation, critic_metrics], -1).cpu().numpy()
