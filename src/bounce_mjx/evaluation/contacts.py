"""Contacts of the arm with itself and the floor, which the physics leaves out.

MuJoCo's own collision detection checks the arm's shapes in every step of a recording.
"""

from collections.abc import Iterable
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.robot.arm import HIDDEN_GROUP
from bounce_mjx.robot.model import find_addresses, load_model
from bounce_mjx.task.shown import Recording
from bounce_mjx.world.config import WorldConfig

_MARGIN = 0.002
_FLOOR = "the floor"


class ArmContact(NamedTuple):
    """Two bodies that touch in a recording."""

    bodies: tuple[str, str]
    episodes: int
    """Number of episodes in which they touch."""
    steps: int
    """Number of control steps."""


def arm_contacts(
    config: WorldConfig, recording: Recording, margin: float = _MARGIN
) -> list[ArmContact]:
    """Bodies of the arm that touch each other or the floor in recorded episodes.

    Neighbours in the chain may touch, and so may bodies whose shapes overlap at the start pose, as
    hulls of meshes do. The floor is the plane z = 0, or a table of this height.

    Args:
      margin: distance that counts as a contact, m.
    """
    checker = _Checker(config, margin)
    allowed = checker.touching(np.array(config.default_joint_angles))
    joint_angles, running = (np.asarray(x) for x in (recording.joint_angles, recording.running))
    found: dict[tuple[str, str], list[int]] = {}
    for step, episode in np.argwhere(running):
        for pair in checker.touching(joint_angles[step, :, episode]) - allowed:
            found.setdefault(pair, []).append(int(episode))
    return [ArmContact(pair, len(set(of)), len(of)) for pair, of in sorted(found.items())]


def describe_contacts(contacts: Iterable[ArmContact], episodes: int) -> str:
    """Contacts in one line."""
    pairs = [f"{a} with {b} in {n} ({steps} steps)" for (a, b), n, steps in contacts]
    return f"contacts of the arm in {episodes} episodes: {'; '.join(pairs) or 'none'}"


class _Checker:
    """The arm with its own contacts, and a floor."""

    def __init__(self, config: WorldConfig, margin: float):
        self._model = model = load_model(config.mjcf, config.physics_dt, robot=config.robot)
        addresses = find_addresses(model)
        self._addresses, self._data = addresses, mujoco.MjData(model)
        balls = {ball.body for ball in addresses.balls}
        plane = (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.geom_bodyid == 0)
        arm = [
            geom
            for geom in range(model.ngeom)
            if model.geom_bodyid[geom] not in balls and not plane[geom] and self._is_shape(geom)
        ]
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        model.geom_contype[:] = model.geom_conaffinity[:] = 0
        model.geom_contype[arm] = model.geom_conaffinity[arm] = 1
        model.geom_conaffinity[plane] = 1
        model.body_contype[:] = model.body_conaffinity[:] = 1
        model.geom_margin[arm] = margin
        model.pair_margin[:] = -1.0

    def _is_shape(self, geom: int) -> bool:
        """Whether a geom is a collision shape: if its body has hidden ones, these are."""
        model = self._model
        own = model.geom_group[model.geom_bodyid == model.geom_bodyid[geom]]
        return model.geom_group[geom] == HIDDEN_GROUP or HIDDEN_GROUP not in own

    def touching(self, joint_angles: np.ndarray) -> set[tuple[str, str]]:
        """Pairs of bodies that touch at joint angles [n], neighbours left out."""
        model, data = self._model, self._data
        data.qpos[list(self._addresses.arm_qpos)] = joint_angles
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        balls = {ball.geom for ball in self._addresses.balls}
        pairs = set()
        for one, other in data.contact.geom[: data.ncon].tolist():
            if not {one, other} & balls and not self._are_neighbours(one, other):
                pairs.add(tuple(sorted((self._name(one), self._name(other)))))
        return pairs

    def _are_neighbours(self, one: int, other: int) -> bool:
        """Whether two geoms are of one moving link, or of two that a joint connects."""
        model = self._model
        links = [model.body_weldid[model.geom_bodyid[geom]] for geom in (one, other)]
        if any(model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE for geom in (one, other)):
            return links[0] == links[1]
        parents = [model.body_weldid[model.body_parentid[link]] for link in links]
        return links[0] in (links[1], parents[1]) or links[1] == parents[0]

    def _name(self, geom: int) -> str:
        model = self._model
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            return _FLOOR
        link = model.body_weldid[model.geom_bodyid[geom]]
        return model.body(link).name if link else "the base"
