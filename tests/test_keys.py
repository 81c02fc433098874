"""Every key of the environment and of PPO has an effect: it changes a program before it is
compiled, or it is refused, as without another key it has none."""

import functools
import re
from typing import Any, get_args

import jax
import numpy as np
import pytest

from bounce_mjx.config.settings import StrictModel, merged
from bounce_mjx.config.validation import validate
from bounce_mjx.env.env import Env, State
from bounce_mjx.errors import UserError
from bounce_mjx.learning.ppo import PPO
from bounce_mjx.physics import Control
from bounce_mjx.robot.model import fingerprint
from bounce_mjx.runs.config import TrainConfig, train_config
from bounce_mjx.tasks.registry import find_task
from bounce_mjx.training.ppo_trainer import episode_steps
from bounce_mjx.world.randomization import Term
from test_ppo import TwoStates

CONFIG = train_config(find_task("bounce"))


def keys(group: type[StrictModel], prefix: str = "") -> dict[str, Any]:
    """The fields of a config by their dotted keys."""
    found = {}
    for name, field in group.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, StrictModel):
            found |= keys(field.annotation, f"{prefix}{name}.")
        else:
            found[prefix + name] = field
    return found


# Tests of the robot and of several balls have the other keys.
ELSEWHERE = "env.robot.", "env.mjcf", "env.num_balls"
KEYS = {k: v for k, v in keys(CONFIG).items() if re.match("env|ppo", k)}
KEYS = {k: v for k, v in KEYS.items() if not k.startswith(ELSEWHERE)}

# Other values, where neither half of the default nor one more of it is one.
VALUES = {
    "env.friction": 0.2, "env.default_joint_angles": [0.1, 0.7, 1.9, 0.0, -1.0, 0.0],
    "env.ball_init_pos": [0.5, 0, 0.4], "env.target_height_range": [0.4, 0.5],
    "env.control_dt": 0.02, "env.randomization.shares": {"restitution": 0.5},
    "env.randomization.warmup_steps": 1000, "env.randomization.camera_rate": [60, 90],
    "env.randomization.command_interval": [1, 2], "env.physics": "mjx",
    "env.reward.target_y": 0.1, "ppo.training_episode_seconds": 3.0, "ppo.entropy_cost": 0.01,
    "ppo.critic_metrics": ["ball_xy_error"], "ppo.hidden_layers": [8], "ppo.critic_layers": [8],
    "ppo.min_learning_rate": 2e-5, "ppo.decay_steps": 1000,
}  # fmt: skip

# Keys that are refused alone, and the settings with which each has an effect.
RESTITUTION = {"randomization": {"restitution": [0.8, 0.9]}}
NEEDED = {
    "env.action.max_lead": {"action": {"base": "target"}},
    "env.observation.servo_lead": {"action": {"base": "target"}},
    "env.randomization.first_command_range": {"randomization": {"warmup_steps": 1000}},
    "env.randomization.push_interval": {"randomization": {"push_speed": [0.1, 0.1]}},
    "env.randomization.restitution_slope": RESTITUTION,
}
# Keys that describe others, and have an effect with them alone.
WITH = {"env.randomization.share": RESTITUTION, "env.randomization.shares": RESTITUTION}


def other(key: str) -> Any:
    """Another value of a key than its default."""
    field, value = KEYS[key], KEYS[key].default
    if key in VALUES:
        return VALUES[key]
    for term in (mark for mark in field.metadata if isinstance(mark, Term)):
        low, high = max(term.bounds[0], -0.1), min(term.bounds[1], 0.9)
        return [0.5 * (low + high), high]
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return next(x for x in reversed(get_args(field.annotation)) if x != value)
    if isinstance(value, tuple):
        return [0.5 * x for x in value]
    if isinstance(value, int):
        return value + 1 if value < 2 else 2 * value
    return 0.5 * value or 0.01


def text(program: jax.stages.Traced) -> tuple:
    """A traced program with its constants."""
    constants = [np.asarray(x).tobytes() for x in program.jaxpr.consts]
    return re.sub(r" at 0x[0-9a-f]+", "", str(program.jaxpr)), constants


def of_environment(config: TrainConfig) -> tuple:
    """The programs of a reset and of a step but for the engine's, and the engine's settings."""
    env = Env(config.env)
    reset = _reset(env)
    numbers = env.config.num_substeps, env.config.episode_steps, env.warmup_steps
    engine = env.engine.name, env.mj_model.opt.timestep, fingerprint(env.mj_model)
    return text(reset), _step(env, reset.out_info), numbers, engine


def of_step(config: TrainConfig) -> tuple:
    """The program of a step alone, from the state of the default environment."""
    return _step(Env(config.env), _default_state())


@functools.cache
def _default_state() -> State:
    return _reset(Env(CONFIG().env)).out_info


def _reset(env: Env) -> jax.stages.Traced:
    return jax.jit(env.reset).trace(jax.ShapeDtypeStruct((2,), "uint32"))


def _step(env: Env, state: State) -> tuple:
    def step(state: State, action: jax.Array) -> tuple[Control, State]:
        control, actuation = env.control(state.pipeline_state, action)
        return control, env.finish_step(state, action, actuation, state.pipeline_state.physics)

    action = jax.ShapeDtypeStruct((env.action_size,), "float32")
    return text(jax.jit(step).trace(state, action))


def of_learning(config: TrainConfig) -> tuple:
    """The program of an iteration in a small environment, and the time limit."""
    small = {"num_envs": 16, "rollout_length": 2, "num_minibatches": 2, "hidden_layers": (16,)}
    changed = {name: x for name, x in config.ppo if x != getattr(CONFIG().ppo, name)}
    # A batch stays divisible.
    small |= {name: 2 * small[name] for name in changed if name in small}
    ppo = config.ppo.model_copy(update=small)
    trainer = PPO(ppo, TwoStates(1.0), episode_steps=1000)
    program = jax.jit(lambda key: trainer.run(trainer.init(key), 1)).trace(jax.random.key(0))
    return text(program), episode_steps(config)


PARTS = {"env.reward.": of_step, "env.": of_environment, "ppo.": of_learning}


@functools.cache
def resolved(part: str, values: str) -> tuple:
    """The programs that a key changes, where `part` is its start, and `values` are the settings as
    Python's text."""
    return PARTS[part](validate(CONFIG, eval(values), "my.yaml"))


@pytest.mark.slow
@pytest.mark.parametrize("key", KEYS)
def test_a_key_has_an_effect_or_is_refused(key: str) -> None:
    part, changed = max(filter(key.startswith, PARTS), key=len), other(key)
    for name in reversed(key.split(".")):
        changed = {name: changed}
    if key in NEEDED:
        with pytest.raises(UserError):
            resolved(part, repr(changed))
    context = {"env": NEEDED.get(key) or WITH.get(key, {})}
    before, after = (resolved(part, repr(x)) for x in (context, merged(context, changed)))
    assert before != after
