"""The identified world in a file: the estimates, and ranges for training with their sources."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import yaml

from bounce_mjx.identify.log import Log
from bounce_mjx.identify.stages import Identified
from bounce_mjx.identify.unknowns import BALL, CAMERA_ROTATION
from bounce_mjx.identify.words import Estimate, estimates
from bounce_mjx.world.named import NamedWorld
from bounce_mjx.world.randomization import TERMS

# Factor by which a range is wider than the interval of each term alone.
_MARGIN = 1.5


def world_of(found: Identified, log: Log, joint_names: Sequence[str], robot: str | None) -> str:
    """YAML text of the identified world: the estimates, and ranges for training.

    The range of each entry of a term covers what the log allows while all other unknowns have their
    estimates, with a margin of half: independent draws from the whole intervals of terms that the
    log cannot separate would be worlds that contradict it. A term that the log does not show is
    assumed.

    Args:
      robot: name or file of the robot's config.
    """
    by_term: dict[str, list[Estimate]] = {}
    places, listed = found.layout.slices(), estimates(found, joint_names)
    for name, place in places.items():
        by_term[name] = listed[place]
    late = least_age(log)
    ranges: dict[str, list[Any]] = {}
    identified: dict[str, float | list[float]] = {}
    sources: dict[str, str] = {}
    assumed = []
    for name, entries in by_term.items():
        if name == CAMERA_ROTATION:
            continue
        shift = late if name == "ball_latency" else 0.0
        ranges[name] = _range(name, entries, shift)
        each = [float(f"{entry.value + shift:.5g}") for entry in entries]
        identified[name] = each if len(each) > 1 else each[0]
        shown = [entry for entry in entries if entry.seen]
        if len(shown) < len(entries):
            assumed.append(name)
        values = ", ".join(_words(entry, shift) for entry in entries)
        how = "Identified" if shown else "Not shown, so the prior stands,"
        sources[name] = f"{how} from {log.source}: {values} (95%)."
    if "ball_latency" not in by_term:
        for name, unknown in BALL.items():
            ends = unknown.mean - unknown.deviation, unknown.mean + unknown.deviation
            ranges[name] = _clipped(name, ends)
            sources[name] = f"{log.source} shows no bounce; these are typical values."
            assumed.append(name)
    for name, (ends, words) in _sensors(found, log).items():
        ranges[name] = _clipped(name, ends)
        sources[name] = f"{words} in {log.source}."
    content: dict[str, Any] = {} if robot is None else {"robot": robot}
    content["env"] = {"randomization": ranges}
    content["sources"] = {f"randomization.{name}": text for name, text in sources.items()}
    content["assumed"] = [f"randomization.{name}" for name in assumed]
    content["estimates"] = identified
    head = f"# Identified from {log.source}: bounce-mjx train --world FILE\n"
    # The numbers of an end on one line, and sources below one another.
    parts = [
        yaml.safe_dump({key: value}, sort_keys=False, default_flow_style=style, width=100)
        for key, value in content.items()
        for style in [None if key in ("env", "estimates") else False]
    ]
    return head + "".join(parts)


def compare(
    world: NamedWorld, found: Identified, log: Log, joint_names: Sequence[str]
) -> list[str]:
    """Terms of a world that a log contradicts, a sentence each; none if the robot is still the
    same."""
    given, listed = world.settings.get("randomization", {}), estimates(found, joint_names)
    late, changed = least_age(log), []
    for name, place in found.layout.slices().items():
        if name not in given:
            continue
        shift = late if name == "ball_latency" else 0.0
        ends = (np.broadcast_to(end, len(listed[place])) for end in given[name])
        for entry, low, high in zip(listed[place], *ends, strict=True):
            if entry.seen and (entry.high + shift < low or entry.low + shift > high):
                changed.append(
                    f"{entry.label} is {_words(entry, shift)} now, outside {low:g} to {high:g}"
                )
    return changed


def _words(entry: Estimate, shift: float) -> str:
    half = 0.5 * (entry.high - entry.low)
    value, unit = entry.value + shift, f" {entry.unit}" if entry.unit else ""
    if entry.unit == "s":
        return f"{1e3 * value:.1f} +- {1e3 * half:.1f} ms"
    return f"{value:.4g} +- {half:.2g}{unit}"


def _range(name: str, entries: Sequence[Estimate], shift: float) -> list[Any]:
    value, low, high, alone = np.transpose([(e.value, e.low, e.high, e.alone) for e in entries])
    low = value - _MARGIN * np.minimum(value - low, alone)
    ends = np.stack([low, value + _MARGIN * np.minimum(high - value, alone)]) + shift
    return _clipped(name, ends if len(entries) > 1 else ends[:, 0])


def _clipped(name: str, ends: Any) -> list[Any]:
    """A range [2], or [2, entries], within the term's limits, for YAML."""
    least, greatest = TERMS[name].limits
    ends = np.clip(ends, max(least, -1e6), min(greatest, 1e6))
    return np.vectorize(lambda x: float(f"{x:.4g}"))(ends).tolist()


def least_age(log: Log) -> float:
    """Time from a picture's stamp to its arrival, s: 0 if the stamp is that of the arrival. Of the
    youngest pictures, as the others wait for the next control step."""
    if not len(log.arrivals):
        return 0.0
    return max(0.0, float(np.quantile(log.arrivals - log.picture_times, 0.02)))


def _sensors(found: Identified, log: Log) -> dict[str, tuple[tuple[float, float], str]]:
    """Ranges of the sensors' noise and of the camera, and how they were measured."""
    angles = found.noise.angles
    ranges = {
        "joint_angle_noise": (
            (0.8 * float(np.min(angles)), 1.2 * float(np.max(angles))),
            "Third differences of the joint angles",
        )
    }
    intervals = np.diff(log.picture_times)
    together = intervals[intervals < 0.1]
    if len(together) > 50:
        interval = float(np.median(together))
        lost = 1.0 - len(together) / float(np.sum(np.round(together / interval)))
        noise = found.noise.balls
        ranges |= {
            "camera_rate": ((0.97 / interval, 1.03 / interval), "Intervals of the pictures"),
            "frame_drop": ((0.5 * lost, 1.5 * lost + 0.01), "Missing pictures"),
            "ball_position_noise": (
                (0.8 * float(np.min(noise)), 1.2 * float(np.max(noise))),
                "Distances of pictures from a parabola through their neighbours",
            ),
        }
    return ranges
