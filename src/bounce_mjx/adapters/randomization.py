"""The domain randomisation of brax and MuJoCo Playground on this project's physics.

Their `randomization_fn` returns a MuJoCo model with a batch axis in some fields. The entries that
differ between environments become `PhysicsParameters.entries`; the fused engine refuses those that
it does not read.
"""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.deploy.environments import refuse_warmup
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.physics.edited import INSEPARABLE, edited
from bounce_mjx.physics.parameters import MODEL_PARAMETERS, PhysicsParameters
from bounce_mjx.physics.scalars import scalars_of
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.robot.numbers import field_of
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.world.randomization import TERMS, RandomizationConfig
from bounce_mjx.world.sampling import nominal_values, physics_parameters, sample_world

Fields = dict[str, Any]
"""Arrays of a model by their names, such as `body_mass` and `opt.gravity`."""


@functools.cache
def default_terms() -> RandomizationConfig:
    """The terms of `configs/randomized.yaml` that change the model."""
    preset = read_preset(Path("randomized")).env.randomization
    ranges = {name: getattr(preset, name) for name in preset.terms if TERMS[name].parameter}
    return RandomizationConfig(**ranges)


def domain_randomize(
    mj_model: mujoco.MjModel,
    model: Any,
    rng: jax.Array,
    config: RandomizationConfig | None = None,
) -> tuple[Any, Any]:
    """A `randomization_fn` of brax and Playground that samples terms of `env.randomization`, once
    its first argument is bound (`functools.partial`).

    Args:
      mj_model: the environment's model.
      model: brax's system or MJX's model of it; brax's draws some shapes in another size.
      rng: keys [B].
      config: ranges and shares of the terms, of which only those that change the physics act; None
        for `default_terms`.

    Returns:
      The model with a batch axis in the changed fields, and the axes for `jax.vmap`. What follows
      from them, such as an inertia from a mass, is not in it: this project's environments derive it
      (`parameters_of`).

    Raises:
      UserError: the ranges would have to grow, which those of a model cannot; or the model is of
        another robot.
    """
    config = config or default_terms()
    refuse_warmup(config, "a randomization_fn")
    if config.ball_inertia is not None:
        raise UserError(
            "the randomisation has ball_inertia, but a randomization_fn has no inertia of a ball, "
            "which this project's environments derive; leave it out, or set env.ball_inertia"
        )
    masses = np.asarray(model.body_mass)
    if masses.shape != mj_model.body_mass.shape or not np.allclose(masses, mj_model.body_mass):
        raise UserError(
            "the model to randomise is of another robot than the mj_model; bind "
            "adapters.randomization.domain_randomize to the mj_model of its environment"
        )
    addresses = find_addresses(mj_model)
    num_joints = len(addresses.arm_joints)
    ranges = config.ranges()
    nominals = nominal_values(mj_model, config.terms, addresses)
    dtype = jnp.result_type(float)

    def sample(key: jax.Array) -> Fields:
        world = sample_world(
            ranges, key, dtype, num_joints, nominals, config.share, config.shares or {}
        )
        parameters = scalars_of(physics_parameters(world, mj_model), dtype)
        world_model = edited(mj_model, addresses, parameters)
        fields = {}
        for name in world_model.fields:
            # A field that only follows from others has none.
            rows = world_model.rows(name)
            if rows:
                values = jnp.asarray(field_of(model, name))
                is_edited = np.isin(np.arange(len(values)), rows)
                is_edited = is_edited.reshape(-1, *[1] * (values.ndim - 1))
                fields[name] = jnp.where(is_edited, world_model.array(name), values)
        return fields

    fields = jax.jit(jax.vmap(sample))(rng)
    axes = jax.tree.map(lambda _: None, model)
    return model.tree_replace(fields), axes.tree_replace(dict.fromkeys(fields, 0))


def parameters_of(base: Any, model: Any) -> PhysicsParameters:
    """The entries of one environment's randomised model that differ from the environment's own.

    What MuJoCo's compiler derives from them, such as an inertia from a mass, follows by itself. The
    physics refuses the name of an entry that is none of MuJoCo's.

    Args:
      base: the environment's own brax system or MJX model.
      model: `base` with other values, as in `jax.vmap` over a batch of models.

    Raises:
      UserError: the values are not known.
    """
    before = dict(_fields_of(base))
    changed = {
        name: value
        for name, value in _fields_of(model)
        if value is not before[name] and not _equal(value, before[name])
    }
    entries = {}
    for name, batch in _batches(changed).items():
        # Of an entry that varies, the value of this environment is in the model.
        varied = np.any(batch != np.asarray(before[name]), axis=0)
        if name in INSEPARABLE:
            varied |= varied.any(axis=1, keepdims=True)
        if name == "pair_friction":
            # The second tangent's number follows from the first one's (`physics.friction`), and the
            # rest has no effect on a pair without torsional friction.
            varied[:, 1] &= np.any(batch[:, :, 1] != batch[:, :, 0], axis=0)
            varied[:, 2:] = False
        for index in np.argwhere(varied).tolist():
            entries[f"{name}[{', '.join(map(str, index))}]"] = changed[name][tuple(index)]
    return PhysicsParameters(entries=entries or None)


def randomized_env(env: Env, base: Any, model: Any) -> Env:
    """The environment in the physics of a randomised model; itself if the model changes nothing.

    The models and the errors are those of `parameters_of`.
    """
    parameters = parameters_of(base, model)
    if parameters == MODEL_PARAMETERS:
        return env
    return Env(env.config, randomize=lambda key: parameters)


def _fields_of(model: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names and values of a model's fields, and of the structures in it."""
    for field in dataclasses.fields(model):
        value = getattr(model, field.name)
        if dataclasses.is_dataclass(value):
            yield from _fields_of(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value


def _equal(a: Any, b: Any) -> bool:
    leaves = jax.tree.leaves(a)
    others = jax.tree.leaves(b)
    if any(isinstance(x, jax.core.Tracer) for x in leaves):
        return False
    return len(leaves) == len(others) and all(map(np.array_equal, leaves, others))


def _batches(fields: Fields) -> Fields:
    """The values [B, ...] of the fields in all environments, or [1, ...] where these share one.

    Inside `jax.vmap`, the value of one environment is a tracer. The vmap rule of a function gets
    the array behind it, with all environments.

    Raises:
      UserError: the values are not known while the program is traced.
    """
    batches = {}

    @jax.custom_batching.custom_vmap
    def probe(arrays: list[jax.Array]) -> list[jax.Array]:
        return arrays

    @probe.def_vmap
    def look(axis_size: int, in_batched: Any, arrays: list[jax.Array]) -> Any:
        for name, array, batched in zip(traced, arrays, in_batched[0], strict=True):
            if isinstance(array, jax.core.Tracer):
                # Inside `jax.jit` too, where nobody knows the numbers.
                break
            batches[name] = np.asarray(array) if batched else np.asarray(array)[None]
        return arrays, in_batched[0]

    traced = [name for name, value in fields.items() if isinstance(value, jax.core.Tracer)]
    if traced:
        # For its vmap rule alone, which fills `batches`.
        probe([fields[name] for name in traced])
    if batches.keys() != set(traced):
        raise UserError(
            "randomization_fn was called inside jax.jit, so its values cannot be checked; wrap the "
            "environment outside it"
        )
    for name in fields.keys() - batches.keys():
        batches[name] = np.asarray(fields[name])[None]
    return batches
