"""Interface of the physics engines, and the choice of an engine for a model."""

import functools
from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

import jax
import mujoco

from bounce_mjx.errors import UserError
from bounce_mjx.lazy import silence_mjx
from bounce_mjx.physics import fused
from bounce_mjx.physics.control import Control
from bounce_mjx.physics.convergence import solver_warning
from bounce_mjx.physics.parameters import PhysicsParameters, check_shapes
from bounce_mjx.physics.state import PhysicsState
from bounce_mjx.robot.model import find_addresses


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
    warnings: tuple[str, ...] = ()
    """Known differences from MuJoCo's C engine, one sentence each, shown to the user."""


def is_fused(mj_model: mujoco.MjModel, choice: str) -> bool:
    """Whether the engine `choice` ("auto", "fused" or "mjx") is fused for a compiled model; this
    starts no device of JAX's."""
    return choice == "fused" or (choice == "auto" and fused.unsupported_feature(mj_model) is None)


def make_engine(mj_model: mujoco.MjModel, choice: str) -> Engine:
    """Builds the engine `choice` ("auto", "fused" or "mjx") for a compiled model.

    Raises:
      UserError: the engine does not support the model.
    """
    beyond_fused = fused.unsupported_feature(mj_model)
    if is_fused(mj_model, choice):
        if beyond_fused is not None:
            beyond_mjx = _mjx_engine().unsupported_feature(mj_model)
            raise UserError(_refusal(beyond_fused, beyond_mjx, "fused"))
        reason = "the model qualifies" if choice == "auto" else "chosen by --physics fused"
        warning = solver_warning(mj_model)
        return _engine("fused", reason, fused, mj_model, () if warning is None else (warning,))
    mjx = _mjx_engine()
    beyond_mjx = mjx.unsupported_feature(mj_model)
    if beyond_mjx is not None:
        raise UserError(_refusal(beyond_fused, beyond_mjx, "mjx"))
    reason = "chosen by --physics mjx" if choice == "mjx" else _lacks("fused", beyond_fused)
    return _engine("mjx", reason, mjx, mj_model, ())


def _engine(
    name: str,
    reason: str,
    implementation: ModuleType,
    mj_model: mujoco.MjModel,
    warnings: tuple[str, ...],
) -> Engine:
    constants = implementation.read_model(mj_model)
    num_joints = len(find_addresses(mj_model).arm_joints)

    def step(
        parameters: PhysicsParameters, state: PhysicsState, control: Control, num_substeps: int
    ) -> PhysicsState:
        check_shapes(parameters, num_joints)
        _check_supported_parameters(name, mj_model, parameters)
        return implementation.step(constants, parameters, state, control, num_substeps)

    return Engine(
        name=name,
        reason=reason,
        step=step,
        paddle_position=functools.partial(implementation.paddle_position, constants),
        warnings=warnings,
    )


def _check_supported_parameters(
    engine: str, mj_model: mujoco.MjModel, parameters: PhysicsParameters
) -> None:
    """Checks that an engine which supports the model also supports the given parameters.

    Raises:
      UserError: the engine does not compute a given kind of friction.
    """
    if engine == "mjx" and parameters.frictionloss is not None:
        # After one step from 2 of 24 states with a slow arm, MJX differed from C by up to 0.02
        # rad/s, whatever the solver's tolerance.
        raise UserError(
            "the mjx physics does not compute dry friction that differs between environments "
            "(frictionloss), as MJX's solver does not always converge with it; use --physics "
            "fused or mujoco"
        )
    if engine == "fused" and parameters.contact_friction is not None:
        if fused.is_elliptic(mj_model):
            raise UserError(
                "the fused physics does not compute friction that differs between environments "
                '(contact_friction) with the MJCF\'s cone="elliptic"; use --physics mjx, or write '
                'cone="pyramidal"'
            )
    if engine == "fused" and mj_model.opt.noslip_iterations:
        for name in ("contact_friction", "frictionloss"):
            if getattr(parameters, name) is not None:
                raise UserError(
                    f"the fused physics does not compute friction that differs between "
                    f"environments ({name}) with the noslip solver, and the MJCF has "
                    f'noslip_iterations="{mj_model.opt.noslip_iterations}"; set it to 0 or leave '
                    "this friction out"
                )


def _mjx_engine() -> ModuleType:
    # The import is lazy because MJX takes seconds to import.
    silence_mjx()
    from bounce_mjx.physics import mjx_engine

    return mjx_engine


def _refusal(beyond_fused: str | None, beyond_mjx: str | None, choice: str) -> str:
    """Error message for a model with a feature that the chosen engine lacks."""
    if beyond_fused is not None and beyond_fused == beyond_mjx:
        return f"no physics engine here supports {beyond_fused}; change the MJCF"
    if beyond_fused is not None and beyond_mjx is not None:
        both = f"{_lacks('fused', beyond_fused)}, and {_lacks('mjx', beyond_mjx)}"
        return f"{both}; change the MJCF"
    if choice == "fused":
        return f"{_lacks('fused', beyond_fused)}; use --physics mjx"
    return f"{_lacks('mjx', beyond_mjx)}; use --physics fused"


def _lacks(engine: str, feature: str | None) -> str:
    return f"the {engine} physics does not support {feature}"
