"""brax's analytic policy gradients: the gradient of the return flows through the physics.

`python examples/brax_apg.py` needs the extra `brax`.
"""

import functools
from typing import Any

from brax.envs import get_environment
from brax.training.agents.apg import networks
from brax.training.agents.apg import train as apg

from bounce_mjx.adapters import brax as adapter


def main(**settings: Any) -> list[dict]:
    """Trains for the first bounce; the metrics of the evaluations.

    Args:
      settings: arguments of brax's `apg.train` that replace the ones below.
    """
    history = []
    given = dict(
        policy_updates=300,
        num_evals=10,
        num_envs=64,
        num_eval_envs=64,
        episode_length=100,
        horizon_length=20,
        learning_rate=3e-3,
        normalize_observations=True,
        max_devices_per_host=1,
    )
    with adapter.device_put_replicated():
        apg.train(
            get_environment(adapter.ENV_NAME),
            network_factory=functools.partial(
                networks.make_apg_networks, hidden_layer_sizes=(64, 64)
            ),
            progress_fn=lambda step, metrics: history.append(metrics),
            **(given | settings),
        )
    return history


if __name__ == "__main__":
    for metrics in main():
        print(metrics["eval/episode_reward"])
