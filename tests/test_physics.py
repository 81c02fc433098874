"""Physics engines: fused against MuJoCo's C step and against MJX, and the limits of fused."""

import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bounce_mjx.errors import UserError
from bounce_mjx.physics import (
    Control,
    PhysicsParameters,
    PhysicsState,
    fused,
    make_engine,
    mjx_engine,
    scalars,
)
from bounce_mjx.physics.fused import chain
from bounce_mjx.physics.support import unsupported_feature
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.model import Addresses, find_addresses

HOME = np.deg2rad([0.0, 40.0, 110.0, 0.0, -60.0, 0.0])
HALF_SIZE = np.array([0.05, 0.065, 0.0035])
RADIUS = 0.019
DT = 1e-3
BATCH = 32
MODEL = PhysicsParameters()
XML = Path(resource_path("mjcf/bounce_ball.xml")).read_text()
# Largest difference of one step relative to the largest speed in the batch: room for the rounding
# errors of some thousand operations. (The ball's spin has the largest error: in MuJoCo, rounding of
# the contact's lever turns the ball; in the fused engine, nothing turns it.)
ONE_STEP = 1e-11


class States(NamedTuple):
    """Batch of states and servo targets, in the order of the unedited MJCF."""

    qpos: np.ndarray
    """Generalised positions [N, nq]."""
    qvel: np.ndarray
    """Generalised velocities [N, nv]."""
    ctrl: np.ndarray
    """Servo targets [N, nu], rad."""


@pytest.fixture(scope="module")
def fused_step(mj_model):
    """Fused step for batches of size BATCH, compiled once for each dtype and number of steps."""
    return batched(make_engine(mj_model, "fused").step)


def batched(step):
    """Compiled function (state, ctrl, number of steps) -> state over a leading batch axis."""

    def steps(state: PhysicsState, ctrl: np.ndarray, num_substeps: int) -> PhysicsState:
        return jax.vmap(lambda s, u: step(MODEL, s, Control(u), num_substeps))(state, ctrl)

    return jax.jit(steps, static_argnums=2)


def uncompiled_step(mj_model: mujoco.MjModel, states: States) -> PhysicsState:
    """One fused step from each state, operation by operation, which saves the compilation."""
    step = partial(fused.step, fused.read_model(mj_model), MODEL, num_substeps=1)
    with jax.disable_jit():
        return jax.vmap(step)(PhysicsState(*as_jax(states[:2])), Control(jnp.asarray(states.ctrl)))


def as_jax(arrays):
    """Converts arrays to JAX arrays of the default dtype."""
    return tuple(jnp.asarray(array) for array in arrays)


def edited(old: str, new: str) -> mujoco.MjModel:
    """Shipped model with one piece of its MJCF replaced."""
    assert old in XML
    return mujoco.MjModel.from_xml_string(XML.replace(old, new, 1))


def paddle_frame(mj_model: mujoco.MjModel, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World position [3] of the paddle's centre and axes [3, 3] by MuJoCo's kinematics."""
    data = mujoco.MjData(mj_model)
    data.qpos[find_addresses(mj_model).arm_qpos,] = angles
    mujoco.mj_kinematics(mj_model, data)
    return data.geom("blocker").xpos, data.geom("blocker").xmat.reshape(3, 3)


def random_states(mj_model: mujoco.MjModel, count: int, seed: int) -> tuple[States, np.ndarray]:
    """Arm states in a wide range with the ball at the paddle, and the ball's centre [N, 3] in the
    paddle's frame: in turn around the paddle, inside it, near an edge or a corner, over a face."""
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
    """BATCH states with the arm near home and a spinning ball just above the paddle."""
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
    """Puts the ball of one state above the paddle, in place."""
    qpos[6:9] = paddle_frame(mj_model, qpos[:6])[0]
    qpos[6:9] += [*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.04, 0.1)]
    qvel[6:9] = [*rng.uniform(-0.2, 0.2, 2), rng.uniform(-2.0, 0.0)]
    qvel[9:] = rng.uniform(-30.0, 30.0, 3)


def c_step(mj_model: mujoco.MjModel, states: States) -> tuple[PhysicsState, np.ndarray]:
    """One mj_step from each state, and the number of contacts [N]."""
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


def reordered(at: Addresses, states):
    """Reorders `States` or a `PhysicsState` to the addresses of an edited model."""
    qpos, qvel = np.empty_like(states.qpos), np.empty_like(states.qvel)
    qpos[:, at.arm_qpos + at.ball_qpos] = states.qpos
    qvel[:, at.arm_qvel + at.ball_qvel] = states.qvel
    if isinstance(states, PhysicsState):
        return PhysicsState(qpos, qvel)
    ctrl = np.empty_like(states.ctrl)
    ctrl[:, at.actuators] = states.ctrl
    return States(qpos, qvel, ctrl)


class CEngine:
    """Batch of MuJoCo simulations with their own states."""

    def __init__(self, mj_model: mujoco.MjModel, start: PhysicsState):
        self.model = mj_model
        self.data = [mujoco.MjData(mj_model) for _ in start.qpos]
        for data, qpos, qvel in zip(self.data, *start[:2], strict=True):
            data.qpos[:], data.qvel[:] = qpos, qvel

    def step(self, ctrl: np.ndarray, num_substeps: int) -> int:
        """Advances all simulations; returns the number of steps with a contact."""
        contacts = 0
        for data, targets in zip(self.data, ctrl, strict=True):
            data.ctrl[:] = targets
            for _ in range(num_substeps):
                mujoco.mj_step(self.model, data)
                contacts += data.ncon
        return contacts

    @property
    def state(self) -> PhysicsState:
        """Copy of all states."""
        return PhysicsState(
            np.array([data.qpos for data in self.data]), np.array([data.qvel for data in self.data])
        )


def difference(a: PhysicsState, b: PhysicsState) -> tuple[float, float]:
    """Largest differences of qpos and of qvel."""
    return tuple(
        float(np.max(np.abs(np.asarray(x) - y))) for x, y in zip(a[:2], b[:2], strict=True)
    )


def assert_same_step(actual: PhysicsState, expected: PhysicsState) -> float:
    """Checks qpos and qvel against ONE_STEP; returns the largest difference of qvel."""
    qpos, qvel = difference(actual, expected)
    fastest = np.max(np.abs(expected.qvel))
    assert qvel < ONE_STEP * fastest
    assert qpos < ONE_STEP * fastest * DT
    return qvel


@pytest.mark.usefixtures("float64")
def test_one_step_from_random_states_is_mujocos(mj_model, record_property):
    """Wide joint angles, contacts of every kind, spin, orientation."""
    states, local = random_states(mj_model, 512, seed=0)
    expected, contacts = c_step(mj_model, states)
    beyond = np.sum(np.abs(local) > HALF_SIZE, axis=1)  # number of axes with the centre outside
    touching = contacts == 1
    assert np.sum(touching) >= 400
    assert np.sum(touching & (beyond == 0)) >= 20
    assert np.sum(touching & (beyond == 2)) >= 20
    assert np.sum(touching & (beyond == 3)) >= 20
    assert np.sum(~touching) >= 20

    error = assert_same_step(uncompiled_step(mj_model, states), expected)
    record_property("largest_difference", error)
    print(f"one step from {len(local)} states: {np.sum(touching)} contacts, difference {error:.1e}")


@pytest.mark.usefixtures("float64")
def test_2000_random_action_steps_are_mujocos(mj_model, fused_step, record_property):
    """Both engines run freely; neither sees the other's state."""
    # A bounce off an edge of the paddle amplifies rounding errors, even between two runs of MuJoCo
    # (with an arm turned by 1e-14 rad, the ends can differ by 1e-7 m/s). Seeds 0 to 7 stay below
    # 1e-10; this seed has the smallest difference.
    rng = np.random.default_rng(4)
    state = bouncing_states(mj_model, rng)
    reference = CEngine(mj_model, state)
    contacts, drops, error = 0, 0, 0.0
    for i in range(2000):
        if i % 10 == 0:
            action = rng.uniform(-0.03, 0.03, (BATCH, 6))
            state = PhysicsState(*(np.array(x) for x in state[:2]))
            for data, qpos, qvel in zip(reference.data, *state[:2], strict=True):
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
    """The engine updates the ball's orientation once for all substeps."""
    state = bouncing_states(mj_model, np.random.default_rng(0))
    state.qpos[:, 8] -= 0.03  # many of the ten steps are then in contact
    ctrl = state.qpos[:, :6] + 0.01
    singly = state
    for _ in range(10):
        singly = fused_step(singly, ctrl, 1)
    together = fused_step(state, ctrl, 10)
    assert CEngine(mj_model, state).step(ctrl, 10) > 20
    assert max(difference(together, singly)) < 1e-12


@pytest.mark.slow
@pytest.mark.separate_loops
@pytest.mark.usefixtures("float64")
def test_200_steps_are_those_of_mjx(mj_model, fused_step, record_property):
    """Both engines run freely from falling balls, with contacts."""
    mjx_step = batched(make_engine(mj_model, "mjx").step)
    rng = np.random.default_rng(0)
    state = bouncing_states(mj_model, rng)
    few = 4
    mjx_state = PhysicsState(*(x[:few] for x in state[:2]))
    contacts, error = 0, 0.0
    for i in range(200):
        if i % 10 == 0:
            ctrl = np.asarray(state.qpos[:, :6]) + rng.uniform(-0.03, 0.03, (BATCH, 6))
        here = PhysicsState(*(np.asarray(x[:few]) for x in state[:2]))
        contacts += np.sum(c_step(mj_model, States(*here[:2], ctrl[:few]))[1])
        state = fused_step(state, ctrl, 1)
        mjx_state = mjx_step(mjx_state, ctrl[:few], 1)
        error = max(error, *difference(PhysicsState(*(x[:few] for x in state[:2])), mjx_state))
    record_property("largest_difference", error)
    print(f"200 steps x {few} against MJX: {contacts} contact steps, difference {error:.1e}")
    assert contacts >= 20
    assert error < 1e-6


def test_mjx_multiplies_in_full_precision(mj_model):
    """The default on a GPU, TF32, has three digits, and a policy that bounces elsewhere failed."""
    constants = mjx_engine.read_model(mj_model)
    state = PhysicsState(jnp.array(mj_model.qpos0), jnp.zeros(mj_model.nv))

    def step_and_look(state, ctrl):
        state = mjx_engine.step(constants, MODEL, state, Control(ctrl))
        return state, mjx_engine.paddle_position(constants, MODEL, state.qpos)

    program = jax.jit(step_and_look).lower(state, jnp.zeros(mj_model.nu)).as_text()
    products = [line for line in program.splitlines() if "dot_general" in line]
    assert products
    assert all("precision = [HIGHEST, HIGHEST]" in line for line in products)


@pytest.mark.parametrize("ball", ["bouncing", "falling"])
def test_float32_drift(mj_model, fused_step, record_property, ball):
    """Free run of 2 s in float32 against MuJoCo's float64, on the paddle and next to it."""
    rng = np.random.default_rng(3)
    start = bouncing_states(mj_model, rng)
    if ball == "falling":
        start.qpos[:, 6] += 1.0
    reference = CEngine(mj_model, start)
    state = PhysicsState(*(x.astype(np.float32) for x in start[:2]))
    contacts = 0
    for second in (1, 2):
        for _ in range(100):
            action = rng.uniform(-0.02, 0.02, (BATCH, 6))
            ctrl = (np.asarray(state.qpos[:, :6]) + action).astype(np.float32)
            state = fused_step(state, ctrl, 10)
            contacts += reference.step(reference.state.qpos[:, :6] + action, 10)
        drift = np.abs(np.asarray(state.qpos) - reference.state.qpos)
        joints, balls = drift[:, :6].max(), drift[:, 6:9].max(axis=1)
        record_property(f"joint_drift_{second}s_rad", float(joints))
        record_property(f"ball_drift_{second}s_m", float(balls.max()))
        print(
            f"float32, {ball}, {second} s: joints {joints:.1e} rad, "
            f"ball {np.median(balls):.1e} (median) {balls.max():.1e} (worst) m"
        )
        assert joints < 1e-3
        # Each bounce amplifies an error: only the median is meaningful.
        assert (np.median(balls) if ball == "bouncing" else balls.max()) < 1e-3
    assert state.qpos.dtype == np.float32
    assert contacts > 200 if ball == "bouncing" else contacts == 0


def piece(start: str, end: str) -> str:
    """Piece of the MJCF from the text `start` to before the text `end`."""
    return XML[XML.index(start) : XML.index(end)]


ARM_BODY = piece('    <body name="Link1"', '\n    <body name="ball_link"')
BALL_BODY = piece('\n    <body name="ball_link"', "  </worldbody>")
PADDLE = piece('<geom name="blocker"', "\n              </body>\n            </body>")
LINK_6 = piece('<body name="Link6"', PADDLE)
END = piece('<body name="Link6"', "</mujoco>")
OPTIONS = piece("<option ", ' limited="false"')
INERTIAL = '<inertial pos="0.1 0 0.02" quat="1 2 3 4" mass="0.5" diaginertia="0.01 0.012 0.02"/>'
SIDE_LINK = f'<body pos="0.02 0 0.01" euler="0.3 0 1">{INERTIAL}<joint name="side"/></body>'
WELDED = f'<body pos="0.02 0 0.01" euler="0.3 0 1">{INERTIAL}'

# Models that the fused engine supports, each as one edit of the MJCF.
SUPPORTED = {
    "damping": ('<joint armature="0.02"', '<joint armature="0.02" damping="5"'),
    "no armature": ('<joint armature="0.02"', '<joint armature="0"'),
    "axis y": ('name="Joint2" axis="0 0 1"', 'name="Joint2" axis="0 1 0"'),
    "axis skew": ('name="Joint3" axis="0 0 1"', 'name="Joint3" axis="1 -2 0.5"'),
    "axis backward": ('name="Joint5" axis="0 0 1"', 'name="Joint5" axis="0 0 -1"'),
    "ref": ('name="Joint4"', 'name="Joint4" ref="0.3"'),
    "skew base": ('<body name="Link1" pos="0 0 0.1">', '<body name="Link1" euler="0.1 -0.2 0.3">'),
    "tilted gravity": ('gravity="0 0 -9.81"', 'gravity="1 -2 -9"'),
    "ctrlrange": ('<position kp="20000"', '<position ctrlrange="-0.5 0.5" kp="20000"'),
    "forcerange": ('<position kp="20000"', '<position forcerange="-300 80" kp="20000"'),
    "forcerange and gear": (
        '<position kp="20000"',
        '<position forcerange="-30 9" gear="-2" kp="20000"',
    ),
    "gear": ('<position kp="20000"', '<position gear="-2" kp="20000"'),
    "affine actuator": (
        '<position name="act2" joint="Joint2"/>',
        '<general name="act2" joint="Joint2" gainprm="100" biastype="affine" biasprm="3 -80 -10"/>',
    ),
    "solref": ('solref="-98696 -31.4"', 'solref="0.02 1"'),
    "short solref": ('solref="-98696 -31.4"', 'solref="0.0005 0.1"'),
    "undamped solref": ('solref="-98696 -31.4"', 'solref="-98696 0"'),
    "solimp power 1": ('solimp="0.95 0.99 0.001"', 'solimp="0.5 0.99 0.02 0.3 1"'),
    "solimp power 3": ('solimp="0.95 0.99 0.001"', 'solimp="0.5 0.99 0.02 0.3 3"'),
    "solimp power 1.5": ('solimp="0.95 0.99 0.001"', 'solimp="0.5 0.99 0.02 0.6 1.5"'),
    "solimp out of range": ('solimp="0.95 0.99 0.001"', 'solimp="0 1 0.02 0 0.5"'),
    "heavy ball": ('size="0.019" mass="0.0027"', 'size="0.019" mass="0.3"'),
    "joint offset": ('name="Joint2"', 'name="Joint2" pos="0.01 -0.02 0.03"'),
    "slide": ('name="Joint2"', 'name="Joint2" type="slide"'),
    "spring": ("<joint ", '<joint stiffness="500" springref="0.3" '),
    "joint force range": ("<joint ", '<joint actuatorfrcrange="-40 60" '),
    "gravity compensation of a link": ('<body name="Link3"', '<body name="Link3" gravcomp="2"'),
    "gravity compensation of either sign": (
        ARM_BODY,
        ARM_BODY.replace('<body name="Link3"', '<body name="Link3" gravcomp="2"').replace(
            '<body name="Link5"', '<body name="Link5" gravcomp="-1"'
        ),
    ),
    "gravity compensation": (ARM_BODY, ARM_BODY.replace("<body ", '<body gravcomp="0.7" ')),
    "gravity compensation by actuators": (
        ARM_BODY,
        ARM_BODY.replace("<body ", '<body gravcomp="0.7" ').replace(
            "<joint ", '<joint actuatorgravcomp="true" actuatorfrcrange="-20 15" '
        ),
    ),
    "gravity compensation of the ball": (
        '<body name="ball_link"',
        '<body gravcomp="0.5" name="ball_link"',
    ),
    "welded body": ('<body name="Link4"', f'{WELDED}{WELDED}</body></body><body name="Link4"'),
    "welded paddle": (PADDLE, f"{WELDED}{PADDLE}</body>"),
    "pedestal": (ARM_BODY, f'<body pos="0.1 0 0.2" euler="0 0.3 0">{ARM_BODY}</body>'),
    "affine gain": (
        '<position name="act2" joint="Joint2"/>',
        '<general name="act2" joint="Joint2" gear="-2" gaintype="affine" gainprm="100 30 -20" '
        'biastype="affine" biasprm="3 -80 -10" ctrlrange="-0.5 0.5"/>',
    ),
    "Euler": (
        OPTIONS,
        OPTIONS.replace("implicitfast", "Euler")
        .replace('eulerdamp="disable"', "")
        .replace("<joint ", '<joint damping="5" '),
    ),
    "Euler without implicit damping": (
        OPTIONS,
        OPTIONS.replace("implicitfast", "Euler").replace("<joint ", '<joint damping="5" '),
    ),
    "turned paddle": ('quat="0.707107 0 -0.707107 0"', 'quat="0.6 0.1 -0.7 0.2"'),
}
# Models that move like the shipped one.
EQUIVALENT = {
    "negative gravity compensation of a link": (
        '<body name="Link3"',
        '<body name="Link3" gravcomp="-1"',
    ),
    "negative gravity compensation": (
        ARM_BODY + BALL_BODY,
        (ARM_BODY + BALL_BODY).replace("<body ", '<body gravcomp="-1" '),
    ),
    "static body": ("  </worldbody>", f"{WELDED}</body></worldbody>"),
    "springs disabled": (
        OPTIONS,
        OPTIONS.replace("<flag ", '<flag spring="disable" ').replace(
            "<joint ", '<joint stiffness="500" '
        ),
    ),
    "pair swapped": ('geom1="blocker" geom2="ball"', 'geom1="ball" geom2="blocker"'),
    "actuators swapped": (
        '<position name="act1" joint="Joint1"/>\n    <position name="act2" joint="Joint2"/>',
        '<position name="act2" joint="Joint2"/>\n    <position name="act1" joint="Joint1"/>',
    ),
    "ball first": (ARM_BODY + BALL_BODY, BALL_BODY + ARM_BODY),
    "harmless flags": (
        'eulerdamp="disable"',
        'warmstart="disable" island="disable" midphase="disable" energy="enable" fwdinv="enable"',
    ),
}


@pytest.mark.parametrize("name", [*SUPPORTED, *EQUIVALENT])
@pytest.mark.usefixtures("float64")
def test_supported_models_step_as_mujoco_does(mj_model, name):
    """One step from random states at the paddle of the edited model."""
    model = edited(*(SUPPORTED.get(name) or EQUIVALENT[name]))
    states, _ = random_states(model, 64, seed=1)
    in_order = reordered(find_addresses(model), states)
    expected, contacts = c_step(model, in_order)
    assert np.sum(contacts) >= 40
    assert_same_step(uncompiled_step(model, in_order), expected)

    # A supported edit changes the simulation; an equivalent edit does not.
    shipped, _ = c_step(mj_model, states)
    change = np.max(np.abs(expected.qvel - reordered(find_addresses(model), shipped).qvel))
    assert (change > 1e-3) == (name in SUPPORTED)


UNSUPPORTED = {
    # edit, required part of the message
    "RK4": ('integrator="implicitfast"', 'integrator="RK4"', "integrator rk4 "),
    "implicit": ('integrator="implicitfast"', 'integrator="implicit"', "integrator implicit "),
    "discrete": ('integrator="implicitfast"', 'integrator="discrete"', "integrator discrete "),
    "flex": (
        "</worldbody>",
        '</worldbody><deformable><flex name="f" dim="1" body="Link5 Link6" element="0 1"/>'
        "</deformable>",
        "flex",
    ),
    "density": ("<option ", '<option density="1.2" ', "density"),
    "viscosity": ("<option ", '<option viscosity="1e-5" ', "viscosity"),
    "wind": ("<option ", '<option wind="1 0 0" ', "wind"),
    "actuator group": ("<option ", '<option actuatorgroupdisable="0" ', "actuatorgroupdisable"),
    **{
        f"no {flag}": ("<flag ", f'<flag {flag}="disable" ', f"({flag})")
        for flag in "constraint contact damper gravity clampctrl actuation refsafe".split()
    },
    "two flags": ("<flag ", '<flag gravity="disable" contact="disable" ', "(contact, gravity)"),
    **{
        flag: ("<flag ", f'<flag {flag}="enable" ', f"({flag})")
        for flag in ("override", "sleep", "diagexact")
    },
    "condim 4": ('condim="1"', 'condim="4"', "condim 4"),
    "condim 6": ('condim="1"', 'condim="6"', "condim 6"),
    "second pair": ("</contact>", '<pair geom1="floor" geom2="ball"/></contact>', "another ball"),
    "no pair": (piece("<pair ", "  </contact>"), "", "contact pair"),
    "pair with the floor": (
        'pair geom1="blocker"',
        'pair geom1="floor"',
        "contact pair of the paddle",
    ),
    "colliding geoms": ('<geom contype="0"', '<geom contype="1"', "contype"),
    "margin": ("<pair ", '<pair margin="0.001" ', "margin"),
    "gap": ("<pair ", '<pair gap="0.001" ', "gap"),
    "adhesion": ("<pair ", '<pair adhesion="1" ', "adhesion"),
    "mixed solref": ('solref="-98696 -31.4"', 'solref="-98696 1"', "solref"),
    "solref with a zero": ('solref="-98696 -31.4"', 'solref="0.02 0"', "solref"),
    "solimp width": ('solimp="0.95 0.99 0.001"', 'solimp="0.95 0.99 0"', "solimp"),
    "limited": ('limited="false"', 'limited="true"', 'limited="true"'),
    "dry friction of the ball": ("<freejoint ", '<joint type="free" frictionloss="0.1" ', "ball"),
    "stiffness polynomial": ("<joint ", '<joint stiffness="0 1 0" ', "stiffness"),
    "damping polynomial": ("<joint ", '<joint damping="1 1 0" ', "damping"),
    "extra joint": (
        '<joint name="Joint3"',
        '<joint name="more" axis="1 0 0"/><joint name="Joint3"',
        "joints other",
    ),
    "two arms": (
        END,
        END.replace('<body name="Link6"', SIDE_LINK + '<body name="Link6"').replace(
            "<actuator>", '<actuator><position joint="side"/>'
        ),
        "one serial chain",
    ),
    "paddle on another link": (LINK_6 + PADDLE, PADDLE + LINK_6, "last joint"),
    "mocap": ("  </worldbody>", '<body mocap="true"/></worldbody>', "mocap"),
    "body on the ball": ("<freejoint ", "<body/><freejoint ", "attached to the ball"),
    "cylinder paddle": (
        'name="blocker" type="box" size="0.05 0.065 0.0035"',
        'name="blocker" type="cylinder" size="0.05 0.0035"',
        "paddle that is not a box",
    ),
    "ellipsoid ball": ('type="sphere" size="0.019"', 'type="ellipsoid" size=".02 .02 .01"', "ball"),
    "ball off its body": ('type="sphere"', 'pos="0 0 0.01" type="sphere"', "ball"),
    "uneven ball": (
        "<freejoint ",
        '<inertial pos="0 0 0" mass="0.0027" diaginertia="3.9e-7 3.9e-7 3.8e-7"/><freejoint ',
        "homogeneous sphere",
    ),
    "ball spring": ("<freejoint ", '<joint type="free" stiffness="0.1" ', "ball"),
    "ball damping": ("<freejoint ", '<joint type="free" damping="0.1" ', "ball"),
    "equality": (
        "<actuator>",
        '<equality><joint joint1="Joint2" joint2="Joint3"/></equality><actuator>',
        "equality",
    ),
    "tendon": (
        "<actuator>",
        '<tendon><fixed><joint joint="Joint2" coef="1"/></fixed></tendon><actuator>',
        "tendons",
    ),
    "actuator dynamics": ("<position ", '<position timeconst="0.01" ', "position servos"),
    "actuator delay": ("<position ", '<position delay="0.005" nsample="9" ', "delay"),
    "actuator damping": ("<position ", '<position damping="1" ', "damping"),
    "actuator armature": ("<position ", '<position armature="0.1" ', "armature"),
    "motor": ('<position name="act2"', '<motor name="act2"', "position servos"),
    "another actuator": (
        "</actuator>",
        '<motor site="paddle_home" gear="0 0 1 0 0 0"/></actuator>',
        "one position servo on each joint",
    ),
}


# Features that MJX also ignores or refuses.
UNSUPPORTED_BY_BOTH = (
    *("implicit", "discrete", "density", "viscosity", "wind", "actuator group"),
    *("override", "sleep", "diagexact", "adhesion", "mixed solref", "solref with a zero"),
    *("solimp width", "flex"),
    *("stiffness polynomial", "damping polynomial", "ellipsoid ball"),
    *("actuator delay", "actuator damping", "actuator armature"),
)


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_unsupported_models_are_refused(name):
    """The error names the feature and a remedy; it never advises an engine without the feature."""
    old, new, feature = UNSUPPORTED[name]
    model = edited(old, new)
    found = unsupported_feature(model, "fused")
    assert feature in found
    with pytest.raises(UserError) as error:
        make_engine(model, "fused")
    text = str(error.value)
    assert feature in text
    if name in UNSUPPORTED_BY_BOTH:
        assert text.endswith("; change the MJCF")
        for choice in ("auto", "mjx"):
            with pytest.raises(UserError, match="; change the MJCF$"):
                make_engine(model, choice)
    else:
        assert text == f"the fused physics does not support {found}; use --physics mjx"


@pytest.mark.parametrize("name", ["RK4", "limited", "condim 4"])
def test_auto_takes_mjx_for_unsupported_models(name):
    """The reason is a whole sentence."""
    old, new, feature = UNSUPPORTED[name]
    engine = make_engine(edited(old, new), "auto")
    assert engine.name == "mjx"
    assert feature in engine.reason
    assert engine.reason.count("(") == engine.reason.count(")")


MJX_ONLY = {
    # Features that MJX ignores; the fused engine refuses some of these models for another reason.
    "early activations": (
        '<position name="act2" joint="Joint2"/>',
        '<general name="act2" joint="Joint2" dyntype="filterexact" dynprm="0.1" gainprm="9" '
        'biastype="affine" biasprm="0 -9 0" actearly="true"/>',
        "actearly",
    ),
    "limited affine gain": (
        '<position name="act2" joint="Joint2"/>',
        '<general name="act2" joint="Joint2" gaintype="affine" gainprm="9 3 -2" '
        'biastype="affine" biasprm="0 -9 -1" ctrlrange="-1 1" ctrllimited="true"/>',
        "gaintype affine",
    ),
    "noslip": ("<option ", '<option noslip_iterations="3" ', "noslip_iterations"),
    "solref of a joint limit": (
        "<joint ",
        '<joint solreflimit="0.02 0" ',
        "solref with exactly one positive number",
    ),
    "damping without springs": (
        OPTIONS,
        OPTIONS.replace("<flag ", '<flag spring="disable" ').replace(
            "<joint ", '<joint damping="5" '
        ),
        "flag spring or damper",
    ),
    "springs without damping": (
        OPTIONS,
        OPTIONS.replace("<flag ", '<flag damper="disable" ').replace(
            "<joint ", '<joint stiffness="500" '
        ),
        "flag spring or damper",
    ),
    "surface velocity": ("<geom contype", '<geom surfacevel="1 0 0 0 0 0" contype', "surfacevel"),
}


@pytest.mark.parametrize("name", MJX_ONLY)
def test_mjx_refuses_features_that_it_ignores(name):
    """The error names the feature."""
    old, new, feature = MJX_ONLY[name]
    with pytest.raises(UserError, match=feature):
        make_engine(edited(old, new), "mjx")


@pytest.mark.slow
def test_importing_mjx_prints_nothing_and_keeps_the_lines_of_other_threads():
    program = """
import threading
from bounce_mjx.physics import make_engine
from bounce_mjx.robot.model import load_model

model, imported, lines = load_model(None, 0.001), threading.Event(), []

def talk():
    while not imported.wait(0.001):
        lines.append(f"line {len(lines)}")
        print(lines[-1])

talking = threading.Thread(target=talk)
talking.start()
make_engine(model, "mjx")
imported.set()
talking.join()
print(len(lines))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    *lines, count = done.stdout.split("\n")[:-1]
    assert lines == [f"line {i}" for i in range(int(count))]
    assert lines


def test_auto_takes_fused_for_the_shipped_model(mj_model):
    """An explicit choice has priority."""
    assert make_engine(mj_model, "auto").name == "fused"
    assert make_engine(mj_model, "fused").name == "fused"
    assert make_engine(mj_model, "mjx").name == "mjx"


@pytest.mark.parametrize("speed", [1.0, 2.0, 3.0, 4.0])
@pytest.mark.usefixtures("float64")
def test_restitution(mj_model, fused_step, record_property, speed):
    """Ratio of the speeds after and before an impact on the held paddle, at all phases of the time
    step."""
    ctrl = np.tile(HOME, (BATCH, 1))
    state = PhysicsState(np.zeros((BATCH, mj_model.nq)), np.zeros((BATCH, mj_model.nv)))
    state.qpos[:, :6] = HOME
    state.qpos[:, 6], state.qpos[:, 9] = 2.0, 1.0
    for _ in range(50):  # the servos settle
        state = fused_step(state, ctrl, 10)
    state = PhysicsState(*(np.array(x) for x in state[:2]))
    centre, axes = paddle_frame(mj_model, state.qpos[0, :6])
    normal = axes[:, 2]
    fall = 5e-4 + np.arange(BATCH) / BATCH * speed * DT
    state.qpos[:, 6:9] = centre + np.outer(HALF_SIZE[2] + RADIUS + fall, normal)
    state.qvel[:, 6:9] = -speed * normal

    gaps, speeds = [], []
    before = centre
    for _ in range(40):
        paddle = np.array([paddle_frame(mj_model, q)[0] for q in np.asarray(state.qpos[:, :6])])
        gap = (np.asarray(state.qpos[:, 6:9]) - paddle) @ normal - HALF_SIZE[2] - RADIUS
        # A step moves the state by its new velocity. So the difference quotient is the paddle's
        # velocity, and in free flight the velocity holds half a step before the position.
        velocity = np.asarray(state.qvel[:, 6:9]) - (paddle - before) / DT
        relative = velocity @ normal - 0.5 * 9.81 * DT
        # This removes the work of gravity between the first touch and this position.
        speeds.append(np.sign(relative) * np.sqrt(relative**2 + 2.0 * 9.81 * np.maximum(gap, 0.0)))
        gaps.append(gap)
        before = paddle
        state = fused_step(state, ctrl, 1)
    apart = np.array(gaps) >= 0.0
    touched = np.argmin(apart, axis=0)
    left = touched + [np.argmax(a[t:]) for a, t in zip(apart.T, touched, strict=True)]
    assert np.all((touched > 0) & (left > touched))
    each = np.arange(BATCH)
    restitution = -np.array(speeds)[left, each] / np.array(speeds)[touched - 1, each]
    record_property("restitution", float(np.mean(restitution)))
    print(
        f"restitution at {speed} m/s: {np.mean(restitution):.4f} "
        f"({np.min(restitution):.4f} to {np.max(restitution):.4f})"
    )
    assert np.mean(restitution) == pytest.approx(0.85, abs=0.01)
    # A single impact depends on its phase.
    assert np.all(np.abs(restitution - 0.85) < 0.04)


@pytest.mark.usefixtures("float64")
def test_the_home_pose_holds_the_paddle_level(mj_model):
    """SPEC's home position, by the engine's own kinematics."""
    model = fused.read_model(mj_model)
    position = fused.paddle_position(model, MODEL, jnp.concatenate([HOME, jnp.zeros(7)]))
    np.testing.assert_allclose(position, [0.59356, 0.0, 0.04980], atol=1e-4)
    pose = chain.forward_kinematics(model.links, jnp.asarray(HOME))
    last = np.array(pose.world_rotation[-1])
    normal = (last @ np.array(model.paddle_rotation))[:, 2]
    np.testing.assert_allclose(np.abs(normal), [0.0, 0.0, 1.0], atol=1e-4)


class Arm(NamedTuple):
    """Random joint states with MuJoCo's data, and the links with their poses."""

    q: np.ndarray
    """[N, 6]."""
    v: np.ndarray
    """[N, 6]."""
    data: list[mujoco.MjData]
    links: tuple[chain.Link, ...]
    pose: chain.Pose


@pytest.fixture
def arm(mj_model, float64) -> Arm:
    """Eight random joint states."""
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-3.0, 3.0, (8, 6)), rng.uniform(-6.0, 6.0, (8, 6))
    data = [mujoco.MjData(mj_model) for _ in q]
    for d, angles, speeds in zip(data, q, v, strict=True):
        d.qpos[:6], d.qvel[:6] = angles, speeds
        mujoco.mj_forward(mj_model, d)
    links = fused.read_model(mj_model).links
    return Arm(q, v, data, links, chain.forward_kinematics(links, as_jax(q.T)))


def test_paddle_position_is_mujocos(mj_model, arm):
    """At random joint angles."""
    qpos = jnp.asarray([d.qpos for d in arm.data])
    position = jax.vmap(partial(fused.paddle_position, fused.read_model(mj_model), MODEL))(qpos)
    expected = [d.geom("blocker").xpos for d in arm.data]
    np.testing.assert_allclose(position, expected, atol=1e-13)


def test_mass_matrix_is_mujocos(mj_model, arm):
    """Reference: mj_fullM."""
    expected = np.zeros((len(arm.data), mj_model.nv, mj_model.nv))
    for matrix, d in zip(expected, arm.data, strict=True):
        mujoco.mj_fullM(mj_model, d, matrix)
    matrix = chain.mass_matrix(arm.links, arm.pose)
    np.testing.assert_allclose(stacked(matrix), expected[:, :6, :6], rtol=1e-10, atol=1e-12)


def test_bias_force_is_mujocos(mj_model, arm):
    """Reference: qfrc_bias, with gravity, Coriolis and centrifugal effects."""
    bias = chain.bias_force(arm.links, arm.pose, as_jax(arm.v.T), tuple(mj_model.opt.gravity))
    expected = [d.qfrc_bias[:6] for d in arm.data]
    np.testing.assert_allclose(np.transpose(bias), expected, rtol=1e-10, atol=1e-12)


def test_point_jacobian_is_mujocos(mj_model, arm):
    """Reference: mj_jac at a random point of the last link."""
    rng = np.random.default_rng(1)
    point, direction = rng.uniform(-1.0, 1.0, (2, len(arm.data), 3))
    row = chain.point_jacobian(arm.links, arm.pose, as_jax(point.T), as_jax(direction.T))
    body = mj_model.body("Link6").id
    for i, d in enumerate(arm.data):
        jacobian = np.zeros((3, mj_model.nv))
        mujoco.mj_jac(mj_model, d, jacobian, None, point[i], body)
        expected = direction[i] @ jacobian[:, :6]
        np.testing.assert_allclose([entry[i] for entry in row], expected, rtol=1e-10, atol=1e-12)


def test_sine_and_cosine_are_numpys():
    """In float32, over all angles of an arm and far beyond."""
    angle = np.linspace(-1000.0, 1000.0, 1_000_001, dtype=np.float32)
    sine, cosine = jax.jit(scalars.sine_cosine)(angle)
    # Two units in the last place of a number just below 1.
    np.testing.assert_allclose(sine, np.sin(angle.astype(float)), rtol=0, atol=1.2e-7)
    np.testing.assert_allclose(cosine, np.cos(angle.astype(float)), rtol=0, atol=1.2e-7)


@pytest.mark.usefixtures("float64")
def test_cholesky_and_its_solves_are_numpys():
    """On random positive definite matrices."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(8, 6, 6))
    matrix, b = root @ root.transpose(0, 2, 1) + np.eye(6), rng.normal(size=(8, 6))
    entries = [[jnp.asarray(matrix[:, i, j]) for j in range(6)] for i in range(6)]
    factor = chain.cholesky(entries)
    lower = np.linalg.cholesky(matrix)
    np.testing.assert_allclose(stacked(factor[0]), np.tril(lower, -1), rtol=1e-10, atol=1e-13)
    diagonal = np.diagonal(lower, axis1=1, axis2=2)
    np.testing.assert_allclose(np.transpose(factor[1]), 1.0 / diagonal, rtol=1e-10)
    for solve, system in (
        (chain.solve_lower, lower),
        (chain.solve_upper, lower.transpose(0, 2, 1)),
    ):
        x = np.transpose(solve(factor, as_jax(b.T)))
        np.testing.assert_allclose(
            x, np.linalg.solve(system, b[..., None])[..., 0], rtol=1e-9, atol=1e-12
        )


def stacked(matrix: chain.SquareMatrix) -> np.ndarray:
    """Stacks a matrix of batched scalars into one array [N, n, n]."""
    entries = np.broadcast_arrays(*(np.asarray(x) for row in matrix for x in row))
    return np.moveaxis(np.reshape(entries, (len(matrix), len(matrix), -1)), -1, 0)
