"""brax's PPO in worlds that brax's domain randomisation draws; the checkpoint's policy as a
page."""

import functools
from pathlib import Path
from typing import Any

import jax
from brax.envs import Env, get_environment
from brax.io import html
from brax.training.agents.ppo import networks
from brax.training.agents.ppo import train as ppo
from brax.training.types import Policy

from bounce_mjx.adapters import brax as adapter


def domain_randomize(sys: Any, rng: jax.Array) -> tuple[Any, Any]:
    """Worlds with a ball of 0.7 to 1.3 times the mass, one for each key [B]: a system whose
    `body_mass` has a batch axis, and the axes of its fields for `jax.vmap`."""
    # Body 0 is the world, which is no link.
    ball = sys.link_names.index("ball_link") + 1

    @jax.vmap
    def body_mass(key: jax.Array) -> jax.Array:
        factor = jax.random.uniform(key, minval=0.7, maxval=1.3)
        return sys.body_mass.at[ball].multiply(factor)

    in_axes = jax.tree.map(lambda _: None, sys)
    in_axes = in_axes.tree_replace({"body_mass": 0})
    return sys.tree_replace({"body_mass": body_mass(rng)}), in_axes


def train(env: Env, folder: Path, **settings: Any) -> list[dict]:
    """Trains and writes checkpoints into the folder; the metrics of each evaluation."""
    history = []

    def progress(num_steps: int, metrics: dict) -> None:
        history.append(metrics)

    # Of a newer JAX, brax misses a function.
    with adapter.device_put_replicated():
        ppo.train(
            environment=env,
            network_factory=functools.partial(
                networks.make_ppo_networks, **adapter.network_settings()
            ),
            randomization_fn=domain_randomize,
            progress_fn=progress,
            save_checkpoint_path=folder.resolve(),
            **adapter.ppo_settings() | settings,
        )
    return history


def rollout(env: Env, policy: Policy, num_steps: int) -> list[Any]:
    """The physics states of the policy's first steps in an environment."""
    jit_reset = jax.jit(env.reset)
    jit_step = jax.jit(env.step)
    jit_policy = jax.jit(policy)
    # The policy is deterministic, and its key without effect.
    key = jax.random.key(0)
    state = jit_reset(key)
    pipeline_states = []
    for _ in range(num_steps):
        action, _ = jit_policy(state.obs, key)
        state = jit_step(state, action)
        pipeline_states.append(state.pipeline_state)
    return pipeline_states


def main(folder: Path = Path("brax_ppo"), rollout_steps: int = 500, **settings: Any) -> list[dict]:
    """Trains, loads the checkpoint and writes `rollout.html`; the metrics of each evaluation.

    Args:
      settings: arguments of brax's `ppo.train` that replace the tuned ones.
    """
    env = get_environment(adapter.ENV_NAME, target_height_range=(0.4, 0.6))
    history = train(env, folder, **settings)
    policy = adapter.load_brax_policy(folder)
    pipeline_states = rollout(env, policy, rollout_steps)
    # The page shows one state for each control step, of several physics steps.
    sys = env.sys.tree_replace({"opt.timestep": env.dt})
    (folder / "rollout.html").write_text(html.render(sys, pipeline_states))
    return history


if __name__ == "__main__":
    for metrics in main():
        print(metrics["eval/episode_reward"])
