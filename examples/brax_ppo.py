"""brax's PPO in worlds that brax's domain randomisation draws; the checkpoint's policy as a page.

`python examples/brax_ppo.py` needs the extra `brax`.
"""

import functools
from pathlib import Path
from typing import Any

import jax
from brax.envs import get_environment
from brax.io import html
from brax.training.agents.ppo import networks
from brax.training.agents.ppo import train as ppo

from bounce_mjx.adapters import brax as adapter


def randomize(system: Any, rng: jax.Array) -> tuple[Any, Any]:
    """Worlds with a ball of 0.7 to 1.3 times the mass, one for each key [B]."""

    def draw(key: jax.Array) -> jax.Array:
        factor = jax.random.uniform(key, (), minval=0.7, maxval=1.3)
        return system.body_mass.at[system.link_names.index("ball_link") + 1].multiply(factor)

    masses = jax.vmap(draw)(rng)
    axes = jax.tree.map(lambda _: None, system).tree_replace({"body_mass": 0})
    return system.tree_replace({"body_mass": masses}), axes


def main(folder: Path = Path("brax_ppo"), rollout_steps: int = 500, **settings: Any) -> list[dict]:
    """Trains, loads the checkpoint and writes `rollout.html`; the metrics of each evaluation.

    Args:
      settings: arguments of brax's `ppo.train` that replace the tuned ones.
    """
    env, history = get_environment(adapter.ENV_NAME, target_height_range=(0.4, 0.6)), []
    network = functools.partial(networks.make_ppo_networks, **adapter.network_settings())
    with adapter.device_put_replicated():
        ppo.train(
            env,
            network_factory=network,
            randomization_fn=randomize,
            progress_fn=lambda step, metrics: history.append(metrics),
            save_checkpoint_path=folder.resolve(),
            **(adapter.ppo_settings() | settings),
        )
    policy = jax.jit(adapter.load_brax_policy(folder))
    step, state, states = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(0)), []
    for _ in range(rollout_steps):
        state = step(state, policy(state.obs, jax.random.key(0))[0])
        states.append(state.pipeline_state)
    page = html.render(env.sys.tree_replace({"opt.timestep": env.dt}), states)
    (folder / "rollout.html").write_text(page)
    return history


if __name__ == "__main__":
    for metrics in main():
        print(metrics["eval/episode_reward"])
