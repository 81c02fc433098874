"""The numbers of a compiled model on which a simulation depends."""

import mujoco
import numpy as np

from bounce_mjx.errors import UserError

DERIVED_FIELDS = frozenset(
    (
        "actuator_acc0",
        "actuator_length0",
        "body_inertia",
        "body_invweight0",
        "body_subtreemass",
        "dof_M0",
        "dof_invweight0",
        "dof_length",
        "geom_aabb",
        "geom_rbound",
    )
)
"""Fields that MuJoCo's compiler can compute from others."""


def check_numbers(mj_model: mujoco.MjModel) -> None:
    """Refuses a time step that is not positive, numbers that are not finite, and joints that gain
    energy.

    Raises:
      UserError: the text starts with the wrong number.
    """
    step = mj_model.opt.timestep
    if not 0.0 < step < np.inf:
        raise UserError(f"the timestep {step}; give a positive number of seconds")
    for name in ("dof_damping", "dof_frictionloss", "dof_armature"):
        least = np.min(getattr(mj_model, name), initial=0.0)
        if least < 0.0:
            raise UserError(f"the negative number {least:g} in {name}; give 0 or more")
    fields = [(mj_model, name) for name in physical_fields(mj_model)]
    fields += [(mj_model.opt, name) for name in ("gravity", "wind", "density", "viscosity")]
    # Derived fields come last: the message must name a number that is in the file.
    for owner, name in sorted(fields, key=lambda field: field[1] in DERIVED_FIELDS):
        values = np.asarray(getattr(owner, name))
        if np.issubdtype(values.dtype, np.floating) and not np.all(np.isfinite(values)):
            value = values[~np.isfinite(values)][0]
            raise UserError(f"the number {value} in {name}; give finite numbers")


def physical_fields(mj_model: mujoco.MjModel) -> list[str]:
    """Names of the model's fields with physics in them, not colours."""
    kinds = ("body_", "jnt_", "dof_", "geom_", "pair_", "actuator_", "eq_", "tendon_", "qpos")
    pictured = ("geom_rgba", "geom_matid", "geom_group")
    return [name for name in dir(mj_model) if name.startswith(kinds) and name not in pictured]
