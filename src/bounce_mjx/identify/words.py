"""What a log shows of a robot's world, and what it does not, in numbers and words."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bounce_mjx.identify.stages import Identified
from bounce_mjx.identify.unknowns import ARM, BALL, CAMERA_ROTATION

# Half the width of a 95% interval in standard deviations.
_WIDTH = 1.96
# An unknown whose deviation fell by less than this factor is not shown by the log.
_UNSEEN = 0.7
# Information in units of the prior's below which a combination of unknowns is not shown.
_WEAK = 1.5
_SHARE = 0.35
_GOOD_FIT = 1.2

_MOTIONS = {
    "encoder_bias": "bounces in other postures of the arm separate them",
    "paddle_tilt": "bounces in other postures of the arm separate them",
    "paddle_offset": "bounces in other postures of the arm, and near the paddle's edges, show it",
    "ball_position_bias": "bounces at places far apart show it",
    CAMERA_ROTATION: "bounces at places far apart, and a level under the base, show it",
    "gravity_tilt": "long flights, and a level under the base, show it",
    "link_mass": "a known weight on the paddle, or slow motions in other postures, show it",
    "servo_gain": "a known weight on the paddle, or slow motions in other postures, show it",
    "servo_damping": "faster motions show it (bounce-mjx excite --max-velocity)",
    "servo_lag": "faster motions show it (bounce-mjx excite --max-velocity)",
    "action_latency": "faster motions show it (bounce-mjx excite --max-velocity)",
    "joint_frictionloss": "slow motions there and back show it (bounce-mjx excite)",
    "contact_friction": "a ball that slips shows it: one with spin, or thrown from the side",
    "air_drag": "higher flights show it",
    "ball_latency": "bounces at several target heights show it",
    "restitution": "more bounces show it",
}
# Deviations of the prior beyond which an estimate is a mistake, and what is likely to be wrong.
_SURPRISING = 3.0
_MISTAKES = {
    "ball_position_bias": "the frame of the ball's position (of the robot's base, in metres, z "
    "up), swapped columns, or where the paddle is, which the log cannot tell from these: "
    "paddle_offset has its prior",
    "gravity_tilt": "the axes of the ball's frame, which swapped columns turn too, or the base",
    "air_drag": "the unit of ball_time or of the ball's position",
    "ball_latency": "the unit or the clock of ball_time",
    "restitution": "the unit of ball_time, or another ball or paddle than the model's",
    "paddle_tilt": "the axes of the ball's frame, or how the paddle is mounted",
    "paddle_offset": "the frame of the ball's position, or how the paddle is mounted",
    CAMERA_ROTATION: "the axes of the ball's frame, which swapped columns turn too",
    "delay": "the clock of the servo targets",
    "encoder_bias": "a joint's zero, the unit of the angles, swapped columns, or the ball's frame",
}
_OF_JOINTS = "another arm than --robot's, swapped columns of joints, or the frame of the ball"


class Estimate(NamedTuple):
    """One unknown."""

    label: str
    unit: str
    value: float
    low: float
    """Lower end of the 95% interval."""
    high: float
    seen: bool
    """Whether the log shows it; otherwise the interval is the prior's."""
    alone: float
    """Half-width of the interval if all other unknowns had their estimates."""


def estimates(found: Identified, joint_names: Sequence[str]) -> list[Estimate]:
    """All unknowns with their intervals; a sensor whose residuals exceed its noise widens them.
    `ball_latency` is the time from the exposure to the arrival."""
    layout, width = found.layout, _WIDTH * found.deviation * misfit(found)
    world = layout.world(found.fit.vector)
    values = np.concatenate([np.ravel(world[name]) for name in layout.terms()])
    low, high = values - width, values + width
    alone = _WIDTH * misfit(found) / np.sqrt(np.diag(np.linalg.inv(found.covariance)))
    for name, ends in _delays(found).items():
        place = layout.terms()[name]
        low[place], high[place] = ends
        alone[place] = np.inf
    late = layout.slices().get("ball_latency", slice(0, 0))
    for array in (values, low, high):
        array[late] += found.stamp_age
    seen = found.deviation < _UNSEEN * layout.deviation
    units = layout.units()
    labels = layout.labels(joint_names)
    return [
        Estimate(label, unit, float(x), float(a), float(b), bool(s), float(w))
        for label, unit, x, a, b, s, w in zip(
            labels, units, values, low, high, seen, alone, strict=True
        )
    ]


def _delays(found: Identified) -> dict[str, tuple[float, float]]:
    """Intervals of latency and lag from those of the delay and its variance. The latency is the
    delay less the lag, whose error is not normal near 0: its interval adds the change over the
    variance's interval to the delay's own error at a given variance."""
    layout, vector, places = found.layout, found.fit.vector, found.layout.slices()
    delay, variance = (places[name].start for name in ("delay", "delay_variance"))
    width = _WIDTH * found.deviation[variance] * misfit(found)
    slope = found.covariance[delay, variance] / found.covariance[variance, variance]
    own = found.covariance[delay, delay] - slope * found.covariance[delay, variance]
    if found.deviation[delay] >= _UNSEEN * layout.deviation[delay]:
        own = found.covariance[delay, delay]
    own = _WIDTH * misfit(found) * np.sqrt(max(own, 0.0))
    ends = np.repeat(vector[None], 3, axis=0)
    ends[:, variance] = np.maximum(vector[variance] + np.array([-width, 0.0, width]), 0.0)
    ends[:, delay] += slope * (ends[:, variance] - vector[variance])
    world = layout.world(ends)
    latency, lag = world["action_latency"], world["servo_lag"]
    below, above = (np.hypot(f(latency) - latency[1], own) for f in (np.min, np.max))
    return {
        "action_latency": (max(latency[1] - below, 0.0), latency[1] + above),
        "servo_lag": (0.0 if vector[variance] < width else lag[0], lag[2]),
    }


def misfit(found: Identified) -> float:
    """Factor by which the residuals exceed the sensors' noise, at least 1."""
    return max(1.0, *found.after.values())


def sentences(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Sentences about the fit and about what the log cannot show."""
    said = []
    for sensor, error in found.held_out.items():
        if error > _GOOD_FIT:
            said.append(
                f"The model does not explain {sensor}: its error in windows that the search had "
                f"not seen is {error:.2f} times the sensor's noise. The robot does something that "
                "the model lacks, or it is another robot, and the intervals are too narrow."
            )
    if found.dropped:
        said.append(
            f"In {found.dropped} of {int(np.sum(found.windows.has_ball))} windows, the ball was "
            "not in free flight; their pictures do not count."
        )
    if not np.any(found.windows.has_ball):
        said.append(
            "The log shows no bounce, so only the arm was identified. If the ball bounced, look at "
            "the axes and the unit of its position, z up in metres, and at the unit of ball_time."
        )
    return [*_mistakes(found, joint_names), *said, *_unseen(found, joint_names)]


def _mistakes(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Warnings of estimates that are several deviations of the prior away."""
    layout, listed, said = found.layout, estimates(found, joint_names), []
    for (name, own), place in zip(layout.unknowns.items(), layout.slices().values(), strict=True):
        unknown = (ARM | BALL).get(name, own)
        off = (found.fit.vector[place] - unknown.mean) / unknown.deviation
        at_limit = np.isin(found.fit.vector[place], [end for end in unknown.limits if end])
        beside = np.array(own.deviation) > unknown.deviation
        for i in np.flatnonzero((np.abs(off) > _SURPRISING) | at_limit | beside):
            entry = listed[place][i]
            said.append(
                f"warning: {entry.label} is {entry.value:.4g} {entry.unit}".rstrip()
                + f", {abs(off[i]):.1f} deviations of the prior from {unknown.mean:g}; look at "
                f"{_MISTAKES.get(name, _OF_JOINTS)}."
            )
    return said


def _unseen(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Combinations of unknowns that the log cannot show: the eigenvectors of its information, in
    units of the prior, with small eigenvalues."""
    layout, labels = found.layout, found.layout.labels(joint_names)
    owners = [n for n, place in layout.terms().items() for _ in range(place.start, place.stop)]
    scaled = found.fit.information * np.outer(layout.deviation, layout.deviation)
    values, vectors = np.linalg.eigh(scaled)
    said: dict[frozenset[str], str] = {}
    for value, vector in zip(values, vectors.T, strict=True):
        if value > _WEAK:
            break
        main = np.flatnonzero(np.abs(vector) > _SHARE)
        names = frozenset(owners[i] for i in main)
        if not names or names in said:
            continue
        motion = next(_MOTIONS[name] for name in _MOTIONS if name in names)
        if len(main) == 1:
            text = f"The log does not show {labels[main[0]]}: its interval is the prior's"
        else:
            listed = ", ".join(labels[i] for i in main)
            text = f"The log does not separate {listed}: their intervals are mostly the prior's"
        said[names] = f"{text}; {motion}."
    return list(said.values())
