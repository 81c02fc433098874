"""The fused engine moves arms of 3, 5 and 7 joints with every feature that it has as C does."""

from typing import NamedTuple

import mujoco
import numpy as np
import pytest

import random_arms
from against_c import (
    States,
    assert_same_step,
    c_models,
    c_steps,
    free_run,
    fused_steps,
    num_contacts,
    paddle_frame,
)
from bounce_mjx.physics import PhysicsParameters, PhysicsState
from bounce_mjx.robot.model import Addresses, find_addresses
from random_arms import random_arm
from random_worlds import random_parameters

# Number of joints and seed.
ARMS = ((3, 0), pytest.param((5, 1), marks=pytest.mark.slow), (7, 2))


class Arm(NamedTuple):
    model: mujoco.MjModel
    at: Addresses


@pytest.fixture(scope="module", params=ARMS, ids=lambda arm: f"{arm[0]} joints")
def arm(request) -> Arm:
    model = random_arm(*request.param)
    return Arm(model, find_addresses(model))


@pytest.mark.slow
def test_2000_steps_of_any_arm_are_mujocos(arm, float64):
    """Around the reference pose, where the paddle is level. Some servos, joints and targets are at
    their limits, and some are not."""
    model, at = arm
    count, rng = 8, np.random.default_rng(0)
    qvel = rng.uniform(-0.5, 0.5, (count, model.nv))
    start = PhysicsState(np.tile(model.qpos0, (count, 1)), qvel)
    ranges = model.actuator_forcerange, model.jnt_actfrcrange[at.arm_joints,]

    def ctrl(_: np.ndarray, action: np.ndarray) -> np.ndarray:
        targets = np.zeros((count, model.nu))
        joints = model.qpos0[at.arm_qpos,] + 0.06 * action
        targets[:, at.actuators] = joints * model.actuator_gear[at.actuators, 0]
        return targets

    def look(data: mujoco.MjData) -> dict[str, float]:
        forces = data.actuator_force, data.qfrc_actuator[at.arm_qvel,]
        servo, joint = (np.mean(f[:, None] == r) for f, r in zip(forces, ranges, strict=True))
        return {"servo": servo, "joint": joint}

    errors, contacts, seen = free_run(
        model, [model] * count, PhysicsParameters(), start, rng, look, ctrl, 20
    )
    assert contacts >= 200
    assert 0.02 < seen["servo"] < 0.4 and 0.02 < seen["joint"] < 0.4
    assert np.max(errors) < 1e-9


def test_one_step_of_any_arm_in_random_worlds_is_mujocos(arm, float64):
    """As the model is and with all parameters given; links and paddle have welded bodies."""
    model, at = arm
    count, rng = 32, np.random.default_rng(1)
    qpos = np.tile(model.qpos0, (count, 1))
    qpos[:, at.arm_qpos] += rng.uniform(-2.0, 2.0, (count, len(at.arm_qpos)))
    qvel = rng.uniform(-5.0, 5.0, (count, model.nv))
    size = np.array(random_arms.HALF_SIZE) + 0.7 * random_arms.RADIUS
    for row in qpos:
        centre, axes = paddle_frame(model, row[at.arm_qpos,])
        row[at.balls[0].qpos[:3],] = centre + axes @ (rng.uniform(-1.0, 1.0, 3) * size)
    ctrl = qpos[:, at.arm_qpos] * model.actuator_gear[:, 0] + rng.uniform(-0.1, 0.1, (count, 1))
    states = States(qpos, qvel, ctrl)
    for parameters in (PhysicsParameters(), random_parameters(model, count, seed=2)):
        expected, forces = c_steps(c_models(model, parameters, count), states)
        assert num_contacts(forces) >= count // 2
        assert_same_step(fused_steps(model, parameters, states), expected)
