"""`jax.device_put_replicated` for brax's trainers on a newer JAX.

brax 0.14.2 calls this function in `ppo.train`, `sac.train` and `apg.train`, but JAX 0.10 removed
it. The package's own trainer does not use it.
"""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_NAME = "device_put_replicated"


@contextlib.contextmanager
def device_put_replicated() -> Iterator[None]:
    """Provides `jax.device_put_replicated` inside a `with` block, where JAX lacks it.

    Not thread-safe: the function is added to the module `jax` and removed at the end.
    """
    if hasattr(jax, _NAME):
        yield
        return
    setattr(jax, _NAME, replicate)
    try:
        yield
    finally:
        delattr(jax, _NAME)


def replicate(tree: Any, devices: Sequence[jax.Device]) -> Any:
    """Copies every leaf [...] of a tree (arrays, numbers or random keys) to each of D devices.

    Returns:
      The tree with leaves [D, ...], slice i on device i.
    """
    mesh = jax.sharding.Mesh(np.array(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
    return jax.tree.map(
        lambda leaf: jax.device_put(jnp.stack([jnp.asarray(leaf)] * len(devices)), sharding), tree
    )
