"""The mjx engine: MuJoCo's own JAX implementation, for any model with the task's names."""

import contextlib
import copy
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from bounce_mjx.errors import UserError
from bounce_mjx.physics.control import Control, drag, servo_target
from bounce_mjx.physics.edited import EditedModel, edited
from bounce_mjx.physics.friction import (
    Grip,
    after_friction,
    ball_jacobian,
    grips,
    solver_model,
)
from bounce_mjx.physics.parameters import PhysicsParameters, PhysicsState
from bounce_mjx.physics.scalars import Scalar, scalars_of
from bounce_mjx.robot.model import Addresses, BallAddresses, find_addresses


class MjxModel(NamedTuple):
    """Constants of the mjx engine."""

    model: mjx.Model
    """For a solver of normal forces alone (`friction.solver_model`)."""
    mj_model: mujoco.MjModel
    """Its source."""
    addresses: Addresses


def read_model(mj_model: mujoco.MjModel, addresses: Addresses | None = None) -> MjxModel:
    """Constants of a compiled model that the engine supports (`support.py`); `addresses` are those
    of its parts, if they are known."""
    addresses = addresses or find_addresses(mj_model)
    model = mjx.put_model(solver_model(mj_model, addresses))
    return MjxModel(model, mj_model, addresses)


def step(
    constants: MjxModel,
    parameters: PhysicsParameters,
    state: PhysicsState,
    control: Control,
    num_substeps: int = 1,
) -> PhysicsState:
    """Advances one environment by `num_substeps` physics steps.

    Args:
      constants: from `read_model`.
      parameters: of the environment.
      state: before the steps.
      control: over the steps.
      num_substeps: number of physics steps.
    """
    balls = constants.addresses.balls
    edits = _edits(constants, parameters)
    coefficients = _coefficients(constants, edits)

    def substep(i: jax.Array, data: mjx.Data) -> mjx.Data:
        data = data.replace(ctrl=servo_target(control, i.astype(data.qpos.dtype)))
        if control.air_drag is not None:
            data = _with_drag(model, balls, data, control.air_drag)
        data = _step(model, data)
        for grip, coefficient in coefficients.items():
            data = _with_friction(model, constants.addresses, grip, coefficient, data)
        return data

    with _full_precision():
        model = _environment_model(constants, edits)
        data = mjx.make_data(model).replace(qpos=state.qpos, qvel=state.qvel)
        if control.ball_push is not None:
            pushed = np.concatenate([ball.qvel[:3] for ball in balls])
            data = data.replace(qvel=data.qvel.at[pushed].add(jnp.ravel(control.ball_push)))
        data = jax.lax.fori_loop(0, num_substeps, substep, data)
    return PhysicsState(data.qpos, data.qvel)


def _with_drag(
    model: mjx.Model, balls: Sequence[BallAddresses], data: mjx.Data, air_drag: jax.Array
) -> mjx.Data:
    """The data with the force of the air on each ball; `air_drag` is that of `Control`."""
    for ball in balls:
        velocity = data.qvel[np.array(ball.qvel[:3])]
        force = model.body_mass[ball.body] * jnp.stack(drag(air_drag, velocity))
        forces = data.xfrc_applied.at[ball.body, :3].set(force)
        data = data.replace(xfrc_applied=forces)
    return data


def _step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.step`, except that the integrator implicitfast is not implicit in the damping of a servo
    at its force limit: MuJoCo's C engine damps no such servo, and MJX does."""
    if int(model.opt.integrator) != int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST):
        return mjx.step(model, data)
    data = mjx.forward(model, data)
    limits = jnp.asarray(model.actuator_forcerange)
    force = data.actuator_force
    is_within = (limits[:, 0] < force) & (force < limits[:, 1])
    is_free = is_within | ~model.actuator_forcelimited
    damping = jnp.asarray(model.actuator_biasprm).at[:, 2].multiply(is_free)
    return mjx.implicit(model.tree_replace({"actuator_biasprm": damping}), data)


def paddle_position(
    constants: MjxModel, parameters: PhysicsParameters, qpos: jax.Array
) -> jax.Array:
    """World position [3] (m) of the paddle's centre at qpos [nq]."""
    with _full_precision():
        model = environment_model(constants, parameters)
        data = mjx.make_data(model).replace(qpos=qpos)
        return mjx.kinematics(model, data).geom_xpos[constants.addresses.paddle_geom]


def environment_model(constants: MjxModel, parameters: PhysicsParameters) -> mjx.Model:
    """Model with the parameters of one environment.

    Raises:
      UserError: they have dry friction of the joints.
    """
    return _environment_model(constants, _edits(constants, parameters))


def _edits(constants: MjxModel, parameters: PhysicsParameters) -> EditedModel:
    """The source with the parameters of one environment."""
    numbers = scalars_of(parameters, jnp.result_type(float))
    return edited(constants.mj_model, constants.addresses, numbers)


def _environment_model(constants: MjxModel, edits: EditedModel) -> mjx.Model:
    if edits.rows("dof_frictionloss"):
        # After one step from 2 of 24 states with a slow arm, MJX differed from C by up to
        # 0.02 rad/s, whatever the solver's tolerance.
        raise UserError(
            "the mjx physics does not support dry friction that differs between environments "
            "(frictionloss); use --physics fused"
        )
    # MJX transforms every geom, even one flagged as sharing its body's frame. The friction of a
    # pair is `_with_friction`'s.
    names = edits.fields - {"geom_sameframe", "pair_dim", "pair_friction"}
    return constants.model.tree_replace({name: edits.array(name) for name in names})


def _coefficients(constants: MjxModel, edits: EditedModel) -> dict[Grip, Scalar]:
    """Coefficient of friction of each contact that has one."""
    frictional = copy.copy(constants.mj_model)
    frictional.pair_dim[:] = edits.array("pair_dim")
    coefficients = {}
    for grip in grips(frictional, constants.addresses):
        coefficients[grip] = edits["pair_friction", grip.pair, 0]
    return coefficients


def _with_friction(
    model: mjx.Model, addresses: Addresses, grip: Grip, coefficient: Scalar, data: mjx.Data
) -> mjx.Data:
    """The data after a step, with the impulse of one contact's friction."""
    contact = data._impl.contact
    last = addresses.balls[grip.balls[-1]]
    if len(grip.balls) == 1:
        first_geom = addresses.paddle_geom
    else:
        first_geom = addresses.balls[grip.balls[0]].geom
    from_last = (contact.geom[:, 0] == last.geom) & (contact.geom[:, 1] == first_geom)
    to_last = (contact.geom[:, 1] == last.geom) & (contact.geom[:, 0] == first_geom)
    # A sphere has at most one contact with another geom.
    index = jnp.argmax(from_last | to_last)
    exists = jnp.any(from_last | to_last)
    force = data._impl.efc_force[jnp.asarray(contact.efc_address)[index]]
    largest = jnp.where(exists, coefficient * model.opt.timestep * force, 0.0)
    # MuJoCo's normal points from the first geom to the second one.
    normal = jnp.where(from_last[index], -1.0, 1.0) * contact.frame[index, 0]

    jacobian = _slip_jacobian(model, addresses, grip, normal, data)
    mass_matrix = mjx.full_m(model, data)

    def solve(force: jax.Array) -> jax.Array:
        return jnp.linalg.solve(mass_matrix, force)

    qvel = after_friction(data.qvel, jacobian, normal, largest, solve)
    return data.replace(qvel=qvel)


def _slip_jacobian(
    model: mjx.Model, addresses: Addresses, grip: Grip, normal: jax.Array, data: mjx.Data
) -> jax.Array:
    """Velocity [3, nv] of the last ball's surface relative to what it touches, per velocity."""
    jacobian = jnp.zeros((3, model.nv))
    for i, side in zip(reversed(grip.balls), (1.0, -1.0), strict=False):
        ball = addresses.balls[i]
        lever = normal * (-side * model.geom_size[ball.geom, 0])
        of_ball = ball_jacobian(data.qpos[np.array(ball.qpos[3:])], lever, jnp)
        jacobian = jacobian.at[:, np.array(ball.qvel)].add(side * of_ball)
    if len(grip.balls) == 1:
        (i,) = grip.balls
        ball = addresses.balls[i]
        # The centre at the step's start; qpos is that of its end.
        point = data.xpos[ball.body] - normal * model.geom_size[ball.geom, 0]
        body = model.geom_bodyid[addresses.paddle_geom]
        of_paddle, _ = mjx.jac(model, data, point, body)
        jacobian = jacobian - of_paddle.T
    return jacobian


def _full_precision() -> contextlib.AbstractContextManager:
    """Full float32 precision for MJX's matrix products. The default on a GPU, TF32, has three
    significant digits, and the ball bounces wrongly."""
    return jax.default_matmul_precision("highest")
