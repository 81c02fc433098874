"""What must hold while an arm follows a policy: one table, for a control step or for recorded
ones."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from bounce_mjx.deploy.metadata import Metadata

STUCK_SHARE = 0.25
"""Share of `action_scale` by which an arm must have been asked to move, to be stuck if it rests."""
# Time for which it rests at least, and for which the latest commands have arrived by then, s.
_STUCK_SECONDS, _ASKED_SECONDS = 0.3, 0.25
# Range of an angle at rest without noise, rad.
_STILL = 1e-3
# What a resting joint may be off its command beside the encoder's bias: its load, rad.
_SAG = 0.01
# Time by which an arm may be later than in the training's worlds, s.
_LATER = 0.05
# Largest noise, in standard deviations.
_LARGEST_NOISE = 8.0
# Of a joint, for a policy without limits: the training ends an episode there, rad/s.
FASTEST = 6.283
# A ball so far below the paddle, or beside it without coming nearer, is lost; one so far above it
# flies, m.
_BELOW, _BESIDE, FLYING = 0.1, 0.9, 0.05
# Pictures in which the noise is smaller than the motion of a ball that comes nearer.
EARLIER = 5
# Difference of two clocks, s.
_SYNCHRONOUS = 1e-3


class Rest(NamedTuple):
    """When a joint rests, and which commands explain that."""

    window: int
    """Control steps that a stuck joint rests."""
    still: float
    """Range of a resting angle, rad."""
    offset: float
    """Distance of a resting joint from its command, rad."""
    weights: np.ndarray
    """Mean command that moves the slowest arm until each of the window's first steps, as weights
    of those steps [K, K]."""
    room: np.ndarray
    """Distance of this mean from the angle by which no arm moves visibly [K], rad."""


def largest_term(metadata: Metadata, term: str, default: float = 0.0, end: int = 1) -> float:
    """Largest absolute value of a randomisation term over axes and joints; with the end 0, its
    least one."""
    found = [r for name, r in metadata.randomization.items() if name.split("[")[0] == term]
    values = [max(map(abs, r)) if end else r[0] for r in found]
    return (max if end else min)(values, default=default)


def picture_age(metadata: Metadata) -> float:
    """Age beyond which a picture is too old: the training's largest latency and five of its longest
    intervals, s."""
    rate = largest_term(metadata, "camera_rate", 1.0 / metadata.control_dt, end=0)
    return min(max(largest_term(metadata, "ball_latency") + 5.0 / rate, 0.1), 1.0)


def make_bounds(metadata: Metadata, age: float, steps_late: float, box: Any) -> dict[str, Any]:
    """The bounds of a policy's worlds, with the settings of a supervisor (`box` [2, 3], m), by the
    first fact of the rule that each is for."""
    limits, dt, ball = metadata.limits, metadata.control_dt, metadata.ball
    noise = 1.5 * _LARGEST_NOISE * largest_term(metadata, "ball_position_noise")
    return {
        "elapsed": steps_late * dt,
        "idle": steps_late,
        "age": age,
        "ball": ball.distance,
        "paddle": (_BELOW, _BESIDE),
        "ball_velocity": ball.speed,
        "ball_motion": ball.speed + noise / dt,
        "velocities": FASTEST if limits is None else 1.2 * np.array(limits.velocity),
        "angles": _rest(metadata),
        "target": box,
    }


def _rest(metadata: Metadata) -> Rest:
    """What the slowest arm of the training's worlds would have done; any faster arm moves more."""
    still = _STILL + 0.8 * _LARGEST_NOISE * largest_term(metadata, "joint_angle_noise")
    visible = max(STUCK_SHARE * metadata.action_scale, 0.6 * still)
    dt = metadata.control_dt
    slow = largest_term(metadata, "servo_damping", 1.0) / largest_term(
        metadata, "servo_gain", 1.0, end=0
    )
    lag = slow * np.max(np.divide(metadata.servo_damping, metadata.servo_stiffness))
    kept = math.exp(-dt / (lag + largest_term(metadata, "servo_lag") + 1e-6))
    late = math.ceil((largest_term(metadata, "action_latency") + _LATER) / dt - 1e-6)
    steps = max(round(_STUCK_SECONDS / dt) - late, math.ceil(_ASKED_SECONDS / dt))
    since = np.arange(steps)[:, None] - np.arange(steps)
    pull = np.tril((1.0 - kept) * kept ** np.abs(since))
    settled = np.sum(pull, axis=1)
    offset = _SAG + largest_term(metadata, "encoder_bias")
    return Rest(steps + late, still, offset, pull / settled[:, None], visible / settled)


def _above(bound: float, number: Any) -> tuple[Any, Any]:
    return number > bound, number


def _long(bound: float, vectors: Any) -> tuple[Any, Any]:
    return _above(bound, np.max(np.linalg.norm(vectors, axis=-1), axis=-1))


def _fast(bound: Any, velocities: Any) -> tuple[Any, Any]:
    return np.any(np.abs(velocities) > bound, axis=-1), np.max(np.abs(velocities), axis=-1)


def _picture(bound: float, age: Any) -> tuple[Any, Any]:
    return (age > bound) | (age < -_SYNCHRONOUS), 1e3 * age


def _lost(bounds: Any, paddle: Any, ball: Any, earlier_ball: Any) -> tuple[Any, Any]:
    paddle = paddle[..., None, :]
    below = paddle[..., 2] - ball[..., 2]
    beside, before = (np.linalg.norm((b - paddle)[..., :2], axis=-1) for b in (ball, earlier_ball))
    is_lost = (below > bounds[0]) | ((beside > bounds[1]) & (beside >= before))
    return np.any(is_lost, axis=-1), np.max(np.maximum(below, beside), axis=-1)


def _stuck(rest: Rest, angles: Any, commands: Any) -> tuple[Any, Any]:
    """Whether a joint rests that no arm of the training would have rested, whatever its offset."""
    # Later commands have not reached the latest arm.
    arrived = commands[..., 1 : len(rest.room) + 1, :] - np.mean(angles, axis=-2, keepdims=True)
    lead = np.swapaxes(arrived, -1, -2)
    mean = lead @ rest.weights.T
    least, most = np.max(mean - rest.room, axis=-1), np.min(mean + rest.room, axis=-1)
    is_explained = np.maximum(least, -rest.offset) <= np.minimum(most, rest.offset)
    is_stuck = (np.ptp(angles, axis=-2) < rest.still) & ~is_explained
    largest_lead = np.max(np.abs(lead), axis=-1)
    return np.any(is_stuck, axis=-1), np.max(np.where(is_stuck, largest_lead, 0.0), axis=-1)


def _outside(box: Any, target: Any) -> tuple[Any, Any]:
    return _above(0.0, np.max(np.maximum(box[0] - target, target - box[1]), axis=-1))


class Rule(NamedTuple):
    """A row of the table."""

    fault: str
    """Code of the fault."""
    needs: str
    """Names of the facts that it judges."""
    check: Callable[..., tuple[Any, Any]]
    """Bound and facts -> whether it is broken, and a number for the reason."""
    reason: str


RULES = (
    Rule("late_step", "elapsed", _above, "a control step came after {:.3g} s"),
    Rule("no_step", "idle", _above, "{} calls in a row are no new step"),
    Rule("old_picture", "age", _picture, "the picture of the ball is {:.0f} ms old"),
    Rule("ball_place", "ball", _long, "the ball is {:.3g} m from the base"),
    Rule("ball_lost", "paddle ball earlier_ball", _lost, "the ball is lost"),
    Rule("ball_speed", "ball_velocity", _long, "the ball has {:.3g} m/s"),
    Rule("ball_speed", "ball_motion", _long, "the ball has {:.3g} m/s"),
    Rule("joint_speed", "velocities", _fast, "a joint has {:.3g} rad/s"),
    Rule("joint_stuck", "angles commands", _stuck, "a joint is stuck {:.3g} rad from its command"),
    Rule("box", "target", _outside, "the paddle's command is {:.3g} m outside the box"),
)
"""What must hold: of the measurements, of the arm's following, and of the command. The facts, for
any batch [...]:

- `elapsed` [...]: time since the last control step, s; `idle` [...]: calls without a step;
- `age` [...] of the ball's picture, s; `ball` and `ball_velocity` [..., B, 3] in it, m and m/s;
  `ball_motion` [..., B, 3] between the last two pictures, m/s; `earlier_ball` [..., B, 3] in the
  picture `EARLIER` before, NaN for none;
- `angles` and `commands` [..., window + 1, J] of the last control steps, rad: a command is that at
  the end of the step before its angle; `velocities` [..., J], rad/s; `paddle` [..., 3], m;
- `target` [..., 3]: where the next command brings the paddle, m.
"""


def faults(bounds: dict[str, Any], facts: dict[str, Any]) -> list[tuple[Rule, Any, Any]]:
    """The rules that the facts decide, each with whether it is broken and its number [...]."""
    rules = [(rule, rule.needs.split()) for rule in RULES]
    return [
        (rule, *rule.check(bounds[needs[0]], *map(facts.get, needs)))
        for rule, needs in rules
        if facts.keys() >= set(needs)
    ]
