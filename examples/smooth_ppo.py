"""PPO with a loss term of one's own: close observations have close actions (CAPS, Mysore 2021).

`bounce-mjx train --algorithm examples/smooth_ppo.py:SmoothPPO --smoothness-cost 0.02`
"""

import jax
import jax.numpy as jnp

from bounce_mjx.config.settings import NonNegative
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.metrics import Metrics
from bounce_mjx.learning.ppo import PPO, Params, Samples


class SmoothConfig(PPOConfig):
    """PPO's settings, and that of the new term; it is a key of the config and a flag."""

    smoothness_cost: NonNegative = 0.02
    """Weight of the squared change of the mean action under small noise of its inputs."""


class SmoothPPO(PPO):
    """Any other method of `PPO` may be changed alike, such as `advantages` or `make_networks`."""

    Config = SmoothConfig

    def loss(self, params: Params, samples: Samples) -> tuple[jax.Array, Metrics]:
        total, metrics = super().loss(params, samples)
        noise = 0.05 * jax.random.normal(jax.random.PRNGKey(0), samples.inputs.shape)
        near = self.distribution(params, samples.inputs + noise, samples.noise_bound).mean
        here = self.distribution(params, samples.inputs, samples.noise_bound).mean
        change = jnp.mean(jnp.sum(jnp.square(near - here), axis=-1))
        total += self.config.smoothness_cost * change
        return total, metrics | {"loss/smoothness": change}
