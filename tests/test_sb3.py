"""Stable-Baselines3: the whole batch equals its own `DummyVecEnv` of single environments, and its
algorithms train on it."""

import gymnasium
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, VecVideoRecorder

from bounce_mjx.adapters.gymnasium.registration import ENV_ID
from bounce_mjx.adapters.sb3 import Sb3VecEnv
from bounce_mjx.adapters.torch.policy import to_policy
from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import make_networks

torch.set_num_threads(1)
NUM_ENVS = 3
LIMIT, STEPS = 36, 45
TARGET = 28
"""Index of the target height in an observation."""


@pytest.fixture
def envs() -> Sb3VecEnv:
    return Sb3VecEnv(NUM_ENVS, max_episode_steps=LIMIT)


def test_vec_env_equals_sb3s_vector_of_single_environments(envs):
    """Observations, rewards, dones, terminal observations, statistics and time-outs."""
    reference = DummyVecEnv(
        [lambda: Monitor(gymnasium.make(ENV_ID, max_episode_steps=LIMIT))] * NUM_ENVS
    )
    for vector in (envs, reference):
        assert vector.seed(5) == [5, 6, 7]
        vector.set_options([{"target_height": 0.5}, {}, {"target_height": 0.7}])
    np.testing.assert_allclose(envs.reset(), reference.reset(), atol=1e-6)
    assert envs.step(np.zeros((NUM_ENVS, 6)))[0][:, TARGET].tolist()[::2] == [0.5, np.float32(0.7)]
    reference.step(np.zeros((NUM_ENVS, 6)))
    actions = 0.1 * np.random.default_rng(0).normal(size=(STEPS, NUM_ENVS, 6))
    # The arms of the last two environments turn away from the ball.
    actions[:, 1:, 0] += [1.0, -0.7]
    timeouts = []
    for action in actions.astype(np.float32):
        (*given, infos), (*expected, expected_infos) = envs.step(action), reference.step(action)
        for left, right in zip(given, expected, strict=True):
            assert left.dtype == right.dtype
            np.testing.assert_allclose(left, right, atol=1e-3, rtol=1e-3)
        for info, reference_info in zip(infos, expected_infos, strict=True):
            timeout = info["TimeLimit.truncated"]
            assert timeout == reference_info["TimeLimit.truncated"]
            if "terminal_observation" not in reference_info:
                assert info.keys() == {"TimeLimit.truncated"}
                continue
            timeouts.append(timeout)
            assert info.keys() == reference_info.keys()
            last, expected_last = (i["terminal_observation"] for i in (info, reference_info))
            np.testing.assert_allclose(last, expected_last, atol=1e-3, rtol=1e-3)
            assert info["episode"]["l"] == reference_info["episode"]["l"]
            assert info["episode"]["r"] == pytest.approx(reference_info["episode"]["r"], abs=1e-2)
    assert set(timeouts) == {False, True}


def test_sb3_checks_pass() -> None:
    check_env(gymnasium.make(ENV_ID, max_episode_steps=LIMIT).unwrapped)


def test_attributes_are_common_and_stay(envs):
    assert envs.get_attr("dt", [0, 2]) == [0.01, 0.01]
    assert not envs.has_attr("gravity") and envs.env_is_wrapped(Monitor, 1) == [True]
    with pytest.raises(UserError, match="'dt', which is fixed by the settings; give these to"):
        envs.set_attr("dt", 0.02)
    with pytest.raises(UserError, match="would change only some of the 3 .* omit indices"):
        envs.set_attr("lap", 1, [0])
    for lap in (1, 2):
        envs.set_attr("lap", lap)
        assert envs.get_attr("lap", [0, 2]) == envs.env_method("get_wrapper_attr", "lap")[:2]
    assert envs.get_attr("lap") == [2] * NUM_ENVS


def test_methods_of_single_environments(envs):
    start = envs.reset()
    high = {"target_height": 0.7}
    ((observation, info),) = envs.env_method("reset", indices=1, seed=3, options=high)
    assert observation[TARGET] == np.float32(0.7) and info == {}
    after = envs.step(np.zeros((NUM_ENVS, 6)))[0]
    np.testing.assert_array_equal(after[[0, 2], TARGET], start[[0, 2], TARGET])
    single = gymnasium.make(ENV_ID)
    np.testing.assert_allclose(observation, single.reset(seed=3, options=high)[0], atol=1e-6)
    with pytest.raises(UserError, match="'jump'; the environments have the methods reset, render"):
        envs.env_method("jump")


def test_the_time_limit_is_that_of_the_task() -> None:
    assert Sb3VecEnv(2, task="catch").episode_steps == 300


PPO_SETTINGS = {"n_steps": 16, "batch_size": 24, "n_epochs": 1}
REPLAY_SETTINGS = {"learning_starts": 30, "batch_size": 16}


@pytest.mark.parametrize(
    "library, algorithm, settings",
    [
        ("stable_baselines3", "PPO", PPO_SETTINGS),
        ("stable_baselines3", "A2C", {"n_steps": 16}),
        ("stable_baselines3", "SAC", REPLAY_SETTINGS),
        ("stable_baselines3", "TD3", REPLAY_SETTINGS),
        ("stable_baselines3", "DDPG", REPLAY_SETTINGS),
        ("sbx", "PPO", PPO_SETTINGS),
    ],
)
def test_algorithm_trains_and_loads(envs, library, algorithm, settings, need, tmp_path):
    make = getattr(need(library), algorithm)
    settings = settings | {"policy_kwargs": {"net_arch": [8]}, "device": "cpu", "seed": 0}
    model = make("MlpPolicy", VecNormalize(envs), **settings)
    start = envs.reset()
    untrained, _ = model.predict(start, deterministic=True)
    model.learn(48 * NUM_ENVS)
    assert model.num_timesteps == 48 * NUM_ENVS
    assert not np.array_equal(model.predict(start, deterministic=True)[0], untrained)
    # The statistics of the episodes, as Monitor gives them.
    assert len(model.ep_info_buffer) == NUM_ENVS
    model.save(tmp_path / "model")
    observation = envs.reset()
    expected, _ = model.predict(observation, deterministic=True)
    given, _ = make.load(tmp_path / "model").predict(observation, deterministic=True)
    np.testing.assert_array_equal(given, expected)


def test_a_network_of_sb3_becomes_a_policy(envs):
    """Its default activation is tanh."""
    model = PPO("MlpPolicy", envs, policy_kwargs={"net_arch": [8, 4]}, device="cpu", seed=0)
    parts = model.policy
    mlp = torch.nn.Sequential(*parts.mlp_extractor.policy_net, parts.action_net)
    policy = to_policy(mlp, torch.zeros(29), torch.ones(29), parts.log_std)
    assert policy.config.activation == "tanh" and policy.config.hidden_layers == (8, 4)
    observation = np.random.default_rng(0).normal(size=(16, 29)).astype(np.float32)
    expected, _ = model.predict(observation, deterministic=True)
    given = make_networks(policy.config, 29, 6).act(policy.policy, observation)
    np.testing.assert_allclose(given, expected, atol=1e-5)


def test_videos_tile_the_first_environments(opengl, need, tmp_path):
    movies = need("moviepy")
    envs = Sb3VecEnv(NUM_ENVS, render_mode="rgb_array", width=96, height=64)
    recorder = VecVideoRecorder(envs, str(tmp_path), lambda step: step == 0, video_length=4)
    recorder.reset()
    for _ in range(5):
        recorder.step(np.zeros((NUM_ENVS, 6), np.float32))
    recorder.close()
    (video,) = tmp_path.glob("*.mp4")
    with movies.VideoFileClip(str(video)) as clip:
        assert clip.size == [2 * 96, 2 * 64] and clip.fps == 100
