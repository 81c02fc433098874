"""Friction of the ball and of the joints is that of MuJoCo's C engine."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from against_c import (
    BATCH,
    DT,
    HALF_SIZE,
    HOME,
    MODEL,
    RADIUS,
    XML,
    States,
    assert_same_step,
    bouncing_states,
    c_models,
    c_steps,
    converged,
    edited,
    free_run,
    fused_steps,
    num_contacts,
    paddle_frame,
    touching_states,
)
from bounce_mjx.errors import UserError
from bounce_mjx.physics import Control, PhysicsParameters, PhysicsState, make_engine
from random_worlds import random_parameters

MODELS = {
    "as it is": ("condim", "condim"),
    "little friction": ('friction="0.3 0.3"', 'friction="0.01 0.01"'),
    "no friction": ('friction="0.3 0.3"', 'friction="0 0"'),
    "another one along each tangent": ('friction="0.3 0.3"', 'friction="0.2 0.9"'),
    "impratio": ("<option ", '<option impratio="10" '),
    "solreffriction": ("<pair ", '<pair solreffriction="-1000 -300" '),
    "standard solref": ('solref="-98696 -31.4"', 'solref="0.02 0.3"'),
    "soft": ('solimp="0.95 0.99 0.001"', 'solimp="0.5 0.99 0.02 0.3 3"'),
    "ball as heavy as the arm": ('size="0.019" mass="0.0027"', 'size="0.019" mass="3"'),
}
FAST_MODELS = ("as it is", "another one along each tangent")


def frictional(old: str = "condim", new: str = "condim") -> mujoco.MjModel:
    """Shipped model with friction, one edit, and a C solver that converges to rounding error."""
    xml = XML.replace('condim="1"', 'condim="3" friction="0.3 0.3"')
    assert old in xml
    return converged(mujoco.MjModel.from_xml_string(xml.replace(old, new, 1)))


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in FAST_MODELS else pytest.mark.slow) for n in MODELS]
)
def test_one_step_of_a_frictional_model_is_mujocos(name, float64):
    """From states that stick, slip and separate, on faces, edges and corners."""
    model = frictional(*MODELS[name])
    states = touching_states(model, 240, seed=0)
    expected, force = c_steps(model, states)
    if name == "as it is":
        load = np.abs(force[:, 1:]).sum(axis=1) / 0.3
        pressed = force[:, 0] > 0.0
        assert np.sum(pressed & (load < 0.99 * force[:, 0])) >= 20
        assert np.sum(pressed & (load > 0.99 * force[:, 0])) >= 20
        assert np.sum(force[:, 0] == 0.0) >= 20 and num_contacts(force) <= 235
    assert_same_step(fused_steps(model, MODEL, states), expected)


ELLIPTIC = ('cone="pyramidal"', 'cone="elliptic"')


@pytest.mark.slow
@pytest.mark.separate_loops
def test_the_elliptic_cone_goes_to_mjx(float64):
    """Which agrees with C, from states that stick, slip and separate on a face of the paddle."""
    model = frictional(*ELLIPTIC)
    engine = make_engine(model, "auto")
    assert engine.name == "mjx" and 'cone="elliptic"' in engine.reason
    states = States(*(x[::3] for x in touching_states(model, 72, seed=0)))
    expected, force = c_steps(model, states)
    load = np.hypot(*force[:, 1:].T) / 0.3
    pressed = force[:, 0] > 0.0
    assert np.sum(pressed & (load < 0.99 * force[:, 0])) >= 5
    assert np.sum(pressed & (load > 0.99 * force[:, 0])) >= 5
    step = jax.jit(jax.vmap(lambda s, u: engine.step(MODEL, s, Control(u), 1)))
    actual = step(PhysicsState(*states[:2]), states.ctrl)
    fastest = np.max(np.abs(expected.qvel), axis=1, keepdims=True)
    error = np.max(np.abs(actual.qvel - expected.qvel) / fastest)
    assert error < 1e-6


def test_a_given_friction_with_the_elliptic_cone_is_refused():
    """The model itself has no friction, so that the fused engine takes it."""
    model = mujoco.MjModel.from_xml_string(XML.replace(*ELLIPTIC))
    engine = make_engine(model, "auto")
    assert engine.name == "fused"
    state = PhysicsState(jnp.zeros(model.nq), jnp.zeros(model.nv))
    given = PhysicsParameters(contact_friction=jnp.ones(()))
    with pytest.raises(UserError, match='cone="elliptic"'):
        engine.step(given, state, Control(jnp.zeros(model.nu)), 1)


def test_one_step_with_a_given_friction_is_mujocos(mj_model, float64):
    """Alone in a frictionless model and with all other parameters, against `edited_model`."""
    states = touching_states(mj_model, 96, seed=1)
    coefficients = 10.0 ** np.random.default_rng(0).uniform(-3.0, 0.5, 96)
    alone = PhysicsParameters(contact_friction=coefficients)
    together = random_parameters(mj_model, 96, seed=2)._replace(contact_friction=coefficients)
    for parameters in (alone, together):
        expected, _ = c_steps(c_models(mj_model, parameters, 96), states)
        assert_same_step(fused_steps(mj_model, parameters, states), expected)
    without, _ = c_steps(mj_model, states)
    assert np.max(np.abs(without.qvel - expected.qvel)) > 1.0


@pytest.mark.parametrize("frictionloss", [0.0, 10.0], ids=["sliding", "sliding and dry"])
@pytest.mark.slow
def test_frictional_worlds_stay_with_mujoco_for_2000_steps(frictionloss, float64):
    """In 64 random worlds with servos at their limits, with sliding friction of the ball, with and
    without dry friction of the joints."""
    count, rng = 64, np.random.default_rng(0)
    base = mujoco.MjModel.from_xml_string(XML)
    base.opt.timestep = DT
    parameters = random_parameters(base, count, seed=7)
    parameters = parameters._replace(
        gravity=parameters.gravity * [0.1, 0.1, 1.0],
        contact_friction=rng.uniform(0.0, 1.0, count),
        force_limit=rng.uniform(10.0, 100.0, (count, 6)),
        frictionloss=rng.uniform(0.0, frictionloss, (count, 6)) if frictionloss else None,
    )
    halves = [bouncing_states(base, rng) for _ in range(count // BATCH)]
    start = PhysicsState(*map(np.concatenate, zip(*(h[:2] for h in halves), strict=True)))
    models = [converged(model, 20) for model in c_models(base, parameters, count)]

    def look(data: mujoco.MjData) -> dict[str, float]:
        dry = data.efc_type == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF
        below = np.abs(data.efc_force) < (1.0 - 1e-9) * data.efc_frictionloss
        return {"sticking": np.sum(dry & below) / 6}

    _, contacts, seen = free_run(base, models, parameters, start, rng, look)
    assert contacts >= 1000
    assert 0.02 < seen["sticking"] < 0.98 if frictionloss else seen["sticking"] == 0.0


# Dry friction of the joints

COUNT = 240


def with_own_friction() -> mujoco.MjModel:
    """Friction in the MJCF of four joints, with impedances and references of all formats."""
    model = mujoco.MjModel.from_xml_string(XML)
    model.dof_frictionloss[:6] = [20.0, 5.0, 0.0, 2.0, 1.0, 0.0]
    model.dof_solref[:4] = [(0.01, 1.0), (1e-4, 1.0), (0.0, -50.0), (0.02, 1.0)]
    model.dof_solimp[:3] = [(0.5, 0.9, 0.01, 0.5, 2), (0.99, 0.9, 1, 0.5, 2), (0, 1, 1, 0.5, 2)]
    model.dof_solimp[3] = (0.3, 0.3, 0.01, 0.5, 2)
    return model


WORLDS = {
    # model, whether all other parameters are drawn too; None: nothing is drawn
    "all parameters": (lambda: mujoco.MjModel.from_xml_string(XML), True),
    "sliding friction": (frictional, False),
    "sliding friction, heavy ball": (
        lambda: frictional(*MODELS["ball as heavy as the arm"]),
        False,
    ),
    "of the model": (with_own_friction, None),
}


def sticking_and_sliding(
    models: list[mujoco.MjModel], states: States
) -> tuple[States, np.ndarray, np.ndarray]:
    """The states with torques up to 1.5 times the dry friction beyond all other forces; also the
    shares of sticking joints and of pressed contacts in each."""
    rng, count = np.random.default_rng(1), len(models)
    slow = rng.uniform(size=(count, 6)) < rng.choice([0.5, 1.0], (count, 1))
    states.qvel[:, :6] *= np.where(slow, 10.0 ** rng.uniform(-7.0, -3.0, slow.shape), 1.0)
    sticking, pressed = [], []
    for m, qpos, qvel, ctrl in zip(models, *states, strict=True):
        data = mujoco.MjData(m)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, qpos[:6]
        mujoco.mj_forward(m, data)
        torque = m.dof_frictionloss[:6] * rng.uniform(-1.5, 1.5, 6) * rng.choice([0.3, 1.0])
        ctrl[:] = qpos[:6] + (torque - data.qfrc_smooth[:6]) / m.actuator_gainprm[:, 0]
        data.ctrl[:] = ctrl
        mujoco.mj_forward(m, data)
        joints = data.efc_type == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF
        sticks = np.abs(data.efc_force) < (1.0 - 1e-9) * data.efc_frictionloss
        sticking.append(np.mean(sticks[joints]))
        pressed.append(np.any(data.efc_force[~joints] > 0.0))
    return states, np.array(sticking), np.array(pressed)


@pytest.mark.parametrize("name", WORLDS)
def test_one_step_with_dry_friction_is_mujocos(name, float64):
    """In each state, some of the joints stick, some slide, and some are close to the limit."""
    make, draws_all = WORLDS[name]
    model, parameters = make(), PhysicsParameters()
    if draws_all is not None:
        drawn = 10.0 ** np.random.default_rng(0).uniform(-1.0, 1.5, (COUNT, 6))
        drawn[::10, 3] = 0.0
        if draws_all:
            parameters = random_parameters(model, COUNT, seed=2)
        parameters = parameters._replace(frictionloss=drawn)
    models = c_models(model, parameters, COUNT)
    states = touching_states(model, COUNT, seed=0)
    states, sticking, pressed = sticking_and_sliding(models, states)
    mixed = (sticking > 0.0) & (sticking < 1.0)
    kinds = (sticking == 0.0, sticking == 1.0, mixed & pressed, mixed & ~pressed)
    assert min(map(np.sum, kinds)) >= 2
    expected, _ = c_steps(models, states)
    assert_same_step(fused_steps(model, parameters, states), expected)


def test_dry_friction_follows_its_flag(float64):
    """With the flag off, C ignores the model's dry friction and a given one."""
    model = edited("<flag ", '<flag frictionloss="disable" ')
    model.dof_frictionloss[:6] = 5.0
    states = touching_states(model, COUNT, seed=3)
    given = PhysicsParameters(frictionloss=np.full((COUNT, 6), 5.0))
    expected, _ = c_steps(converged(model), states)
    for parameters in (PhysicsParameters(), given):
        assert_same_step(fused_steps(model, parameters, states), expected)
    model.opt.disableflags ^= int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
    without, _ = c_steps(model, states)
    assert np.abs(without.qvel - expected.qvel).max() > 1e-3
    assert_same_step(fused_steps(model, given, states), without)


def test_mjx_refuses_given_dry_friction(mj_model):
    engine = make_engine(mj_model, "mjx")
    state = PhysicsState(jnp.asarray(mj_model.qpos0), jnp.zeros(mj_model.nv))
    given = PhysicsParameters(frictionloss=jnp.full(6, 10.0))
    with pytest.raises(UserError, match="dry friction .*--physics fused"):
        engine.step(given, state, Control(jnp.zeros(mj_model.nu)), 1)


@pytest.mark.parametrize("friction", [0.1, 1.0])
def test_a_bounce_takes_a_tenth_of_the_horizontal_speed_whatever_the_friction(friction):
    """MuJoCo damps a contact's sliding as softly as its bounce. Coulomb's friction stops it, and a
    sphere loses more than a quarter of its speed."""
    model = frictional('friction="0.3 0.3"', f'friction="{friction} {friction}"')
    centre, axes = paddle_frame(model, HOME)
    speed, impact_speed = 1.0, 3.0
    data = mujoco.MjData(model)
    data.qpos[:6] = data.ctrl[:] = HOME
    data.qpos[6:9] = centre + (HALF_SIZE[2] + RADIUS + 1e-3) * axes[:, 2]
    data.qvel[6:9] = speed, 0.0, -impact_speed
    mujoco.mj_forward(model, data)
    while data.qvel[8] < 0.0 or data.ncon:
        mujoco.mj_step(model, data)
    lost = speed - data.qvel[6]
    assert 0.05 < lost / speed < 0.15

    ball = model.body("ball_link").id
    inertia_share = model.body_inertia[ball, 0] / (model.body_mass[ball] * RADIUS**2)
    lost_until_it_rolls = inertia_share / (1.0 + inertia_share) * speed
    most_of_coulomb = friction * (impact_speed + data.qvel[8])
    assert 0.25 * speed < lost_until_it_rolls < most_of_coulomb
