"""A Kalman filter of a bouncing ball, which estimates position and velocity from late pictures.

The ball flies under gravity and drag. The paddle's plane is a damped spring, so that a contact
takes its time and ends with the restitution. The filter holds the ball at the time of the last
picture and predicts from there to the present.

The training computes it with JAX (`task/estimator.py`) and a robot with NumPy
(`deploy/estimator.py`), by the same code, which imports neither.

Source: Kalman (1960), extended to the nonlinear motion by linearisation about the estimate. Each
axis has its own covariance matrix, because only the contact couples the axes, and the paddle is
almost level.
"""

import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

Array = Any
Repeat = Callable[[int, Callable[[Any], Any], Any], Any]
"""(count, function, start) -> result of applying the function `count` times."""

# Standard deviation of each component of the ball's velocity at the start, m/s.
_START_SPEED = 0.5
# Speed up to which drag grows, m/s; the limit keeps the time steps stable.
_FASTEST = 50.0
# Depth beyond which a ball below the plane is beside the paddle, m.
_DEEPEST = 0.025
# Time steps in a contact.
_CONTACT_STEPS = 5


Acceleration = Annotated[float, (-1e3, 1e3)]


class Constants(NamedTuple):
    """Constants of the filter, with the limits within which it is stable and fast on a robot;
    `EstimatorConfig` documents the first eight."""

    measurement_noise: Annotated[float, (1e-6, 1e3)]
    process_noise: Annotated[float, (0.0, 1e3)]
    restitution: Annotated[float, (0.1, 1.0)]
    restitution_noise: Annotated[float, (0.0, 1e3)]
    contact_time: Annotated[float, (0.002, 0.05)]
    paddle_noise: Annotated[float, (0.0, 1e3)]
    air_drag: Annotated[float, (0.0, 4.0)]
    latency: Annotated[float, (0.0, 10.0)] | None
    gravity: tuple[Acceleration, Acceleration, Acceleration]
    """Acceleration of a free ball, m/s^2."""
    contact_distance: Annotated[float, (0.0, 10.0)]
    """Distance from the paddle's centre to the ball's centre when they touch, m."""


class BallTrack(NamedTuple):
    """Estimate at the time of the last picture."""

    position: Array
    """Position [3], m."""
    velocity: Array
    """Velocity [3], m/s."""
    position_variance: Array
    """Variance of each coordinate [3], m^2."""
    covariance: Array
    """Covariance of each coordinate and its velocity [3], m^2/s."""
    velocity_variance: Array
    """Variance of each velocity [3], m^2/s^2."""
    age: Array
    """Time since the picture was taken [], s."""


class BallFilter:
    """The filter as pure functions of a `BallTrack`.

    The argument `planes` [K, 4] holds the paddle's planes (`plane`) at the last control steps, the
    newest first; between two control steps the plane moves linearly. A motion further back than
    these control steps is ignored.
    """

    def __init__(self, constants: Constants, control_dt: float, xp: Any, repeat: Repeat):
        """Chooses the array library.

        Args:
          control_dt: time between two control steps, s.
          xp: `jax.numpy` or `numpy`.
          repeat: loop of this library.
        """
        self._constants, self._control_dt, self._xp, self._repeat = (
            constants,
            control_dt,
            xp,
            repeat,
        )
        time_step = constants.contact_time / _CONTACT_STEPS
        self._num_steps = math.ceil(control_dt / time_step - 1e-6)
        # A damped spring that the ball leaves after the contact time, slower by the restitution.
        decay = -math.log(constants.restitution) / constants.contact_time
        self._spring = (math.pi / constants.contact_time) ** 2 + decay**2
        self._damping = 2.0 * decay

    def plane(self, paddle: Array, normal: Array) -> Array:
        """Plane of the ball's centre in a contact: points p with n . p = c, as [4]: n and c.

        Args:
          paddle: position of the paddle's centre [3], m.
          normal: upward unit normal of the paddle [3].
        """
        distance = self._xp.sum(normal * paddle) + self._constants.contact_distance
        return self._xp.concatenate([normal, distance[None]])

    def start(self, position: Array, age: Array) -> BallTrack:
        """Track of a ball at rest at a measured position [3]; its picture has the age [] (s)."""
        zero = self._xp.zeros_like(position)
        return BallTrack(
            position=position,
            velocity=zero,
            position_variance=zero + self._constants.measurement_noise**2,
            covariance=zero,
            velocity_variance=zero + _START_SPEED**2,
            age=age,
        )

    def add_picture(
        self, track: BallTrack, planes: Array, position: Array, age: Array
    ) -> BallTrack:
        """Track after a new picture: a measured position [3] (m), and the time since it was taken
        [] (s)."""
        moved = self._moved(self._step_of_track, track, planes, track.age, age)
        noise = self._constants.measurement_noise**2
        gain = moved.position_variance / (moved.position_variance + noise)
        velocity_gain = moved.covariance / (moved.position_variance + noise)
        surprise = position - moved.position
        return BallTrack(
            position=moved.position + gain * surprise,
            velocity=moved.velocity + velocity_gain * surprise,
            position_variance=(1.0 - gain) * moved.position_variance,
            covariance=(1.0 - gain) * moved.covariance,
            velocity_variance=moved.velocity_variance - velocity_gain * moved.covariance,
            age=age,
        )

    def present(self, track: BallTrack, planes: Array) -> tuple[Array, Array]:
        """Position [3] (m) and velocity [3] (m/s) now."""

        def step(motion: tuple[Array, Array], *args: Array) -> tuple[Array, Array]:
            position, velocity, _, _ = self._accelerated(*motion, *args)
            return position, velocity

        start = (track.position, track.velocity)
        return self._moved(step, start, planes, track.age, self._xp.zeros_like(track.age))

    def _moved(
        self, step: Callable[..., Any], state: Any, planes: Array, since: Array, until: Array
    ) -> Any:
        """A state moved by time steps between two ages [] (s).

        Args:
          step: (state, plane [4], its change per second [4], time step [] in s) -> state.
        """
        dt = self._control_dt
        for i in reversed(range(len(planes) - 1)):
            newer, older = planes[i], planes[i + 1]
            begin = self._xp.minimum(since, (i + 1) * dt)
            duration = self._xp.maximum(begin - self._xp.maximum(until, i * dt), 0.0)
            # NumPy knows the number, and skips control steps outside the ages.
            if isinstance(duration, float) and duration == 0.0:
                continue
            rate, part = (newer - older) / dt, duration / self._num_steps

            def one(carry: Any, rate: Array = rate, part: Array = part) -> Any:
                state, plane = carry
                return step(state, plane, rate, part), plane + part * rate

            start = (state, newer - (begin - i * dt) * rate)
            state, _ = self._repeat(self._num_steps, one, start)
        return state

    def _step_of_track(self, track: BallTrack, plane: Array, rate: Array, dt: Array) -> BallTrack:
        """One time step of the estimate and of its variances, without a picture."""
        constants = self._constants
        position, velocity, share, leaving = self._accelerated(
            track.position, track.velocity, plane, rate, dt
        )
        # The errors of position and velocity are mapped by (a b; c d).
        squares = plane[:3] * plane[:3]
        c = -dt * self._spring * share * squares
        d = 1.0 - dt * (self._damping + 0.5 * dt * self._spring) * share * squares
        a, b = 1.0 + 0.5 * dt * c, 0.5 * dt * (1.0 + d)
        pp, pv, vv = track.position_variance, track.covariance, track.velocity_variance
        misplaced = (1.0 + constants.restitution) * constants.paddle_noise
        error = self._xp.where(leaving > 0.0, misplaced**2, 0.0)
        fast = (constants.restitution_noise * leaving) ** 2
        return BallTrack(
            position=position,
            velocity=velocity,
            position_variance=a * a * pp + 2.0 * a * b * pv + b * b * vv + squares * error,
            covariance=a * c * pp + (a * d + b * c) * pv + b * d * vv,
            velocity_variance=c * c * pp
            + 2.0 * c * d * pv
            + d * d * vv
            + squares * fast
            + constants.process_noise**2 * dt,
            age=track.age,
        )

    def _accelerated(
        self, position: Array, velocity: Array, plane: Array, rate: Array, dt: Array
    ) -> tuple[Array, Array, Array, Array]:
        """One time step of the motion, exact in a flight without drag.

        Returns:
          Position [3], velocity [3], the share of the step in contact [], and the speed [] with
          which the ball leaves the paddle in this step (0 if it does not leave).
        """
        xp, constants = self._xp, self._constants
        normal = plane[:3]
        height = xp.sum(normal * position) - plane[3]
        speed = xp.sum(normal * velocity) + xp.sum(rate[:3] * position) - rate[3]
        # The mean depth over the step, at a constant speed: the restitution does not depend on the
        # part of a step at which the contact begins.
        later = height + dt * speed
        low, high = xp.minimum(height, later), xp.maximum(height, later)
        share = xp.clip(-low / xp.maximum(high - low, 1e-9), 0.0, 1.0)
        share = xp.where(low > -_DEEPEST, share, 0.0)
        depth = 0.5 * share * (low + xp.minimum(high, 0.0))
        push = self._spring * depth + self._damping * share * speed
        gravity = xp.stack([xp.full_like(push, g) for g in constants.gravity])
        acceleration = gravity - push * normal
        if constants.air_drag:
            squared = xp.minimum(xp.sum(velocity * velocity), _FASTEST**2)
            acceleration = acceleration - constants.air_drag * xp.sqrt(squared) * velocity
        changed = velocity + dt * acceleration
        leaving = xp.where((height < 0.0) & (later >= 0.0), speed, 0.0)
        return position + 0.5 * dt * (velocity + changed), changed, share, leaving
