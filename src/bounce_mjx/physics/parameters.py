"""The state of the physics, and its parameters: the numbers of a model that may differ between
environments."""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np

Array = np.ndarray | jax.Array


class PhysicsState(NamedTuple):
    """Generalised coordinates in MuJoCo's order, the same for every engine."""

    qpos: jax.Array
    """Positions [nq]: joint angles in rad; each ball's position in m, quaternion [w, x, y, z]."""
    qvel: jax.Array
    """Velocities [nv]: joints in rad/s; each ball in m/s (world) and rad/s (its frame)."""


class PhysicsParameters(NamedTuple):
    """Physics parameters of one environment; None keeps the model's own value.

    Every engine replaces the model's value by the given one; the reference is `CEngine` of the
    model returned by `edited_model`. Quantities of the n acting joints and their links are in the
    order of `Addresses.arm_joints`. `jax.vmap` batches the arrays.
    """

    ball_mass: Array | None = None
    """Mass [] of the ball, kg, and of the first of several, to which the others stay in proportion;
    the inertia scales in proportion."""
    ball_radius: Array | None = None
    """Radius [] of the ball, m, and of the first of several, to which the others stay in
    proportion; the mass stays the same, the inertia scales with the square."""
    ball_inertia: Array | None = None
    """Moment of inertia [] of the balls per mass and squared radius: 2/5 of a solid ball, 2/3 of a
    hollow one. It acts only where a ball has friction."""
    contact_stiffness: Array | None = None
    """Stiffness [] of the contacts, 1/s^2: k of MuJoCo's direct `solref="-k -b"`."""
    contact_damping: Array | None = None
    """Damping [] of the contacts, 1/s: b of `solref="-k -b"`."""
    contact_friction: Array | None = None
    """Coefficient [] of sliding friction between ball and paddle, and between balls
    (`physics.friction`); it turns a frictionless pair into one with `condim="3"`."""
    servo_gain: Array | None = None
    """Stiffness [n] of the position servos at their actuators, N m/rad: `kp`."""
    servo_damping: Array | None = None
    """Damping [n] of the position servos at their actuators, N m s/rad: `kv`."""
    force_limit: Array | None = None
    """Largest torques [n] of the position servos at their joints, N m: `forcerange` times `gear`. A
    servo that is weaker keeps its own range."""
    armature: Array | None = None
    """Rotor inertia [n] at the joints, kg m^2."""
    damping: Array | None = None
    """Viscous damping [n] of the joints, N m s/rad."""
    frictionloss: Array | None = None
    """Dry friction [n] of the joints, N m: `frictionloss`; the mjx engine refuses it."""
    link_mass: Array | None = None
    """Masses [n] of the links, kg; first moment and inertia scale in proportion, the centre of mass
    stays in place."""
    paddle_position: Array | None = None
    """Centre [3] of the paddle in the frame of its body, m."""
    paddle_rotation: Array | None = None
    """Orientation [4] of the paddle in the frame of its body: a unit quaternion w, x, y, z."""
    gravity: Array | None = None
    """Gravitational acceleration [3] in the world, m/s^2: the MJCF's `<option gravity>`."""
    entries: Mapping[str, Array] | None = None
    """Other entries [] of the MjModel by their names, such as `dof_damping[2]`, `geom_size[3, 0]`
    or `opt.gravity[2]`; they prevail over the fields above. The fused engine refuses the name of an
    entry that it does not read; the mjx engine takes those that `mjx.Model` has."""


MODEL_PARAMETERS = PhysicsParameters()
"""The model's own parameters: no value is replaced."""
