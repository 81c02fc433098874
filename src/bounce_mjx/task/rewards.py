"""Reward terms: settings with a weight, and a formula.

`Task.step` returns the weighted terms by name, however it computes them; the metrics
`reward/<name>`, the log and the report follow. The tasks of the package make them from settings: a
group, the config's `reward`, in which each field whose type is a subclass of `RewardTerm` is a term
(`weighted_terms`). Then the config and the flags follow as well. To add a term, extend the group by
a field, the task's `Config` by that group, and the task by that `Config`. That is enough in
`bounce`, whose terms share their inputs. The other tasks give each term its own, and know their own
terms alone: keep their group, and extend `step` by a term that it adds to the result's `reward`.
"""

from __future__ import annotations

import typing
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
        raise UserError(
            f"the reward term {type(self).__name__} has no method value; write one, which returns "
            "the unweighted term"
        )


class Near(RewardTerm):
    """A term that falls with the length of an error: weight / (1 + (length / scale)^2)."""

    scale: Positive = 0.03
    """Length at half the weight, in the unit of the error."""

    def value(self, error: jax.Array) -> jax.Array:
        """The unweighted term [] for an error of any shape."""
        return 1.0 / (1.0 + jnp.sum(jnp.square(error)) / self.scale**2)


class Gaussian(RewardTerm):
    """A term that falls with an error: weight * exp(-error^2 / (2 scale^2))."""

    scale: Positive = 0.05
    """Width, in the unit of the error."""

    def value(self, error: jax.Array) -> jax.Array:
        """The unweighted term [] for an error []."""
        return gaussian(error, self.scale)


class Proportional(RewardTerm):
    """A term proportional to a number; a negative weight makes it a penalty."""

    def value(self, number: jax.Array) -> jax.Array:
        """The number [] itself."""
        return 1.0 * number


def term_names(reward: type[StrictModel]) -> tuple[str, ...]:
    """Names of the terms in a group of settings, in order: of the fields whose type is a subclass
    of `RewardTerm`.

    Raises:
      UserError: a field may be a term or something else.
    """
    names = []
    for name, field in reward.model_fields.items():
        if _is_term(field.annotation):
            names.append(name)
        elif any(map(_is_term, typing.get_args(field.annotation))):
            raise UserError(
                f"{name} in {reward.__name__} may be a term of the reward or something else; give "
                "it the type of one term, which the weight 0 turns off"
            )
    return tuple(names)


def _is_term(annotation: Any) -> bool:
    """Whether a type is that of a term."""
    return isinstance(annotation, type) and issubclass(annotation, RewardTerm)


def weighted_terms(
    reward: StrictModel, inputs: Any = None, **term_inputs: Any
) -> dict[str, jax.Array]:
    """Each term [] times its weight; their sum is the reward.

    Args:
      inputs: what the formula of every term takes that is not in `term_inputs`. Leave it out where
        `term_inputs` has every term, or where no formula needs any.
      term_inputs: by a term's name, what its formula takes instead.

    Raises:
      UserError: a name of `term_inputs` is no term, a term has no inputs or returns nothing, or a
        ready-made one gets something else than numbers.
    """
    names = term_names(type(reward))
    provided = set(term_inputs)
    for_all_terms = inputs is not None or not term_inputs
    if for_all_terms:
        provided.update(names)
    check_names("weighted_terms", "term of the reward", provided, names)
    weighted = {}
    for name in names:
        term = getattr(reward, name)
        given = term_inputs.get(name, inputs)
        _check_numbers(name, term, given)
        value = term.value(given)
        if value is None:
            raise UserError(
                f"the reward term {name}, a {type(term).__name__}, returns None; return one number"
            )
        weighted[name] = term.weight * value
    return weighted


def _check_numbers(name: str, term: RewardTerm, given: Any) -> None:
    """Refuses anything but numbers for a ready-made term, such as the inputs of other terms."""
    is_ready_made = type(term).value in (Near.value, Gaussian.value, Proportional.value)
    is_number = isinstance(given, int | float) or hasattr(given, "shape")
    if is_ready_made and not is_number:
        raise UserError(
            f"the term {name} is a {type(term).__name__}, which takes a number, and gets "
            f"{shorten(type(given).__name__)}; give it by the term's name: weighted_terms(..., "
            f"{name}=NUMBER)"
        )


def check_names(code: str, kind: str, names: Collection[str], expected: Collection[str]) -> None:
    """Compares the names in a task's code with those that there are.

    Args:
      code: the code, for the error.
      kind: what the names stand for, for the error.
      names: the names in the code.
      expected: the names that there are, each of which it needs.

    Raises:
      UserError: a name is unknown or missing.
    """
    unknown = sorted(set(names) - set(expected))
    missing = sorted(set(expected) - set(names))
    listed = ", ".join(sorted(set(expected))) or "none"
    if unknown:
        raise UserError(
            f"{code} names a {kind} that there is not, {shorten(unknown[0])}; there are: {listed}"
        )
    if missing:
        raise UserError(f"{code} lacks the {kind} {shorten(missing[0])}; there are: {listed}")


def gaussian(error: jax.Array, scale: jax.Array | float) -> jax.Array:
    """exp(-error^2 / (2 scale^2)), for an error and a width in the same unit."""
    return jnp.exp(-jnp.square(error) / (2.0 * jnp.square(scale)))


def safe_sqrt(number: jax.Array) -> jax.Array:
    """Square root of max(0, number), whose derivative is 0 for a number <= 0.

    The derivative of `jnp.sqrt` is infinite at 0. Multiplied by the zero of a branch that is not
    taken, it would make the whole gradient NaN.
    """
    positive = number > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, number, 1.0)), 0.0)


def length(vector: jax.Array) -> jax.Array:
    """Length [] of a vector [n]; its derivative is 0 where it is 0."""
    return safe_sqrt(jnp.sum(jnp.square(vector)))


def horizontal_distance(a: jax.Array, b: jax.Array) -> jax.Array:
    """Distance [] between two points [2 or 3] in x and y; its derivative is 0 where they
    coincide."""
    return safe_sqrt(jnp.square(a[0] - b[0]) + jnp.square(a[1] - b[1]))


def changes(joint_velocities: jax.Array, action: jax.Array, last_action: jax.Array) -> jax.Array:
    """The joint velocities [n], and the change of the action [n], as one vector [2 n]: of a calm
    arm, both are small."""
    return jnp.concatenate([joint_velocities, action - last_action])
