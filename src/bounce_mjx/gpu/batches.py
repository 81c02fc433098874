"""Kernels under `jax.vmap` and on several devices."""

import contextlib
import contextvars
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.custom_partitioning import custom_partitioning
from jax.sharding import NamedSharding, PartitionSpec

_outer_axis: contextvars.ContextVar[int] = contextvars.ContextVar("outer_axis", default=0)


@contextlib.contextmanager
def outer_axis(size: int) -> Iterator[None]:
    """Tells that `jax.vmap` adds an axis of this size around all that is traced within. JAX first
    traces the functions of `batch_by` without it, and drops what it has traced."""
    token = _outer_axis.set(size)
    try:
        yield
    finally:
        _outer_axis.reset(token)


def is_dropped() -> bool:
    """Whether a function of `batch_by` is being traced without the outer axis."""
    return _outer_axis.get() > 0


def batch_by(function: Callable[..., tuple], batched: Callable[..., tuple]) -> Callable[..., tuple]:
    """`function`, with `batched` as its implementation under `jax.vmap`.

    Args:
      batched: takes the arguments with the batch axis in front, and returns the results with the
        batch axis in front.
    """
    call = jax.custom_batching.custom_vmap(function)

    @call.def_vmap
    def batch(axis_size: int, in_batched: list[bool], *args: jax.Array):
        args = [
            x if is_batched else jnp.broadcast_to(x, (axis_size, *x.shape))
            for x, is_batched in zip(args, in_batched, strict=True)
        ]
        with outer_axis(0 if axis_size == _outer_axis.get() else _outer_axis.get()):
            results = tuple(batched(*args))
        return results, (True,) * len(results)

    return call


def partition_by(
    function: Callable[..., Any],
    specs: Callable[[PartitionSpec], tuple[Any, Any]],
    sharding_rule: str,
    replicated: tuple[str, ...],
    **sizes: int,
) -> Callable[..., Any]:
    """`function`, which each of several devices applies to its shard.

    Args:
      specs: computes the partitions of the arguments and of the results from the partition of the
        first argument.
      sharding_rule: see `jax.experimental.custom_partitioning`.
      replicated: the axes of the rule that are never sharded.
      sizes: size of each axis in the rule that is only part of an array's axis.
    """
    # On one device, a custom partitioning would have no effect except to keep the program out of
    # the compilation cache.
    if jax.device_count() == 1:
        return function
    partitioned = custom_partitioning(function)

    def partition(mesh, arg_shapes, result_shape):
        del result_shape
        arguments, results = jax.tree.map(
            lambda spec: NamedSharding(mesh, spec),
            specs(arg_shapes[0].sharding.spec),
            is_leaf=lambda node: isinstance(node, PartitionSpec),
        )
        return mesh, function, results, arguments

    partitioned.def_partition(
        partition=partition,
        sharding_rule=sharding_rule,
        need_replication_factors=replicated,
        **sizes,
    )
    return partitioned
