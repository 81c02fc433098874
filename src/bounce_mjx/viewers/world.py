"""Sliders of the viewers for terms of the randomisation."""

import math
from typing import NamedTuple

import jax.numpy as jnp

from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import TERMS, Ranges, entries


class WorldSlider(NamedTuple):
    """A slider for one term of `RandomizationConfig`."""

    label: str
    term: str
    limits: tuple[float, float]
    """Ends of the slider, in its unit."""
    step: float
    scale: float = 1.0
    """Factor from the slider's unit to the term's."""
    nominal: float = 0.0
    """Position without effect, in the slider's unit; of the restitution, on the project's own
    model."""

    @property
    def span(self) -> tuple[float, float]:
        """The limits in the term's unit."""
        return self.limits[0] * self.scale, self.limits[1] * self.scale

    def world_value(self, position: float) -> tuple[float, ...]:
        """Entries of the term at a slider position; the slider moves the first entry."""
        others = math.prod(TERMS[self.term].size) - 1
        return (position * self.scale, *(self.nominal * self.scale,) * others)


SLIDERS = (
    WorldSlider("action delay, ms", "action_latency", (0.0, 50.0), 1.0, 1e-3),
    WorldSlider("picture delay, ms", "ball_latency", (0.0, 50.0), 1.0, 1e-3),
    WorldSlider("ball noise, mm", "ball_position_noise", (0.0, 20.0), 0.5, 1e-3),
    WorldSlider("paddle tilt, degrees", "paddle_tilt", (-5.0, 5.0), 0.1, math.radians(1.0)),
    WorldSlider("restitution", "restitution", (0.6, 0.98), 0.01, nominal=0.85),
)


def _sliders_of(config: WorldConfig) -> tuple[WorldSlider, ...]:
    """The sliders that a model can have: the nominal restitution is that of the project's own."""
    if config.mjcf is None:
        return SLIDERS
    return tuple(slider for slider in SLIDERS if slider.term != "restitution")


def with_sliders(config: WorldConfig) -> WorldConfig:
    """The config with the sliders' terms active, in ranges that contain the sliders' and its
    own."""
    spans = {}
    for slider in _sliders_of(config):
        own = entries(getattr(config.randomization, slider.term) or slider.span)
        low, high = zip(slider.span, *own, strict=True)
        spans[slider.term] = min(low), max(high)
    randomization = config.randomization.model_copy(update=spans)
    return config.model_copy(update={"randomization": randomization})


def reset_ranges(config: WorldConfig) -> Ranges:
    """Ranges with which a reset of `with_sliders(config)` samples the worlds of `config`."""
    active = with_sliders(config).randomization.terms
    ranges = config.randomization.ranges()
    for slider in _sliders_of(config):
        if slider.term in active and slider.term not in config.randomization.terms:
            shape = TERMS[slider.term].shape(config.num_joints)
            end = jnp.full(shape, slider.nominal * slider.scale, jnp.float32)
            ranges[slider.term] = end, end
    return ranges


def sliders_for(config: WorldConfig) -> tuple[WorldSlider, ...]:
    """Sliders of the active terms whose ranges contain the sliders'; each spans the whole range."""
    found = []
    for slider in _sliders_of(config):
        ends = getattr(config.randomization, slider.term)
        spans = [] if ends is None else entries(ends)
        if spans and all(low <= slider.span[0] and slider.span[1] <= high for low, high in spans):
            limits = tuple(round(end / slider.scale, 6) for end in spans[0])
            found.append(slider._replace(limits=limits))
    return tuple(found)
