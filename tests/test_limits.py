"""Commands within an arm's limits are those of a simulation, late and lagged, on every engine."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.limits import limit_shares
from bounce_mjx.physics import servo_targets
from bounce_mjx.robot.config import LimitsConfig
from bounce_mjx.robot.setpoints import (
    JointLimits,
    Setpoint,
    joint_limits,
    next_setpoint,
    position_at,
)
from bounce_mjx.task.task import Recording

VELOCITY, ACCELERATION, JERK = 2.0, 15.0, 7500.0
LIMITS = {
    "velocity": (VELOCITY,) * 6,
    "acceleration": (ACCELERATION,) * 6,
    "jerk": (JERK,) * 6,
    "torque": (90.0,) * 6,
}
STEPS, SUBSTEPS = 300, 10


class Rollout(NamedTuple):
    env: BounceBall
    actions: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    """States before each step, and after the last [STEPS + 1, ...]."""
    commands: np.ndarray
    """Servo targets of every physics step [STEPS, SUBSTEPS, 6]."""


def rolled_out(smooth: bool, world: dict) -> Rollout:
    """Random actions, many of which push a joint for long; no episode ends."""
    limits = LIMITS | ({} if smooth else {"jerk": None})
    config = EnvConfig(
        robot={"limits": limits},
        action={"base": "target"},
        action_scale=0.04,
        max_joint_velocity=50.0,
        randomization=world,
    )
    rng = np.random.default_rng(0)
    pushes = np.repeat(rng.choice([-1.0, 0.0, 1.0], (STEPS // 10, 6)), 10, axis=0)
    actions = np.clip(pushes + rng.normal(0.0, 0.5, (STEPS, 6)), -1.0, 1.0)
    with jax.enable_x64(True):
        env = BounceBall(config)
        state = jax.jit(env.reset)(jax.random.PRNGKey(0))

        def step(state, action):
            now = state.pipeline_state
            control, actuation = env.control(now, action)
            physics = env.engine.step(now.parameters, now.physics, control, SUBSTEPS)
            after = env.finish_step(state, action, actuation, physics)
            physics = after.pipeline_state.physics
            return after, (servo_targets(control, SUBSTEPS), physics.qpos, physics.qvel)

        _, (commands, qpos, qvel) = jax.jit(lambda s, a: jax.lax.scan(step, s, a))(
            state, jnp.asarray(actions)
        )
        first = state.pipeline_state.physics
        qpos, qvel = (
            np.concatenate([np.asarray(start)[None], np.asarray(later)])
            for start, later in ((first.qpos, qpos), (first.qvel, qvel))
        )
        return Rollout(env, actions, qpos, qvel, np.asarray(commands))


LATE, LATER = {"action_latency": (0.017, 0.017)}, {"action_latency": (0.023, 0.023)}
WORLDS = {
    "late": (False, LATER),
    "late, smooth and lagged": (True, LATE | {"servo_lag": (0.008, 0.008)}),
}


@pytest.fixture(
    scope="module", params=[pytest.param(world, id=name) for name, world in WORLDS.items()]
)
def world(request: pytest.FixtureRequest) -> tuple:
    return *request.param, rolled_out(*request.param)


def test_no_command_leaves_the_limits(world: tuple) -> None:
    smooth, given, rollout = world
    rows = rollout.commands.reshape(-1, 6)
    ranges = rollout.env.mj_model.jnt_range[:6]
    assert np.all((rows >= ranges[:, 0] - 1e-12) & (rows <= ranges[:, 1] + 1e-12))
    assert np.abs(rows - np.repeat(rollout.qpos[:-1, :6], SUBSTEPS, axis=0)).max() < 0.2
    velocity = np.diff(rows, axis=0) * 1e3
    acceleration = np.diff(velocity, axis=0) * 1e3
    jerk = np.diff(acceleration, axis=0) * 1e3
    pairs = [(velocity, VELOCITY), (acceleration, ACCELERATION)]
    for values, limit in [*pairs, *([(jerk, JERK)] if smooth else [])]:
        assert np.abs(values).max() <= limit * (1.0 + 1e-6)
        assert np.abs(values).max() > (0.3 if "servo_lag" in given else 0.8) * limit


def test_commands_are_those_of_a_simulation(world: tuple) -> None:
    """Delayed by whole physics steps and filtered in steps of 10 microseconds, from the targets
    that follow from the measured angles."""
    smooth, given, rollout = world
    ranges = rollout.env.mj_model.jnt_range[:6]
    smoothing = 2.0 * ACCELERATION / JERK if smooth else None
    limits = JointLimits(VELOCITY, ACCELERATION, smoothing, tuple(ranges.T))
    angles = rollout.qpos[:, :6]
    start = Setpoint(np.clip(angles[0], *ranges.T), np.zeros(6), np.zeros(6))
    first, fine, rows = start.position, 100, []
    times = np.arange(1, SUBSTEPS * fine + 1)[:, None] / (1000 * fine)
    for angle, action in zip(angles, rollout.actions, strict=False):
        base = np.clip(start.position, angle - 0.15, angle + 0.15)
        target = np.clip(base + 0.04 * action, *ranges.T)
        after = next_setpoint(limits, start, target, 0.01, np)
        rows.append(position_at(start, after.acceleration, times, np, smoothing))
        start = after
    late = round(1e3 * given.get("action_latency", (0.0,))[0]) * fine
    expected = np.concatenate([np.tile(first, (late, 1)), *rows])[: len(rows) * len(times)]
    if "servo_lag" in given:
        share = 1.0 - np.exp(-1e-5 / given["servo_lag"][0])
        filtered, before = first, np.concatenate([first[None], expected[:-1]])
        # The mean over a short step.
        middle = 0.5 * (before + expected)
        for i, value in enumerate(middle):
            filtered = filtered + share * (value - filtered)
            expected[i] = filtered
    np.testing.assert_allclose(
        rollout.commands.reshape(-1, 6), expected[fine - 1 :: fine], rtol=0.0, atol=5e-9
    )


def test_the_engines_follow_the_commands_like_c(world: tuple) -> None:
    """The fused engine's states against MuJoCo's C engine with the commands of each physics step,
    and torques within the arm's limit."""
    rollout = world[-1]
    model = rollout.env.mj_model
    np.testing.assert_array_equal(model.actuator_forcerange, [[-90.0, 90.0]] * 6)
    data = mujoco.MjData(model)
    for i in range(0, STEPS, 7):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = rollout.qpos[i], rollout.qvel[i]
        for row in rollout.commands[i]:
            data.ctrl[:] = row
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.qpos[:6], rollout.qpos[i + 1, :6], atol=1e-8)


def test_a_command_without_a_range_moves_within_its_other_limits() -> None:
    limits = joint_limits(LimitsConfig(velocity=(2.0,), acceleration=(15.0,)))
    setpoint = Setpoint(np.zeros(1), np.zeros(1), np.zeros(1))
    velocities = []
    for _ in range(20):
        setpoint = next_setpoint(limits, setpoint, 1e3, 0.01, np)
        velocities.append(setpoint.velocity[0])
    np.testing.assert_allclose(velocities, np.minimum(0.15 * np.arange(1, 21), 2.0))


def test_an_action_adds_to_a_moving_command() -> None:
    with pytest.raises(UserError, match="set action.base to target"):
        validate(EnvConfig, {"robot": {"limits": LIMITS}}, "my.yaml")


@pytest.mark.parametrize(
    "limits, wrong",
    [
        ({"velocity": [1.0] * 6}, "velocity or acceleration is missing"),
        ({"jerk": [1.0] * 6}, "velocity or acceleration is missing"),
        ({"velocity": [1.0] * 6, "acceleration": [1.0] * 5}, "acceleration has 5 numbers"),
        ({"torque": [1.0] * 5}, "has 5 numbers"),
        (
            {"velocity": [1.0] * 6, "acceleration": [10.0] * 6, "jerk": [1000.0] * 6},
            "is too low: the acceleration cannot turn from 10",
        ),
    ],
)
def test_a_mistake_is_one_sentence(limits: dict, wrong: str) -> None:
    with pytest.raises(UserError, match=wrong) as caught:
        settings = {"robot": {"limits": limits}, "action": {"base": "target"}}
        validate(EnvConfig, settings, "my.yaml")
    assert "\n" not in str(caught.value)


def recorded(velocities: np.ndarray) -> Recording:
    """An episode with these velocities of the commands [T, 6], which ends five steps early."""
    running = np.arange(len(velocities))[:, None] < len(velocities) - 5
    empty = np.zeros((len(velocities), 3, 1))
    joint_angles = np.zeros((len(velocities), 6, 1))
    return Recording(
        joint_angles=joint_angles,
        ball=empty,
        paddle=empty,
        goal={},
        running=running,
        terminated=np.zeros_like(running),
        command_velocity=velocities[..., None],
    )


@pytest.mark.parametrize("smooth, rate", [(False, 1000), (True, 500)])
def test_shares_of_the_limits(smooth: bool, rate: int) -> None:
    """Full acceleration, then full speed, use the limits up; 10% more acceleration of a joint is
    seen."""
    config = EnvConfig(
        robot={"limits": LIMITS | ({} if smooth else {"jerk": None})}, action={"base": "target"}
    )
    full = np.minimum(0.01 * ACCELERATION * np.arange(1.0, 40.0), VELOCITY)
    velocities = np.tile(full[:, None], 6)
    shares = {x.quantity: x.share for x in limit_shares(config, recorded(velocities), rate)}
    assert shares.keys() == {"velocity", "acceleration", *(["jerk"] if smooth else [])}
    assert shares["velocity"] == pytest.approx(1.0, abs=1e-9)
    assert shares["acceleration"] == pytest.approx(1.0, abs=1e-9)
    if smooth:
        # The mean is over 4 ms, so a step of the acceleration has the jerk 15 / 0.004, half of the
        # limit. At 500 Hz, two of the three pieces of the difference's quadratic spline see it:
        # 1/6 and 2/3.
        assert shares["jerk"] == pytest.approx(0.5 * 5 / 6, abs=1e-6)
    hasty = velocities.copy()
    hasty[:, 3] = np.minimum(0.011 * ACCELERATION * np.arange(1.0, 40.0), VELOCITY)
    _, acceleration, *_ = limit_shares(config, recorded(hasty), rate)
    assert acceleration.share == pytest.approx(1.1, abs=1e-6) and acceleration.joint == 4
    # What follows the end of an episode does not count.
    late = velocities.copy()
    late[-5:] = 100.0
    assert limit_shares(config, recorded(late), rate)[0].share == pytest.approx(1.0)
