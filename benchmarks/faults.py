"""Faults of a robot, put one at a time into MuJoCo's C engine under a supervised policy.

    python benchmarks/faults.py                        # every fault for every policy
    python benchmarks/faults.py robust --faults joint  # those with a word in their name

The robot has late and noisy pictures, and noisy encoders. In each run the arm goes home, the policy
plays, and the fault comes after 1.5 s. A run passes if

- no command is farther from the last one than `Metadata.largest_step`, and the first one is where
  the arm is;
- the braking begins in time, for the reason that was expected, or a sample is bridged and nothing
  stops;
- neither the commands nor the arm leave the box around the paddle's home.
"""

import argparse
import concurrent.futures
import copy
import functools
import math
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.errors import UserError
from bounce_mjx.resources import POLICIES, resource_path
from bounce_mjx.robot.model import BALLS_APART, find_addresses
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.world.model import world_model

RATE = 500.0
"""Of the commands, Hz."""
FAULT_AT, SECONDS = 1.5, 4.0
"""Times of the fault and of a run after the start of the episode, s."""
BOX = 0.5
"""Half of the box around the paddle's home, m."""
FIRST_COMMAND, OVERSHOOT = 0.02, 0.02
"""What the first command may be off the arm (rad), and the arm off the box (m)."""
COUNT = 2.0 * math.pi / 4096.0
"""A coarse encoder's count, rad."""
DRY_FRICTION = 5e-4
"""Angle between a servo's target and its joint that dry friction holds, rad."""


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
    command = {key: jnp.array(0.5 * (x.low + x.high)) for key, x in env.commands.items()}
    thrown = task.throw(jnp.full(task.num_draws, 0.5), command)
    if thrown is not None:
        return tuple(np.asarray(x, float).reshape(-1, 3) for x in thrown)
    above = BALLS_APART * np.arange(env.num_balls)[:, None] * [0.0, 0.0, 1.0]
    return np.array(env.ball_init_pos) + above, np.zeros((env.num_balls, 3))


class Robot:
    """An arm with a paddle, balls and a camera in the C engine; somebody holds the balls until the
    episode starts."""

    def __init__(self, name: str, seed: int = 0):
        shared, self.env = _model(name)
        self.name = name
        self.model, self.delay = copy.copy(shared), 0.0
        self.sensors = REAL if self.env.randomization.ball_latency else PERFECT
        self.data, self.random = mujoco.MjData(self.model), np.random.default_rng(seed)
        addresses = find_addresses(self.model)
        self.qpos, self.qvel = list(addresses.arm_qpos), list(addresses.arm_qvel)
        self.servos, self.paddle_geom = list(addresses.actuators), addresses.paddle_geom
        self.balls = addresses.balls
        self.home = np.array(self.env.default_joint_angles)
        self.data.qpos[self.qpos] = self.home
        self.is_held, self.is_dead = True, np.zeros(len(self.home), bool)
        self.sent: deque[tuple[float, np.ndarray]] = deque()
        self.command = self.home.copy()
        self.pictures: deque[tuple[float, np.ndarray]] = deque()
        self.newest = self.before = None
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

    def measure(self) -> dict[str, Any]:
        """What the robot's program knows."""
        count, time = len(self.home), self.data.time
        while self.pictures and self.pictures[0][0] <= time - self.sensors.delay + 1e-9:
            self.before, self.newest = self.newest, self.pictures.popleft()
        angle_noise, velocity_noise = self.random.standard_normal((2, count))
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
            self.sent.append((self.data.time + self.delay, np.array(command)))
            for _ in range(round(1.0 / (RATE * self.model.opt.timestep))):
                while self.sent and self.sent[0][0] <= self.data.time + 1e-9:
                    self.command = self.sent.popleft()[1]
                self.data.ctrl[self.servos] = np.where(self.is_dead, self.angles, self.command)
                if self.is_held:
                    self.hold()
                mujoco.mj_step(self.model, self.data)
                self._look()

    def _look(self) -> None:
        last = self.pictures[-1][0] if self.pictures else (self.newest or (-1.0,))[0]
        if self.data.time - last > 1.0 / self.sensors.rate - 1e-9:
            places = np.array([self.data.qpos[list(ball.qpos[:3])] for ball in self.balls])
            noise = self.sensors.noise * self.random.standard_normal(places.shape)
            self.pictures.append((self.data.time, np.squeeze(places + noise)))


class Moment(NamedTuple):
    """A control step in which a fault may act."""

    robot: Robot
    measured: dict[str, Any]
    """May be changed."""
    time: float
    """Since the fault came, s; negative before it."""
    memory: dict[str, Any]


Act = Callable[[Moment], Any]


class Fault(NamedTuple):
    """A fault, and what the supervisor does."""

    act: Act
    """In each control step before the measurement is given; "skip" if the program is not called."""
    codes: tuple[str, ...] = ()
    """Faults of the supervisor, one of which is expected; none if nothing stops."""
    within: float = 0.3
    """Time to the start of the braking, s."""
    from_start: bool = False
    """Whether it is there from the first sample."""
    sent: Callable[[Moment, np.ndarray], np.ndarray] | None = None
    """What the robot gets in place of the commands."""
    falls: bool = False
    """Whether no command can keep the arm in the box."""


def _later(change: Act, until: float = math.inf) -> Act:
    """A change of the moments from the fault on, for a time (s)."""
    return lambda moment: change(moment) if 0.0 <= moment.time < until - 1e-6 else None


def _put(name: str, value: Callable[[Moment], Any]) -> Act:
    return lambda moment: moment.measured.__setitem__(name, value(moment))


def _angle(joint: int, change: Callable[[Moment, float], float]) -> Act:
    def act(moment: Moment) -> None:
        angles = moment.measured["joint_angles"]
        angles[joint] = change(moment, angles[joint])

    return act


def _first_sample(joint: int, off: float) -> Act:
    """The first sample is off by an angle (rad)."""
    return _angle(joint, lambda moment, x: x + off * (moment.robot.data.time < 0.005))


def _both(*joints: int, flip: bool = False) -> Act:
    """Two joints swapped, or one with another sign."""

    def act(moment: Moment) -> None:
        for name in ("joint_angles", "joint_velocities"):
            values, own = moment.measured[name], list(joints)
            values[own] = -values[own] if flip else values[own[::-1]]

    return act


def _dead(joint: int) -> Act:
    return lambda moment: moment.robot.is_dead.__setitem__(joint, True)


def _weak(torque: float) -> Act:
    def act(moment: Moment) -> None:
        model, servos = moment.robot.model, moment.robot.servos
        model.actuator_forcelimited[servos] = 1
        gears = model.actuator_gear[servos, :1]
        model.actuator_forcerange[servos] = np.array([-torque, torque]) / gears

    return act


def _coarse(moment: Moment) -> None:
    moment.measured["joint_angles"] = COUNT * np.round(moment.measured["joint_angles"] / COUNT)


def _dry_friction(moment: Moment) -> None:
    model, servos = moment.robot.model, moment.robot.servos
    stiffness = model.actuator_gainprm[servos, 0] * model.actuator_gear[servos, 0] ** 2
    model.dof_frictionloss[moment.robot.qvel] = DRY_FRICTION * stiffness
    _coarse(moment)


def _ball(change: Callable[[Moment, np.ndarray], Any]) -> Act:
    return _put("ball_position", lambda moment: change(moment, moment.measured["ball_position"]))


def _throw(speed: float) -> Act:
    def act(moment: Moment) -> None:
        if moment.memory.setdefault("thrown", moment.time) == moment.time:
            for ball in moment.robot.balls:
                moment.robot.data.qvel[list(ball.qvel[:3])] = (0.0, speed, speed)

    return act


def _frozen(*names: str) -> Act:
    def act(moment: Moment) -> None:
        values = {name: moment.measured[name] for name in names}
        moment.measured.update(moment.memory.setdefault("frozen", values))

    return act


def _no_pictures(moment: Moment) -> None:
    names = ("ball_position", "ball_velocity", "ball_age")
    last = moment.memory.setdefault("last", {name: moment.measured[name] for name in names})
    moment.measured.update(last | {"ball_age": last["ball_age"] + moment.time})


def _held(seconds: float) -> Callable[[Moment, np.ndarray], np.ndarray]:
    """The robot rests at the first command for a time."""

    def sent(moment: Moment, commands: np.ndarray) -> np.ndarray:
        if not 0.0 <= moment.time < seconds:
            return commands
        return np.tile(moment.memory.setdefault("held", commands[0]), (len(commands), 1))

    return sent


def _nothing(moment: Moment) -> None:
    pass


ARM = ("joint_astray",)
JUMP = ("joint_jump", "joint_range")
"""Codes for an arm that does not follow, and for angles that cannot be."""


def faults(joints: int) -> dict[str, Fault]:
    """The faults of an arm with a number of joints, by name."""
    last, found = joints - 1, {"nothing": Fault(_nothing)}
    for joint in (0, 1, 2, last):
        for size in (0.3, 1.0, -3.0):
            spike = _later(_angle(joint, lambda m, x, size=size: x + size), 0.01)
            found[f"joint {joint + 1}: one sample off by {size} rad"] = Fault(spike)
        wrong = _later(_angle(joint, lambda m, x: x + 0.5))
        found[f"joint {joint + 1}: encoder jumps by 0.5 rad"] = Fault(wrong, JUMP)
        drift = _later(_angle(joint, lambda m, x: x + 0.5 * m.time))
        found[f"joint {joint + 1}: encoder drifts by 0.5 rad/s"] = Fault(drift, (*ARM, "box"))
        found[f"joint {joint + 1}: encoder is frozen"] = Fault(
            _later(_angle(joint, lambda m, x: m.memory.setdefault("angle", x))), ARM, 0.5
        )
        found[f"joint {joint + 1}: servo without torque"] = Fault(_later(_dead(joint)), ARM, 0.5)
    for joint in (1, 2):
        sign = Fault(_later(_both(joint, flip=True)), JUMP)
        found[f"joint {joint + 1}: sign flips"] = sign
    zeros = _put("joint_angles", lambda m: 0.0 * m.measured["joint_angles"])
    found |= {
        "all joints: encoders of 4,096 counts": Fault(_coarse, from_start=True),
        "all joints: dry friction, 4,096 counts": Fault(
            _dry_friction, ("", "ball_lost", "box"), math.inf, from_start=True
        ),
        "joint 1 and 2 swapped": Fault(_later(_both(0, 1)), (*JUMP, *ARM)),
        "joint 2 and 3 swapped": Fault(_later(_both(1, 2)), (*JUMP, *ARM)),
        "joint 2 and 3 swapped from the start": Fault(
            _both(1, 2), ("joint_order", "first_sample", *JUMP, *ARM), from_start=True
        ),
        "joint 2 with another sign from the start": Fault(
            _both(1, flip=True), ("joint_order", "first_sample", *JUMP, *ARM), from_start=True
        ),
        "all joints: degrees": Fault(
            _later(_put("joint_angles", lambda m: np.degrees(m.measured["joint_angles"]))), JUMP
        ),
        "all joints: one sample of zeros": Fault(_later(zeros, 0.01)),
        "all joints: zeros": Fault(_later(zeros), JUMP),
        "all joints: first samples are zeros": Fault(
            lambda m: zeros(m) if m.robot.data.time < 0.1 else None, from_start=True
        ),
        "joint 1: first sample is off by 0.5 rad": Fault(_first_sample(0, 0.5), from_start=True),
        "joint 2: first sample is off by 0.25 rad": Fault(_first_sample(1, 0.25), from_start=True),
        "joint 2: first sample is off by 1 rad": Fault(_first_sample(1, 1.0), from_start=True),
        "all joints: frozen": Fault(_later(_frozen("joint_angles")), ARM),
        "all joints: wrapped by a turn": Fault(
            _later(_put("joint_angles", lambda m: m.measured["joint_angles"] + 2.0 * math.pi)),
            JUMP,
        ),
        "all joints: NaN": Fault(
            _later(_put("joint_angles", lambda m: np.nan * m.measured["joint_angles"])),
            ("measurement",),
        ),
        "all joints: complex": Fault(
            _later(_put("joint_angles", lambda m: m.measured["joint_angles"] + 1j)),
            ("measurement",),
        ),
        "all joints: missing": Fault(
            _later(lambda m: m.measured.pop("joint_angles")), ("measurement",)
        ),
        "torque of 3 N m": Fault(_later(_weak(3.0)), ARM, falls=True),
        "the arm ignores its commands": Fault(_nothing, ARM, sent=_held(9.0)),
        "commands 0.5 s late": Fault(
            _later(lambda m: setattr(m.robot, "delay", 0.5)), (*ARM, "ball_lost", "box"), 0.5
        ),
        "time stands": Fault(_later(_put("time", lambda m: FAULT_AT)), ("no_step", "time")),
        "time 0.5 s back": Fault(
            _later(_put("time", lambda m: m.measured["time"] - 0.5)), ("time",)
        ),
        "time 0.5 s back in one sample": Fault(
            _later(_put("time", lambda m: m.measured["time"] - 0.5), 0.01)
        ),
        "time 0.5 s ahead": Fault(
            _later(_put("time", lambda m: m.measured["time"] + 0.5)), ("late_step",)
        ),
        "time 50 s ahead": Fault(
            _later(_put("time", lambda m: m.measured["time"] + 50.0)), ("late_step",)
        ),
        "time in ms from the start": Fault(
            _put("time", lambda m: 1e3 * m.measured["time"]),
            ("measurement", "late_step"),
            from_start=True,
        ),
        "time in float32 from the start": Fault(
            _put("time", lambda m: np.float32(1.7e9 + m.measured["time"])),
            ("measurement",),
            from_start=True,
        ),
        "time jitters by 4 ms": Fault(
            _put("time", lambda m: m.measured["time"] + m.robot.random.uniform(-0.004, 0.004)),
            from_start=True,
        ),
        "the program pauses for 20 ms": Fault(
            lambda m: "skip" if 0.0 <= m.time < 0.019 else None,
        ),
        "the program pauses for 0.2 s": Fault(
            lambda m: "skip" if 0.0 <= m.time < 0.199 else None, ("late_step",)
        ),
        "ball: the camera stops": Fault(_later(_no_pictures), ("old_picture",)),
        "ball: in mm": Fault(
            _later(_ball(lambda m, x: 1e3 * x)), ("ball_place", "ball_speed"), within=0.3
        ),
        "ball: one false picture": Fault(
            _later(_ball(lambda m, x: x + [0.0, 0.6, 0.0]), 0.008),
        ),
        "ball: 0.9 m aside": Fault(
            _later(_ball(lambda m, x: x + [0.0, 0.9, 0.0])), ("ball_speed",)
        ),
        "ball: mirrored": Fault(
            _later(_ball(lambda m, x: x * [-1.0, -1.0, 1.0])), ("ball_speed", "ball_lost")
        ),
        "ball: hidden": Fault(
            _later(_ball(lambda m, x: np.ma.array(x, mask=True))), ("measurement",)
        ),
        "ball: thrown away": Fault(
            _later(_throw(3.0)), ("ball_lost", "box", "ball_place", "old_picture"), 1.5
        ),
        "velocities in deg/s": Fault(
            _later(
                _put("joint_velocities", lambda m: np.degrees(9.0 + m.measured["joint_velocities"]))
            ),
            ("joint_speed",),
        ),
    }
    return found


class Outcome(NamedTuple):
    """What happened in a run."""

    fault: str
    """Code of the supervisor's fault; empty if nothing stopped."""
    reason: str
    delay: float
    """From the fault to the start of the braking, s."""
    step: float
    """Largest step of the commands as a share of the largest one that is allowed."""
    first: float
    """Distance of the first command from the arm, rad."""
    outside: float
    """Of the commands from the box, m; negative inside."""
    arm_outside: float
    """Of the arm from the box, m."""

    def wrong(self, fault: Fault) -> str:
        """What is wrong with the outcome of a fault; empty if nothing is."""
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
        if self.fault and not fault.from_start and self.delay > fault.within:
            return f"braking begins after {self.delay:.2f} s"
        return ""


def run(name: str, fault: Fault, seed: int = 0) -> Outcome:
    """One run of a policy with a fault."""
    robot, policy = Robot(name, seed), load_policy(name)
    metadata = policy.metadata
    home = paddle_position(metadata, robot.home)
    box = home - BOX, home + BOX
    arm = policy.supervise(RATE, box=box)
    wished = {key: float(np.mean(command.range)) for key, command in metadata.commands.items()}
    memory, sent, paddles, places = {}, [], [], []
    started, code, reason, delay, first = None, "", "", math.nan, 0.0
    commands = np.zeros((0, len(robot.home)))
    while robot.data.time < (started or 1.0) + SECONDS:
        time = robot.data.time - FAULT_AT - (math.inf if started is None else started)
        moment = Moment(robot, robot.measure() | wished, time, memory)
        acted = fault.act(moment)
        skipped = isinstance(acted, str) and acted == "skip"
        given = {key: x for key, x in moment.measured.items() if key in policy.units}
        if skipped:
            commands = commands[-1:].repeat(len(commands), axis=0)
        else:
            try:
                commands = arm.commands(given)
            except UserError as error:
                code, reason = getattr(error, "fault", "measurement"), str(error)
                break
        if arm.state in ("braking", "stopped") and not code:
            code, reason, delay = arm.fault, arm.reason, time
        if len(commands):
            if not sent:
                first = float(np.max(np.abs(commands - robot.angles)))
            sent.append(commands[-1])
            places.extend(commands)
        if arm.state == "ready" and robot.newest is not None:
            arm.start()
            started = robot.data.time
            robot.release()
        idle = commands if len(commands) else robot.command[None].repeat(5, axis=0)
        robot.step(idle if fault.sent is None else fault.sent(moment, idle))
        if started is not None:
            paddles.append(robot.paddle)
        if arm.state == "stopped" and time > 1.0:
            break

    def outside(points: np.ndarray) -> float:
        return float(np.max(np.abs(points - home))) - BOX if len(points) else -BOX

    steps = np.abs(np.diff(sent, axis=0)) / metadata.largest_step if len(sent) > 1 else [[0.0]]
    return Outcome(
        code,
        reason,
        delay,
        float(np.max(steps)),
        first,
        outside(paddle_position(metadata, np.array(places))) if places else -BOX,
        outside(np.array(paddles)),
    )


def cases(policies: list[str], words: list[str]) -> Iterator[tuple[str, str]]:
    """The runs of policies: names of the policy and of the fault."""
    for policy in policies:
        metadata = load_policy(policy).metadata
        for name in faults(len(metadata.joint_names)):
            if not words or any(word in name for word in words):
                yield policy, name


def judge(policy: str, name: str) -> tuple[Outcome, str]:
    """The outcome of a run by the names of the policy and the fault, and what is wrong with it."""
    fault = faults(len(load_policy(policy).metadata.joint_names))[name]
    outcome = run(policy, fault)
    return outcome, outcome.wrong(fault)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("policies", nargs="*", default=list(POLICIES), help="names")
    parser.add_argument("--faults", nargs="*", default=[], help="words in the faults' names")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    given = parser.parse_args()
    runs = list(cases(given.policies, given.faults))
    failed = 0
    with concurrent.futures.ProcessPoolExecutor(given.jobs) as pool:
        for (policy, name), (outcome, wrong) in zip(
            runs, pool.map(judge, *zip(*runs, strict=True)), strict=True
        ):
            failed += bool(wrong)
            print(
                f"{policy:12s} {name:45s} {outcome.fault or 'runs':13s} {outcome.delay:5.2f} s "
                f"step {outcome.step:4.2f} box {1e3 * outcome.outside:5.0f} "
                f"{1e3 * outcome.arm_outside:5.0f} mm  {wrong and 'WRONG: ' + wrong}",
                flush=True,
            )
    print(f"{len(runs) - failed} of {len(runs)} runs pass")


if __name__ == "__main__":
    main()
