"""Settings of the trainer."""

from typing import Annotated, Literal

import pydantic
from pydantic import Field

from bounce_mjx.config import settings
from bounce_mjx.errors import UserError

PPO_NAME = "ppo"
"""Name of the algorithm of this package."""
NETWORK_KEYS = ("hidden_layers", "critic_layers", "shared_critic", "activation")
"""Settings that shape the networks."""


class PPOConfig(settings.StrictModel):
    """Proximal policy optimisation (Schulman et al. 2017) with a KL-adaptive learning rate."""

    num_envs: settings.Count = 4096
    """Environments that run in parallel."""
    rollout_length: settings.Count = 32
    """Control steps of each environment in one iteration."""
    training_episode_seconds: settings.Duration | None = None
    """Time limit of training episodes, s; null for the environment's limit. A shorter one shows
    more resets and worlds; a time-out is bootstrapped."""
    num_epochs: settings.Count = 4
    """Passes over the data of one iteration."""
    num_minibatches: settings.Count = 8
    """Minibatches in one epoch; must divide num_envs * rollout_length."""
    learning_rate: settings.Positive = 3e-4
    """Learning rate at the start, within its limits."""
    min_learning_rate: settings.Positive = 1e-5
    """Lower limit of the learning rate that adapts."""
    max_learning_rate: settings.Positive = 3e-3
    """Upper limit of the learning rate at the start of training."""
    final_max_learning_rate: settings.Positive = 1e-4
    """Upper limit of the learning rate from decay_steps on."""
    decay_steps: settings.Steps = 20_000_000
    """Environment steps over which the upper limit decays exponentially."""
    target_kl: settings.NonNegative = 0.01
    """Target KL divergence of the policy from that of the rollout, to which the learning rate
    adapts after each minibatch; 0 keeps the rate constant, also outside its limits."""
    discount: settings.UnitInterval = 0.98
    """Discount factor of a control step."""
    gae_lambda: settings.UnitInterval = 0.95
    """Lambda of the generalised advantage estimation."""
    clip_epsilon: settings.Positive = 0.2
    """Clipping range of the probability ratio."""
    entropy_cost: settings.NonNegative = 0.0
    """Weight of the entropy bonus."""
    value_cost: settings.NonNegative = 0.5
    """Weight of the squared value error."""
    max_grad_norm: settings.Positive = 1.0
    """Global norm to which a gradient is clipped."""
    reward_scale: settings.Positive = 0.1
    """Factor by which the trainer scales the reward."""
    init_noise_std: settings.Positive = 0.4
    """Standard deviation of the action noise at the start."""
    mean_noise_bound: settings.NonNegative = 0.0
    """Mean lower bound of that standard deviation: each environment has a bound of its own, evenly
    from 0 to twice this; 0 for none. Without it a long training forgets how to recover."""
    hidden_layers: Annotated[tuple[settings.Count, ...], Field(min_length=1)] = (128, 128)
    """Widths of the hidden layers of the policy, and of the value network by default."""
    critic_layers: Annotated[tuple[settings.Count, ...], Field(min_length=1)] | None = None
    """Widths of the hidden layers of the value network; null for those of the policy, or for none
    on top of a shared part."""
    shared_critic: bool = False
    """The value network starts from the last hidden layer of the policy, which both train."""
    activation: Literal["silu", "relu", "tanh", "elu"] = "silu"
    """Activation of the hidden layers."""
    compute_dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the hidden layers during training; bfloat16 is faster on a GPU. The rest is
    float32."""
    critic_metrics: tuple[str, ...] | None = None
    """Metrics of the environment that the value network sees too; null for those that the task
    names."""

    @pydantic.model_validator(mode="after")
    def _check_batch_and_learning_rates(self):
        if self.min_learning_rate > min(self.max_learning_rate, self.final_max_learning_rate):
            raise ValueError(
                f"min_learning_rate {self.min_learning_rate} is above the upper limits "
                f"max_learning_rate {self.max_learning_rate} and final_max_learning_rate "
                f"{self.final_max_learning_rate}; lower it"
            )
        adapts = self.target_kl > 0.0
        if adapts and not self.min_learning_rate <= self.learning_rate <= self.max_learning_rate:
            raise ValueError(
                f"learning_rate {self.learning_rate} is not within min_learning_rate "
                f"{self.min_learning_rate} and max_learning_rate {self.max_learning_rate}, which "
                "limit it after the first minibatch; change one of them, or set target_kl to 0"
            )
        batch = self.num_envs * self.rollout_length
        if batch % self.num_minibatches:
            raise ValueError(
                f"num_minibatches {self.num_minibatches} does not divide the batch of "
                f"{batch} samples (num_envs {self.num_envs} * rollout_length "
                f"{self.rollout_length}); choose a divisor of {batch}"
            )
        return self

    def check_rollout(self, episode_steps: int) -> None:
        """Checks the rollout against the control steps after which an episode is truncated.

        Raises:
          UserError: a rollout is longer than an episode.
        """
        if self.rollout_length > episode_steps:
            raise UserError(
                f"rollout_length {self.rollout_length} is longer than an episode of "
                f"{episode_steps} control steps; choose a shorter rollout or longer episodes"
            )

    @property
    def batch_steps(self) -> int:
        """Environment steps in one iteration."""
        return self.num_envs * self.rollout_length
