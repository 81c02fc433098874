"""The torques that a model's servos can exert at their joints.

MuJoCo limits an actuator by its `forcerange`, which the `gear` multiplies, and a joint by its
`actuatorfrcrange`. Of an actuator that is no servo yet, whose control may limit it too,
`actuators.servo_settings` has the force limit.
"""

from collections.abc import Sequence

import mujoco
import numpy as np


def force_ranges(mj_model: mujoco.MjModel, servos: Sequence[int]) -> np.ndarray:
    """Lower and upper ends [2, n] of the `forcerange` of actuators [n]; infinite without a
    limit."""
    low, high = mj_model.actuator_forcerange[list(servos)].T
    is_limited = mj_model.actuator_forcelimited[list(servos)].astype(bool)
    return np.stack([np.where(is_limited, low, -np.inf), np.where(is_limited, high, np.inf)])


def torque_ranges(
    mj_model: mujoco.MjModel, joints: Sequence[int], servos: Sequence[int]
) -> np.ndarray:
    """Least and greatest torque [2, n] (N m, or N of a slide) of the servos [n] of joints [n];
    infinite without a limit."""
    gears = mj_model.actuator_gear[list(servos), 0]
    low, high = np.sort(gears * force_ranges(mj_model, servos), axis=0)
    joint_low, joint_high = mj_model.jnt_actfrcrange[list(joints)].T
    is_limited = mj_model.jnt_actfrclimited[list(joints)].astype(bool)
    return np.stack(
        [
            np.where(is_limited, np.maximum(low, joint_low), low),
            np.where(is_limited, np.minimum(high, joint_high), high),
        ]
    )


def largest_torques(
    mj_model: mujoco.MjModel, joints: Sequence[int], servos: Sequence[int]
) -> np.ndarray:
    """Largest torque [n] (N m, or N of a slide) that the servos exert in either direction: the
    smaller of both ends; infinite without a limit."""
    low, high = torque_ranges(mj_model, joints, servos)
    return np.minimum(-low, high)


def limit_torques(
    mj_model: mujoco.MjModel, servos: Sequence[int], torques: Sequence[float]
) -> None:
    """Narrows the `forcerange` of servos [n] to torques [n] (N m) at their joints; a weaker servo
    keeps its own. Each has 0 in its range (`model.check_servos`)."""
    forces = np.asarray(torques) / np.abs(mj_model.actuator_gear[list(servos), 0])
    low, high = force_ranges(mj_model, servos)
    narrowed = np.stack([np.maximum(low, -forces), np.minimum(high, forces)], axis=1)
    mj_model.actuator_forcerange[list(servos)] = narrowed
    mj_model.actuator_forcelimited[list(servos)] = True
