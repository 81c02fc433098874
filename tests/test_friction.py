"""Friction of the ball is Coulomb's law, in every engine, and friction of the joints MuJoCo's."""

import copy
from functools import partial

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
    balls_model,
    bouncing_states,
    c_models,
    c_steps,
    converged,
    edited,
    free_run,
    frictionless,
    fused_steps,
    hostile_states,
    jit_mjx,
    num_contacts,
    num_pressed,
    paddle_frame,
    touching_states,
)
from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation import c_episodes
from bounce_mjx.physics import (
    CEngine,
    Control,
    PhysicsParameters,
    PhysicsState,
    edited_model,
    make_engine,
    servo_targets,
)
from bounce_mjx.physics.friction import after_friction
from bounce_mjx.robot.model import find_addresses
from random_worlds import random_parameters

SOLID, HOLLOW = 2.0 / 5.0, 2.0 / 3.0
MODELS = {
    "as it is": ("condim", "condim"),
    "little friction": ('friction="0.3 0.3"', 'friction="0.01 0.01"'),
    "no friction": ('friction="0.3 0.3"', 'friction="0 0"'),
    "elliptic cone": ('cone="pyramidal"', 'cone="elliptic" impratio="10"'),
    "solreffriction": ("<pair ", '<pair solreffriction="-1000 -300" '),
    "standard solref": ('solref="-98696 -31.4"', 'solref="0.02 0.3"'),
    "soft": ('solimp="0.95 0.99 0.001"', 'solimp="0.5 0.99 0.02 0.3 3"'),
    "ball as heavy as the arm": ('size="0.019" mass="0.0027"', 'size="0.019" mass="3"'),
    "Euler": ('integrator="implicitfast"', 'integrator="Euler"'),
    "hollow": ("condim", "condim"),
}
FAST_MODELS = ("as it is", "hollow", "ball as heavy as the arm")


def frictional(old: str = "condim", new: str = "condim") -> mujoco.MjModel:
    """Shipped model with friction, one edit, and a C solver that converges to rounding error."""
    xml = XML.replace('condim="1"', 'condim="3" friction="0.3 0.3"')
    assert old in xml
    return converged(mujoco.MjModel.from_xml_string(xml.replace(old, new, 1)))


def with_inertia(model: mujoco.MjModel, per_mass: float) -> mujoco.MjModel:
    """The model with balls of an inertia per mass and squared radius, edited in place."""
    for ball in find_addresses(model).balls:
        squared_radius = model.geom_size[ball.geom, 0] ** 2
        inertia = per_mass * model.body_mass[ball.body] * squared_radius
        model.body_inertia[ball.body] = inertia
        model.dof_M0[list(ball.qvel[3:])] = inertia
    return model


def sticks(model: mujoco.MjModel, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether the first contact of each state sticks, and whether it slips, from the forces [N, 3]
    of `c_steps`."""
    friction = np.hypot(*force[:, 1:].T)
    limit = model.pair_friction[0, 0] * force[:, 0]
    pressed = force[:, 0] > 0.0
    is_below = friction < (1.0 - 1e-9) * limit
    return pressed & is_below, pressed & ~is_below


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in FAST_MODELS else pytest.mark.slow) for n in MODELS]
)
def test_one_step_with_friction_is_that_of_c_and_coulombs_impulse(name, float64):
    """In the fused engine and in `CEngine`, from states that stick, slip and separate, on faces,
    edges and corners."""
    model = frictional(*MODELS[name])
    if name == "hollow":
        with_inertia(model, HOLLOW)
    states = touching_states(model, 240, seed=0)
    expected, force = c_steps(model, states)
    if name == "as it is":
        sticking, slipping = sticks(model, force)
        assert sticking.sum() >= 20 and slipping.sum() >= 20
        assert np.sum(force[:, 0] == 0.0) >= 20 and num_contacts(force) <= 235
    assert_same_step(fused_steps(model, MODEL, states), expected)
    assert_same_step(c_engine_steps(model, states), expected)


def c_engine_steps(model: mujoco.MjModel, states: States) -> PhysicsState:
    """One step of `CEngine` from each state."""
    engine, after = CEngine(model), []
    for start in zip(*states, strict=True):
        data = mujoco.MjData(engine.model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = start
        engine.step(data)
        after.append((data.qpos.copy(), data.qvel.copy()))
    return PhysicsState(*map(np.array, zip(*after, strict=True)))


@pytest.mark.slow
def test_mjx_has_the_same_friction(float64):
    """From states that stick, slip and separate; given as parameters of each environment too."""
    model = frictional()
    states = touching_states(model, 120, seed=0)
    _, force = c_steps(model, states)
    sticking, slipping = sticks(model, force)
    # MJX's normal at an edge of a box is another one.
    at_edge = np.arange(120) % 4 == 2
    kinds = (sticking, slipping, force[:, 0] == 0.0)
    some = [np.flatnonzero(which & ~at_edge)[:8] for which in kinds]
    states = States(*(x[np.concatenate(some)] for x in states))
    count = len(states.qpos)
    assert count == 24
    given = PhysicsParameters(
        contact_friction=np.linspace(0.0, 0.6, count), ball_inertia=np.linspace(0.3, 0.667, count)
    )
    engine = make_engine(model, "mjx")
    step = jit_mjx(jax.vmap(lambda p, s, u: engine.step(p, s, Control(u), 1)))
    start = PhysicsState(*states[:2])
    own = PhysicsParameters(
        contact_friction=np.full(count, 0.3), ball_inertia=np.full(count, SOLID)
    )
    for parameters in (own, given):
        expected, _ = c_steps(c_models(model, parameters, count), states)
        assert_same_step(step(parameters, start, states.ctrl), expected)


def test_one_step_with_a_given_friction_is_that_of_c_and_coulombs_impulse(mj_model, float64):
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


def test_friction_of_two_balls_is_that_of_c_and_coulombs_impulse(float64):
    """Of a pair of balls alone and together with the paddle; three balls are in test_balls.py."""
    model = balls_model(2, 0.3)
    states = hostile_states(model, 32, seed=6)
    assert np.sum(num_pressed(model, states) >= 2) >= 5
    expected, _ = c_steps(model, states)
    assert_same_step(fused_steps(model, MODEL, states), expected)
    assert_same_step(c_engine_steps(model, states), expected)


def test_an_entry_of_the_coefficient_acts_alone(mj_model, float64):
    """`pair_friction[0, 0]` is the friction of its pair in a frictionless model; the other tangent
    has no coefficient of its own."""
    states = touching_states(mj_model, 12, seed=1)
    given = PhysicsParameters(entries={"pair_friction[0, 0]": np.full(12, 0.2)})
    same = PhysicsParameters(contact_friction=np.full(12, 0.2))
    models = c_models(mj_model, given, 12)
    assert np.all([model.pair_friction[0, :2] == 0.2 for model in models])
    expected, _ = c_steps(c_models(mj_model, same, 12), states)
    assert_same_step(c_steps(models, states)[0], expected)
    assert_same_step(fused_steps(mj_model, given, states), expected)
    other = PhysicsParameters(entries={"pair_friction[0, 1]": np.float64(0.2)})
    with pytest.raises(
        UserError, match=r"pair_friction\[0, 1\] .* give the entry with the index 0"
    ):
        edited_model(mj_model, other)


@pytest.mark.slow
def test_frictional_worlds_stay_with_c_for_2000_steps(float64):
    """In 64 random worlds with servos at their limits, with sliding friction of the ball and dry
    friction of the joints."""
    count, rng = 64, np.random.default_rng(0)
    base = mujoco.MjModel.from_xml_string(XML)
    base.opt.timestep = DT
    parameters = random_parameters(base, count, seed=7)
    parameters = parameters._replace(
        gravity=parameters.gravity * [0.1, 0.1, 1.0],
        contact_friction=rng.uniform(0.0, 1.0, count),
        force_limit=rng.uniform(10.0, 100.0, (count, 6)),
        frictionloss=rng.uniform(0.0, 10.0, (count, 6)),
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
    assert 0.02 < seen["sticking"] < 0.98


# Bounces and rolling on a held paddle


class HeldPaddle:
    """`CEngine` with an arm that does not yield, and a ball at the centre of the paddle."""

    def __init__(self, timestep: float, inertia: float, tilt: float = 0.0):
        """
        Args:
          inertia: of the ball per mass and squared radius.
          tilt: of the paddle about its y axis, rad.
        """
        model = with_inertia(frictional(), inertia)
        model.opt.timestep = timestep
        model.dof_armature[:6] = 1e9
        self.engine = CEngine(model)
        self.model = self.engine.model
        self.phase = 0.0
        self.pose = HOME + [0.0, 0.0, 0.0, 0.0, tilt, 0.0]
        self.centre, self.axes = paddle_frame(model, self.pose)

    def resting_gap(self, g: float) -> float:
        """Gap of a ball at rest, pressed with g (m/s^2): there MuJoCo's acceleration of the
        contact, the impedance d times the spring's less the rest of d times g, is 0."""
        dmin, dmax = self.model.pair_solimp[0, :2]
        stiffness = -self.model.pair_solref[0, 0] / dmax**2
        return -(1.0 - dmin) * g / (stiffness * dmin**2)

    def start(self, gap: float, velocity: np.ndarray, spin: np.ndarray) -> mujoco.MjData:
        """The ball over the paddle's face; all vectors are in the paddle's frame."""
        data = mujoco.MjData(self.model)
        data.qpos[:6] = data.ctrl[:] = self.pose
        data.qpos[6:9] = self.centre + (HALF_SIZE[2] + RADIUS + gap) * self.axes[:, 2]
        data.qpos[9:13] = 1.0, 0.0, 0.0, 0.0
        data.qvel[6:9] = self.axes @ velocity
        data.qvel[9:12] = self.axes @ spin
        return data

    def ball(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Velocity and spin of the ball in the paddle's frame."""
        (ball,) = find_addresses(self.model).balls
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, data.qpos[9:13])
        spin = rotation.reshape(3, 3) @ data.qvel[list(ball.qvel[3:])]
        return self.axes.T @ data.qvel[6:9], self.axes.T @ spin

    def bounce(self, velocity: np.ndarray, spin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Velocity and spin after a bounce, of which each begins at another phase of a step."""
        self.phase = (self.phase + 0.618) % 1.0
        gap = -velocity[2] * self.model.opt.timestep * self.phase
        data, has_touched = self.start(gap, velocity, spin), False
        while not has_touched or data.ncon:
            self.engine.step(data)
            has_touched |= data.ncon > 0
        return self.ball(data)


UP = np.array([0.0, 0.0, 1.0])
SPINS = ((0.0, 0.0, 0.0), (0.0, 60.0, 0.0), (0.0, -60.0, 0.0), (40.0, 10.0, 30.0))


@pytest.mark.parametrize("timestep", [0.0005, 0.001, 0.002])
@pytest.mark.parametrize("inertia", [SOLID, HOLLOW], ids=["solid", "hollow"])
def test_a_bounce_follows_the_rigid_formula(timestep, inertia):
    """Without gravity: Coulomb's law for the impulse of the whole bounce, within 2.5% of the speed
    along the paddle, whether the ball grips or slides; energy is never gained."""
    held, restitutions, kinds = HeldPaddle(timestep, inertia), [], []
    held.model.opt.gravity[:] = 0.0
    of_effective_mass = 1.0 / (1.0 + 1.0 / inertia)
    # Dampings of the contact for restitutions around 0.86 and 0.93.
    for damping in (29.0, 13.3):
        held.model.pair_solref[0] = -98696.0, -damping
        for mu in (0.1, 0.3, 0.6):
            held.model.pair_friction[0, :2] = mu
            for fall in (1.0, 2.0, 4.0):
                for along in (0.2, 0.7, 2.0):
                    for spin in SPINS:
                        before = np.array([along, 0.0, -fall])
                        after, spin_after = held.bounce(before, np.array(spin))
                        slip = before[:2] + np.cross(spin, -RADIUS * UP)[:2]
                        speed, normal_impulse = np.linalg.norm(slip), fall + after[2]
                        to_stop = of_effective_mass * speed
                        impulse = -min(to_stop, mu * normal_impulse) * slip / speed
                        error = np.linalg.norm(after[:2] - before[:2] - impulse)
                        assert error < 0.025 * along
                        turned = np.cross(-RADIUS * UP, [*impulse, 0.0]) / inertia / RADIUS**2
                        error = np.linalg.norm(spin_after - spin - turned) * RADIUS
                        assert error < 0.025 * along / inertia
                        kinds.append(to_stop < mu * normal_impulse)
                        restitutions.append(after[2] / fall)
                        energies = [
                            v @ v + inertia * RADIUS**2 * (w @ w)
                            for v, w in ((before, np.array(spin)), (after, spin_after))
                        ]
                        assert energies[1] < energies[0]
    assert 0.3 < np.mean(kinds) < 0.9
    of_damping = np.mean(np.reshape(restitutions, (2, -1)), axis=1)
    np.testing.assert_allclose(of_damping, [0.86, 0.93], atol=0.015)


@pytest.mark.parametrize("num_balls", [1, 2])
def test_friction_never_adds_energy(num_balls):
    """Not with the mass matrix of the step's start, with which it acts, from states of one to three
    contacts with a moving arm."""
    model = balls_model(num_balls, 0.5)
    states = hostile_states(model, 200, seed=5)
    law, bare, lost = CEngine(model), frictionless(model), []
    for start in zip(*states, strict=True):
        energies = []
        for advance, stepped in ((law.step, law.model), (partial(mujoco.mj_step, bare), bare)):
            data = mujoco.MjData(stepped)
            data.qpos[:], data.qvel[:], data.ctrl[:] = start
            advance(data)
            momentum = np.zeros(model.nv)
            mujoco.mj_mulM(stepped, data, momentum, data.qvel)
            energies.append(0.5 * data.qvel @ momentum)
        lost.append(1.0 - energies[0] / energies[1])
    assert min(lost) > -1e-12
    assert np.sum(np.array(lost) > 1e-6) > 50


@pytest.mark.parametrize("inertia", [SOLID, HOLLOW], ids=["solid", "hollow"])
@pytest.mark.parametrize("tilt", [0.05, -0.2])
def test_a_ball_rolls_on_a_tilted_paddle(tilt, inertia):
    """Down it with 5/7 (solid) or 3/5 (hollow) of g sin a, within 1%. It sticks in each step, up to
    a creep of 2/7 or 2/5 of g sin a dt, by which a step's own acceleration moves it."""
    timestep, g = 0.001, 9.81
    held = HeldPaddle(timestep, inertia, tilt)
    # Less than what it slides with: 2/7 or 2/5 of tan 0.2.
    share = 1.0 / (1.0 + inertia)
    held.model.pair_friction[0, :2] = 1.2 * (1.0 - share) * np.tan(abs(tilt))
    down = -held.axes[2, 0] * g
    assert abs(down) == pytest.approx(g * np.sin(abs(tilt)), rel=1e-6)
    data = held.start(held.resting_gap(g * np.cos(tilt)), np.zeros(3), np.zeros(3))
    times, speeds = [], []
    while data.time < 0.2:
        before = data.qpos[6:9].copy()
        held.engine.step(data)
        velocity, spin = held.ball(data)
        # The surface rests on the paddle.
        assert np.abs(velocity[:2] + np.cross(spin, -RADIUS * UP)[:2]).max() < 1e-9
        creep = (held.axes.T @ (data.qpos[6:9] - before))[0] / timestep - velocity[0]
        assert abs(creep) < 1.01 * (1.0 - share) * abs(down) * timestep
        times.append(data.time)
        speeds.append(velocity[0])
    acceleration = np.polyfit(times, speeds, 1)[0]
    assert acceleration == pytest.approx(share * down, rel=0.01)


def test_a_ball_slides_where_friction_is_too_small_to_roll():
    """With mu g cos a of deceleration."""
    tilt, mu = 0.2, 0.03
    held = HeldPaddle(0.001, HOLLOW, tilt)
    held.model.pair_friction[0, :2] = mu
    data = held.start(held.resting_gap(9.81 * np.cos(tilt)), np.zeros(3), np.zeros(3))
    held.engine.step(data, 200)
    velocity, _ = held.ball(data)
    expected = 9.81 * (np.sin(tilt) - mu * np.cos(tilt)) * 0.2
    assert abs(velocity[0]) == pytest.approx(expected, rel=0.01)


def test_a_plain_mj_step_has_another_friction():
    """MuJoCo damps a contact's sliding as softly as its bounce: it takes a tenth of the horizontal
    speed whatever the coefficient, as physics.md says."""
    held = HeldPaddle(0.001, HOLLOW)
    plain = copy.copy(held.model)
    plain.pair_dim[:] = 3
    plain.opt.gravity[:] = 0.0
    for mu in (0.1, 1.0):
        plain.pair_friction[0, :2] = mu
        data = held.start(1e-4, np.array([1.0, 0.0, -3.0]), np.zeros(3))
        while data.qvel[8] < 0.0 or data.ncon:
            mujoco.mj_step(plain, data)
        assert 0.05 < 1.0 - data.qvel[6] < 0.15


# Evaluation on C


@pytest.mark.slow
@pytest.mark.parametrize("drawn", [False, True], ids=["one world", "a world each"])
def test_the_evaluation_on_c_has_the_friction_of_the_engine(drawn):
    """Over control steps with a bounce, the drag of the air and pushes, each up to the rounding of
    float32; with one model for all episodes, and with one for each."""
    terms = {"air_drag": (0.5, 0.5), "push_speed": (0.5, 0.5)}
    terms |= {"contact_friction": (0.1, 0.5), "ball_inertia": (0.4, 0.6)} if drawn else {}
    env = BounceBall(EnvConfig(friction=0.3, ball_inertia=HOLLOW, randomization=terms))
    count, num_steps = 4, env.config.num_substeps
    now = jax.vmap(env.reset, out_axes=-1)(jax.random.split(jax.random.key(0), count))
    now = now.pipeline_state
    assert (not jax.tree.leaves(now.parameters)) != drawn
    qpos, qvel = (np.array(x) for x in now.physics[:2])
    for i in range(count):
        centre, axes = paddle_frame(env.mj_model, qpos[:6, i])
        qpos[6:9, i] = centre + (HALF_SIZE[2] + RADIUS + 0.003) * axes[:, 2]
        qvel[6:9, i], qvel[9:, i] = (0.4, 0.1 * i, -1.0), (5.0, 40.0 - 30.0 * i, 20.0)
    physics = PhysicsState(jnp.asarray(qpos), jnp.asarray(qvel))
    control = Control(
        physics.qpos[:6] + 0.01,
        air_drag=jnp.full(count, 0.5),
        ball_push=0.1 * jnp.arange(3.0)[:, None] * jnp.ones(count),
    )
    targets = jax.vmap(servo_targets, in_axes=(-1, None))(control, num_steps)
    step = jax.jit(
        jax.vmap(lambda p, s, c: env.engine.step(p, s, c, num_steps), in_axes=-1, out_axes=-1)
    )
    with mujoco.rollout.Rollout(nthread=2) as pool:
        on_c = c_episodes._Physics(env, now._replace(physics=physics), pool)
        for _ in range(3):
            expected = on_c.step(control, targets)
            physics = step(now.parameters, physics, control)
    np.testing.assert_allclose(physics.qpos, expected.qpos, atol=1e-5)
    np.testing.assert_allclose(physics.qvel[:9], expected.qvel[:9], atol=1e-3)
    np.testing.assert_allclose(physics.qvel[9:], expected.qvel[9:], atol=0.05)
    # It has bounced, and friction has turned it.
    turned = np.abs(expected.qvel[9:] - qvel[9:]).max(axis=0)
    assert np.all(expected.qvel[8] > 0.1) and np.all(turned > 3.0)


def test_a_frictionless_world_is_stepped_in_threads():
    """By `mj_step` alone, as before, of which `CEngine` is no copy."""
    env = BounceBall(EnvConfig())
    now = jax.vmap(env.reset, out_axes=-1)(jax.random.split(jax.random.key(0), 2)).pipeline_state
    with mujoco.rollout.Rollout(nthread=1) as pool:
        assert not c_episodes._Physics(env, now, pool)._has_friction
    model = frictionless(frictional())
    engine, states = CEngine(model), touching_states(model, 12, seed=0)
    expected, _ = c_steps(model, states)
    assert not engine.has_friction
    np.testing.assert_array_equal(c_engine_steps(model, states).qvel, expected.qvel)


def test_c_engine_is_one_step_after_another():
    """`num_steps` at once, and its model is a copy: the caller's keeps its friction."""
    model = frictional()
    engine, states = CEngine(model), touching_states(model, 3, seed=0)
    assert model.pair_dim[0] == 3 and engine.model.pair_dim[0] == 1 and engine.has_friction
    once, often = mujoco.MjData(engine.model), mujoco.MjData(engine.model)
    for data in (once, often):
        data.qpos[:], data.qvel[:], data.ctrl[:] = (x[0] for x in states)
    engine.step(once, 20)
    for _ in range(20):
        engine.step(often)
    np.testing.assert_array_equal(once.qvel, often.qvel)
    assert once.time == pytest.approx(0.02)


# What the physics lacks


def touching_by_type(model_text: str) -> mujoco.MjModel:
    """Ball and paddle that touch by their types, in place of the pair."""
    spec = mujoco.MjSpec.from_string(model_text)
    for pair in spec.pairs:
        spec.delete(pair)
    for name in ("ball", "blocker"):
        geom = spec.geom(name)
        geom.contype, geom.conaffinity, geom.condim = 1, 1, 3
    return spec.compile()


REFUSED = {
    "condim 4": (lambda: frictional('condim="3"', 'condim="4"'), "friction of the ball .condim 4;"),
    "condim 6": (lambda: frictional('condim="3"', 'condim="6"'), "friction of the ball .condim 6;"),
    "unequal": (
        lambda: frictional('friction="0.3 0.3"', 'friction="0.3 0.4"'),
        r"two coefficients of friction between ball and paddle \(friction 0.3 0.4; only equal",
    ),
    "RK4": (
        lambda: frictional("implicitfast", "RK4"),
        "friction of a ball with the integrator RK4",
    ),
    "no pair": (lambda: touching_by_type(XML), r"touch without a <pair> in <contact> \(condim 3"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_friction_that_the_law_lacks_is_refused_by_every_engine(name):
    make, words = REFUSED[name]
    model = make()
    for build in (CEngine, partial(make_engine, choice="auto"), partial(make_engine, choice="mjx")):
        with pytest.raises(UserError, match=words) as error:
            build(model)
        assert str(error.value).endswith("; change the MJCF") and "\n" not in str(error.value)
    with pytest.raises(UserError):
        make_engine(model, "fused")


def test_friction_that_a_frictionless_model_only_names_is_allowed():
    """Unequal coefficients of a pair of condim 1, and RK4 in MJX and C."""
    model = edited('condim="1"', 'condim="1" friction="0.3 0.4"')
    assert make_engine(model, "auto").name == "fused" and not CEngine(model).has_friction
    model = edited("implicitfast", "RK4")
    assert make_engine(model, "auto").name == "mjx" and not CEngine(model).has_friction


# Gradients


@pytest.mark.slow
def test_the_gradient_of_friction_is_that_of_finite_differences(float64):
    """From states that stick and slip, with respect to the state, the coefficient and the ball's
    inertia, away from the limit between the two."""
    model = frictional()
    states = touching_states(model, 240, seed=4)
    _, force = c_steps(model, states)
    friction, limit = np.hypot(*force[:, 1:].T), 0.3 * force[:, 0]
    ratio = friction / np.where(limit > 0.0, limit, np.inf)
    sticking = np.flatnonzero((ratio > 0.01) & (ratio < 0.9))[:12]
    slipping = np.flatnonzero(ratio > 1.0 - 1e-9)[:12]
    assert len(sticking) == len(slipping) == 12
    some = np.concatenate([sticking, slipping])
    step = make_engine(model, "fused").step
    weights = jnp.asarray(np.random.default_rng(0).normal(size=model.nv))
    weights = weights.at[9:].multiply(RADIUS)

    def outcome(numbers: jax.Array, state: jax.Array, ctrl: jax.Array) -> jax.Array:
        given = PhysicsParameters(contact_friction=numbers[0], ball_inertia=numbers[1])
        after = step(given, PhysicsState(state[:13], state[13:]), Control(ctrl), 1)
        return weights @ after.qvel

    numbers = jnp.tile(jnp.array([0.3, SOLID]), (24, 1))
    state = jnp.asarray(np.concatenate([states.qpos[some], states.qvel[some]], axis=1))
    ctrl = jnp.asarray(states.ctrl[some])
    # The argument, the index in it, and the step of the difference.
    directions = [*((0, i, 1e-6) for i in range(2)), *((1, i, 1e-8) for i in (0, 3, 6, 8))]
    directions += [(1, i, 1e-6) for i in (13, 16, 19, 20, 22, 24)]
    moved = []
    for which, i, size in directions:
        for sign in (1.0, -1.0):
            point = [numbers, state]
            point[which] = point[which].at[:, i].add(sign * size)
            moved.append((*point, ctrl))
    with jax.disable_jit():
        gradient = jax.vmap(jax.grad(outcome, argnums=(0, 1)))(numbers, state, ctrl)
        values = jax.vmap(outcome)(*map(jnp.concatenate, zip(*moved, strict=True)))
    up, down = np.moveaxis(np.reshape(values, (len(directions), 2, 24)), 1, 0)
    sizes = np.array([size for *_, size in directions])[:, None]
    expected = (up - down) / (2.0 * sizes)
    found = np.array([gradient[which][:, i] for which, i, _ in directions])
    error = np.abs(found - expected) / (np.abs(expected).max(axis=1, keepdims=True) + 1e-9)
    assert error.max() < 1e-4
    # The coefficient acts on what slips alone, the inertia on what sticks.
    assert np.all(found[0, :12] == 0.0) and np.all(np.abs(found[0, 12:]) > 1e-6)
    assert np.all(np.abs(found[1, :12]) > 1e-6)


@pytest.mark.slow
def test_gradients_are_finite_at_the_edges_of_friction():
    """Without slip, with hardly any, without contact, without friction; in float32 as shipped."""
    step = make_engine(frictional(), "fused").step
    centre, axes = paddle_frame(frictional(), HOME)

    def outcome(mu: jax.Array, gap: jax.Array, velocity: jax.Array, spin: jax.Array) -> jax.Array:
        at = jnp.asarray(centre + HALF_SIZE[2] * axes[:, 2]) + (RADIUS + gap) * axes[:, 2]
        qpos = jnp.concatenate([jnp.asarray(HOME), at, jnp.array([1.0, 0.0, 0.0, 0.0])])
        qvel = jnp.concatenate([jnp.zeros(6), velocity, spin])
        given = PhysicsParameters(contact_friction=mu)
        after = step(given, PhysicsState(qpos, qvel), Control(jnp.asarray(HOME)), 2)
        return jnp.sum(after.qvel) + jnp.sum(after.qpos)

    still, down = np.zeros(3), np.array([0.0, 0.0, -1.0])
    along = np.array([1.0, 0.0, 0.0])
    cases = [(0.3, gap, velocity, still) for gap in (-1e-3, 0.1) for velocity in (still, down)]
    cases += [(0.3, -1e-3, down + size * along, still) for size in (1e-3, 1e-9, 1e-12, 1e-30)]
    cases += [(mu, gap, down + along, still) for mu in (0.0, 1e-30) for gap in (-1e-3, 0.1)]
    # It rolls: the velocity of the centre cancels that of the spin.
    cases.append((0.3, -1e-3, down + 10.0 * RADIUS * along, np.array([0.0, 10.0, 0.0])))
    columns = [jnp.asarray(np.array(column), jnp.float32) for column in zip(*cases, strict=True)]
    with jax.disable_jit():
        gradients = jax.vmap(jax.grad(outcome, argnums=(0, 1, 2, 3)))(*columns)
    for array in gradients:
        assert np.all(np.isfinite(array)) and np.abs(array).max() > 0.0


def test_the_law_has_a_gradient_at_every_slip():
    """Also at none, and at one whose square float32 cannot hold."""

    def speed(slip: jax.Array, largest: jax.Array) -> jax.Array:
        jacobian = jnp.concatenate([jnp.eye(3), jnp.eye(3)], axis=1)
        qvel = jnp.zeros(6).at[0].set(slip)
        return after_friction(qvel, jacobian, UP, largest, lambda force: force)[0]

    slips = jnp.asarray([0.0, *10.0 ** np.arange(-30.0, 1.0, 0.5)], jnp.float32)
    for largest in (0.0, 1e-30, 1e-3, 10.0):
        by_slip, by_largest = jax.vmap(jax.grad(speed, argnums=(0, 1)), (0, None))(slips, largest)
        assert np.all(np.isfinite(by_slip)) and np.all(np.isfinite(by_largest))
    # Two free masses that stick share their speed.
    np.testing.assert_allclose(by_slip[slips > 1e-7], 0.5, rtol=1e-6)


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
    for m, qpos, qvel, ctrl in zip(map(frictionless, models), *states, strict=True):
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
