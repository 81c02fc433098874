"""brax's analytic policy gradients: the gradient of the return flows through the physics."""

import functools
from typing import Any

from brax.envs import get_environment
from brax.training.agents.apg import networks
from brax.training.agents.apg import train as apg

from bounce_mjx.adapters import brax as adapter

SETTINGS = dict(
    policy_updates=300,
    num_evals=10,
    num_envs=64,
    num_eval_envs=64,
    episode_length=100,
    # 0.2 s: a gradient over many bounces grows fast. brax clips each of its components to 1.
    horizon_length=20,
    learning_rate=3e-3,
    normalize_observations=True,
    max_devices_per_host=1,
)
"""Arguments of brax's `apg.train`."""


def main(**settings: Any) -> list[dict]:
    """Trains for the first bounce; the metrics of the evaluations.

    Args:
      settings: arguments of brax's `apg.train` in place of those of `SETTINGS`.
    """
    history = []

    def progress(num_steps: int, metrics: dict) -> None:
        history.append(metrics)

    # Of a newer JAX, brax misses a function.
    with adapter.device_put_replicated():
        apg.train(
            environment=get_environment(adapter.ENV_NAME),
            network_factory=functools.partial(
                networks.make_apg_networks, hidden_layer_sizes=(64, 64)
            ),
            progress_fn=progress,
            **SETTINGS | settings,
        )
    return history


if __name__ == "__main__":
    for metrics in main():
        print(metrics["eval/episode_reward"])
