"""Contacts of the arm with itself and the floor, which the physics leaves out.

MuJoCo's own collision detection checks the arm's shapes in every step of a recording.
"""

from collections.abc import Iterable
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.robot.arm import HIDDEN_GROUP, compile_spec
from bounce_mjx.robot.model import find_addresses, scene_spec
from bounce_mjx.task.task import Recording
from bounce_mjx.world.config import WorldConfig

# Distance that counts as a contact, m.
_MARGIN = 0.002


class ArmContact(NamedTuple):
    """Two bodies that touch in a recording."""

    bodies: tuple[str, ...]
    episodes: int
    """Number of episodes in which they touch."""
    steps: int
    """Number of control steps."""


def arm_contacts(config: WorldConfig, recording: Recording) -> list[ArmContact]:
    """Bodies of the arm that touch each other or the floor, z = 0, in recorded episodes.

    Neighbours in the chain may touch, and so may bodies whose shapes overlap at the start pose, as
    hulls of meshes do.
    """
    checker = ContactChecker(config, _MARGIN)
    allowed = checker.touching(np.array(config.default_joint_angles))
    joint_angles, running = (np.asarray(x) for x in (recording.joint_angles, recording.running))
    found: dict[tuple[str, ...], list[int]] = {}
    for step, episode in np.argwhere(running):
        for pair in checker.touching(joint_angles[step, :, episode]) - allowed:
            names = tuple(sorted(map(checker.name, pair)))
            found.setdefault(names, []).append(int(episode))
    return [ArmContact(pair, len(set(of)), len(of)) for pair, of in sorted(found.items())]


def describe_contacts(contacts: Iterable[ArmContact], episodes: int) -> str:
    """Contacts in one line."""
    pairs = [f"{a} with {b} in {n} ({steps} steps)" for (a, b), n, steps in contacts]
    return f"contacts of the arm in {episodes} episodes: {'; '.join(pairs) or 'none'}"


class ContactChecker:
    """The arm with its own contacts, over the floor and a table. Its parts are numbers: a body of
    the model, 0 for the base, and -1 and -2 for the floor and the table."""

    def __init__(self, config: WorldConfig, margin: float, table_height: float | None = None):
        """Compiles the model.

        Args:
          margin: distance that counts as a contact, m.
          table_height: of a table under the arm, m; None for the floor alone.
        """
        spec, path = scene_spec(config.mjcf, config.robot)
        heights = [0.0] if table_height is None else [0.0, table_height]
        size, kind = [5.0, 5.0, 0.1], mujoco.mjtGeom.mjGEOM_PLANE
        for height in heights:
            spec.worldbody.add_geom(type=kind, size=size, pos=[0.0, 0.0, height])
        self._model = model = compile_spec(spec, path)
        self._addresses, self._data = find_addresses(model), mujoco.MjData(model)
        own = (model.geom_type == kind) & (model.geom_bodyid == 0)
        # MuJoCo sorts the geoms by body, those of the world in the order of their addition.
        self._planes = {int(g): -1 - i for i, g in enumerate(np.flatnonzero(own)[-len(heights) :])}
        planes, balls = list(self._planes), {ball.body for ball in self._addresses.balls}
        arm = [
            geom
            for geom in range(model.ngeom)
            if model.geom_bodyid[geom] not in balls and not own[geom] and self._is_shape(geom)
        ]
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        model.geom_contype[:] = model.geom_conaffinity[:] = 0
        model.geom_contype[arm] = model.geom_conaffinity[arm] = 1
        model.geom_conaffinity[planes] = 1
        model.body_contype[:] = model.body_conaffinity[:] = 1
        # MuJoCo adds the margins of the two geoms.
        model.geom_margin[arm + planes] = 0.5 * margin
        model.pair_margin[:] = -1.0

    def _is_shape(self, geom: int) -> bool:
        """Whether a geom is a collision shape: if its body has hidden ones, these are."""
        model = self._model
        own = model.geom_group[model.geom_bodyid == model.geom_bodyid[geom]]
        return model.geom_group[geom] == HIDDEN_GROUP or HIDDEN_GROUP not in own

    def touching(self, joint_angles: np.ndarray) -> set[tuple[int, int]]:
        """Pairs of parts that touch at joint angles [n], neighbours left out."""
        model, data = self._model, self._data
        data.qpos[:] = model.qpos0
        data.qpos[list(self._addresses.arm_qpos)] = joint_angles
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        balls = {ball.geom for ball in self._addresses.balls}
        found = data.contact.geom[: data.ncon].tolist()
        pairs = {tuple(sorted(map(self._part, pair))) for pair in found if not balls & set(pair)}
        return {pair for pair in pairs if not self._are_neighbours(*pair)}

    def _part(self, geom: int) -> int:
        return self._planes.get(geom, int(self._model.body_weldid[self._model.geom_bodyid[geom]]))

    def _are_neighbours(self, one: int, other: int) -> bool:
        """Whether a joint connects two parts. A link that turns about a vertical axis on its base
        comes no closer to a plane."""
        model = self._model
        parent = model.body_weldid[model.body_parentid[other]]
        joint = model.body_jntadr[other]
        if one >= 0:
            return parent == one
        vertical = joint >= 0 and abs(self._data.xaxis[joint][2]) > 0.999
        return other == 0 or (parent == 0 and vertical)

    def name(self, part: int) -> str:
        """A part's name in a message."""
        if part <= 0:
            return ("the base", "the floor", "the table")[-part]
        return self._model.body(part).name or f"body {part}"
