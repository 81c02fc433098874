"""Faults of an arm, its encoders, its camera and its program, to put into a simulated arm."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bounce_mjx.errors import UserError, suggest

if TYPE_CHECKING:
    from bounce_mjx.rehearsal.arm import SimulatedArm

COUNT = 2.0 * math.pi / 4096.0
"""A coarse encoder's count, rad."""
DRY_FRICTION = 5e-4
"""Angle between a servo's target and its joint that dry friction holds, rad."""


class Moment(NamedTuple):
    """A control step in which a fault is there."""

    arm: "SimulatedArm"
    """Or another one with the attributes that a fault uses."""
    measured: dict[str, Any]
    """May be changed."""
    first: dict[str, Any]
    """Measured when the fault came."""
    time: float
    """Since the fault came, s."""


Act = Callable[[Moment], Any]
"""What a fault does in each control step in which it is there, before the measurement is given."""


class Injection(NamedTuple):
    """A fault that comes in the first episode."""

    act: Act
    after: float
    """Time from the start of the episode, s."""


def put(name: str, value: Callable[[Moment], Any]) -> Act:
    """Another value of a measurement."""

    def act(moment: Moment) -> None:
        moment.measured[name] = value(moment)

    return act


def _angle(joint: int, change: Callable[[Moment, float], float]) -> Act:
    def act(moment: Moment) -> None:
        angles = moment.measured["joint_angles"]
        angles[joint] = change(moment, angles[joint])

    return act


def off(joint: int, distance: float) -> Act:
    """A joint measured at a distance (rad)."""
    return _angle(joint, lambda moment, angle: angle + distance)


def drift(joint: int, speed: float) -> Act:
    """An encoder that goes away (rad/s)."""
    return _angle(joint, lambda moment, angle: angle + speed * moment.time)


def frozen_encoder(joint: int) -> Act:
    """An encoder whose reading repeats."""
    return _angle(joint, lambda moment, angle: moment.first["joint_angles"][joint])


def swapped(first: int, second: int) -> Act:
    """Two joints measured in each other's place."""

    def act(moment: Moment) -> None:
        for name in ("joint_angles", "joint_velocities"):
            values = moment.measured[name]
            values[[first, second]] = values[[second, first]]

    return act


def flipped(joint: int) -> Act:
    """A joint measured with another sign."""

    def act(moment: Moment) -> None:
        for name in ("joint_angles", "joint_velocities"):
            moment.measured[name][joint] *= -1.0

    return act


def dead(joint: int) -> Act:
    """A servo without torque."""

    def act(moment: Moment) -> None:
        moment.arm.is_dead[joint] = True

    return act


def stuck(joint: int) -> Act:
    """A joint that something holds."""

    def act(moment: Moment) -> None:
        moment.arm.stuck.setdefault(joint, float(moment.arm.angles[joint]))

    return act


def weak(torque: float) -> Act:
    """Servos with this much torque (N m) at most."""

    def act(moment: Moment) -> None:
        model, servos = moment.arm.model, moment.arm.servos
        model.actuator_forcelimited[servos] = 1
        gears = model.actuator_gear[servos, :1]
        model.actuator_forcerange[servos] = np.array([-torque, torque]) / gears

    return act


def late_commands(moment: Moment) -> None:
    """Commands arrive 0.5 s late."""
    moment.arm.command_delay = 0.5


def deaf(moment: Moment) -> None:
    """The arm ignores its commands."""
    moment.arm.is_deaf = True


def pause(moment: Moment) -> None:
    """The program pauses for 0.2 s once, while the last command holds."""
    if moment.time == 0.0:
        moment.arm.idle(0.2)
        moment.measured.update(moment.arm.read())


def coarse(moment: Moment) -> None:
    """Encoders of 4,096 counts a turn."""
    moment.measured["joint_angles"] = COUNT * np.round(moment.measured["joint_angles"] / COUNT)


def dry_friction(moment: Moment) -> None:
    """Joints that dry friction holds, with coarse encoders."""
    model, servos = moment.arm.model, moment.arm.servos
    stiffness = model.actuator_gainprm[servos, 0] * model.actuator_gear[servos, 0] ** 2
    model.dof_frictionloss[moment.arm.qvel] = DRY_FRICTION * stiffness
    coarse(moment)


def ball(change: Callable[[Moment, np.ndarray], Any]) -> Act:
    """A ball that is seen elsewhere."""
    return put("ball_position", lambda moment: change(moment, moment.measured["ball_position"]))


def thrown(speed: float) -> Act:
    """A ball that gets another velocity (m/s)."""

    def act(moment: Moment) -> None:
        for thrown_ball in moment.arm.balls:
            moment.arm.data.qvel[list(thrown_ball.qvel[:3])] = (0.0, speed, speed)

    return act


def knocked(moment: Moment) -> None:
    """Somebody knocks the balls away once."""
    if moment.time == 0.0:
        thrown(3.0)(moment)


def frozen(name: str) -> Act:
    """A measurement that repeats."""
    return put(name, lambda moment: moment.first[name])


def no_pictures(moment: Moment) -> None:
    """The camera stops."""
    for name in ("ball_position", "ball_velocity"):
        moment.measured[name] = moment.first[name]
    moment.measured["ball_age"] = moment.first["ball_age"] + moment.time


def held(offset: list[float], speed: float = 0.0) -> Act:
    """A hand that holds the balls at an offset (m) from where the paddle was, with the noise of
    the camera in each picture; or carries them sideways (m/s)."""
    places: dict[float, np.ndarray] = {}

    def act(moment: Moment) -> None:
        arm = moment.arm
        if moment.time == 0.0:
            places.clear()
            places[-1.0] = arm.paddle
        taken = arm.picture_time
        if taken not in places:
            place = places[-1.0] + offset + [0.0, speed * moment.time, 0.0]
            shape = moment.measured["ball_position"].shape
            places[taken] = place + arm.picture_noise * arm.random.standard_normal(shape)
        moment.measured["ball_position"] = places[taken]
        moment.measured["ball_velocity"] = 0.0 * moment.measured["ball_velocity"]

    return act


class Kind(NamedTuple):
    """A kind of fault that a user names."""

    meaning: str
    """In words."""
    act: Act | None = None
    """Of a kind without a joint."""
    of_joint: Callable[[int], Act] | None = None
    """Of a kind that a joint has, by its index."""


KINDS = {
    "stuck": Kind("the joint is held where it is", of_joint=stuck),
    "dead": Kind("the joint's servo has no torque", of_joint=dead),
    "frozen": Kind("the joint's encoder repeats its reading", of_joint=frozen_encoder),
    "jump": Kind("the joint's encoder jumps by 0.5 rad", of_joint=lambda j: off(j, 0.5)),
    "drift": Kind("the joint's encoder drifts by 0.5 rad/s", of_joint=lambda j: drift(j, 0.5)),
    "flipped": Kind("the joint is measured with another sign", of_joint=flipped),
    "weak": Kind("no servo has more than 3 N m", weak(3.0)),
    "deaf": Kind("the arm ignores its commands", deaf),
    "late": Kind("commands arrive 0.5 s late", late_commands),
    "pause": Kind("the program pauses for 0.2 s", pause),
    "clock": Kind("the driver's time stands still", frozen("time")),
    "coarse": Kind("the encoders have 4,096 counts a turn", coarse),
    "camera": Kind("the camera stops", no_pictures),
    "aside": Kind(
        "the ball is found 0.35 m aside", ball(lambda moment, place: place + [0.0, 0.35, 0.0])
    ),
    "mirrored": Kind(
        "x and y of the ball are mirrored",
        ball(lambda moment, place: place * [-1.0, -1.0, 1.0]),
    ),
    "millimetres": Kind("the ball is given in mm", ball(lambda moment, place: 1e3 * place)),
    "hand": Kind("a hand holds the ball over the paddle", held([0.0, 0.0, 0.3])),
    "knocked": Kind("the ball is knocked away", knocked),
}
"""The kinds of faults by the word for `bounce-mjx rehearse --fault`."""


def named_fault(words: str, joint_names: tuple[str, ...]) -> tuple[Act, str]:
    """A fault by its words, `camera` or `stuck:3` for the third joint (from 1, or by its name), and
    its meaning.

    Raises:
      UserError: there is no such fault, or no such joint.
    """
    name, colon, joint = words.partition(":")
    kind = KINDS.get(name)
    if kind is None:
        near = suggest(name, KINDS)
        question = f"{near} " if near else ""
        raise UserError(f"there is no fault {name}; {question}give one of {', '.join(KINDS)}")
    if kind.of_joint is None:
        if colon:
            raise UserError(f"the fault {name} is not of a joint; give {name} alone")
        return kind.act, kind.meaning
    numbers = [str(i + 1) for i in range(len(joint_names))]
    if joint not in (*joint_names, *numbers):
        raise UserError(
            f"the fault {words} needs one of the joints 1 to {len(joint_names)} "
            f"({', '.join(joint_names)}), such as {name}:2"
        )
    index = joint_names.index(joint) if joint in joint_names else int(joint) - 1
    return kind.of_joint(index), f"{joint_names[index]}: {kind.meaning}"
