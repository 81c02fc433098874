"""Gymnasium lists the environment, and its own checks pass."""

import subprocess
import sys
import warnings

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode

from bounce_mjx.errors import UserError
from bounce_mjx.task.rewards import TERM_NAMES
from bounce_mjx.viewers import offscreen

ENV_ID = "bounce_mjx/BounceBall-v0"
EPISODE_STEPS = 8


@pytest.fixture(scope="module")
def single(opengl):
    env = gymnasium.make(ENV_ID, render_mode="rgb_array", episode_seconds=0.01 * EPISODE_STEPS)
    yield env
    env.close()


@pytest.fixture(scope="module")
def vectorised(opengl):
    env = gymnasium.make_vec(
        ENV_ID, num_envs=3, render_mode="rgb_array", episode_seconds=0.01 * EPISODE_STEPS
    )
    yield env
    env.close()


def episode(env, seed: int, steps: int) -> list:
    """Copies of everything that an environment returns for given actions."""
    given = [env.reset(seed=seed)]
    rng = np.random.default_rng(0)
    for _ in range(steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        given.append(env.step(action))
    return jax.tree.map(np.array, given)


def test_import_registers_whichever_comes_first():
    for order in ("import bounce_mjx, gymnasium", "import gymnasium, bounce_mjx"):
        script = (
            f"{order}\nprint(gymnasium.spec({ENV_ID!r}).id, 'torch' in __import__('sys').modules)"
        )
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
        assert done.stdout.split() == [ENV_ID, "False"], done.stderr


def test_spaces_equal_the_specification(single, vectorised):
    action, observation = single.action_space, single.observation_space
    assert action == gymnasium.spaces.Box(-1.0, 1.0, (6,))
    assert observation == gymnasium.spaces.Box(-np.inf, np.inf, (29,))
    assert vectorised.single_action_space == action
    assert vectorised.single_observation_space == observation
    assert vectorised.action_space.shape == (3, 6)


def test_gymnasium_checks_pass(single):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # An observation without limits is what the task has.
        warnings.filterwarnings("ignore", message=".*A Box observation space m.*")
        check_env(single.unwrapped, skip_close_check=True)


@pytest.mark.parametrize("kind", ["single", "vectorised"])
def test_seed_repeats_episodes(kind, request):
    env = request.getfixturevalue(kind)
    first = episode(env, 4, EPISODE_STEPS)
    assert data_equivalence(first, episode(env, 4, EPISODE_STEPS), exact=True)
    assert not data_equivalence(first[0], episode(env, 5, 1)[0])


def test_single_environment_truncates_and_reports(single):
    *_, (_, reward, terminated, truncated, info) = episode(single, 0, EPISODE_STEPS)
    assert truncated and not terminated
    terms = [value for name, value in info.items() if name.startswith("reward/")]
    assert len(terms) == len(TERM_NAMES)
    assert sum(terms) == pytest.approx(float(reward), rel=1e-4)


def test_vectorised_environments_meet_the_interface(vectorised):
    """Gymnasium has no checker for vectorised environments, so the test checks spaces, types and
    the same-step autoreset."""
    assert vectorised.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    given = episode(vectorised, 1, EPISODE_STEPS + 1)
    for observation, reward, terminated, truncated, info in given[1:]:
        assert observation in vectorised.observation_space
        assert reward.shape == terminated.shape == truncated.shape == (3,)
        assert terminated.dtype == truncated.dtype == bool
        np.testing.assert_array_equal(info["_final_obs"], terminated | truncated)
        assert info["final_obs"].shape == (3, 29)
    before, last, after = given[-3], given[-2], given[-1]
    assert last[3].all() and not before[3].any() and not after[3].any()
    # The target height never changes within an episode, and a reset draws a new one.
    np.testing.assert_array_equal(last[4]["final_obs"][:, 28], before[0][:, 28])
    assert (last[0][:, 28] != before[0][:, 28]).all()
    np.testing.assert_array_equal(before[4]["final_obs"], before[0])


def test_vectorised_environments_work_in_gymnasiums_wrappers(vectorised):
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(vectorised)
    given = episode(env, 1, EPISODE_STEPS)
    np.testing.assert_array_equal(given[-1][4]["episode"]["l"], EPISODE_STEPS)
    total = sum(step[1] for step in given[1:])
    np.testing.assert_allclose(given[-1][4]["episode"]["r"], total, rtol=1e-5)


def test_returned_arrays_belong_to_the_user(vectorised):
    observation, _ = vectorised.reset(seed=0)
    following, reward, *_ = vectorised.step(np.zeros((3, 6), np.float32))
    for array in (observation, following, reward):
        array[:] = 7.0
    np.testing.assert_array_less(vectorised.step(np.zeros((3, 6), np.float32))[0][:, 8], 1.0)


def test_pictures_show_the_state(single, vectorised):
    single.reset(seed=0)
    first = single.render()
    assert first.shape == (480, 640, 3) and first.dtype == np.uint8
    # The arm is orange.
    red, green, blue = first.reshape(-1, 3).astype(int).T
    assert ((red > 150) & (green > 50) & (green < 150) & (blue < 80)).sum() > 2000
    for _ in range(EPISODE_STEPS - 1):
        single.step(np.ones(6, np.float32))
    assert (np.abs(single.render().astype(int) - first).max(axis=-1) > 60).sum() > 300
    vectorised.reset(seed=0)
    pictures = vectorised.render()
    assert len(pictures) == 3 and not np.array_equal(pictures[0], pictures[1])


def test_rendering_failure_gives_one_sentence(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(offscreen.sys, "executable", "/bin/false")
    with pytest.raises(UserError, match="neither EGL nor OSMesa works here; .*libosmesa6"):
        gymnasium.make(ENV_ID, render_mode="rgb_array")


def test_wrong_settings_give_one_sentence():
    with pytest.raises(UserError, match="unknown key target_hight_range; did you mean target_h"):
        gymnasium.make(ENV_ID, target_hight_range=(0.3, 0.8))
    with pytest.raises(UserError, match="render_mode is 'human'"):
        gymnasium.make_vec(ENV_ID, num_envs=2, render_mode="human")
