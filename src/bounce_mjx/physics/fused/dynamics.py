"""Step of the fused engine, unrolled into scalar arithmetic while tracing.

Under `jax.vmap` each scalar becomes one array over the batch. XLA fuses a physics step into a few
loops; on a GPU one kernel computes all physics steps of a control step (`gpu/elementwise.py`).
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.gpu.elementwise import elementwise
from bounce_mjx.physics.control import Control, drag, servo_target
from bounce_mjx.physics.fused import chain, friction, joint_friction
from bounce_mjx.physics.fused.contact import normal_force, sphere_box
from bounce_mjx.physics.fused.model import FusedModel, Servo, in_world
from bounce_mjx.physics.fused.scalars import (
    Scalar,
    Vec3,
    add,
    dot,
    is_constant,
    matmul,
    matvec,
    mul,
    quaternion_product,
    scale,
    stored,
    sub,
    vadd,
)
from bounce_mjx.physics.parameters import PhysicsParameters
from bounce_mjx.physics.state import PhysicsState


class Motion(NamedTuple):
    """Coordinates changed by a physics step, one scalar each."""

    q: tuple[Scalar, ...]
    v: tuple[Scalar, ...]
    ball_position: Vec3
    ball_velocity: Vec3
    turning: friction.Turning | None
    """Spin and orientation of the ball; None without friction, as the spin is then constant."""


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
    addresses = model.addresses
    frictional = model.contact.friction is not None or parameters.contact_friction is not None
    motion = Motion(
        q=tuple(state.qpos[i] for i in addresses.arm_qpos),
        v=tuple(state.qvel[i] for i in addresses.arm_qvel),
        ball_position=tuple(state.qpos[i] for i in addresses.ball_qpos[:3]),
        ball_velocity=tuple(state.qvel[i] for i in addresses.ball_qvel[:3]),
        turning=friction.turning_of(*_orientation_and_spin(model, state)) if frictional else None,
    )
    if control.ball_push is not None:
        pushed = vadd(motion.ball_velocity, tuple(control.ball_push[i] for i in range(3)))
        motion = motion._replace(ball_velocity=pushed)
    leaves, tree = jax.tree.flatten(motion)
    inputs = (_arm_control(control, addresses.actuators), parameters)
    numbers, given = jax.tree.flatten(as_scalars(inputs, state.qpos.dtype))
    advance = elementwise(_substeps(model, tree, given, num_substeps), num_results=len(leaves))
    motion = tree.unflatten(advance(*leaves, *numbers))
    if motion.turning is None:
        quaternion = turn(*_orientation_and_spin(model, state), num_substeps * model.dt)
        spin = ()
    else:
        quaternion, spin = motion.turning.orientation, friction.spin_in_ball(motion.turning)

    qpos = [state.qpos[i] for i in range(model.nq)]
    qvel = [state.qvel[i] for i in range(model.nv)]
    positions = (*motion.q, *motion.ball_position, *quaternion)
    for i, value in zip(addresses.arm_qpos + addresses.ball_qpos, positions, strict=True):
        qpos[i] = value
    velocities = (*motion.v, *motion.ball_velocity, *spin)
    for i, value in zip(addresses.arm_qvel + addresses.ball_qvel, velocities, strict=False):
        qvel[i] = value
    return PhysicsState(jnp.stack(qpos), jnp.stack(qvel))


def _orientation_and_spin(
    model: FusedModel, state: PhysicsState
) -> tuple[tuple[Scalar, ...], Vec3]:
    """Orientation and spin of the ball in MuJoCo's coordinates."""
    addresses = model.addresses
    return (
        tuple(state.qpos[i] for i in addresses.ball_qpos[3:]),
        tuple(state.qvel[i] for i in addresses.ball_qvel[3:]),
    )


def paddle_position(model: FusedModel, parameters: PhysicsParameters, qpos: jax.Array) -> jax.Array:
    """World position [3] (m) of the paddle's centre at qpos [nq]."""
    relevant = PhysicsParameters(paddle_position=parameters.paddle_position)
    numbers, given = jax.tree.flatten(as_scalars(relevant, qpos.dtype))
    # A separate kernel: XLA takes long to fuse such a chain with the surrounding program.
    position = elementwise(_paddle_position(model, given), num_results=3)
    return jnp.stack(position(*(qpos[i] for i in model.addresses.arm_qpos), *numbers))


def _arm_control(control: Control, actuators: tuple[int, ...]) -> Control:
    """Control of the arm's servos in the order of the joints, without the push."""

    def chosen(ctrl: jax.Array | None) -> jax.Array | None:
        return None if ctrl is None else jnp.stack([ctrl[i] for i in actuators])

    return control._replace(
        ctrl=chosen(control.ctrl),
        previous=chosen(control.previous),
        filtered=chosen(control.filtered),
        ball_push=None,
    )


def as_scalars(arrays: Any, dtype: jnp.dtype) -> Any:
    """Arrays of one environment as scalars, or tuples of scalars, of one dtype."""

    def scalars(array: jax.Array) -> Scalar | tuple[Scalar, ...]:
        array = jnp.asarray(array, dtype)
        return array if array.ndim == 0 else tuple(array[i] for i in range(len(array)))

    return jax.tree.map(scalars, arrays)


@functools.lru_cache
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
        world = in_world(model, parameters)
        if control.air_drag is not None:
            world = dataclasses.replace(world, air_drag=control.air_drag)
        motion = jax.lax.fori_loop(
            0,
            num_substeps,
            lambda i, motion: substep(world, motion, _targets(control, i)),
            coordinates.unflatten(scalars[:num_coordinates]),
        )
        return tuple(jax.tree.leaves(motion))

    return jax.jit(substeps, inline=True)


def _targets(control: Control, step: jax.Array) -> tuple[Scalar, ...]:
    """Servo targets during one physics step."""
    if control.previous is None and control.lag is None:
        return control.ctrl
    step = jax.lax.convert_element_type(step, control.ctrl[0].dtype)
    none = (None,) * len(control.ctrl)
    servos = zip(control.ctrl, control.previous or none, control.filtered or none, strict=True)
    return tuple(
        servo_target(control._replace(ctrl=ctrl, previous=previous, filtered=filtered), step)
        for ctrl, previous, filtered in servos
    )


@functools.lru_cache
def _paddle_position(model: FusedModel, given: jax.tree_util.PyTreeDef) -> Callable[..., Vec3]:
    """`paddle_position` as a function of the joint angles and the given parameters; cached
    like `_substeps`."""
    n = len(model.links)

    def position(*scalars: Scalar) -> Vec3:
        world = in_world(model, given.unflatten(scalars[n:]))
        return _paddle_origin(world, chain.forward_kinematics(world.links, scalars[:n]))

    return jax.jit(position, inline=True)


def substep(model: FusedModel, motion: Motion, targets: tuple[Scalar, ...]) -> Motion:
    """One physics step: the equivalent of `mj_step`."""
    keep = _keep(model, motion)
    pose = keep(chain.forward_kinematics(model.links, motion.q))
    arm_gravity = scale(model.gravity, model.weight)
    bias = keep(chain.bias_force(model.links, pose, motion.v, arm_gravity))
    inertia = keep(chain.mass_matrix(model.links, pose))
    floating = chain.floating_force(model.links, pose, model.gravity)
    applied, servo_damping = [], []
    for link, servo, target, q, v, b, carried in zip(
        model.links, model.servos, targets, motion.q, motion.v, bias, floating, strict=True
    ):
        force, derivative = servo_force(servo, target, q, v)
        spring = mul(link.stiffness, sub(q, link.spring_position))
        applied.append(joint_force(servo, force, carried) - link.damping * v - add(b, spring))
        servo_damping.append(derivative)
    constraint_torque, ball_acceleration, spin_acceleration = constraint_response(
        model, motion, pose, inertia, applied
    )
    return integrate(
        model,
        motion,
        inertia,
        servo_damping,
        [add(a, c) for a, c in zip(applied, constraint_torque, strict=True)],
        ball_acceleration,
        spin_acceleration,
    )


def servo_force(servo: Servo, target: Scalar, q: Scalar, v: Scalar) -> tuple[Scalar, Scalar]:
    """Force of MuJoCo's affine actuator at its joint (N m, N) for the servo target, and the force's
    derivative with respect to the velocity; the derivative is 0 at the force limit."""
    if servo.ctrl_range is not None:
        target = jnp.clip(target, *servo.ctrl_range)
    gain, damping = servo.gain, servo.damping
    if servo.gain_stiffness or servo.gain_damping:
        gain = gain + servo.gain_stiffness * q + servo.gain_damping * v
        damping = damping + servo.gain_damping * target
    force = gain * target + servo.stiffness * q + servo.damping * v + servo.bias
    if servo.force_range is None:
        return force, damping
    least, most = servo.force_range
    free = (force > least) & (force < most)
    return jnp.clip(force, least, most), jnp.where(free, damping, 0.0)


def joint_force(servo: Servo, force: Scalar, carried: Scalar) -> Scalar:
    """Force of the servo and of gravity compensation on the joint. The limit of the joint does not
    change MuJoCo's derivative of the force."""
    if servo.joint_range is None:
        return add(force, carried)
    if servo.carries_weight:
        return jnp.clip(add(force, carried), *servo.joint_range)
    return add(jnp.clip(force, *servo.joint_range), carried)


def constraint_response(
    model: FusedModel,
    motion: Motion,
    pose: chain.Pose,
    inertia: chain.SquareMatrix,
    applied: list[Scalar],
) -> tuple[list[Scalar], Vec3, Vec3 | None]:
    """Joint forces from the contact and dry friction, total acceleration of the ball (m/s^2) and
    angular acceleration of the ball (rad/s^2, world); the last is None without sliding friction."""
    contact = sphere_box(
        model.contact,
        motion.ball_position,
        _paddle_origin(model, pose),
        matmul(pose.world_rotation[-1], model.paddle_rotation),
    )
    ball_free = scale(model.gravity, model.ball_weight)
    if not is_constant(model.air_drag):
        ball_free = vadd(ball_free, drag(model.air_drag, motion.ball_velocity))
    if motion.turning is not None:
        factor = stored(chain.cholesky(inertia))
        response = friction.contact_response(
            model,
            pose,
            factor,
            contact,
            joint_velocity=motion.v,
            half_applied=chain.solve_lower(factor, applied),
            ball=(motion.ball_position, motion.ball_velocity, motion.turning.spin),
            free_acceleration=ball_free,
        )
        ball_acceleration = vadd(ball_free, response.ball_acceleration)
        return response.joint_torque, ball_acceleration, response.spin_acceleration
    # A force along the normal has the same torque at the contact point and at the ball's centre.
    jacobian = [
        -entry
        for entry in chain.point_jacobian(model.links, pose, motion.ball_position, contact.normal)
    ]
    keep = _keep(model, motion)
    factor = keep(chain.cholesky(inertia))
    half_jacobian = chain.solve_lower(factor, jacobian)
    half_applied = chain.solve_lower(factor, applied)

    normal_velocity = dot(contact.normal, motion.ball_velocity)
    free_acceleration = dot(contact.normal, ball_free)
    inverse_inertia = 1.0 / model.ball_mass
    for j, v, half_j, half_a in zip(jacobian, motion.v, half_jacobian, half_applied, strict=True):
        normal_velocity = normal_velocity + j * v
        free_acceleration = free_acceleration + half_j * half_a
        inverse_inertia = inverse_inertia + half_j * half_j

    def contact_force(matrix: tuple[Scalar], acceleration: tuple[Scalar]) -> tuple[jax.Array]:
        return (normal_force(model.contact, contact, normal_velocity, *acceleration, *matrix),)

    (force,), dry_friction = joint_friction.contact_and_friction(
        model.links,
        factor,
        motion.v,
        half_applied,
        [half_jacobian],
        (inverse_inertia,),
        (free_acceleration,),
        contact_force,
    )
    ball_acceleration = vadd(ball_free, scale(contact.normal, force / model.ball_mass))
    torque = [add(j * force, f) for j, f in zip(jacobian, dry_friction, strict=True)]
    return torque, ball_acceleration, None


def integrate(
    model: FusedModel,
    motion: Motion,
    inertia: chain.SquareMatrix,
    servo_damping: Sequence[Scalar],
    torque: list[Scalar],
    ball_acceleration: Vec3,
    spin_acceleration: Vec3 | None,
) -> Motion:
    """MuJoCo's integrators implicitfast and Euler: semi-implicit Euler, implicit in the
    velocity-dependent forces of joint damping and, with implicitfast, of servos (documentation,
    "Computation", numerical integration)."""
    dt = model.dt
    implicit = [list(row) for row in inertia]
    for i, (link, derivative) in enumerate(zip(model.links, servo_damping, strict=True)):
        damping = link.damping if model.implicit_damping else 0.0
        if model.implicit_servos:
            damping = damping - derivative
        implicit[i][i] = add(implicit[i][i], dt * damping)
    factor = _keep(model, motion)(chain.cholesky(implicit))
    acceleration = chain.solve_upper(factor, chain.solve_lower(factor, torque))
    v = tuple(a + dt * b for a, b in zip(motion.v, acceleration, strict=True))
    q = tuple(a + dt * b for a, b in zip(motion.q, v, strict=True))
    ball_velocity = vadd(motion.ball_velocity, scale(ball_acceleration, dt))
    ball_position = vadd(motion.ball_position, scale(ball_velocity, dt))
    turning = motion.turning
    if turning is not None:
        turning = friction.turned(turning, spin_acceleration, dt)
    return Motion(q, v, ball_position, ball_velocity, turning)


def turn(quaternion: tuple[Scalar, ...], spin: Vec3, duration: float) -> tuple[Scalar, ...]:
    """Quaternion [w, x, y, z] after turning at a constant spin (rad/s, body frame): the axis-angle
    product of MuJoCo's mju_quatIntegrate."""
    w, x, y, z = quaternion
    inverse_norm = jax.lax.rsqrt(w * w + x * x + y * y + z * z)
    unit = tuple(c * inverse_norm for c in quaternion)
    squared_speed = dot(spin, spin)
    still = squared_speed == 0.0
    speed = jnp.sqrt(jnp.where(still, 1.0, squared_speed))
    half_angle = 0.5 * duration * speed
    sine = jnp.where(still, 0.0, jnp.sin(half_angle) / speed)
    cosine = jnp.where(still, 1.0, jnp.cos(half_angle))
    return quaternion_product(unit, (cosine, *scale(spin, sine)))


def _keep(model: FusedModel, motion: Motion) -> Callable[[Any], Any]:
    """`stored` in the long programs of models with friction, else the identity."""
    frictional = motion.turning is not None or any(map(joint_friction.has_friction, model.links))
    return stored if frictional else lambda values: values


def _paddle_origin(model: FusedModel, pose: chain.Pose) -> Vec3:
    return vadd(pose.world_origin[-1], matvec(pose.world_rotation[-1], model.paddle_origin))
