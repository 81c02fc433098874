"""The mjx engine: MuJoCo's own JAX implementation, for any model that has the task's names."""

import contextlib
from typing import NamedTuple

import jax
import mujoco
from mujoco import mjx

from bounce_mjx.errors import UserError
from bounce_mjx.physics.state import PhysicsState
from bounce_mjx.robot.model import find_addresses


class MjxModel(NamedTuple):
    """Constants of the mjx engine."""

    model: mjx.Model
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
    return MjxModel(model, find_addresses(mj_model).paddle_geom)


def step(
    constants: MjxModel, state: PhysicsState, ctrl: jax.Array, num_substeps: int = 1
) -> PhysicsState:
    """Advances one environment by `num_substeps` physics steps under a constant `ctrl` [nu]."""
    with _full_precision():
        data = mjx.make_data(constants.model).replace(qpos=state.qpos, qvel=state.qvel, ctrl=ctrl)
        data = jax.lax.fori_loop(
            0, num_substeps, lambda _, carry: mjx.step(constants.model, carry), data
        )
    return PhysicsState(data.qpos, data.qvel)


def paddle_position(constants: MjxModel, qpos: jax.Array) -> jax.Array:
    """World position [3] (m) of the paddle's centre at qpos [nq]."""
    with _full_precision():
        data = mjx.make_data(constants.model).replace(qpos=qpos)
        return mjx.kinematics(constants.model, data).geom_xpos[constants.paddle_geom]


def _full_precision() -> contextlib.AbstractContextManager:
    """Keeps MJX's matrix products in float32: the default on a GPU is tf32, whose three digits
    make the ball bounce wrong."""
    return jax.default_matmul_precision("highest")
