"""What cannot be true is no measurement: a robot's sample against what the last ones say.

A sample that cannot be true is bridged, the last values hold, while at most a third of the last
0.1 s are such; then the sample is refused. What no other sample can make true is refused at once:
first angles of an arm that is elsewhere, a range that the arm has left little by little, a clock
that has stood for 25 calls or gone back by a second, a picture of the future. Each reason here is a
row of the table in docs/real-robot.md. What is no number at all is refused before
(`deploy.driver`).

Nothing here changes: `Samples.take` returns what is known after a sample, and a refused one leaves
everything as it was.
"""

import math
from typing import NamedTuple

import numpy as np

from bounce_mjx.deploy.clock import MOST_STANDING, Clock, advance, is_pause
from bounce_mjx.deploy.flight import Flight, begin, flight_bounds, follow, may_lie
from bounce_mjx.deploy.metadata import Metadata, joint_ends, largest_term, least_term
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.errors import UserError

Measurements = dict[str, np.ndarray]

# Distances that are too far: of an angle from its range, and of the first one from where the arm
# starts, rad.
_OUTSIDE = 0.5
_NEAR = 0.1
# Share of an arm's own limit of velocity that no joint reaches.
_OVERSPEED = 1.2
# Largest noise in standard deviations.
_LARGEST_NOISE = 8.0
# Time of which a third may be bridged, s; of the ball at least so many pictures.
_BRIDGED = 0.1
_BRIDGED_PICTURES = 4.0
# Pictures of the same position are two if they are farther apart than this share of a control step:
# the newest ones of two steps are half of it apart or more, whatever the camera's rate.
_APART = 0.4
# The same of pictures without an age, of a ball that may lie still, in the training's longest
# intervals between two, and at least, s: sooner, there may have been none.
_STILL_FOR = 3.0
_LEAST_STILL = 0.05
# Time in which velocities and angles are compared, s; the least way that counts, rad, how much
# later the velocities may be, s, and their errors as a share of the way.
_COMPARED = 0.1
_LEAST_WAY = 0.01
_VELOCITY_LAG = 0.02
_OF_WAY = 0.3
# How long the paddle's way is known, for late pictures, s.
_PADDLE_WAY = 0.3

SYNCHRONOUS = 1e-3
"""How far in the future a picture may be, as two clocks differ, s."""

RESOLUTION = 2e-3
"""Largest count of an encoder, rad; one of 4,096 counts a turn has 1.5e-3."""

_OF_ARM = ("joint_angles", "joint_velocities")
_OF_BALL = (
    "ball_position",
    "ball_velocity",
    "ball_age",
    "ball_quaternion",
    "ball_angular_velocity",
)


class ImpossibleMeasurement(UserError):
    """A measurement that cannot be true."""

    def __init__(self, fault: str, reason: str):
        super().__init__(reason)
        self.fault = fault
        """Code of what is wrong, of the table in docs/real-robot.md."""


class Doubt(Exception):
    """Why a sample cannot be true: it is bridged, or refused."""

    def __init__(self, fault: str, reason: str):
        super().__init__(reason)
        self.fault = fault
        """Code, as of `ImpossibleMeasurement`."""

    def refused(self) -> ImpossibleMeasurement:
        """The same of a sample that is refused."""
        return ImpossibleMeasurement(self.fault, str(self))


class Bridge(NamedTuple):
    """The samples of one kind that were bridged, not long ago."""

    times: tuple[float, ...] = ()
    """s."""
    durations: tuple[float, ...] = ()
    """For which each counts, s."""


class Moved(NamedTuple):
    """A believed sample of the arm, of the last 0.1 s."""

    time: float
    """s."""
    angles: np.ndarray
    """[J], rad."""
    way: np.ndarray
    """Integral of the measured velocities [J] since the first sample, rad."""
    speeds: np.ndarray
    """The velocities' sizes [J], rad/s."""


class Picture(NamedTuple):
    """The newest picture of the balls that is believed."""

    balls: np.ndarray
    """[B, 3], m."""
    taken: float
    """s."""
    interval: float
    """From the picture before, s."""


class Seen(NamedTuple):
    """What the samples until now say."""

    clock: Clock = Clock()
    values: Measurements = {}
    """The last believed ones, by name."""
    arm_time: float = 0.0
    """Of the arm's last believed sample, s."""
    moved: tuple[Moved, ...] = ()
    paddle: tuple[tuple[float, np.ndarray], ...] = ()
    """The paddle's places [3] (m) at the last times (s), the last one by the believed angles."""
    let_go: float = -math.inf
    """Time by which a hand has let go of the ball, s: no picture from before is of a flight."""
    picture: Picture | None = None
    flights: tuple[Flight, ...] = ()
    """Of each ball."""
    bridges: dict[str, Bridge] = {}
    """Of the clock, the arm and the ball."""

    @property
    def has_arm(self) -> bool:
        """Whether a sample of the arm is known."""
        return "joint_angles" in self.values

    @property
    def is_arm_bridged(self) -> bool:
        """Whether the joint angles of the last sample are those of one before."""
        return self.arm_time != self.clock.now


class Samples:
    """What a policy's worlds can hold."""

    def __init__(self, metadata: Metadata):
        self._metadata = metadata
        self._dt = metadata.control_dt
        if metadata.limits is None:
            self._fastest = np.full(len(metadata.joint_names), metadata.max_joint_velocity)
        else:
            self._fastest = _OVERSPEED * np.array(metadata.limits.velocity)
        largest = math.sqrt(2.0) * _LARGEST_NOISE
        self._noise = RESOLUTION + largest * largest_term(metadata, "joint_angle_noise")
        self._velocity_bias = largest_term(metadata, "joint_velocity_bias")
        self._velocity_noise = _LARGEST_NOISE * largest_term(metadata, "joint_velocity_noise")
        self._low, self._high = joint_ends(metadata)
        self._start = np.array(metadata.default_joint_angles)
        self.start_room = _NEAR + metadata.start_noise
        """Distance of a resting arm from its start pose where nobody says where it rests, rad."""
        self._still = np.zeros(len(self._start))
        self._flight = flight_bounds(metadata)
        slowest = least_term(metadata, "camera_rate", 1.0 / metadata.control_dt)
        self._still_for = max(_STILL_FOR / slowest, _LEAST_STILL)

    def take(
        self,
        seen: Seen,
        measured: Measurements,
        rests_at: np.ndarray | None = None,
        waited: float | None = None,
    ) -> tuple[Seen, Measurements, int]:
        """What is known with a new sample; the sample, with the last values in place of those that
        cannot be true; and the control steps since the last one.

        Args:
          seen: what is known without it.
          measured: arrays by name, as for `OnnxNetwork.step`, and `time` [1].
          rests_at: angles [J] (rad) at which the arm is known to rest, for a first sample; without,
            it is to be near the start pose.
          waited: as for `clock.advance`.

        Raises:
          ImpossibleMeasurement: it cannot be true, and nor could too many before.
        """
        measured = dict(measured)
        seen, steps, elapsed = self._take_time(seen, measured, waited)
        if "joint_angles" in measured:
            seen = self._take_arm(seen, measured, rests_at, elapsed)
        if "ball_position" in measured:
            seen = self._take_picture(seen, measured, elapsed)
        return seen, measured, steps

    def rest(self, seen: Seen, angles: np.ndarray) -> Seen:
        """What is known of an arm that rests at angles [J], rad; the ball is forgotten, the clock
        goes on."""
        now = seen.clock.now
        values = {"joint_angles": angles, "joint_velocities": self._still}
        paddle = ((now, paddle_position(self._metadata, angles)),)
        return Seen(clock=seen.clock, values=values, arm_time=now, paddle=paddle)

    def bridge_time(self, seen: Seen, given: float, believed: float) -> Seen:
        """What is known with one more time of the driver that another clock contradicts.

        Args:
          given: by the driver, s.
          believed: in its place, s.

        Raises:
          ImpossibleMeasurement: too many of the last ones were such.
        """
        doubt = Doubt(
            "time",
            f"the time is {given:.10g} s, {given - believed:+.3g} s from what it has to be by this "
            "computer's clock; give seconds of one clock, and call restart if it starts again",
        )
        last = believed if seen.clock.time is None else seen.clock.time
        return self._bridge(seen, "time", doubt, max(believed - last, self._dt))

    def _take_time(
        self, seen: Seen, measured: Measurements, waited: float | None
    ) -> tuple[Seen, int, float]:
        """Passes the time, which goes on: the steps and the time (s) since the last sample."""
        time = float(measured["time"][0]) if "time" in measured else None
        clock, elapsed, steps = advance(seen.clock, time, self._dt, waited)
        if elapsed < -self._dt:
            reason = (
                f"the time went back by {-elapsed:.3g} s; give seconds of one clock, and call "
                "reset, or restart of a supervisor, if it starts again"
            )
            if is_pause(elapsed):
                raise ImpossibleMeasurement("time", reason)
            seen = self._bridge(seen, "time", Doubt("time", reason), self._dt)
            seen = seen._replace(clock=seen.clock._replace(standing=seen.clock.standing + 1))
            measured["time"] = np.array([seen.clock.time])
            return seen, 0, 0.0
        if clock.standing >= MOST_STANDING:
            raise ImpossibleMeasurement(
                "time",
                f"the time has stood at {time:.10g} s for {clock.standing} calls; give the "
                "time of each sample, or none",
            )
        if elapsed < 0.0:
            # Two samples that came in the wrong order.
            clock = clock._replace(now=seen.clock.now, time=seen.clock.time)
            elapsed = 0.0
        return seen._replace(clock=clock), steps, elapsed

    def _take_arm(
        self, seen: Seen, measured: Measurements, rests_at: np.ndarray | None, elapsed: float
    ) -> Seen:
        """Believes the arm's sample, or bridges it."""
        angles = measured["joint_angles"]
        if not seen.has_arm:
            self.check_first(angles, rests_at)
            seen = self.rest(seen, angles)
        try:
            moved = self._moved(seen, measured)
        except Doubt as doubt:
            return self._bridge_values(seen, measured, "arm", _OF_ARM, doubt, elapsed)
        now = seen.clock.now
        paddle = seen.paddle
        if paddle and paddle[-1][0] == now:
            # The first sample of an arm that rests, or another one at the same time.
            paddle = paddle[:-1]
        paddle = (*paddle, (now, paddle_position(self._metadata, angles)))
        return seen._replace(
            values=_believed(seen, measured, _OF_ARM),
            arm_time=now,
            moved=moved,
            paddle=_recent(paddle, now - _PADDLE_WAY),
        )

    def _moved(self, seen: Seen, measured: Measurements) -> tuple[Moved, ...]:
        """The arm's motion with a sample.

        Raises:
          Doubt: something speaks against the sample.
        """
        angles = measured["joint_angles"]
        last = seen.values["joint_angles"]
        elapsed = max(seen.clock.now - seen.arm_time, self._dt)
        change = np.abs(angles - last)
        too_far = change - (self._fastest * elapsed + self._noise)
        # Of so few numbers, Python's maximum is the faster.
        if max(too_far.tolist()) > 0.0:
            joint = int(np.argmax(too_far))
            turned = abs(change[joint] - 2.0 * math.pi) < 0.2
            remedy = "give unwrapped angles" if turned else "check the encoder, or call reset"
            reason = (
                f"the angle of {self._metadata.joint_names[joint]} is {angles[joint]:.3g} rad, "
                f"{change[joint]:.3g} rad from {1e3 * elapsed:.0f} ms before, "
                f"farther than it moves; {remedy}"
            )
            raise Doubt("joint_jump", reason)
        # Not left by a jump, so that the next sample will say the same.
        self.check_range("angle", angles)
        if "joint_velocities" not in measured:
            return ()
        velocities = measured["joint_velocities"]
        speeds = np.abs(velocities)
        too_fast = speeds - self._fastest
        if max(too_fast.tolist()) > 0.0:
            joint = int(np.argmax(too_fast))
            reason = (
                f"{self._metadata.joint_names[joint]} has {velocities[joint]:.3g} rad/s, and moves "
                f"at most at {self._fastest[joint]:.3g} (rad/s); stop the arm"
            )
            raise Doubt("joint_speed", reason)
        return self._compare_velocities(seen, angles, velocities, speeds)

    def _compare_velocities(
        self, seen: Seen, angles: np.ndarray, velocities: np.ndarray, speeds: np.ndarray
    ) -> tuple[Moved, ...]:
        """The arm's motion with velocities [J], whose integral is the way of the angles [J].

        Raises:
          Doubt: it is another way.
        """
        now = seen.clock.now
        elapsed = now - seen.moved[-1].time if seen.moved else math.inf
        if elapsed > 0.5 * _COMPARED:
            # Nothing is known of the velocities meanwhile.
            return (Moved(now, angles, self._still, speeds),)
        last = seen.moved[-1]
        if elapsed < 0.5 * self._dt:
            return seen.moved
        before = seen.values["joint_velocities"]
        way = last.way + 0.5 * elapsed * (before + velocities)
        moved = _recent((*seen.moved, Moved(now, angles, way, speeds)), now - _COMPARED)
        first = moved[0]
        duration = now - first.time
        if duration < 0.5 * _COMPARED:
            return moved
        by_angles = angles - first.angles
        by_velocities = way - first.way
        apart = np.abs(by_angles - by_velocities)
        # The integral of a noise grows with the root of the time.
        noise = self._velocity_noise * math.sqrt(duration * self._dt)
        at_rest = _LEAST_WAY + self._noise + noise + self._velocity_bias * duration
        if max(apart.tolist()) <= at_rest:
            return moved
        # One velocity may be wrong, and all a little late.
        fastest = np.max([one.speeds for one in moved], axis=0)
        largest_way = np.maximum(np.abs(by_angles), fastest * duration)
        allowed = at_rest + fastest * (_VELOCITY_LAG + self._dt) + _OF_WAY * largest_way
        beyond = apart - allowed
        if max(beyond.tolist()) <= 0.0:
            return moved
        joint = int(np.argmax(beyond))
        reason = (
            f"by its angles {self._metadata.joint_names[joint]} moved {by_angles[joint]:.2g} rad "
            f"in {1e3 * duration:.0f} ms, and by its velocities {by_velocities[joint]:.2g} rad; "
            "give rad/s, each joint's own, with the sign of its angle"
        )
        raise Doubt("joint_speed", reason)

    def check_range(self, label: str, angles: np.ndarray) -> None:
        """Refuses angles [J] (rad) far outside of their ranges. Whole turns are not removed: a
        joint that counts them would be commanded a turn away, and another one is really there.

        Args:
          label: what each is of its joint, for the message.

        Raises:
          ImpossibleMeasurement: one is 0.5 rad outside.
        """
        outside = np.maximum(self._low - angles, angles - self._high)
        if max(outside.tolist()) > _OUTSIDE:
            joint = int(np.argmax(outside))
            raise ImpossibleMeasurement(
                "joint_range",
                f"the {label} of {self._metadata.joint_names[joint]} is {angles[joint]:.3g}, but "
                f"the training had {self._low[joint]:.3g} to {self._high[joint]:.3g} (rad); give "
                "this unit, the policy's order, and no whole turns",
            )

    def check_first(self, angles: np.ndarray, rests_at: np.ndarray | None) -> None:
        """An arm rests where it is said to, or near its start pose.

        Args:
          angles: of a first sample [J], rad.
          rests_at: where it is said to rest [J], rad.

        Raises:
          ImpossibleMeasurement: these angles are elsewhere.
        """
        self.check_range("angle", angles)
        place = self._start if rests_at is None else rests_at
        room = self.start_room if rests_at is None else _NEAR
        away = np.abs(angles - place)
        joint = int(np.argmax(away))
        if away[joint] <= room:
            return
        where = "its start pose" if rests_at is None else "where the arm is said to rest"
        cause = "check its sign, zero, unit and place in the order"
        if not np.any(angles):
            cause = "all joint angles are 0, as of a driver without data"
        elif rests_at is None:
            cause = "say where the arm rests (reset with targets), or " + cause
        raise ImpossibleMeasurement(
            "first_sample",
            f"the first angle of {self._metadata.joint_names[joint]} is {away[joint]:.3g} rad from "
            f"{where}; {cause}",
        )

    def _take_picture(self, seen: Seen, measured: Measurements, elapsed: float) -> Seen:
        """Believes the picture of the balls, or bridges it."""
        balls = measured["ball_position"].reshape(-1, 3)
        age = float(measured["ball_age"][0]) if "ball_age" in measured else None
        if age is not None and age < -SYNCHRONOUS:
            raise ImpossibleMeasurement(
                "old_picture",
                f"the picture of the ball is {1e3 * age:.0f} ms old; give the time since it was "
                "taken, by one clock",
            )
        last = seen.picture
        taken = seen.clock.now - (age or 0.0)
        is_new = last is None or bool((balls != last.balls).any())
        if not is_new:
            is_new = self._is_later(seen, taken - last.taken, has_age=age is not None)
        flights = seen.flights
        try:
            self._check_velocity(measured)
            if is_new:
                flights = self._follow(seen, balls, taken)
        except Doubt as doubt:
            return self._bridge_values(seen, measured, "ball", _OF_BALL, doubt, elapsed)
        values = _believed(seen, measured, _OF_BALL)
        if not is_new:
            return seen._replace(values=values)
        interval = self._dt if last is None else taken - last.taken
        picture = Picture(balls, taken, interval)
        return seen._replace(values=values, picture=picture, flights=flights)

    def _is_later(self, seen: Seen, later: float, has_age: bool) -> bool:
        """Whether a place that repeats is that of another picture.

        Args:
          later: by how much it was taken later, or came later, s.
          has_age: whether it is known when it was taken; if not, only balls that may lie where they
            are repeat their place.
        """
        if has_age:
            return later > _APART * self._dt
        if later < self._still_for or not seen.paddle:
            return False
        paddle = seen.paddle[-1][1]
        return all(may_lie(self._flight, ball, paddle) for ball in seen.picture.balls)

    def _check_velocity(self, measured: Measurements) -> None:
        """Raises Doubt for balls that are too fast."""
        if "ball_velocity" not in measured:
            return
        speed = _longest(measured["ball_velocity"].reshape(-1, 3))
        if speed <= self._flight.speed:
            return
        raise Doubt(
            "ball_speed",
            f"the ball has {speed:.3g} m/s, but the training had at most "
            f"{self._flight.speed:.3g} (m/s); give this unit",
        )

    def _follow(self, seen: Seen, balls: np.ndarray, taken: float) -> tuple[Flight, ...]:
        """The flights with a new picture of the balls [B, 3].

        Raises:
          Doubt: something speaks against the picture.
        """
        farthest = self._metadata.ball.distance
        distance = _longest(balls)
        if distance > farthest:
            reason = (
                f"the distance of ball_position is {distance:.3g}, but the training had 0 to "
                f"{farthest:.3g} (m); give this unit, and the robot's frame"
            )
            raise Doubt("ball_place", reason)
        last = seen.picture
        if last is not None and taken < last.taken - self._dt:
            reason = (
                f"the picture of the ball was taken {1e3 * (last.taken - taken):.0f} ms before the "
                "last one; give the newest, and ages by one clock"
            )
            raise Doubt("old_picture", reason)
        if not seen.paddle or taken < seen.let_go:
            return ()
        paddle = _at(seen.paddle, taken)
        if not seen.flights:
            return tuple(begin(taken, ball, paddle) for ball in balls)
        # Times of pictures differ from the truth, but not their order.
        taken = max(taken, float(seen.flights[0].pictures[-1, 0]) + 1e-3)
        flights = []
        for ball, flight in zip(balls, seen.flights, strict=True):
            following, reason = follow(self._flight, flight, taken, ball, paddle)
            if reason is not None:
                x, y, z = ball - paddle
                place = f"{math.hypot(x, y):.2g} m beside and {z:.2g} m above the paddle"
                reason = (
                    f"the ball, {place}, {reason}; check the camera, and that nothing else looks "
                    "like the ball and nobody holds it"
                )
                raise Doubt("ball_flight", reason)
            flights.append(following)
        return tuple(flights)

    def _bridge_values(
        self,
        seen: Seen,
        measured: Measurements,
        kind: str,
        names: tuple[str, ...],
        doubt: Doubt,
        elapsed: float,
    ) -> Seen:
        """Puts the last values of some measurements in place; what came for the first time is left
        out.

        Args:
          kind: of the bridge.
          elapsed: time for which the sample counts, s.
        """
        if names[0] not in seen.values:
            raise doubt.refused()
        seen = self._bridge(seen, kind, doubt, elapsed)
        for name in names:
            if measured.pop(name, None) is None:
                continue
            if name == "ball_age":
                if seen.picture is not None:
                    measured[name] = np.array([seen.clock.now - seen.picture.taken])
            elif name in seen.values:
                measured[name] = seen.values[name]
        return seen

    def _bridge(self, seen: Seen, kind: str, doubt: Doubt, elapsed: float) -> Seen:
        """Bridges a sample, if at most a third of the last ones are such."""
        now = seen.clock.now
        window = _BRIDGED
        if kind == "ball" and seen.picture is not None:
            window = max(window, _BRIDGED_PICTURES * seen.picture.interval)
        last = seen.bridges.get(kind, Bridge())
        times = (*last.times, now)
        durations = (*last.durations, min(max(elapsed, 0.0), window))
        kept = [place for place, time in enumerate(times) if time > now - window]
        bridge = Bridge(
            tuple(times[place] for place in kept), tuple(durations[place] for place in kept)
        )
        if sum(bridge.durations) > window / 3.0 + 1e-9:
            raise doubt.refused()
        return seen._replace(bridges=seen.bridges | {kind: bridge})


def _believed(seen: Seen, measured: Measurements, names: tuple[str, ...]) -> Measurements:
    """The last believed values, with those of some measurements that a sample has."""
    return seen.values | {name: measured[name] for name in names if name in measured}


def _recent(entries: tuple, since: float) -> tuple:
    """The entries from the last one before a time on; each begins with its time, s."""
    first = 0
    while first + 1 < len(entries) and entries[first + 1][0] <= since + 1e-9:
        first += 1
    return entries[first:]


def _at(way: tuple[tuple[float, np.ndarray], ...], time: float) -> np.ndarray:
    """The place [3] on a way at a time, or the nearest one that is known."""
    for known, place in reversed(way):
        if known <= time:
            return place
    return way[0][1]


def _longest(vectors: np.ndarray) -> float:
    """Length of the longest of vectors [B, 3]."""
    return max(math.hypot(*vector) for vector in vectors.tolist())
