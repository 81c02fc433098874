"""How a kernel meets `jax.vmap` and several devices."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.custom_partitioning import custom_partitioning
from jax.sharding import NamedSharding, PartitionSpec


def batch_by(function: Callable[..., tuple], batched: Callable[..., tuple]) -> Callable[..., tuple]:
    """`function`, of which `batched` computes a batch.

    Args:
      batched: takes the arguments with the batch's axis in front, and puts it in front of results.
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
    """`function`, which each of several devices computes on its shard.

    Args:
      specs: the partitions of the arguments and of the results, from the first argument's.
      sharding_rule: see `jax.experimental.custom_partitioning`.
      replicated: the axes of the rule that are never divided.
      sizes: of an axis in the rule that is part of an array's axis.
    """
    # On one device a partitioning would only keep the program out of the compilation cache.
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
