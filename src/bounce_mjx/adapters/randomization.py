"""The domain randomisation of brax and MuJoCo Playground on this project's physics.

Their `randomization_fn` returns a MuJoCo model with a batch axis in some fields. Here these fields
become `PhysicsParameters`, and a field that no parameter expresses is refused by its name.

| field                                  | parameter                                               |
|----------------------------------------|---------------------------------------------------------|
| `body_mass`                            | masses of the ball and the links, with their inertia    |
| `geom_size`                            | radius of the ball, with its inertia                    |
| `geom_friction`, `pair_friction`       | sliding friction of ball and paddle (`condim="3"`)      |
| `geom_solref`, `pair_solref`           | stiffness and damping of the contact                    |
| `geom_pos`, `geom_quat`                | pose of the paddle on the last link                     |
| `actuator_gainprm`, `actuator_biasprm` | `kp` and `kv` of the servos                             |
| `actuator_forcerange`                  | force limits of the servos                              |
| `dof_armature`, `dof_damping`, `dof_frictionloss` | the same, of the arm's joints                |
| `opt.gravity`                          | gravity                                                 |

The friction and the solref of the two geoms act as in a contact without a pair.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.physics.parameters import (
    MODEL_PARAMETERS,
    PhysicsParameters,
    contact_pair,
    edited_fields,
    entries,
    link_bodies,
    to_direct_solref,
)
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.world.randomization import RandomizationConfig, draw_world, physics_parameters

# Fields that MuJoCo's compiler can compute from others.
_DERIVED_FIELDS = frozenset(
    (
        "actuator_acc0",
        "actuator_length0",
        "body_inertia",
        "body_invweight0",
        "body_subtreemass",
        "dof_M0",
        "dof_invweight0",
        "dof_length",
        "geom_aabb",
        "geom_rbound",
    )
)

Fields = dict[str, Any]
"""Arrays of a model by their names, such as `body_mass` and `opt.gravity`."""

DEFAULT = RandomizationConfig(
    restitution=(0.75, 0.95),
    ball_mass=(0.7, 1.3),
    ball_radius=(0.9, 1.1),
    servo_gain=(0.8, 1.2),
    gravity_tilt=(-0.035, 0.035),
)
"""The terms of `configs/robust.yaml` that change the model."""


def domain_randomize(
    mj_model: mujoco.MjModel,
    model: Any,
    rng: jax.Array,
    config: RandomizationConfig = DEFAULT,
) -> tuple[Any, Any]:
    """A `randomization_fn` of brax and Playground that draws terms of `env.randomization`.

    Args:
      mj_model: the environment's model.
      model: brax's system or MJX's model, made of it.
      rng: keys [B].
      config: ranges of the terms; only terms that change the physics act.

    Returns:
      The model with a batch axis in the changed fields, and the axes for `jax.vmap`.
    """

    num_joints = len(find_addresses(mj_model).arm_joints)

    def draw(key: jax.Array) -> Fields:
        world = draw_world(config.ranges(), key, jnp.result_type(float), num_joints)
        fields, options = edited_fields(mj_model, physics_parameters(world, mj_model))
        return fields | {f"opt.{name}": value for name, value in options.items()}

    fields = jax.jit(jax.vmap(draw))(rng)
    axes = jax.tree.map(lambda _: None, model)
    return model.tree_replace(fields), axes.tree_replace(dict.fromkeys(fields, 0))


def parameters_of(mj_model: mujoco.MjModel, base: Any, model: Any) -> PhysicsParameters:
    """The physics parameters of one environment's randomised model.

    Args:
      mj_model: the environment's model.
      base: brax's system or MJX's model, made of it.
      model: `base` with other values, as in `jax.vmap` over a batch of models.

    Raises:
      UserError: a changed field does not correspond to a parameter.
    """
    before = dict(_fields_of(base))
    changed = {
        name: value
        for name, value in _fields_of(model)
        if value is not before[name] and not _equal(value, before[name])
    }
    batches = _batches(changed)
    varied = {
        name: np.any(batch != np.asarray(before[name]), axis=0) for name, batch in batches.items()
    }
    varied = {name: mask for name, mask in varied.items() if mask.any()}
    contact = sorted(varied.keys() & _CONTACT_FIELDS)
    if len({name.split("_")[1] for name in contact}) < len(contact):
        raise UserError(
            f"randomization_fn changes {' and '.join(contact)}, and only the pair's value would "
            "act; change one of them"
        )
    sources = _sources(mj_model, contact_pair(mj_model) if contact else None)
    known = {source.field for source in sources}
    for name in sorted(varied.keys() - known - _DERIVED_FIELDS):
        raise UserError(
            f"randomization_fn changes {name}, which this physics cannot vary between "
            f"environments; leave it out, or change {', '.join(sorted(known))}"
        )
    acting = [s for s in sources if s.field in varied and varied[s.field][s.index].any()]
    _check_effect(mj_model, before, batches, varied, acting)
    # Entries of these fields may change without an effect in MuJoCo too.
    silent = varied.keys() & {*_CONTACT_FIELDS, "body_mass"}
    for name in sorted(silent - {source.field for source in acting}):
        raise UserError(
            f"randomization_fn changes {name}, but not the entries of the ball, the paddle or the "
            "links, so it would have no effect; change those, or leave it out"
        )
    return _read(acting, changed, jnp)


def randomized_task(task: Env, mj_model: mujoco.MjModel, base: Any, model: Any) -> Env:
    """The environment in the physics of a randomised model; itself if the model changes nothing.

    The arguments after the task, and the errors, are those of `parameters_of`.
    """
    parameters = parameters_of(mj_model, base, model)
    if parameters == MODEL_PARAMETERS:
        return task
    return Env(task.config, randomize=lambda key: parameters)


class _Source(NamedTuple):
    """The entries of a field that hold parameters."""

    field: str
    index: Any
    read: Callable[[Any, ModuleType], Fields]
    """(entries, numpy or jax.numpy) -> parameters by name."""


_CONTACT_FIELDS = {"geom_friction", "geom_solref", "pair_friction", "pair_solref"}


def _sources(mj_model: mujoco.MjModel, pair: int | None) -> list[_Source]:
    """Every source of a parameter; `pair` is the contact pair, if a contact field varies."""
    m, addresses = mj_model, find_addresses(mj_model)
    geoms = [addresses.ball_geom, addresses.paddle_geom]
    links = link_bodies(m)
    ends = np.cumsum([len(bodies) for bodies in links])[:-1]

    def alone(parameter: str, sign: float = 1.0) -> Callable[[Any, ModuleType], Fields]:
        return lambda x, xp: {parameter: sign * x}

    def contact(solref: Any, xp: ModuleType) -> Fields:
        direct = to_direct_solref(solref, m.opt.timestep, xp)
        return dict(zip(("contact_stiffness", "contact_damping"), direct, strict=True))

    plain = {}
    for name, field, index, sign in entries(addresses):
        plain.setdefault(name, _Source(field, index, alone(name, sign)))
    return [
        *plain.values(),
        _Source("body_mass", addresses.ball_body, alone("ball_mass")),
        _Source("geom_size", (addresses.ball_geom, 0), alone("ball_radius")),
        _Source("opt.gravity", slice(None), alone("gravity")),
        _Source(
            "body_mass",
            np.concatenate(links),
            lambda x, xp: {"link_mass": xp.stack([part.sum() for part in xp.split(x, ends)])},
        ),
        _Source("pair_friction", (pair, slice(0, 2)), lambda x, xp: {"contact_friction": x[0]}),
        _Source(
            "geom_friction",
            (geoms, 0),
            lambda x, xp: {"contact_friction": _combined(m, geoms, x)},
        ),
        _Source("pair_solref", pair, contact),
        _Source("geom_solref", geoms, lambda x, xp: contact(mixed_solref(m, geoms, *x, xp), xp)),
    ]


def _read(sources: Sequence[_Source], fields: Fields, xp: ModuleType) -> PhysicsParameters:
    """The parameters of one environment from the fields of its model.

    Args:
      xp: numpy or jax.numpy, for the arrays.
    """
    given = {}
    for source in sources:
        given |= source.read(xp.asarray(fields[source.field])[source.index], xp)
    return PhysicsParameters(**given)


def _combined(mj_model: mujoco.MjModel, geoms: list[int], values: jax.Array) -> jax.Array:
    """Friction [] of a contact of two geoms with the frictions [2]: the larger value, or the value
    of the geom with the higher priority."""
    first, second = mj_model.geom_priority[geoms]
    if first == second:
        return values.max()
    return values[0] if first > second else values[1]


def mixed_solref(
    mj_model: mujoco.MjModel,
    geoms: Sequence[int],
    first: jax.Array,
    second: jax.Array,
    xp: ModuleType = jnp,
) -> jax.Array:
    """`solref` [2] of a contact of two geoms with their own ones [2]: the mean by `solmix` of two
    standard formats, and the smaller values if one has the direct format; a higher priority decides
    alone (MuJoCo's documentation, "Contact parameters")."""
    priority = mj_model.geom_priority[list(geoms)]
    if priority[0] != priority[1]:
        return first if priority[0] > priority[1] else second
    mix = mj_model.geom_solmix[list(geoms)]
    share = mix[0] / mix.sum() if mix.sum() > 0.0 else 0.5
    mean = share * first + (1.0 - share) * second
    return xp.where((first[0] > 0.0) & (second[0] > 0.0), mean, xp.minimum(first, second))


def _check_effect(
    mj_model: mujoco.MjModel,
    base: Fields,
    batches: Fields,
    varied: Fields,
    acting: Sequence[_Source],
) -> None:
    """Checks that the parameters give each changed entry its new value.

    Args:
      base: fields of the environment's model.
      batches: the changed fields with a batch axis, which may have the length 1.
      varied: masks of the changed entries.
      acting: sources of the parameters that change.

    Raises:
      UserError: an entry with an effect in MuJoCo would have none here.
    """
    names = list(varied)
    if "actuator_gainprm" in varied and "actuator_biasprm" not in varied:
        # A position servo needs kp in both.
        names.append("actuator_biasprm")
    silent = {name: _without_effect(mj_model, name) for name in names}
    for i in range(max(map(len, batches.values()), default=0)):
        fields = {name: batches[name][min(i, len(batches[name]) - 1)] for name in varied}
        edited, options = edited_fields(mj_model, _read(acting, fields, np))
        edited |= {f"opt.{name}": value for name, value in options.items()}
        for name in names:
            wanted = fields.get(name, np.asarray(base[name]))
            given = edited.get(name, np.asarray(base[name]))
            differs = np.abs(wanted - given) > 1e-4 * np.abs(wanted) + 1e-9
            wrong = differs & ~silent[name]
            if wrong.any():
                raise UserError(
                    f"randomization_fn changes {name}{np.argwhere(wrong)[0].tolist()} in a way "
                    "that no parameter of this physics expresses; leave it out, or see the table "
                    "in docs/jax.md"
                )


def _without_effect(mj_model: mujoco.MjModel, name: str) -> np.ndarray:
    """Mask of the entries of a field that have no effect of their own."""
    m, addresses = mj_model, find_addresses(mj_model)
    geoms = [addresses.ball_geom, addresses.paddle_geom]
    mask = np.zeros(m.opt.gravity.shape if name == "opt.gravity" else getattr(m, name).shape, bool)
    if name in ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0"):
        mask[0] = True  # the world
    elif name == "pair_friction":
        mask[contact_pair(m), 2:] = True  # torsion and rolling, which need condim 4 and 6
    elif name == "pair_solref":
        mask[contact_pair(m)] = True  # read in both formats, written in the direct one
    elif name in ("geom_friction", "geom_solref"):
        collides = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
        mask[~collides] = True
        mask[geoms] = True
    return mask


def _fields_of(model: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names and values of a model's fields, and of the structures in it."""
    for field in dataclasses.fields(model):
        value = getattr(model, field.name)
        if dataclasses.is_dataclass(value):
            yield from _fields_of(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value


def _equal(a: Any, b: Any) -> bool:
    leaves, others = jax.tree.leaves(a), jax.tree.leaves(b)
    if any(isinstance(x, jax.core.Tracer) for x in leaves):
        return False
    return len(leaves) == len(others) and all(map(np.array_equal, leaves, others))


def _batches(fields: Fields) -> Fields:
    """The values of the fields in all environments, the batch in front.

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
                break
            batches[name] = np.asarray(array) if batched else np.asarray(array)[None]
        return arrays, in_batched[0]

    traced = [name for name, value in fields.items() if isinstance(value, jax.core.Tracer)]
    if traced:
        probe([fields[name] for name in traced])
    if batches.keys() != set(traced):
        raise UserError(
            "randomization_fn was called inside jax.jit, so its values cannot be checked; wrap the "
            "environment outside it"
        )
    for name in fields.keys() - batches.keys():
        batches[name] = np.asarray(fields[name])[None]
    return batches
