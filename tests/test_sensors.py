"""Late, noisy and lossy sensors are those of a simulation, and random numbers are random."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import stats
from scipy.interpolate import CubicHermiteSpline

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.env.env import _instant
from bounce_mjx.physics import PhysicsState
from bounce_mjx.world import noise

PARTS = {
    "joint_angles": 3, "ball_position": 4, "ball_quaternion": 0, "joint_velocities": 2,
    "ball_velocity": 2, "ball_angular_velocity": 0, "paddle_position": 1, "target_height": 1,
    "action": 3, "ball_age": 1, "apex_error": 3, "bounce_position": 3, "bounce_interval": 3,
    "bounce_joint_angles": 2, "bounce_joint_velocities": 2,
}  # fmt: skip
SENSORS = {
    "ball_latency": (0.0, 0.03), "camera_rate": (50.0, 250.0), "frame_drop": (0.0, 0.9),
    "ball_position_noise": (0.0, 0.2), "ball_position_bias": (-0.3, 0.3),
    "ball_velocity_noise": (0.0, 1.0), "ball_velocity_bias": (-1.0, 1.0),
    "joint_angle_noise": (0.0, 0.05), "encoder_bias": (-0.3, 0.3),
    "joint_velocity_noise": (0.0, 1.0), "joint_velocity_bias": (-1.0, 1.0),
}  # fmt: skip
PERFECT = {name: (0.0, 0.0) for name in SENSORS} | {"camera_rate": (50.0, 250.0)}
EPISODES, STEPS, DT = 32, 150, 0.01


def trajectory() -> tuple[np.ndarray, np.ndarray]:
    """Trajectory of a bouncing ball over a swaying arm: qpos and qvel [T + 1]. The ball starts at
    rest."""
    time = DT * np.arange(STEPS + 1)
    qpos, qvel = np.zeros((STEPS + 1, 13)), np.zeros((STEPS + 1, 12))
    qpos[:, 9] = 1.0
    phases = np.arange(6)
    home = np.array(EnvConfig().default_joint_angles)
    qpos[:, :6] = home + 0.01 * np.sin(3.0 * time[:, None] + phases)
    qvel[:, :6] = 0.03 * np.cos(3.0 * time[:, None] + phases)
    z, vz = 0.35, 0.0
    for t in range(STEPS + 1):
        qpos[t, 6:9] = 0.59 + 0.02 * np.sin(5 * time[t]), 0.01 * np.cos(4 * time[t]), z
        qvel[t, 6:9] = 0.1 * np.cos(5 * time[t]), -0.04 * np.sin(4 * time[t]), vz
        z, vz = z + vz * DT, vz - 9.81 * DT
        if z < 0.075 and vz < 0.0:
            vz = 2.2 + 0.3 * np.sin(t)
    qvel[0, 6:9] = 0.0
    return qpos, qvel


class Watch(NamedTuple):
    """Observations of the trajectory: [N, T, ...]."""

    world: dict
    phase: np.ndarray
    first: dict
    """Values of each part at the reset [N, n, size]."""
    parts: dict
    """Values of each part [N, T, n, size], the newest first."""
    actions: np.ndarray
    targets: np.ndarray
    """Servo targets [N, T, 6]."""
    privileged: dict
    """Metrics for the critic alone [N, T]."""
    rewards: np.ndarray
    """[N, T]."""


@functools.cache
def watching(camera: bool, velocity: str):
    """Compiled function (ranges) -> `Watch` of an environment with these sensors."""
    sensors = {name: r for name, r in SENSORS.items() if camera or name != "camera_rate"}
    observation = PARTS | {"velocity": velocity}
    env = BounceBall(EnvConfig(randomization=sensors, observation=observation))
    qpos, qvel = trajectory()
    actions = np.random.default_rng(4).uniform(-1, 1, (STEPS, 6))

    @jax.jit
    def watch(ranges, keys):
        def of_one(key, ranges):
            start = env.reset(key, ranges)
            physics = PhysicsState(jnp.asarray(qpos[0]), jnp.asarray(qvel[0]))
            pipeline = start.pipeline_state._replace(physics=physics)
            # The first memory must also have the ball of the trajectory.
            memory = env._sensors.first(_instant(pipeline, env.kinematics(pipeline)))
            pipeline = pipeline._replace(sensing=memory)
            start = start.replace(pipeline_state=pipeline, obs=env.observe(pipeline))

            def step(state, inputs):
                action, physics = inputs
                control, actuation = env.control(state.pipeline_state, action)
                state = env.finish_step(state, action, actuation, physics)
                metrics = {
                    n: x for n, x in state.metrics.items() if n.startswith(("world/", "true/"))
                }
                return state, (state.obs, control.ctrl, metrics, state.reward)

            physics = PhysicsState(jnp.asarray(qpos[1:]), jnp.asarray(qvel[1:]))
            _, seen = jax.lax.scan(step, start, (jnp.asarray(actions), physics))
            return start.pipeline_state.world, pipeline.clock.camera_phase, start.obs, *seen

        return jax.vmap(of_one)(keys, ranges)

    def run(**changed: tuple[float, float]) -> Watch:
        ranges = {name: PERFECT[name] for name in sensors} | changed
        ranges = {n: tuple(jnp.full(EPISODES, e) for e in r) for n, r in ranges.items()}
        keys = jax.random.split(jax.random.PRNGKey(0), EPISODES)
        world, phase, first, obs, targets, privileged, rewards = jax.device_get(watch(ranges, keys))

        def parts(obs: np.ndarray) -> dict[str, np.ndarray]:
            return {
                part.name: obs[..., env.layout[part.name]].reshape(
                    *obs.shape[:-1], PARTS[part.name], -1
                )
                for part in env.layout.parts
            }

        return Watch(world, phase, parts(first), parts(obs), actions, targets, privileged, rewards)

    return run


@pytest.fixture
def watch(float64):
    return watching(camera=True, velocity="measured")


def ball_path() -> Callable[[np.ndarray], np.ndarray]:
    """Position of the ball between the control steps, by the positions and velocities at them. The
    ball rests before the reset."""
    qpos, qvel = trajectory()
    path = CubicHermiteSpline(DT * np.arange(STEPS + 1), qpos[:, 6:9], qvel[:, 6:9])
    return lambda times: path(np.maximum(times, 0.0))


def pictures(world: dict, phase: float, w: int):
    """Measured position, velocity and age at the reset and each control step, frame by frame: the
    camera takes picture n at (n + phase) / rate, and the picture arrives after the latency."""
    qpos, qvel = trajectory()
    time = DT * np.arange(STEPS + 1)
    rate, latency = float(world["camera_rate"][w]), float(world["ball_latency"][w])
    taken = (np.arange(-100, 2000) + phase) / rate
    taken = taken[taken < time[-1]]

    positions = ball_path()(taken)
    velocities = np.stack([np.interp(taken, time, column) for column in qvel[:, 6:9].T], axis=1)
    for now in time:
        n = np.flatnonzero(taken + latency <= now + 1e-4 / rate)[-1]
        yield n, positions[n], velocities[n], now - taken[n]


def test_the_reward_is_of_the_true_state(watch) -> None:
    """Whatever the sensors measure."""
    wrong, right = watch(**SENSORS), watch()
    error = wrong.parts["ball_position"] - right.parts["ball_position"]
    assert np.all(np.max(np.abs(error), axis=(1, 2, 3)) > 0.05)
    np.testing.assert_array_equal(wrong.rewards, right.rewards)
    assert np.std(right.rewards) > 0.0


@pytest.mark.slow
def test_camera_is_that_of_a_simulation(watch) -> None:
    """Rates of 50 to 250 Hz and latencies of 0 to 30 ms, any phase, no noise."""
    seen = watch(ball_latency=(0.0, 0.03))
    for w in range(EPISODES):
        expected = list(pictures(seen.world, seen.phase[w], w))
        _, position, velocity, age = (np.array(x) for x in zip(*expected, strict=True))
        for name, values, atol in (
            ("ball_position", position, 2e-5),
            ("ball_velocity", velocity, 2e-3),
            ("ball_age", age[:, None], 2e-6),
        ):
            np.testing.assert_allclose(seen.parts[name][w, :, 0], values[1:], atol=atol)
            np.testing.assert_allclose(seen.first[name][w, 0], values[0], atol=atol)
    held = np.diff(seen.parts["ball_position"][:, :, 0], axis=1) == 0.0
    rate = np.asarray(seen.world["camera_rate"])
    assert np.all(held.all(axis=2).any(axis=1)[rate < 90]), "a slow camera holds its picture"


def test_lost_pictures_do_not_come_later(watch) -> None:
    """At 60 Hz, a control step has at most one new picture; a share of the pictures is lost."""
    seen = watch(frame_drop=(0.3, 0.3), camera_rate=(60.0, 60.0))
    new, lost = 0, 0
    for w in range(EPISODES):
        reset, *expected = pictures(seen.world, seen.phase[w], w)
        position, age = seen.parts["ball_position"][w, :, 0], seen.parts["ball_age"][w, :, 0, 0]
        last = reset[1]
        for t, now in enumerate(expected):
            due = now[0] > (expected[t - 1] if t else reset)[0]
            is_new = due and np.abs(position[t] - now[1]).max() < 2e-5
            last = now[1] if is_new else last
            np.testing.assert_allclose(position[t], last, atol=2e-5)
            # At first the ball is at rest and looks the same in all pictures.
            if t >= 10:
                new, lost = new + due, lost + (due and not is_new)
                assert not is_new or age[t] == pytest.approx(now[3], abs=2e-6)
    share = lost / new
    assert abs(share - 0.3) < 4 * np.sqrt(0.21 / new)
    # At 250 Hz, the two or three pictures of a control step are lost together.
    fast = watch(frame_drop=(0.5, 0.5), camera_rate=(250.0, 250.0))
    growth = np.diff(fast.parts["ball_age"][:, :, 0, 0], axis=1)
    is_held = np.isclose(growth, DT, atol=1e-6)
    assert abs(is_held.mean() - 0.5) < 4 * np.sqrt(0.25 / is_held.size)


def test_noise_has_its_size_and_is_held_with_the_picture(watch) -> None:
    sizes = {
        "ball_position": 0.02, "ball_velocity": 0.3, "joint_angle": 0.01, "joint_velocity": 0.2,
    }  # fmt: skip
    noisy = {f"{name}_noise": (size, size) for name, size in sizes.items()}
    seen, clean = watch(**noisy, camera_rate=(50.0, 50.0)), watch(camera_rate=(50.0, 50.0))
    for name, part in (
        ("ball_position", "ball_position"),
        ("ball_velocity", "ball_velocity"),
        ("joint_angle", "joint_angles"),
        ("joint_velocity", "joint_velocities"),
    ):
        error = (seen.parts[part] - clean.parts[part])[:, 5:, 0]
        if "ball" in name:
            held = np.all(clean.parts["ball_age"][:, 6:] > clean.parts["ball_age"][:, 5:-1], axis=2)
            held = held[..., 0]
            assert 0.4 < held.mean() < 0.6
            np.testing.assert_allclose(error[:, 1:][held], error[:, :-1][held], atol=1e-12)
            error = error[:, 1:][~held]
        error = error.reshape(-1, error.shape[-1]) / sizes[name]
        assert stats.kstest(error.ravel(), "norm").pvalue > 1e-4
        correlation = np.corrcoef(error.T) - np.eye(error.shape[1])
        assert np.abs(correlation).max() < 6 / np.sqrt(len(error))
    # The paddle's measured position follows from the wrong angles.
    assert np.abs(seen.parts["paddle_position"] - clean.parts["paddle_position"]).max() > 1e-3


def test_biases_are_constant_in_an_episode(watch) -> None:
    names = {
        "ball_position_bias": "ball_position", "ball_velocity_bias": "ball_velocity",
        "encoder_bias": "joint_angles", "joint_velocity_bias": "joint_velocities",
    }  # fmt: skip
    seen = watch(**dict.fromkeys(names, (-0.05, 0.05)), camera_rate=(100.0, 100.0))
    clean = watch(camera_rate=(100.0, 100.0))
    for bias, part in names.items():
        error = seen.parts[part][:, 5:, 0] - clean.parts[part][:, 5:, 0]
        expected = np.broadcast_to(seen.world[bias][:, None], error.shape)
        np.testing.assert_allclose(error, expected, atol=1e-9)
        assert np.unique(expected[:, 0].round(9)).size == expected[:, 0].size


def test_servo_targets_start_from_the_measured_angles(watch) -> None:
    """With the noise that the policy saw. The servo shares the error of its encoder's zero, which
    therefore has no effect on the true target."""
    seen = watch(joint_angle_noise=(0.01, 0.01), encoder_bias=(-0.05, 0.05))
    angles = seen.parts["joint_angles"][:, :-1, 0]
    angles = np.concatenate([seen.first["joint_angles"][:, :1], angles], axis=1)
    measured = angles - seen.world["encoder_bias"][:, None]
    np.testing.assert_allclose(seen.targets, measured + 0.02 * seen.actions, atol=1e-7)
    assert np.abs(measured - trajectory()[0][:-1, :6]).max() > 0.03


def test_the_critic_may_see_the_world_and_the_truth(watch, mj_model) -> None:
    seen = watch(**{name: (0.5, 1.0) for name in SENSORS if name.endswith(("noise", "bias"))})
    qpos, qvel = (x[1:] for x in trajectory())
    data, paddle = mujoco.MjData(mj_model), []
    for data.qpos[:] in qpos:
        mujoco.mj_kinematics(mj_model, data)
        paddle.append(data.geom("blocker").xpos.copy())
    hidden = {
        "joint_angles": qpos[:, :6], "ball_position": qpos[:, 6:9],
        "joint_velocities": qvel[:, :6], "ball_velocity": qvel[:, 6:9],
        "ball_angular_velocity": qvel[:, 9:], "paddle_position": np.array(paddle),
    }  # fmt: skip
    expected = {f"world/{name}": x[:, None] for name, x in seen.world.items() if x.ndim == 1}
    arrays = {f"world/{n}": x[:, None] for n, x in seen.world.items() if x.ndim == 2}
    arrays |= {f"true/{n}": x[None] for n, x in hidden.items()}
    for name, array in arrays.items():
        expected |= {f"{name}_{i}": array[..., i] for i in range(array.shape[-1])}
    assert seen.privileged.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_allclose(
            seen.privileged[name],
            np.broadcast_to(values, (EPISODES, STEPS)),
            atol=1e-12,
            err_msg=name,
        )
    assert np.abs(seen.parts["ball_position"][:, :, 0] - hidden["ball_position"]).max() > 1.0


def test_bounces_are_those_of_the_measurements(watch) -> None:
    """Against an offline evaluation of all measured heights at once."""
    seen = watch(ball_position_noise=(0.002, 0.002), camera_rate=(120.0, 120.0))
    for w in range(4):
        part = {name: values[w] for name, values in seen.parts.items()}
        ball, target = part["ball_position"][:, 0], part["target_height"][0, 0, 0]
        low = ball[:, 2] < part["paddle_position"][:, 0, 2] + EnvConfig().bounce_max_distance
        starts = [t for t in range(STEPS) if low[t] and not (t and low[t - 1])]
        assert len(starts) >= 3
        for t in range(starts[0], STEPS):
            begun = [s for s in starts if s <= t][::-1]
            for i, s in enumerate(begun[:3]):
                end = s
                while end + 1 <= t and low[end + 1]:
                    end += 1
                lowest = s + int(np.argmin(ball[s : end + 1, 2]))
                np.testing.assert_array_equal(part["bounce_position"][t, i], ball[lowest, :2])
                if i < 2:
                    angles = part["joint_angles"][lowest, 0]
                    np.testing.assert_array_equal(part["bounce_joint_angles"][t, i], angles)
                    speeds = part["joint_velocities"][lowest, 0]
                    np.testing.assert_array_equal(part["bounce_joint_velocities"][t, i], speeds)
                before = [r for r in starts if r < s]
                # Times since the reset start at 0; the first row is one step later.
                interval = DT * (s - before[-1] if before else s + 1)
                assert part["bounce_interval"][t, i, 0] == pytest.approx(interval, abs=1e-9)
                flown = np.flatnonzero(low[:s])
                flight = ball[flown[-1] if len(flown) else 0 : s, 2]
                start = seen.first["ball_position"][w, 0, 2]
                apex = max(flight.max(), start if not len(flown) else 0.0)
                assert part["apex_error"][t, i, 0] == pytest.approx(apex - target, abs=1e-9)


def test_latency_without_a_camera_and_velocity_by_differences(float64) -> None:
    """A picture at every control step; the velocity is the difference from the previous picture."""
    run = watching(camera=False, velocity="differences")
    seen = run(ball_latency=(0.0, 0.03))
    time = DT * np.arange(STEPS + 1)
    for w, latency in enumerate(np.asarray(seen.world["ball_latency"])):
        then = np.maximum(time[1:] - latency, 0.0)
        expected = ball_path()(then)
        position = seen.parts["ball_position"][w, :, 0]
        # Before the reset there was no path.
        np.testing.assert_allclose(position[3:], expected[3:], atol=1e-9)
        np.testing.assert_allclose(seen.parts["ball_age"][w, :, 0, 0], latency, atol=1e-9)
        velocity = seen.parts["ball_velocity"][w, :, 0]
        np.testing.assert_allclose(velocity[5:], np.diff(expected, axis=0)[4:] / DT, atol=1e-6)
    # No sensor measures the velocity, so its errors do not act.
    noisy = run(ball_latency=(0.0, 0.03), ball_velocity_noise=(1.0, 1.0))
    np.testing.assert_array_equal(noisy.parts["ball_velocity"], seen.parts["ball_velocity"])


COUNT = 20_000


@pytest.fixture(scope="module")
def counters() -> np.ndarray:
    """Counters of consecutive control steps of one environment."""

    def step(counter, _):
        return noise.next_counter(counter), counter

    return jax.lax.scan(step, jnp.int32(12345), None, length=COUNT)[1]


@pytest.mark.parametrize("kind", ["uniform", "norm"])
def test_random_numbers_have_their_distribution(counters, kind: str) -> None:
    generate = {"uniform": noise.uniform, "norm": noise.normal}[kind]
    streams = [
        np.asarray(jax.vmap(lambda c, s=s: generate(c, s, (5,), jnp.dtype("float32")))(counters))
        for s in (0, 1, 4)
    ]
    columns = np.concatenate(streams, axis=1).T.astype(float)
    assert np.all(np.isfinite(columns))
    for column in columns:
        assert stats.kstest(column, kind).pvalue > 1e-4
        # Neighbouring control steps are uncorrelated.
        for lag in (1, 2, 3):
            assert abs(np.corrcoef(column[:-lag], column[lag:])[0, 1]) < 5 / np.sqrt(COUNT)
    correlation = np.corrcoef(columns) - np.eye(len(columns))
    assert np.abs(correlation).max() < 5 / np.sqrt(COUNT)
