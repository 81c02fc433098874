"""Step of the fused engine, unrolled into scalar arithmetic while tracing.

Under `jax.vmap` each scalar becomes one array over the batch. XLA fuses a physics step into a few
loops; on a GPU one kernel computes all physics steps of a control step (`gpu/elementwise.py`).
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.gpu.elementwise import elementwise
from bounce_mjx.physics.control import Control, drag, servo_target
from bounce_mjx.physics.fused import chain, joint_friction
from bounce_mjx.physics.fused.model import FusedModel, Servo, read_model
from bounce_mjx.physics.fused.response import contact_response, paddle_origin
from bounce_mjx.physics.parameters import PhysicsParameters, PhysicsState
from bounce_mjx.physics.scalars import (
    ZERO3,
    Quaternion,
    Scalar,
    Vec,
    add,
    mul,
    not_inlined,
    quaternion_matrix,
    quaternion_product,
    scalars_of,
    sine_cosine,
    sub,
)


class Turning(NamedTuple):
    """Spin and orientation of the ball."""

    spin: Vec
    """Angular velocity in the world, rad/s. Without a torque it is constant for a sphere, both in
    the world and in the ball's frame."""
    orientation: Quaternion
    """Unit quaternion w, x, y, z."""


class Ball(NamedTuple):
    """Coordinates of one ball."""

    position: Vec
    velocity: Vec
    turning: Turning | None
    """Spin and orientation; None if the spin is constant."""


class Motion(NamedTuple):
    """Coordinates changed by a physics step, one scalar each."""

    q: tuple[Scalar, ...]
    v: tuple[Scalar, ...]
    balls: tuple[Ball, ...]


def step(
    model: FusedModel,
    parameters: PhysicsParameters,
    state: PhysicsState,
    control: Control,
    num_substeps: int = 1,
) -> PhysicsState:
    """Advances one environment by `num_substeps` physics steps.

    Given parameters are inputs of the program; the others fold into it as constants. The loop
    carries the coordinates as scalars. Without friction the contact's force goes through the ball's
    centre and the spin stays constant, so one rotation over the whole interval updates the
    orientation.
    """
    at = model.addresses
    qpos, qvel = (_entries(x, range(len(x))) for x in (state.qpos, state.qvel))
    slides = any(name.startswith("pair_friction[") for name in parameters.entries or {})
    slides = slides or parameters.contact_friction is not None
    turns = slides or model.contacts[0].friction is not None
    turnings = [
        read_turning(_entries(qpos, x.qpos[3:]), _entries(qvel, x.qvel[3:])) for x in at.balls
    ]
    velocities = [_entries(qvel, x.qvel[:3]) for x in at.balls]
    if control.ball_push is not None:
        pushes = jnp.reshape(control.ball_push, (-1, 3))
        velocities = [v + _entries(pushes[k], range(3)) for k, v in enumerate(velocities)]
    balls = [
        Ball(_entries(qpos, x.qpos[:3]), velocity, turning if turns else None)
        for x, velocity, turning in zip(at.balls, velocities, turnings, strict=True)
    ]
    motion = Motion(_entries(qpos, at.arm_qpos), _entries(qvel, at.arm_qvel), tuple(balls))
    leaves, tree = jax.tree.flatten(motion)
    inputs = (_arm_control(control, at.actuators), parameters)
    numbers, given = jax.tree.flatten(scalars_of(inputs, state.qpos.dtype))
    advance = elementwise(_substeps(model, tree, given, num_substeps), num_results=len(leaves))
    motion = tree.unflatten(advance(*leaves, *numbers))

    qpos, qvel = list(qpos), list(qvel)
    _put(qpos, at.arm_qpos, motion.q)
    _put(qvel, at.arm_qvel, motion.v)
    for x, ball, before in zip(at.balls, motion.balls, turnings, strict=True):
        after = ball.turning or advance_turning(before, ZERO3, num_substeps * model.dt)
        _put(qpos, x.qpos, (*ball.position, *after.orientation))
        _put(qvel, x.qvel[:3], ball.velocity)
        if turns:
            _put(qvel, x.qvel[3:], quaternion_matrix(after.orientation).T @ after.spin)
    return PhysicsState(jnp.stack(qpos), jnp.stack(qvel))


def _entries(coordinates: jax.Array | Sequence[Scalar], indices: Sequence[int]) -> Vec:
    return Vec(coordinates[i] for i in indices)


def _put(coordinates: list[Scalar], indices: Sequence[int], values: Sequence[Scalar]) -> None:
    for i, value in zip(indices, values, strict=True):
        coordinates[i] = value


def paddle_position(model: FusedModel, parameters: PhysicsParameters, qpos: jax.Array) -> jax.Array:
    """World position [3] (m) of the paddle's centre at qpos [nq]."""
    fields = ("body_pos[", "geom_pos[", "qpos0[")
    entries = {x: y for x, y in (parameters.entries or {}).items() if x.startswith(fields)}
    relevant = PhysicsParameters(
        paddle_position=parameters.paddle_position, entries=entries or None
    )
    numbers, given = jax.tree.flatten(scalars_of(relevant, qpos.dtype))
    # A separate kernel: XLA takes long to fuse such a chain with the surrounding program.
    position = elementwise(_paddle_position(model, given), num_results=3)
    return jnp.stack(position(*(qpos[i] for i in model.addresses.arm_qpos), *numbers))


def _arm_control(control: Control, actuators: tuple[int, ...]) -> Control:
    """Control of the arm's servos in the order of the joints, without the push."""

    def chosen(x: jax.Array) -> jax.Array:
        return jnp.stack([x[i] for i in actuators]) if jnp.ndim(x) else x

    return jax.tree.map(chosen, control._replace(ball_push=None))


@functools.lru_cache(maxsize=16)
def _substeps(
    model: FusedModel,
    coordinates: jax.tree_util.PyTreeDef,
    given: jax.tree_util.PyTreeDef,
    num_substeps: int,
) -> Callable[..., tuple[Scalar, ...]]:
    """Physics steps as a function of scalars.

    Its arguments are the leaves of a `Motion` (tree structure `coordinates`), then the leaves of
    the `Control` and the parameters (tree structure `given`). Thanks to the cache and the inline
    jit, JAX traces this long function once for all programs; a trace takes some tenths of a second.
    """
    num_coordinates = coordinates.num_leaves

    def substeps(*scalars: Scalar) -> tuple[Scalar, ...]:
        control, parameters = given.unflatten(scalars[num_coordinates:])
        world = read_model(model.mj_model, parameters)
        motion = jax.lax.fori_loop(
            0,
            num_substeps,
            lambda i, motion: substep(world, motion, _targets(control, i), control.air_drag),
            coordinates.unflatten(scalars[:num_coordinates]),
        )
        return tuple(jax.tree.leaves(motion))

    return jax.jit(substeps, inline=True)


def _targets(control: Control, step: jax.Array) -> tuple[Scalar, ...]:
    """Servo targets during one physics step."""
    if control.previous is None and control.lag is None and control.moving is None:
        return control.ctrl
    step = jax.lax.convert_element_type(step, control.ctrl[0].dtype)

    def servo_control(i: int) -> Control:
        return jax.tree.map(
            lambda x: x[i] if type(x) is tuple else x, control, is_leaf=lambda x: type(x) is tuple
        )

    return tuple(servo_target(servo_control(i), step) for i in range(len(control.ctrl)))


@functools.lru_cache(maxsize=16)
def _paddle_position(
    model: FusedModel, given: jax.tree_util.PyTreeDef
) -> Callable[..., tuple[Scalar, ...]]:
    """`paddle_position` as a function of the joint angles and the given parameters; cached
    like `_substeps`."""
    n = len(model.links)

    def position(*scalars: Scalar) -> tuple[Scalar, ...]:
        world = read_model(model.mj_model, given.unflatten(scalars[n:]))
        return tuple(paddle_origin(world, chain.forward_kinematics(world.links, scalars[:n])))

    return jax.jit(position, inline=True)


def substep(
    model: FusedModel, motion: Motion, targets: tuple[Scalar, ...], air_drag: Scalar | None = None
) -> Motion:
    """One physics step: the equivalent of `mj_step` with the integrators implicitfast and Euler:
    semi-implicit Euler, implicit in the velocity-dependent forces of joint damping and, with
    implicitfast, of servos (documentation, "Computation", numerical integration)."""
    dt, links, balls = model.dt, model.links, motion.balls
    frictional = balls[0].turning is not None or any(map(joint_friction.has_friction, links))
    # The programs of models with friction are long.
    keep = not_inlined if frictional else lambda values: values
    pose = keep(chain.forward_kinematics(links, motion.q))
    bias = keep(chain.bias_force(links, pose, motion.v, model.gravity))
    inertia = keep(chain.mass_matrix(links, pose))
    floating = chain.floating_force(links, pose, model.gravity)
    applied, implicit = [], [list(row) for row in inertia]
    for i, (link, servo, target, q, v) in enumerate(
        zip(links, model.servos, targets, motion.q, motion.v, strict=True)
    ):
        force, derivative = servo_force(servo, target, q, v, floating[i])
        spring = mul(link.stiffness, sub(q, link.spring_position))
        applied.append(force - link.damping * v - add(bias[i], spring))
        damping = link.damping if model.implicit_damping else 0.0
        if model.implicit_servos:
            damping = damping - derivative
        implicit[i][i] = add(implicit[i][i], dt * damping)
    factor = keep(chain.cholesky(inertia))
    free = [model.gravity * ball.weight for ball in model.balls]
    if air_drag is not None:
        free = [a + drag(air_drag, ball.velocity) for a, ball in zip(free, balls, strict=True)]
    torque, *pushes = contact_response(
        model, pose, factor, motion.v, chain.solve_lower(factor, applied), balls, free, keep
    )
    factor = keep(chain.cholesky(implicit))
    half = chain.solve_lower(factor, list(map(add, applied, torque)))
    acceleration = chain.solve_upper(factor, half)
    v = Vec(a + dt * b for a, b in zip(motion.v, acceleration, strict=True))
    q = Vec(a + dt * b for a, b in zip(motion.q, v, strict=True))
    moved = []
    for ball, *accelerations in zip(balls, free, *pushes, strict=True):
        velocity = ball.velocity + (accelerations[0] + accelerations[1]) * dt
        turning = ball.turning and advance_turning(ball.turning, accelerations[2], dt)
        moved.append(Ball(ball.position + velocity * dt, velocity, turning))
    return Motion(q, v, tuple(moved))


def servo_force(
    servo: Servo, target: Scalar, q: Scalar, v: Scalar, carried: Scalar
) -> tuple[Scalar, Scalar]:
    """Force of a servo and of gravity compensation at a joint (N m, N) for the servo target, and
    the servo's derivative with respect to the velocity, which is 0 at the servo's force limit. The
    limit of the joint does not change MuJoCo's derivative.

    Args:
      carried: force of the gravity compensation.
    """
    if servo.ctrl_range is not None:
        target = jnp.clip(target, *servo.ctrl_range)
    force = servo.gain * target + servo.stiffness * q + servo.damping * v + servo.bias
    derivative = servo.damping
    if servo.force_range is not None:
        least, most = servo.force_range
        derivative = jnp.where((force > least) & (force < most), derivative, 0.0)
        force = jnp.clip(force, least, most)
    if servo.carries_weight:
        force, carried = add(force, carried), 0.0
    if servo.joint_range is not None:
        force = jnp.clip(force, *servo.joint_range)
    return add(force, carried), derivative


def read_turning(quaternion: Quaternion, spin: Vec) -> Turning:
    """Spin in the world and normalised orientation from MuJoCo's coordinates."""
    q = Vec(quaternion)
    orientation = tuple(q * jax.lax.rsqrt(q @ q))
    return Turning(quaternion_matrix(orientation) @ spin, orientation)


def advance_turning(turning: Turning, acceleration: Vec, dt: float) -> Turning:
    """Spin and orientation after a time dt, in which the new spin turns the orientation."""
    spin = turning.spin + acceleration * dt
    squared = spin @ spin
    still = squared < float(jnp.finfo(squared.dtype).tiny)
    inverse_speed = jax.lax.rsqrt(jnp.where(still, 1.0, squared))
    sine, cosine = sine_cosine(0.5 * dt * (squared * inverse_speed))
    rotation = (cosine, *(spin * (sine * inverse_speed)))
    return Turning(spin, quaternion_product(rotation, turning.orientation))
