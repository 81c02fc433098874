"""Dry friction of the joints in the fused engine against MuJoCo's C step."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bounce_mjx.errors import UserError
from bounce_mjx.physics import (
    Control,
    PhysicsParameters,
    PhysicsState,
    edited_model,
    fused,
    make_engine,
)
from bounce_mjx.physics.support import unsupported_feature
from random_worlds import random_parameters
from test_friction import (
    MODELS,
    assert_same_step,
    c_steps,
    converged,
    frictional,
    fused_steps,
    touching_states,
)
from test_physics import XML, States, edited

COUNT = 240
HEAVY_BALL = MODELS["ball as heavy as the arm"]


def frictionless() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def with_own_friction() -> mujoco.MjModel:
    """Friction in the MJCF of four joints, with impedances and references of all formats."""
    model = frictionless()
    model.dof_frictionloss[:6] = [20.0, 5.0, 0.0, 2.0, 1.0, 0.0]
    model.dof_solref[:4] = [(0.01, 1.0), (1e-4, 1.0), (0.0, -50.0), (0.03, -1.0)]
    model.dof_solimp[:3] = [(0.5, 0.9, 0.01, 0.5, 2), (0.99, 0.9, 0, 0.5, 2), (0, 1, 1, 0.5, 2)]
    model.dof_solimp[3] = (0.3, 0.3, 0.01, 0.5, 2)
    return model


WORLDS = {
    "frictionless contact": (frictionless, False),
    "all parameters": (frictionless, True),
    "sliding friction": (frictional, False),
    "sliding friction, heavy ball": (lambda: frictional(*HEAVY_BALL), False),
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
@pytest.mark.usefixtures("float64")
def test_one_step_with_dry_friction_is_mujocos(name, record_property, tmp_path, monkeypatch):
    """In each state, some of the joints stick, some slide, and some are close to the limit."""
    monkeypatch.chdir(tmp_path)  # for MuJoCo's log: mixed formats are worth a warning
    make, draws_all = WORLDS[name]
    model = make()
    parameters = PhysicsParameters()
    if draws_all is not None:
        drawn = 10.0 ** np.random.default_rng(0).uniform(-1.0, 1.5, (COUNT, 6))
        drawn[::10, 3] = 0.0
        if draws_all:
            parameters = random_parameters(model, COUNT, seed=2)
        parameters = parameters._replace(frictionloss=drawn)
    models = [
        converged(edited_model(model, jax.tree.map(lambda x, i=i: x[i], parameters)))
        for i in range(COUNT)
    ]
    states = touching_states(model, COUNT, seed=0)
    states, sticking, pressed = sticking_and_sliding(models, states)
    mixed = (sticking > 0.0) & (sticking < 1.0)
    kinds = (sticking == 0.0, sticking == 1.0, mixed & pressed, mixed & ~pressed)
    assert min(map(np.sum, kinds)) >= 2
    expected, _ = c_steps(models, states)
    error = assert_same_step(fused_steps(model, parameters, states), expected)
    record_property("largest_difference", error)
    print(f"{name}: {error:.1e} of the largest speed, {np.mean(sticking):.0%} stick")


@pytest.mark.usefixtures("float64")
@pytest.mark.slow
def test_a_joint_holds_below_its_dry_friction(mj_model):
    """A weak servo pushes one joint with 5 N m. Below its dry friction, the joint creeps at the
    speed of MuJoCo's soft constraint; beyond it, the friction subtracts from the torque."""
    loss = np.zeros((3, 6))
    loss[:, 0] = [0.0, 2.0, 10.0]
    parameters = PhysicsParameters(
        frictionloss=jnp.asarray(loss),
        servo_gain=jnp.full((3, 6), 1e-3),
        servo_damping=jnp.zeros((3, 6)),
        damping=jnp.zeros((3, 6)),
        gravity=jnp.zeros((3, 3)),
    )
    qpos = np.tile(mj_model.qpos0, (3, 1))
    qpos[:, 8] = 2.0  # the ball is away
    ctrl = qpos[:, :6].copy()
    ctrl[:, 0] += 5.0 / 1e-3
    state = PhysicsState(jnp.asarray(qpos), jnp.zeros((3, mj_model.nv)))
    step = make_engine(mj_model, "fused").step
    state = jax.jit(jax.vmap(lambda p, s, u: step(p, s, Control(u), 8)))(parameters, state, ctrl)
    free, slid, held = np.asarray(state.qvel)[:, 0]
    assert free > 0.02
    assert slid == pytest.approx((5.0 - 2.0) / 5.0 * free, rel=0.01)
    # MuJoCo's defaults: impedance 0.9 at no violation, at most 0.95, time constant 0.02 s.
    softness = (1.0 - 0.9) / 0.9 * mj_model.dof_invweight0[0]
    assert 0.0 < held <= 1.01 * softness * 5.0 * (0.95 * 0.02 / 2.0)
    assert held < 0.1 * free


@pytest.mark.usefixtures("float64")
def test_dry_friction_follows_its_flag():
    """With the flag off, C ignores the model's dry friction and a given one."""
    model = edited("<flag ", '<flag frictionloss="disable" ')
    model.dof_frictionloss[:6] = 5.0
    states = touching_states(model, COUNT, seed=3)
    given = PhysicsParameters(frictionloss=np.full((COUNT, 6), 5.0))
    expected, _ = c_steps([converged(model)] * COUNT, states)
    for parameters in (PhysicsParameters(), given):
        assert_same_step(fused_steps(model, parameters, states), expected)
    model.opt.disableflags ^= int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
    without, _ = c_steps([model] * COUNT, states)
    assert np.abs(without.qvel - expected.qvel).max() > 1e-3
    assert_same_step(fused_steps(model, given, states), without)


def test_the_noslip_solver_is_refused_only_with_friction():
    model = frictionless()
    model.opt.noslip_iterations = 3
    assert unsupported_feature(model, "fused") is None
    for with_friction in (with_own_friction(), frictional()):
        with_friction.opt.noslip_iterations = 3
        assert "noslip_iterations" in unsupported_feature(with_friction, "fused")


@pytest.mark.parametrize("name", ["contact_friction", "frictionloss"])
def test_the_noslip_solver_is_refused_with_given_friction(name):
    """C changes the step by its noslip solver, which the fused engine lacks."""
    model = frictionless()
    model.opt.noslip_iterations = 3
    friction = {"contact_friction": np.ones(6), "frictionloss": np.full((6, 6), 500.0)}
    given = PhysicsParameters(**{name: friction[name]})
    states = touching_states(model, 6, seed=3)
    models = [edited_model(model, jax.tree.map(lambda x, i=i: x[i], given)) for i in range(6)]
    with_noslip, _ = c_steps(models, states)
    for m in models:
        m.opt.noslip_iterations = 0
    without, _ = c_steps(models, states)
    assert np.abs(with_noslip.qvel - without.qvel).max() > 1e-3
    engine = make_engine(model, "auto")
    state = PhysicsState(jnp.asarray(states.qpos[0]), jnp.asarray(states.qvel[0]))
    with pytest.raises(UserError, match="noslip_iterations.* with friction"):
        engine.step(jax.tree.map(lambda x: x[0], given), state, Control(states.ctrl[0]), 1)


def test_mjx_refuses_given_dry_friction(mj_model):
    engine = make_engine(mj_model, "mjx")
    state = PhysicsState(jnp.asarray(mj_model.qpos0), jnp.zeros(mj_model.nv))
    given = PhysicsParameters(frictionloss=jnp.full(6, 10.0))
    with pytest.raises(UserError, match="dry friction .*--physics fused"):
        engine.step(given, state, Control(jnp.zeros(mj_model.nu)), 1)


def test_no_dry_friction_leaves_the_program_alone(mj_model):
    """A model without dry friction has the program of a model in which the flag is off."""
    off = edited("<flag ", '<flag frictionloss="disable" ')
    state = PhysicsState(jnp.zeros(mj_model.nq), jnp.zeros(mj_model.nv))
    programs = [
        str(
            jax.make_jaxpr(
                lambda s, u, m=m: fused.step(
                    fused.read_model(m), PhysicsParameters(), s, Control(u)
                )
            )(state, jnp.zeros(mj_model.nu))
        )
        for m in (mj_model, off)
    ]
    assert programs[0] == programs[1]
    assert "while" not in programs[0]
