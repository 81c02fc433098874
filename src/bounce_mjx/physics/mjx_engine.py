"""The mjx engine: MuJoCo's own JAX implementation, for any model that has the task's names."""

import contextlib
import copy
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from bounce_mjx.errors import UserError
from bounce_mjx.physics.parameters import PhysicsParameters, edited_fields
from bounce_mjx.physics.state import PhysicsState
from bounce_mjx.robot.model import find_addresses


class MjxModel(NamedTuple):
    """Constants of the mjx engine."""

    model: mjx.Model
    mj_model: mujoco.MjModel
    """Its source."""
    paddle_geom: int


def read_model(mj_model: mujoco.MjModel) -> MjxModel:
    """Constants of a compiled model.

    Raises:
      UserError: mjx does not implement a feature of the model.
    """
    try:
        model = mjx.put_model(mj_model)
    except NotImplementedError as error:
        raise UserError(
            f"MJX does not support this model ({error}); change the MJCF, or use --physics fused"
        ) from error
    return MjxModel(model, copy.copy(mj_model), find_addresses(mj_model).paddle_geom)


def step(
    constants: MjxModel,
    parameters: PhysicsParameters,
    state: PhysicsState,
    ctrl: jax.Array,
    num_substeps: int = 1,
) -> PhysicsState:
    """Advances one environment by `num_substeps` physics steps under a constant `ctrl` [nu]."""
    with _full_precision():
        model = in_world(constants, parameters)
        data = mjx.make_data(model).replace(qpos=state.qpos, qvel=state.qvel, ctrl=ctrl)
        if state.act is not None:
            data = data.replace(act=state.act)
        data = jax.lax.fori_loop(0, num_substeps, lambda _, carry: mjx.step(model, carry), data)
    return PhysicsState(data.qpos, data.qvel, None if state.act is None else data.act)


def paddle_position(
    constants: MjxModel, parameters: PhysicsParameters, qpos: jax.Array
) -> jax.Array:
    """World position [3] (m) of the paddle's centre at qpos [nq]."""
    with _full_precision():
        model = in_world(constants, parameters)
        data = mjx.make_data(model).replace(qpos=qpos)
        return mjx.kinematics(model, data).geom_xpos[constants.paddle_geom]


def in_world(constants: MjxModel, parameters: PhysicsParameters) -> mjx.Model:
    """The model with the given numbers of one environment."""
    numbers = jax.tree.map(jnp.asarray, parameters)
    fields, options = edited_fields(constants.mj_model, numbers)
    replaced = fields | {f"opt.{name}": value for name, value in options.items()}
    # MJX transforms every geom, whether or not it is known to share its body's frame.
    replaced.pop("geom_sameframe", None)
    return constants.model.tree_replace(replaced)


def _full_precision() -> contextlib.AbstractContextManager:
    """Keeps MJX's matrix products in float32: the default on a GPU is tf32, whose three digits
    make the ball bounce wrong."""
    return jax.default_matmul_precision("highest")
