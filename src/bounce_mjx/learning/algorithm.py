"""What an algorithm is to a training: its settings, and what trains with them."""

from typing import Any, ClassVar

from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig


class Algorithm:
    """Base of every algorithm: of `PPO`, and of a user's own that is no `PPO`, such as SAC or that
    of another library. Once its module is imported, `--algorithm NAME` trains with it: the job
    evaluates, saves, resumes and reports as it does for PPO."""

    Config: ClassVar[type[PPOConfig]] = PPOConfig
    """Type of the settings: those of PPO, which describe the policy's network, and more; its
    `batch_steps` are the environment steps of an iteration."""

    @classmethod
    def make_trainer(cls, config: Any, env: Any) -> Any:
        """What trains: a `training.trainer.Trainer`, or None for the trainer of `PPO`.

        Args:
          config: of the run, a `TrainConfig`.
          env: one environment, an `Env`.

        Raises:
          UserError: the class has none.
        """
        raise UserError(
            f"the algorithm {cls.__name__} has no make_trainer(config, env), which returns a "
            "bounce_mjx.training.trainer.Trainer; write one, or extend PPO"
        )
