"""PPO with a loss term of one's own: close observations have close actions (CAPS, Mysore 2021).

`bounce-mjx train --import examples/smooth_ppo.py --algorithm smoothppo --smoothness-cost 0.02`
"""

import jax
import jax.numpy as jnp

from bounce_mjx.config.settings import NonNegative
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.metrics import Metrics
from bounce_mjx.learning.ppo import PPO, Params, Samples

INPUT_NOISE = 0.05
"""Noise of the inputs, in their standard deviations."""


class SmoothConfig(PPOConfig):
    """PPO's settings, and that of the new term; it is a key of the config and a flag."""

    smoothness_cost: NonNegative = 0.02
    """Weight of the squared change of the mean action under small noise of its inputs."""


class SmoothPPO(PPO):
    """Any other method of `PPO` may be changed alike, such as `advantages` or `make_networks`."""

    Config = SmoothConfig

    def loss(self, params: Params, samples: Samples) -> tuple[jax.Array, Metrics]:
        """PPO's loss and the new term, on a minibatch of samples [S, ...]."""
        ppo_loss, metrics = super().loss(params, samples)
        smoothness_loss = self.action_change(params, samples)
        loss = ppo_loss + self.config.smoothness_cost * smoothness_loss
        return loss, metrics | {"loss/smoothness": smoothness_loss}

    def action_change(self, params: Params, samples: Samples) -> jax.Array:
        """Mean squared change of the mean action under noise of its inputs []."""
        # A minibatch has other samples each time, so the same noise for all of them will do.
        noise = jax.random.normal(jax.random.key(0), samples.inputs.shape)
        noisy_inputs = samples.inputs + INPUT_NOISE * noise
        action = self.distribution(params, samples.inputs, samples.noise_bound).mean
        noisy_action = self.distribution(params, noisy_inputs, samples.noise_bound).mean
        return jnp.mean(jnp.sum(jnp.square(noisy_action - action), axis=-1))
