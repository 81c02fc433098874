"""What a task's code returns, against the tree that is expected: structure, names, shapes, types.
The first difference is one sentence with the path, what it got, what is expected, and the line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.config.places import where_defined, where_raised
from bounce_mjx.errors import UserError, reason_of, shorten, suggest
from bounce_mjx.task.rewards import check_names


class Number(NamedTuple):
    """One number is expected: an array of the shape ()."""

    kind: type | None = None
    """Kind of its type, such as `jnp.floating`; None for any, also a number of Python's."""
    wanted: str = "one number, an array of the shape ()"
    """What to return, for the error."""


class Named(NamedTuple):
    """A mapping of any names to values of one kind is expected."""

    value: Any
    """What is expected of each."""


class Exactly(NamedTuple):
    """A mapping with these names is expected."""

    kind: str
    """What a name stands for, for the error."""
    values: Mapping[str, Any]
    """What is expected of each."""


class Like(NamedTuple):
    """A pytree is expected that is like another one: of its structure, shapes and types."""

    tree: Any
    source: str
    """What has the other one, for the error."""


ANY_NUMBER = Number()
FLOATING = Number(
    jnp.floating, "one number, a JAX array of the shape () and of a floating-point type"
)
TRUTH = Number(jnp.bool_, "one bool, such as height < 0")


class _Difference(Exception):
    """The first difference of what was returned from what is expected."""

    def __init__(self, path: str, given: str, wanted: str):
        self.path = path
        self.given = given
        self.wanted = wanted


class Code:
    """A method of a task, or another function of a user's, whose results are compared."""

    def __init__(self, function: Callable[..., Any], name: str):
        """Args:
        name: what it is, for errors, such as "step of the task Bounce".
        """
        self._function = function
        self._name = name

    def __call__(self, *args: Any) -> Any:
        """What it returns for its arguments.

        Raises:
          UserError: the code raises an error.
        """
        try:
            return self._function(*args)
        except UserError as error:
            place = where_raised(error, self._function)
            raise UserError(f"{error}{place}") from error
        except Exception as error:
            place = where_raised(error, self._function)
            raise UserError(
                f"{self._name}{place} ends in {_explained(error, args)}; correct it"
            ) from error

    def shapes(self, *args: Any) -> Any:
        """What it returns, as the shapes and types of its arrays: nothing is computed."""
        try:
            return jax.eval_shape(lambda: self(*args))
        except TypeError as error:
            raise self._no_array(error) from error

    def traced(
        self, arguments: Callable[[jax.Array], tuple[Any, ...]], number: jax.Array
    ) -> tuple[Any, bool]:
        """What it returns, as the shapes and types of its arrays, and whether it reads a number.

        Args:
          arguments: the number [] -> its arguments.
          number: the number; its value is not read.
        """
        trace = jax.make_jaxpr(lambda number: self(*arguments(number)), return_shape=True)
        try:
            program, shapes = trace(number)
        except TypeError as error:
            raise self._no_array(error) from error
        (variable,) = program.jaxpr.invars
        read = [*program.jaxpr.outvars]
        for equation in program.jaxpr.eqns:
            read += equation.invars
        return shapes, any(variable is other for other in read)

    def _no_array(self, error: TypeError) -> UserError:
        """The error of code that returns something else than arrays."""
        reason = shorten(reason_of(error), 200)
        return UserError(
            f"{self.named} returns something that is no array ({reason}); return arrays and numbers"
        )

    def pair(self, wanted: str, *args: Any) -> tuple[Any, Any]:
        """The two things that it returns for its arguments.

        Args:
          wanted: what the two are, for the error.
        """
        returned = self(*args)
        if not (isinstance(returned, tuple) and len(returned) == 2):
            raise UserError(f"{self.named} returns {described(returned)}; return {wanted}")
        return returned

    def compare(self, returned: Any, expected: Any, path: str = "") -> None:
        """Compares what it returned with what is expected: one of this module's classes, a
        `NamedTuple` of them, which the result is an instance of, or None for nothing in particular.

        Args:
          path: of what is compared in all that it returned, for the error.

        Raises:
          UserError: they differ.
        """
        try:
            _compare(returned, expected, path, self.named)
        except _Difference as difference:
            of_path = f" for {difference.path}" if difference.path else ""
            raise UserError(
                f"{self.named} returns {difference.given}{of_path}; return {difference.wanted}"
            ) from None

    @property
    def named(self) -> str:
        """What the code is, and its line."""
        return self._name + where_defined(self._function)


def _compare(given: Any, expected: Any, path: str, code: str) -> None:
    if isinstance(expected, Number):
        _compare_number(given, expected, path)
    elif isinstance(expected, Named):
        _check_mapping(given, path)
        for name, value in given.items():
            _compare(value, expected.value, _inner(path, name), code)
    elif isinstance(expected, Exactly):
        _check_mapping(given, path)
        place = f"{path} of {code}" if path else code
        check_names(place, expected.kind, given, expected.values)
        for name, value in expected.values.items():
            _compare(given[name], value, _inner(path, name), code)
    elif isinstance(expected, Like):
        _compare_trees(given, expected, path)
    elif expected is not None:
        if not isinstance(given, type(expected)):
            raise _Difference(path, described(given), f"a task.{type(expected).__name__}")
        for name, value in expected._asdict().items():
            _compare(getattr(given, name), value, name, code)


def _compare_number(given: Any, expected: Number, path: str) -> None:
    if has_shape(given):
        fits = given.shape == ()
        if expected.kind is not None:
            fits = fits and jnp.issubdtype(given.dtype, expected.kind)
    else:
        fits = expected.kind is None and isinstance(given, int | float)
    if not fits:
        raise _Difference(path, described(given), expected.wanted)


def _check_mapping(given: Any, path: str) -> None:
    if not isinstance(given, Mapping):
        raise _Difference(path, described(given), "a dictionary of one value for each name")


def _compare_trees(given: Any, expected: Like, path: str) -> None:
    """No loop of JAX could carry a tree of another kind."""
    if jax.tree.structure(given) != jax.tree.structure(expected.tree):
        raise _Difference(
            path,
            described(given),
            f"{described(expected.tree)} of the same structure as {expected.source}",
        )
    places, _ = jax.tree_util.tree_flatten_with_path(expected.tree)
    for (keys, old), new in zip(places, jax.tree.leaves(given), strict=True):
        old_type = _type_of(old)
        new_type = _type_of(new)
        if (new_type.shape, new_type.dtype) != (old_type.shape, old_type.dtype):
            raise _Difference(
                f"{path}{jax.tree_util.keystr(keys)}",
                described(new_type),
                f"{described(old_type)}, as {expected.source}",
            )


def _type_of(leaf: Any) -> Any:
    """Shape and type of an array, or of the array that a number would be."""
    return leaf if has_shape(leaf) else jax.eval_shape(lambda: jnp.asarray(leaf))


def _inner(path: str, name: Any) -> str:
    """The path of a value in a mapping."""
    return f"{path}[{name!r}]"


def has_shape(value: Any) -> bool:
    """Whether a value is an array, or stands for one."""
    return hasattr(value, "shape") and hasattr(value, "dtype")


def described(value: Any) -> str:
    """What a user's code returned, for an error."""
    if has_shape(value):
        return f"{value.dtype} of the shape {value.shape}"
    return "None" if value is None else shorten(f"a {type(value).__name__}")


def _explained(error: Exception, args: tuple[Any, ...]) -> str:
    """An error of a user's code in words: its type, its text and, of a name, the nearest that there
    is.

    Args:
      args: of the code.
    """
    kind = type(error).__name__
    if isinstance(error, jax.errors.ConcretizationTypeError):
        return (
            f"{kind}, as Python's if, and, or, while and float() need one value, and the code is "
            "traced for all; write jnp.where, & and |"
        )
    text = f"{kind}: {shorten(reason_of(error), 300)}"
    name = error.args[0] if isinstance(error, KeyError) and error.args else None
    if isinstance(name, str) and (near := suggest(name, _names_in(args))):
        text += f" ({near})"
    return text


def _names_in(args: tuple[Any, ...]) -> list[str]:
    """The names in the mappings among some arguments, and in their fields."""
    names = []
    for argument in args:
        parts = argument if isinstance(argument, tuple) else (argument,)
        for part in parts:
            if isinstance(part, Mapping):
                names += [name for name in part if isinstance(name, str)]
    return names
