"""Reward terms: settings with a weight, and a formula.

A task's reward is a group of settings, in which each field of a subclass of `RewardTerm` is a term.
The config, the flags, the metrics `reward/<field>`, the log and the report follow the fields. A
term is added by a subclass of the group with one more field.
"""

from __future__ import annotations

from collections.abc import Iterable
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
    terms = {name: getattr(reward, name) for name in term_names(type(reward))}
    missing = terms.keys() - own.keys() if own and inputs is None else set()
    check_names("weighted_terms", "term of the reward", own.keys() | terms.keys() - missing, terms)
    return {name: t.weight * t.value(own.get(name, inputs)) for name, t in terms.items()}


def check_names(what: str, kind: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Compares the names that a task's code gives with those that it has.

    Raises:
      UserError: a name is unknown or missing.
    """
    given, known = set(given), set(known)
    for name in sorted(given ^ known, key=lambda name: (name in known, name)):
        wrong = f"lacks the {kind}" if name in known else f"names a {kind} that there is not,"
        names = ", ".join(sorted(known)) or "none"
        raise UserError(f"{what} {wrong} {shorten(name)}; there are: {names}")


def gaussian(error: jax.Array, scale: jax.Array | float) -> jax.Array:
    """exp(-error^2 / (2 scale^2))."""
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
