"""Every setting of PPO has an effect: it changes the program of a training."""

import re
from typing import Any, get_args

import jax
import numpy as np
import pytest

from bounce_mjx.config.validation import validate
from bounce_mjx.learning.ppo import PPO
from bounce_mjx.runs.config import TrainConfig, train_config
from bounce_mjx.tasks.registry import find_task
from bounce_mjx.training.ppo_trainer import episode_steps
from test_ppo import TwoStates

CONFIG = train_config(find_task("bounce"))
FIELDS = type(CONFIG().ppo).model_fields
SMALL = {"num_envs": 16, "rollout_length": 2, "num_minibatches": 2, "hidden_layers": (16,)}
# Other values, where neither half of the default nor one more of it is one.
VALUES = {
    "training_episode_seconds": 3.0, "entropy_cost": 0.01, "critic_metrics": ["ball_xy_error"],
    "hidden_layers": [8], "critic_layers": [8], "min_learning_rate": 2e-5, "decay_steps": 1000,
}  # fmt: skip


def other(key: str) -> Any:
    """Another value of a key than its default."""
    value = FIELDS[key].default
    if key in VALUES:
        return VALUES[key]
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return next(x for x in reversed(get_args(FIELDS[key].annotation)) if x != value)
    if isinstance(value, int):
        return value + 1 if value < 2 else 2 * value
    return 0.5 * value or 0.01


def program(config: TrainConfig) -> tuple:
    """The traced program of an iteration in a small environment, and the time limit."""
    changed = {name: x for name, x in config.ppo if x != getattr(CONFIG().ppo, name)}
    # A batch stays divisible.
    small = SMALL | {name: 2 * SMALL[name] for name in changed if name in SMALL}
    ppo = config.ppo.model_copy(update=small)
    trainer = PPO(ppo, TwoStates(1.0), episode_steps=1000)
    traced = jax.jit(lambda key: trainer.run(trainer.init(key), 1)).trace(jax.random.key(0))
    constants = [np.asarray(x).tobytes() for x in traced.jaxpr.consts]
    return re.sub(r" at 0x[0-9a-f]+", "", str(traced.jaxpr)), constants, episode_steps(config)


@pytest.fixture(scope="module")
def default() -> tuple:
    return program(CONFIG())


@pytest.mark.slow
@pytest.mark.parametrize("key", FIELDS)
def test_a_setting_of_ppo_has_an_effect(key: str, default: tuple) -> None:
    assert program(validate(CONFIG, {"ppo": {key: other(key)}}, "my.yaml")) != default
