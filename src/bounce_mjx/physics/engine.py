"""Interface of the physics engines, and the choice of an engine for a model."""

import functools
from collections.abc import Callable
from typing import NamedTuple, NoReturn

import jax
import mujoco

from bounce_mjx.errors import UserError
from bounce_mjx.physics import fused
from bounce_mjx.physics.control import Control
from bounce_mjx.physics.convergence import solver_warning
from bounce_mjx.physics.parameters import PhysicsParameters, check_shapes
from bounce_mjx.physics.state import PhysicsState
from bounce_mjx.physics.support import unsupported_feature, unsupported_parameter
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
    return choice == "fused" or (
        choice == "auto" and unsupported_feature(mj_model, "fused") is None
    )


def make_engine(mj_model: mujoco.MjModel, choice: str) -> Engine:
    """Builds the engine `choice` ("auto", "fused" or "mjx") for a compiled model.

    Raises:
      UserError: the engine does not support the model.
    """
    name = "fused" if is_fused(mj_model, choice) else "mjx"
    _check_supported(mj_model, name)
    warnings: tuple[str, ...] = ()
    reason = f"chosen by --physics {choice}"
    if name == "fused":
        implementation = fused
        warning = solver_warning(mj_model)
        warnings = () if warning is None else (warning,)
        reason = "the model qualifies" if choice == "auto" else reason
    else:
        # MJX takes seconds to import.
        from bounce_mjx.physics import mjx_engine as implementation

        if choice == "auto":
            reason = _lacks("fused", unsupported_feature(mj_model, "fused"))
    constants = implementation.read_model(mj_model)
    num_joints = len(find_addresses(mj_model).arm_joints)

    def step(
        parameters: PhysicsParameters, state: PhysicsState, control: Control, num_substeps: int
    ) -> PhysicsState:
        check_shapes(parameters, num_joints)
        beyond = unsupported_parameter(mj_model, name, parameters)
        if beyond is not None:
            _refuse(beyond, unsupported_parameter(mj_model, _OTHER[name], parameters), name)
        return implementation.step(constants, parameters, state, control, num_substeps)

    paddle_position = functools.partial(implementation.paddle_position, constants)
    return Engine(name, reason, step, paddle_position, warnings)


_OTHER = {"fused": "mjx", "mjx": "fused"}


def _check_supported(mj_model: mujoco.MjModel, engine: str) -> None:
    beyond = unsupported_feature(mj_model, engine)
    if beyond is not None:
        _refuse(beyond, unsupported_feature(mj_model, _OTHER[engine]), engine)


def _refuse(beyond: str, beyond_other: str | None, engine: str) -> NoReturn:
    """Raises the error for a feature that the engine lacks, and for one that the other lacks."""
    if beyond_other is None:
        raise UserError(f"{_lacks(engine, beyond)}; use --physics {_OTHER[engine]}")
    if beyond == beyond_other:
        raise UserError(f"no physics engine here supports {beyond}; change the MJCF")
    other = _lacks(_OTHER[engine], beyond_other)
    raise UserError(f"{_lacks(engine, beyond)}, and {other}; change the MJCF")


def _lacks(engine: str, feature: str | None) -> str:
    return f"the {engine} physics does not support {feature}"
