"""FastTD3 (Seo et al., arXiv 2505.22642) in `jax_vs_torch.py`: its authors' own script.

    git clone https://github.com/younggyoseo/FastTD3 benchmarks/sources/FastTD3

Their `train.py` runs as it is, with `TorchVectorEnv` in place of MuJoCo Playground, and each of its
checkpoints is evaluated. The settings are theirs for Playground's LeapCubeReorient, which moves an
object too (1,024 environments, batches of 32,768, two updates a step, returns over three steps),
except for these:

| setting               | value                                                         |
|-----------------------|---------------------------------------------------------------|
| reward_normalization  | on, as in their settings for MTBench, to fit the critic's range |
| start of the training | the episodes begin at different times, not all together       |
| logs, videos          | none                                                          |
"""

import contextlib
import sys
import time
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import torch
from trainer_interface import OnBlock, TrainingEnded, use_source

from bounce_mjx.adapters.torch import TorchVectorEnv
from bounce_mjx.env.bounce_ball import BounceBall
from bounce_mjx.runs.config import TrainConfig

SOURCE = Path(__file__).with_name("sources") / "FastTD3" / "fast_td3"


class PlaygroundEnv:
    """B environments with the interface of the script's environments."""

    asymmetric_obs = True

    def __init__(self, env: TorchVectorEnv):
        self._env = env
        self.num_envs = env.num_envs
        self.num_actions = env.num_actions
        self.num_obs = env.num_observations
        self.num_privileged_obs = env.num_observations + len(env.critic_metrics)
        self.max_episode_steps = env.episode_steps
        self.steps = 0
        """Environment steps so far, of all environments together."""

    def reset_with_critic_obs(self) -> tuple[torch.Tensor, torch.Tensor]:
        observation, critic_metrics = self._env.reset()
        # The script starts all episodes together; their time-outs are spread, as in our trainer.
        self._env.clock = torch.randint_like(self._env.clock, self.max_episode_steps)
        return observation, torch.cat([observation, critic_metrics], -1)

    def step(self, actions: torch.Tensor) -> tuple:
        result = self._env.step(actions)
        self.steps += self.num_envs
        last = {
            "obs": result.final_observation,
            "critic_obs": torch.cat([result.final_observation, result.final_critic_metrics], -1),
        }
        critic = torch.cat([result.observation, result.critic_metrics], -1)
        infos = {"time_outs": result.truncated, "observations": {"critic": critic, "raw": last}}
        return result.observation, result.reward, result.done, infos


class MeanActor:
    """The script's actor without noise, in JAX."""

    def act(self, policy: dict[str, Any], observation: jax.Array) -> jax.Array:
        x = (observation - policy["mean"]) / policy["std"]
        *hidden, last = policy["layers"]
        for weight, bias in hidden:
            x = jax.nn.relu(x @ weight.T + bias)
        return jnp.tanh(x @ last[0].T + last[1])


def policy_of(actor: torch.nn.Module, normalizer: torch.nn.Module) -> dict[str, Any]:
    """The arrays of the script's actor."""

    def array(tensor: torch.Tensor) -> jax.Array:
        return jnp.asarray(tensor.detach().float().cpu().numpy())

    linears = [module for module in actor.modules() if isinstance(module, torch.nn.Linear)]
    return {
        "mean": array(normalizer.mean),
        "std": array(normalizer.std + normalizer.eps),
        "layers": [(array(linear.weight), array(linear.bias)) for linear in linears],
    }


def train(config: TrainConfig, on_block: OnBlock, **settings: Any) -> None:
    """Runs the script until `on_block` returns True.

    Args:
      settings: settings of the script in place of those above.
    """
    use_source(SOURCE)
    # The script imports it even without `use_wandb`.
    sys.modules.setdefault("wandb", types.ModuleType("wandb"))
    playground = types.ModuleType("environments.mujoco_playground_env")
    sys.modules["environments.mujoco_playground_env"] = playground
    import hyperparams
    import train as script
    from fast_td3 import Actor
    from fast_td3_utils import EmpiricalNormalization

    args = hyperparams.LeapCubeReorientArgs(
        env_name="BounceBall",
        seed=config.seed,
        cuda=torch.cuda.is_available(),
        reward_normalization=True,
        use_wandb=False,
        eval_interval=0,
        render_interval=0,
    )
    for name, value in settings.items():
        setattr(args, name, value)
    args.save_interval = max(1, round(config.eval_every / args.num_envs))
    env = PlaygroundEnv(TorchVectorEnv(BounceBall(config.env), args.num_envs, seed=config.seed))
    untrained = Actor(env.num_obs, env.num_actions, 1, args.init_scale, args.actor_hidden_dim)
    fresh_normalizer = EmpiricalNormalization(env.num_obs, "cpu")
    on_block.prepare(MeanActor(), policy_of(untrained, fresh_normalizer))
    started = 0.0

    def make_env(*_, **__) -> tuple[PlaygroundEnv, None, None]:
        nonlocal started
        started = time.perf_counter()
        return env, None, None

    def on_checkpoint(step: int, actor, qnet, target, normalizer, *_) -> None:
        nonlocal started
        policy = jax.block_until_ready(policy_of(actor, normalizer))
        if on_block(env.steps, time.perf_counter() - started, policy):
            raise TrainingEnded
        started = time.perf_counter()

    playground.make_env = make_env
    script.get_args = lambda: args
    script.save_params = on_checkpoint
    with contextlib.suppress(TrainingEnded):
        script.main()
