"""Reward terms: settings with a weight, and a formula.

`Task.step` returns the weighted terms by name, however it computes them; the metrics
`reward/<name>`, the log and the report follow. The tasks of the package make them from settings: a
group, the config's `reward`, in which each field of a subclass of `RewardTerm` is a term
(`weighted_terms`). Then the config and the flags follow as well, and a subclass of the group with
one more field adds a term.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from bounce_mjx.config.settings import Finite, Positive, StrictModel
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.lazy import jax, jnp


class RewardTerm(StrictModel):
    """A term of the reward: its weight, and the constants of its formula."""

    weight: Finite = 1.0
    """Weight of the term."""

    def value(self, inputs: Any) -> jax.Array:
        """The unweighted term [].

        Args:
          inputs: what the task gives to its terms.
        """
        raise NotImplementedError


class Near(RewardTerm):
    """A term that falls with the length of an error: weight / (1 + (length / scale)^2)."""

    scale: Positive = 0.03
    """Length at half the weight, in the unit of the error."""

    def value(self, error: jax.Array) -> jax.Array:
        """The unweighted term [] for an error [] or [...]."""
        return 1.0 / (1.0 + jnp.sum(jnp.square(error)) / self.scale**2)


class Gaussian(RewardTerm):
    """A term that falls with an error: weight * exp(-error^2 / (2 scale^2))."""

    scale: Positive = 0.05
    """Width, in the unit of the error."""

    def value(self, error: jax.Array) -> jax.Array:
        """The unweighted term [] for an error []."""
        return gaussian(error, self.scale)


class Proportional(RewardTerm):
    """A term proportional to a number."""

    def value(self, number: jax.Array) -> jax.Array:
        """The number [] itself."""
        return 1.0 * number


def term_names(reward: type[StrictModel]) -> tuple[str, ...]:
    """Names of the terms in a group of settings, in order."""
    return tuple(
        name
        for name, field in reward.model_fields.items()
        if isinstance(field.annotation, type) and issubclass(field.annotation, RewardTerm)
    )


def weighted_terms(reward: StrictModel, inputs: Any = None, **own: Any) -> dict[str, jax.Array]:
    """Each term [] times its weight; their sum is the reward.

    Args:
      inputs: what the formula of every term takes.
      own: by a term's name, what its formula takes instead.

    Raises:
      UserError: `own` has a name that is no term, or lacks one although there are no inputs.
    """
    names = term_names(type(reward))
    # Without `own`, the formulas may take no inputs at all.
    share_inputs = inputs is not None or not own
    provided = own.keys() | names if share_inputs else own.keys()
    check_names("weighted_terms", "term of the reward", provided, names)
    weighted = {}
    for name in names:
        term = getattr(reward, name)
        weighted[name] = term.weight * term.value(own.get(name, inputs))
    return weighted


def check_names(what: str, kind: str, given: Collection[str], known: Collection[str]) -> None:
    """Compares the names that a task's code gives with those that it has.

    Args:
      what: the code, for the error.
      kind: what the names stand for, for the error.

    Raises:
      UserError: a name is unknown or missing.
    """
    unknown = sorted(set(given) - set(known))
    missing = sorted(set(known) - set(given))
    names = ", ".join(sorted(set(known))) or "none"
    if unknown:
        raise UserError(
            f"{what} names a {kind} that there is not, {shorten(unknown[0])}; there are: {names}"
        )
    if missing:
        raise UserError(f"{what} lacks the {kind} {shorten(missing[0])}; there are: {names}")


def gaussian(error: jax.Array, scale: jax.Array | float) -> jax.Array:
    """exp(-error^2 / (2 scale^2)), for an error and a width in the same unit."""
    return jnp.exp(-jnp.square(error) / (2.0 * jnp.square(scale)))


def safe_sqrt(x: jax.Array) -> jax.Array:
    """Square root of max(0, x), whose derivative is 0 for x <= 0.

    The derivative of `jnp.sqrt` is infinite at 0. Multiplied by the zero of a branch that is not
    taken, it would make the whole gradient NaN.
    """
    positive = x > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def length(vector: jax.Array) -> jax.Array:
    """Length [] of a vector [n]; its derivative is 0 where it is 0."""
    return safe_sqrt(jnp.sum(jnp.square(vector)))


def horizontal_distance(a: jax.Array, b: jax.Array) -> jax.Array:
    """Distance [] between two points [2 or 3] in x and y; its derivative is 0 where they
    coincide."""
    return safe_sqrt(jnp.square(a[0] - b[0]) + jnp.square(a[1] - b[1]))
