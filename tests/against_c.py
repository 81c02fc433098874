"""The physics against MuJoCo's C engine: random states, steps of both, and their differences.

The friction of a ball is Coulomb's impulse after each of C's steps (`Coulomb`), written here anew.
"""

import copy
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.physics import (
    Control,
    PhysicsParameters,
    PhysicsState,
    edited_model,
    make_engine,
)
from bounce_mjx.physics.fused import dynamics
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.model import BallAddresses, find_addresses, load_model

HOME = np.deg2rad([0.0, 40.0, 110.0, 0.0, -60.0, 0.0])
HALF_SIZE = np.array([0.05, 0.065, 0.0035])
RADIUS = 0.019
DT = 1e-3
BATCH = 32
MODEL = PhysicsParameters()
XML = Path(resource_path("mjcf/bounce_ball.xml")).read_text()
PICOMETRE = 1e-12
# Largest difference of one step relative to the largest speed: room for the rounding errors of some
# thousand operations. (The ball's spin has the largest error: in MuJoCo, rounding of the contact's
# lever turns the ball; in the fused engine, nothing turns it.)
ONE_STEP = 1e-11


class States(NamedTuple):
    """Batch of states and servo targets, in the order of the unedited MJCF."""

    qpos: np.ndarray
    """Generalised positions [N, nq]."""
    qvel: np.ndarray
    """Generalised velocities [N, nv]."""
    ctrl: np.ndarray
    """Servo targets [N, nu], rad."""


def edited(old: str, new: str) -> mujoco.MjModel:
    """Shipped model with one piece of its MJCF replaced."""
    assert old in XML
    return mujoco.MjModel.from_xml_string(XML.replace(old, new, 1))


def converged(model: mujoco.MjModel, iterations: int = 100) -> mujoco.MjModel:
    """The model, edited so that C's solver converges to rounding error.

    In a trajectory the solver starts from the forces of the last step, and 20 iterations suffice.
    """
    model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, iterations, 50
    return model


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


def touching_states(model: mujoco.MjModel, count: int, seed: int) -> States:
    """`random_states`, but every third ball rolls on the paddle; some of these slip or leave."""
    states, _ = random_states(model, count, seed)
    rng = np.random.default_rng(seed)
    at = find_addresses(model)
    for i in range(0, count, 3):
        data = mujoco.MjData(model)
        states.qvel[i, :6] *= 0.1
        data.qpos[:], data.qvel[:] = states.qpos[i], states.qvel[i]
        mujoco.mj_fwdPosition(model, data)
        centre, axes = paddle_frame(model, states.qpos[i, :6])
        gap = -rng.uniform(0.0, 0.002)
        local = np.array([0.8, 0.8, 0.0]) * rng.uniform(-1.0, 1.0, 3) * HALF_SIZE
        local[2] = HALF_SIZE[2] + RADIUS + gap
        states.qpos[i, 6:9] = centre + axes @ local
        contact = states.qpos[i, 6:9] - axes[:, 2] * (RADIUS + 0.5 * gap)
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, contact, model.geom_bodyid[at.paddle_geom])
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, states.qpos[i, 9:])
        turning = np.cross(
            rotation.reshape(3, 3) @ states.qvel[i, 9:], contact - states.qpos[i, 6:9]
        )
        slip = rng.uniform(-1.0, 1.0, 3) * [0.3, 0.3, 0.1] * (i % 2)
        states.qvel[i, 6:9] = jacobian @ states.qvel[i] - turning + axes @ slip
    return states


def balls_model(num_balls: int, friction: float | None = None) -> mujoco.MjModel:
    """Shipped model with several balls, and a C solver that converges to rounding error."""
    model = load_model(None, 0.001, num_balls=num_balls)
    if friction is not None:
        model.pair_dim[:], model.pair_friction[:, :2] = 3, friction
    return converged(model)


def hostile_states(model: mujoco.MjModel, count: int, seed: int) -> States:
    """The first ball as in `random_states`. Each further ball is close to one before it, in a
    random direction or along a face of the paddle, which both then touch, or overlaps with it
    deeply; some of the balls are fast."""
    rng = np.random.default_rng(seed)
    num_balls = (model.nq - 6) // 7
    first, _ = random_states(load_model(None, 0.001), count, seed)
    qpos, qvel = np.zeros((count, model.nq)), np.zeros((count, model.nv))
    qpos[:, :13], qvel[:, :12] = first.qpos, first.qvel
    for i in range(count):
        _, axes = paddle_frame(model, qpos[i, :6])
        for ball in range(1, num_balls):
            direction = rng.normal(size=3)
            if rng.uniform() < 0.6:
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
    mj_model: mujoco.MjModel,
    qpos: np.ndarray,
    qvel: np.ndarray,
    rng: np.random.Generator,
    i: int = 0,
) -> None:
    """Puts ball i of one state above the paddle and the balls before it, in place."""
    at = find_addresses(mj_model)
    place = paddle_frame(mj_model, qpos[at.arm_qpos,])[0] + [0.0, 0.0, 0.1 * i]
    qpos[at.balls[i].qpos[:3],] = place + [*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.04, 0.1)]
    velocity = [*rng.uniform(-0.2, 0.2, 2), rng.uniform(-2.0, 0.0)]
    qvel[at.balls[i].qvel,] = [*velocity, *rng.uniform(-30.0, 30.0, 3)]


def frictionless(model: mujoco.MjModel) -> mujoco.MjModel:
    """Copy of the model in which no contact pair has friction."""
    copied = copy.copy(model)
    copied.pair_dim[:] = 1
    return copied


class Coulomb:
    """C's step of a model whose pairs have no friction, and then the impulse of each of them.

    Written without `physics.friction`: in the world, with the arm's full mass matrix, and with the
    mass, the inertia and the radius of each ball.
    """

    def __init__(self, model: mujoco.MjModel):
        """
        Args:
          model: with friction where a pair has `condim="3"`.
        """
        self.balls = find_addresses(model).balls
        self.pairs = []
        for pair in np.flatnonzero(model.pair_dim > 1):
            geoms = {int(model.pair_geom1[pair]), int(model.pair_geom2[pair])}
            touching = [i for i, ball in enumerate(self.balls) if ball.geom in geoms]
            self.pairs.append((len(touching), touching, geoms, float(model.pair_friction[pair, 0])))
        # Those with the paddle first.
        self.pairs.sort(key=lambda pair: pair[:2])
        self.model = frictionless(model) if self.pairs else model
        of_balls = {dof for ball in self.balls for dof in ball.qvel}
        self.arm = [dof for dof in range(model.nv) if dof not in of_balls]

    def step(self, data: mujoco.MjData) -> np.ndarray:
        """Advances data of `model` in place; returns the force of the first contact [3] along its
        normal and its tangents, N, NaN without a contact."""
        mujoco.mj_step(self.model, data)
        first = np.full(3, np.nan)
        if not data.ncon:
            return first
        normal_forces = []
        for i in range(data.ncon):
            wrench = np.zeros(6)
            mujoco.mj_contactForce(self.model, data, i, wrench)
            normal_forces.append(wrench[0])
        first[:] = normal_forces[0], 0.0, 0.0
        for _, balls, geoms, coefficient in self.pairs:
            for i, contact in enumerate(data.contact):
                if set(contact.geom.tolist()) != geoms:
                    continue
                largest = coefficient * normal_forces[i] * self.model.opt.timestep
                impulse = self._impulse(data, balls, contact, largest)
                if i == 0:
                    along_axes = contact.frame.reshape(3, 3) @ impulse
                    first[1:] = along_axes[1:] / self.model.opt.timestep
        return first

    def _impulse(
        self, data: mujoco.MjData, balls: list[int], contact: mujoco.MjContact, largest: float
    ) -> np.ndarray:
        """Impulse [3] on the last ball of a contact, of at most `largest`; changes the velocities.

        Positions, normals and the mass matrix of the data are those of the step's start."""
        *others, last = (self.balls[i] for i in balls)
        normal = contact.frame[:3] if contact.geom[1] == last.geom else -contact.frame[:3]
        slip, mobility = self._surface(data, last, -normal)
        if others:
            velocity, of_other = self._surface(data, others[0], normal)
        else:
            point = data.xpos[last.body] - self.model.geom_size[last.geom, 0] * normal
            velocity, of_other, arm_change = self._paddle(data, point)
        slip = slip - velocity
        slip -= normal * (normal @ slip)
        speed = np.linalg.norm(slip)
        if speed == 0.0:
            return np.zeros(3)
        to_stop = speed**2 / (slip @ (mobility + of_other) @ slip)
        impulse = -min(to_stop, largest / speed) * slip
        self._push(data, last, -normal, impulse)
        if others:
            self._push(data, others[0], normal, -impulse)
        else:
            data.qvel[self.arm] -= arm_change @ impulse
        return impulse

    def _surface(
        self, data: mujoco.MjData, ball: BallAddresses, towards: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Velocity [3] of a ball's surface, and what an impulse there changes of it [3, 3]."""
        radius = self.model.geom_size[ball.geom, 0]
        spin = ball_rotation(data, ball) @ data.qvel[list(ball.qvel[3:])]
        velocity = data.qvel[list(ball.qvel[:3])] + radius * np.cross(spin, towards)
        tangential = np.eye(3) - np.outer(towards, towards)
        by_mass = np.eye(3) / self.model.body_mass[ball.body]
        by_inertia = radius**2 / self.model.body_inertia[ball.body, 0] * tangential
        return velocity, by_mass + by_inertia

    def _paddle(
        self, data: mujoco.MjData, point: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same of a point of the paddle, and the joints' velocities per impulse [n, 3]."""
        model = self.model
        jacobian, mass_matrix = np.zeros((3, model.nv)), np.zeros((model.nv, model.nv))
        paddle = model.geom_bodyid[find_addresses(model).paddle_geom]
        mujoco.mj_jac(model, data, jacobian, None, point, paddle)
        mujoco.mj_fullM(model, data, mass_matrix)
        of_arm = jacobian[:, self.arm]
        arm_change = np.linalg.solve(mass_matrix[np.ix_(self.arm, self.arm)], of_arm.T)
        return of_arm @ data.qvel[self.arm], of_arm @ arm_change, arm_change

    def _push(
        self, data: mujoco.MjData, ball: BallAddresses, towards: np.ndarray, impulse: np.ndarray
    ) -> None:
        """Gives a ball an impulse on its surface."""
        lever = self.model.geom_size[ball.geom, 0] * towards
        spin_change = np.cross(lever, impulse) / self.model.body_inertia[ball.body, 0]
        data.qvel[list(ball.qvel[:3])] += impulse / self.model.body_mass[ball.body]
        data.qvel[list(ball.qvel[3:])] += ball_rotation(data, ball).T @ spin_change


def ball_rotation(data: mujoco.MjData, ball: BallAddresses) -> np.ndarray:
    """Rotation [3, 3] from the frame of a ball to the world."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, data.qpos[list(ball.qpos[3:])])
    return rotation.reshape(3, 3)


def c_steps(
    models: mujoco.MjModel | list[mujoco.MjModel], states: States
) -> tuple[PhysicsState, np.ndarray]:
    """One step of C (`Coulomb`) from each state in its own model or in the same, and the force of
    the first contact [N, 3] along its normal and its tangents; NaN without a contact."""
    if isinstance(models, list):
        laws = [Coulomb(model) for model in models]
    else:
        laws = [Coulomb(models)] * len(states.qpos)
    after, forces = [], []
    for law, *start in zip(laws, *states, strict=True):
        data = mujoco.MjData(law.model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = start
        forces.append(law.step(data))
        after.append((data.qpos.copy(), data.qvel.copy()))
    return PhysicsState(*map(np.array, zip(*after, strict=True))), np.array(forces)


def num_contacts(forces: np.ndarray) -> int:
    """Number of states with a contact, from the forces of `c_steps`."""
    return int(np.sum(~np.isnan(forces[:, 0])))


def num_pressed(model: mujoco.MjModel, states: States) -> np.ndarray:
    """Number of contacts with a force in each state."""
    model = frictionless(model)
    data, pressed = mujoco.MjData(model), []
    for data.qpos[:], data.qvel[:], data.ctrl[:] in zip(*states, strict=True):
        mujoco.mj_forward(model, data)
        force, forces = np.zeros(6), 0
        for contact in range(data.ncon):
            mujoco.mj_contactForce(model, data, contact, force)
            forces += force[0] > 0.0
        pressed.append(forces)
    return np.array(pressed)


def world(parameters: PhysicsParameters, i: int | slice) -> PhysicsParameters:
    """Parameters of world i from a batch [N, ...]."""
    return jax.tree.map(lambda array: np.asarray(array)[i], parameters)


def c_models(
    model: mujoco.MjModel, parameters: PhysicsParameters, count: int
) -> list[mujoco.MjModel]:
    """The edited model of each world, with a solver that converges to rounding error."""
    return [converged(edited_model(model, world(parameters, i))) for i in range(count)]


def fused_steps(model: mujoco.MjModel, parameters: PhysicsParameters, states: States):
    """One fused step from each state, operation by operation."""
    step = partial(dynamics.step, dynamics.read_model(model), num_substeps=1)
    axes = jax.tree.map(lambda x: 0 if np.ndim(x) else None, parameters)
    with jax.disable_jit():
        return jax.vmap(step, in_axes=(axes, 0, 0))(
            jax.tree.map(jnp.asarray, parameters),
            PhysicsState(jnp.asarray(states.qpos), jnp.asarray(states.qvel)),
            Control(jnp.asarray(states.ctrl)),
        )


def jit_mjx(function: Callable) -> Callable:
    """`jax.jit` of a function that steps MJX, on whose programs XLA aborts if it joins their loops,
    as it does in the tests (`conftest.py`)."""
    return jax.jit(function, compiler_options={"xla_backend_extra_options": ""})


class CBatch:
    """Batch of MuJoCo simulations with their own states, and their own models or the same."""

    def __init__(self, models: mujoco.MjModel | list[mujoco.MjModel], start: PhysicsState):
        if isinstance(models, list):
            self.laws = [Coulomb(model) for model in models]
        else:
            self.laws = [Coulomb(models)] * len(start.qpos)
        self.data = [mujoco.MjData(law.model) for law in self.laws]
        for data, qpos, qvel in zip(self.data, *start[:2], strict=True):
            data.qpos[:], data.qvel[:] = qpos, qvel

    def step(self, ctrl: np.ndarray, num_substeps: int) -> int:
        """Advances all simulations; returns the number of steps with a contact."""
        contacts = 0
        for law, data, targets in zip(self.laws, self.data, ctrl, strict=True):
            data.ctrl[:] = targets
            for _ in range(num_substeps):
                law.step(data)
                contacts += data.ncon
        return contacts

    @property
    def state(self) -> PhysicsState:
        return PhysicsState(
            np.array([data.qpos for data in self.data]), np.array([data.qvel for data in self.data])
        )


def near(qpos: np.ndarray, action: np.ndarray) -> np.ndarray:
    """Servo targets close to the angles [N, 6]."""
    return qpos[:, :6] + 0.03 * action


def free_run(
    base: mujoco.MjModel,
    models: list[mujoco.MjModel],
    parameters: PhysicsParameters,
    start: PhysicsState,
    rng: np.random.Generator,
    look: Callable[[mujoco.MjData], dict[str, float]],
    ctrl: Callable[[np.ndarray, np.ndarray], np.ndarray] = near,
    flight: int = 200,
) -> tuple[np.ndarray, int, dict[str, float]]:
    """2,000 physics steps of worlds in both engines, neither of which sees the other's state.

    A lost ball is dropped again, and all balls after each `flight` control steps. Bounces and balls
    that meet amplify differences: the engines must be closer at any time than two runs of C with
    balls that start a picometre apart.

    Args:
      base, parameters: what the fused engine reads: a model, and the parameters [N, ...].
      models: C's model of each world.
      look: figures of a state of C.
      ctrl: servo targets from generalised positions [N, nq] and random numbers [N, n] in [-1, 1].

    Returns:
      The largest difference of each world from C [N], the number of steps of C with a contact, and
      the means of what `look` saw.
    """
    at, engine, count = find_addresses(base), make_engine(base, "fused"), len(models)
    axes = jax.tree.map(lambda _: 0, parameters)
    step = jax.jit(
        jax.vmap(lambda p, s, u: engine.step(p, s, Control(u), 10), in_axes=(axes, 0, 0))
    )
    state, c, shifted = start, CBatch(models, start), CBatch(models, start)
    contacts, errors, apart, seen = 0, np.zeros(count), np.zeros(count), []
    for i in range(200):
        state = PhysicsState(*(np.array(x) for x in state[:2]))
        for model, data, twin, *ours in zip(models, c.data, shifted.data, *state[:2], strict=True):
            lowest = paddle_frame(model, data.qpos[at.arm_qpos,])[0][2] - 0.1
            for k, ball in enumerate(at.balls):
                if i % flight == 0 or data.qpos[ball.qpos[2]] < lowest:
                    drop_ball(model, data.qpos, data.qvel, rng, k)
                    for qpos, qvel in (ours, (twin.qpos, twin.qvel)):
                        qpos[ball.qpos,] = data.qpos[ball.qpos,]
                        qvel[ball.qvel,] = data.qvel[ball.qvel,]
                    twin.qpos[ball.qpos[2]] += PICOMETRE
        action = rng.uniform(-1.0, 1.0, (count, len(at.arm_qpos)))
        state = step(parameters, state, ctrl(state.qpos, action))
        contacts += c.step(ctrl(c.state.qpos, action), 10)
        shifted.step(ctrl(shifted.state.qpos, action), 10)
        errors = np.maximum(errors, differences(state, c.state))
        apart = np.maximum(apart, differences(shifted.state, c.state))
        assert np.all((errors < 1e-9) | (errors < apart))
        seen += [look(data) for data in c.data]
    assert np.quantile(errors, 0.9) < 1e-9
    return errors, contacts, {name: np.mean([x[name] for x in seen]) for name in seen[0]}


def differences(a: PhysicsState, b: PhysicsState) -> np.ndarray:
    """Largest difference of each state [N]."""
    return np.maximum(*(np.max(np.abs(x - y), axis=1) for x, y in zip(a[:2], b[:2], strict=True)))


def assert_same_step(actual: PhysicsState, expected: PhysicsState) -> None:
    """Checks each state to ONE_STEP times its largest speed, and prints the largest ratio."""
    fastest = np.max(np.abs(expected.qvel), axis=1, keepdims=True)
    error = np.max(np.abs(np.asarray(actual.qvel) - expected.qvel) / fastest)
    print(f"largest difference: {error:.1e}")
    assert error < ONE_STEP
    # The comparison includes the orientation, which has no unit of length.
    assert np.max(np.abs(np.asarray(actual.qpos) - expected.qpos) / fastest) < ONE_STEP * DT + 1e-15


def push_by_air(model: mujoco.MjModel, data: mujoco.MjData, drag: float) -> None:
    """Applies the force of the air on the ball by hand."""
    ball, velocity = model.body("ball_link"), data.qvel[6:9]
    force = -drag * np.linalg.norm(velocity) * velocity
    data.xfrc_applied[ball.id, :3] = ball.mass[0] * force
