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
    joint_angles = np.asarray(recording.joint_angles)
    running = np.asarray(recording.running)
    # The episode of each step in which the pair touches.
    episodes_of: dict[tuple[str, ...], list[int]] = {}
    for step, episode in np.argwhere(running):
        for pair in checker.touching(joint_angles[step, :, episode]) - allowed:
            names = tuple(sorted(map(checker.name, pair)))
            episodes_of.setdefault(names, []).append(int(episode))
    contacts = []
    for names, episodes in sorted(episodes_of.items()):
        contacts.append(ArmContact(names, len(set(episodes)), len(episodes)))
    return contacts


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
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        for height in heights:
            spec.worldbody.add_geom(type=plane, size=[5.0, 5.0, 0.1], pos=[0.0, 0.0, height])
        model = compile_spec(spec, path)
        self._model = model
        self._data = mujoco.MjData(model)
        self._addresses = find_addresses(model)
        is_plane = (model.geom_type == plane) & (model.geom_bodyid == 0)
        # MuJoCo sorts the geoms by body, those of the world in the order of their addition.
        planes = np.flatnonzero(is_plane)[-len(heights) :].tolist()
        self._planes = {geom: -1 - i for i, geom in enumerate(planes)}
        is_ball = np.isin(model.geom_bodyid, [ball.body for ball in self._addresses.balls])
        others = np.flatnonzero(~is_plane & ~is_ball).tolist()
        arm = [geom for geom in others if self._is_shape(geom)]
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        model.geom_contype[:] = model.geom_conaffinity[:] = 0
        model.geom_contype[arm] = model.geom_conaffinity[arm] = 1
        model.geom_conaffinity[planes] = 1
        # MuJoCo's broad phase has masks of the bodies.
        model.body_contype[:] = model.body_conaffinity[:] = 1
        # MuJoCo adds the margins of the two geoms.
        model.geom_margin[arm + planes] = 0.5 * margin
        # Nor shall the MJCF's own pairs, such as the balls and the paddle, touch.
        model.pair_margin[:] = -1.0

    def _is_shape(self, geom: int) -> bool:
        """Whether a geom is a collision shape: if its body has hidden ones, these are."""
        model = self._model
        groups = model.geom_group[model.geom_bodyid == model.geom_bodyid[geom]]
        return model.geom_group[geom] == HIDDEN_GROUP or HIDDEN_GROUP not in groups

    def touching(self, joint_angles: np.ndarray) -> set[tuple[int, int]]:
        """Pairs of parts that touch at joint angles [n], neighbours left out."""
        model = self._model
        data = self._data
        data.qpos[:] = model.qpos0
        data.qpos[list(self._addresses.arm_qpos)] = joint_angles
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        balls = {ball.geom for ball in self._addresses.balls}
        touching = set()
        for geoms in data.contact.geom[: data.ncon].tolist():
            one, other = sorted(map(self._part, geoms))
            if balls.isdisjoint(geoms) and not self._are_neighbours(one, other):
                touching.add((one, other))
        return touching

    def _part(self, geom: int) -> int:
        return self._planes.get(geom, int(self._model.body_weldid[self._model.geom_bodyid[geom]]))

    def _are_neighbours(self, one: int, other: int) -> bool:
        """Whether a joint connects two parts; or one is a plane, to which the other comes no
        closer.

        Args:
          one: the part with the smaller number.
        """
        model = self._model
        parent = model.body_weldid[model.body_parentid[other]]
        if one >= 0:
            return parent == one
        if other <= 0:
            return True
        # A link on the base that turns about a vertical axis keeps its height.
        joint = model.body_jntadr[other]
        is_vertical = joint >= 0 and abs(self._data.xaxis[joint][2]) > 0.999
        return parent == 0 and is_vertical

    def name(self, part: int) -> str:
        """A part's name in a message."""
        if part <= 0:
            return ("the base", "the floor", "the table")[-part]
        return self._model.body(part).name or f"body {part}"
