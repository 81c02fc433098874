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
    copy: Callable[[Any], Any]
    """P -> copies that `gradient` needs as well, such as numbers of lower precision. The step that
    changes the parameters makes them, because on a GPU they then cost no kernel of their own."""
    shuffle: Callable[[Any, jax.Array, jax.Array, jax.Array], Any]
    """(samples of G groups, order [G, M, N / G] of M minibatches, mean [M] and standard deviation
    [M] of their advantages) -> data of the epoch."""
    gradient: Callable[[Any, Any, Any, jax.Array], tuple[Any, dict[str, jax.Array]]]
    """(P, its copies, data of the epoch, index of the minibatch [], int32) -> gradient in the form
    P, metrics [] with the norm of the gradient, "loss/gradient_norm"."""
