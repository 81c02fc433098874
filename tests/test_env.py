"""The environment observes, resets, acts, counts and ends as the specification says."""

import functools
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.resources import resource_path
from bounce_mjx.task import Kinematics, Step, term_names
from bounce_mjx.task.bounce import Bounce, Rewards, State
from bounce_mjx.world.config import PADDLE_HOME
from reward_reference import REFERENCE_WEIGHTS, reference_terms

JOINTS = tuple(f"Joint{i}" for i in range(1, 7))
TARGET_XY = np.array([0.58856, 0.0])
BALL = np.array([0.58856, 0.0, 0.45])
DEFAULT_ANGLES = np.radians([0, 40, 110, 0, -60, 0])
FLOAT32_EPS = 1.2e-7


@pytest.fixture(scope="module")
def reset(env):
    return jax.jit(env.reset)


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(env.step)


@pytest.fixture(scope="module")
def finish(env):
    return jax.jit(lambda *args: finished(env, *args))


@pytest.fixture(scope="module")
def model():
    """The MJCF as MuJoCo reads it, without the package in between."""
    return mujoco.MjModel.from_xml_path(str(resource_path("mjcf/bounce_ball.xml")))


def finished(env, state, action, physics):
    """The second half of a step, for another state of the physics."""
    return env.finish_step(state, action, state.pipeline_state.actuation, physics)


def mj_data(model, physics) -> mujoco.MjData:
    """MuJoCo's own view of one physics state."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = physics.qpos, physics.qvel
    mujoco.mj_forward(model, data)
    return data


def with_task(state, target_height=None, **changes):
    """`state` with another target height, and other fields of the task."""
    pipeline = state.pipeline_state
    if target_height is not None:
        pipeline = pipeline._replace(goal={"target_height": jnp.float32(target_height)})
    changes = {
        name: jnp.asarray(value, getattr(pipeline.task, name).dtype)
        for name, value in changes.items()
    }
    return state.replace(pipeline_state=pipeline._replace(task=pipeline.task._replace(**changes)))


def with_ball(physics, position=None, velocity=None, spin=None):
    """`physics` with another ball; the free joint comes after the six hinges."""
    qpos, qvel = physics.qpos, physics.qvel
    if position is not None:
        qpos = qpos.at[6:9].set(jnp.array(position))
    if velocity is not None:
        qvel = qvel.at[6:9].set(jnp.array(velocity))
    if spin is not None:
        qvel = qvel.at[9:12].set(jnp.array(spin))
    return physics._replace(qpos=qpos, qvel=qvel)


def with_physics(state, physics):
    return state.replace(pipeline_state=state.pipeline_state._replace(physics=physics))


def all_finite(tree) -> bool:
    return all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tree))


def assert_identical(first, second):
    """Bit for bit."""
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


@pytest.fixture(scope="module")
def walked(reset, step):
    """A state in motion, with a spinning ball so that no entry of the observation is trivial."""
    state = reset(jax.random.key(3))
    physics = with_ball(state.pipeline_state.physics, velocity=(0.3, -0.2, 1.0), spin=(4, -7, 5))
    state = with_physics(state, physics)
    for action in np.random.default_rng(0).uniform(-1, 1, (4, 6)):
        state = step(state, jnp.array(action, jnp.float32))
    return state


def test_the_observation_is_mujocos_state(walked, model):
    data = mj_data(model, walked.pipeline_state.physics)
    ball = data.joint("ball_link").qvel
    expected = (
        (slice(0, 6), [data.joint(j).qpos[0] for j in JOINTS]),
        (slice(6, 9), data.body("ball_link").xpos),
        (slice(9, 13), data.body("ball_link").xquat),
        (slice(13, 19), [data.joint(j).qvel[0] for j in JOINTS]),
        (slice(19, 22), ball[:3]),
        (slice(22, 25), ball[3:]),
        (slice(25, 28), data.geom("blocker").xpos),
    )
    for entries, values in expected:
        assert np.all(np.abs(values) > 1e-4), "too small to tell from zero"
        np.testing.assert_allclose(walked.obs[entries], values, rtol=0, atol=1e-6)
    assert walked.obs.shape == (29,) and walked.obs.dtype == jnp.float32
    assert walked.obs[28] == walked.pipeline_state.goal["target_height"]


N_RESETS = 2000


@pytest.fixture(scope="module")
def resets(env):
    """A batch of resets, each from its own key."""
    keys = jax.random.split(jax.random.key(7), N_RESETS)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(env.reset))(keys))


def reset_noise(resets) -> np.ndarray:
    """The random entries [N, 16] of the resets, scaled to a uniform distribution in [-1, 1]."""
    obs = resets.obs.astype(np.float64)
    angles, position = (obs[:, 0:6] - DEFAULT_ANGLES) / 0.1, (obs[:, 6:9] - BALL) / 0.01
    return np.concatenate([angles, obs[:, 13:19] / 0.01, position, (obs[:, 28:] - 0.5) / 0.1], 1)


def test_reset_noise_is_uniform_and_independent(resets):
    noise = reset_noise(resets)
    # Rounding of a coordinate of order 1 to float32, in units of the smallest half-width, 0.01.
    assert np.abs(noise).max() <= 1.0 + 3 * FLOAT32_EPS / 0.01
    # Five standard errors of each estimate for a uniform variable.
    assert np.abs(noise.mean(axis=0)).max() < 5 / np.sqrt(3 * N_RESETS)
    spread_error = np.abs(noise.std(axis=0) * np.sqrt(3) - 1)
    assert spread_error.max() < 5 * np.sqrt(0.2 / N_RESETS)
    quartiles = np.mean(np.abs(noise) < 0.5, axis=0)
    assert np.abs(quartiles - 0.5).max() < 5 * 0.5 / np.sqrt(N_RESETS)
    correlation = np.corrcoef(noise.T) - np.eye(16)
    assert np.abs(correlation).max() < 5 / np.sqrt(N_RESETS)


def test_reset_has_a_resting_ball_and_no_history(resets):
    task = resets.pipeline_state.task
    np.testing.assert_array_equal(resets.obs[:, 9:13], np.tile([1, 0, 0, 0], (N_RESETS, 1)))
    np.testing.assert_array_equal(resets.obs[:, 19:25], 0)
    np.testing.assert_array_equal(task.n_bounces, 0)
    np.testing.assert_array_equal(resets.pipeline_state.last_action, 0)
    np.testing.assert_array_equal(task.rising, False)
    np.testing.assert_array_equal(task.apex, resets.obs[:, 8])
    np.testing.assert_array_equal(resets.done, 0)
    np.testing.assert_array_equal(resets.reward, 0)
    assert all(np.all(value == 0) for value in resets.metrics.values())


NO_NOISE = {"joint_angles": 0, "joint_velocities": 0, "ball_position": 0}


def test_noise_free_reset_has_the_paddle_at_home():
    config = EnvConfig(reset=NO_NOISE, target_height_range=(0.8, 0.8))
    obs = jax.jit(BounceBall(config).reset)(jax.random.key(0)).obs
    np.testing.assert_allclose(obs[0:6], DEFAULT_ANGLES, atol=1e-7)
    np.testing.assert_allclose(obs[6:9], [0.58856, 0, 0.45], atol=1e-7)
    np.testing.assert_allclose(obs[25:28], [0.59356, 0, 0.04980], atol=1e-5)
    np.testing.assert_allclose(obs[25:28], PADDLE_HOME, atol=1e-5)
    assert obs[28] == np.float32(0.8)


def test_servo_target_is_clipped_to_the_joint_range(env, reset, model):
    state = reset(jax.random.key(0)).pipeline_state
    ranges = np.array([model.joint(name).range for name in JOINTS])
    for side, sign in ((0, -1.0), (1, 1.0)):
        qpos = state.physics.qpos.at[:6].set(jnp.array(ranges[:, side] - sign * 0.005))
        at_limit = state._replace(physics=state.physics._replace(qpos=qpos))
        outwards = env.control(at_limit, jnp.full(6, sign))[0].ctrl
        np.testing.assert_allclose(outwards, ranges[:, side], rtol=1e-6)
        inwards = env.control(at_limit, jnp.full(6, -sign))[0].ctrl
        np.testing.assert_allclose(inwards, ranges[:, side] - sign * 0.025, rtol=0, atol=2e-6)


def test_action_adds_to_the_last_target_within_its_lead():
    """The arm does not move meanwhile; the targets lead it by at most max_lead and one action."""
    env = BounceBall(EnvConfig(action={"base": "target", "max_lead": 0.05}))
    state = jax.jit(env.reset)(jax.random.key(0)).pipeline_state
    angles = state.physics.qpos[:6]
    for lead in (0.02, 0.04, 0.06, 0.07, 0.07):
        control, actuation = env.control(state, jnp.ones(6))
        state = state._replace(actuation=actuation)
        np.testing.assert_allclose(control.ctrl - angles, lead, atol=1e-6)
    control, _ = env.control(state, -jnp.ones(6))
    np.testing.assert_allclose(control.ctrl - angles, 0.03, atol=1e-6)


def test_action_is_clipped_to_one(reset, step):
    state = reset(jax.random.key(0))
    signs = jnp.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    at_limit = step(state, signs)
    assert_identical(step(state, 5.0 * signs), at_limit)
    assert_identical(step(state, jnp.inf * signs), at_limit)
    assert not np.allclose(step(state, 0.5 * signs).obs[:6], at_limit.obs[:6], atol=1e-4)
    np.testing.assert_array_equal(at_limit.pipeline_state.last_action, signs)


def c_step(model, physics, action) -> mujoco.MjData:
    """One control step by MuJoCo's C engine: the action as the specification defines it, then 10
    substeps."""
    data = mj_data(model, physics)
    for name, entry in zip(JOINTS, np.clip(action, -1, 1), strict=True):
        target = np.clip(data.joint(name).qpos[0] + 0.02 * entry, *model.joint(name).range)
        (actuator,) = np.flatnonzero(model.actuator_trnid[:, 0] == model.joint(name).id)
        data.ctrl[actuator] = target
    for _ in range(10):
        mujoco.mj_step(model, data)
    return data


def test_step_equals_ten_substeps_of_mujoco(env, reset, step, model):
    rng = np.random.default_rng(1)
    touched = 0
    for seed in range(12):
        state = reset(jax.random.key(seed))
        physics = state.pipeline_state.physics
        # Every second ball is about to hit the paddle.
        if seed % 2:
            position = np.asarray(state.obs[25:28]) + [0, 0, 0.035]
            physics = with_ball(physics, position, (0.1, 0, -2), (1, 2, 3))
        action = rng.uniform(-2, 2, 6).astype(np.float32)
        after = step(with_physics(state, physics), jnp.array(action)).pipeline_state.physics
        data = c_step(model, physics, action)
        touched += data.qvel[8] > -2
        np.testing.assert_allclose(after.qpos, data.qpos, rtol=0, atol=2e-6)
        np.testing.assert_allclose(after.qvel, data.qvel, rtol=0, atol=1e-4)
    assert touched >= 6


@pytest.fixture(scope="module")
def episodes(reset, step):
    """Pairs (state before, action, state after) of a few random episodes up to their ends."""
    rng = np.random.default_rng(5)
    transitions = []
    for seed in range(6):
        state = reset(jax.random.key(100 + seed))
        for _ in range(80):
            action = rng.uniform(-1.5, 1.5, 6).astype(np.float32)
            before, state = state, step(state, jnp.array(action))
            transitions.append(jax.device_get((before, action, state)))
            if state.done:
                break
    return transitions


def test_a_step_reports_the_terms_of_its_reward_and_the_metrics(episodes, reset):
    names = {f"reward/{name}" for name in term_names(Rewards)}
    others = {"bounced", "n_bounces", "ball_xy_error", "apex_error", "apex_offset"}
    assert set(reset(jax.random.key(0)).metrics) == names | others | {"non_finite", "too_fast"}
    for _, action, after in episodes:
        assert set(after.metrics) == names | others | {"non_finite", "too_fast"}
        total = sum(after.metrics[name] for name in names)
        np.testing.assert_allclose(after.reward, total, rtol=1e-5, atol=1e-5)
        error = np.hypot(*(after.obs[6:8] - TARGET_XY))
        np.testing.assert_allclose(after.metrics["ball_xy_error"], error, rtol=1e-5, atol=1e-7)
        np.testing.assert_array_equal(after.pipeline_state.last_action, np.clip(action, -1, 1))
        assert after.metrics["non_finite"] == 0


def test_reward_terms_follow_the_state(episodes, model):
    """The terms equal the specification's formulas, evaluated on the state of MuJoCo's C engine."""
    rows = []
    for before, action, after in episodes:
        data = mj_data(model, after.pipeline_state.physics)
        rows.append(
            {
                "ball_position": data.body("ball_link").xpos.copy(),
                "ball_velocity": data.joint("ball_link").qvel[:3].copy(),
                "paddle_position": data.geom("blocker").xpos.copy(),
                "target_height": before.pipeline_state.goal["target_height"],
                "n_bounces": after.metrics["n_bounces"],
                "bounced": after.metrics["bounced"] > 0,
                "action": np.clip(action, -1, 1),
                "last_action": before.pipeline_state.last_action,
                "joint_velocity": [data.joint(name).qvel[0] for name in JOINTS],
            }
        )
    assert any(row["bounced"] for row in rows)
    inputs = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    for name, expected in reference_terms(**inputs).items():
        actual = np.array([after.metrics[f"reward/{name}"] for _, _, after in episodes])
        np.testing.assert_allclose(
            actual, REFERENCE_WEIGHTS[name] * expected, rtol=1e-3, atol=1e-4, err_msg=name
        )


# Bounces

PADDLE_Z = 0.05


def drive(steps, start_height=0.45, target=0.5, config=None):
    """Feeds ball heights and vertical velocities, one pair per step, to `Bounce.detect`.

    Returns:
      bounced and n_bounces after each step, and the last state of the task.
    """
    detect = jax.jit(Bounce(config or EnvConfig()).detect)
    state = State(
        rising=jnp.asarray(False), n_bounces=jnp.float32(0), apex=jnp.float32(start_height)
    )
    bounced, counts = [], []
    for z, vz in steps:
        truth = dict.fromkeys(Kinematics._fields) | {
            "ball_position": jnp.array([0.5, 0.0, z]),
            "ball_velocity": jnp.array([0.0, 0.0, vz]),
            "paddle_position": jnp.array([0.55, 0.0, PADDLE_Z]),
        }
        step = Step(Kinematics(**truth), {"target_height": target}, None, None)
        state, is_bounce = detect(state, step)
        bounced.append(bool(is_bounce))
        counts.append(float(state.n_bounces))
    return bounced, counts, state


def flights(*apexes):
    """Steps that reach each apex and then bounce."""
    return [pair for apex in apexes for pair in ((apex, 0.0), (0.1, -2.0), (0.1, 2.0))]


@pytest.mark.parametrize(
    ("apexes", "settings", "expected"),
    [
        pytest.param([0.5, 0.5, 0.5, 0.39, 0.5], {}, [1, 2, 3, 1, 2], id="too low restarts at 1"),
        pytest.param([0.5, 0.399], {}, [1, 1], id="just below the tolerance"),
        pytest.param([0.5, 0.401], {}, [1, 2], id="just within the tolerance"),
        pytest.param([0.5, 1.3], {}, [1, 2], id="far above the target"),
        pytest.param([0.15, 0.15], {"start_height": 0.15}, [1, 1], id="dribbling"),
        pytest.param([0.5, 0.5], {"target": 0.8}, [1, 1], id="another target"),
        pytest.param(
            [0.5, 0.31, 0.29], {"config": EnvConfig(apex_tolerance=0.2)}, [1, 2, 1], id="tolerance"
        ),
    ],
)
def test_bounce_count(apexes, settings, expected):
    bounced, counts, _ = drive(flights(*apexes), **settings)
    assert bounced == [False, False, True] * len(apexes) and counts[2::3] == expected


def test_apex_is_the_highest_point_since_the_bounce():
    falling = [(0.52, -0.5), (0.4, -1.5), (0.1, -2.0)]
    _, _, task = drive(flights(0.5) + falling)
    assert task.apex == np.float32(0.52)
    bounced, counts, task = drive(flights(0.5) + falling + [(0.12, 1.0)])
    assert bounced[-1] and counts[-1] == 2 and task.apex == np.float32(0.12)


def test_bounce_is_near_the_paddle():
    for side, (distance, expected) in itertools.product((1, -1), ((0.119, True), (0.121, False))):
        z = PADDLE_Z + side * distance
        bounced, counts, _ = drive([(z, -2.0), (z, 2.0)])
        assert bounced == [False, expected] and counts[-1] == expected
    # A ball that began to rise far away does not bounce near the paddle.
    assert drive([(0.4, -1.0), (0.4, 1.0), (0.1, 1.0)])[0] == [False, False, False]


def test_rising_starts_at_one_centimetre_per_second():
    """A ball that keeps rising does not bounce again."""
    for velocities, expected in (
        ([-1.0, 0.009, 0.011, 2.0], [False, False, True, False]),
        ([-1.0, 0.011, 0.009, 0.011], [False, True, False, True]),
    ):
        assert drive([(0.1, v) for v in velocities])[0] == expected


def test_step_reports_the_bounce(reset, finish, apex=0.47, error=0.03):
    state = with_task(
        reset(jax.random.key(0)), target_height=0.5, n_bounces=4, rising=False, apex=apex
    )
    above_paddle = np.asarray(state.obs[25:28]) + [0, 0, 0.05]
    physics = state.pipeline_state.physics
    rising = finish(state, jnp.zeros(6), with_ball(physics, above_paddle, (0, 0, 2.0)))
    assert rising.metrics["bounced"] == 1
    assert rising.metrics["n_bounces"] == 5
    np.testing.assert_allclose(rising.metrics["apex_error"], error, atol=1e-6)
    np.testing.assert_allclose(abs(rising.metrics["apex_offset"]), error, atol=1e-6)
    falling = finish(state, jnp.zeros(6), with_ball(physics, above_paddle, (0, 0, -2.0)))
    assert falling.metrics["bounced"] == 0
    assert falling.metrics["n_bounces"] == 4
    assert falling.metrics["apex_error"] == 0


def test_ball_ends_the_episode_beyond_its_bound(reset, finish):
    """It fell, is too high above its target, or too far away along an axis."""
    state = reset(jax.random.key(0))
    bounds = [(2, 0.0501, 0.0499, 0.5), (2, 1.499, 1.501, 0.5), (2, 1.599, 1.601, 0.6)]
    bounds += [(axis, sign * 1.499, sign * 1.501, 0.5) for axis in (0, 1) for sign in (1, -1)]
    for axis, inside, outside, target in bounds:
        for coordinate, done in ((inside, 0), (outside, 1)):
            position = np.array([0.5, 0.0, 0.5])
            position[axis] = coordinate
            physics = with_ball(state.pipeline_state.physics, position)
            after = finish(with_task(state, target_height=target), jnp.zeros(6), physics)
            assert after.done == done


def test_fast_joint_ends_the_episode(reset, finish):
    """A fast or spinning ball does not."""
    state = reset(jax.random.key(0))
    physics = state.pipeline_state.physics
    for joint, sign in itertools.product(range(6), (1, -1)):
        for factor, done in ((0.999, 0), (1.001, 1)):
            speed = sign * factor * 2 * np.pi
            moving = physics._replace(qvel=physics.qvel.at[joint].set(speed))
            assert finish(state, jnp.zeros(6), moving).done == done
    fast = with_ball(physics, velocity=(7, 7, 7), spin=(50, 50, 50))
    assert finish(state, jnp.zeros(6), fast).done == 0


@pytest.fixture(scope="module")
def finish_each(env):
    """`finish_step` of one state for a batch of physics states."""
    return jax.jit(jax.vmap(functools.partial(finished, env), in_axes=(None, None, 0)))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e38])
def test_non_finite_physics_ends_the_episode_and_does_not_spread(value, walked, finish_each):
    """Also finite speeds whose squares overflow, beyond MuJoCo's own limit of 1e10 (mjMAXVAL)."""
    before = walked.pipeline_state
    qpos, qvel = np.tile(before.physics.qpos, (25, 1)), np.tile(before.physics.qvel, (25, 1))
    qpos[np.arange(13), np.arange(13)] = value
    qvel[13 + np.arange(12), np.arange(12)] = value
    physics = before.physics._replace(qpos=jnp.array(qpos), qvel=jnp.array(qvel))
    after = finish_each(walked, jnp.ones(6), physics)
    np.testing.assert_array_equal(after.done, 1)
    np.testing.assert_array_equal(after.metrics["non_finite"], 1)
    assert all_finite(after)
    # Two programs round the paddle's position differently.
    np.testing.assert_allclose(after.obs, np.tile(walked.obs, (25, 1)), rtol=1e-6, atol=1e-7)


# An action that acts later, and is seen and remembered in every place.
LATE = EnvConfig(
    action={"base": "target"},
    observation={"action": 2, "servo_lead": 1},
    randomization={"action_latency": (0.03, 0.03), "servo_lag": (0.01, 0.01)},
)


@pytest.mark.parametrize("config", [EnvConfig(), LATE], ids=["at once", "late"])
def test_nan_action_ends_the_episode_and_acts_as_zero(config):
    """All entries or one of them, in the command, in the memories and in the observation."""
    env = BounceBall(config)
    state = jax.jit(env.reset)(jax.random.key(3))

    @jax.jit
    def step_on_the_spot(action):
        control, actuation = env.control(state.pipeline_state, action)
        physics = state.pipeline_state.physics
        return control, env.finish_step(state, action, actuation, physics)

    control_at_rest, at_rest = step_on_the_spot(jnp.zeros(6))
    for broken in (range(6), [2]):
        action = jnp.full(6, 0.5).at[jnp.array(list(broken))].set(jnp.nan)
        control, after = step_on_the_spot(action)
        assert_identical(control, control_at_rest)
        assert after.done == 1 and after.metrics["non_finite"] == 1 and at_rest.done == 0
        metrics = at_rest.metrics | {"non_finite": after.metrics["non_finite"]}
        assert_identical(after, at_rest.replace(done=after.done, metrics=metrics))


@pytest.mark.slow
def test_gradient_through_steps_with_a_contact_equals_finite_differences(quick_compilation):
    """The derivative of the summed rewards of five steps, in which the ball hits the paddle, along
    a direction of the actions, against central differences of the fourth order."""
    with jax.enable_x64(True):
        env = BounceBall()
        state = jax.jit(env.reset)(jax.random.key(0))
        paddle = env.kinematics(state.pipeline_state).paddle_position
        physics = with_ball(state.pipeline_state.physics, paddle + jnp.array([0.01, 0.0, 0.04]))
        physics = physics._replace(qvel=physics.qvel.at[8].set(-1.5))
        state = with_physics(state, physics)
        rng = np.random.default_rng(0)
        actions, direction = (jnp.array(rng.uniform(-0.5, 0.5, (5, 6))) for _ in range(2))

        def total(actions):
            after, rewards = jax.lax.scan(
                lambda state, action: (lambda s: (s, s.reward))(env.step(state, action)),
                state,
                actions,
            )
            return rewards.sum(), after.metrics["n_bounces"]

        (_, bounces), gradient = jax.jit(jax.value_and_grad(total, has_aux=True))(actions)
        assert bounces == 1.0
        evaluate, step = jax.jit(lambda actions: total(actions)[0]), 1e-4
        near, far = (
            evaluate(actions + i * step * direction) - evaluate(actions - i * step * direction)
            for i in (1.0, 2.0)
        )
        expected = (8.0 * near - far) / (12.0 * step)
        actual = jnp.vdot(gradient, direction)
    assert np.isfinite(gradient).all() and (np.abs(gradient) > 0.0).all()
    np.testing.assert_allclose(actual, expected, rtol=1e-6)
