"""Kernels under `jax.vmap` and on several devices."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.custom_partitioning import custom_partitioning
from jax.sharding import NamedSharding, PartitionSpec


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
    """`function`, which each of several devices applies to its shard; in the program of one device,
    it is the function itself.

    Args:
      specs: computes the partitions of the arguments and of the results from the partition of the
        first argument.
      sharding_rule: see `jax.experimental.custom_partitioning`.
      replicated: the axes of the rule that are never sharded.
      sizes: size of each axis in the rule that is only part of an array's axis.
    """
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
