"""What a log says about each quantity of a robot's world: estimates with their intervals."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.identify.identification import Identified
from bounce_mjx.identify.servos import servos_of
from bounce_mjx.identify.unknowns import OF_SERVOS
from bounce_mjx.world.randomization import TERMS

# Half the width of a 95% interval in standard deviations, and its ends as quantiles.
HALF_WIDTH = 1.96
_ENDS = (2.5, 97.5)
UNSEEN = 0.7
"""An unknown whose deviation fell by less than this factor is not shown by the log."""


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
    """All unknowns with their intervals, from the resampled logs. `ball_latency` is the time from
    the exposure to the arrival. Values and intervals are within the bounds of the world's terms."""
    layout = found.layout
    vector = found.fit.vector

    def terms(vectors: np.ndarray) -> np.ndarray:
        """The terms [..., P] of vectors [..., P]."""
        world = layout.world(vectors)
        shape = vectors.shape[:-1]
        return np.concatenate([world[name].reshape(*shape, -1) for name in layout.terms], axis=-1)

    values = terms(vector)
    samples = layout.clip(vector + found.certainty.changes)
    low, high = _intervals(terms(samples), values)
    prior = layout.precision / np.outer(layout.deviation, layout.deviation)
    precision = found.certainty.information + prior
    # As much wider than for independent residuals as the interval itself.
    wider = found.deviation / np.sqrt(np.diag(np.linalg.inv(precision)))
    given_others = np.maximum(wider, 1.0) / np.sqrt(np.diag(precision))
    ends = layout.decode(vector + HALF_WIDTH * np.minimum(given_others, layout.deviation))
    alone = ends - layout.decode(vector)
    typical = layout.decode(vector + layout.deviation) - layout.decode(vector)
    latency = layout.terms["action_latency"]
    lag = layout.terms["servo_lag"]
    # A change of latency or lag alone is one of the delay, at whose place the latency is.
    alone[lag] = alone[latency]
    typical[lag] = typical[latency]
    late = layout.slices.get("ball_latency", slice(0, 0))
    for array in (values, low, high):
        array[late] += found.stamp_age
    for name, place in layout.terms.items():
        if name in TERMS:
            for array in (values, low, high):
                array[place] = np.clip(array[place], *TERMS[name].bounds)
    seen = is_seen_by(found)
    chosen = is_chosen(found)
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


def _intervals(samples: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the 95% intervals [P] of samples [B, P], which hold the estimates [P]."""
    low, high = np.percentile(samples, _ENDS, axis=0)
    return np.minimum(low, values), np.maximum(high, values)


def is_seen_by(found: Identified) -> np.ndarray:
    """Which unknowns [P] a log shows."""
    return found.deviation < UNSEEN * found.layout.deviation


def is_chosen(found: Identified) -> np.ndarray:
    """Which unknowns [P] were chosen for a follower, and not searched."""
    chosen = np.zeros(len(found.fit.vector), bool)
    for name in OF_SERVOS if found.is_follower else ():
        chosen[found.layout.terms[name]] = True
    return chosen


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

    def total(vectors: np.ndarray) -> np.ndarray:
        """Of vectors [..., P], s."""
        world = layout.world(vectors)
        of_servos = servos.delays(world["servo_gain"], world["servo_damping"])
        return vectors[..., delay] + np.mean(of_servos, axis=-1) - 0.5 * layout.physics_dt

    vector = found.fit.vector
    late = max(float(total(vector)), 0.0)
    # What was chosen leaves nothing open.
    changes = np.where(is_chosen(found), 0.0, found.certainty.changes)
    low, high = np.percentile(total(layout.clip(vector + changes)), _ENDS)
    width = max(high - late, late - low)
    is_shown = found.deviation[delay] < UNSEEN * layout.deviation[delay]
    return (
        f"total delay: {1e3 * late:.1f} +- {1e3 * width:.1f} ms, of latency, lag and servos"
        f"{'' if is_shown else ' (not shown by the log)'}"
    )
