"""Search of the start pose: a level paddle at a well-conditioned point in front of the robot.

Inverse kinematics by damped least squares (Wampler 1986; Buss 2004) from many seeds. The best pose
has, within 1%, the largest score of conditioning, distance to the joint limits and strength. The
same arm written in degrees and in radians, whose numbers differ by rounding, has the same start
pose, as almost equal scores are told apart by the posture. (A pose that lies exactly at a threshold
may be in or out.)
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.robot.arm import HIDDEN_GROUP
from bounce_mjx.robot.config import PaddleConfig
from bounce_mjx.robot.model import Addresses, data_at, joint_names, joint_ranges

# Length that makes rotations comparable with displacements: about a forearm, m/rad.
_LENGTH = 0.25
# Upward acceleration of the paddle that a bounce needs, m/s^2, and one that is plenty.
_LEAST_ACCELERATION = 3.0
_AMPLE_ACCELERATION = 20.0
# Smallest singular value of a usable pose; 1 would be an arm that moves as a sphere.
_LEAST_MANIPULABILITY = 0.02
# Scores within this share of the best one count as equal.
_EQUAL_SCORES = 0.01
# Of two mirrored postures, the one on the positive side of its joints is taken: distances count
# from this far beside the reference posture, rad.
_SIDE = 0.1

# Seeds of each goal.
_TRIES = 8
# Steps toward the goal with a level paddle, then steps that only level it: not every arm can do
# both.
_STEPS_TO_GOAL = 30
_STEPS_TO_LEVEL = 30
# Largest change of a joint in a step, rad or m.
_LARGEST_STEP = 0.4
# Damping of the least squares, m^2; levelling needs none.
_DAMPING = 1e-3
_NO_DAMPING = 1e-9
_LEVEL_TOLERANCE = 1e-9
# Number of random postures from which the reach is measured.
_REACH_SAMPLES = 500

# Distance of a pose from the joint limits, rad or m: the noise of a reset's joint positions. Of a
# short range it is a tenth.
_LEAST_MARGIN = 0.1
# Distance from the joint limits that is plenty, rad or m.
_AMPLE_MARGIN = 0.5
# Radius of the column over the paddle that is the ball's way, m.
_CLEARANCE = 0.09
# Least height of the lines between the joints, half the thickness of a link, m; within a radius
# around the first joint, at the base, they may be lower, but not below the floor.
_FLOOR_CLEARANCE = 0.07
_BASE_RADIUS = 0.2
# Lowest height of the paddle in the search, m: the links below it stay above the floor.
_LOWEST = 0.1
# Heights that must be free of the arm around the paddle, m: the ball flies above, and a paddle that
# lies flat on its site is 0.03 m above it.
_BELOW = 0.02
_HEADROOM = 1.0
# A height of the paddle at which it does not lie on the floor, m.
_OFF_FLOOR = 0.03
# Points of a link that are checked.
_SAMPLES_OF_A_LINK = 12
# Largest distance of the paddle from a shape that is measured, m.
_FAR = 0.5
# The quaternion of a handle along z in four turns about it by 90 degrees.
_HALF = math.sqrt(0.5)
_TURNS = (
    (_HALF, 0.0, -_HALF, 0.0),
    (0.5, 0.5, -0.5, 0.5),
    (0.0, _HALF, 0.0, _HALF),
    (-0.5, 0.5, 0.5, 0.5),
)


class PaddlePose(NamedTuple):
    """A start pose, with a level paddle."""

    angles: np.ndarray
    """Positions of the acting joints [n], rad; of a slide, m."""
    paddle: np.ndarray
    """Centre of the paddle [3], m."""
    mount: PaddleConfig
    """The paddle as it is held in this pose."""
    manipulability: float
    """Smallest singular value of the scaled Jacobian of the task directions."""
    acceleration: float
    """Largest upward acceleration of the paddle by the actuators' force limits, m/s^2."""
    inertia: np.ndarray
    """Reflected inertia of each acting joint [n]: the diagonal of the mass matrix, kg m^2 or kg."""
    holding: np.ndarray
    """Force of each acting joint that holds the arm [n], N m or N."""
    reach: float
    """Largest horizontal distance of the paddle from the first joint, m; measured once for all
    mounts, with that of the config."""
    score: float


def mounts(paddle: PaddleConfig) -> list[PaddleConfig]:
    """The paddle held by a handle along the site's z, in four turns about it, and flat on the
    site."""
    flat_on_site = {"position": (0.0, 0.0, 0.03), "quaternion": (1.0, 0.0, 0.0, 0.0)}
    choices = []
    for quaternion in _TURNS:
        on_handle = {"position": (0.0, 0.0, 0.19), "quaternion": quaternion}
        choices.append(paddle.model_copy(update=on_handle))
    choices.append(paddle.model_copy(update=flat_on_site))
    return choices


def rank_poses(
    model: mujoco.MjModel,
    addresses: Addresses,
    force_limits: Sequence[float | None],
    choices: Sequence[PaddleConfig],
) -> list[PaddlePose]:
    """Start poses of an arm in the task's scene, the best first.

    Args:
      model: the compiled scene; its paddle is moved.
      addresses: of its parts.
      force_limits: largest force of each acting joint, N m or N; None for no limit.
      choices: mounts of the paddle to try.

    Raises:
      UserError: the paddle cannot be level, tilted or lifted, or no servo is strong enough.
    """
    search = _Search(model, addresses, force_limits)
    names = ", ".join(joint_names(model, addresses))
    level: list[PaddlePose] = []
    for mount in choices:
        level += search.level_poses(mount)
    if not level:
        raise UserError(
            f"no reachable pose with a level paddle in front of the robot, {names} inside their "
            "ranges, and the links above the floor and out of the ball's way; check the site, the "
            "paddle's position and quaternion, and the height of the base"
        )
    able = [pose for pose in level if pose.manipulability >= _LEAST_MANIPULABILITY]
    if not able:
        raise UserError(
            f"no pose in which the joints {names} can lift the paddle and tilt it about two "
            "axes; give an arm with joints about more axes, or with wider ranges"
        )
    strong = [pose for pose in able if pose.acceleration >= _LEAST_ACCELERATION]
    if not strong:
        most = max(0.0, *(pose.acceleration for pose in able))
        raise UserError(
            "no servo strong enough: in addition to holding the arm, the actuators accelerate the "
            f"paddle upward by {most:.1f} m/s^2 at most, and the task needs "
            f"{_LEAST_ACCELERATION:g}; raise the force limits of {names}"
        )
    return search.rank(strong)


class _Search:
    """Level poses of one arm. `_qpos`, `_dofs` and `_joints` are the acting joints' places in
    MuJoCo's arrays; each posture is an array [n] of their positions, rad or m. The ends of their
    ranges are `_low` and `_high`, of the search `_least` and `_greatest`, and of its random seeds
    `_least_seed` and `_greatest_seed`: each pair lies within the one before."""

    def __init__(
        self, model: mujoco.MjModel, addresses: Addresses, force_limits: Sequence[float | None]
    ):
        self._model = model
        self._data = mujoco.MjData(model)
        self._rng = np.random.default_rng(0)
        self._limits = np.array([np.inf if limit is None else limit for limit in force_limits])
        self._qpos = np.array(addresses.arm_qpos)
        self._dofs = np.array(addresses.arm_qvel)
        self._joints = np.array(addresses.arm_joints)
        self._is_hinge = model.jnt_type[self._joints] == mujoco.mjtJoint.mjJNT_HINGE
        self._paddle = addresses.paddle_geom
        # The last link, to which the paddle's own body is welded.
        self._body = int(model.body_weldid[model.geom_bodyid[self._paddle]])
        self._low, self._high = joint_ranges(model, addresses)
        # A servo whose joint is at its limit could move it one way only.
        margin = np.minimum(_LEAST_MARGIN, 0.1 * (self._high - self._low))
        self._least = self._low + margin
        self._greatest = self._high - margin
        # MuJoCo's reference posture, in which most files draw the arm.
        self._reference = self._inside(model.qpos0[self._qpos])
        # The seeds of a hinge lie within half a turn.
        slide_width = np.where(np.isinf(self._low), 0.5, np.inf)
        width = np.where(self._is_hinge, np.pi, slide_width)
        self._least_seed = self._inside(self._reference - width)
        self._greatest_seed = self._inside(self._reference + width)
        mujoco.mj_kinematics(model, self._data)
        self._base = self._data.xanchor[self._joints[0]].copy()
        self._reach = self._largest_distance()

    def _inside(self, angles: np.ndarray) -> np.ndarray:
        """The angles [n], clipped to the ranges of the search."""
        return np.clip(angles, self._least, self._greatest)

    def _seed(self) -> np.ndarray:
        """A random posture [n]."""
        return self._rng.uniform(self._least_seed, self._greatest_seed)

    def _from_base(self, point: np.ndarray) -> float:
        """Horizontal distance of a point [3] from the first joint, m."""
        x, y, _ = point - self._base
        return float(np.hypot(x, y))

    def _largest_distance(self) -> float:
        """Largest horizontal distance of the paddle from the first joint, m."""
        largest = 0.0
        for _ in range(_REACH_SAMPLES):
            paddle, _ = self._forward(self._seed())
            largest = max(largest, self._from_base(paddle))
        return largest

    def rank(self, poses: Sequence[PaddlePose]) -> list[PaddlePose]:
        """The poses by their score; equal ones by their distance to the reference posture.

        Without the second rule, rounding would choose: the last joint of an arm with a flat paddle
        turns it in its plane, and a symmetric arm has each pose twice. Each group of equal ones
        begins at the best of the rest, so rounding moves a pose at most at a group's lower edge.
        """
        beside_reference = self._reference + _SIDE

        def distance(pose: PaddlePose) -> float:
            return float(np.sum((pose.angles - beside_reference) ** 2))

        remaining = sorted(poses, key=lambda pose: -pose.score)
        ranked: list[PaddlePose] = []
        while remaining:
            least = (1.0 - _EQUAL_SCORES) * remaining[0].score
            equal = [pose for pose in remaining if pose.score >= least]
            ranked += sorted(equal, key=distance)
            remaining = remaining[len(equal) :]
        return ranked

    def _forward(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position [3] and normal [3] of the paddle."""
        self._data.qpos[self._qpos] = angles
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        position = self._data.geom_xpos[self._paddle].copy()
        normal = self._data.geom_xmat[self._paddle].reshape(3, 3)[:, 2].copy()
        return position, normal

    def _jacobian(self, paddle: np.ndarray) -> np.ndarray:
        """Jacobian [5, n] of the paddle's displacement, m, and of its scaled tilt about x and y, m;
        a turn about the vertical does not matter."""
        linear = np.zeros((3, self._model.nv))
        angular = np.zeros((3, self._model.nv))
        mujoco.mj_jac(self._model, self._data, linear, angular, paddle, self._body)
        return np.vstack([linear, _LENGTH * angular[:2]])[:, self._dofs]

    def level_poses(self, mount: PaddleConfig) -> Iterator[PaddlePose]:
        """Poses with a level paddle in front of the robot, at many distances and heights, in which
        the arm is neither in the way of the ball nor in the floor."""
        place_paddle(self._model, self._paddle, mount)
        for goal in self._goals():
            for _ in range(_TRIES):
                angles = self._solve(self._seed(), goal)
                if angles is not None and self._is_usable(angles, goal):
                    yield self._rate(angles, mount)

    def _goals(self) -> Iterator[np.ndarray]:
        """Places of the paddle [3] in front of the robot, m."""
        lowest = max(_LOWEST, self._base[2] - 0.3 * self._reach)
        for share_of_reach in (0.45, 0.6, 0.75):
            x = self._base[0] + share_of_reach * self._reach
            for rise in (0.0, 0.15, 0.3):
                yield np.array([x, self._base[1], lowest + rise * self._reach])

    def _is_usable(self, angles: np.ndarray, goal: np.ndarray) -> bool:
        """Whether the paddle is in front of the robot, along the world's x, over the floor and
        clear of the links."""
        paddle, _ = self._forward(angles)
        in_front = paddle[0] - self._base[0] > 0.3 * self._from_base(goal)
        return bool(in_front and paddle[2] > _OFF_FLOOR and self._is_clear(paddle))

    def _solve(self, angles: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        """The pose near the goal with a level paddle; None if the search does not level it."""
        for _ in range(_STEPS_TO_GOAL):
            paddle, normal = self._forward(angles)
            error = np.concatenate([goal - paddle, _LENGTH * _levelling_turn(normal)])
            angles = self._step(angles, self._jacobian(paddle), error, _DAMPING)
        for _ in range(_STEPS_TO_LEVEL):
            paddle, normal = self._forward(angles)
            if normal[2] > 0.0 and np.linalg.norm(normal[:2]) < _LEVEL_TOLERANCE:
                return self._unwound(angles)
            error = _LENGTH * _levelling_turn(normal)
            angles = self._step(angles, self._jacobian(paddle)[3:], error, _NO_DAMPING)
        return None

    def _step(
        self, angles: np.ndarray, jacobian: np.ndarray, error: np.ndarray, damping: float
    ) -> np.ndarray:
        """A step of damped least squares inside the ranges, of limited length."""
        gram = jacobian @ jacobian.T + damping * np.eye(len(error))
        step = jacobian.T @ np.linalg.solve(gram, error)
        step *= min(1.0, _LARGEST_STEP / max(np.max(np.abs(step)), 1e-12))
        return self._inside(angles + step)

    def _unwound(self, angles: np.ndarray) -> np.ndarray:
        """The same pose with each hinge within half a turn of the reference posture, where its
        range allows it."""
        # Half a turn to either side is the same pose: the positive one counts as nearer.
        turns = np.round((angles - self._reference) / (2.0 * np.pi) - 1e-3)
        unwound = angles - 2.0 * np.pi * turns
        allowed = self._is_hinge & (self._inside(unwound) == unwound)
        return np.where(allowed, unwound, angles)

    def _rate(self, angles: np.ndarray, mount: PaddleConfig) -> PaddlePose:
        """The pose with its score."""
        paddle, _ = self._forward(angles)
        jacobian = self._jacobian(paddle)
        lifting_and_tilting = jacobian[2:]
        # With fewer than five joints, the arm cannot choose where the paddle is.
        task = jacobian if len(angles) >= 5 else lifting_and_tilting
        manipulability = self._manipulability(task, lifting_and_tilting)
        mass, holding = self._dynamics()
        acceleration = -np.inf
        can_hold = np.all(np.abs(holding) <= self._limits)
        if manipulability >= _LEAST_MANIPULABILITY and can_hold:
            # The rows of the task end with z and the two tilts.
            lifting_force = mass @ np.linalg.pinv(task)[:, -3]
            acceleration = self._acceleration(lifting_force, holding)
        to_limit = np.min(np.minimum(angles - self._low, self._high - angles))
        margin = float(np.clip(to_limit / _AMPLE_MARGIN, 0.0, 1.0))
        strength = min(1.0, max(acceleration, 0.0) / _AMPLE_ACCELERATION)
        return PaddlePose(
            angles=angles,
            paddle=paddle,
            mount=mount,
            manipulability=manipulability,
            acceleration=acceleration,
            inertia=np.diag(mass),
            holding=holding,
            reach=self._reach,
            score=manipulability * margin * strength,
        )

    def _manipulability(self, task: np.ndarray, lifting_and_tilting: np.ndarray) -> float:
        """Smallest singular value of the task's Jacobian [k, n]; 0 where the paddle cannot be
        lifted and tilted about two axes, by its Jacobian [3, n]."""
        if np.linalg.matrix_rank(lifting_and_tilting, tol=1e-3) < 3:
            return 0.0
        return float(np.linalg.svd(task, compute_uv=False)[-1])

    def _is_clear(self, paddle: np.ndarray) -> bool:
        """Whether the links, as straight lines between the joints, stay above the floor and out of
        the ball's way; in the pose of the last `_forward`. The way from the last link's origin to
        the paddle is left out, as it ends in the ball's."""
        ends = [self._data.xanchor[joint] for joint in self._joints]
        ends.append(self._data.xpos[self._body])
        for i, (start, end) in enumerate(itertools.pairwise(ends)):
            shares = np.linspace(0.0, 1.0, _SAMPLES_OF_A_LINK)[:, None]
            points = start + shares * (end - start)
            if not self._is_above_floor(points, is_first_link=i == 0):
                return False
            if _is_in_balls_way(points, paddle):
                return False
        return True

    def _is_above_floor(self, points: np.ndarray, is_first_link: bool) -> bool:
        """Whether points [k, 3] of a link's line leave room for its half thickness, m."""
        beyond_base = np.linalg.norm(points - self._base, axis=1) > _BASE_RADIUS
        # The first joint may be anywhere along its axis.
        lowest_at_base = -np.inf if is_first_link else -1e-6
        lowest = np.where(beyond_base, _FLOOR_CLEARANCE, lowest_at_base)
        return bool(np.all(points[:, 2] >= lowest))

    def _dynamics(self) -> tuple[np.ndarray, np.ndarray]:
        """Mass matrix [n, n] of the acting joints, and the forces [n] that hold the arm."""
        model = self._model
        data = self._data
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        full_matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full_matrix)
        mass_matrix = full_matrix[np.ix_(self._dofs, self._dofs)]
        holding = (data.qfrc_bias - data.qfrc_passive)[self._dofs]
        return mass_matrix, holding

    def _acceleration(self, lifting_force: np.ndarray, holding: np.ndarray) -> float:
        """Largest upward acceleration of the paddle, m/s^2.

        Args:
          lifting_force: joint forces [n] for each m/s^2.
          holding: joint forces [n] that hold the arm.
        """
        needed = np.abs(lifting_force)
        spare = np.where(lifting_force > 0.0, self._limits - holding, self._limits + holding)
        takes_part = needed > 1e-9
        return float(np.min(spare[takes_part] / needed[takes_part], initial=np.inf))


def _is_in_balls_way(points: np.ndarray, paddle: np.ndarray) -> bool:
    """Whether one of some points [k, 3] is in the column over the paddle's centre [3], m."""
    x, y, _ = (points - paddle).T
    is_near = np.hypot(x, y) < _CLEARANCE
    above_bottom = points[:, 2] > paddle[2] - _BELOW
    below_top = points[:, 2] < paddle[2] + _HEADROOM
    return bool(np.any(is_near & above_bottom & below_top))


def clearance(model: mujoco.MjModel, addresses: Addresses, pose: PaddlePose) -> float:
    """Least distance of the paddle in a pose from the shapes of the other links and of the world,
    m; negative if it is inside one, and at most `_FAR`.

    Args:
      model: the compiled scene with all its geoms; its paddle is moved.
      addresses: of its parts.
      pose: of the arm.
    """
    paddle = addresses.paddle_geom
    place_paddle(model, paddle, pose.mount)
    data = data_at(model, addresses, pose.angles)
    last_link = model.body_weldid[model.geom_bodyid[paddle]]
    balls = [ball.geom for ball in addresses.balls]
    least = _FAR
    for geom in range(model.ngeom):
        is_flat = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE
        moves_along = model.body_weldid[model.geom_bodyid[geom]] == last_link
        if is_flat or moves_along or geom in balls or _is_picture(model, geom):
            continue
        distance = mujoco.mj_geomDistance(model, data, paddle, geom, _FAR, None)
        least = min(least, distance)
    return least


def _is_picture(model: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom is only a link's picture: where a link has shapes that touch, the others
    are."""
    groups_of_body = model.geom_group[model.geom_bodyid == model.geom_bodyid[geom]]
    return HIDDEN_GROUP in groups_of_body and model.geom_group[geom] != HIDDEN_GROUP


def place_paddle(model: mujoco.MjModel, paddle_geom: int, mount: PaddleConfig) -> None:
    """Moves the paddle of a compiled scene, with its mass. Its body has the frame of the site, and
    no mass but the blade's."""
    body = model.geom_bodyid[paddle_geom]
    earlier = np.zeros(4)
    mujoco.mju_negQuat(earlier, model.geom_quat[paddle_geom])
    # MuJoCo may give the principal axes another order than the blade's axes.
    principal_axes = np.zeros(4)
    mujoco.mju_mulQuat(principal_axes, earlier, model.body_iquat[body])
    orientation = np.array(mount.quaternion) / np.linalg.norm(mount.quaternion)
    model.geom_pos[paddle_geom] = mount.position
    model.geom_quat[paddle_geom] = orientation
    model.body_ipos[body] = mount.position
    mujoco.mju_mulQuat(model.body_iquat[body], orientation, principal_axes)
    # MuJoCo skips the transformation of a frame that is flagged as the body's.
    model.geom_sameframe[paddle_geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    model.body_sameframe[body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


def _levelling_turn(normal: np.ndarray) -> np.ndarray:
    """The turn [2] about x and y, rad, that levels a paddle with the normal [3]: for small angles
    exact, and a whole radian if the paddle is upside down."""
    turn = np.array([normal[1], -normal[0]])
    if normal[2] >= 0.0:
        return turn
    size = np.linalg.norm(turn)
    return turn / size if size > 1e-6 else np.array([1.0, 0.0])
