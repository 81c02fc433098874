"""Interface of the physics engines, and the choice of an engine for a model."""

import copy
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import mujoco

from bounce_mjx.errors import UserError
from bounce_mjx.physics.control import Control
from bounce_mjx.physics.edited import check_shapes
from bounce_mjx.physics.fused import dynamics
from bounce_mjx.physics.parameters import PhysicsParameters, PhysicsState
from bounce_mjx.physics.support import unsupported_feature
from bounce_mjx.robot.model import check_servos, find_addresses


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


def is_fused(mj_model: mujoco.MjModel, choice: str) -> bool:
    """Whether the engine `choice` ("auto", "fused" or "mjx") is fused for a compiled model; this
    starts no device of JAX's."""
    return choice == "fused" or (
        choice == "auto" and unsupported_feature(mj_model, "fused") is None
    )


def make_engine(mj_model: mujoco.MjModel, choice: str) -> Engine:
    """Builds the engine `choice` ("auto", "fused" or "mjx") for a compiled model.

    Raises:
      UserError: an acting joint has no position servo, or the engine does not support the model.
    """
    check_servos(mj_model, find_addresses(mj_model))
    # Its programs are traced later, when somebody may have edited the model.
    mj_model = copy.copy(mj_model)
    name = "fused" if is_fused(mj_model, choice) else "mjx"
    lacking = {}
    for engine in (name, "fused"):
        feature = unsupported_feature(mj_model, engine)
        if feature is not None:
            lacking[engine] = f"the {engine} physics does not support {feature}"
    if name in lacking:
        other = "mjx" if name == "fused" else "fused"
        remedy = "change the MJCF" if len(lacking) == 2 else f"use --physics {other}"
        raise UserError(f"{', and '.join(lacking.values())}; {remedy}")
    reason = f"chosen by --physics {choice}"
    if choice == "auto":
        reason = lacking.get("fused", "the model qualifies")
    if name == "fused":
        implementation = dynamics
    else:
        # MJX takes seconds to import.
        from bounce_mjx.physics import mjx_engine as implementation
    constants = implementation.read_model(mj_model)

    def step(
        parameters: PhysicsParameters, state: PhysicsState, control: Control, num_substeps: int
    ) -> PhysicsState:
        check_shapes(mj_model, parameters)
        return implementation.step(constants, parameters, state, control, num_substeps)

    return Engine(name, reason, step, functools.partial(implementation.paddle_position, constants))
