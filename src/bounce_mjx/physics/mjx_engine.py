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
from bounce_mjx.physics.edited import MIN_FRICTION, edited
from bounce_mjx.physics.parameters import PhysicsParameters, PhysicsState
from bounce_mjx.physics.scalars import scalars_of
from bounce_mjx.robot.model import Addresses, BallAddresses, find_addresses


class MjxModel(NamedTuple):
    """Constants of the mjx engine."""

    model: mjx.Model
    mj_model: mujoco.MjModel
    """Its source."""
    addresses: Addresses


def read_model(mj_model: mujoco.MjModel, addresses: Addresses | None = None) -> MjxModel:
    """Constants of a compiled model that the engine supports (`support.py`); `addresses` are those
    of its parts, if they are known."""
    return MjxModel(mjx.put_model(mj_model), mj_model, addresses or find_addresses(mj_model))


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

    def substep(i: jax.Array, data: mjx.Data) -> mjx.Data:
        data = data.replace(ctrl=servo_target(control, i.astype(data.qpos.dtype)))
        if control.air_drag is not None:
            data = _with_drag(model, balls, data, control.air_drag)
        return _step(model, data)

    with _full_precision():
        model = environment_model(constants, parameters)
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
    mj_model = constants.mj_model
    numbers = scalars_of(parameters, jnp.result_type(float))
    model_edits = edited(mj_model, constants.addresses, numbers)
    if model_edits.rows("dof_frictionloss"):
        # After one step from 2 of 24 states with a slow arm, MJX differed from C by up to
        # 0.02 rad/s, whatever the solver's tolerance.
        raise UserError(
            "the mjx physics does not support dry friction that differs between environments "
            "(frictionloss); use --physics fused"
        )
    # MJX transforms every geom, even one flagged as sharing its body's frame.
    names = model_edits.fields - {"geom_sameframe", "pair_dim"}
    fields = {name: model_edits.array(name) for name in names}
    if "pair_friction" in fields:
        fields["pair_friction"] = jnp.maximum(fields["pair_friction"], MIN_FRICTION)
    model = constants.model
    if "pair_dim" in model_edits.fields:
        # MJX cannot change the dimension of a contact pair in a model that it has.
        frictional = copy.copy(mj_model)
        frictional.pair_dim[:] = model_edits.array("pair_dim")
        with jax.ensure_compile_time_eval():
            model = mjx.put_model(frictional)
    return model.tree_replace(fields)


def _full_precision() -> contextlib.AbstractContextManager:
    """Full float32 precision for MJX's matrix products. The default on a GPU, TF32, has three
    significant digits, and the ball bounces wrongly."""
    return jax.default_matmul_precision("highest")
