"""The Kalman filter of the ball, in the environment and on a robot."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bounce_mjx import BounceBall
from bounce_mjx.deploy.export import policy_metadata
from bounce_mjx.deploy.histories import Histories
from bounce_mjx.gpu.scalars import as_scalars
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.robot.model import load_model
from bounce_mjx.runs import reading
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.folders import pretrained_checkpoint
from bounce_mjx.tasks.bounce import BounceConfig
from bounce_mjx.world.ball_filter import BallFilter, Constants
from bounce_mjx.world.estimator import Estimator, filter_constants
from bounce_mjx.world.sensing import Picture

OBSERVATION = BounceConfig().layout

BALLS, STEPS, DT = 8, 500, 0.01
SEEN = {"ball_position": 1, "ball_velocity": 1}
ENV = {
    "observation": dict.fromkeys(BounceConfig().observation.quantities(), 0)
    | SEEN
    | {"position": "filter", "velocity": "filter"},
    "randomization": {
        "camera_rate": (120.0, 120.0), "ball_latency": (0.02, 0.02),
        "ball_position_noise": (0.002, 0.002),
    },
}  # fmt: skip


class Watched(NamedTuple):
    """Trajectories of bouncing balls [N, T, ...] from the reset on, their pictures, and the
    estimates."""

    position: np.ndarray
    velocity: np.ndarray
    joint_angles: np.ndarray
    picture: np.ndarray
    """Position in the last picture [N, T, 3]."""
    age: np.ndarray
    observation: np.ndarray


@pytest.fixture(scope="module")
def env() -> BounceBall:
    return BounceBall(BounceConfig(**ENV))


@pytest.fixture(scope="module")
def watched(env: BounceBall) -> Watched:
    """The package's policy bounces the balls by their true states; all in float64."""
    checkpoint = pretrained_checkpoint()
    config = load_run_config(checkpoint.run)
    policy = reading.read_policy(checkpoint, config)
    networks = make_networks(config.ppo, OBSERVATION.size, 6)

    def step(state, _):
        pipeline = state.pipeline_state
        truth, picture = env.kinematics(pipeline), pipeline.memory.sensing.picture
        height = {"target_height": pipeline.command["target_height"][None]}
        action = networks.act(policy, OBSERVATION.pack(truth._asdict() | height))
        kinematics = truth.ball_position, truth.ball_velocity, truth.joint_angles
        seen = Watched(*kinematics, picture.position, picture.age, state.obs)
        return env.step(state, action), (seen, state.done)

    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.PRNGKey(0), BALLS)
        run = jax.vmap(lambda key: jax.lax.scan(step, env.reset(key), None, length=STEPS)[1])
        seen, done = jax.device_get(jax.jit(run)(keys))
    assert not done.any() and seen.velocity.dtype == np.float64
    return seen


def differences(seen: Watched) -> np.ndarray:
    """Velocity [N, T, 3] by the difference of the last two pictures, at each control step."""
    taken = DT * np.arange(STEPS) - seen.age
    velocity = np.zeros_like(seen.picture)
    for ball in range(BALLS):
        for t in range(1, STEPS):
            elapsed = taken[ball, t] - taken[ball, t - 1]
            is_new = elapsed > 1e-4
            change = seen.picture[ball, t] - seen.picture[ball, t - 1]
            velocity[ball, t] = change / elapsed if is_new else velocity[ball, t - 1]
    return velocity


def test_filtered_velocity_is_several_times_better_than_differences(env, watched) -> None:
    """At 120 Hz, 2 mm of noise and 20 ms of latency; in flight and around the bounces."""
    layout = env.layout
    velocity = watched.observation[..., layout["ball_velocity"]]
    position = watched.observation[..., layout["ball_position"]]
    vz = watched.velocity[..., 2]
    reversal = np.diff(np.sign(vz), axis=1, prepend=vz[:, :1]) > 0
    near = np.stack([np.roll(reversal, k, axis=1) for k in range(-1, 6)]).any(axis=0)
    near[:, :100] = False
    assert reversal[:, 100:].sum() > 5 * BALLS
    far = ~near
    far[:, :100] = False

    def rms(error: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.square(error))))

    for where in (near, far):
        for axis in range(3):
            ours = rms((velocity - watched.velocity)[where][:, axis])
            theirs = rms((differences(watched) - watched.velocity)[where][:, axis])
            assert ours < theirs / 5.0
    # A picture 20 to 28 ms late is several centimetres away.
    late, now = (rms((p - watched.position)[:, 100:]) for p in (watched.picture, position))
    assert now < 0.002 and late > 0.02


def test_numpy_equals_the_environment(env, watched) -> None:
    """A robot's histories, from the same measurements."""
    metadata = policy_metadata(TrainConfig(env=BounceConfig(**ENV)), 0)

    def measured(ball: int, t: int) -> dict[str, np.ndarray]:
        return {
            "ball_position": watched.picture[ball, t],
            "ball_age": watched.age[ball, t, None],
            "joint_angles": watched.joint_angles[ball, t],
        }

    for ball in range(2):
        histories = Histories(metadata, metadata.observation, measured(ball, 0))
        for t in range(1, STEPS):
            histories.add(measured(ball, t), np.zeros(6))
            seen = np.concatenate([histories.values[name][0] for name in SEEN])
            np.testing.assert_allclose(seen, watched.observation[ball, t], rtol=0, atol=1e-6)


def test_metadata_has_the_constants_of_the_filter() -> None:
    settings = {"restitution": 0.8, "latency": 0.015, "air_drag": 0.1}
    metadata = policy_metadata(TrainConfig(env=BounceConfig(**(ENV | {"estimator": settings}))), 0)
    assert (metadata.position, metadata.velocity) == ("filter", "filter")
    assert settings.items() <= metadata.estimator._asdict().items()
    # Half the paddle's thickness and the ball's radius.
    assert metadata.estimator.contact_distance == pytest.approx(0.0035 + 0.019)
    assert metadata.estimator.gravity == (0.0, 0.0, -9.81)
    assert policy_metadata(TrainConfig(), 0).estimator is None


def test_pictures_without_time_stamps_have_the_expected_latency() -> None:
    """Every position differs, so that each is a new picture."""
    metadata = policy_metadata(
        TrainConfig(env=BounceConfig(**(ENV | {"estimator": {"latency": 0.02}}))), 0
    )
    angles = np.array(metadata.default_joint_angles)

    def estimates(stamp: dict[str, np.ndarray]) -> list[np.ndarray]:
        fall = [{"ball_position": np.array([0.59, 0.0, 0.5 - 5e-4 * t * t])} for t in range(30)]
        histories = Histories(
            metadata, metadata.observation, fall[0] | {"joint_angles": angles} | stamp
        )
        seen = []
        for measured in fall[1:]:
            histories.add(measured | {"joint_angles": angles} | stamp, np.zeros(6))
            seen.append(np.concatenate([histories.values[name][0] for name in SEEN]))
        return seen

    expected = estimates({"ball_age": np.array([0.02])})
    np.testing.assert_array_equal(estimates({}), expected)
    assert np.abs(np.array(estimates({"ball_age": np.array([0.0])})) - expected).max() > 0.02


def test_measurements_of_missed_steps_are_no_pictures() -> None:
    """A late call fills the missed control steps with interpolated measurements; to the filter, the
    last picture is still the newest."""
    metadata = policy_metadata(TrainConfig(env=BounceConfig(**ENV)), 0)
    angles = np.array(metadata.default_joint_angles)

    def measured(height: float, age: float) -> dict[str, np.ndarray]:
        position = np.array([0.59, 0.0, height])
        return {"ball_position": position, "ball_age": np.array([age]), "joint_angles": angles}

    seen = []
    for between, is_real in ((measured(0.45, 0.02), False), (measured(0.5, 0.03), True)):
        histories = Histories(metadata, metadata.observation, measured(0.5, 0.02))
        histories.add(between, np.zeros(6), is_real)
        histories.add(measured(0.4, 0.02), np.zeros(6))
        seen.append([histories.values[name][0] for name in SEEN])
    np.testing.assert_array_equal(*seen)


@pytest.mark.usefixtures("float64")
def test_a_stated_latency_replaces_the_true_one(mj_model) -> None:
    """The age of an unstamped picture is the time since its arrival plus the stated latency."""
    picture = Picture(*map(jnp.array, (0.0, 0.0, 0.017, 0.0)))
    world = {"ball_latency": jnp.array(0.013)}
    for stated, expected in ((None, 0.017), (0.02, 0.024)):
        config = BounceConfig(**(ENV | {"estimator": {"latency": stated}}))
        age = Estimator(config, mj_model, None).age(picture, world)
        assert age == pytest.approx(expected)


# The motion and the estimate, against formulas


def constants(**changes) -> Constants:
    return filter_constants(BounceConfig(**ENV), load_model(None, 0.001))._replace(**changes)


def repeat(count, function, start):
    for _ in range(count):
        start = function(start)
    return start


@pytest.mark.parametrize("restitution", [0.7, 0.85, 0.95])
@pytest.mark.parametrize("paddle_speed", [-0.5, 0.0, 0.8])
def test_a_bounce_takes_the_contact_time_and_has_the_restitution(restitution, paddle_speed) -> None:
    """Falls from several heights, against flight and contact in closed form."""
    ball_filter = BallFilter(constants(restitution=restitution), DT, np, repeat)
    up, g = np.array([0.0, 0.0, 1.0]), 9.81
    # The plane is at height 0 now.
    planes = np.column_stack([np.tile(up, (50, 1)), -paddle_speed * DT * np.arange(50)])
    for gap in np.linspace(0.3, 0.32, 7):
        touch = (-paddle_speed + math.sqrt(paddle_speed**2 + 2.0 * g * gap)) / g
        since = 0.05
        age = touch + 0.01 + since
        track = ball_filter.start((gap - paddle_speed * age) * up, np.float64(age))
        position, velocity = ball_filter.present(track, planes)
        away = restitution * (g * touch + paddle_speed) + paddle_speed
        assert velocity[2] == pytest.approx(away - g * since, abs=0.05)
        there = -paddle_speed * since
        assert position[2] == pytest.approx(there + away * since - 0.5 * g * since**2, abs=0.004)


def test_the_estimate_in_flight_is_that_of_least_squares() -> None:
    """Without process noise, the filter is the regression of all pictures on one parabola, with the
    start as another observation."""
    noise = 0.002
    ball_filter = BallFilter(constants(measurement_noise=noise, process_noise=0.0), DT, np, repeat)
    rng, g = np.random.default_rng(0), np.array([0.0, 0.0, -9.81])
    times = np.array([0.0, 0.01, 0.018, 0.03, 0.035, 0.05, 0.06])
    fall = lambda t: np.array([0.6, 0.0, 2.0]) + np.array([0.3, -0.2, 1.0]) * t + 0.5 * g * t * t  # noqa: E731
    pictures = [fall(t) + noise * rng.standard_normal(3) for t in times]
    planes = np.tile([0.0, 0.0, 1.0, 0.0], (20, 1))
    track = ball_filter.start(pictures[0], np.float64(0.0))
    for before, t, picture in zip(times[:-1], times[1:], pictures[1:], strict=True):
        # The picture arrives 20 ms late.
        track = track._replace(age=np.float64(t - before + 0.02))
        track = ball_filter.add_picture(track, planes, picture, np.float64(0.02))
    position, velocity = ball_filter.present(track, planes)

    rows = np.column_stack([np.ones_like(times), times]) / noise
    rows = np.vstack([rows, [0.0, 1.0 / 0.5]])
    free = np.array([p - 0.5 * g * t * t for t, p in zip(times, pictures, strict=True)]) / noise
    at_start, speed = np.linalg.lstsq(rows, np.vstack([free, np.zeros(3)]), rcond=None)[0]
    now = times[-1] + 0.02
    np.testing.assert_allclose(velocity, speed + g * now, atol=1e-9)
    np.testing.assert_allclose(position, at_start + speed * now + 0.5 * g * now**2, atol=1e-9)
    covariance = np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose(track.velocity_variance, covariance[1, 1], rtol=1e-9)


def test_drag_is_that_of_an_accurate_integration() -> None:
    ball_filter = BallFilter(constants(air_drag=0.2), DT, np, repeat)
    velocity = np.array([1.0, -0.5, 3.0])
    track = ball_filter.start(np.array([0.0, 0.0, 2.0]), np.float64(0.1))
    planes = np.tile([0.0, 0.0, 1.0, 0.0], (12, 1))
    _, after = ball_filter.present(track._replace(velocity=velocity), planes)

    def fall(_, v):
        return np.array([0.0, 0.0, -9.81]) - 0.2 * np.linalg.norm(v) * v

    exact = solve_ivp(fall, (0.0, 0.1), velocity, rtol=1e-10, atol=1e-10).y[:, -1]
    np.testing.assert_allclose(after, exact, atol=2e-3)
    assert np.abs(after - velocity - [0.0, 0.0, -0.981]).max() > 0.05


def test_a_ball_beside_the_paddle_is_not_pushed() -> None:
    ball_filter = BallFilter(constants(), DT, np, repeat)
    planes = np.tile([0.0, 0.0, 1.0, 0.5], (5, 1))
    track = ball_filter.start(np.array([0.9, 0.0, 0.4]), np.float64(0.02))
    _, velocity = ball_filter.present(track, planes)
    np.testing.assert_allclose(velocity, [0.0, 0.0, -9.81 * 0.02], atol=1e-12)


def test_the_estimator_fits_into_a_gpu_kernel() -> None:
    """With an operation that kernels lack, the whole step would be compiled by XLA."""
    config = BounceConfig(**ENV)
    estimator = Estimator(config, load_model(None, 0.001), None)
    ball, plane = jnp.zeros(3), jnp.zeros(4)
    picture = Picture(ball, ball, jnp.zeros(()), jnp.zeros(()))
    world = {"ball_latency": jnp.zeros(())}
    start = estimator.start(picture, world, plane)
    args, tree = jax.tree.flatten((start, world, picture, picture, plane))

    def flat(*args):
        return jax.tree.leaves(estimator.next(*tree.unflatten(args)))

    function = as_scalars(flat, [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args])
    assert len(function.dtypes) > 20
