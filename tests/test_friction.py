"""Frictional contact of the fused engine against MuJoCo's C step."""

from functools import partial

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
from bounce_mjx.robot.model import find_addresses
from random_worlds import random_parameters
from test_physics import (
    BATCH,
    DT,
    HALF_SIZE,
    MODEL,
    ONE_STEP,
    RADIUS,
    XML,
    CEngine,
    States,
    bouncing_states,
    difference,
    drop_ball,
    paddle_frame,
    random_states,
)

SUBSTEPS = 10
PICOMETRE = 1e-12
# Single edits of the MJCF with a frictional pair.
MODELS = {
    "as it is": ("condim", "condim"),
    "little friction": ('friction="0.3 0.3"', 'friction="0.01 0.01"'),
    "much friction": ('friction="0.3 0.3"', 'friction="2 2"'),
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


def converged(model: mujoco.MjModel, iterations: int = 100) -> mujoco.MjModel:
    """The model, edited so that C's solver converges to rounding error.

    In a trajectory the solver starts from the forces of the last step, and 20 iterations suffice.
    """
    model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, iterations, 50
    return model


def touching_states(model: mujoco.MjModel, count: int, seed: int) -> States:
    """`random_states`, but every third ball rolls on the paddle; some of these slip or leave."""
    states, _ = random_states(model, count, seed)
    rng = np.random.default_rng(seed)
    at = find_addresses(model)
    for i in range(0, count, 3):
        data = mujoco.MjData(model)
        states.qvel[i, :6] *= 0.1
        data.qpos[:], data.qvel[:] = states.qpos[i], states.qvel[i]
        mujoco.mj_fwdPosition(model, data)
        centre, axes = paddle_frame(model, states.qpos[i, :6])
        gap = -rng.uniform(0.0, 0.002)
        local = np.array([0.8, 0.8, 0.0]) * rng.uniform(-1.0, 1.0, 3) * HALF_SIZE
        local[2] = HALF_SIZE[2] + RADIUS + gap
        states.qpos[i, 6:9] = centre + axes @ local
        contact = states.qpos[i, 6:9] - axes[:, 2] * (RADIUS + 0.5 * gap)
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, contact, model.geom_bodyid[at.paddle_geom])
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, states.qpos[i, 9:])
        turning = np.cross(
            rotation.reshape(3, 3) @ states.qvel[i, 9:], contact - states.qpos[i, 6:9]
        )
        slip = rng.uniform(-1.0, 1.0, 3) * [0.3, 0.3, 0.1] * (i % 2)
        states.qvel[i, 6:9] = jacobian @ states.qvel[i] - turning + axes @ slip
    return states


def c_steps(models: list[mujoco.MjModel], states: States) -> tuple[PhysicsState, np.ndarray]:
    """One mj_step from each state, and the contact force [N, 3] in the contact's frame; NaN without
    a contact."""
    after, forces = [], []
    for model, *start in zip(models, *states, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = start
        mujoco.mj_step(model, data)
        wrench = np.full(6, np.nan)
        if data.ncon:
            mujoco.mj_contactForce(model, data, 0, wrench)
        after.append((data.qpos.copy(), data.qvel.copy()))
        forces.append(wrench[:3])
    return PhysicsState(*map(np.array, zip(*after, strict=True))), np.array(forces)


def fused_steps(model: mujoco.MjModel, parameters: PhysicsParameters, states: States):
    """One fused step from each state, operation by operation."""
    step = partial(fused.step, fused.read_model(model), num_substeps=1)
    axes = jax.tree.map(lambda x: 0 if np.ndim(x) else None, parameters)
    with jax.disable_jit():
        return jax.vmap(step, in_axes=(axes, 0, 0))(
            jax.tree.map(jnp.asarray, parameters),
            PhysicsState(jnp.asarray(states.qpos), jnp.asarray(states.qvel)),
            Control(jnp.asarray(states.ctrl)),
        )


def assert_same_step(actual: PhysicsState, expected: PhysicsState) -> float:
    """Checks each state against ONE_STEP times its largest speed; returns the largest ratio."""
    fastest = np.max(np.abs(expected.qvel), axis=1, keepdims=True)
    error = np.max(np.abs(np.asarray(actual.qvel) - expected.qvel) / fastest)
    assert error < ONE_STEP
    # The comparison includes the orientation, which has no unit of length.
    assert np.max(np.abs(np.asarray(actual.qpos) - expected.qpos) / fastest) < ONE_STEP * DT + 1e-15
    return float(error)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in FAST_MODELS else pytest.mark.slow) for n in MODELS],
)
@pytest.mark.usefixtures("float64")
def test_one_step_of_a_frictional_model_is_mujocos(name, record_property):
    """From states that stick, slip and separate, on faces, edges and corners."""
    model = frictional(*MODELS[name])
    states = touching_states(model, 240, seed=0)
    expected, force = c_steps([model] * 240, states)
    if name == "as it is":
        load = np.abs(force[:, 1:]).sum(axis=1) / 0.3
        pressed = force[:, 0] > 0.0
        assert np.sum(pressed & (load < 0.99 * force[:, 0])) >= 20
        assert np.sum(pressed & (load > 0.99 * force[:, 0])) >= 20
        assert np.sum(force[:, 0] == 0.0) >= 20
        assert np.sum(np.isnan(force[:, 0])) >= 5
    error = assert_same_step(fused_steps(model, MODEL, states), expected)
    record_property("largest_difference", float(error))
    print(f"{name}: {error:.1e} of the largest speed")


ELLIPTIC = ('cone="pyramidal"', 'cone="elliptic"')


@pytest.mark.slow
@pytest.mark.separate_loops
@pytest.mark.usefixtures("float64")
def test_the_elliptic_cone_goes_to_mjx(record_property):
    """Which agrees with C, from states that stick, slip and separate on a face of the paddle."""
    model = frictional(*ELLIPTIC)
    engine = make_engine(model, "auto")
    assert engine.name == "mjx" and 'cone="elliptic"' in engine.reason
    states = States(*(x[::3] for x in touching_states(model, 72, seed=0)))
    expected, force = c_steps([model] * len(states.qpos), states)
    load = np.hypot(*force[:, 1:].T) / 0.3
    pressed = force[:, 0] > 0.0
    assert np.sum(pressed & (load < 0.99 * force[:, 0])) >= 5
    assert np.sum(pressed & (load > 0.99 * force[:, 0])) >= 5
    step = jax.jit(jax.vmap(lambda s, u: engine.step(MODEL, s, Control(u), 1)))
    actual = step(PhysicsState(*states[:2]), states.ctrl)
    fastest = np.max(np.abs(expected.qvel), axis=1, keepdims=True)
    error = np.max(np.abs(actual.qvel - expected.qvel) / fastest)
    record_property("largest_difference", float(error))
    print(f"MJX, elliptic cone: {error:.1e} of the largest speed")
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


@pytest.mark.usefixtures("float64")
def test_one_step_with_a_given_friction_is_mujocos(mj_model):
    """Alone in a frictionless model and with all other parameters, against `edited_model`."""
    model = mj_model
    states = touching_states(model, 96, seed=1)
    coefficients = 10.0 ** np.random.default_rng(0).uniform(-3.0, 0.5, 96)
    alone = PhysicsParameters(contact_friction=coefficients)
    together = random_parameters(model, 96, seed=2)._replace(contact_friction=coefficients)
    for parameters in (alone, together):
        models = [
            converged(edited_model(model, jax.tree.map(lambda x, i=i: x[i], parameters)))
            for i in range(96)
        ]
        expected, _ = c_steps(models, states)
        assert_same_step(fused_steps(model, parameters, states), expected)
    without, _ = c_steps([model] * 96, states)
    assert np.max(np.abs(without.qvel - expected.qvel)) > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("frictionloss", [0.0, 10.0], ids=["sliding", "sliding and dry"])
@pytest.mark.usefixtures("float64")
def test_frictional_worlds_stay_with_mujoco_for_2000_steps(frictionloss, record_property):
    """Each engine runs freely in 64 random worlds with servos at their limits and with sliding
    friction of the ball, with and without dry friction of the joints. A lost ball is dropped again.

    A bounce off an edge amplifies differences. In the worlds in which it does, the engines are
    closer at any time than two runs of C with balls that start a picometre apart.
    """
    count = 64
    base = mujoco.MjModel.from_xml_string(XML)
    base.opt.timestep = DT
    rng = np.random.default_rng(0)
    parameters = random_parameters(base, count, seed=7)
    parameters = parameters._replace(
        gravity=parameters.gravity * [0.1, 0.1, 1.0],
        contact_friction=rng.uniform(0.0, 1.0, count),
        force_limit=rng.uniform(10.0, 100.0, (count, 6)),
        frictionloss=rng.uniform(0.0, frictionloss, (count, 6)) if frictionloss else None,
    )
    halves = [bouncing_states(base, rng) for _ in range(count // BATCH)]
    state = PhysicsState(*map(np.concatenate, zip(*(h[:2] for h in halves), strict=True)))
    reference = []
    for i in range(count):
        model = edited_model(base, jax.tree.map(lambda x, i=i: x[i], parameters))
        start = PhysicsState(*(x[[i, i]] for x in state[:2]))
        reference.append(CEngine(converged(model, 20), start))
        reference[i].data[1].qpos[8] += PICOMETRE
    engine = make_engine(base, "fused")
    step = jax.jit(jax.vmap(lambda p, s, u: engine.step(p, s, Control(u), SUBSTEPS)))
    contacts, drops, sticking, errors, apart = 0, 0, 0, np.zeros(count), np.zeros(count)
    for _ in range(2000 // SUBSTEPS):
        action = rng.uniform(-0.03, 0.03, (count, 6))
        for c, qpos, qvel in zip(reference, *state[:2], strict=True):
            data, shifted = c.data
            if data.qpos[8] < data.geom("blocker").xpos[2] - 0.1:
                drop_ball(c.model, data.qpos, data.qvel, rng)
                qpos[6:], qvel[6:] = data.qpos[6:], data.qvel[6:]
                shifted.qpos[6:], shifted.qvel[6:] = data.qpos[6:], data.qvel[6:]
                shifted.qpos[8] += PICOMETRE
                drops += 1
        after = step(parameters, state, state.qpos[:, :6] + action)
        state = PhysicsState(*(np.array(x) for x in after[:2]))
        for j, c in enumerate(reference):
            # Half of the contacts are of the second run.
            contacts += c.step(c.state.qpos[:, :6] + action[j], SUBSTEPS) / 2
            data = c.data[0]
            dry = data.efc_type == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF
            below = np.abs(data.efc_force) < (1.0 - 1e-9) * data.efc_frictionloss
            sticking += np.sum(dry & below)
            first, second = (PhysicsState(*(x[k] for x in c.state[:2])) for k in (0, 1))
            ours = PhysicsState(*(x[j] for x in state[:2]))
            errors[j] = max(errors[j], *difference(ours, first))
            apart[j] = max(apart[j], *difference(second, first))
        assert np.all((errors < 1e-9) | (errors < apart))
    record_property("largest_difference", float(errors.max()))
    sticking /= 6 * count * (2000 // SUBSTEPS)
    print(
        f"2,000 steps x {count}: {contacts:.0f} contacts, {drops} drops, "
        f"{sticking:.0%} stick, {errors.max():.1e}, two runs of C {apart.max():.1e}"
    )
    assert contacts >= 1000
    assert 0.02 < sticking < 0.98 if frictionloss else sticking == 0.0
    assert np.quantile(errors, 0.9) < 1e-9
