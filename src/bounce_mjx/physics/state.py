"""State of the physics, the same for every engine."""

from typing import NamedTuple

import jax


class PhysicsState(NamedTuple):
    """Generalised coordinates in MuJoCo's order."""

    qpos: jax.Array
    """Positions [nq]: joint angles in rad; each ball's position in m, quaternion [w, x, y, z]."""
    qvel: jax.Array
    """Velocities [nv]: joints in rad/s; each ball in m/s (world) and rad/s (its frame)."""
    act: jax.Array | None = None
    """Activations [na] of the actuators; None if the model has none."""
