"""The interface of a physics engine, and the choice of one for a model."""

import contextlib
import functools
import io
from collections.abc import Callable
from typing import NamedTuple

import jax
import mujoco

from bounce_mjx.errors import UserError
from bounce_mjx.physics import fused
from bounce_mjx.physics.parameters import PhysicsParameters
from bounce_mjx.physics.state import PhysicsState


class Engine(NamedTuple):
    """Pure functions over one environment; `jax.vmap` batches them."""

    name: str
    """fused or mjx."""
    reason: str
    """Why this one was chosen, for the user."""
    step: Callable[[PhysicsParameters, PhysicsState, jax.Array, int], PhysicsState]
    """(parameters, state, ctrl [nu], number of physics steps) -> state."""
    paddle_position: Callable[[PhysicsParameters, jax.Array], jax.Array]
    """(parameters, qpos [nq]) -> world position [3] of the paddle's centre, m."""
    warnings: tuple[str, ...] = ()
    """Differences to MuJoCo's C engine that the user should know; one sentence each."""


def make_engine(mj_model: mujoco.MjModel, choice: str) -> Engine:
    """Builds the engine `choice` ("auto", "fused" or "mjx") for a compiled model.

    Raises:
      UserError: the engine does not support the model.
    """
    if choice == "mjx":
        return _mjx(mj_model, "chosen by --physics mjx")
    try:
        constants = fused.read_model(mj_model)
    except fused.UnsupportedModelError as error:
        if choice == "fused":
            raise UserError(str(error)) from error
        return _mjx(mj_model, str(error).split(";")[0])
    return Engine(
        name="fused",
        reason="chosen by --physics fused" if choice == "fused" else "the model qualifies",
        step=functools.partial(fused.step, constants),
        paddle_position=functools.partial(fused.paddle_position, constants),
    )


def _mjx(mj_model: mujoco.MjModel, reason: str) -> Engine:
    # MJX takes a second to import, which the fused engine saves; and it prints a line for each of
    # its optional parts that is not installed.
    with contextlib.redirect_stdout(io.StringIO()):
        from bounce_mjx.physics import mjx_engine

    constants = mjx_engine.read_model(mj_model)
    return Engine(
        name="mjx",
        reason=reason,
        step=functools.partial(mjx_engine.step, constants),
        paddle_position=functools.partial(mjx_engine.paddle_position, constants),
    )
