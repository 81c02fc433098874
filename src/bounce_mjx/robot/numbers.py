"""The numbers of a compiled model on which a simulation depends."""

import mujoco
import numpy as np

from bounce_mjx.errors import UserError

WORLD_OPTIONS = ("gravity", "wind", "density", "viscosity")
"""Fields of a model's options that act on all bodies."""

# Starts of the names of a model's fields with physics in them, and those of colours among them.
_PHYSICAL = ("body_", "jnt_", "dof_", "geom_", "pair_", "actuator_", "eq_", "tendon_", "qpos")
_PICTURED = ("geom_rgba", "geom_matid", "geom_group")
# Fields that MuJoCo's compiler can compute from others; an error names one of them last.
_DERIVED = frozenset(
    "actuator_acc0 actuator_length0 body_inertia body_invweight0 body_subtreemass dof_M0 "
    "dof_invweight0 dof_length geom_aabb geom_rbound".split()
)


def field_of(mj_model: mujoco.MjModel, name: str) -> np.ndarray:
    """A view of a model's field, or of one in its options, such as `opt.gravity`."""
    owner, _, field = name.rpartition(".")
    return np.asarray(getattr(mj_model.opt if owner == "opt" else mj_model, field))


def physical_fields(mj_model: mujoco.MjModel) -> list[str]:
    """Names of the model's fields with physics in them, not colours."""
    names = []
    for name in dir(mj_model):
        if name.startswith(_PHYSICAL) and not name.startswith(_PICTURED):
            names.append(name)
    return names


def check_numbers(mj_model: mujoco.MjModel) -> None:
    """Refuses numbers that MuJoCo compiles, and that nothing can simulate.

    Raises:
      UserError: a number is not finite, or a joint's damping, dry friction or armature is negative;
        the text starts with the number.
    """
    for name in ("dof_damping", "dof_frictionloss", "dof_armature"):
        least = np.min(getattr(mj_model, name), initial=0.0)
        if least < 0.0:
            raise UserError(f"the negative number {least:g} in {name}; give 0 or more")
    names = physical_fields(mj_model)
    names += [f"opt.{option}" for option in WORLD_OPTIONS]
    # Derived fields come last: the sentence must name a number that is in the file.
    names.sort(key=_DERIVED.__contains__)
    for name in names:
        values = field_of(mj_model, name)
        if not np.issubdtype(values.dtype, np.floating):
            continue
        wrong = values[~np.isfinite(values)]
        if wrong.size:
            shown = name.removeprefix("opt.")
            raise UserError(f"the number {wrong[0]} in {shown}; give finite numbers")
