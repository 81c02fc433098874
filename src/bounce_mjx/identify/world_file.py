"""A named world from what was identified: its ranges, with their sources; and a comparison."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import yaml

from bounce_mjx.identify.estimates import Estimate, estimates
from bounce_mjx.identify.identification import Identified
from bounce_mjx.identify.log import Log
from bounce_mjx.identify.sensors import measure_camera
from bounce_mjx.identify.unknowns import BALL, CAMERA_ROTATION
from bounce_mjx.world.named import NamedWorld
from bounce_mjx.world.randomization import TERMS

# Factor by which a range is wider than the interval of each term alone.
_MARGIN = 1.5


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
                f"Chosen, as {found.choice.chosen.name} explains the joints, and not measured, "
                f"from {log.source}: {values}."
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
    carried = found.simulated.gravity_compensation
    if carried:
        head["env"] = {"robot": {"gravity_compensation": carried}} | head["env"]
    tail = {"sources": {f"randomization.{name}": text for name, text in sources.items()}}
    if carried:
        words = f"{log.source} fits better with a controller that carries the arm's weight."
        if found.is_follower:
            words = f"In {log.source}, the joints are where their commands were, in all postures."
        tail["sources"]["robot.gravity_compensation"] = words
    tail["assumed"] = [f"randomization.{name}" for name in assumed]
    # The numbers of an end on one line, and sources below one another.
    texts = [
        yaml.safe_dump(part, sort_keys=False, default_flow_style=style, width=100)
        for part, style in ((head, None), (tail, False))
    ]
    lines = [
        f"Identified from {log.source}: bounce-mjx train --world FILE",
        f"The arm: {found.choice.chosen.name}.",
        *doubts,
    ]
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
