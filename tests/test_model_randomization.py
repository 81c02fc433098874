"""`adapters/randomization.py`: a randomised MuJoCo model as parameters of the physics."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from bounce_mjx.adapters.randomization import domain_randomize, mixed_solref, parameters_of
from bounce_mjx.errors import UserError
from bounce_mjx.physics.parameters import PhysicsParameters, direct_solref, edited_model
from random_worlds import random_parameters

BATCH = 3


@pytest.fixture(scope="module")
def base(mj_model) -> mjx.Model:
    return mjx.put_model(mj_model)


def batch_of(base: mjx.Model, **fields: np.ndarray) -> tuple[mjx.Model, mjx.Model]:
    """What a `randomization_fn` returns: the model with new fields [B, ...], and the axes."""
    axes = jax.tree.map(lambda _: None, base).tree_replace(dict.fromkeys(fields, 0))
    return base.tree_replace(
        {name: jnp.asarray(x, jnp.float32) for name, x in fields.items()}
    ), axes


def read(mj_model: mujoco.MjModel, base: mjx.Model, **fields: np.ndarray) -> PhysicsParameters:
    model, axes = batch_of(base, **fields)
    return jax.jit(
        lambda: jax.vmap(lambda one: parameters_of(mj_model, base, one), in_axes=(axes,))(model)
    )()


def scaled(array: np.ndarray) -> np.ndarray:
    """B arrays, the first one unchanged."""
    return np.stack([array * factor for factor in (1.0, 1.1, 0.9)])


FIELDS = {
    "ball_mass": ["body_mass", "body_inertia", "body_invweight0", "dof_M0", "body_subtreemass"],
    "ball_radius": ["geom_size", "geom_rbound", "geom_aabb", "body_inertia"],
    "contact_stiffness": ["pair_solref"],
    "contact_damping": ["pair_solref"],
    "contact_friction": ["pair_friction"],
    "servo_gain": ["actuator_gainprm", "actuator_biasprm"],
    "servo_damping": ["actuator_biasprm"],
    "force_limit": ["actuator_forcerange"],
    "armature": ["dof_armature"],
    "damping": ["dof_damping"],
    "frictionloss": ["dof_frictionloss"],
    "link_mass": ["body_mass", "body_inertia"],
    "paddle_position": ["geom_pos"],
    "paddle_rotation": ["geom_quat"],
    "gravity": ["opt.gravity"],
}


def test_every_parameter_has_a_field():
    assert set(FIELDS) == set(PhysicsParameters._fields)


def test_parameters_are_read_back_from_edited_models(mj_model, base):
    """The models of `edited_model`, which is the reference of every engine, give back the
    parameters with which they were made, one parameter at a time and all together."""
    drawn = random_parameters(mj_model, BATCH, seed=1)
    drawn = drawn._replace(
        contact_friction=np.array([0.1, 0.2, 0.3]),
        frictionloss=np.full((BATCH, 6), 0.5),
        force_limit=np.full((BATCH, 6), 30.0),
    )
    cases = [(name,) for name in FIELDS] + [tuple(FIELDS)]
    for names in cases:
        given = PhysicsParameters(**{name: getattr(drawn, name) for name in names})
        models = [
            edited_model(mj_model, jax.tree.map(lambda x, i=i: np.asarray(x)[i], given))
            for i in range(BATCH)
        ]
        fields = {
            field: np.stack([_field(model, field) for model in models])
            for name in names
            for field in FIELDS[name]
        }
        result = read(mj_model, base, **fields)
        for name in names:
            np.testing.assert_allclose(
                getattr(result, name), getattr(given, name), rtol=1e-4, err_msg=name
            )
        if names != tuple(FIELDS) and names[0] not in ("contact_stiffness", "contact_damping"):
            assert {n for n, x in result._asdict().items() if x is not None} == set(names)


def _field(model: mujoco.MjModel, name: str) -> np.ndarray:
    owner, _, field = name.rpartition(".")
    return np.array(getattr(getattr(model, owner) if owner else model, field))


def test_friction_of_the_geoms_is_that_of_their_contact(mj_model, base):
    """A contact has the larger friction of its two geoms."""
    friction = np.array([base.geom_friction] * BATCH)
    friction[:, :, 0] = np.array([0.0, 0.3, 0.5])[:, None]
    friction[2, mj_model.geom("blocker").id, 0] = 0.2
    result = read(mj_model, base, geom_friction=friction)
    np.testing.assert_allclose(result.contact_friction, [0.0, 0.3, 0.5])


@pytest.mark.parametrize("second", [(0.004, 0.5), (-9e4, -25.0)], ids=["standard", "direct"])
def test_solref_of_the_geoms_is_that_of_their_contact(second):
    """MuJoCo's own contact of two geoms without a pair is the reference."""
    xml = """
      <mujoco><worldbody>
        <geom name="a" size="0.1" solref="0.006 0.8" solmix="2"/>
        <body pos="0.1 0 0"><freejoint/><geom name="b" size="0.1" solref="{} {}"/></body>
      </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml.format(*second))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mixed = mixed_solref(model, (0, 1), *jnp.asarray(model.geom_solref))
    np.testing.assert_allclose(mixed, data.contact.solref[0], rtol=1e-6)


def test_standard_solref_becomes_direct(mj_model, base):
    solref = (
        np.tile(np.array([0.003, 0.1]), (BATCH, 1, 1)) * np.array([1.0, 1.1, 1.2])[:, None, None]
    )
    result = read(mj_model, base, pair_solref=solref)
    for i in range(BATCH):
        model = copy.copy(mj_model)
        model.pair_solref[:] = solref[i]
        np.testing.assert_allclose(
            (result.contact_stiffness[i], result.contact_damping[i]),
            direct_solref(model),
            rtol=1e-5,
        )


def test_equal_values_change_nothing(mj_model, base):
    """A function that only gives every field a batch axis is not a randomisation."""
    fields = {name: np.stack([getattr(base, name)] * 2) for name in ("qpos0", "body_mass")}
    assert read(mj_model, base, **fields) == PhysicsParameters()


REFUSED = {
    "qpos0": ("qpos0", ("qpos0, which this physics cannot vary", "leave it out")),
    "floor": ("geom_size", (r"geom_size\[\d+, 0\]",)),
    "gain without bias": ("actuator_gainprm", (r"actuator_biasprm\[0, 1\]",)),
    "inertia without mass": ("body_inertia", (r"body_inertia\[1, 0\]",)),
    "colour": ("geom_rgba", ("geom_rgba",)),
}


@pytest.mark.parametrize("field, words", REFUSED.values(), ids=REFUSED)
def test_changes_without_a_parameter_are_refused_by_name(field, words, mj_model, base):
    one = np.asarray(getattr(base, field))
    changed = np.stack([one, 1.1 * one + (0.1 if field == "qpos0" else 0.0)])
    with pytest.raises(UserError) as refused:
        read(mj_model, base, **{field: changed})
    for word in words:
        assert refused.match(word)


def test_damping_of_the_ball_is_refused(mj_model, base):
    damping = np.stack([np.asarray(base.dof_damping) + added for added in (0.0, 1.0)])
    with pytest.raises(UserError, match=r"dof_damping\[6\]"):
        read(mj_model, base, dof_damping=damping)
    damping[:, 6:] = 0.0
    np.testing.assert_array_equal(read(mj_model, base, dof_damping=damping).damping[1], 1.0)


def test_friction_of_the_floor_is_refused(mj_model, base):
    """Only the paddle touches the ball, so another geom's friction would change nothing."""
    friction = np.stack([base.geom_friction] * 2)
    friction[1, mj_model.geom("floor").id, 0] = 1.0
    with pytest.raises(UserError, match="geom_friction, .* no effect"):
        read(mj_model, base, geom_friction=friction)


def test_friction_of_geoms_and_of_the_pair_exclude_each_other(mj_model, base):
    with pytest.raises(UserError, match="geom_friction and pair_friction"):
        read(
            mj_model,
            base,
            geom_friction=scaled(np.asarray(base.geom_friction) + 0.1),
            pair_friction=scaled(np.asarray(base.pair_friction) + 0.1),
        )


def test_values_that_are_traced_are_refused(mj_model, base):
    """Without the values, a change without an effect could not be told."""
    model, axes = batch_of(base, body_mass=scaled(np.asarray(base.body_mass)))
    with pytest.raises(UserError, match="inside jax.jit"):
        jax.jit(jax.vmap(lambda one: parameters_of(mj_model, base, one), in_axes=(axes,)))(model)


def test_the_projects_randomiser_draws_within_its_ranges(mj_model, base):
    model, axes = domain_randomize(mj_model, base, jax.random.split(jax.random.PRNGKey(0), 32))
    result = jax.vmap(lambda one: parameters_of(mj_model, base, one), in_axes=(axes,))(model)
    share = np.asarray(result.ball_mass) / mj_model.body("ball_link").mass
    assert 0.7 <= share.min() < 0.8 and 1.2 < share.max() <= 1.3
    assert result.link_mass is None and result.contact_damping is not None
