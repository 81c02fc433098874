"""The fused engine moves arms of 3, 5 and 7 joints with every feature that it has as C does."""

from typing import NamedTuple

import jax
import mujoco
import numpy as np
import pytest

import random_arms
from against_c import (
    CEngine,
    States,
    assert_same_step,
    c_models,
    c_steps,
    difference,
    fused_steps,
    num_contacts,
)
from bounce_mjx.physics import Control, PhysicsParameters, PhysicsState, make_engine
from bounce_mjx.robot.model import Addresses, find_addresses
from random_arms import random_arm
from random_worlds import random_parameters

COUNT = 8
CONTROL_STEPS, STEPS_OF_A_BALL, NUM_SUBSTEPS = 200, 20, 10
# Number of joints and seed.
ARMS = ((3, 0), pytest.param((5, 1), marks=pytest.mark.slow), (7, 2))


class Arm(NamedTuple):
    model: mujoco.MjModel
    at: Addresses


@pytest.fixture(scope="module", params=ARMS, ids=lambda arm: f"{arm[0]} joints")
def arm(request) -> Arm:
    model = random_arm(*request.param)
    return Arm(model, find_addresses(model))


def targets(arm: Arm, rng: np.random.Generator, count: int) -> np.ndarray:
    """Servo targets [count, n] around the reference pose, where the paddle is level."""
    model, at = arm
    joints = model.qpos0[at.arm_qpos,] + rng.uniform(-0.06, 0.06, (count, len(at.arm_qpos)))
    ctrl = np.zeros((count, model.nu))
    ctrl[:, at.actuators] = joints * model.actuator_gear[at.actuators, 0]
    return ctrl


def place_ball(arm: Arm, qpos: np.ndarray, local: np.ndarray) -> None:
    """Puts the ball's centre at a position in the paddle's frame, in place."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(arm.model, data)
    paddle = data.geom("blocker")
    qpos[arm.at.balls[0].qpos[:3],] = paddle.xpos + paddle.xmat.reshape(3, 3) @ local


@pytest.mark.slow
def test_2000_steps_of_any_arm_are_mujocos(arm, float64):
    """Both engines run freely; neither sees the other's state. Some servos, joints and targets are
    at their limits, and some are not."""
    model, at = arm
    rng = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (COUNT, 1))
    qvel = rng.uniform(-0.5, 0.5, (COUNT, model.nv))
    state = PhysicsState(qpos, qvel)
    reference = CEngine(model, state)
    engine = make_engine(model, "fused")
    step = jax.jit(
        jax.vmap(lambda s, u: engine.step(PhysicsParameters(), s, Control(u), NUM_SUBSTEPS))
    )
    contacts, error = 0, 0.0
    at_limit: dict[str, list[np.ndarray]] = {"servo": [], "joint": []}
    for i in range(CONTROL_STEPS):
        # Each bounce amplifies rounding errors, even between two runs of MuJoCo.
        if i % STEPS_OF_A_BALL == 0:
            state = PhysicsState(*(np.array(x) for x in state[:2]))
            for data, qpos, qvel in zip(reference.data, *state[:2], strict=True):
                above = np.array([*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.03, 0.06)])
                place_ball(arm, data.qpos, above)
                spin = rng.uniform(-1.0, 0.0), *rng.uniform(-30.0, 30.0, 3)
                data.qvel[at.balls[0].qvel,] = [0.0, 0.0, *spin]
                qpos[at.balls[0].qpos,] = data.qpos[at.balls[0].qpos,]
                qvel[at.balls[0].qvel,] = data.qvel[at.balls[0].qvel,]
        ctrl = targets(arm, rng, COUNT)
        state = step(state, ctrl)
        contacts += reference.step(ctrl, NUM_SUBSTEPS)
        error = max(error, *difference(state, reference.state))
        for name, forces, ranges in (
            ("servo", "actuator_force", model.actuator_forcerange),
            ("joint", "qfrc_actuator", model.jnt_actfrcrange[at.arm_joints,]),
        ):
            force = np.array([getattr(data, forces)[: len(ranges)] for data in reference.data])
            at_limit[name].append((force[..., None] == ranges).any(-1))
    limited = {name: np.mean(limits) for name, limits in at_limit.items()}
    assert contacts >= 200
    assert all(0.02 < share < 0.8 for share in limited.values())
    assert error < 1e-9


def test_one_step_of_any_arm_in_random_worlds_is_mujocos(arm, float64):
    """As the model is and with all parameters given; links and paddle have welded bodies."""
    model, at = arm
    count, rng = 32, np.random.default_rng(1)
    qpos = np.tile(model.qpos0, (count, 1))
    qpos[:, at.arm_qpos] += rng.uniform(-2.0, 2.0, (count, len(at.arm_qpos)))
    qvel = rng.uniform(-5.0, 5.0, (count, model.nv))
    for row in qpos:
        place_ball(
            arm,
            row,
            rng.uniform(-1.0, 1.0, 3)
            * (np.array(random_arms.HALF_SIZE) + 0.7 * random_arms.RADIUS),
        )
    ctrl = qpos[:, at.arm_qpos] * model.actuator_gear[:, 0] + rng.uniform(-0.1, 0.1, (count, 1))
    states = States(qpos, qvel, ctrl)
    for parameters in (PhysicsParameters(), random_parameters(model, count, seed=2)):
        expected, forces = c_steps(c_models(model, parameters, count), states)
        assert num_contacts(forces) >= count // 2
        assert_same_step(fused_steps(model, parameters, states), expected)
