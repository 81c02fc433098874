"""What a log says about a robot's world: estimates, sentences, and a named world for training."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import yaml

from bounce_mjx.identify.log import Log
from bounce_mjx.identify.servos import servos_of
from bounce_mjx.identify.stages import Identified
from bounce_mjx.identify.unknowns import BALL, CAMERA_ROTATION, MOTIONS
from bounce_mjx.world.named import NamedWorld
from bounce_mjx.world.randomization import TERMS

# Factor by which a range is wider than the interval of each term alone.
_MARGIN = 1.5
# Longest time between two pictures of one flight, s.
_TOGETHER = 0.1
# Half the width of a 95% interval in standard deviations.
_HALF_WIDTH = 1.96
# An unknown whose deviation fell by less than this factor is not shown by the log.
_UNSEEN = 0.7
# Information in units of the prior's below which a combination of unknowns is not shown.
_WEAK = 1.5
_SHARE = 0.35
# An error in windows that the search had not seen is explained up to this multiple of the sensor's
# noise, or up to these: a share of a joint's motion and an angle, rad; a distance of the ball, m.
_GOOD_FIT = 2.0
_GOOD_SHARE = 0.02
_GOOD_ANGLE = 1e-3
_GOOD_DISTANCE = 3e-3
# Share of the windows with a ball from which its bounces count.
_MOST_FLY = 0.5

# Deviations of the prior beyond which an estimate is a mistake, and what is likely to be wrong.
_SURPRISING = 3.0
# Distance from a limit of the search within which an estimate is at it, in the same deviations.
_AT_LIMIT = 1e-6
# Terms of a follower's servos, which were chosen and not estimated.
_OF_FOLLOWER = ("servo_lag", "servo_gain", "servo_damping", "joint_frictionloss")
_MISTAKES = (
    "Look at the frame of the ball's position (the robot's base, in metres, z up), the unit and "
    "clock of ball_time and of the servo targets, swapped columns, a joint's zero, --robot, and "
    "how the paddle is mounted, which the log cannot tell from these: paddle_offset has its prior."
)
_ARM_MISTAKES = (
    "The servos of --robot may be made up, or it is another robot; look at the unit and clock of "
    "the servo targets too."
)


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
    chosen: bool
    """Whether it was chosen for a follower: the interval is then the prior's about that number,
    which says how far a training may vary it and nothing about the robot."""
    alone: float
    """Half-width of the interval if all other unknowns had their estimates."""
    typical: float
    """Distance from the value within which it lies without the log: one deviation of the prior."""


def estimates(found: Identified, joint_names: Sequence[str]) -> list[Estimate]:
    """All unknowns with their intervals; a sensor whose residuals exceed its noise widens them.
    `ball_latency` is the time from the exposure to the arrival. Values and intervals are within
    the bounds of the world's terms."""
    layout = found.layout
    vector = found.fit.vector
    world = layout.world(vector)
    values = np.concatenate([np.ravel(world[name]) for name in layout.terms])
    deviation = _known_deviation(found)
    low = layout.decode(layout.clip(vector - _HALF_WIDTH * deviation))
    high = layout.decode(layout.clip(vector + _HALF_WIDTH * deviation))
    given_others = misfit(found) / np.sqrt(np.diag(np.linalg.inv(found.covariance)))
    ends = layout.decode(vector + _HALF_WIDTH * np.minimum(given_others, layout.deviation))
    alone = ends - layout.decode(vector)
    typical = layout.decode(vector + layout.deviation) - layout.decode(vector)
    for name, ends in _estimate_delays(found).items():
        place = layout.terms[name]
        low[place], high[place] = ends
        # A change of latency or lag alone is one of the delay, at whose place the latency is.
        alone[place] = alone[layout.terms["action_latency"]]
        typical[place] = typical[layout.terms["action_latency"]]
    late = layout.slices.get("ball_latency", slice(0, 0))
    for array in (values, low, high):
        array[late] += found.stamp_age
    for name, place in layout.terms.items():
        if name in TERMS:
            for array in (values, low, high):
                array[place] = np.clip(array[place], *TERMS[name].bounds)
    seen = found.deviation < _UNSEEN * layout.deviation
    chosen = _is_chosen(found)
    return [
        Estimate(
            label=label,
            unit=layout.units[i],
            value=float(values[i]),
            low=float(low[i]),
            high=float(high[i]),
            seen=bool(seen[i]),
            chosen=bool(chosen[i]),
            alone=float(alone[i]),
            typical=float(typical[i]),
        )
        for i, label in enumerate(layout.labels(joint_names))
    ]


def _is_chosen(found: Identified) -> np.ndarray:
    """Which unknowns [P] were chosen for a follower, and not searched."""
    chosen = np.zeros(len(found.fit.vector), bool)
    for name in _OF_FOLLOWER if found.is_follower else ():
        chosen[found.layout.terms[name]] = True
    return chosen


def _known_deviation(found: Identified) -> np.ndarray:
    """Standard deviations [P] of the unknowns, widened by the misfit; what a log does not show is
    as well known as before it."""
    return np.minimum(found.deviation * misfit(found), found.layout.deviation)


def _estimate_delays(found: Identified) -> dict[str, tuple[float, float]]:
    """Intervals of latency and lag from those of the delay and its variance. The latency is the
    delay less the lag, whose error is not normal near 0: its interval adds the change over the
    variance's interval to the delay's own error at a given variance."""
    layout = found.layout
    vector = found.fit.vector
    places = found.layout.slices
    delay = places["delay"].start
    variance = places["delay_variance"].start
    width = _HALF_WIDTH * _known_deviation(found)[variance]
    slope = found.covariance[delay, variance] / found.covariance[variance, variance]
    squared = found.covariance[delay, delay] - slope * found.covariance[delay, variance]
    if found.deviation[delay] >= _UNSEEN * layout.deviation[delay]:
        squared = found.covariance[delay, delay]
    of_delay = misfit(found) * np.sqrt(max(squared, 0.0))
    given_variance = _HALF_WIDTH * min(of_delay, layout.deviation[delay])
    ends = np.repeat(vector[None], 3, axis=0)
    ends[:, variance] = np.maximum(vector[variance] + np.array([-width, 0.0, width]), 0.0)
    ends[:, delay] += slope * (ends[:, variance] - vector[variance])
    world = layout.world(ends)
    latency = world["action_latency"]
    lag = world["servo_lag"]
    below = np.hypot(np.min(latency) - latency[1], given_variance)
    above = np.hypot(np.max(latency) - latency[1], given_variance)
    return {
        "action_latency": (max(latency[1] - below, 0.0), latency[1] + above),
        "servo_lag": (0.0 if vector[variance] < width else lag[0], lag[2]),
    }


def misfit(found: Identified) -> float:
    """Factor by which the errors in windows that the search had not seen exceed those in all
    windows, these included, at least 1."""
    ratios = [found.held_out[name] / found.after[name] for name in found.held_out]
    return float(np.max([1.0, *ratios]))


def sentences(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Sentences about the fit and about what the log cannot show."""
    said = describe_doubts(found, joint_names)
    if found.gravity_compensation:
        said.append("The log shows that the controller carries the arm's weight.")
    if found.is_still:
        said.append(
            "No command in the log changes, so it shows neither a delay nor servos; record motions "
            "of the arm too (bounce-mjx excite)."
        )
    if found.has_set_points:
        said.append(
            "The targets are the controller's own set points, which the joints follow at once: the "
            "world has their delay, a constant offset of each joint, and stiff servos."
        )
    elif found.is_follower:
        said.append(
            "A delay and a constant offset of each joint explain the angles in windows that the "
            "search had not seen no worse than servos do: the world has these, and stiff servos."
        )
    if found.leaves_at_once:
        said.append(
            "The ball leaves the paddle at once, as a real one does; in the world it stays for the "
            "model's contact, and leaves as fast."
        )
    if found.dropped and found.dropped <= _MOST_FLY * np.sum(found.windows.has_ball):
        said.append(
            f"In {found.dropped} of {int(np.sum(found.windows.has_ball))} windows, the ball was "
            "not in free flight; their pictures do not count."
        )
    if "ball_position" in found.after and "ball_position" not in found.held_out:
        said.append(
            "No window with a bounce was left out of the search, so that nothing checks what was "
            "found about the ball; record more bounces."
        )
    if not np.any(found.windows.has_ball):
        said.append(
            "The log shows fewer than three bounces, so only the arm was identified, without a "
            "zero that an encoder and its servo share (encoder_bias)."
        )
    delay = found.layout.slices["delay"].start
    lag = found.layout.slices["delay_variance"].start
    is_seen = found.deviation < _UNSEEN * found.layout.deviation
    if is_seen[delay] and not is_seen[lag]:
        said.append(
            "The log does not tell action_latency and servo_lag apart; their sum is what it shows."
        )
    return [*_describe_mistakes(found, joint_names), *said, *_describe_unseen(found, joint_names)]


def describe_doubts(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Why the identified world does not explain the log, a sentence each; none if it does.

    The errors are those in windows that the search had not seen. A model that is off by less than
    its sensor's noise, or by a small share of the motion, is as good as a policy needs it.
    """
    windows = found.windows
    doubts = []
    angles = windows.angles[windows.angle_weights > 0.0]
    for j, (name, error) in enumerate(zip(joint_names, found.joint_errors, strict=False)):
        noise = found.noise.angles[j]
        motion = float(np.std(angles[:, j]))
        # Also an error that is no number is none that the model explains.
        if not error <= max(_GOOD_FIT * noise, _GOOD_SHARE * motion, _GOOD_ANGLE):
            doubts.append(
                f"The model does not explain the angles of {name}: its error in windows that the "
                f"search had not seen is {1e3 * error:.2g} mrad, and {1e3 * noise:.2g} mrad is the "
                "encoder's noise. The robot does something that the model lacks, or it is another "
                "robot."
            )
    bounces = int(np.sum(windows.has_ball))
    if bounces and found.dropped > _MOST_FLY * bounces:
        doubts.append(
            f"In {found.dropped} of {bounces} windows, the ball was not in free flight as the "
            "model knows it; the other windows are too few to believe."
        )
    ratio = found.held_out.get("ball_position", 0.0)
    error = ratio * float(np.mean(found.noise.balls)) if bounces else 0.0
    if not (ratio <= _GOOD_FIT or error <= _GOOD_DISTANCE):
        doubts.append(
            f"The model does not explain the ball: its error in windows that the search had not "
            f"seen is {1e3 * error:.2g} mm, {ratio:.2g} times the camera's noise."
        )
    return doubts


def total_delay(found: Identified, model: mujoco.MjModel) -> str:
    """The delay from a command to the angle, which a log shows however it is shared.

    It is the action's latency, the mean delay of the lag's steps (shorter than the lag by half a
    step at most), and the delay of the servos themselves, which the joints' own damping makes
    longer, less the half step by which a simulated servo answers earlier. Of commands that are held
    until the next, the delay that an inspection shows is longer by half a control step, the mean
    time of holding.
    """
    layout = found.layout
    servos = servos_of(model)
    delay = layout.slices["delay"].start

    def total(vector: np.ndarray) -> float:
        world = layout.world(vector)
        of_servos = servos.delays(world["servo_gain"], world["servo_damping"])
        return float(vector[delay] + np.mean(of_servos)) - 0.5 * layout.physics_dt

    vector = found.fit.vector
    steps = 1e-3 * layout.deviation
    moved = [total(vector + step) for step in np.diag(steps)]
    slope = (np.array(moved) - total(vector)) / steps
    covariance = np.linalg.inv(found.information + np.diag(layout.deviation**-2.0))
    # As much wider than for independent residuals as the interval of the delay.
    wider = found.deviation[delay] / np.sqrt(covariance[delay, delay])
    deviation = misfit(found) * wider * float(np.sqrt(slope @ covariance @ slope))
    before = float(np.linalg.norm(slope * layout.deviation))
    width = _HALF_WIDTH * min(deviation, before)
    late = max(total(vector), 0.0)
    is_shown = found.deviation[delay] < _UNSEEN * layout.deviation[delay]
    return (
        f"total delay: {1e3 * late:.1f} +- {1e3 * width:.1f} ms, of latency, lag and servos"
        f"{'' if is_shown else ' (not shown by the log)'}"
    )


def _describe_mistakes(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Warnings of estimates that are several deviations of the prior away, or that cannot be."""
    layout = found.layout
    vector = found.fit.vector
    listed = estimates(found, joint_names)
    expected = layout.world(layout.mean)
    typical = np.concatenate([np.ravel(expected[name]) for name in layout.terms])
    off = np.abs(vector - layout.mean) / layout.deviation
    # Of a physical quantity that may be absent, such as drag, 0 is a value like any other.
    is_near = np.abs(layout.limits - vector) < _AT_LIMIT * layout.deviation
    at_limit = np.any(is_near & (layout.limits != 0.0), axis=0)
    # The deviations are those of the delay, which latency and lag share.
    delay = layout.slices["delay"].start
    listed[delay] = listed[delay]._replace(
        label="action_latency and servo_lag together", value=float(vector[delay])
    )
    typical[delay] = layout.mean[delay]
    late = layout.slices.get("ball_latency", slice(0, 0))
    typical[late] += found.stamp_age
    is_judged = ~_is_chosen(found)
    said = [
        f"warning: {entry.label} is {entry.value:.4g} {entry.unit}".rstrip()
        + f", {off[i]:.1f} deviations of the prior from {typical[i]:.3g}."
        for i, entry in enumerate(listed)
        if is_judged[i] and (off[i] > _SURPRISING or at_limit[i])
    ]
    ages = vector[late] + found.stamp_age
    if np.any(ages + _HALF_WIDTH * found.deviation[late] * misfit(found) < 0.0):
        said.append(
            f"warning: the pictures arrive {-1e3 * ages[0]:.1f} ms before what they show, which "
            "cannot be; the world has a ball_latency of 0."
        )
    advice = _MISTAKES if np.any(found.windows.has_ball) else _ARM_MISTAKES
    return [*said, advice] if said else []


def _describe_unseen(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Combinations of unknowns that the log cannot show: the eigenvectors of its information, in
    units of the prior, with small eigenvalues; not of those that were chosen."""
    layout = found.layout
    searched = np.flatnonzero(~_is_chosen(found))
    labels = np.array(layout.labels(joint_names))[searched]
    owners = [n for n, place in layout.terms.items() for _ in range(place.start, place.stop)]
    owners = np.array(owners)[searched]
    scaled = found.information * np.outer(layout.deviation, layout.deviation)
    values, vectors = np.linalg.eigh(scaled[np.ix_(searched, searched)])
    said: dict[frozenset[str], str] = {}
    for value, vector in zip(values, vectors.T, strict=True):
        main = np.flatnonzero(np.abs(vector) > _SHARE)
        names = frozenset(owners[i] for i in main)
        if value > _WEAK or not names or names in said:
            continue
        motion = next(x for x, shown in MOTIONS.items() if names & set(shown.split()))
        text = f"The log does not show {labels[main[0]]}: its interval is the prior's"
        if len(main) > 1:
            listed = ", ".join(labels[i] for i in main)
            text = f"The log does not separate {listed}: their intervals are mostly the prior's"
        said[names] = f"{text}; {motion} would."
    return list(said.values())


def to_yaml(
    found: Identified,
    log: Log,
    joint_names: Sequence[str],
    robot: str | None,
    doubts: Sequence[str] = (),
) -> str:
    """YAML text of the identified world: ranges for training, with their sources.

    The range of each entry of a term covers what the log allows while all other unknowns have their
    estimates, with a margin of half: independent samples from the whole intervals of terms that the
    log cannot separate would be worlds that contradict it. A term that the log does not show is
    assumed, and has at most one deviation of its prior to each side.

    Args:
      robot: name or file of the robot's config.
      doubts: why the world does not explain the log, for its first lines.
    """
    ranges: dict[str, list[Any]] = {}
    sources: dict[str, str] = {}
    assumed = []
    listed = estimates(found, joint_names)
    for name, place in found.layout.terms.items():
        if name == CAMERA_ROTATION:
            continue
        entries = listed[place]
        ranges[name] = _widen(name, entries)
        if not all(entry.seen for entry in entries):
            assumed.append(name)
        shown = any(entry.seen for entry in entries)
        how = "Identified" if shown else "Not shown, so the prior stands,"
        values = ", ".join(map(_format, entries))
        sources[name] = f"{how} from {log.source}: {values} (95%)."
        if all(entry.chosen for entry in entries):
            values = ", ".join(f"{entry.value:.4g} {entry.unit}".rstrip() for entry in entries)
            sources[name] = (
                "Chosen, as a delay and offsets alone explain the joints, and not measured, from "
                f"{log.source}: {values}."
            )
    for name in [name for name in BALL if name not in ranges]:
        unknown = BALL[name]
        ends = unknown.mean - unknown.deviation, unknown.mean + unknown.deviation
        ranges[name] = _clip(name, ends)
        sources[name] = f"{log.source} shows fewer than three bounces; these are typical values."
        assumed.append(name)
    for name, (low, high, words) in _measure_sensors(found, log).items():
        ranges[name] = _clip(name, (low, high))
        sources[name] = f"{words} in {log.source}."
    head = {} if robot is None else {"robot": robot}
    head["env"] = {"randomization": ranges}
    if found.gravity_compensation:
        head["env"] = {"robot": {"gravity_compensation": found.gravity_compensation}} | head["env"]
    tail = {"sources": {f"randomization.{name}": text for name, text in sources.items()}}
    if found.gravity_compensation:
        words = f"{log.source} fits better with a controller that carries the arm's weight."
        tail["sources"]["robot.gravity_compensation"] = words
    tail["assumed"] = [f"randomization.{name}" for name in assumed]
    # The numbers of an end on one line, and sources below one another.
    texts = [
        yaml.safe_dump(part, sort_keys=False, default_flow_style=style, width=100)
        for part, style in ((head, None), (tail, False))
    ]
    lines = [f"Identified from {log.source}: bounce-mjx train --world FILE", *doubts]
    comment = "".join(f"# {line}\n" for line in lines)
    return comment + "".join(texts)


def compare(world: NamedWorld, found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Terms of a world that a log contradicts, a sentence each; none if the robot is still the
    same."""
    given = world.settings.get("randomization", {})
    listed = estimates(found, joint_names)
    changed = []
    for name, place in found.layout.terms.items():
        if name not in given:
            continue
        ends = (np.broadcast_to(end, len(listed[place])) for end in given[name])
        for entry, low, high in zip(listed[place], *ends, strict=True):
            if entry.seen and (entry.high < low or entry.low > high):
                changed.append(
                    f"{entry.label} is {_format(entry)} now, outside {low:g} to {high:g}"
                )
    return changed


def _format(entry: Estimate) -> str:
    half = max(entry.high - entry.value, entry.value - entry.low)
    unit = f" {entry.unit}" if entry.unit else ""
    if entry.unit == "s":
        return f"{1e3 * entry.value:.1f} +- {1e3 * half:.1f} ms"
    return f"{entry.value:.4g} +- {half:.2g}{unit}"


def _widen(name: str, entries: Sequence[Estimate]) -> list[Any]:
    """The range of a term for training, from the intervals of its entries."""
    lows = []
    highs = []
    for entry in entries:
        most = np.inf if entry.seen else entry.typical
        below = _MARGIN * min(entry.value - entry.low, entry.alone)
        above = _MARGIN * min(entry.high - entry.value, entry.alone)
        lows.append(entry.value - min(below, most))
        highs.append(entry.value + min(above, most))
    return _clip(name, [lows, highs] if len(entries) > 1 else [lows[0], highs[0]])


def _clip(name: str, ends: Any) -> list[Any]:
    """A range [2], or [2, entries], within the term's limits, for YAML."""
    least, greatest = TERMS[name].bounds
    ends = np.clip(ends, max(least, -1e6), min(greatest, 1e6))
    return np.vectorize(lambda x: float(f"{x:.4g}"))(ends).tolist()


def measure_camera(log: Log) -> tuple[float, float] | None:
    """Rate of the pictures (Hz), and share of them that were lost; None for fewer than 50.

    A picture that came together with a later one, between two control steps, is not lost.
    """
    intervals = np.diff(log.picture_times)
    steps = np.searchsorted(log.times, log.arrivals)
    together = intervals < _TOGETHER
    if np.sum(together) < 50:
        return None
    intervals = intervals[together]
    period = float(np.median(intervals))
    for _ in range(3):
        # Stamps that are rounded, or of every second picture at times, have another median.
        periods = np.maximum(np.round(intervals / period), 1.0)
        period = float(np.sum(intervals) / np.sum(periods))
    missing = periods - 1.0
    if np.mean(np.isin(log.arrivals, log.times)) > 0.9:
        missing = np.minimum(missing, np.maximum(np.diff(steps)[together] - 1.0, 0.0))
    return 1.0 / period, float(np.sum(missing) / (len(missing) + np.sum(missing)))


def _measure_sensors(found: Identified, log: Log) -> dict[str, tuple[float, float, str]]:
    """Lower and upper end of the sensors' noise and of the camera's terms, and how they were
    measured."""
    angles, balls = found.noise
    ranges = {
        "joint_angle_noise": (
            0.8 * np.min(angles),
            1.2 * np.max(angles),
            "Third differences of the joint angles",
        )
    }
    if (camera := measure_camera(log)) is not None:
        rate, lost = camera
        ball_noise = (
            0.8 * np.min(balls),
            1.2 * np.max(balls),
            "Distances of pictures from a parabola through their neighbours",
        )
        ranges |= {
            "camera_rate": (0.97 * rate, 1.03 * rate, "Intervals of the pictures"),
            "frame_drop": (0.5 * lost, 1.5 * lost + 0.01, "Missing pictures"),
            "ball_position_noise": ball_noise,
        }
    return ranges
