"""Physics parameters for tests: the model's own ones, and random ones around them."""

import jax
import mujoco
import numpy as np

from bounce_mjx.physics import PhysicsParameters
from bounce_mjx.robot.contact import stiffness_and_damping
from bounce_mjx.robot.model import find_addresses, link_bodies


def own_parameters(mj_model: mujoco.MjModel) -> PhysicsParameters:
    """The model's own numbers, all of them given but for those that it has not: friction and
    force limits."""
    at = find_addresses(mj_model)
    links = link_bodies(mj_model, at)
    stiffness, damping = stiffness_and_damping(mj_model.pair_solref[0], mj_model.opt.timestep)
    return PhysicsParameters(
        ball_mass=mj_model.body_mass[at.balls[0].body],
        ball_radius=mj_model.geom_size[at.balls[0].geom, 0],
        ball_inertia=np.float64(0.4),
        contact_stiffness=np.float64(stiffness),
        contact_damping=np.float64(damping),
        servo_gain=mj_model.actuator_gainprm[at.actuators, 0],
        servo_damping=-mj_model.actuator_biasprm[at.actuators, 2],
        armature=mj_model.dof_armature[at.arm_qvel,],
        damping=mj_model.dof_damping[at.arm_qvel,],
        link_mass=np.array([np.sum(mj_model.body_mass[bodies]) for bodies in links]),
        paddle_position=mj_model.geom_pos[at.paddle_geom],
        paddle_rotation=mj_model.geom_quat[at.paddle_geom],
        gravity=mj_model.opt.gravity,
    )


def random_parameters(mj_model: mujoco.MjModel, count: int, seed: int) -> PhysicsParameters:
    """Worlds [N, ...] around the model's own one: all of `own_parameters`, drawn."""
    rng = np.random.default_rng(seed)
    own = own_parameters(mj_model)

    def scaled(array: np.ndarray) -> np.ndarray:
        return array * rng.uniform(0.7, 1.3, (count, *np.shape(array)))

    def shifted(array: np.ndarray, size: float) -> np.ndarray:
        return array + size * rng.uniform(-1.0, 1.0, (count, *np.shape(array)))

    drawn = jax.tree.map(scaled, own)
    quaternion = shifted(own.paddle_rotation, 0.05)
    return drawn._replace(
        damping=rng.uniform(0.0, 5.0, drawn.damping.shape),
        paddle_position=shifted(own.paddle_position, 0.01),
        paddle_rotation=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        gravity=shifted(own.gravity, 1.0),
    )
