"""The identified world in a file: ranges for training, with their sources."""

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
# Longest time between two pictures of one flight, s.
_TOGETHER = 0.1


def world_of(found: Identified, log: Log, joint_names: Sequence[str], robot: str | None) -> str:
    """YAML text of the identified world: ranges for training, with their sources.

    The range of each entry of a term covers what the log allows while all other unknowns have their
    estimates, with a margin of half: independent draws from the whole intervals of terms that the
    log cannot separate would be worlds that contradict it. A term that the log does not show is
    assumed.

    Args:
      robot: name or file of the robot's config.
    """
    by_term: dict[str, list[Estimate]] = {}
    listed = estimates(found, joint_names)
    for name, place in found.layout.terms().items():
        by_term[name] = listed[place]
    ranges: dict[str, list[Any]] = {}
    sources: dict[str, str] = {}
    assumed = []
    for name, entries in by_term.items():
        if name == CAMERA_ROTATION:
            continue
        ranges[name] = _range(name, entries)
        shown = [entry for entry in entries if entry.seen]
        if len(shown) < len(entries):
            assumed.append(name)
        values = ", ".join(_words(entry) for entry in entries)
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
    head = f"# Identified from {log.source}: bounce-mjx train --world FILE\n"
    # The numbers of an end on one line, and sources below one another.
    parts = [
        yaml.safe_dump({key: value}, sort_keys=False, default_flow_style=style, width=100)
        for key, value in content.items()
        for style in [None if key == "env" else False]
    ]
    return head + "".join(parts)


def compare(world: NamedWorld, found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Terms of a world that a log contradicts, a sentence each; none if the robot is still the
    same."""
    given, listed = world.settings.get("randomization", {}), estimates(found, joint_names)
    changed = []
    for name, place in found.layout.terms().items():
        if name not in given:
            continue
        ends = (np.broadcast_to(end, len(listed[place])) for end in given[name])
        for entry, low, high in zip(listed[place], *ends, strict=True):
            if entry.seen and (entry.high < low or entry.low > high):
                changed.append(f"{entry.label} is {_words(entry)} now, outside {low:g} to {high:g}")
    return changed


def _words(entry: Estimate) -> str:
    half, unit = 0.5 * (entry.high - entry.low), f" {entry.unit}" if entry.unit else ""
    if entry.unit == "s":
        return f"{1e3 * entry.value:.1f} +- {1e3 * half:.1f} ms"
    return f"{entry.value:.4g} +- {half:.2g}{unit}"


def _range(name: str, entries: Sequence[Estimate]) -> list[Any]:
    value, low, high, alone = np.transpose([(e.value, e.low, e.high, e.alone) for e in entries])
    low = value - _MARGIN * np.minimum(value - low, alone)
    ends = np.stack([low, value + _MARGIN * np.minimum(high - value, alone)])
    return _clipped(name, ends if len(entries) > 1 else ends[:, 0])


def _clipped(name: str, ends: Any) -> list[Any]:
    """A range [2], or [2, entries], within the term's limits, for YAML."""
    least, greatest = TERMS[name].bounds
    ends = np.clip(ends, max(least, -1e6), min(greatest, 1e6))
    return np.vectorize(lambda x: float(f"{x:.4g}"))(ends).tolist()


def camera_of(log: Log) -> tuple[float, float] | None:
    """Rate of the pictures (Hz), and share of them that were lost; None for fewer than 50.

    A picture that came together with a later one, between two control steps, is not lost.
    """
    intervals, steps = np.diff(log.picture_times), np.searchsorted(log.times, log.arrivals)
    together = intervals < _TOGETHER
    if np.sum(together) < 50:
        return None
    intervals, period = intervals[together], float(np.median(intervals[together]))
    for _ in range(3):
        # Stamps that are rounded, or of every second picture at times, have another median.
        periods = np.maximum(np.round(intervals / period), 1.0)
        period = float(np.sum(intervals) / np.sum(periods))
    missing = periods - 1.0
    if np.mean(np.isin(log.arrivals, log.times)) > 0.9:
        missing = np.minimum(missing, np.maximum(np.diff(steps)[together] - 1.0, 0.0))
    return 1.0 / period, float(np.sum(missing) / (len(missing) + np.sum(missing)))


def _sensors(found: Identified, log: Log) -> dict[str, tuple[tuple[float, float], str]]:
    """Ranges of the sensors' noise and of the camera, and how they were measured."""
    angles = found.noise.angles
    ranges = {
        "joint_angle_noise": (
            (0.8 * float(np.min(angles)), 1.2 * float(np.max(angles))),
            "Third differences of the joint angles",
        )
    }
    if (camera := camera_of(log)) is not None:
        rate, lost = camera
        noise = found.noise.balls
        ranges |= {
            "camera_rate": ((0.97 * rate, 1.03 * rate), "Intervals of the pictures"),
            "frame_drop": ((0.5 * lost, 1.5 * lost + 0.01), "Missing pictures"),
            "ball_position_noise": (
                (0.8 * float(np.min(noise)), 1.2 * float(np.max(noise))),
                "Distances of pictures from a parabola through their neighbours",
            ),
        }
    return ranges
