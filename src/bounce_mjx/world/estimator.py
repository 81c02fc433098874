"""The state estimator between camera and policy in the simulation: the filter of
`task/ball_filter.py` at each control step."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.physics import Engine
from bounce_mjx.physics.parameters import MODEL_PARAMETERS
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.world.ball_filter import BallFilter, BallTrack, Constants
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import World
from bounce_mjx.world.sensing import Picture, oldest_picture

# Pictures lost in a row up to which the estimator knows the paddle's planes.
_LOST_IN_A_ROW = 2.0
# Smallest time between two pictures, s.
_SAME_PICTURE = 1e-4
# A picture's axes in jax.vmap over the balls that it shows.
_OF_BALLS = Picture(position=0, velocity=0, age=None, number=None)


class Estimate(NamedTuple):
    """Memory of the estimator, and its estimate."""

    track: BallTrack
    planes: jax.Array
    """Paddle's planes (`BallFilter.plane`) at the last control steps [K, 4], the newest first."""
    position: jax.Array
    """Estimated position of the ball now [3], m."""
    velocity: jax.Array
    """Estimated velocity of the ball now [3], m/s."""


class Estimator:
    """The estimator of an environment with these settings."""

    def __init__(self, config: WorldConfig, mj_model: mujoco.MjModel, engine: Engine):
        self._config, self._engine = config, engine
        constants = filter_constants(config, mj_model)
        self._filter = BallFilter(constants, config.control_dt, jnp, _repeat)
        normal, _ = upper_face(mj_model, config.default_joint_angles)
        self._above_paddle = mj_model.geom_pos[find_addresses(mj_model).paddle_geom] + normal

        terms = config.randomization
        interval = 1.0 / terms.camera_rate[0] if terms.camera_rate else 0.0
        lost = _LOST_IN_A_ROW * interval if terms.frame_drop else 0.0
        oldest = lost + max(oldest_picture(terms), interval + (config.estimator.latency or 0.0))
        # The picture before the last one can be as old and one control step older.
        self._num_planes = math.ceil(oldest / config.control_dt - 1e-6) + 2

    def plane(self, qpos: jax.Array) -> jax.Array:
        """The paddle's plane [4] (`BallFilter.plane`) by forward kinematics at qpos [nq],
        in the nominal world."""
        above = MODEL_PARAMETERS._replace(
            paddle_position=jnp.asarray(self._above_paddle, qpos.dtype)
        )
        paddle = self._engine.paddle_position(MODEL_PARAMETERS, qpos)
        normal = self._engine.paddle_position(above, qpos) - paddle
        return self._filter.plane(paddle, normal)

    def start(self, picture: Picture, world: World, plane: jax.Array) -> Estimate:
        """Estimate at a reset, where the ball is at rest. With several balls, everything has one
        row for each.

        Args:
          picture: the first one.
          plane: `plane` of the measured joint angles [4].
        """
        start = self._start
        if self._config.num_balls > 1:
            start = jax.vmap(start, in_axes=(_OF_BALLS, None, None))
        return start(picture, world, plane)

    def _start(self, picture: Picture, world: World, plane: jax.Array) -> Estimate:
        return Estimate(
            track=self._filter.start(picture.position, self.age(picture, world)),
            planes=jnp.broadcast_to(plane, (self._num_planes, 4)),
            position=picture.position,
            velocity=jnp.zeros_like(picture.position),
        )

    def age(self, picture: Picture, world: World) -> jax.Array:
        """Age of a picture [] (s) as far as the robot knows it: without a stamp, the time since its
        arrival plus the expected latency."""
        latency = self._config.estimator.latency
        if latency is None:
            return picture.age
        return jnp.maximum(picture.age - world.get("ball_latency", 0.0), 0.0) + latency

    def next(
        self, before: Estimate, world: World, last: Picture, picture: Picture, plane: jax.Array
    ) -> Estimate:
        """Estimate at the next control step.

        Args:
          last, picture: the picture of the control step before and of this one; both are the same
            one if none has arrived.
          plane: `plane` of the measured joint angles [4].
        """
        following = self._next
        if self._config.num_balls > 1:
            following = jax.vmap(following, in_axes=(0, None, _OF_BALLS, _OF_BALLS, None))
        return following(before, world, last, picture, plane)

    def _next(
        self, before: Estimate, world: World, last: Picture, picture: Picture, plane: jax.Array
    ) -> Estimate:
        control_dt, age = self._config.control_dt, self.age(picture, world)
        planes = jnp.concatenate([plane[None], before.planes[:-1]])
        track = before.track._replace(age=before.track.age + control_dt)
        seen = self._filter.add_picture(track, planes, picture.position, age)
        is_new = picture.age < last.age + control_dt - _SAME_PICTURE
        track = jax.tree.map(lambda new, old: jnp.where(is_new, new, old), seen, track)
        return Estimate(track, planes, *self._filter.present(track, planes))


def _repeat(count: int, function: Callable[[Any], Any], start: Any) -> Any:
    return jax.lax.fori_loop(0, count, lambda _, carry: function(carry), start)


def filter_constants(config: WorldConfig, mj_model: mujoco.MjModel) -> Constants:
    """Constants of the filter from the config and the nominal model."""
    _, height = upper_face(mj_model, config.default_joint_angles)
    radius = mj_model.geom_size[find_addresses(mj_model).ball_geom, 0]
    return Constants(
        **config.estimator.model_dump(),
        gravity=tuple(mj_model.opt.gravity.tolist()),
        contact_distance=float(height + radius),
    )


def upper_face(
    mj_model: mujoco.MjModel, joint_angles: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Unit normal [3] of the paddle's face that is the upper one at these joint angles (rad), in
    the frame of the paddle's body, and the face's distance [] from the paddle's centre, m."""
    data, addresses = mujoco.MjData(mj_model), find_addresses(mj_model)
    data.qpos[list(addresses.arm_qpos)] = joint_angles
    mujoco.mj_kinematics(mj_model, data)
    paddle, normal = addresses.paddle_geom, np.zeros(3)
    upward = data.geom_xmat[paddle].reshape(3, 3)[2]
    axis = int(np.argmax(abs(upward)))
    face = np.sign(upward[axis]) * np.eye(3)[axis]
    mujoco.mju_rotVecQuat(normal, face, mj_model.geom_quat[paddle])
    return normal, mj_model.geom_aabb[paddle, 3 + axis]
