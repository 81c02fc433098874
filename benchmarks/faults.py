"""Faults of a robot, put one at a time into MuJoCo's C engine under a supervised policy.

    python benchmarks/faults.py                        # every fault for every policy
    python benchmarks/faults.py robust --faults joint  # those with a word in their name

The robot has late and noisy pictures, and noisy encoders (perfect ones for policies that trained
without such errors). In each run the arm goes home, the policy plays, and the fault comes after
1.5 s, of `catch` after 0.7 s, while the arm still moves. A run passes if

- the policy started and the fault came;
- the last command of no control step is farther from that of the step before than
  `Metadata.largest_step`, and the first one is where the arm is;
- the braking begins after the fault and in time, for the reason that was expected, or nothing
  stops where nothing should;
- neither the commands nor the arm leave the box around the paddle's home.

The exit status is 1 if a run fails.
"""

import argparse
import concurrent.futures
import copy
import functools
import math
import multiprocessing
import sys
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.errors import UserError
from bounce_mjx.physics import CEngine
from bounce_mjx.rehearsal import faults as inject
from bounce_mjx.rehearsal.faults import Act, Moment
from bounce_mjx.resources import POLICIES, resource_path
from bounce_mjx.robot.model import balls_above, find_addresses
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.world.model import world_model

RATE = 500.0
"""Of the commands, Hz."""
FAULT_AT = 1.5
"""Time of the fault after the start of the episode, s."""
FAULT_AT_OF = {"catch": 0.7}
"""The same of policies whose arm rests by then: a joint that is not asked to move shows none."""
SECONDS = 4.0
"""Length of a run after the start of the episode, s."""
BOX = 0.5
"""Half of the box around the paddle's home, m."""
FIRST_COMMAND = 0.02
"""What the first command may be off the arm, rad."""
OVERSHOOT = 0.02
"""What the arm may be off the box, m."""


class Sensors(NamedTuple):
    """The camera and the encoders."""

    rate: float
    """Of the camera's pictures, Hz."""
    delay: float
    """Of the pictures, s."""
    noise: float
    """Of the balls' positions, m."""
    angle_noise: float
    """Of the encoders, rad."""


REAL = Sensors(rate=120.0, delay=0.01, noise=0.001, angle_noise=1e-4)
PERFECT = Sensors(rate=1e3, delay=0.0, noise=0.0, angle_noise=0.0)
"""For the policies that were trained without errors of the sensors."""


@functools.cache
def _model(name: str) -> tuple[mujoco.MjModel, Any]:
    env = load_run_config(resource_path(POLICIES[name])).env
    return world_model(env, visual=False), env


@functools.cache
def _throw_of(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of the balls [B, 3] at the start of an episode."""
    env = _model(name)[1]
    task = env.task(env)
    goal = {key: jnp.array(0.5 * (x.low + x.high)) for key, x in env.goals.items()}
    thrown = task.throw(jnp.full(task.num_draws, 0.5), goal)
    if thrown is not None:
        return tuple(np.asarray(x, float).reshape(-1, 3) for x in thrown)
    return balls_above(env.ball_init_pos, env.num_balls), np.zeros((env.num_balls, 3))


class Robot:
    """An arm with a paddle, balls and a camera in the C engine; somebody holds the balls until the
    episode starts."""

    def __init__(self, name: str, seed: int = 0):
        shared_model, env = _model(name)
        self.name = name
        self.engine = CEngine(shared_model)
        self.model = self.engine.model
        self.data = mujoco.MjData(self.model)
        self.random = np.random.default_rng(seed)
        self.sensors = REAL if env.randomization.ball_latency else PERFECT
        addresses = find_addresses(self.model)
        self.qpos = list(addresses.arm_qpos)
        self.qvel = list(addresses.arm_qvel)
        self.servos = list(addresses.actuators)
        self.paddle_geom = addresses.paddle_geom
        self.balls = addresses.balls
        self.home = np.array(env.default_joint_angles)
        self.data.qpos[self.qpos] = self.home
        self.is_held = True
        self.is_dead = np.zeros(len(self.home), bool)
        self.command_delay = 0.0
        """From a command to the servos, s."""
        self.sent: deque[tuple[float, np.ndarray]] = deque()
        self.command = self.home.copy()
        self.pictures: deque[tuple[float, np.ndarray]] = deque()
        """That the program has not yet, with the times at which they were taken, s."""
        self.newest: tuple[float, np.ndarray] | None = None
        self.before: tuple[float, np.ndarray] | None = None
        self.hold()
        mujoco.mj_forward(self.model, self.data)

    def hold(self) -> None:
        """Puts the balls at their start."""
        for ball, place in zip(self.balls, _throw_of(self.name)[0], strict=True):
            self.data.qpos[list(ball.qpos)] = [*place, 1.0, 0.0, 0.0, 0.0]
            self.data.qvel[list(ball.qvel)] = 0.0

    def release(self) -> None:
        """Throws the balls as the task does."""
        for ball, velocity in zip(self.balls, _throw_of(self.name)[1], strict=True):
            self.data.qvel[list(ball.qvel[:3])] = velocity
        self.is_held = False

    @property
    def angles(self) -> np.ndarray:
        return self.data.qpos[self.qpos].copy()

    @property
    def paddle(self) -> np.ndarray:
        return self.data.geom_xpos[self.paddle_geom].copy()

    @property
    def picture_time(self) -> float:
        return self.newest[0]

    @property
    def picture_noise(self) -> float:
        return self.sensors.noise

    def measure(self) -> dict[str, Any]:
        """What the robot's program knows."""
        time = self.data.time
        while self.pictures and self.pictures[0][0] <= time - self.sensors.delay + 1e-9:
            self.before = self.newest
            self.newest = self.pictures.popleft()
        angle_noise, velocity_noise = self.random.standard_normal((2, len(self.home)))
        angle_noise = self.sensors.angle_noise * angle_noise
        velocity_noise = 100.0 * self.sensors.angle_noise * velocity_noise
        measured = {
            "joint_angles": self.angles + angle_noise,
            "joint_velocities": self.data.qvel[self.qvel] + velocity_noise,
            "time": time,
        }
        if self.newest is not None:
            taken, places = self.newest
            earlier, places_before = self.before or self.newest
            velocity = (places - places_before) / max(taken - earlier, 1e-3)
            if self.sensors == PERFECT:
                rows = [self.data.qvel[list(ball.qvel[:3])] for ball in self.balls]
                velocity = np.squeeze(rows)
            measured |= {"ball_position": places.copy(), "ball_velocity": velocity}
            measured["ball_age"] = time - taken
        return measured

    def step(self, commands: np.ndarray) -> None:
        """The control step of commands [M, J]."""
        for command in commands:
            self.sent.append((self.data.time + self.command_delay, np.array(command)))
            for _ in range(round(1.0 / (RATE * self.model.opt.timestep))):
                while self.sent and self.sent[0][0] <= self.data.time + 1e-9:
                    self.command = self.sent.popleft()[1]
                self.data.ctrl[self.servos] = np.where(self.is_dead, self.angles, self.command)
                if self.is_held:
                    self.hold()
                self.engine.step(self.data)
                self._look()

    def _look(self) -> None:
        last_picture = self.pictures[-1] if self.pictures else self.newest
        last_time = -1.0 if last_picture is None else last_picture[0]
        if self.data.time - last_time > 1.0 / self.sensors.rate - 1e-9:
            places = np.array([self.data.qpos[list(ball.qpos[:3])] for ball in self.balls])
            noise = self.sensors.noise * self.random.standard_normal(places.shape)
            self.pictures.append((self.data.time, np.squeeze(places + noise)))


class Fault(NamedTuple):
    """A fault, and what the supervisor does."""

    act: Act
    """In each control step in which it is there, before the measurement is given."""
    codes: tuple[str, ...] = ()
    """Faults of the supervisor, one of which is expected; an empty one: it may also go on. None if
    nothing stops."""
    within: float = 0.3
    """Time to the start of the braking, s."""
    steps: float = math.inf
    """Control steps in a row in which it is there."""
    from_start: bool = False
    """Whether it is there from the first sample, not after a time of the episode."""
    pauses: bool = False
    """Whether the program is not called."""
    sent: Callable[[Moment, np.ndarray], np.ndarray] | None = None
    """What the robot gets in place of the commands [M, J]."""
    falls: bool = False
    """Whether no command can keep the arm in the box."""


def _at_rest(moment: Moment, commands: np.ndarray) -> np.ndarray:
    """The robot rests at the command that it had."""
    return np.tile(moment.arm.command, (len(commands), 1))


def _nothing(moment: Moment) -> None:
    pass


def _half_zero(moment: Moment) -> None:
    angles = moment.measured["joint_angles"]
    angles[: len(angles) // 2] = 0.0


def _copied_target(moment: Moment) -> None:
    _half_zero(moment)
    moment.measured["joint_targets"] = moment.measured["joint_angles"].copy()


def _every_second(moment: Moment) -> None:
    if round(100.0 * moment.time) % 2 == 0:
        moment.measured["joint_angles"][1:4] = 0.0


def _velocities(change: Callable[[np.ndarray], np.ndarray]) -> Act:
    return inject.put("joint_velocities", lambda m: change(m.measured["joint_velocities"]))


def _second_ball() -> Act:
    """Every second picture that the program sees shows another ball."""
    seen: list[float] = []

    def act(moment: Moment) -> None:
        if moment.time == 0.0:
            seen.clear()
        taken = moment.arm.picture_time
        if taken not in seen[-1:]:
            seen.append(taken)
        if len(seen) % 2:
            moment.measured["ball_position"] = moment.measured["ball_position"] + [0.0, 0.1, 0.0]

    return act


ARM = ("joint_astray",)
"""Codes for an arm that does not follow."""
JUMP = ("joint_jump", "joint_range")
"""Codes for angles that cannot be."""
FLIGHT = ("ball_flight", "ball_lost")
"""Codes for a ball that does not fly as balls do."""
HELD = ("ball_flight",)
SPEED = ("joint_speed",)
WAITS = ("waits", "joint_range")
"""Codes for an arm that is not known to rest where it is measured: nothing is sent."""


def faults(joints: int, policy: str = "robust") -> dict[str, Fault]:
    """The faults of an arm with a number of joints under a policy, by name."""
    found = {"nothing": Fault(_nothing)}
    for joint in (0, 1, 2, joints - 1):
        name = f"joint {joint + 1}"
        for size in (0.3, 1.0, -3.0):
            found[f"{name}: one sample off by {size} rad"] = Fault(inject.off(joint, size), steps=1)
        found[f"{name}: encoder jumps by 0.5 rad"] = Fault(inject.off(joint, 0.5), JUMP)
        # Its velocities, of another sensor, may contradict it first.
        found[f"{name}: encoder drifts by 0.5 rad/s"] = Fault(
            inject.drift(joint, 0.5), (*ARM, *SPEED, "box")
        )
        found[f"{name}: encoder is frozen"] = Fault(inject.frozen_encoder(joint), ARM, 0.5)
        found[f"{name}: servo without torque"] = Fault(inject.dead(joint), ARM, 0.5)
    for joint in (1, 2):
        found[f"joint {joint + 1}: sign flips"] = Fault(inject.flipped(joint), JUMP)
    zeros = inject.put("joint_angles", lambda m: 0.0 * m.measured["joint_angles"])
    found |= {
        "all joints: encoders of 4,096 counts": Fault(inject.coarse, from_start=True),
        "all joints: dry friction, 4,096 counts": Fault(
            inject.dry_friction, ("", "ball_lost", "box"), math.inf, from_start=True
        ),
        "joint 1 and 2 swapped": Fault(inject.swapped(0, 1), (*JUMP, *ARM)),
        "joint 2 and 3 swapped": Fault(inject.swapped(1, 2), (*JUMP, *ARM)),
        "joint 2 and 3 swapped from the start": Fault(inject.swapped(1, 2), WAITS, from_start=True),
        "joint 2 with another sign from the start": Fault(
            inject.flipped(1), WAITS, from_start=True
        ),
        "joint 2: zero off by a quarter turn from the start": Fault(
            inject.off(1, 0.5 * math.pi), WAITS, from_start=True
        ),
        "half of the joints zero from the start": Fault(_half_zero, WAITS, from_start=True),
        "a copy of wrong angles as the target from the start": Fault(
            _copied_target, WAITS, from_start=True
        ),
        "zeros of three joints in every second sample": Fault(_every_second, JUMP),
        "joint velocities: zero": Fault(_velocities(lambda v: 0.0 * v), SPEED, 0.5),
        "joint velocities: reversed": Fault(_velocities(lambda v: -v), SPEED, 0.5),
        "joint velocities: permuted": Fault(_velocities(lambda v: np.roll(v, 1)), SPEED, 0.5),
        "joint velocities: rpm": Fault(_velocities(lambda v: 9.55 * v), SPEED, 0.5),
        "all joints: degrees": Fault(
            inject.put("joint_angles", lambda m: np.degrees(m.measured["joint_angles"])), JUMP
        ),
        "all joints: one sample of zeros": Fault(zeros, steps=1),
        "all joints: zeros": Fault(zeros, JUMP),
        "all joints: first samples are zeros": Fault(zeros, steps=10, from_start=True),
        "joint 1: first sample is off by 0.5 rad": Fault(
            inject.off(0, 0.5), steps=1, from_start=True
        ),
        "joint 2: first sample is off by 0.25 rad": Fault(
            inject.off(1, 0.25), steps=1, from_start=True
        ),
        "joint 2: first sample is off by 1 rad": Fault(
            inject.off(1, 1.0), steps=1, from_start=True
        ),
        "all joints: frozen": Fault(inject.frozen("joint_angles"), ARM),
        "all joints: wrapped by a turn": Fault(
            inject.put("joint_angles", lambda m: m.measured["joint_angles"] + 2.0 * math.pi),
            JUMP,
        ),
        "all joints: NaN": Fault(
            inject.put("joint_angles", lambda m: np.nan * m.measured["joint_angles"]),
            ("measurement",),
        ),
        "all joints: complex": Fault(
            inject.put("joint_angles", lambda m: m.measured["joint_angles"] + 1j),
            ("measurement",),
        ),
        "all joints: missing": Fault(lambda m: m.measured.pop("joint_angles"), ("measurement",)),
        "torque of 3 N m": Fault(inject.weak(3.0), ARM, falls=True),
        "the arm ignores its commands": Fault(_nothing, ARM, sent=_at_rest),
        "commands 0.5 s late": Fault(inject.late_commands, (*ARM, "ball_lost", "box"), 0.5),
        "time stands": Fault(inject.frozen("time"), ("time",)),
        "time 0.5 s back": Fault(inject.put("time", lambda m: m.measured["time"] - 0.5), ("time",)),
        "time 0.5 s back in one sample": Fault(
            inject.put("time", lambda m: m.measured["time"] - 0.5), steps=1
        ),
        "time 0.5 s ahead": Fault(
            inject.put("time", lambda m: m.measured["time"] + 0.5), ("late_step",)
        ),
        "time 50 s ahead": Fault(
            inject.put("time", lambda m: m.measured["time"] + 50.0), ("late_step",)
        ),
        "time in ms from the start": Fault(
            inject.put("time", lambda m: 1e3 * m.measured["time"]),
            ("measurement", "late_step"),
            from_start=True,
        ),
        "time in float32 from the start": Fault(
            inject.put("time", lambda m: np.float32(1.7e9 + m.measured["time"])),
            ("measurement",),
            from_start=True,
        ),
        "time jitters by 4 ms": Fault(
            inject.put("time", lambda m: m.measured["time"] + m.arm.random.uniform(-0.004, 0.004)),
            from_start=True,
        ),
        "the program pauses for 20 ms": Fault(_nothing, steps=2, pauses=True),
        "the program pauses for 0.2 s": Fault(_nothing, ("late_step",), steps=20, pauses=True),
        "ball: the camera stops": Fault(inject.no_pictures, ("old_picture",)),
        "ball: in mm": Fault(inject.ball(lambda m, x: 1e3 * x), ("ball_place", "ball_speed")),
        "ball: one false picture": Fault(inject.ball(lambda m, x: x + [0.0, 0.6, 0.0]), steps=1),
        "ball: 0.9 m aside": Fault(inject.ball(lambda m, x: x + [0.0, 0.9, 0.0]), FLIGHT),
        "ball: mirrored": Fault(inject.ball(lambda m, x: x * [-1.0, -1.0, 1.0]), FLIGHT),
        "ball: found 0.35 m aside": Fault(inject.ball(lambda m, x: x + [0.0, 0.35, 0.0]), FLIGHT),
        # Within the noise of the training's worlds: it may be seen when the ball misses the paddle.
        "ball: a camera is bumped by 5 cm": Fault(
            inject.ball(lambda m, x: x + [0.0, 0.05, 0.0]), ("", *FLIGHT, "box"), math.inf
        ),
        "ball: a second one 0.1 m aside in every second picture": Fault(_second_ball(), FLIGHT),
        "ball: held 0.4 m beside": Fault(inject.held([0.0, 0.4, 0.1]), FLIGHT),
        "ball: held 0.3 m above": Fault(inject.held([0.0, 0.0, 0.3]), FLIGHT),
        "ball: carried at 0.3 m/s": Fault(inject.held([0.0, 0.4, 0.1], speed=0.3), FLIGHT),
        "ball: held 3 cm above": Fault(inject.held([0.0, 0.0, 0.05]), HELD, 0.5),
        "ball: hidden": Fault(
            inject.ball(lambda m, x: np.ma.array(x, mask=True)), ("measurement",)
        ),
        "ball: thrown away": Fault(
            inject.thrown(3.0), (*FLIGHT, "box", "ball_place", "old_picture"), 1.5, steps=1
        ),
        "joint velocities 9 rad/s off, in deg/s": Fault(
            inject.put(
                "joint_velocities", lambda m: np.degrees(9.0 + m.measured["joint_velocities"])
            ),
            ("joint_speed",),
        ),
    }
    if load_policy(policy).metadata.ball_rests is not False:
        # A hand near the paddle, and one that takes the ball off it, are no faults there.
        found["ball: held 3 cm above"] = Fault(inject.held([0.0, 0.0, 0.05]), ("", *HELD), math.inf)
    return found


class Outcome(NamedTuple):
    """What happened in a run."""

    has_started: bool
    """Whether the policy has."""
    steps: int
    """Control steps in which the fault was there."""
    fault: str
    """Code of the supervisor's fault; empty if nothing stopped."""
    reason: str
    braking_after: float
    """From the fault to the start of the braking, s; negative if it began before, and NaN if it did
    not."""
    step: float
    """Largest step of the commands as a share of the largest one that is allowed."""
    first: float
    """Distance of the first command from the arm, rad."""
    outside: float
    """Of the commands from the box, m; negative inside."""
    arm_outside: float
    """Of the arm from the box, m."""
    waits_for: str = ""
    """Why nothing was sent; empty if anything was."""

    def wrong(self, fault: Fault) -> str:
        """What is wrong with the outcome of a fault; empty if nothing is."""
        if not self.has_started and not self.fault:
            return "" if "waits" in fault.codes and self.waits_for else "the policy never started"
        if not self.steps:
            return f"stopped before the fault: {self.reason}"
        if self.step > 1.0 + 1e-9:
            return f"a command moves {self.step:.2f} times as far as allowed"
        if self.first > FIRST_COMMAND:
            return f"the first command is {self.first:.3g} rad from the arm"
        if self.outside > 1e-9 or (self.arm_outside > OVERSHOOT and not fault.falls):
            return f"commands {self.outside:.3g} m and the arm {self.arm_outside:.3g} m outside"
        if not fault.codes:
            return f"stopped as {self.reason}" if self.fault else ""
        if self.fault not in fault.codes:
            return f"{self.fault or 'nothing'} in place of {', '.join(fault.codes)}: {self.reason}"
        if self.fault and not fault.from_start and not 0.0 <= self.braking_after <= fault.within:
            return f"braking begins after {self.braking_after:.2f} s"
        return ""


def run(name: str, fault: Fault, seed: int = 0) -> Outcome:
    """One run of a policy with a fault."""
    robot = Robot(name, seed)
    policy = load_policy(name)
    metadata = policy.metadata
    home = paddle_position(metadata, robot.home)
    fault_at = FAULT_AT_OF.get(name, FAULT_AT)
    arm = policy.supervise(RATE, box=(home - BOX, home + BOX))
    wished = {key: float(np.mean(goal.range)) for key, goal in metadata.goals.items()}
    last_commands: list[np.ndarray] = []
    """Of the control steps."""
    commanded: list[np.ndarray] = []
    paddles: list[np.ndarray] = []
    started: float | None = None
    first_measured: dict[str, Any] = {}
    fault_steps = 0
    code = reason = ""
    braking_after = math.nan
    first_distance = 0.0
    commands = np.zeros((0, len(robot.home)))
    while robot.data.time < (started or 1.0) + SECONDS:
        measured = robot.measure() | wished
        fault_time = _time_since_fault(fault, robot.data.time, started, fault_at)
        is_there = fault_time >= 0.0 and fault_steps < fault.steps
        if is_there:
            if not fault_steps:
                first_measured = copy.deepcopy(measured)
            moment = Moment(robot, measured, first_measured, fault_time)
            fault.act(moment)
            fault_steps += 1
        if is_there and fault.pauses:
            commands = commands[-1:].repeat(len(commands), axis=0)
        else:
            used = {name: value for name, value in measured.items() if name in policy.units}
            try:
                commands = arm.commands(used)
            except UserError as error:
                code = getattr(error, "fault", "measurement")
                reason = str(error)
                braking_after = fault_time
                break
        if arm.state in ("braking", "stopped") and not code:
            code = arm.fault
            reason = arm.reason
            braking_after = fault_time
        if len(commands):
            if not last_commands:
                first_distance = float(np.max(np.abs(commands - robot.angles)))
            last_commands.append(commands[-1])
            commanded.extend(commands)
        if arm.state == "ready" and robot.newest is not None:
            arm.start()
            started = robot.data.time
            robot.release()
        sent = commands
        if not len(sent):
            sent = np.tile(robot.command, (policy.commands_per_step(RATE), 1))
        if is_there and fault.sent is not None:
            sent = fault.sent(moment, sent)
        robot.step(sent)
        if started is not None:
            paddles.append(robot.paddle)
        if arm.state == "stopped" and fault_time > 1.0:
            break

    def outside(points: np.ndarray) -> float:
        return float(np.max(np.abs(points - home))) - BOX if len(points) else -BOX

    steps = np.abs(np.diff(last_commands, axis=0)) if len(last_commands) > 1 else np.zeros(1)
    return Outcome(
        has_started=started is not None,
        steps=fault_steps,
        fault=code,
        reason=reason,
        braking_after=braking_after,
        step=float(np.max(steps / metadata.largest_step)),
        first=first_distance,
        outside=outside(paddle_position(metadata, np.array(commanded))) if commanded else -BOX,
        arm_outside=outside(np.array(paddles)),
        waits_for="" if last_commands else arm.reason or "",
    )


def _time_since_fault(fault: Fault, time: float, started: float | None, fault_at: float) -> float:
    """Time since a fault came, s: -inf before the episode of one that comes in it.

    Args:
      time: of the simulation, s.
      started: time of the start of the episode; None before it.
      fault_at: time of the fault after that start, s.
    """
    if fault.from_start:
        return time
    if started is None:
        return -math.inf
    # A sum of many time steps is a little beside the time that it means, and a fault of one
    # control step must not be missed.
    return round(time - started - fault_at, 9)


def cases(policies: list[str], words: list[str]) -> Iterator[tuple[str, str]]:
    """The runs of policies: names of the policy and of the fault."""
    for policy in policies:
        metadata = load_policy(policy).metadata
        for name in faults(len(metadata.joint_names), policy):
            if not words or any(word in name for word in words):
                yield policy, name


def judge(policy: str, name: str) -> tuple[Outcome, str]:
    """The outcome of a run by the names of the policy and the fault, and what is wrong with it."""
    metadata = load_policy(policy).metadata
    fault = faults(len(metadata.joint_names), policy)[name]
    outcome = run(policy, fault)
    return outcome, outcome.wrong(fault)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("policies", nargs="*", default=list(POLICIES), help="names")
    parser.add_argument("--faults", nargs="*", default=[], help="words in the faults' names")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    given = parser.parse_args()
    runs = list(cases(given.policies, given.faults))
    if not runs:
        parser.error(f"no fault has one of {given.faults} in its name")
    failed = 0
    # A process that is forked after JAX was imported may hang.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(given.jobs, mp_context=context) as pool:
        for (policy, name), (outcome, wrong) in zip(
            runs, pool.map(judge, *zip(*runs, strict=True)), strict=True
        ):
            failed += bool(wrong)
            print(
                f"{policy:12s} {name:45s} {outcome.fault or 'runs':13s} "
                f"{outcome.braking_after:5.2f} s step {outcome.step:4.2f} "
                f"box {1e3 * outcome.outside:5.0f} {1e3 * outcome.arm_outside:5.0f} mm  "
                f"{wrong and 'WRONG: ' + wrong}",
                flush=True,
            )
    print(f"{len(runs) - failed} of {len(runs)} runs pass")
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
