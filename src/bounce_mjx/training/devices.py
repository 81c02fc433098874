"""Training on several devices: a mesh that divides the environments or the seeds.

The program is the same on any number of devices: arrays over the environments are sharded along
their batch axis, all other arrays are replicated, and XLA adds the reductions of gradients and
statistics.
"""

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.ppo import TrainingState, num_groups

_AXIS = "devices"


def make_mesh(num_devices: int | None, config: PPOConfig, num_seeds: int = 1) -> Mesh:
    """A mesh of the first `num_devices` devices.

    Args:
      num_devices: number of devices; None means one, or all devices if there are several hosts.

    Raises:
      UserError: there are fewer devices, or the environments (one seed) or the seeds (several)
        cannot be divided among them, or a device of some host would be unused.
    """
    devices = jax.devices()
    if num_devices is None:
        num_devices = 1 if jax.process_count() == 1 else len(devices)
    if num_devices > len(devices):
        raise UserError(
            f"num_devices is {num_devices}, but there are {len(devices)} "
            f"({devices[0].device_kind}); choose at most that"
        )
    if jax.process_count() > 1 and num_devices < len(devices):
        raise UserError(
            f"num_devices is {num_devices}, but the hosts have {len(devices)} and use all; omit it"
        )
    if num_seeds > 1:
        shared, name, advice = num_seeds, f"num_seeds {num_seeds}", f"a multiple of {num_devices}"
    else:
        shared, name = num_groups(config), f"num_envs {config.num_envs}"
        multiple = f"a multiple of {num_devices} * num_minibatches as num_envs"
        advice = f"a power of two as num_devices, and {multiple}"
    if shared % num_devices:
        raise UserError(f"{name} cannot be divided among {num_devices} devices; choose {advice}")
    return Mesh(devices[:num_devices], (_AXIS,))


def replicated(mesh: Mesh) -> NamedSharding:
    """Sharding of arrays that every device holds in full."""
    return NamedSharding(mesh, PartitionSpec())


def state_sharding(mesh: Mesh, state: TrainingState, num_seeds: int = 1) -> TrainingState:
    """Shardings of a training state. With several seeds each device holds some of them; with one
    seed each device holds some environments and everything else.

    Args:
      state: the state or its shapes; with several seeds, the seeds are the first axis.
    """
    if num_seeds > 1:
        return jax.tree.map(lambda _: NamedSharding(mesh, PartitionSpec(_AXIS)), state)
    shardings = jax.tree.map(lambda _: replicated(mesh), state)

    def batch_last(x: jax.Array) -> NamedSharding:
        return NamedSharding(mesh, PartitionSpec(*[None] * (x.ndim - 1), _AXIS))

    return shardings._replace(env=jax.tree.map(batch_last, state.env))
