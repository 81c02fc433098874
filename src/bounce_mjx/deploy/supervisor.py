"""A supervisor between a policy and an arm."""

import math
import time
import traceback
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from bounce_mjx.deploy.box import Box, checked_box
from bounce_mjx.deploy.clock import MOST_LATE, Clock, Witness, advance, begin_anew, look
from bounce_mjx.deploy.controller import Controller, Memory
from bounce_mjx.deploy.driver import LARGEST, Driver
from bounce_mjx.deploy.faults import Fault, Followed, Watch, check_balls, picture_age
from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.deploy.motion import Course, paddle_position
from bounce_mjx.deploy.rest import (
    Target,
    Unknown,
    check_place,
    check_tool,
    follow_target,
    place_of,
)
from bounce_mjx.deploy.samples import Measurements, Seen
from bounce_mjx.errors import UserError

State = Literal["homing", "ready", "running", "braking", "stopped"]

# Of the commands at home, rad.
_HOME_TOLERANCE = 2e-3
# On the way home, rad/s.
_HOME_SPEED = 0.3
# In which an arm comes to rest where its commands do, s.
_SETTLING = 1.0
# Horizontal distance of a ball from the paddle's centre at which it is over the paddle, m.
_OVER = 0.15
# How long after the word a hand may let go of the ball, s.
_LETTING_GO = 0.02
# Measured of the arm alone.
_OF_ARM = ("joint_angles", "time", "joint_targets", "tool_position", "tool_normal")


class Stop(NamedTuple):
    """Why an arm stops."""

    fault: str
    reason: str
    is_at_rest: bool = False
    """Whether the commands rest."""


class Place(NamedTuple):
    """Where an arm is to be measured before anything is sent."""

    angles: np.ndarray
    """[J], rad."""
    words: str
    """The same in words."""
    room: float
    """Distance of a joint that is no error, rad."""
    course: Course
    """Commands that begin there."""
    is_said: bool = True
    """Whether the operator, the controller or the last commands say it."""


class Progress(NamedTuple):
    """What a supervisor knows between two calls."""

    memory: Memory
    """The policy's, with the commands."""
    phase: Literal["homing", "ready", "running"] = "homing"
    """The state unless there is a stop."""
    has_found_arm: bool = False
    """Whether the arm has been measured where its commands rest; nothing is sent before, nor once
    a stopped arm is elsewhere."""
    may_raise: bool = True
    """Whether what fails is raised: there was no command, and nobody said where the arm rests."""
    target: Target = Target()
    """The controller's own, before the arm was found."""
    followed: Followed | None = None
    """The arm's last control steps, since it was found."""
    witness: Witness = Witness()
    """The clocks, since the begin or the last restart."""
    waits_for: str | None = None
    """Why the arm waits on its way home."""
    waits_since: float | None = None
    """Time since which the arm is not where its commands rest, s."""
    resting_angles: np.ndarray | None = None
    """Measured [J] in the last step at home, rad."""
    balls: np.ndarray | None = None
    """Measured [B, 3] in the last step at home, m; None without a picture."""
    ball_age: float | None = None
    """Of that picture, s; None where the driver gives none."""


class Supervisor:
    """Gives an arm's commands, and stops the arm when a measurement cannot be true
    (`deploy.samples`), when the arm does not follow, or the ball is lost (`deploy.faults`), when
    the paddle would leave the box, or when anything else fails; `DeployedPolicy.supervise` creates
    it.

    Call `commands` once each control step, in every state:

    - homing: once the arm is where it is said to rest, it goes slowly to the policy's first
      posture, also back from a push, then it is
    - ready: it rests there until `start`;
    - running: it follows the policy, until a fault or `stop`;
    - braking: the commands slow down within the arm's limits, then it is
    - stopped: the commands rest, and `fault` and `reason` say why, until `restart`.

    Each commands begin where the last ones ended. What it remembers is a value (`Progress`), which
    a call replaces as a whole, or not at all.
    """

    def __init__(
        self,
        controller: Controller,
        driver: Driver,
        times: np.ndarray,
        rests_at: np.ndarray | None,
        box: Box = ((-math.inf,) * 3, (math.inf,) * 3),
        max_picture_age: float | None = None,
        max_steps_late: float = 2.0,
    ):
        """See `DeployedPolicy.supervise`.

        Args:
          times: of the commands since the start of a control step [M], s.
          rests_at: where the arm is said to rest [J], rad.
        """
        self._controller = controller
        self._driver = driver
        self._times = times
        self._metadata: Metadata = controller.metadata
        self._dt = self._metadata.control_dt
        self._home = np.array(self._metadata.default_joint_angles)
        age = picture_age(self._metadata) if max_picture_age is None else max_picture_age
        for name, value, most in (
            ("max_picture_age", age, 1.0),
            ("max_steps_late", max_steps_late, 1.0 / self._dt),
        ):
            if not (isinstance(value, Real) and 0.0 < value <= most):
                raise UserError(f"{name} is {value!r}; give a number above 0 and at most {most:g}")
        self._max_picture_age = age
        self._max_steps_late = max_steps_late
        self._box = checked_box(box)
        self._has_box = bool(np.any(np.isfinite(self._box)))
        self._watch = Watch(self._metadata)
        # A stop may come within any other call, from another thread or a signal handler: it is one
        # assignment, which `restart` alone takes back.
        self._stop: Stop | None = None
        self._progress = Progress(controller.begin(rests_at), may_raise=rests_at is None)

    @property
    def state(self) -> State:
        stop = self._stop
        if stop is None:
            return self._progress.phase
        return "stopped" if stop.is_at_rest else "braking"

    @property
    def fault(self) -> str | None:
        """Code of the rule that was broken, such as `ball_lost`, of the tables in
        docs/real-robot.md; `stopped` after `stop`."""
        stop = self._stop
        return None if stop is None else stop.fault

    @property
    def reason(self) -> str | None:
        """Why the arm has stopped or brakes, or what it waits for on its way home."""
        stop = self._stop
        return self._progress.waits_for if stop is None else stop.reason

    def start(self) -> None:
        """Starts an episode, as the ball is let go, or up to 20 ms before.

        Raises:
          UserError: the arm is not ready, or the ball is seen elsewhere than over the paddle, or in
            a picture that would stop the arm at once.
        """
        if self.state != "ready":
            raise UserError(
                f"the arm is {self.state}, and an episode starts when it is ready; call restart "
                "after a stop, and commands until the arm is home"
            )
        progress = self._progress
        self._check_start(progress)
        # A load and the servo hold the arm a little beside its command.
        seen = self._controller.samples.rest(progress.memory.seen, progress.resting_angles)
        seen = seen._replace(let_go=seen.clock.now + _LETTING_GO)
        memory = self._controller.episode(seen, progress.memory.course)
        self._progress = progress._replace(memory=memory, phase="running")

    def stop(self, reason: str, fault: str = "stopped") -> None:
        """Brakes, from any state. It may be called at any time, also by another thread or a signal
        handler while `commands` works; the commands of the next control step brake, at the
        latest."""
        if self._stop is None:
            self._stop = Stop(fault, reason)

    def restart(self, moved: bool = False, targets: Sequence[float] | None = None) -> None:
        """Goes home after a stop, for the next `start`. The commands go on where they rest, and
        nothing is sent until the arm is there. The driver's clock may have begun anew.

        Args:
          moved: whether the arm was moved with its servos off. Its commands then begin anew, as the
            first ones did: where the controller holds it (`joint_targets`), or near the start pose.
          targets: servo targets [J] (rad) at which the moved arm rests now.

        Raises:
          UserError: the arm has not stopped, or the targets are not J numbers in the joint ranges.
        """
        if self.state != "stopped":
            raise UserError(f"the arm is {self.state}; restart it when it has stopped")
        stop = self._stop
        # A stop from here on stays.
        self._stop = None
        try:
            progress = self._restarted(moved, targets)
        except UserError:
            self._stop = self._stop or stop
            raise
        self._progress = progress

    def _restarted(self, moved: bool, targets: Sequence[float] | None) -> Progress:
        progress = self._progress
        course = progress.memory.course
        if targets is not None:
            values = self._driver.read_joints("the targets", targets, "rad", LARGEST)
            self._controller.samples.check_range("target", values)
            course = self._controller.motion.resting(values)
        elif moved:
            course = None
        memory = self._controller.episode(Seen(), course)
        return Progress(memory, may_raise=progress.may_raise)

    def commands(self, measurements: Mapping[str, Any]) -> np.ndarray:
        """Commands [M, J] of a control step at the robot's rate, rad; none ([0, J]), so that
        nothing is sent, in a call that is no new control step, until the arm is measured where it
        is said to rest (`DeployedPolicy.reset`, the controller's own `joint_targets`, or near the
        start pose), after a `restart` until it is where the commands rest, and once a stopped arm
        that had a second to settle is elsewhere.

        Args:
          measurements: as for `DeployedPolicy.step`. Before `start`, only the joint angles are
            needed, and none while the arm brakes; after that, the joint angles tell whether the
            stopped arm was moved. Without `time`, the host's clock counts. Without `ball_age` a
            picture is as old as the time since the ball's position last changed.

        Raises:
          Exception: anything fails before the supervisor has given a command, and nobody said where
            the arm rests; mostly a `UserError`, as the first joint angles are wrong. In all other
            cases nothing is raised, and the arm brakes.
        """
        host = time.monotonic()
        progress = self._progress
        steps = 0
        if self._stop is None:
            try:
                progress, steps = self._next(progress, measurements, host)
            except Exception as error:
                if progress.may_raise and not isinstance(error, Fault):
                    raise
                self.stop(*_fault_of(error))
        if self._stop is not None:
            # What this step was to send is not sent.
            progress, steps = self._brake(self._progress, measurements, host)
        course = progress.memory.course
        has_commands = course is not None and progress.has_found_arm
        if steps:
            progress = progress._replace(witness=progress.witness._replace(stepped=host))
        self._progress = progress._replace(may_raise=progress.may_raise and not has_commands)
        if steps == 0 or not has_commands:
            return np.zeros((0, len(self._home)))
        return self._driver.to_driver(self._controller.motion.at(course, self._times))

    def _next(
        self, progress: Progress, measurements: Mapping[str, Any], host: float
    ) -> tuple[Progress, int]:
        """What is known after a call at a time of the host (s), and the control steps since the
        last one.

        Raises:
          UserError: the arm is to stop.
        """
        if not isinstance(measurements, Mapping):
            raise UserError(
                f"the measurements are {str(measurements)[:100]!r}; give a mapping of their names, "
                "such as joint_angles"
            )
        waited = progress.witness.waited(host)
        if progress.phase == "running":
            # Of a policy that does not see them, the arm needs the angles all the same.
            needs = tuple(dict.fromkeys((*self._driver.needs, "joint_angles")))
            measured = self._driver.check(measurements, needs)
            progress = self._timed(progress, measured, host)
            return self._follow(progress, measured, waited)
        of_arm = {name: value for name, value in measurements.items() if name in _OF_ARM}
        measured = self._driver.check(of_arm, ("joint_angles",))
        progress = self._timed(progress, measured, host)
        balls = self._given(measurements, "ball_position")
        places = None if balls is None else balls.reshape(-1, 3)
        progress = progress._replace(balls=places, ball_age=self._age_given(measurements))
        if not progress.has_found_arm:
            return self._find_arm(progress, measured, waited)
        return self._go_home(progress, measured, waited)

    def _timed(self, progress: Progress, measured: Measurements, host: float) -> Progress:
        """What is known with the time of a sample, which gets the time that is believed.

        Raises:
          UserError: a time comes in some samples alone, or too many were not believed.
        """
        given = float(measured["time"][0]) if "time" in measured else None
        witness = progress.witness
        if witness.host is not None and witness.has_time != (given is not None):
            if witness.has_time:
                raise UserError(
                    "the measurement time is missing, and was given before; give it in every sample"
                )
            raise UserError(
                "the measurement time is given, and was not before; give it in every sample, "
                "or in none"
            )
        witness, is_believed = look(witness, given, host)
        measured["time"] = np.array([witness.time])
        progress = progress._replace(witness=witness)
        if is_believed:
            return progress
        memory = progress.memory
        seen = self._controller.samples.bridge_time(memory.seen, given, witness.time)
        return progress._replace(memory=memory._replace(seen=seen))

    def _find_arm(
        self, progress: Progress, measured: Measurements, waited: float | None
    ) -> tuple[Progress, int]:
        """Waits until the arm is measured where it rests, from where its commands begin or go
        on."""
        memory = progress.memory
        of_time = {"time": measured["time"]}
        seen, _, steps = self._controller.samples.take(memory.seen, of_time, None, waited)
        angles = measured["joint_angles"]
        self._controller.samples.check_range("angle", angles)
        target = follow_target(progress.target, measured)
        progress = progress._replace(memory=memory._replace(seen=seen), target=target)
        try:
            place = self._resting_place(progress, angles)
        except Unknown as unknown:
            return progress._replace(waits_for=str(unknown), waits_since=None), steps
        try:
            check_place(self._metadata, angles, place.angles, place.room, place.words)
            check_tool(self._metadata, measured)
        except Unknown as unknown:
            if not place.is_said:
                return progress._replace(waits_for=str(unknown), waits_since=None), steps
            return self._wait(progress, unknown), steps
        course = place.course
        seen = self._controller.samples.rest(seen, angles)
        command = self._controller.motion.target(course)
        progress = progress._replace(
            memory=memory._replace(seen=seen, course=course),
            has_found_arm=True,
            followed=self._watch.rest(angles, command),
            waits_for=None,
            waits_since=None,
        )
        return self._move_home(progress, angles, max(steps, 1))

    def _resting_place(self, progress: Progress, angles: np.ndarray) -> Place:
        """Where an arm at angles [J] is said to rest.

        Raises:
          Unknown: the next samples will say it.
        """
        motion = self._controller.motion
        room = self._watch.offset
        course = progress.memory.course
        if course is not None:
            return Place(motion.target(course), "where its commands rest", room, course)
        target = place_of(progress.target, angles)
        if target is not None:
            return Place(target, "where its controller holds it", room, motion.resting(target))
        words = (
            "its start pose, and nobody says where the arm rests: give the controller's own "
            "joint_targets, or reset(targets)"
        )
        room = self._controller.samples.start_room
        return Place(self._home, words, room, motion.resting(angles), is_said=False)

    def _go_home(
        self, progress: Progress, measured: Measurements, waited: float | None
    ) -> tuple[Progress, int]:
        """A step of the way home, or at home."""
        before = progress.memory.seen.clock
        samples = self._controller.samples
        seen, measured, steps = samples.take(progress.memory.seen, measured, None, waited)
        self._check_pace(before, seen.clock)
        progress = progress._replace(memory=progress.memory._replace(seen=seen))
        if steps == 0:
            return progress, 0
        angles = measured["joint_angles"]
        command = self._controller.motion.target(progress.memory.course)
        followed = self._watch.follow(
            progress.followed, angles, command, steps, seen.is_arm_bridged
        )
        return self._move_home(progress._replace(followed=followed), angles, steps)

    def _move_home(
        self, progress: Progress, angles: np.ndarray, steps: int
    ) -> tuple[Progress, int]:
        """The next commands on the way home of an arm at angles [J]."""
        motion = self._controller.motion
        last = progress.memory.course
        if progress.memory.seen.clock.has_waited:
            last = motion.stopped(last)
        if np.abs(motion.target(last) - self._home).max() > _HOME_TOLERANCE:
            course = motion.move(last, self._home, _HOME_SPEED)
            # An arm that starts outside of the box may come in.
            if self._outside(last.end.position) <= 0.0:
                self._check_box(motion.braking_path(course))
            memory = progress.memory._replace(course=course)
            return progress._replace(memory=memory, phase="homing"), steps
        course = motion.hold(last)
        progress = progress._replace(
            memory=progress.memory._replace(course=course), resting_angles=angles
        )
        if not motion.is_still(course):
            return progress, steps
        return self._settle(progress, angles), steps

    def _settle(self, progress: Progress, angles: np.ndarray) -> Progress:
        """Whether the arm has come to rest at home, where its commands are; else it waits.

        Raises:
          Fault: it had time to settle.
        """
        place = self._controller.motion.target(progress.memory.course)
        room = self._watch.offset
        try:
            check_place(self._metadata, angles, place, room, "where its commands rest")
        except Unknown as unknown:
            return self._wait(progress._replace(phase="homing"), unknown)
        return progress._replace(phase="ready", waits_for=None, waits_since=None)

    def _wait(self, progress: Progress, unknown: Unknown) -> Progress:
        """An arm that is not where its commands rest, and may still come there.

        Raises:
          Fault: it had time to settle.
        """
        now = progress.memory.seen.clock.now
        since = now if progress.waits_since is None else progress.waits_since
        if now - since > _SETTLING:
            raise Fault(unknown.fault, str(unknown)) from None
        return progress._replace(waits_for=str(unknown), waits_since=since)

    def _follow(
        self, progress: Progress, measured: Measurements, waited: float | None
    ) -> tuple[Progress, int]:
        """A step of the policy."""
        controller = self._controller
        command = controller.motion.target(progress.memory.course)
        clock = progress.memory.seen.clock
        # Before the sample is judged: what a late one shows follows from its lateness.
        late = advance(clock, float(measured["time"][0]), self._dt)[2] - 1
        if late > self._max_steps_late:
            raise Fault("late_step", f"a control step came {late} steps late")
        memory, measured, steps = controller.take(progress.memory, measured, waited)
        seen = memory.seen
        self._check_pace(clock, seen.clock)
        if steps == 0:
            return progress._replace(memory=memory), 0
        if "ball_position" in measured:
            age = seen.clock.now - seen.picture.taken
            if "ball_age" in measured:
                age = max(age, float(measured["ball_age"][0]))
            check_balls(seen.picture.balls, age, self._max_picture_age, seen.paddle[-1][1])
        followed = self._watch.follow(
            progress.followed, measured["joint_angles"], command, steps, seen.is_arm_bridged
        )
        memory = controller.act(memory, measured, steps)
        self._check_box(controller.motion.braking_path(memory.course))
        return progress._replace(memory=memory, followed=followed), steps

    def _check_pace(self, before: Clock, clock: Clock) -> None:
        """Raises Fault for a loop that is slower than the control steps: its arm would rest after
        each, and neither play nor get home."""
        if clock.late > MOST_LATE:
            raise Fault(
                "late_step",
                f"most samples come late, the last one {1e3 * (clock.now - before.now):.0f} ms "
                f"after the one before; call commands every {1e3 * self._dt:g} ms",
            )

    def _brake(
        self, progress: Progress, measurements: Mapping[str, Any], host: float
    ) -> tuple[Progress, int]:
        """A step in which the commands brake or rest, whatever is measured."""
        memory = progress.memory
        stop = self._stop
        if memory.course is None or not progress.has_found_arm:
            # Nothing has been sent since the begin, or the restart.
            self._stop = stop._replace(is_at_rest=True)
            return progress, 0
        progress, steps = self._braking_time(progress, measurements, host)
        memory = progress.memory
        clock = memory.seen.clock
        if steps == 0:
            return progress, 0
        motion = self._controller.motion
        last = motion.stopped(memory.course) if clock.has_waited else memory.course
        course = motion.hold(last)
        memory = memory._replace(course=course)
        progress = progress._replace(memory=memory, phase="homing", waits_for=None)
        if not stop.is_at_rest:
            if motion.is_still(course):
                self._stop = stop._replace(is_at_rest=True)
                progress = progress._replace(waits_since=clock.now)
            return progress, steps
        is_there = self._is_not_moved(progress, measurements)
        return progress._replace(has_found_arm=progress.has_found_arm and is_there), steps

    def _braking_time(
        self, progress: Progress, measurements: Mapping[str, Any], host: float
    ) -> tuple[Progress, int]:
        """The clocks while the arm brakes, and the control steps since the last call: by the host's
        if the driver's has agreed with it; else by the driver's, and one if that cannot be read,
        stands or goes back."""
        memory = progress.memory
        clock = memory.seen.clock
        witness = progress.witness
        if witness.is_agreed:
            waited = witness.waited(host)
            witness = witness.at_host(host)
            clock, _, steps = advance(clock, witness.time, self._dt, waited)
        else:
            given = self._given(measurements, "time")
            time_given = None if given is None else float(given[0])
            new, elapsed, steps = advance(clock, time_given, self._dt)
            if time_given is None or elapsed <= 0.0:
                clock = begin_anew(clock, time_given, self._dt)
                steps = 1
            else:
                clock = new
        memory = memory._replace(seen=memory.seen._replace(clock=clock))
        return progress._replace(memory=memory, witness=witness), steps

    def _given(self, measurements: Mapping[str, Any], name: str) -> np.ndarray | None:
        """A measurement by its name; None if it is missing or cannot be read."""
        try:
            return self._driver.check({name: measurements[name]}, (name,))[name]
        except (UserError, KeyError, TypeError):
            return None

    def _age_given(self, measurements: Mapping[str, Any]) -> float | None:
        """Age of the balls' picture, s; infinite if it cannot be read, None if there is none."""
        if "ball_age" not in measurements:
            return None
        given = self._given(measurements, "ball_age")
        return math.inf if given is None else float(given[0])

    def _is_not_moved(self, progress: Progress, measurements: Mapping[str, Any]) -> bool:
        """Whether a stopped arm is where its commands rest, has had no time to settle, or is not
        measured."""
        since = progress.waits_since
        if since is not None and progress.memory.seen.clock.now - since <= _SETTLING:
            return True
        angles = self._given(measurements, "joint_angles")
        if angles is None:
            return True
        place = self._controller.motion.target(progress.memory.course)
        return bool(np.all(np.abs(angles - place) <= self._watch.offset))

    def _check_start(self, progress: Progress) -> None:
        """Raises UserError for an old picture of the ball, or a ball that is not over the paddle by
        forward kinematics."""
        age = progress.ball_age
        if age is not None and age > self._max_picture_age:
            raise UserError(
                f"the newest picture of the ball is {1e3 * age:.0f} ms old, and an episode starts "
                f"with one of at most {1e3 * self._max_picture_age:.0f} ms; check the camera"
            )
        if progress.balls is None or self._metadata.ball_thrown:
            return
        paddle = paddle_position(self._metadata, progress.resting_angles)
        x, y, z = progress.balls[0] - paddle
        beside = math.hypot(x, y)
        if beside > _OVER or z < 0.0:
            raise UserError(
                f"the ball is seen {beside:.2g} m beside and {z:.2g} m above the paddle, and an "
                "episode starts with the ball over it; check the camera, or hold the ball there"
            )

    def _check_box(self, joint_angles: np.ndarray) -> None:
        """Raises Fault if the paddle would leave the box at one of the joint angles [K, J], in
        which the commands would brake."""
        outside = self._outside(joint_angles)
        if outside > 0.0:
            raise Fault("box", f"the paddle would come to rest {outside:.3g} m outside the box")

    def _outside(self, joint_angles: np.ndarray) -> float:
        """How far the paddle is outside of the box at one of the joint angles [..., J], m; negative
        inside."""
        if not self._has_box:
            return -math.inf
        paddle = paddle_position(self._metadata, joint_angles)
        return float(np.max([self._box[0] - paddle, paddle - self._box[1]]))


def _fault_of(error: Exception) -> tuple[str, str]:
    """Reason and code of an exception in a control step."""
    if isinstance(error, UserError):
        return str(error), getattr(error, "fault", "measurement")
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"the program failed: {error!r} ({Path(place.filename).name}:{place.lineno})", "error"
