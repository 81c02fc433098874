"""The delay of a model's servos: how late a joint follows its target."""

from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.robot.model import find_addresses


class Servos(NamedTuple):
    """The servos of a model, at its joints.

    A joint that moves steadily lags behind its target by the torque of all damping divided by the
    servo's stiffness: the delay (damping + joint's own damping) / stiffness, which is also the mean
    of the answer to a step.
    """

    stiffness: np.ndarray
    """[n], N m / rad."""
    damping: np.ndarray
    """Of the servo itself [n], N m s / rad."""
    joint_damping: np.ndarray
    """Of the joint in its bearings and gears [n], N m s / rad, which no gain of the servo
    scales."""
    frictionloss: np.ndarray
    """Dry friction of the joint [n], N m."""

    def delays(
        self, gain: np.ndarray | float = 1.0, damping: np.ndarray | float = 1.0
    ) -> np.ndarray:
        """The delay of each joint [..., n], s, with its stiffness and its servo's damping times
        these factors [..., n]."""
        return (self.damping * damping + self.joint_damping) / (self.stiffness * gain)

    def damping_for(self, delay: float, gain: float, limits: tuple[float, float]) -> np.ndarray:
        """The factor [n] of the servo's damping with which each joint follows late by a delay (s),
        as far as the limits allow; 1 for a servo without any."""
        wanted = delay * self.stiffness * gain - self.joint_damping
        has_damping = self.damping > 0.0
        factor = np.where(has_damping, wanted / np.where(has_damping, self.damping, 1.0), 1.0)
        return np.clip(factor, *limits)


def servos_of(model: mujoco.MjModel) -> Servos:
    """The servos of a robot's model."""
    addresses = find_addresses(model)
    actuators = list(addresses.actuators)
    squared_gear = model.actuator_gear[actuators, 0] ** 2
    return Servos(
        stiffness=model.actuator_gainprm[actuators, 0] * squared_gear,
        damping=-model.actuator_biasprm[actuators, 2] * squared_gear,
        joint_damping=model.dof_damping[list(addresses.arm_qvel)],
        frictionloss=model.dof_frictionloss[list(addresses.arm_qvel)],
    )
