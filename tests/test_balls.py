"""Several balls in the physics: fused against MuJoCo's C step and against MJX."""

import mujoco
import numpy as np
import pytest

from bounce_mjx.physics import fused
from bounce_mjx.robot.model import load_model
from test_friction import assert_same_step, c_steps, converged, fused_steps
from test_physics import MODEL, RADIUS, States, paddle_frame, random_states

COUNT = 1000


def balls_model(num_balls: int, cone: str = "pyramidal", friction: float | None = None):
    """Shipped model with several balls, and a C solver that converges to rounding error."""
    model = load_model(None, 0.001, num_balls=num_balls)
    model.opt.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone.upper()}")
    if friction is not None:
        model.pair_dim[:], model.pair_friction[:, :2] = 3, friction
    return converged(model)


def hostile_states(model: mujoco.MjModel, count: int, seed: int) -> States:
    """The first ball as in `random_states`. Each further ball overlaps with one before it or is
    close to it, in a random direction or along a face of the paddle, which both then touch; some of
    the balls are fast."""
    rng = np.random.default_rng(seed)
    num_balls = (model.nq - 6) // 7
    first, _ = random_states(load_model(None, 0.001), count, seed)
    qpos, qvel = np.zeros((count, model.nq)), np.zeros((count, model.nv))
    qpos[:, :13], qvel[:, :12] = first.qpos, first.qvel
    for i in range(count):
        _, axes = paddle_frame(model, qpos[i, :6])
        for ball in range(1, num_balls):
            direction = rng.normal(size=3)
            if rng.uniform() < 0.6:  # parallel to the face
                direction = axes @ (direction * [1.0, 1.0, 0.1])
            direction /= np.linalg.norm(direction)
            other = 6 + 7 * rng.integers(ball)
            distance = 2.0 * RADIUS * (1.0 + rng.choice([rng.uniform(-0.03, 0.01), -0.6]))
            at, speeds = 6 + 7 * ball, 6 + 6 * ball
            qpos[i, at : at + 3] = qpos[i, other : other + 3] + distance * direction
            quaternion = rng.normal(size=4)
            qpos[i, at + 3 : at + 7] = quaternion / np.linalg.norm(quaternion)
            qvel[i, speeds : speeds + 3] = rng.uniform(-3.0, 3.0, 3) * rng.choice([1.0, 10.0])
            qvel[i, speeds + 3 : speeds + 6] = rng.uniform(-30.0, 30.0, 3)
    return States(qpos, qvel, first.ctrl)


@pytest.mark.parametrize("num_balls", [2, 3])
@pytest.mark.usefixtures("float64")
def test_one_step_of_several_balls_is_mujocos(num_balls, record_property):
    model = balls_model(num_balls)
    assert fused.unsupported_feature(model) is None
    states = hostile_states(model, COUNT, seed=0)
    expected, _ = c_steps([model] * COUNT, states)
    error = assert_same_step(fused_steps(model, MODEL, states), expected)
    record_property("largest_difference", error)
    print(f"{num_balls} balls: {error:.1e} of the largest speed")


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("num_balls", [2])
@pytest.mark.usefixtures("float64")
def test_one_step_of_several_balls_with_friction_is_mujocos(num_balls, cone, record_property):
    model = balls_model(num_balls, cone, 0.3)
    states = hostile_states(model, COUNT, seed=0)
    expected, _ = c_steps([model] * COUNT, states)
    error = assert_same_step(fused_steps(model, MODEL, states), expected)
    record_property("largest_difference", error)
    print(f"{num_balls} balls: {error:.1e} of the largest speed")
