"""Physics parameters: each engine against MuJoCo's C step with an edited model."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import rollout

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.c_episodes import (
    episode_models,
    full_states,
    make_mujoco_evaluator,
    physics_states,
)
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.learning import policy as policies
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.statistics import init_normalizer
from bounce_mjx.physics import (
    Control,
    PhysicsParameters,
    PhysicsState,
    edited_model,
    fused,
    make_engine,
)
from bounce_mjx.physics.parameters import shapes
from bounce_mjx.robot.model import load_model, resting_activations
from random_worlds import own_parameters, random_parameters
from test_impact import push_by_air
from test_physics import (
    DT,
    ONE_STEP,
    XML,
    CEngine,
    States,
    bouncing_states,
    c_step,
    difference,
    edited,
    paddle_frame,
    random_states,
)

MODEL = PhysicsParameters()
# Parameters of the shipped model; test_friction.py and test_joint_friction.py cover friction.
_NOT_IN_THE_MODEL = ("contact_friction", "force_limit", "frictionloss", "entries")
FIELDS = [f for f in PhysicsParameters._fields if f not in _NOT_IN_THE_MODEL]
NUM_WORLDS = 16


def world(parameters: PhysicsParameters, i: int) -> PhysicsParameters:
    """Parameters of world i from a batch [N, ...]."""
    return jax.tree.map(lambda array: array[i], parameters)


def uncompiled_steps(mj_model, parameters: PhysicsParameters, states: States) -> PhysicsState:
    """One fused step from each state in its own world, operation by operation."""
    step = partial(fused.step, fused.read_model(mj_model), num_substeps=1)
    with jax.disable_jit():
        return jax.vmap(step)(
            jax.tree.map(jnp.asarray, parameters),
            PhysicsState(jnp.asarray(states.qpos), jnp.asarray(states.qvel)),
            Control(jnp.asarray(states.ctrl)),
        )


def c_steps(mj_model, parameters: PhysicsParameters, states: States) -> tuple[PhysicsState, int]:
    """One mj_step from each state in its own world, and the number of contacts."""
    after, contacts = [], 0
    for i in range(len(states.qpos)):
        one = States(*(x[i : i + 1] for x in states))
        state, touching = c_step(edited_model(mj_model, world(parameters, i)), one)
        after.append(state)
        contacts += int(touching[0])
    return joined(after), contacts


def joined(states: list[PhysicsState]) -> PhysicsState:
    """Joins batches of states."""
    return PhysicsState(*(np.concatenate(x) for x in zip(*(s[:2] for s in states), strict=True)))


def assert_same_step(actual: PhysicsState, expected: PhysicsState) -> None:
    fastest = np.max(np.abs(expected.qvel))
    qpos, qvel = difference(actual, expected)
    assert qvel < ONE_STEP * fastest
    assert qpos < ONE_STEP * fastest * DT


@pytest.mark.usefixtures("float64")
def test_one_step_in_random_worlds_is_mujocos(mj_model):
    """All parameters are given, with contacts of every kind."""
    states, _ = random_states(mj_model, 128, seed=5)
    parameters = random_parameters(mj_model, 128, seed=6)
    expected, contacts = c_steps(mj_model, parameters, states)
    assert contacts >= 80
    assert_same_step(uncompiled_steps(mj_model, parameters, states), expected)


@pytest.mark.slow
@pytest.mark.usefixtures("float64")
def test_each_number_alone_acts_as_in_mujoco(mj_model):
    """In one batch with shared states and parameters, except for one random field."""
    fields = FIELDS
    count = 8
    states, _ = random_states(mj_model, count, seed=1)
    states = States(*(np.tile(x, (len(fields), 1)) for x in states))
    own = jax.tree.map(
        lambda array: np.broadcast_to(array, (len(fields) * count, *np.shape(array))).copy(),
        own_parameters(mj_model),
    )
    drawn = random_parameters(mj_model, len(fields) * count, seed=2)
    for i, field in enumerate(fields):
        rows = slice(i * count, (i + 1) * count)
        getattr(own, field)[rows] = getattr(drawn, field)[rows]
    expected, _ = c_steps(mj_model, own, states)
    assert_same_step(uncompiled_steps(mj_model, own, states), expected)

    shipped, _ = c_step(mj_model, states)
    change = np.abs(expected.qvel - shipped.qvel).max(axis=1).reshape(len(fields), count)
    assert np.all(change.max(axis=1) > 1e-4), dict(zip(fields, change.max(axis=1), strict=True))


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.usefixtures("float64")
def test_one_given_number_leaves_the_others_to_the_model(mj_model, field):
    """One field is given and the rest is None, with a solref in the standard format."""
    model = edited('solref="-98696 -31.4"', 'solref="0.02 0.3"')
    states, _ = random_states(model, 4, seed=3)
    drawn = getattr(random_parameters(model, 4, seed=4), field)
    parameters = PhysicsParameters(**{field: drawn})
    expected, _ = c_steps(model, parameters, states)
    assert_same_step(uncompiled_steps(model, parameters, states), expected)


@pytest.mark.slow
@pytest.mark.usefixtures("float64")
def test_random_worlds_stay_with_mujoco_for_500_steps(mj_model, record_property):
    """Both engines run freely; neither sees the other's state."""
    rng = np.random.default_rng(0)
    start = bouncing_states(mj_model, rng)
    state = PhysicsState(*(x[:NUM_WORLDS] for x in start[:2]))
    parameters = random_parameters(mj_model, NUM_WORLDS, seed=7)
    parameters = parameters._replace(gravity=parameters.gravity * [0.1, 0.1, 1.0])
    models = [edited_model(mj_model, world(parameters, i)) for i in range(NUM_WORLDS)]
    reference = [
        CEngine(model, PhysicsState(*(x[i : i + 1] for x in state[:2])))
        for i, model in enumerate(models)
    ]
    step = jax.jit(
        jax.vmap(lambda p, s, u: make_engine(mj_model, "fused").step(p, s, Control(u), 1))
    )
    contacts, error = 0, 0.0
    for i in range(500):
        if i % 10 == 0:
            action = rng.uniform(-0.03, 0.03, (NUM_WORLDS, 6))
            ctrl = np.asarray(state.qpos[:, :6]) + action
            c_ctrl = np.concatenate([c.state.qpos[:, :6] for c in reference]) + action
        state = step(parameters, state, ctrl)
        for j, c in enumerate(reference):
            contacts += c.step(c_ctrl[j : j + 1], 1)
        error = max(error, *difference(state, joined([c.state for c in reference])))
    record_property("largest_difference", error)
    print(f"500 steps x {NUM_WORLDS} worlds: {contacts} contact steps, difference {error:.1e}")
    assert contacts >= 200
    assert error < 1e-9


@pytest.mark.usefixtures("float64")
def test_given_force_limits_are_mujocos(mj_model):
    """Some servos are at their limits, where they have no implicit damping, and some are not."""
    states, _ = random_states(mj_model, 128, seed=11)
    limits = 10.0 ** np.random.default_rng(0).uniform(1.0, 3.5, (128, 6))
    alone = PhysicsParameters(force_limit=limits)
    for parameters in (alone, random_parameters(mj_model, 128, 12)._replace(force_limit=limits)):
        expected, _ = c_steps(mj_model, parameters, states)
        assert_same_step(uncompiled_steps(mj_model, parameters, states), expected)
    data = mujoco.MjData(edited_model(mj_model, world(alone, 0)))
    at_limit = []
    for i, start in enumerate(zip(*states, strict=True)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = start
        mujoco.mj_forward(edited_model(mj_model, world(alone, i)), data)
        at_limit.append(np.abs(data.actuator_force) == limits[i])
    assert 0.2 < np.mean(at_limit) < 0.8


def test_nothing_given_leaves_the_program_alone(mj_model):
    """The model's constants fold: no further input appears, and the model is bitwise the same."""
    model = fused.read_model(mj_model)
    assert fused.read_model(mj_model) == model
    state = PhysicsState(jnp.zeros(mj_model.nq), jnp.zeros(mj_model.nv))
    ctrl = jnp.zeros(mj_model.nu)
    step = partial(fused.step, model, num_substeps=1)
    default = jax.make_jaxpr(step)(MODEL, state, Control(ctrl))
    assert len(default.in_avals) == 3
    assert not default.consts
    given = jax.make_jaxpr(step)(PhysicsParameters(ball_mass=jnp.ones(())), state, Control(ctrl))
    assert len(given.in_avals) == 4
    # One given field adds only the operations that use it.
    assert 0 < num_operations(given) - num_operations(default) < 20


def num_operations(jaxpr) -> int:
    """Number of equations in a program, including its calls and loops."""
    inner = [
        value
        for equation in jaxpr.eqns
        for value in jax.tree.leaves(
            equation.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")
        )
        if hasattr(value, "eqns") or hasattr(value, "jaxpr")
    ]
    return len(jaxpr.eqns) + sum(num_operations(getattr(x, "jaxpr", x)) for x in inner)


@pytest.mark.slow
@pytest.mark.parametrize("choice", ("fused", pytest.param("mjx", marks=pytest.mark.separate_loops)))
@pytest.mark.usefixtures("float64")
def test_paddle_position_follows_its_parameter(mj_model, choice):
    parameters = random_parameters(mj_model, 1, seed=8)
    qpos = np.random.default_rng(0).uniform(-1.0, 1.0, mj_model.nq)
    expected, _ = paddle_frame(edited_model(mj_model, world(parameters, 0)), qpos[:6])
    engine = make_engine(mj_model, choice)
    position = jax.jit(engine.paddle_position)(world(parameters, 0), qpos)
    np.testing.assert_allclose(position, expected, atol=1e-12)


@pytest.mark.slow
@pytest.mark.separate_loops
@pytest.mark.usefixtures("float64")
def test_mjx_carries_activations_and_worlds(record_property):
    """Free run against C over control steps, in random worlds with friction, spin in air and
    filtered servos at their limits."""
    count, num_substeps, air_drag, air_lift = 4, 5, 0.2, 0.05
    model = edited('<position kp="20000"', '<position timeconst="0.02" kp="20000"')
    assert model.na == 6
    start = bouncing_states(model, np.random.default_rng(1))
    start.qpos[:, 8] -= 0.03
    state = PhysicsState(
        *(jnp.asarray(x[:count]) for x in start[:2]), jnp.asarray(start.qpos[:count, :6])
    )
    parameters = random_parameters(model, count, seed=9)
    parameters = parameters._replace(
        contact_friction=np.array([0.01, 0.1, 0.4, 1.0]),
        force_limit=np.tile([300.0, 100.0, 30.0, 10.0, 3.0, 1.0], (count, 1)),
    )
    data = []
    for i in range(count):
        c_model = edited_model(model, world(parameters, i))
        data.append((c_model, mujoco.MjData(c_model)))
        data[i][1].qpos[:], data[i][1].qvel[:], data[i][1].act[:] = (x[i] for x in state)
    engine = make_engine(model, "mjx")
    control = partial(Control, air_drag=air_drag, air_lift=air_lift)
    step = jax.jit(jax.vmap(lambda p, s, u: engine.step(p, s, control(u), num_substeps)))
    contacts, flight, touched = 0, [], set()
    for i in range(6):
        ctrl = np.asarray(state.qpos[:, :6]) + 0.02 * (-1.0) ** i
        state = step(parameters, state, jnp.asarray(ctrl))
        for j, (c_model, d) in enumerate(data):
            d.ctrl[:] = ctrl[j]
            for _ in range(num_substeps):
                push_by_air(c_model, d, air_drag, air_lift)
                mujoco.mj_step(c_model, d)
                contacts += d.ncon
                touched |= {j} if d.ncon else set()
            if j not in touched:
                flight.append(np.max(np.abs(state.qvel[j] - d.qvel)))
    expected = (np.array([getattr(d, name) for _, d in data]) for name in ("qpos", "qvel", "act"))
    error = max(
        float(np.max(np.abs(np.asarray(x) - y))) for x, y in zip(state, expected, strict=True)
    )
    record_property("largest_difference", error)
    print(f"MJX, {6 * num_substeps} steps x {count} worlds: {contacts} contacts, {error:.1e}")
    assert contacts >= 20
    assert error < 1e-6
    # MJX's solver is not exact in a contact.
    assert flight and max(flight) < 1e-9, flight
    record_property("largest_difference_in_flight", float(max(flight)))


def test_a_parameter_of_another_shape_is_refused(mj_model):
    engine = make_engine(mj_model, "fused")
    state = PhysicsState(jnp.zeros(mj_model.nq), jnp.zeros(mj_model.nv))
    for field, shape in shapes(6).items():
        wrong = PhysicsParameters(**{field: jnp.ones((*shape, 2))})
        with pytest.raises(UserError, match=field):
            engine.step(wrong, state, Control(jnp.zeros(mj_model.nu)), 1)


def heavy_and_light(key: jax.Array) -> PhysicsParameters:
    """Environment with balls of 1 to 100 times the mass."""
    return PhysicsParameters(ball_mass=0.0027 * 100.0 ** jax.random.uniform(key))


@pytest.mark.slow
def test_each_environment_of_a_batch_has_its_own_ball():
    """A drawn mass acts like in C with the edited model, and is in the state."""
    with jax.enable_x64(True):
        config = EnvConfig(ball_init_pos=(0.58856, 0.0, 0.08))
        env = BounceBall(config, randomize=heavy_and_light)
        keys = jax.random.split(jax.random.PRNGKey(3), 2)
        state = jax.vmap(env.reset)(keys)
        parameters = state.pipeline_state.parameters
        assert abs(np.log(parameters.ball_mass[0] / parameters.ball_mass[1])) > 0.5
        at = env.addresses
        action = jnp.zeros((2, 6))
        start = state.pipeline_state.physics
        reference = [
            CEngine(edited_model(env.mj_model, world(parameters, i)), world(start, slice(i, i + 1)))
            for i in range(2)
        ]
        step = jax.jit(jax.vmap(env.step))
        contacts = np.zeros(2, int)
        for _ in range(15):
            ctrl = jax.vmap(env.servo_targets)(state.pipeline_state.physics, action)
            state = step(state, action)
            contacts += [c.step(ctrl[i : i + 1], 10) for i, c in enumerate(reference)]
        assert np.all(contacts > 0)
        assert not np.any(state.done)
        expected = joined([c.state for c in reference])
        assert max(difference(state.pipeline_state.physics, expected)) < 1e-9
        np.testing.assert_array_equal(
            state.pipeline_state.parameters.ball_mass, parameters.ball_mass
        )
        height = state.pipeline_state.physics.qpos[:, at.ball_qpos[2]]
        assert abs(height[0] - height[1]) > 1e-5


@pytest.fixture(scope="module")
def networks():
    env = BounceBall()
    return policies.make_networks(
        PPOConfig(hidden_layers=(16,)), env.observation_size, env.action_size
    )


@pytest.fixture(scope="module")
def untrained(networks):
    """Untrained policy."""
    params = networks.policy_network.init(jax.random.PRNGKey(5))
    return policies.Policy(init_normalizer(BounceBall().observation_size), params)


@pytest.mark.slow
def test_c_evaluates_each_episode_in_its_own_world(networks, untrained):
    """C agrees with the fused engine, also on the drag of a bouncing ball, and not all worlds equal
    the model's."""
    config = EnvConfig(
        episode_seconds=0.3,
        ball_init_pos=(0.58856, 0.0, 0.1),
        randomization={
            "air_drag": (5.0, 10.0),
            "air_lift": (0.0, 0.01),
            "restitution": (0.7, 0.95),
            "restitution_slope": (0.05, 0.1),
        },
    )
    key = jax.random.PRNGKey(0)
    env = BounceBall(config, randomize=heavy_and_light)
    c = make_mujoco_evaluator(env, networks, 6)(untrained, key)
    ours = make_evaluator(env, networks, 6)(untrained, key)
    np.testing.assert_allclose(c.episode_return, ours.episode_return, rtol=1e-3, atol=1e-2)

    masses = jax.vmap(env.reset, out_axes=-1)(jax.random.split(key, 6)).pipeline_state.parameters
    models = episode_models(env, masses)
    np.testing.assert_allclose(
        [model.body("ball_link").mass[0] for model in models], masses.ball_mass, rtol=1e-6
    )
    assert len(episode_models(BounceBall(config), MODEL)) == 1


STATEFUL = {
    "activations": ('<position kp="20000"', '<position timeconst="0.02" kp="20000"'),
    "delayed sensor": (
        "<actuator>",
        '<sensor><jointpos joint="Joint1" delay="0.005" nsample="9"/></sensor><actuator>',
    ),
}


@pytest.mark.parametrize("name", STATEFUL)
def test_c_evaluation_carries_the_whole_state(name):
    """Control steps of the evaluation equal an uninterrupted run of mj_step."""
    model = edited(*STATEFUL[name])
    rng = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (2, 1)) + 0.1
    act = np.array(qpos[:, :6]) if model.na else None
    start = PhysicsState(qpos.T, 0.1 * np.ones((model.nv, 2)), None if act is None else act.T)
    states = full_states(model, start)
    data = [mujoco.MjData(model) for _ in range(2)]
    for i, d in enumerate(data):
        d.qpos[:], d.qvel[:] = qpos[i], 0.1
        if act is not None:
            d.act[:] = act[i]
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
    if model.na:
        np.testing.assert_allclose(after.act.T, [d.act for d in data], rtol=1e-6)
    else:
        assert after.act is None


def test_c_evaluation_takes_a_delayed_sensor(networks, untrained, tmp_path):
    """A short evaluation runs without an error."""
    mjcf = tmp_path / "delayed.xml"
    mjcf.write_text(XML.replace(*STATEFUL["delayed sensor"], 1))
    env = BounceBall(EnvConfig(mjcf=mjcf, episode_seconds=0.1))
    statistics = make_mujoco_evaluator(env, networks, 2)(untrained, jax.random.PRNGKey(0))
    np.testing.assert_array_equal(statistics.steps, 10)


def test_filtered_servos_start_at_rest():
    """Also with a gear: the activations are the actuators' lengths, so no servo exerts a force."""
    model = edited('<position kp="20000"', '<position timeconst="0.02" gear="-2" kp="20000"')
    data = mujoco.MjData(model)
    data.qpos[:6] = np.linspace(-1.0, 1.0, 6)
    data.act[:] = resting_activations(model, [jnp.asarray(x) for x in data.qpos])
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, 0.0, atol=0.01)
    assert resting_activations(load_model(None, 0.001), list(data.qpos)) is None
