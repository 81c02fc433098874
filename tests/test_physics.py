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
BATCH = 32
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
    """The fused step, compiled once for each dtype and number of steps if always given BATCH."""
    return batched(make_engine(mj_model, "fused").step)


def batched(step):
    """(state, ctrl, number of steps) -> state, compiled over a leading batch axis."""

    def steps(state: PhysicsState, ctrl: np.ndarray, num_substeps: int) -> PhysicsState:
        return jax.vmap(lambda s, u: step(s, u, num_substeps))(state, ctrl)

    return jax.jit(steps, static_argnums=2)


def uncompiled_step(mj_model: mujoco.MjModel, states: States) -> PhysicsState:
    """One fused step from each state, operation by operation: no time goes into compiling."""
    step = partial(fused.step, fused.read_model(mj_model), num_substeps=1)
    with jax.disable_jit():
        return jax.vmap(step)(PhysicsState(*as_jax(states[:2])), jnp.asarray(states.ctrl))


def as_jax(arrays):
    """The arrays as JAX arrays of the dtype that is set."""
    return tuple(jnp.asarray(array) for array in arrays)


def edited(old: str, new: str) -> mujoco.MjModel:
    """The shipped model with one piece of its MJCF replaced."""
    assert old in XML
    return mujoco.MjModel.from_xml_string(XML.replace(old, new, 1))


def paddle_frame(mj_model: mujoco.MjModel, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World position [3] of the paddle's centre and axes [3, 3] by MuJoCo's kinematics."""
    data = mujoco.MjData(mj_model)
    data.qpos[:6] = angles
    mujoco.mj_kinematics(mj_model, data)
    return data.geom("blocker").xpos, data.geom("blocker").xmat.reshape(3, 3)


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
        centre, axes = paddle_frame(mj_model, qpos[i, :6])
        qpos[i, 6:9] = centre + axes @ local[i]
    ctrl = qpos[:, :6] + rng.uniform(-0.03, 0.03, (count, 6))
    return States(qpos, qvel, ctrl), local


def bouncing_states(mj_model: mujoco.MjModel, rng: np.random.Generator) -> PhysicsState:
    """BATCH states with the arm around home and a spinning ball about to fall on the paddle."""
    qpos, qvel = np.zeros((BATCH, mj_model.nq)), np.zeros((BATCH, mj_model.nv))
    qpos[:, :6] = HOME + rng.uniform(-0.2, 0.2, (BATCH, 6))
    qvel[:, :6] = rng.uniform(-1.0, 1.0, (BATCH, 6))
    qpos[:, 9] = 1.0
    for i in range(BATCH):
        drop_ball(mj_model, qpos[i], qvel[i], rng)
    return PhysicsState(qpos, qvel)


def drop_ball(
    mj_model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, rng: np.random.Generator
) -> None:
    """Puts the ball above the paddle of one state, in place."""
    qpos[6:9] = paddle_frame(mj_model, qpos[:6])[0]
    qpos[6:9] += [*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.04, 0.1)]
    qvel[6:9] = [*rng.uniform(-0.2, 0.2, 2), rng.uniform(-2.0, 0.0)]
    qvel[9:] = rng.uniform(-30.0, 30.0, 3)


def c_step(mj_model: mujoco.MjModel, states: States) -> tuple[PhysicsState, np.ndarray]:
    """One mj_step from each state, and its number of contacts [N]."""
    data = mujoco.MjData(mj_model)
    qpos, qvel, contacts = [], [], []
    for start in zip(*states, strict=True):
        mujoco.mj_resetData(mj_model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = start
        mujoco.mj_step(mj_model, data)
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        contacts.append(data.ncon)
    return PhysicsState(np.array(qpos), np.array(qvel)), np.array(contacts)


class CEngine:
    """A batch of MuJoCo simulations that keep their own state."""

    def __init__(self, mj_model: mujoco.MjModel, start: PhysicsState):
        self.model = mj_model
        self.data = [mujoco.MjData(mj_model) for _ in start.qpos]
        for data, qpos, qvel in zip(self.data, *start, strict=True):
            data.qpos[:], data.qvel[:] = qpos, qvel

    def step(self, ctrl: np.ndarray, num_substeps: int) -> int:
        """Advances all of them; the number of steps with a contact."""
        contacts = 0
        for data, targets in zip(self.data, ctrl, strict=True):
            data.ctrl[:] = targets
            for _ in range(num_substeps):
                mujoco.mj_step(self.model, data)
                contacts += data.ncon
        return contacts

    @property
    def state(self) -> PhysicsState:
        """A copy of their state."""
        return PhysicsState(
            np.array([data.qpos for data in self.data]), np.array([data.qvel for data in self.data])
        )


def difference(a: PhysicsState, b: PhysicsState) -> tuple[float, float]:
    """Largest differences of qpos and of qvel."""
    return tuple(float(np.max(np.abs(np.asarray(x) - y))) for x, y in zip(a, b, strict=True))


@pytest.mark.usefixtures("float64")
def test_one_step_from_random_states_is_mujocos(mj_model):
    """Wide joint angles, contacts of every kind, spin, orientation."""
    states, local = random_states(mj_model, 512, seed=0)
    expected, contacts = c_step(mj_model, states)
    beyond = np.sum(np.abs(local) > HALF_SIZE, axis=1)  # in how many axes the centre is outside
    touching = contacts == 1
    assert np.sum(touching) >= 400
    assert np.sum(touching & (beyond == 0)) >= 20
    assert np.sum(touching & (beyond == 2)) >= 20
    assert np.sum(touching & (beyond == 3)) >= 20
    assert np.sum(~touching) >= 20

    qpos, qvel = difference(uncompiled_step(mj_model, states), expected)
    assert qpos < ONE_STEP_QPOS
    assert qvel < ONE_STEP_QVEL


@pytest.mark.usefixtures("float64")
def test_2000_random_action_steps_are_mujocos(mj_model, fused_step, record_property):
    """The engines run freely: neither ever sees the other's state."""
    # A bounce off an edge of the paddle amplifies rounding, in MuJoCo against itself too (an arm
    # turned by 1e-14 rad can end 1e-7 m/s away), so the bound is for draws without long series
    # of those; the seed gives one.
    rng = np.random.default_rng(2)
    state = bouncing_states(mj_model, rng)
    reference = CEngine(mj_model, state)
    contacts, drops, error = 0, 0, 0.0
    for i in range(2000):
        if i % 10 == 0:
            action = rng.uniform(-0.03, 0.03, (BATCH, 6))
            state = PhysicsState(*(np.array(x) for x in state))
            for data, qpos, qvel in zip(reference.data, *state, strict=True):
                if data.qpos[8] < paddle_frame(mj_model, data.qpos[:6])[0][2] - 0.1:
                    drop_ball(mj_model, data.qpos, data.qvel, rng)
                    qpos[6:9], qvel[6:] = data.qpos[6:9], data.qvel[6:]
                    drops += 1
            ctrl, reference_ctrl = state.qpos[:, :6] + action, reference.state.qpos[:, :6] + action
        state = fused_step(state, ctrl, 1)
        contacts += reference.step(reference_ctrl, 1)
        error = max(error, *difference(state, reference.state))
    record_property("largest_difference", error)
    print(f"2,000 steps x {BATCH}: {contacts} contact steps, {drops} drops, difference {error:.1e}")
    assert contacts >= 1000
    assert error < 1e-9


@pytest.mark.usefixtures("float64")
def test_ten_substeps_are_ten_steps(mj_model, fused_step):
    """Also the ball's orientation, which the engine turns once for all the substeps."""
    state = bouncing_states(mj_model, np.random.default_rng(0))
    state.qpos[:, 8] -= 0.03  # so that many of the ten steps are in contact
    ctrl = state.qpos[:, :6] + 0.01
    singly = state
    for _ in range(10):
        singly = fused_step(singly, ctrl, 1)
    together = fused_step(state, ctrl, 10)
    assert CEngine(mj_model, state).step(ctrl, 10) > 20
    assert max(difference(together, singly)) < 1e-12


@pytest.mark.usefixtures("float64")
def test_200_steps_are_those_of_mjx(mj_model, fused_step, record_property):
    """Free-running from falling balls, with contacts."""
    mjx_step = batched(make_engine(mj_model, "mjx").step)
    rng = np.random.default_rng(0)
    state = bouncing_states(mj_model, rng)
    few = 4
    mjx_state = PhysicsState(*(x[:few] for x in state))
    contacts, error = 0, 0.0
    for i in range(200):
        if i % 10 == 0:
            ctrl = np.asarray(state.qpos[:, :6]) + rng.uniform(-0.03, 0.03, (BATCH, 6))
        here = PhysicsState(*(np.asarray(x[:few]) for x in state))
        contacts += np.sum(c_step(mj_model, States(*here, ctrl[:few]))[1])
        state = fused_step(state, ctrl, 1)
        mjx_state = mjx_step(mjx_state, ctrl[:few], 1)
        error = max(error, *difference(PhysicsState(*(x[:few] for x in state)), mjx_state))
    record_property("largest_difference", error)
    print(f"200 steps x {few} against MJX: {contacts} contact steps, difference {error:.1e}")
    assert contacts >= 20
    assert error < 1e-6


@pytest.mark.parametrize("ball", ["bouncing", "falling"])
def test_float32_drift(mj_model, fused_step, record_property, ball):
    """Free-running float32 against MuJoCo's float64: 1 s in free motion, 2 s with bounces."""
    rng = np.random.default_rng(3)
    start = bouncing_states(mj_model, rng)
    if ball == "falling":
        start.qpos[:, 6] += 1.0
    reference = CEngine(mj_model, start)
    state = PhysicsState(*(x.astype(np.float32) for x in start))
    drift, contacts = [], 0
    for _ in range(200):
        action = rng.uniform(-0.02, 0.02, (BATCH, 6))
        state = fused_step(state, (state.qpos[:, :6] + action).astype(np.float32), 10)
        contacts += reference.step(reference.state.qpos[:, :6] + action, 10)
        off = np.abs(np.asarray(state.qpos) - reference.state.qpos)
        drift.append((off[:, :6].max(), off[:, 6:9].max()))
    assert state.qpos.dtype == np.float32
    for seconds in (1, 2):
        joints, position = drift[100 * seconds - 1]
        record_property(f"joint_drift_{seconds}s_rad", float(joints))
        record_property(f"ball_drift_{seconds}s_m", float(position))
        print(f"float32, {ball}, {seconds} s: joints {joints:.1e} rad, ball {position:.1e} m")
