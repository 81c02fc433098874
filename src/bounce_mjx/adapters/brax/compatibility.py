"""What brax's own trainers need from this side to run on a newer jax.

brax 0.14.2 calls `jax.device_put_replicated` in `brax.training.agents.ppo.train`, but jax 0.10
removed that function. This file is the one place that gives it back. Nothing else in the package
uses it, as the package's own trainer (`ppo.py`) does not need it.
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
    """Within it, `brax.training.agents.ppo.train.train` runs on a jax that lacks
    `jax.device_put_replicated`; a jax that has the function is left as it is.

    Not for several threads at once: the function is added to the module `jax` and removed again.
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
    if not devices:
        raise ValueError("no devices to copy to; give at least one, such as jax.local_devices()")
    mesh = jax.sharding.Mesh(np.array(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
    return jax.tree.map(
        lambda leaf: jax.device_put(jnp.stack([jnp.asarray(leaf)] * len(devices)), sharding), tree
    )
