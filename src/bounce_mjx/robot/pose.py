"""Search of the start pose: a level paddle at a well-conditioned point in front of the robot.

Inverse kinematics by least squares within the joint limits, from many seeds; the best pose
has the largest score of conditioning, distance to the joint limits and strength.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import scipy.optimize

from bounce_mjx.errors import UserError
from bounce_mjx.robot.arm import joint_name
from bounce_mjx.robot.config import PaddleConfig
from bounce_mjx.robot.model import Addresses, find_addresses, joint_ranges

# Length that makes rotations comparable with displacements: about a forearm, m/rad.
_LENGTH = 0.25
# Upward acceleration of the paddle that a bounce needs, m/s^2, and one that is plenty.
_LEAST_ACCELERATION, _AMPLE_ACCELERATION = 3.0, 20.0
# Smallest singular value of a usable pose; 1 would be an arm that moves as a sphere.
_LEAST_MANIPULABILITY = 0.02
_LEVEL_TOLERANCE = 1e-9
_TRIES, _EVALUATIONS = 8, 30
_UP = np.array([0.0, 0.0, 1.0])
# Distance of a pose from the joint limits, rad or m: the noise of a reset's joint positions. Of a
# short range it is a tenth.
_LEAST_MARGIN = 0.1
_CLEARANCE = 0.09
# Least height of the lines between the joints, half the thickness of a link, m; within a radius
# around the first joint, at the base, they may be lower, but not below the floor.
_FLOOR_CLEARANCE = 0.07
_BASE_RADIUS = 0.2
# Lowest height of the paddle in the search, m: the links below it stay above the floor.
_LOWEST = 0.1
# Heights above the paddle that must be free of the arm, m: the ball flies there.
_HEADROOM = 1.0


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
    """Largest horizontal distance of the paddle from the first joint, m."""
    score: float


def mounts(paddle: PaddleConfig) -> list[PaddleConfig]:
    """The paddle held by a handle along the site's z, in four turns about it, and flat on the
    site."""
    turns = [(math.cos(i * math.pi / 4.0), math.sin(i * math.pi / 4.0)) for i in range(4)]
    half = math.sqrt(0.5)
    choices = [((0.0, 0.0, 0.19), (half * c, half * s, -half * c, half * s)) for c, s in turns]
    choices.append(((0.0, 0.0, 0.03), (1.0, 0.0, 0.0, 0.0)))
    return [paddle.model_copy(update={"position": p, "quaternion": q}) for p, q in choices]


def find_pose(
    model: mujoco.MjModel,
    force_limits: Sequence[float | None],
    choices: Sequence[PaddleConfig],
) -> PaddlePose:
    """The best start pose of an arm in the task's scene.

    Args:
      model: the compiled scene; its paddle is moved.
      force_limits: largest force of each acting joint, N m or N; None for no limit.
      choices: mounts of the paddle to try.

    Raises:
      UserError: the paddle cannot be level, tilted or lifted, or no servo is strong enough.
    """
    search = _Search(model, force_limits)
    poses = [pose for choice in choices for pose in search.level_poses(choice)]
    names = ", ".join(joint_name(model, j) for j in find_addresses(model).arm_joints)
    for suits, problem in (
        (
            lambda pose: True,
            f"no reachable pose with a level paddle in front of the robot, {names} inside their "
            "ranges, and the links above the floor and out of the ball's way; check the site, the "
            "paddle's position and quaternion, and the height of the base",
        ),
        (
            lambda pose: pose.manipulability >= _LEAST_MANIPULABILITY,
            f"no pose in which the joints {names} can lift the paddle and tilt it about two "
            "axes; give an arm with joints about more axes, or with wider ranges",
        ),
        (
            lambda pose: pose.acceleration >= _LEAST_ACCELERATION,
            "no servo strong enough to hold the arm and to accelerate the paddle upward by "
            f"{_LEAST_ACCELERATION:g} m/s^2; raise the force limits of {names}",
        ),
    ):
        poses = list(filter(suits, poses))
        if not poses:
            raise UserError(problem)
    return max(poses, key=lambda pose: pose.score)


class _Search:
    def __init__(self, model: mujoco.MjModel, force_limits: Sequence[float | None]):
        self._model, self._rng = model, np.random.default_rng(0)
        self._limits = np.array([np.inf if limit is None else limit for limit in force_limits])
        self._data = mujoco.MjData(model)
        self._at: Addresses = find_addresses(model)
        self._qpos, self._dofs = np.array(self._at.arm_qpos), np.array(self._at.arm_qvel)
        self._joints = np.array(self._at.arm_joints)
        # The last link, to which the paddle's own body is welded.
        self._body = int(model.body_weldid[model.geom_bodyid[self._at.paddle_geom]])
        self._range = low, high = joint_ranges(model)
        # A servo whose joint is at its limit could move it one way only.
        margin = np.minimum(_LEAST_MARGIN, 0.1 * (high - low))
        self._inside = self._range[0] + margin, self._range[1] - margin
        # The seeds of a hinge lie within half a turn.
        self._hinge = model.jnt_type[self._joints] == mujoco.mjtJoint.mjJNT_HINGE
        wide = np.where(self._hinge, np.pi, np.where(np.isinf(low), 0.5, np.inf))
        self._centre = centre = np.clip(model.qpos0[self._qpos], *self._inside)
        self._seeds = [np.clip(centre + side * wide, *self._inside) for side in (-1.0, 1.0)]
        # MuJoCo skips the transformation of a geom flagged as sharing its body's frame.
        model.geom_sameframe[self._at.paddle_geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        mujoco.mj_kinematics(model, self._data)
        self._base = self._data.xanchor[self._joints[0]].copy()
        paddles = [self._forward(self._rng.uniform(*self._seeds))[0] for _ in range(500)]
        self._reach = float(max(np.hypot(*(paddle - self._base)[:2]) for paddle in paddles))

    def _forward(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position [3] and normal [3] of the paddle."""
        self._data.qpos[self._qpos] = angles
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        rotation = self._data.geom_xmat[self._at.paddle_geom].reshape(3, 3)
        return self._data.geom_xpos[self._at.paddle_geom].copy(), rotation[:, 2].copy()

    def _jacobian(self, paddle: np.ndarray) -> np.ndarray:
        """Jacobian [6, n] of the paddle's displacement and scaled rotation, m."""
        linear, angular = np.zeros((3, self._model.nv)), np.zeros((3, self._model.nv))
        mujoco.mj_jac(self._model, self._data, linear, angular, paddle, self._body)
        return np.vstack([linear, _LENGTH * angular])[:, self._dofs]

    def level_poses(self, choice: PaddleConfig) -> Iterator[PaddlePose]:
        """Poses with a level paddle in front of the robot, at many distances and heights, in which
        the arm is neither in the way of the ball nor in the floor."""
        # The paddle's body has the frame of the site.
        quaternion = np.array(choice.quaternion)
        self._model.geom_quat[self._at.paddle_geom] = quaternion / np.linalg.norm(quaternion)
        self._model.geom_pos[self._at.paddle_geom] = choice.position
        distances = self._reach * np.array([0.45, 0.6, 0.75])
        lowest = max(_LOWEST, self._base[2] - 0.3 * self._reach)
        heights = lowest + self._reach * np.array([0.0, 0.15, 0.3])
        for distance, height in itertools.product(distances, heights):
            goal = np.array([self._base[0] + distance, self._base[1], height])
            for _ in range(_TRIES):
                angles = self._solve(self._rng.uniform(*self._seeds), goal)
                if angles is not None and self._is_clear(self._forward(angles)[0]):
                    yield self._rate(angles, choice)

    def _solve(self, angles: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        """The pose near the goal with a level paddle; None if the search finds none."""

        def error(angles: np.ndarray, rows: slice) -> np.ndarray:
            paddle, normal = self._forward(angles)
            return np.concatenate([paddle - goal, _LENGTH * (normal - _UP)])[rows]

        def derivative(angles: np.ndarray, rows: slice) -> np.ndarray:
            paddle, normal = self._forward(angles)
            jacobian = self._jacobian(paddle)
            return np.vstack([jacobian[:3], np.cross(jacobian[3:].T, normal).T])[rows]

        # Level and at the goal, then level alone: not every arm can be both.
        for rows in (slice(0, 6), slice(3, 6)):
            angles = scipy.optimize.least_squares(
                error,
                angles,
                derivative,
                self._inside,
                method="dogbox",
                ftol=None,
                xtol=None,
                gtol=1e-13,
                max_nfev=_EVALUATIONS,
                args=(rows,),
            ).x
        # The same pose within half a turn, where the range allows it.
        turns = np.round((angles - self._centre) / (2.0 * np.pi))
        turned = np.where(self._hinge, angles - 2.0 * np.pi * turns, angles)
        angles = np.where(np.clip(turned, *self._inside) == turned, turned, angles)
        paddle, normal = self._forward(angles)
        if normal[2] < 0.0 or np.linalg.norm(normal[:2]) > _LEVEL_TOLERANCE:
            return None
        in_front = paddle[0] - self._base[0] > 0.3 * np.hypot(*(goal - self._base)[:2])
        return angles if in_front and paddle[2] > 0.03 else None

    def _rate(self, angles: np.ndarray, choice: PaddleConfig) -> PaddlePose:
        """The pose with its score."""
        paddle, _ = self._forward(angles)
        # A turn about the vertical does not matter.
        jacobian = self._jacobian(paddle)[:5]
        lifting = jacobian[2:]
        task = jacobian if len(angles) >= 5 else lifting
        smallest = float(np.linalg.svd(task, compute_uv=False)[-1])
        if np.linalg.matrix_rank(lifting, tol=1e-3) < 3:
            smallest = 0.0
        mass, holding = self._dynamics()
        acceleration = -np.inf
        if smallest >= _LEAST_MANIPULABILITY and np.all(np.abs(holding) <= self._limits):
            acceleration = self._acceleration(mass @ np.linalg.pinv(task)[:, -3], holding)
        low, high = self._range
        # The distance to the nearest joint limit as a share of half a radian.
        margin = float(np.clip(np.min(np.minimum(angles - low, high - angles)) / 0.5, 0.0, 1.0))
        strong = min(1.0, max(acceleration, 0.0) / _AMPLE_ACCELERATION)
        score, inertia = smallest * margin * strong, np.diag(mass)
        return PaddlePose(
            angles, paddle, choice, smallest, acceleration, inertia, holding, self._reach, score
        )

    def _is_clear(self, paddle: np.ndarray) -> bool:
        """Whether the links, as straight lines between the joints, stay above the floor and out of
        the ball's way."""
        data = self._data
        points = [data.xanchor[j] for j in self._joints] + [data.xpos[self._body]]
        for i, (start, end) in enumerate(zip(points, points[1:], strict=False)):
            samples = start + np.linspace(0.0, 1.0, 12)[:, None] * (end - start)
            beyond_base = np.linalg.norm(samples - self._base, axis=1) > _BASE_RADIUS
            # The first joint may be anywhere along its axis.
            lowest = np.where(beyond_base, _FLOOR_CLEARANCE, -1e-6 if i else -np.inf)
            if np.any(samples[:, 2] < lowest):
                return False
            near = np.hypot(*(samples[:, :2] - paddle[:2]).T) < _CLEARANCE
            beside = (samples[:, 2] > paddle[2] - 0.03) & (samples[:, 2] < paddle[2] + _HEADROOM)
            if np.any(near & beside):
                return False
        return True

    def _dynamics(self) -> tuple[np.ndarray, np.ndarray]:
        """Mass matrix [n, n] of the acting joints, and the forces [n] that hold the arm."""
        model, data = self._model, self._data
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        hold = (data.qfrc_bias - data.qfrc_passive)[self._dofs]
        return full[np.ix_(self._dofs, self._dofs)], hold

    def _acceleration(self, force: np.ndarray, hold: np.ndarray) -> float:
        """Largest upward acceleration of the paddle; each m/s^2 of it needs the forces [n]."""
        needed = np.abs(force)
        spare = np.where(force > 0.0, self._limits - hold, self._limits + hold)
        moved = needed > 1e-9
        return float(np.min(spare[moved] / needed[moved], initial=np.inf))
