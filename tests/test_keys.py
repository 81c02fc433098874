"""Every key of the config reference has an effect: it changes a program before it is compiled, or a
value that the training resolves; or it is refused, as without another key it has none."""

import contextlib
import functools
import re
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
import pytest
from rich.console import Console

from arms import ARM
from bounce_mjx.config.settings import merged
from bounce_mjx.config.validation import validate
from bounce_mjx.env.env import Env, State
from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.ppo import PPO
from bounce_mjx.physics import Control
from bounce_mjx.robot.model import fingerprint
from bounce_mjx.runs.config import TrainConfig, fields_of_training
from bounce_mjx.task.registry import find_task
from bounce_mjx.training.evaluators import Evaluators
from bounce_mjx.training.job import open_job
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import Term
from test_ppo import TwoStates

KEYS = fields_of_training(find_task("bounce").Config)

# Other values, where neither half of the default nor one more of it is one.
VALUES = {
    "task": "catch", "seed": 1, "num_devices": 1000, "screening_episodes": 16, "save_every": 256,
    "warm_start": "nowhere", "log_dir": "elsewhere", "eval_seed": 3,
    "env.mjcf": "nowhere.xml", "env.friction": 0.2, "env.ball_inertia": 0.5, "env.num_balls": 2,
    "env.default_joint_angles": [0.1, 0.7, 1.9, 0.0, -1.0, 0.0], "env.ball_init_pos": [0.5, 0, 0.4],
    "env.target_height_range": [0.4, 0.5], "env.control_dt": 0.02,
    "env.robot.site": "nowhere", "env.robot.joints": ["Joint1"],
    "env.robot.paddle.quaternion": [1, 0, 0, 0], "env.robot.ball.mass": 0.003,
    "env.robot.ball.radius": 0.02, "env.robot.servo_stiffness": [100.0] * 6,
    "env.robot.servo_damping": [10.0] * 6, "env.robot.servo_force_limit": [10.0] * 6,
    "env.robot.limits.velocity": [2.0] * 6, "env.robot.limits.acceleration": [30.0] * 6,
    "env.robot.limits.jerk": [9000.0] * 6, "env.robot.limits.torque": [20.0] * 6,
    "env.randomization.shares": {"restitution": 0.5}, "env.randomization.warmup_steps": 1000,
    "env.reward.target_y": 0.1, "ppo.training_episode_seconds": 3.0, "ppo.entropy_cost": 0.01,
    "ppo.critic_metrics": ["ball_xy_error"], "ppo.hidden_layers": [8], "ppo.critic_layers": [8],
    "algorithm": "own",
    "ppo.min_learning_rate": 2e-5, "env.randomization.camera_rate": [60, 90],
    "env.randomization.ball_start": [0.0, 0.05], "env.randomization.joint_start": [-0.05, 0.05],
    "env.randomization.goal_interval": [1, 2], "env.physics": "mjx", "ppo.decay_steps": 1000,
}  # fmt: skip

# Keys that are refused alone, and the settings with which each has an effect; None where the
# refusal is all that this test can see, as its value names what there is not.
LIMITS = {"velocity": [1.0] * 6, "acceleration": [20.0] * 6, "jerk": [8000.0] * 6}
WITH_LIMITS = {"robot": {"limits": LIMITS}, "action": {"base": "target"}}
SERVOS = {
    "servo_stiffness": [500.0] * 6, "servo_damping": [5.0] * 6, "servo_force_limit": [50.0] * 6,
}  # fmt: skip
ADOPTED = {
    "mjcf": "arm.xml", "default_joint_angles": [0.0] * 6, "robot": {"site": "tool"} | SERVOS,
    "ball_init_pos": [0.0, 0.0, 5.0], "target_height_range": [5.0, 6.0],
}  # fmt: skip
FOR_ANY_ROBOT = ("env.robot.limits.", "env.robot.gravity_compensation")
OF_SITE = [k for k in KEYS if k.startswith("env.robot.") and not k.startswith(FOR_ANY_ROBOT)]
VARIED = {"restitution": [0.8, 0.9]}
NEEDED = {
    "env.action.max_lead": {"action": {"base": "target"}},
    "env.observation.servo_lead": {"action": {"base": "target"}},
    "env.randomization.first_goal_range": {"randomization": VARIED | {"warmup_steps": 1000}},
    "env.randomization.warmup_steps": {"randomization": VARIED},
    "env.randomization.push_interval": {"randomization": {"push_speed": [0.1, 0.1]}},
    **{f"env.robot.limits.{name}": WITH_LIMITS for name in LIMITS},
    **dict.fromkeys(OF_SITE, ADOPTED),
    **dict.fromkeys(("num_devices", "warm_start", "env.mjcf", "env.num_balls", "algorithm"), None),
    **dict.fromkeys(("env.robot.site", "env.robot.joints"), None),
}
# Keys that describe others, and have an effect with them alone.
WITH = {
    "env.randomization.share": {"randomization": VARIED},
    "env.randomization.shares": {"randomization": VARIED},
}


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


def settings(key: str, value: Any) -> dict[str, Any]:
    for name in reversed(key.split(".")):
        value = {name: value}
    return value


def text(program: jax.stages.Traced) -> tuple:
    """A traced program with its constants."""
    constants = [np.asarray(x).tobytes() for x in program.jaxpr.consts]
    return re.sub(r" at 0x[0-9a-f]+", "", str(program.jaxpr)), constants


def of_model(config: TrainConfig) -> tuple:
    env = Env(config.env)
    numbers = env.config.num_substeps, env.config.episode_steps, env.warmup_steps
    return env.engine.name, env.mj_model.opt.timestep, fingerprint(env.mj_model), numbers


def of_reset(config: TrainConfig) -> tuple:
    return text(_reset(config.env))


def _reset(config: WorldConfig) -> jax.stages.Traced:
    return jax.jit(Env(config).reset).trace(jax.ShapeDtypeStruct((2,), "uint32"))


# States after a reset, by the config without the reward.
STATES: dict[str, State] = {}


def of_step(config: TrainConfig) -> tuple:
    """The program of a step but for the engine's."""
    env = Env(config.env)
    key = config.env.model_dump_json(exclude={"reward"})
    state = STATES.setdefault(key, STATES.get(key) or _reset(config.env).out_info)

    def step(state: State, action: jax.Array) -> tuple[Control, State]:
        control, actuation = env.control(state.pipeline_state, action)
        return control, env.finish_step(state, action, actuation, state.pipeline_state.physics)

    action = jax.ShapeDtypeStruct((env.action_size,), "float32")
    return text(jax.jit(step).trace(state, action))


def of_learning(config: TrainConfig) -> tuple:
    """The program of an iteration in a small environment, and the time limit."""
    small = {"num_envs": 16, "rollout_length": 2, "num_minibatches": 2, "hidden_layers": (16,)}
    changed = {name: x for name, x in config.ppo if x != getattr(PPOConfig(), name)}
    # A batch stays divisible.
    small |= {name: 2 * small[name] for name in changed if name in small}
    ppo = config.ppo.model_copy(update=small)
    trainer = PPO(ppo, TwoStates(1.0), episode_steps=1000)
    program = jax.jit(lambda key: trainer.run(trainer.init(key), 1)).trace(jax.random.key(0))
    return text(program), config.training_episode_steps


def of_run(config: TrainConfig) -> tuple:
    """What a run resolves: its blocks, evaluations, seeds and folder."""
    blocks, measured = [], []
    with contextlib.ExitStack() as stack, pytest.MonkeyPatch.context() as patch:
        job = open_job(config, Console(quiet=True), stack)
        # As if all results were met: then `stop_when_solved` ends it before the first block.
        patch.setattr("bounce_mjx.training.job.all_may_end", lambda seeds: True)
        while not job.ends_here():
            blocks.append(job.steps)
            job.steps += job.steps_per_block
        nothing = types.SimpleNamespace(compile=lambda: None)
        patch.setattr(Evaluators, "_lower", lambda _: nothing)
        patch.setattr(Evaluators, "_run", lambda *given: measured.append(given[2]))
        patch.setattr(Evaluators, "_judge", lambda *_: None)
        evaluators = Evaluators(config, job.env, job.trainer.mesh, job.pool)
        evaluators.final(None)
        seeds, task = str(job.trainer._seeds), type(job.env.task).__name__
    steps = job.eval_steps, job.save_steps, config.keep_checkpoints
    return blocks, steps, evaluators._chunk, measured, seeds, job.run.parent, task


# What a key that begins so may change, the cheapest first.
PARTS = {"env.physics": [of_model], "env.robot.": [of_model], "env.reward.": [of_step]}
PARTS |= {"env.": [of_model, of_reset, of_step], "ppo.": [of_learning], "": [of_run]}
PARTS["env.robot.limits"] = PARTS["env."]


@functools.cache
def resolved(of_part: Callable, values: str) -> tuple:
    """Programs and values of a config from its settings, which are Python's text."""
    return of_part(validate(TrainConfig, eval(values), "my.yaml"))


@pytest.fixture(autouse=True, scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory):
    with contextlib.chdir(tmp_path_factory.mktemp("keys")):
        Path("arm.xml").write_text(ARM)
        yield


@pytest.mark.parametrize("kind", [of_reset, of_step, of_learning, of_run])
def test_equal_settings_have_equal_programs(kind: Callable) -> None:
    assert kind(TrainConfig()) == kind(TrainConfig())


@pytest.mark.slow
@pytest.mark.parametrize("key", KEYS)
def test_a_key_has_an_effect_or_is_refused(key: str) -> None:
    part, changed = max(filter(key.startswith, PARTS), key=len), settings(key, other(key))
    if key in NEEDED:
        with pytest.raises(UserError):
            for of_part in PARTS[part]:
                resolved(of_part, repr(changed))
    context = {"env": NEEDED.get(key) or WITH.get(key, {})}
    if NEEDED.get(key, {}) is not None:
        both = repr(context), repr(merged(context, changed))
        assert any(resolved(f, both[0]) != resolved(f, both[1]) for f in PARTS[part])
