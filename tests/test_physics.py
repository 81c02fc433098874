"""The physics engines: fused against MuJoCo's C step, against MJX, and against its own limits."""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bounce_mjx.config import EnvConfig
from bounce_mjx.errors import UserError
from bounce_mjx.model import find_addresses, load_model
from bounce_mjx.physics import PhysicsState, chain, fused, make_engine, mjx_engine
from bounce_mjx.resources import resource_path

HOME = np.deg2rad([0.0, 40.0, 110.0, 0.0, -60.0, 0.0])
HALF_SIZE = np.array([0.05, 0.065, 0.0035])
RADIUS = 0.019
DT = 1e-3
XML = Path(resource_path("mjcf/bounce_ball.xml")).read_text()
# One step changes a velocity by up to 1e4 m/s^2 * 1 ms = 10, or 100 where the servos kick: these
# leave room for the rounding of some thousand operations and of the mass matrix's inverse.
ONE_STEP_QVEL = 1e-10
ONE_STEP_QPOS = ONE_STEP_QVEL * DT


class States(NamedTuple):
    """A batch of states and servo targets, in the order of the unedited MJCF."""

    qpos: np.ndarray
    """[N, nq]."""
    qvel: np.ndarray
    """[N, nv]."""
    ctrl: np.ndarray
    """[N, nu], rad."""


@pytest.fixture
def float64():
    """Everything in the test runs in float64."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def mj_model() -> mujoco.MjModel:
    """The shipped model at the default time step."""
    return load_model(EnvConfig())


@pytest.fixture(scope="module")
def fused_step(mj_model):
    """Compiled fused step over a batch: (state, ctrl, number of steps) -> state."""
    return batched(fused.step, fused.read_model(mj_model))


def batched(step, constants):
    """A step compiled over a leading batch axis."""

    def steps(state: PhysicsState, ctrl: np.ndarray, num_substeps: int) -> PhysicsState:
        one = partial(step, constants, num_substeps=num_substeps)
        return jax.vmap(one)(state, ctrl)

    return jax.jit(steps, static_argnums=2)


def edited(old: str, new: str) -> mujoco.MjModel:
    """The shipped model with one piece of its MJCF replaced."""
    assert old in XML
    return mujoco.MjModel.from_xml_string(XML.replace(old, new, 1))


def place_ball(
    mj_model: mujoco.MjModel, angles: np.ndarray, local: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """World position of a point of the paddle's frame at the joint angles; that frame's axes."""
    data = mujoco.MjData(mj_model)
    data.qpos[:6] = angles
    mujoco.mj_kinematics(mj_model, data)
    paddle = data.geom("blocker")
    axes = paddle.xmat.reshape(3, 3)
    return paddle.xpos + axes @ local, axes


def random_states(mj_model: mujoco.MjModel, count: int, seed: int) -> tuple[States, np.ndarray]:
    """Arm states in a wide range with the ball at the paddle; and the ball's centre [N, 3] in the
    paddle's frame: in turn around it, inside it, beside an edge or a corner, over a face."""
    rng = np.random.default_rng(seed)
    qpos, qvel = np.zeros((count, mj_model.nq)), np.zeros((count, mj_model.nv))
    qpos[:, :6] = rng.uniform(-np.pi, np.pi, (count, 6))
    qvel[:, :6] = rng.uniform(-6.0, 6.0, (count, 6))
    qvel[:, 6:9] = rng.uniform(-3.0, 3.0, (count, 3))
    qvel[:, 9:] = rng.uniform(-30.0, 30.0, (count, 3))
    quaternion = rng.normal(size=(count, 4))
    qpos[:, 9:] = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)

    local = rng.uniform(-1.0, 1.0, (count, 3)) * (HALF_SIZE + 1.2 * RADIUS)
    local[1::4] = rng.uniform(-1.0, 1.0, local[1::4].shape) * HALF_SIZE
    beyond = HALF_SIZE + rng.uniform(0.0, 0.6 * RADIUS, local[2::4].shape)
    along = np.arange(len(beyond)) % 4  # 3: a corner
    edge = along < 3
    beyond[edge, along[edge]] *= rng.uniform(0.0, 0.9, edge.sum())
    local[2::4] = beyond * rng.choice([-1.0, 1.0], beyond.shape)
    local[3::4, :2] *= 0.6
    local[3::4, 2] = rng.choice([-1.0, 1.0], len(local[3::4])) * (
        HALF_SIZE[2] + RADIUS * rng.uniform(-0.5, 1.1, len(local[3::4]))
    )
    for i in range(count):
        qpos[i, 6:9], _ = place_ball(mj_model, qpos[i, :6], local[i])
    ctrl = qpos[:, :6] + rng.uniform(-0.03, 0.03, (count, 6))
    return States(qpos, qvel, ctrl), local


def c_step(mj_model: mujoco.MjModel, states: States) -> tuple[PhysicsState, np.ndarray]:
    """One mj_step from each state, and its number of contacts [N]."""
    data = mujoco.MjData(mj_model)
    at = find_addresses(mj_model)
    qpos, qvel, contacts = [], [], []
    for start in zip(*states, strict=True):
        mujoco.mj_resetData(mj_model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = start
        mujoco.mj_step(mj_model, data)
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        contacts.append(data.ncon)
    assert max(at.arm_qpos + at.ball_qpos) + 1 == mj_model.nq
    return PhysicsState(np.array(qpos), np.array(qvel)), np.array(contacts)


def difference(a: PhysicsState, b: PhysicsState) -> tuple[float, float]:
    """Largest differences of qpos and of qvel."""
    return tuple(float(np.max(np.abs(np.asarray(x) - y))) for x, y in zip(a, b, strict=True))
