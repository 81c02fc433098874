"""`adapters/randomization.py`: a randomised MuJoCo model as entries of the physics."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from against_c import assert_same_step, c_steps, converged, fused_steps, touching_states, world
from bounce_mjx.adapters.randomization import domain_randomize, parameters_of
from bounce_mjx.errors import UserError
from bounce_mjx.physics import Control, PhysicsState, make_engine
from bounce_mjx.physics.edited import edited_model
from bounce_mjx.physics.parameters import PhysicsParameters
from bounce_mjx.robot.model import load_model
from bounce_mjx.world.randomization import RandomizationConfig
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
    """The parameters of a batch, which the fused engine must accept."""
    model, axes = batch_of(base, **fields)
    engine = make_engine(mj_model, "fused")
    start = PhysicsState(jnp.asarray(mj_model.qpos0), jnp.zeros(mj_model.nv))

    def of_one(one: mjx.Model) -> PhysicsParameters:
        parameters = parameters_of(base, one)
        jax.eval_shape(
            lambda p: engine.step(p, start, Control(jnp.zeros(mj_model.nu)), 1), parameters
        )
        return parameters

    return jax.jit(lambda: jax.vmap(of_one, in_axes=(axes,))(model))()


def scaled(array: np.ndarray) -> np.ndarray:
    """B arrays, the first one unchanged."""
    return np.stack([array * factor for factor in (1.0, 1.1, 0.9)])


def field_of(model: mujoco.MjModel, name: str) -> np.ndarray:
    owner, _, field = name.rpartition(".")
    return np.array(getattr(getattr(model, owner) if owner else model, field))


FIELDS = (
    "body_mass geom_size pair_solref pair_friction actuator_gainprm actuator_biasprm "
    "actuator_forcerange dof_armature dof_damping dof_frictionloss geom_pos geom_quat opt.gravity"
).split()
DERIVED = "body_inertia body_invweight0 body_subtreemass dof_M0 geom_rbound".split()


@pytest.mark.slow
def test_models_of_parameters_are_read_back(mj_model, base):
    """The numbers of `edited_model`, given as a randomised model, give the same model again, one
    parameter at a time and all together; an inertia of the ball's own is refused there."""
    drawn = random_parameters(mj_model, BATCH, seed=1)._replace(
        contact_friction=np.array([0.1, 0.2, 0.3]),
        frictionloss=np.full((BATCH, 6), 0.5),
        force_limit=np.full((BATCH, 6), 30.0),
    )
    names = [name for name in PhysicsParameters._fields if name not in ("entries", "ball_inertia")]
    for given in (*((name,) for name in names), names):
        parameters = PhysicsParameters(**{name: getattr(drawn, name) for name in given})
        models = [edited_model(mj_model, world(parameters, i)) for i in range(BATCH)]
        fields = {name: np.stack([field_of(model, name) for model in models]) for name in FIELDS}
        result = read(mj_model, base, **fields)
        for i, model in enumerate(models):
            again = edited_model(mj_model, world(result, i))
            for name in (*FIELDS, *DERIVED, "pair_dim", "actuator_forcelimited"):
                np.testing.assert_allclose(
                    field_of(again, name), field_of(model, name), 1e-5, 1e-12, err_msg=name
                )


def test_the_inertia_of_a_lone_slide_follows(tmp_path):
    """MuJoCo takes the inertia of a joint that moves one body alone from the model."""
    scene = """<mujoco><worldbody>
        <body><joint name="lift" type="slide" axis="0 0 1" armature="{}"/>
          <geom name="blocker" type="box" size=".1 .1 .01" mass="{}"/></body>
        <body name="ball_link" pos="0 0 .5"><freejoint/>
          <geom name="ball" type="sphere" size=".02" mass=".0027"/></body>
      </worldbody><contact><pair geom1="blocker" geom2="ball"/></contact>
      <actuator><position joint="lift" kp="100" kv="1"/></actuator></mujoco>"""
    speeds = []
    parameters = PhysicsParameters(armature=np.array([5.0]), link_mass=np.array([3.0]))
    for numbers, given in (((1, 2), parameters), ((5, 3), PhysicsParameters())):
        (tmp_path / "lift.xml").write_text(scene.format(*numbers))
        model = edited_model(load_model(tmp_path / "lift.xml", 0.001), given)
        data = mujoco.MjData(model)
        data.ctrl[0] = 1.0
        mujoco.mj_step(model, data)
        speeds.append(data.qvel[0])
    assert speeds[0] == pytest.approx(speeds[1], rel=1e-12)


def test_terms_of_a_randomization_fn_have_their_shares(mj_model, base):
    """A term that an episode does not sample is the model's; a warm-up would never grow."""
    terms = {"ball_mass": (0.5, 2.0), "link_mass": (1.5, 2.0)}
    config = RandomizationConfig(**terms, share=0.0, shares={"link_mass": 1.0})
    model, axes = domain_randomize(mj_model, base, jax.random.split(jax.random.key(0), 8), config)
    ball = mj_model.body("ball_link").id
    assert axes.body_mass == 0
    np.testing.assert_allclose(model.body_mass[:, ball], mj_model.body_mass[ball], rtol=1e-6)
    assert np.all(model.body_mass[:, 2:7] > 1.4 * mj_model.body_mass[2:7])
    # What no term changes is the given model's own: brax's draws the handle in another size.
    sizes = base.geom_size.at[0].set(0.7)
    other = base.tree_replace({"geom_size": sizes})
    resized, _ = domain_randomize(
        mj_model,
        other,
        jax.random.split(jax.random.key(0), 8),
        RandomizationConfig(ball_radius=(0.5, 2.0)),
    )
    ball_geom = mj_model.geom("ball").id
    is_new = np.any(np.asarray(resized.geom_size != sizes), axis=(0, 2))
    assert np.flatnonzero(is_new).tolist() == [ball_geom]
    two = load_model(None, 0.001, num_balls=2)
    with pytest.raises(UserError, match="is of another robot than the mj_model; bind"):
        domain_randomize(two, base, jax.random.split(jax.random.key(0), 8), config)
    grows = RandomizationConfig(**terms, warmup_steps=100)
    with pytest.raises(
        UserError, match="a randomization_fn: .* warmup_steps, but its ranges do not grow"
    ):
        domain_randomize(mj_model, base, jax.random.split(jax.random.key(0), 8), grows)
    hollow = RandomizationConfig(**terms, ball_inertia=(0.4, 0.6))
    with pytest.raises(UserError, match="a randomization_fn has no inertia of a ball"):
        domain_randomize(mj_model, base, jax.random.split(jax.random.key(0), 8), hollow)


def test_a_pair_has_one_coefficient_of_friction(mj_model, base):
    """A randomised model has it along both tangents; another one along the second is refused."""
    friction = np.tile(mj_model.pair_friction, (BATCH, 1, 1))
    friction[:, 0, :2] = np.array([0.2, 0.5, 1.0])[:, None]
    friction[:, 0, 2] *= [1.0, 2.0, 3.0]  # without effect, as in MuJoCo
    given = read(mj_model, base, pair_friction=friction)
    assert list(given.entries) == ["pair_friction[0, 0]"]
    np.testing.assert_allclose(given.entries["pair_friction[0, 0]"], friction[:, 0, 0], rtol=1e-6)
    friction[0, 0, 1] = 0.3
    with pytest.raises(UserError, match=r"pair_friction\[0, 1\] would be another friction"):
        read(mj_model, base, pair_friction=friction)


@pytest.mark.slow
def test_entries_act_as_in_mujoco(mj_model, float64):
    """Random changes of every field that the fused engine reads, in one step against C."""
    count, rng = 48, np.random.default_rng(0)
    links, ball, paddle = range(2, 7), mj_model.body("ball_link").id, mj_model.geom("blocker").id
    changed = {f"body_mass[{body}]": mj_model.body_mass[body] for body in (*links, ball)}
    changed |= {
        f"body_inertia[{links[2]}, {i}]": mj_model.body_inertia[links[2], i] for i in (0, 1)
    }
    changed |= {f"body_pos[{body}, {i}]": 0.1 for body in links for i in range(3)}
    changed |= {f"body_invweight0[{ball}, 0]": mj_model.body_invweight0[ball, 0]}
    changed |= {f"geom_size[{mj_model.geom('ball').id}, 0]": 0.019}
    changed |= {f"geom_size[{paddle}, {i}]": mj_model.geom_size[paddle, i] for i in range(3)}
    changed |= {f"geom_pos[{paddle}, {i}]": 0.02 for i in range(3)}
    changed |= {f"pair_solref[0, {i}]": x for i, x in enumerate((0.01, 0.3))}
    changed |= {"pair_friction[0, 0]": 0.2}
    changed |= {f"opt.gravity[{i}]": x for i, x in enumerate((1.0, -1.0, -9.0))}
    for joint in range(6):
        changed |= {f"dof_damping[{joint}]": 3.0, f"dof_armature[{joint}]": 0.1}
        changed |= {f"jnt_stiffness[{joint}]": 40.0, f"qpos_spring[{joint}]": 0.3}
        changed |= {f"qpos0[{joint}]": 0.1, f"actuator_gainprm[{joint}, 0]": 2e4}
        changed |= {f"actuator_biasprm[{joint}, {i}]": x for i, x in enumerate((5.0, -1e4, -90.0))}
        changed |= {f"actuator_forcerange[{joint}, {i}]": x for i, x in enumerate((-90.0, 200.0))}
    changed |= {"dof_frictionloss[1]": 20.0}
    entries = {name: own * rng.uniform(0.7, 1.3, count) for name, own in changed.items()}
    parameters = PhysicsParameters(entries=entries)
    states = touching_states(mj_model, count, seed=4)
    models = []
    for i in range(count):
        models.append(converged(edited_model(mj_model, world(parameters, i))))
        for name, values in entries.items():
            field, _, index = name[:-1].partition("[")
            place = tuple(map(int, index.split(",")))
            assert field_of(models[i], field)[place] == values[i]
    expected, _ = c_steps(models, states)
    assert_same_step(fused_steps(mj_model, parameters, states), expected)


REFUSED = {
    "axis": ("jnt_axis", r"jnt_axis\[0, 2\]"),
    "floor": ("geom_size", r"geom_size\[\d+, 0\]"),
    "ball": ("dof_damping", r"dof_damping\[6\]"),
    "inertia of the ball": ("body_inertia", r"body_inertia\[7, 0\]"),
    "bound": ("geom_rbound", "geom_rbound"),
    "friction of geoms": ("geom_friction", r"geom_friction\[0, 0\]"),
    "solref of geoms": ("geom_solref", "geom_solref"),
    "colour": ("geom_rgba", "geom_rgba"),
}


@pytest.mark.parametrize("field, word", REFUSED.values(), ids=REFUSED)
def test_changes_without_an_effect_are_refused_by_name(field, word, mj_model, base):
    one = np.asarray(getattr(base, field))
    with pytest.raises(UserError, match=word):
        read(
            mj_model,
            base,
            **{
                field: np.stack(
                    [one, 1.1 * one + 0.1 * (field in ("dof_damping", "geom_friction"))]
                )
            },
        )


def test_values_that_are_traced_are_refused(base):
    """Without the values, a change without an effect could not be told."""
    model, axes = batch_of(base, body_mass=scaled(np.asarray(base.body_mass)))
    with pytest.raises(UserError, match="inside jax.jit"):
        jax.jit(jax.vmap(lambda one: parameters_of(base, one), in_axes=(axes,)))(model)
