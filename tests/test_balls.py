"""Several balls move in the fused engine, in MJX and in the environment as on C."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from against_c import (
    HOME,
    MODEL,
    States,
    assert_same_step,
    balls_model,
    c_models,
    c_steps,
    differences,
    free_run,
    hostile_states,
    jit_mjx,
    num_pressed,
)
from bounce_mjx import task
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation import c_episodes
from bounce_mjx.physics import Control, PhysicsParameters, PhysicsState, make_engine, servo_targets
from bounce_mjx.physics.edited import edited_model
from bounce_mjx.physics.support import unsupported_feature
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.model import add_balls, find_addresses
from bounce_mjx.world.randomization import RandomizationConfig
from bounce_mjx.world.sampling import nominal_values, physics_parameters
from random_worlds import random_parameters
from rest_task import Rest
from test_friction import c_engine_steps, sticking_and_sliding


def compiled_steps(model: mujoco.MjModel, parameters: PhysicsParameters, states: States):
    step = make_engine(model, "fused").step
    axes = jax.tree.map(lambda x: 0, parameters)
    steps = jax.jit(jax.vmap(lambda p, s, u: step(p, s, Control(u), 1), in_axes=(axes, 0, 0)))
    return steps(parameters, PhysicsState(*states[:2]), states.ctrl)


@pytest.mark.slow
@pytest.mark.parametrize(("num_balls", "friction"), [(2, None), (3, None), (2, 0.3), (3, 0.05)])
def test_one_step_of_several_balls_is_mujocos(num_balls, friction, float64):
    """From states with one to all contacts at once; the impulses of friction follow in order."""
    model = balls_model(num_balls, friction)
    assert unsupported_feature(model, "fused") is None
    count = 1000
    states = hostile_states(model, count, seed=0)
    pressed = num_pressed(model, states)
    assert min(np.sum(pressed == n) for n in range(1, num_balls + 2)) >= 20
    expected, _ = c_steps(model, states)
    assert_same_step(compiled_steps(model, MODEL, states), expected)
    if friction is not None:
        assert_same_step(c_engine_steps(model, states), expected)


def test_terms_are_of_each_ball_or_refused_where_the_balls_differ(tmp_path, float64):
    """A second ball twice as heavy and a tenth larger stays so; one value of the contact would
    change one of two that differ."""
    model = balls_model(2)
    first, second = find_addresses(model).balls
    model.body_mass[second.body] *= 2.0
    model.geom_size[second.geom, 0] *= 1.1
    nominals = nominal_values(model, ("ball_mass", "ball_radius"))
    same = edited_model(model, physics_parameters(jax.tree.map(jnp.asarray, nominals), model))
    np.testing.assert_allclose(same.body_mass, model.body_mass, rtol=1e-12)
    np.testing.assert_allclose(same.geom_size, model.geom_size, rtol=1e-12)
    sampled = {"ball_mass": jnp.asarray(1.5), "ball_radius": jnp.asarray(1.2)}
    changed = edited_model(model, physics_parameters(sampled, model))
    for ball in (first, second):
        assert changed.body_mass[ball.body] == pytest.approx(1.5 * model.body_mass[ball.body])
        assert changed.geom_size[ball.geom, 0] == pytest.approx(1.2 * model.geom_size[ball.geom, 0])

    spec = mujoco.MjSpec.from_file(str(resource_path("mjcf/bounce_ball.xml")))
    add_balls(spec, 2)
    spec.pairs[-1].solref = [-5e4, -30.0]
    path = tmp_path / "two.xml"
    path.write_text(spec.to_xml())
    Env(Two.Config(mjcf=path, randomization={"contact_friction": (0.1, 0.2)}))
    with pytest.raises(UserError, match="differ in pair_solref, of which randomization.rest"):
        Env(Two.Config(mjcf=path, randomization={"restitution": (0.8, 0.9)}))


@pytest.mark.slow
def test_given_parameters_act_on_all_balls(float64):
    """All parameters at once, against C on `edited_model`; without and with friction."""
    model, count = balls_model(2), 120
    states = hostile_states(model, count, seed=1)
    plain = random_parameters(model, count, seed=2)
    rng = np.random.default_rng(0)
    dry = plain._replace(
        frictionloss=10.0 ** rng.uniform(-1.0, 1.5, (count, 6)),
        contact_friction=rng.uniform(0.0, 1.0, count),
    )
    for parameters in (plain, dry):
        models = c_models(model, parameters, count)
        if parameters.frictionloss is not None:
            states, sticking, _ = sticking_and_sliding(models, states)
            assert 0.1 < np.mean(sticking) < 0.9
        expected, _ = c_steps(models, states)
        assert_same_step(compiled_steps(model, parameters, states), expected)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("num_balls", "friction"), [(2, None), (3, None), (2, 0.3)], ids=["two", "three", "friction"]
)
def test_several_balls_stay_with_mujoco_for_2000_steps(num_balls, friction, float64):
    model, count, rng = balls_model(num_balls, friction), 16, np.random.default_rng(0)
    start = PhysicsState(np.tile(model.qpos0, (count, 1)), np.zeros((count, model.nv)))
    start.qpos[:, :6] = HOME + rng.uniform(-0.2, 0.2, (count, 6))
    paddle = find_addresses(model).paddle_geom

    def look(data: mujoco.MjData) -> dict[str, float]:
        return {"meeting": np.any(np.all(data.contact.geom != paddle, axis=1))}

    _, _, seen = free_run(model, [model] * count, MODEL, start, rng, look)
    assert seen["meeting"] > 0.001


@pytest.mark.slow
def test_the_gradient_of_touching_balls_is_that_of_finite_differences(float64):
    """Of a sum of the velocities after a step with all contacts, with respect to the state."""
    model = balls_model(2, 0.3)
    states = hostile_states(model, 400, seed=3)
    touching = np.flatnonzero(num_pressed(model, states) == 3)[:24]
    weights = jnp.asarray(np.random.default_rng(0).normal(size=model.nv))
    step = make_engine(model, "fused").step

    def outcome(qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array) -> jax.Array:
        after = step(MODEL, PhysicsState(qpos, qvel), Control(ctrl), 2)
        return weights @ after.qvel

    # Without fusion XLA compiles much faster, and the programs run only a few times.
    compiled = partial(jax.jit, compiler_options={"xla_disable_hlo_passes": "fusion"})
    value = compiled(jax.vmap(outcome))
    given = compiled(jax.vmap(jax.grad(outcome, argnums=(0, 1))))
    qpos, qvel, ctrl = (jnp.asarray(x[touching]) for x in states)
    by_position, by_velocity = given(qpos, qvel, ctrl)
    rng = np.random.default_rng(1)
    for _ in range(4):
        ahead, along = (jnp.asarray(rng.normal(size=x.shape)) for x in (qpos, qvel))
        ahead = ahead.at[:, np.r_[9:13, 16:20]].set(0.0)
        ahead, along = 1e-8 * ahead, 1e-6 * along
        change = value(qpos + ahead, qvel + along, ctrl) - value(qpos - ahead, qvel - along, ctrl)
        expected = np.asarray(change) / 2.0
        found = jnp.sum(by_position * ahead, axis=1) + jnp.sum(by_velocity * along, axis=1)
        scale = np.abs(expected) + 1e-6
        assert np.median(np.abs(found - expected) / scale) < 1e-5
        # A step across the edge of a zone has two slopes.
        assert np.mean(np.abs(found - expected) / scale < 1e-3) > 0.9


@pytest.mark.slow
def test_mjx_agrees_on_several_balls(float64):
    """With friction, between the balls too."""
    model, count = balls_model(2, 0.3), 8
    states = hostile_states(model, 64, seed=4)
    some = np.flatnonzero(num_pressed(model, states) >= 2)[:count]
    states = States(*(x[some] for x in states))
    expected, _ = c_steps(model, states)
    step = jit_mjx(jax.vmap(lambda s, u: make_engine(model, "mjx").step(MODEL, s, Control(u), 1)))
    after = step(PhysicsState(*states[:2]), states.ctrl)
    error = differences(PhysicsState(*map(np.asarray, after[:2])), expected)
    error /= np.max(np.abs(expected.qvel), axis=1)
    assert np.sum(error < 1e-11) >= 6
    # From some states of three contacts MJX's solver stops at errors up to 2e-5, without friction
    # too, and the small inertia of a ball magnifies them.
    assert np.max(error) < 1e-2


class Two(Rest):
    """A task with two balls, which fly side by side."""

    class Config(Rest.Config):
        num_balls: int = 2
        randomization: RandomizationConfig = RandomizationConfig(ball_latency=(0.02, 0.02))

    num_balls = (2, 3)
    num_draws = 1

    def throw(self, draws: jax.Array, goal: task.Values) -> tuple[jax.Array, jax.Array]:
        side = jnp.array([[0.0, -0.5, 0.5 + draws[0]], [0.0, 0.5, 0.5]])
        return side, jnp.array([[0.1, 0.0, 1.0], [-0.1, 0.0, 2.0]])

    def step(self, state, step: task.Step) -> task.TaskStep:
        heights = step.truth.ball_position[:, 2]
        return task.TaskStep((), {}, ended=jnp.any(heights < 0.0), metrics={})


def after_resting(env: Env, steps: int, key: int = 0):
    """The kinematics and the observations of some steps without actions, and the last state."""
    state = jax.jit(env.reset)(jax.random.PRNGKey(key))
    step, truths, observations = jax.jit(env.step), [], []
    for _ in range(steps):
        truths.append(env.kinematics(state.pipeline_state))
        observations.append(np.asarray(state.obs))
        state = step(state, jnp.zeros(env.action_size))
    return truths, np.array(observations), state


@pytest.mark.slow
def test_a_world_of_two_balls_sees_each_late():
    """Each ball is thrown as the task says, flies freely, and is seen after the latency."""
    env = Env(Two.Config(observation={"ball_position": 2}))
    truths, observations, state = after_resting(env, 12)
    at = np.array([truth.ball_position for truth in truths])
    assert at.shape == (12, 2, 3)
    assert np.all(np.abs(at[0, :, 1] - [-0.5, 0.5]) < 0.011)
    time = env.dt * np.arange(12)[:, None]
    np.testing.assert_allclose(
        at[..., 2] - at[0, :, 2], time * [1.0, 2.0] - 0.5 * 9.81 * time**2, atol=1e-3
    )
    seen = observations[:, env.layout["ball_position"]].reshape(12, 2, 2, 3)
    np.testing.assert_allclose(seen[4:, 0], at[2:-2], atol=1e-5)
    np.testing.assert_array_equal(seen[1:, 1], seen[:-1, 0])
    assert {"true/ball_position_5", "true/ball_velocity_5"} <= state.metrics.keys()
    assert env.layout.parts[env.layout.parts.index(("ball_velocity", 6, "m/s", 1))]


@pytest.mark.slow
def test_c_moves_several_balls_as_the_engine_does():
    """With a push, and with the drag of the air in each physics step."""
    drawn = {"push_speed": (1.0, 1.0), "air_drag": (0.5, 0.5)}
    env = Env(Two.Config(randomization=drawn))
    count, num_steps = 2, env.config.num_substeps
    keys = jax.random.split(jax.random.PRNGKey(0), count)
    states = jax.vmap(env.reset, out_axes=-1)(keys)
    now = states.pipeline_state
    physics = now.physics
    spins = [i for ball in find_addresses(env.mj_model).balls for i in ball.qvel[3:]]
    physics = physics._replace(qvel=physics.qvel.at[np.array(spins)].set(30.0))
    push = jnp.arange(6.0).reshape(2, 3, 1) * jnp.ones(count)
    control = Control(physics.qpos[:6], air_drag=jnp.full(count, 0.5), ball_push=push)
    targets = jax.vmap(servo_targets, in_axes=(-1, None))(control, num_steps)
    now = now._replace(physics=physics)
    with mujoco.rollout.Rollout(nthread=2) as pool:
        expected = c_episodes._Physics(env, now, pool).step(control, targets)
    step = jax.vmap(lambda s, c: env.engine.step(MODEL, s, c, num_steps), in_axes=-1, out_axes=-1)
    for ours, theirs in zip(step(physics, control), expected, strict=True):
        if theirs is not None:
            np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_a_task_of_one_ball_refuses_two():
    with pytest.raises(UserError, match="num_balls is 2, but the task Rest takes 1; set num_balls"):
        Env(Rest.Config(num_balls=2))
