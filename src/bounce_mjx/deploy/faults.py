"""What must hold while an arm follows a policy: one table, for a control step or for recorded
ones."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from bounce_mjx.deploy.metadata import Metadata

STUCK_SHARE = 0.25
"""Share of `action_scale` by which an arm must have been asked to move, to be stuck if it rests."""
# Time for which it rests, s, and the range of an angle at rest without noise, rad.
_STUCK_SECONDS, _STILL = 0.3, 1e-3
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


class Allowed(NamedTuple):
    """The bounds of the table; T and K are the steps of the windows of angles and commands."""

    elapsed: float
    """Time between two control steps, s."""
    idle: float
    """Calls in a row without a new step."""
    age: float
    """Age of a picture, s."""
    ball: tuple[float, float]
    """Distance from the base, m, and speed, m/s."""
    ball_noise: float
    """Error of the distance between two pictures, m."""
    speed: np.ndarray
    """Speed of each joint [J], rad/s."""
    box: np.ndarray
    """Lowest and highest position of the paddle [2, 3], m."""
    still: float
    """Range of a resting angle, rad."""
    asked: float
    """Motion after which an arm does not rest, rad."""
    offset: float
    """Distance of a resting joint from its command, rad."""
    pull: np.ndarray
    """Motion of each kind of arm [M, T] that rested at the start of the window, by commands in the
    window [K]: [M, T, K]."""
    settled: np.ndarray
    """Share of an offset at the start that it has lost [M, T]."""


def largest(metadata: Metadata, term: str, default: float = 0.0, end: int = 1) -> float:
    """Largest absolute value of a randomisation term over axes and joints; with the end 0, its
    least one."""
    found = [r for name, r in metadata.randomization.items() if name.split("[")[0] == term]
    values = [max(map(abs, r)) if end else r[0] for r in found]
    return (max if end else min)(values, default=default)


def picture_age(metadata: Metadata) -> float:
    """Age beyond which a picture is too old: the training's largest latency and five of its longest
    intervals, s."""
    rate = largest(metadata, "camera_rate", 1.0 / metadata.control_dt, end=0)
    return min(max(largest(metadata, "ball_latency") + 5.0 / rate, 0.1), 1.0)


def allowed(metadata: Metadata, age: float, steps_late: float, box: Any = None) -> Allowed:
    """The bounds of a policy's worlds, with the settings of a supervisor."""
    limits, dt = metadata.limits, metadata.control_dt
    still = _STILL + 0.8 * _LARGEST_NOISE * largest(metadata, "joint_angle_noise")
    count = len(metadata.joint_names)
    speed = np.full(count, FASTEST) if limits is None else 1.2 * np.array(limits.velocity)
    return Allowed(
        elapsed=steps_late * dt,
        idle=steps_late,
        age=age,
        ball=metadata.ball,
        ball_noise=1.5 * _LARGEST_NOISE * largest(metadata, "ball_position_noise"),
        speed=speed,
        box=np.array([[-np.inf], [np.inf]]) if box is None else box,
        still=still,
        asked=max(STUCK_SHARE * metadata.action_scale, 0.6 * still),
        offset=_SAG + largest(metadata, "encoder_bias"),
        **_arms(metadata),
    )


def _arms(metadata: Metadata) -> dict[str, np.ndarray]:
    """How arms of the training's worlds follow: late by each latency, with the shortest and the
    longest lag."""
    dt, terms = metadata.control_dt, np.array(metadata.servo_stiffness)
    servo = np.array(metadata.servo_damping) / terms
    slow = largest(metadata, "servo_damping", 1.0) / largest(metadata, "servo_gain", 1.0, end=0)
    lags = np.min(servo), slow * np.max(servo) + largest(metadata, "servo_lag")
    steps = max(round(_STUCK_SECONDS / dt), 1)
    latest = math.ceil((largest(metadata, "action_latency") + _LATER) / dt - 1e-6)
    times = np.unique(np.linspace(1, steps, min(steps, 30)).astype(int))
    # The command of each step in the window counts once it has arrived.
    since = times[:, None] - np.arange(1 - latest, steps + 1)
    pull, settled = [], []
    for late in np.unique(np.linspace(0, latest, min(latest, 10) + 1).astype(int)):
        for lag in lags:
            kept = math.exp(-dt / max(lag, 1e-6))
            moves = (since >= late) & (since - late < times[:, None])
            pull.append(np.where(moves, (1.0 - kept) * kept ** np.maximum(since - late, 0), 0.0))
            settled.append(1.0 - kept**times)
    return {"pull": np.array(pull), "settled": np.array(settled)}


def _largest_norm(vectors: Any) -> Any:
    return np.max(np.linalg.norm(vectors, axis=-1), axis=-1)


def _late(a: Allowed, elapsed: Any) -> tuple[Any, Any]:
    return elapsed > a.elapsed, 1e3 * elapsed


def _picture(a: Allowed, age: Any) -> tuple[Any, Any]:
    return (age > a.age) | (age < -_SYNCHRONOUS), 1e3 * age


def _place(a: Allowed, ball: Any) -> tuple[Any, Any]:
    return (far := _largest_norm(ball)) > a.ball[0], far


def _lost(a: Allowed, ball: Any, earlier_ball: Any, paddle: Any) -> tuple[Any, Any]:
    paddle = paddle[..., None, :]
    below = paddle[..., 2] - ball[..., 2]
    beside, before = (np.linalg.norm((b - paddle)[..., :2], axis=-1) for b in (ball, earlier_ball))
    is_lost = (below > _BELOW) | ((beside > _BESIDE) & (beside >= before))
    return np.any(is_lost, axis=-1), np.max(np.maximum(below, beside), axis=-1)


def _velocity(a: Allowed, ball_velocity: Any) -> tuple[Any, Any]:
    return (fast := _largest_norm(ball_velocity)) > a.ball[1], fast


def _moved(a: Allowed, ball: Any, last_ball: Any, between: Any) -> tuple[Any, Any]:
    moved = _largest_norm(ball - last_ball)
    return moved > a.ball[1] * between + a.ball_noise, moved / between


def _fast(a: Allowed, velocities: Any) -> tuple[Any, Any]:
    return np.any(np.abs(velocities) > a.speed, axis=-1), np.max(np.abs(velocities), axis=-1)


def _stuck(a: Allowed, angles: Any, commands: Any) -> tuple[Any, Any]:
    """Whether a joint rests that no arm of the training would have rested, whatever its offset."""
    still = np.ptp(angles, axis=-2) < a.still
    rest = np.mean(angles, axis=-2)
    led = np.moveaxis(commands - rest[..., None, :], -1, -2)[still]
    # What each kind of arm would have done, for the joints that rest: [..., M, T].
    pulled = np.tensordot(led, a.pull, (-1, -1))
    least = np.max((-a.asked - pulled) / a.settled, axis=-1)
    most = np.min((a.asked - pulled) / a.settled, axis=-1)
    explained = np.maximum(least, -a.offset) <= np.minimum(most, a.offset)
    lead = np.zeros(still.shape)
    lead[still] = np.where(np.any(explained, axis=-1), 0.0, np.max(np.abs(led), axis=-1))
    return np.any(lead > 0.0, axis=-1), np.max(lead, axis=-1)


def _outside(a: Allowed, target: Any) -> tuple[Any, Any]:
    over = np.max(np.maximum(a.box[0] - target, target - a.box[1]), axis=-1)
    return over > 0.0, over


class Rule(NamedTuple):
    """A row of the table."""

    fault: str
    """Code of the fault."""
    needs: str
    """Names of the facts that it judges."""
    check: Callable[..., tuple[Any, Any]]
    """Bounds and facts -> whether it is broken, and a number for the reason."""
    reason: str


RULES = (
    Rule("late_step", "elapsed", _late, "a control step came after {:.0f} ms"),
    Rule("no_step", "idle", lambda a, n: (n > a.idle, n), "{} calls in a row are no new step"),
    Rule("old_picture", "age", _picture, "the picture of the ball is {:.0f} ms old"),
    Rule("ball_place", "ball", _place, "the ball is {:.3g} m from the base"),
    Rule("ball_lost", "ball earlier_ball paddle", _lost, "the ball is lost"),
    Rule("ball_speed", "ball_velocity", _velocity, "the ball has {:.3g} m/s"),
    Rule("ball_speed", "ball last_ball between", _moved, "the ball has {:.3g} m/s"),
    Rule("joint_speed", "velocities", _fast, "a joint has {:.3g} rad/s"),
    Rule("joint_stuck", "angles commands", _stuck, "a joint is stuck {:.3g} rad from its command"),
    Rule("box", "target", _outside, "the paddle's command is {:.3g} m outside the box"),
)
"""What must hold: of the measurements, of the arm's following, and of the command. The facts, for
any batch [...]:

- `elapsed` [...]: time since the last control step, s; `idle` [...]: calls without a step;
- `age` [...] of the ball's picture, s; `ball` and `ball_velocity` [..., B, 3] in it, m and m/s;
  `last_ball` [..., B, 3] in the picture before, the time `between` them [...], s, and
  `earlier_ball` in the one `EARLIER` before; NaN for none;
- `angles` [..., T + 1, J] and `commands` [..., K, J] of the last control steps, rad: a command is
  that at the end of the step before its angle; `velocities` [..., J], rad/s; `paddle` [..., 3], m;
- `target` [..., 3]: where the next command brings the paddle, m.
"""


def faults(bounds: Allowed, facts: dict[str, Any]) -> list[tuple[Rule, Any, Any]]:
    """The rules that the facts decide, each with whether it is broken and its number [...]."""
    rules = [(rule, rule.needs.split()) for rule in RULES]
    return [
        (rule, *rule.check(bounds, *map(facts.get, needs)))
        for rule, needs in rules
        if facts.keys() >= set(needs)
    ]


def first_fault(bounds: Allowed, facts: dict[str, Any]) -> tuple[str, str] | None:
    """Code and reason of the first rule that a single control step breaks."""
    broken = (x for x in faults(bounds, facts) if x[1])
    return next(((rule.fault, rule.reason.format(number)) for rule, _, number in broken), None)
