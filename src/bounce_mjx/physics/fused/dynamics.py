"""Steps of the fused engine, unrolled into scalar arithmetic while tracing.

Under `jax.vmap` each scalar becomes one array over the batch. XLA fuses a physics step into a few
loops; on a GPU one kernel computes all physics steps of a control step (`gpu/elementwise.py`). One
physics step is `forward.substep`.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from bounce_mjx.gpu.elementwise import elementwise
from bounce_mjx.physics.control import Control, servo_target
from bounce_mjx.physics.fused import chain
from bounce_mjx.physics.fused.ball import Ball, read_ball, spin_in_ball, turn
from bounce_mjx.physics.fused.constraint import paddle_centre
from bounce_mjx.physics.fused.forward import Motion, substep
from bounce_mjx.physics.fused.model import FusedModel, read_model
from bounce_mjx.physics.parameters import PhysicsParameters, PhysicsState
from bounce_mjx.physics.scalars import Scalar, Vec, scalars_of


def step(
    model: FusedModel,
    parameters: PhysicsParameters,
    state: PhysicsState,
    control: Control,
    num_substeps: int = 1,
) -> PhysicsState:
    """Advances one environment by `num_substeps` physics steps.

    Parameters that are not None are inputs of the program; the others fold into it as constants.
    The loop carries the coordinates as scalars. Without sliding friction a contact's force goes
    through the ball's centre and the spin stays constant, so one rotation over the whole interval
    updates the orientation; with it, each physics step changes the spin (`fused.friction`).

    Args:
      model: from `read_model`.
      parameters: of the environment.
      state: before the steps.
      control: over the steps.
      num_substeps: number of physics steps.
    """
    addresses = model.addresses
    qpos = [state.qpos[i] for i in range(len(state.qpos))]
    qvel = [state.qvel[i] for i in range(len(state.qvel))]
    balls = []
    for at in addresses.balls:
        balls.append(read_ball([qpos[i] for i in at.qpos], [qvel[i] for i in at.qvel]))
    if control.ball_push is not None:
        balls = _pushed(balls, control.ball_push)
    spins_change = _has_sliding_friction(model, parameters)
    moving_balls = balls
    if not spins_change:
        moving_balls = [ball._replace(turning=None) for ball in balls]
    start = Motion(
        q=Vec(qpos[i] for i in addresses.arm_qpos),
        v=Vec(qvel[i] for i in addresses.arm_qvel),
        balls=tuple(moving_balls),
    )
    end = _run(model, parameters, control, start, num_substeps)

    _put(qpos, addresses.arm_qpos, end.q)
    _put(qvel, addresses.arm_qvel, end.v)
    for at, ball, ball_before in zip(addresses.balls, end.balls, balls, strict=True):
        if spins_change:
            turning = ball.turning
            _put(qvel, at.qvel[3:], spin_in_ball(turning))
        else:
            turning = turn(ball_before.turning, num_substeps * model.dt)
        _put(qpos, at.qpos, (*ball.position, *turning.orientation))
        _put(qvel, at.qvel[:3], ball.velocity)
    return PhysicsState(jnp.stack(qpos), jnp.stack(qvel))


def paddle_position(model: FusedModel, parameters: PhysicsParameters, qpos: jax.Array) -> jax.Array:
    """World position [3] (m) of the paddle's centre at qpos [nq]."""
    # What moves the centre; a turn of the paddle (`geom_quat`) does not. The other parameters would
    # only be inputs of the program without use.
    fields = ("body_pos[", "geom_pos[", "qpos0[")
    entries = {}
    for name, value in (parameters.entries or {}).items():
        if name.startswith(fields):
            entries[name] = value
    relevant = PhysicsParameters(
        paddle_position=parameters.paddle_position, entries=entries or None
    )
    numbers, structure = jax.tree.flatten(scalars_of(relevant, qpos.dtype))
    # A separate kernel: XLA takes long to fuse such a chain with the surrounding program.
    position = elementwise(_paddle_position(model, structure), num_results=3)
    return jnp.stack(position(*(qpos[i] for i in model.addresses.arm_qpos), *numbers))


def _has_sliding_friction(model: FusedModel, parameters: PhysicsParameters) -> bool:
    """Whether a contact of this environment can have sliding friction."""
    if any(contact.friction is not None for contact in model.contacts):
        return True
    if parameters.contact_friction is not None:
        return True
    return any(name.startswith("pair_friction[") for name in parameters.entries or {})


def _pushed(balls: Sequence[Ball], ball_push: jax.Array) -> list[Ball]:
    """The balls after `Control.ball_push`."""
    pushes = jnp.reshape(ball_push, (-1, 3))
    pushed = []
    for ball, push in zip(balls, pushes, strict=True):
        velocity = ball.velocity + Vec(push[i] for i in range(3))
        pushed.append(ball._replace(velocity=velocity))
    return pushed


def _put(coordinates: list[Scalar], indices: Sequence[int], values: Sequence[Scalar]) -> None:
    for i, value in zip(indices, values, strict=True):
        coordinates[i] = value


def _run(
    model: FusedModel,
    parameters: PhysicsParameters,
    control: Control,
    motion: Motion,
    num_substeps: int,
) -> Motion:
    """The motion after some physics steps; the arguments are those of `step`, with the state as a
    `Motion`."""
    coordinates, motion_structure = jax.tree.flatten(motion)
    inputs = (_arm_control(control, model.addresses.actuators), parameters)
    inputs = scalars_of(inputs, coordinates[0].dtype)
    numbers, input_structure = jax.tree.flatten(inputs)
    substeps = _substeps(model, motion_structure, input_structure, num_substeps)
    advance = elementwise(substeps, num_results=len(coordinates))
    return motion_structure.unflatten(advance(*coordinates, *numbers))


def _arm_control(control: Control, actuators: tuple[int, ...]) -> Control:
    """Control of the arm's servos in the order of the joints, without the push."""

    def of_arm(array: jax.Array) -> jax.Array:
        if jnp.ndim(array) == 0:
            return array
        return jnp.stack([array[i] for i in actuators])

    return jax.tree.map(of_arm, control._replace(ball_push=None))


@functools.lru_cache(maxsize=16)
def _substeps(
    model: FusedModel,
    motion_structure: jax.tree_util.PyTreeDef,
    input_structure: jax.tree_util.PyTreeDef,
    num_substeps: int,
) -> Callable[..., tuple[Scalar, ...]]:
    """Physics steps as a function of scalars.

    Its arguments are the leaves of a `Motion`, then those of the `Control` and the parameters, as a
    GPU kernel takes numbers alone. The tree structures are in the cache's key because they say
    which program it is: a disturbance or a parameter that is None leaves its operations out, and a
    ball without `turning` does not turn. Thanks to the cache and the inline jit, JAX traces this
    long function once for all programs; a trace takes some tenths of a second.

    Args:
      model: the MJCF's; the parameters of each environment change it inside.
      motion_structure: of the first arguments, a `Motion`.
      input_structure: of the others, a `Control` and the `PhysicsParameters`.
      num_substeps: number of physics steps.
    """
    num_coordinates = motion_structure.num_leaves

    def substeps(*scalars: Scalar) -> tuple[Scalar, ...]:
        motion = motion_structure.unflatten(scalars[:num_coordinates])
        control, parameters = input_structure.unflatten(scalars[num_coordinates:])
        environment_model = read_model(model.mj_model, parameters, model.addresses)

        def one_step(i: jax.Array, motion: Motion) -> Motion:
            return substep(environment_model, motion, _targets(control, i), control.air_drag)

        motion = jax.lax.fori_loop(0, num_substeps, one_step, motion)
        return tuple(jax.tree.leaves(motion))

    return jax.jit(substeps, inline=True)


def _targets(control: Control, step: jax.Array) -> tuple[Scalar, ...]:
    """Servo targets during one physics step."""
    if control.previous is None and control.lag is None and control.moving is None:
        return control.ctrl
    step = jax.lax.convert_element_type(step, control.ctrl[0].dtype)

    targets = []
    for i in range(len(control.ctrl)):
        targets.append(servo_target(_of_servo(control, i), step))
    return tuple(targets)


def _of_servo(control: Control, i: int) -> Control:
    """The control of servo i alone: its number of each field that has one for every servo."""

    def has_one_for_each(field: Any) -> bool:
        # A NamedTuple such as `Control` itself is no such field.
        return type(field) is tuple

    def number(field: Any) -> Scalar:
        return field[i] if has_one_for_each(field) else field

    return jax.tree.map(number, control, is_leaf=has_one_for_each)


@functools.lru_cache(maxsize=16)
def _paddle_position(
    model: FusedModel, structure: jax.tree_util.PyTreeDef
) -> Callable[..., tuple[Scalar, ...]]:
    """`paddle_position` as a function of the joint angles and the given parameters; cached
    like `_substeps`."""
    num_joints = len(model.links)

    def position(*scalars: Scalar) -> tuple[Scalar, ...]:
        parameters = structure.unflatten(scalars[num_joints:])
        environment_model = read_model(model.mj_model, parameters, model.addresses)
        pose = chain.forward_kinematics(environment_model.links, scalars[:num_joints])
        return tuple(paddle_centre(environment_model, pose))

    return jax.jit(position, inline=True)
