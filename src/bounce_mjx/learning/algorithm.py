"""What an algorithm is to a training: its settings, and what trains with them."""

from typing import Any, ClassVar

from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig


class Algorithm:
    """Base of every algorithm: of `PPO`, and of a user's own that is no `PPO`, such as SAC or that
    of another library. Once its module is imported, `--algorithm NAME` trains with it: the job
    evaluates, saves, resumes and reports as it does for PPO. Such a class has a `Config` and
    `make_trainer`; a subclass of `PPO` needs neither. A library's training that is one loop, such
    as brax's `ppo.train`, has to be divided into blocks, and its network given as a `Policy`; no
    adapter of this package does that. (docs/algorithms.md)
    """

    Config: ClassVar[type[PPOConfig]] = PPOConfig
    """Type of the settings, which are the group `ppo` of the training's config whatever the
    algorithm: those of PPO, as they describe the network of every policy and the presets have them,
    and more. Its property `batch_steps` is the environment steps of an iteration, of PPO `num_envs`
    times `rollout_length`; an algorithm with others overrides it."""

    @classmethod
    def make_trainer(cls, config: Any, env: Any) -> Any:
        """What trains: a `training.trainer.Trainer`, whose docstring says what the job calls. Of
        `PPO` and its subclasses alone it is None: `job.trainer_of` then makes a `PPOTrainer`.

        Args:
          config: of the run, a `runs.config.TrainConfig`; its `ppo` is of this class's `Config`.
          env: one environment, an `env.env.Env`, of which the trainer steps as many as it likes
            (`env/vector.py`).

        Raises:
          UserError: the class has none, or the config does not fit.
        """
        raise UserError(
            f"the algorithm {cls.__name__} has no make_trainer(config, env), which returns a "
            "bounce_mjx.training.trainer.Trainer; write one, or extend PPO"
        )
