"""A given physics parameter acts in each engine as in C with an edited model."""

import copy
import re
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import rollout

from against_c import (
    Coulomb,
    States,
    assert_same_step,
    bouncing_states,
    c_models,
    c_steps,
    edited,
    fused_steps,
    jit_mjx,
    num_contacts,
    push_by_air,
    random_states,
    world,
)
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.c_episodes import full_states, physics_states
from bounce_mjx.physics import Control, PhysicsParameters, PhysicsState, edited_model, make_engine
from bounce_mjx.physics.fused.model import read_model, variable_entries
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.robot.numbers import field_of
from random_worlds import own_parameters, random_parameters

# Parameters of the shipped model; test_friction.py covers friction.
_NOT_IN_THE_MODEL = ("contact_friction", "force_limit", "frictionloss", "entries")
FIELDS = [f for f in PhysicsParameters._fields if f not in _NOT_IN_THE_MODEL]


def test_one_step_in_random_worlds_is_mujocos(mj_model, float64):
    """All parameters are given, with contacts of every kind; with force limits, at which servos
    have no implicit damping, some servos are at their limits and some are not."""
    count = 128
    states, _ = random_states(mj_model, count, seed=5)
    parameters = random_parameters(mj_model, count, seed=6)
    limits = 10.0 ** np.random.default_rng(0).uniform(1.0, 3.5, (count, 6))
    for given in (parameters, parameters._replace(force_limit=limits)):
        models = c_models(mj_model, given, count)
        expected, forces = c_steps(models, states)
        assert num_contacts(forces) >= 80
        assert_same_step(fused_steps(mj_model, given, states), expected)
    at_limit = []
    for i, (model, *start) in enumerate(zip(models, *states, strict=True)):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = start
        mujoco.mj_forward(model, data)
        at_limit.append(np.abs(data.actuator_force) == limits[i])
    assert 0.2 < np.mean(at_limit) < 0.8


@pytest.mark.parametrize("field", FIELDS)
def test_one_given_number_leaves_the_others_to_the_model(mj_model, field, float64):
    """One field is given and the rest is None, with a solref in the standard format."""
    model = edited('solref="-98696 -31.4"', 'solref="0.02 0.3"')
    states, _ = random_states(model, 4, seed=3)
    drawn = getattr(random_parameters(model, 4, seed=4), field)
    parameters = PhysicsParameters(**{field: drawn})
    expected, _ = c_steps(c_models(model, parameters, 4), states)
    assert_same_step(fused_steps(model, parameters, states), expected)


@pytest.mark.slow
def test_mjx_carries_worlds(mj_model, float64):
    """Free run against C over control steps, in random worlds with friction, air and
    servos at their limits."""
    count, num_substeps, air_drag = 4, 5, 0.2
    start = bouncing_states(mj_model, np.random.default_rng(1))
    start.qpos[:, 8] -= 0.03
    state = PhysicsState(*(jnp.asarray(x[:count]) for x in start[:2]))
    parameters = random_parameters(mj_model, count, seed=9)
    parameters = parameters._replace(
        contact_friction=np.array([0.01, 0.1, 0.4, 1.0]),
        force_limit=np.tile([300.0, 100.0, 30.0, 10.0, 3.0, 1.0], (count, 1)),
    )
    data = []
    for i in range(count):
        law = Coulomb(edited_model(mj_model, world(parameters, i)))
        data.append((law, mujoco.MjData(law.model)))
        data[i][1].qpos[:], data[i][1].qvel[:] = (x[i] for x in state)
    engine = make_engine(mj_model, "mjx")
    control = partial(Control, air_drag=air_drag)
    step = jit_mjx(jax.vmap(lambda p, s, u: engine.step(p, s, control(u), num_substeps)))
    contacts, flight, touched = 0, [], set()
    for i in range(6):
        ctrl = np.asarray(state.qpos[:, :6]) + 0.02 * (-1.0) ** i
        state = step(parameters, state, jnp.asarray(ctrl))
        for j, (law, d) in enumerate(data):
            d.ctrl[:] = ctrl[j]
            for _ in range(num_substeps):
                push_by_air(law.model, d, air_drag)
                law.step(d)
                contacts += d.ncon
                touched |= {j} if d.ncon else set()
            if j not in touched:
                flight.append(np.max(np.abs(state.qvel[j] - d.qvel)))
    expected = (np.array([getattr(d, name) for _, d in data]) for name in ("qpos", "qvel"))
    error = max(np.max(np.abs(x - y)) for x, y in zip(state, expected, strict=True))
    assert contacts >= 20 and error < 1e-6
    # MJX's solver is not exact in a contact.
    assert flight and max(flight) < 1e-9, flight


def test_the_inertia_of_a_ball_is_the_compilers(mj_model):
    """A given one, with the mass and the radius of the same world, is all that MuJoCo's compiler
    derives from a ball of that inertia in the MJCF."""
    mass, radius, per_mass = 0.0035, 0.021, 2.0 / 3.0
    given = PhysicsParameters(*map(np.float64, (mass, radius, per_mass)))
    model = edited_model(mj_model, given)
    inertia = per_mass * mass * radius**2
    written = edited(
        '<geom name="ball" type="sphere" size="0.019" mass="0.0027"',
        f'<inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>'
        f'<geom name="ball" type="sphere" size="{radius}"',
    )
    for field in "body_mass body_inertia body_invweight0 dof_M0 geom_size geom_rbound".split():
        np.testing.assert_allclose(
            field_of(model, field), field_of(written, field), rtol=1e-9, atol=1e-12, err_msg=field
        )
    own = edited_model(mj_model, PhysicsParameters(ball_mass=np.float64(mass)))
    assert own.body_inertia[-1, 0] == pytest.approx(0.4 * mass * 0.019**2)


def test_without_friction_the_inertia_changes_no_bit(mj_model):
    """Of a bounce of the fused engine, in float32 as shipped."""
    states, _ = random_states(mj_model, 32, seed=7)
    before = fused_steps(mj_model, PhysicsParameters(), states)
    after = fused_steps(mj_model, PhysicsParameters(ball_inertia=np.full(32, 0.6)), states)
    for x, y in zip(before, after, strict=True):
        assert x.dtype == jnp.float32
        np.testing.assert_array_equal(x, y)


def test_a_parameter_of_another_shape_is_refused(mj_model):
    engine = make_engine(mj_model, "fused")
    state = PhysicsState(jnp.zeros(mj_model.nq), jnp.zeros(mj_model.nv))
    for field, own in own_parameters(mj_model)._asdict().items():
        if own is None:
            continue
        wrong = PhysicsParameters(**{field: jnp.ones((*np.shape(own), 2))})
        with pytest.raises(UserError, match=field):
            engine.step(wrong, state, Control(jnp.zeros(mj_model.nu)), 1)


def test_the_fused_engine_reads_each_entry_that_it_accepts(mj_model):
    """A change of each of `variable_entries` is one of the fused model; MuJoCo too ignores the last
    coefficients of friction here."""
    unchanged = {"opt.gravity[0]": float(mj_model.opt.gravity[0])}
    base = read_model(mj_model, PhysicsParameters(entries=unchanged))
    names = set()
    for field, index in variable_entries(mj_model, find_addresses(mj_model)):
        array = field_of(mj_model, field)
        places = np.ravel(np.arange(array.size).reshape(array.shape)[index])
        for place in zip(*np.unravel_index(places, array.shape), strict=True):
            if field == "pair_friction" and place[1] > 1:
                continue
            name = f"{field}[{', '.join(map(str, place))}]"
            changed = {name: float(array[place]) + 0.01}
            assert read_model(mj_model, PhysicsParameters(entries=changed)) != base, name
            names.add(name)
    assert len(names) > 100


@pytest.mark.parametrize("name", ("pair_dim[0]", "actuator_forcelimited[1]", "jnt_pos[2, 0]"))
def test_an_entry_that_the_fused_engine_ignores_is_refused(mj_model, name):
    with pytest.raises(UserError, match=re.escape(f"cannot vary {name}")):
        read_model(mj_model, PhysicsParameters(entries={name: 3.0}))


@pytest.mark.parametrize("name", ("qpos_spring[1]", "jnt_stiffness[1]"))
def test_a_number_whose_flag_is_off_is_refused(mj_model, name):
    model = copy.deepcopy(mj_model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SPRING
    assert read_model(mj_model, PhysicsParameters(entries={name: 0.1}))
    with pytest.raises(UserError, match=re.escape(f"cannot vary {name}")):
        read_model(model, PhysicsParameters(entries={name: 0.1}))


@pytest.mark.parametrize("name", ("opt.density", "opt.gravity", "opt.gravity[3]", "friction[0]"))
def test_a_name_of_no_single_entry_is_refused(mj_model, name):
    with pytest.raises(UserError, match=re.escape(f"{name} is no entry of an MjModel")):
        edited_model(mj_model, PhysicsParameters(entries={name: np.float64(1.0)}))


@pytest.mark.slow
def test_each_number_alone_acts_as_in_mujoco(mj_model, float64):
    """In one batch with shared states and parameters, except for one random field."""
    count, size = 8, 8 * len(FIELDS)
    states, _ = random_states(mj_model, count, seed=1)
    states = States(*(np.tile(x, (len(FIELDS), 1)) for x in states))
    own = jax.tree.map(
        lambda array: np.broadcast_to(array, (size, *np.shape(array))).copy(),
        own_parameters(mj_model),
    )
    drawn = random_parameters(mj_model, size, seed=2)
    for i, field in enumerate(FIELDS):
        rows = slice(i * count, (i + 1) * count)
        getattr(own, field)[rows] = getattr(drawn, field)[rows]
    expected, _ = c_steps(c_models(mj_model, own, size), states)
    assert_same_step(fused_steps(mj_model, own, states), expected)
    shipped, _ = c_steps(mj_model, states)
    change = np.abs(expected.qvel - shipped.qvel).max(axis=1).reshape(len(FIELDS), count)
    changes = dict(zip(FIELDS, change.max(axis=1), strict=True))
    # Without friction nothing turns the ball.
    assert changes.pop("ball_inertia") < 1e-12
    assert min(changes.values()) > 1e-4, changes


def test_c_evaluation_carries_the_whole_state(mj_model):
    """Control steps of the evaluation equal an uninterrupted run of mj_step."""
    model = mj_model
    rng = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (2, 1)) + 0.1
    start = PhysicsState(qpos.T, 0.1 * np.ones((model.nv, 2)))
    states = full_states(model, start)
    data = [mujoco.MjData(model) for _ in range(2)]
    for i, d in enumerate(data):
        d.qpos[:], d.qvel[:] = qpos[i], 0.1
    with rollout.Rollout(nthread=1) as pool:
        for _ in range(3):
            ctrl = qpos[:, :6] + rng.uniform(-0.05, 0.05, (2, 6))
            control = np.repeat(ctrl[:, None], 10, axis=1)
            states = pool.rollout([model], [mujoco.MjData(model)], states, control)[0][:, -1]
            for d, targets in zip(data, ctrl, strict=True):
                d.ctrl[:] = targets
                mujoco.mj_step(model, d, nstep=10)
    after = physics_states(model, states)
    np.testing.assert_allclose(after.qpos.T, [d.qpos for d in data], rtol=1e-6)
    np.testing.assert_allclose(after.qvel.T, [d.qvel for d in data], rtol=1e-6, atol=1e-9)
