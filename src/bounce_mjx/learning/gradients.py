"""The interface between PPO and an implementation of minibatch gradients."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax


class MinibatchGradients(NamedTuple):
    """An implementation of minibatch gradients, which may store the parameters in its own form
    P."""

    pack: Callable[[Any], Any]
    """Parameters of the two networks -> P; linear."""
    unpack: Callable[[Any], Any]
    """P -> parameters of the two networks; the inverse."""
    shuffle: Callable[[Any, jax.Array, jax.Array, jax.Array], tuple[Any, Any]]
    """(samples of G groups, order [G, M, N / G] of M minibatches, mean [M] and standard deviation
    [M] of their advantages) -> data of the epoch, data of each minibatch with M as first axis."""
    gradient: Callable[[Any, Any, Any], tuple[Any, dict[str, jax.Array]]]
    """(P, data of the epoch, data of one minibatch) -> gradient in the form P, metrics []."""
