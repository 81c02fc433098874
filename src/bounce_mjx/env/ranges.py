"""The ranges that a reset is given. They are a randomisation like the config's, and reach no
farther than the environment can act: what an episode's world says is what happens in it."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.task.rewards import check_names
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import (
    TERMS,
    RandomizationConfig,
    Ranges,
    World,
    check_bounds,
)

_SOURCE = "the ranges of a reset"
_QUEUES = {
    "action_latency": (1, "late actions"),
    "ball_latency": (1, "late pictures"),
    "camera_rate": (0, "late pictures"),
}
"""Terms by which the environment's queues are as long as they are: the end of the range that
decides, and of what the queue is."""


def check_ranges(
    config: WorldConfig, ranges: Ranges, nominals: Mapping[str, np.ndarray]
) -> RandomizationConfig:
    """Refuses ranges of a reset that the environment cannot act on.

    Args:
      ranges: of all active terms, and of goals. Of traced ends the shapes alone are known;
        `within_queues` keeps what is sampled from them within the queues.
      nominals: the terms' values without randomisation, from which a warm-up grows their ranges.

    Returns:
      The config's randomisation, with the ranges whose ends are known.

    Raises:
      UserError: the ranges lack a term, have an unknown one or ends of another shape, are no ranges
        within the bounds of the term or of the goal, or reach beyond the queues of the config.
    """
    terms = config.randomization.terms
    goals = config.goals
    # The goals are on both sides, as none needs a range and each may have one.
    check_names("a reset", "range", {*ranges, *goals}, {*terms, *goals})
    known = {}
    for name, ends in ranges.items():
        _check_shape(name, ends, config.num_joints)
        numbers = _numbers(ends)
        if numbers is None:
            continue
        if name in goals:
            low, high = (goals[name].checked(end, f"{_SOURCE}: {name}") for end in numbers)
            if low > high:
                raise UserError(f"{_SOURCE}: {name} is from {low:g} to {high:g}; exchange the two")
        else:
            known[name] = numbers
    for name, ends in known.items():
        try:
            check_bounds(name, ends, nominals.get(name))
        except ValueError as error:
            raise UserError(f"{_SOURCE}: {error}") from error
        if name in _QUEUES:
            _check_queue(name, ends, config.randomization)
    return config.randomization.model_copy(update=known)


def within_queues(config: RandomizationConfig, world: World) -> World:
    """A world with no longer delay, and no slower camera, than the queues of the config have room
    for: as it will act."""
    kept = dict(world)
    for name in world.keys() & _QUEUES.keys():
        ends = getattr(config, name)
        if ends is None:
            continue
        decisive, _ = _QUEUES[name]
        # As the config's own ranges, so that none of their samples changes.
        bound = jnp.asarray(ends[decisive], jnp.float32)
        keep = jnp.minimum if decisive else jnp.maximum
        kept[name] = keep(world[name], bound.astype(world[name].dtype))
    return kept


def _check_shape(name: str, ends: Any, num_joints: int) -> None:
    """Refuses what is no pair of ends, and ends of another shape than the term, which NumPy would
    spread over its entries or refuse in words of its own."""
    shape = TERMS[name].shape(num_joints) if name in TERMS else ()
    is_pair = isinstance(ends, tuple | list) and len(ends) == 2
    shapes = [jnp.shape(end) for end in ends] if is_pair else []
    if not is_pair or shapes[0] != shapes[1] or shapes[0] not in ((), shape):
        given = " and ".join(map(str, shapes)) if is_pair else f"a {type(ends).__name__}"
        wanted = (
            "two numbers" if shape == () else f"two numbers, or two arrays of the shape {shape}"
        )
        raise UserError(f"{_SOURCE}: {name} has ends of the shapes {given}; give {wanted}")


def _numbers(ends: Any) -> tuple[Any, Any] | None:
    """Both ends as Python's numbers, or tuples of them; None of traced ones. A float32 is the
    decimal number that it stands for, as 0.99 is within a bound of 0.99."""
    try:
        low, high = (np.asarray(end) for end in ends)
    except jax.errors.TracerArrayConversionError:
        return None
    return _decimal(low), _decimal(high)


def _decimal(end: np.ndarray) -> Any:
    """Numbers as Python's, by their shortest decimal form."""
    return tuple(float(str(number)) for number in end) if end.ndim else float(str(end[()]))


def _check_queue(name: str, ends: Any, config: RandomizationConfig) -> None:
    """Refuses a range for which the queue is too short: its delays would be cut off."""
    decisive, of_what = _QUEUES[name]
    asked = ends[decisive]
    room = getattr(config, name)[decisive]
    is_beyond = asked > room if decisive else asked < room
    if is_beyond:
        bound = "up to" if decisive else "down to"
        raise UserError(
            f"{_SOURCE}: {name} goes {bound} {asked:g}, but the queue of {of_what} is as long as "
            f"the config needs, for {room:g}; give env.randomization.{name} the widest range"
        )
