"""Interface of the physics engines, and the choice of an engine for a model."""

import copy
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import mujoco

from bounce_mjx.errors import UserError
from bounce_mjx.physics.control import Control
from bounce_mjx.physics.edited import check_shapes, own_parameters
from bounce_mjx.physics.fused import dynamics
from bounce_mjx.physics.parameters import PhysicsParameters, PhysicsState
from bounce_mjx.physics.support import unsupported_feature
from bounce_mjx.robot.model import Addresses, check_servos, find_addresses


class Engine(NamedTuple):
    """Pure functions of one environment; `jax.vmap` batches them."""

    name: str
    """fused or mjx."""
    reason: str
    """Reason for the choice, shown to the user."""
    step: Callable[[PhysicsParameters, PhysicsState, Control, int], PhysicsState]
    """(parameters, state, control, number of physics steps) -> state."""
    paddle_position: Callable[[PhysicsParameters, jax.Array], jax.Array]
    """(parameters, qpos [nq]) -> world position [3] of the paddle's centre, m."""


def is_fused(mj_model: mujoco.MjModel, choice: str, addresses: Addresses | None = None) -> bool:
    """Whether the engine `choice` ("auto", "fused" or "mjx") is fused for a compiled model
    (`world.model.world_model`); this starts no device of JAX's."""
    if choice != "auto":
        return choice == "fused"
    return unsupported_feature(mj_model, "fused", addresses) is None


def make_engine(
    mj_model: mujoco.MjModel, choice: str, addresses: Addresses | None = None
) -> Engine:
    """Builds the engine `choice` ("auto", "fused" or "mjx") for a compiled model.

    Args:
      mj_model: the model; the engine keeps a copy of it.
      choice: of the engine.
      addresses: of the model's parts, if they are known.

    Raises:
      UserError: an acting joint has no position servo, or the engine does not support the model.
    """
    addresses = addresses or find_addresses(mj_model)
    check_servos(mj_model, addresses)
    # Its programs are traced later, when somebody may have edited the model.
    mj_model = copy.copy(mj_model)
    why_not_fused = _refusal(mj_model, "fused", addresses)
    if choice == "auto":
        name = "fused" if why_not_fused is None else "mjx"
        reason = why_not_fused or "the model qualifies"
    else:
        name = choice
        reason = f"chosen by --physics {choice}"
    if name == "fused":
        if why_not_fused is not None:
            raise UserError(f"{why_not_fused}; use --physics mjx")
        implementation = dynamics
    else:
        _check_mjx(mj_model, addresses, why_not_fused)
        # MJX takes seconds to import.
        from bounce_mjx.physics import mjx_engine as implementation
    constants = implementation.read_model(mj_model, addresses=addresses)
    model_parameters = own_parameters(mj_model, addresses)

    def step(
        parameters: PhysicsParameters, state: PhysicsState, control: Control, num_substeps: int
    ) -> PhysicsState:
        check_shapes(model_parameters, parameters)
        return implementation.step(constants, parameters, state, control, num_substeps)

    paddle_position = functools.partial(implementation.paddle_position, constants)
    return Engine(name, reason, step, paddle_position)


def _refusal(mj_model: mujoco.MjModel, engine: str, addresses: Addresses) -> str | None:
    """What an engine lacks for a model, in words; None if it supports the model."""
    feature = unsupported_feature(mj_model, engine, addresses)
    return None if feature is None else f"the {engine} physics does not support {feature}"


def _check_mjx(mj_model: mujoco.MjModel, addresses: Addresses, why_not_fused: str | None) -> None:
    """Refuses a model that MJX does not support, with the engine that does."""
    why_not_mjx = _refusal(mj_model, "mjx", addresses)
    if why_not_mjx is None:
        return
    if why_not_fused is None:
        raise UserError(f"{why_not_mjx}; use --physics fused")
    raise UserError(f"{why_not_mjx}, and {why_not_fused}; change the MJCF")
