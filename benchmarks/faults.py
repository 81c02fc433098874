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
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.errors import UserError
from bounce_mjx.rehearsal import faults as inject
from bounce_mjx.rehearsal.arm import SimulatedArm
from bounce_mjx.rehearsal.faults import Act, Moment
from bounce_mjx.rehearsal.operator import SimulatedOperator
from bounce_mjx.resources import POLICIES, resource_path
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.world.config import WorldConfig

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
SHOWN = 0.03
"""Distance of a joint from its command at which it lacks torque, rad; in play it lags by less."""
OVERSHOOT = 0.02
"""What the arm may be off the box, m."""


REAL = {
    "camera_rate": 120.0,
    "ball_latency": 0.01,
    "ball_position_noise": 0.001,
    "ball_velocity_noise": 0.1,
    "joint_angle_noise": 1e-4,
    "joint_velocity_noise": 0.01,
}
"""The world of the camera and the encoders (`env.randomization` has the units)."""
PERFECT: dict[str, float] = {}
"""For the policies that were trained without errors of the sensors."""


@functools.cache
def _config(name: str) -> WorldConfig:
    return load_run_config(resource_path(POLICIES[name])).env


def simulated_arm(name: str, seed: int = 0) -> SimulatedArm:
    """The arm of a policy, with a camera and encoders that are as good as in its training."""
    config = _config(name)
    world = REAL if config.randomization.ball_latency else PERFECT
    return SimulatedArm(config, world, seed, rate=RATE)


class Fault(NamedTuple):
    """A fault, and what the supervisor does."""

    act: Act
    """In each control step in which it is there, before the measurement is given."""
    codes: tuple[str, ...] = ()
    """Faults of the supervisor, one of which is expected; an empty one: it may also go on. None if
    nothing stops."""
    within: float = 0.3
    """Time to the start of the braking, s."""
    by_torque: bool = False
    """Whether it shows only once a joint needs torque, and is off its command: the time counts from
    then on. One that is not asked to move needs none, nor does an arm that swings downward until it
    is to brake."""
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
    least_way: float = 0.0
    """Way of a joint in 0.1 s that shows it, rad; without one, nothing has to stop."""


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
ALIKE = 0.2
"""Difference of two joints at home, rad, that the room for a start hides."""
VELOCITY_WAY = 0.02
"""Way of a joint in 0.1 s, rad, that tells its velocity from another one, by the noise: on a slower
arm, such as that of `balance`, a wrong velocity is within it."""
WAITS = ("waits", "joint_range")
"""Codes for an arm that is not known to rest where it is measured: nothing is sent."""


def faults(joints: int, policy: str = "robust") -> dict[str, Fault]:
    """The faults of an arm with a number of joints under a policy, by name."""
    metadata = load_policy(policy).metadata
    home = metadata.default_joint_angles
    # Joints that look alike at home are told apart when they move.
    alike = ARM if abs(home[1] - home[2]) < ALIKE else ()
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
        found[f"{name}: servo without torque"] = Fault(inject.dead(joint), ARM, 0.5, by_torque=True)
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
        "joint 2 and 3 swapped from the start": Fault(
            inject.swapped(1, 2), (*WAITS, *alike), from_start=True
        ),
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
        "joint velocities: zero": Fault(
            _velocities(lambda v: 0.0 * v), SPEED, 0.5, least_way=VELOCITY_WAY
        ),
        "joint velocities: reversed": Fault(
            _velocities(lambda v: -v), SPEED, 0.5, least_way=VELOCITY_WAY
        ),
        "joint velocities: permuted": Fault(
            _velocities(lambda v: np.roll(v, 1)), SPEED, 0.5, least_way=VELOCITY_WAY
        ),
        "joint velocities: rpm": Fault(
            _velocities(lambda v: 9.55 * v), SPEED, 0.5, least_way=VELOCITY_WAY
        ),
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
        "torque of 3 N m": Fault(inject.weak(3.0), ARM, by_torque=True, falls=True),
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
    if metadata.ball_rests:
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
    off_after: float = math.inf
    """From the fault to the first joint that is `SHOWN` off its command, s."""
    way: float = math.inf
    """Largest one of a joint in 0.1 s while the fault was there, rad."""

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
        if not self.fault and self.way < fault.least_way:
            return ""
        if self.fault not in fault.codes:
            return f"{self.fault or 'nothing'} in place of {', '.join(fault.codes)}: {self.reason}"
        shown_after = min(self.off_after, self.braking_after) if fault.by_torque else 0.0
        latest = shown_after + fault.within
        if self.fault and not fault.from_start and not 0.0 <= self.braking_after <= latest:
            return f"braking begins after {self.braking_after:.2f} s"
        return ""


def run(name: str, fault: Fault, seed: int = 0) -> Outcome:
    """One run of a policy with a fault."""
    robot = simulated_arm(name, seed)
    operator = SimulatedOperator(robot)
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
    angles: list[np.ndarray] = []
    """Of the arm in the control steps with the fault."""
    started: float | None = None
    first_measured: dict[str, Any] = {}
    fault_steps = 0
    code = reason = ""
    braking_after = math.nan
    off_after = math.inf
    first_distance = 0.0
    commands = np.zeros((0, len(robot.home)))
    while robot.data.time < (started or 1.0) + SECONDS:
        measured = robot.read() | wished
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
        state = arm.state
        if operator.has_word(state) and state == "ready" and "ball_position" in measured:
            arm.start()
            started = robot.data.time
        sent = commands
        if not len(sent):
            sent = np.tile(robot.command, (policy.commands_per_step(RATE), 1))
        if is_there and fault.sent is not None:
            sent = fault.sent(moment, sent)
        robot.send(sent)
        if is_there:
            angles.append(robot.angles)
            if np.max(np.abs(robot.angles - robot.command)) > SHOWN:
                off_after = min(off_after, fault_time)
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
        off_after=off_after,
        way=_way(np.array(angles), round(0.1 / metadata.control_dt)),
    )


def _way(angles: np.ndarray, steps: int) -> float:
    """The largest way of a joint by its angles [N, J] in a number of control steps, rad."""
    if len(angles) <= steps:
        return math.inf
    return float(np.max(np.abs(angles[steps:] - angles[:-steps])))


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
