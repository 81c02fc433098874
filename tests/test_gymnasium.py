"""Gymnasium: its own checks pass, and many environments in one step equal its own vector of single
ones."""

import copy
import os
import pickle
import shutil
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics

from bounce_mjx.adapters.gymnasium import batch, environments
from bounce_mjx.adapters.gymnasium.registration import ENV_ID, TASK_ID, TASKS
from bounce_mjx.errors import UserError
from bounce_mjx.task.registry import find_task, registered_tasks
from bounce_mjx.viewers import offscreen

NUM_ENVS = 3
# A ball without a paddle reaches the floor after 30 steps.
LIMIT, STEPS = 36, 45
TARGET = 28
"""Index of the target height in an observation."""
NOTHING = np.zeros((NUM_ENVS, 6), np.float32)


@pytest.fixture(scope="module")
def single():
    env = gymnasium.make(ENV_ID, render_mode="rgb_array", episode_seconds=0.01 * LIMIT)
    yield env
    env.close()


@pytest.fixture(scope="module")
def vectorised():
    env = gymnasium.make_vec(
        ENV_ID, NUM_ENVS, render_mode="rgb_array", max_episode_steps=LIMIT, width=96, height=64
    )
    yield env
    env.close()


def make_vec(mode=AutoresetMode.NEXT_STEP, **settings) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(
        ENV_ID, NUM_ENVS, autoreset_mode=mode, max_episode_steps=LIMIT, **settings
    )


def test_the_time_limit_is_that_of_the_config() -> None:
    """Gymnasium's wrappers read it from the spec."""
    for make, settings, steps in (
        (gymnasium.make, {}, 2000),
        (gymnasium.make_vec, {"task": "catch"}, 300),
        (gymnasium.make, {"control_dt": 0.02}, 1000),
        (gymnasium.make_vec, {"episode_seconds": 30}, 3000),
        (gymnasium.make, {"episode_seconds": 30, "max_episode_steps": 2500}, 2500),
        (gymnasium.make, {"max_episode_steps": 3000}, 2000),
        (gymnasium.make, {"episode_seconds": 0.1, "max_episode_steps": 50}, 10),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            env = make(TASK_ID, **settings)
        assert env.spec.max_episode_steps == steps
        assert type(env.spec).from_json(env.spec.to_json()).max_episode_steps == steps


def falling_actions(steps: int) -> np.ndarray:
    """Actions [steps, B, 6] that turn the arms of the last two environments away from the ball."""
    actions = 0.1 * np.random.default_rng(0).normal(size=(steps, NUM_ENVS, 6))
    actions[:, 1:, 0] += [1.0, -0.7]
    return actions.astype(np.float32)


def assert_same(left, right, tolerance: float) -> None:
    """The same structure, keys, types and shapes, and nearly the same numbers."""
    assert type(left) is type(right)
    if isinstance(left, dict):
        assert left.keys() == right.keys()
        for key in left:
            assert_same(left[key], right[key], 1e9 if key == "t" else tolerance)
    elif isinstance(left, tuple) or (isinstance(left, np.ndarray) and left.dtype == object):
        for one, other in zip(left, right, strict=True):
            assert_same(one, other, tolerance)
    elif isinstance(left, np.ndarray):
        assert left.dtype == right.dtype and left.shape == right.shape
        np.testing.assert_allclose(left, right, atol=tolerance, rtol=tolerance)
    else:
        assert left is right is None


def test_one_import_registers_the_environments_and_no_import_is_hooked() -> None:
    """Also Gymnasium's own form, with the name of the module before the environment's."""
    script = f"""
import sys
finders = list(sys.meta_path)
import bounce_mjx
assert sys.meta_path == finders and "gymnasium" not in sys.modules
import bounce_mjx.adapters.gymnasium, gymnasium
print(gymnasium.spec({ENV_ID!r}).id, "torch" in sys.modules, "jax" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.split() == [ENV_ID, "False", "False"], done.stderr
    script = f"""
import gymnasium
try:
    gymnasium.make("bounce_mjx:" + {ENV_ID!r}, frameskip=2)
except TypeError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert "frameskip" in done.stdout, done.stderr


@pytest.mark.slow
def test_each_task_of_the_package_has_a_name() -> None:
    own = {
        name for name in registered_tasks() if find_task(name).__module__.startswith("bounce_mjx")
    }
    assert own == {*TASKS, "bounce"}
    for name in TASKS:
        env = gymnasium.make(f"bounce_mjx/{name.title()}-v0")
        assert isinstance(env.get_wrapper_attr("core").task, find_task(name))
    env = gymnasium.make("bounce_mjx/Juggle-v0")
    observation, _ = env.reset(seed=0, options={"target_height": 0.5})
    layout = env.get_wrapper_attr("core").layout
    assert layout["ball_position"].stop - layout["ball_position"].start == 6
    assert observation[layout["target_height"]] == pytest.approx(0.5)


def test_gymnasium_checks_pass(opengl, single):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # An observation without limits is what the task has.
        warnings.filterwarnings("ignore", message=".*A Box observation space m.*")
        check_env(single.unwrapped, skip_close_check=True)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vector_equals_gymnasiums_vector_of_single_environments(mode):
    """Observations, rewards, ends, infos and their masks, over falls, time-outs and resets."""
    same_step = mode is AutoresetMode.SAME_STEP
    wrap = RecordEpisodeStatistics if same_step else lambda env: env
    made = [lambda: wrap(gymnasium.make(ENV_ID, max_episode_steps=LIMIT))] * NUM_ENVS
    envs, reference = make_vec(mode), SyncVectorEnv(made, autoreset_mode=mode)
    assert envs.autoreset_mode is envs.metadata["autoreset_mode"] is mode
    assert_same(envs.reset(seed=[5, 6, 9]), reference.reset(seed=[5, 6, 9]), 1e-6)
    ends = np.zeros((2, NUM_ENVS), bool)
    for action in falling_actions(STEPS):
        given, expected = envs.step(action), reference.step(action)
        assert_same(given, expected, 1e-3)
        ends |= np.stack(given[2:4])
        mask = given[2] | given[3]
        if mode is AutoresetMode.DISABLED and mask.any():
            with pytest.raises(UserError, match="have ended; reset them with"):
                envs.step(action)
            given = envs.reset(options={"reset_mask": mask})
            expected = reference.reset(options={"reset_mask": mask})
            assert_same(given, expected, 1e-3)
    assert ends.any(axis=1).all()


def test_options_choose_the_target_and_the_environments(single, vectorised):
    assert single.reset(seed=1, options={"target_height": 0.5})[0][TARGET] == 0.5
    drawn = single.reset(seed=1)[0]
    observation, _ = vectorised.reset(seed=[1, 2, None], options={"target_height": 0.5})
    np.testing.assert_array_equal(observation[:, TARGET], 0.5)
    assert vectorised.np_random_seed[:2] == (1, 2)
    # Only the target differs from the drawn episode.
    np.testing.assert_allclose(observation[0, :TARGET], drawn[:TARGET], atol=1e-6)
    mask = np.array([False, True, False])
    chosen = {"reset_mask": mask, "target_height": 0.7}
    after, _ = vectorised.reset(seed=[7, np.int64(8), 9], options=chosen)
    assert vectorised.np_random_seed[:2] == (1, 8)
    np.testing.assert_array_equal(after[:, TARGET], np.float32([0.5, 0.7, 0.5]))
    np.testing.assert_array_equal((after == observation).all(axis=1), ~mask)
    # An episode's steps keep its target.
    observation, *_ = vectorised.step(NOTHING)
    np.testing.assert_array_equal(observation[:, TARGET], after[:, TARGET])


def test_wrong_arguments_and_options_give_one_sentence(vectorised):
    """A type error, with the words that TorchRL looks for, where an argument is unknown."""
    with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
        gymnasium.make_vec(ENV_ID, 2, frameskip=2)
    for arguments, sentence in (
        ({"render_mode": "human"}, "render_mode is 'human'"),
        ({"max_episode_steps": 3000}, "must be from 1 to the 2000 steps .* episode_seconds makes"),
        ({"max_episode_steps": 2.5}, "max_episode_steps is 2.5, but must be a whole number"),
        ({"num_envs": 0}, "num_envs is 0, but must"),
        ({"num_envs": 1.5}, "num_envs is 1.5, but must be a whole number"),
        ({"width": 64.0}, "width is 64.0, but must be a whole number"),
        (
            {"autoreset_mode": "same_step"},
            "'same_step'; choose one of 'NextStep'",
        ),
        ({"target_hight_range": (0, 1)}, "keyword argument 'target_hight_range'; did you mean"),
        ({"render_mode": "rgb_array", "camera": "top"}, "no camera 'top'; its .* overview, side"),
    ):
        with pytest.raises(UserError, match=sentence):
            gymnasium.make_vec(ENV_ID, **{"num_envs": 2} | arguments)
    for options, sentence in (
        ({"target_hight": 0.5}, "unexpected option 'target_hight'; known options are: target_h"),
        ({"target_height": -1.0}, "target_height is -1.0, but must be a finite number >="),
        ({"target_height": "high"}, "target_height is 'high', but must be a finite number"),
        ({"reset_mask": np.ones(2, bool)}, r"shape \(2,\), but must be .* \(3,\) with at least"),
        ({"reset_mask": np.zeros(3, bool)}, "at least one True"),
    ):
        with pytest.raises(UserError, match=sentence):
            vectorised.reset(options=options)
    single = environments.make_env()
    for env, option in ((vectorised, "target_hight"), (single, "reset_mask")):
        with pytest.raises(TypeError, match=f"unexpected option '{option}'"):
            env.reset(options={option: np.ones(1, bool)})


def test_spaces_and_attributes(single, vectorised):
    action, observation = single.action_space, single.observation_space
    assert action == gymnasium.spaces.Box(-1.0, 1.0, (6,))
    assert observation == gymnasium.spaces.Box(-np.inf, np.inf, (29,))
    assert vectorised.single_action_space == action
    assert vectorised.single_observation_space == observation
    assert vectorised.action_space.shape == (NUM_ENVS, 6)
    for env in (single, vectorised):
        assert env.unwrapped.mj_model.nu == 6 and env.metadata["render_fps"] == 100
    assert single.get_wrapper_attr("dt") == vectorised.dt == 0.01
    assert vectorised.call("dt") == vectorised.get_attr("dt") == (0.01,) * NUM_ENVS
    with pytest.raises(UserError, match="reset would do it to all environments; use reset itself"):
        vectorised.call("reset", seed=3)


def test_equal_environments_share_their_programs():
    first, second = make_vec(), make_vec(AutoresetMode.SAME_STEP)
    assert first._batch.programs is second._batch.programs
    assert first._batch.programs is not make_vec(physics_dt=0.002)._batch.programs


def test_returned_arrays_belong_to_the_user(vectorised):
    observation, _ = vectorised.reset(seed=0)
    following, reward, *_, info = vectorised.step(NOTHING)
    twin = copy.deepcopy(vectorised)
    for array in (observation, following, reward, info["bounced"], info["_bounced"]):
        array[:] = 7.0
    assert data_equivalence(vectorised.step(NOTHING), twin.step(NOTHING), exact=True)
    twin.close()


def test_wrappers_work_on_the_vector(vectorised, need):
    """The observations and rewards of Gymnasium's wrappers on its own vector; and tensors."""
    wrappers = gymnasium.wrappers.vector

    def steps(env):
        env = wrappers.NormalizeReward(
            wrappers.NormalizeObservation(wrappers.RecordEpisodeStatistics(env))
        )
        return [env.reset(seed=1), *map(env.step, falling_actions(STEPS))]

    made = [lambda: gymnasium.make(ENV_ID, max_episode_steps=LIMIT)] * NUM_ENVS
    for left, right in zip(steps(vectorised), steps(SyncVectorEnv(made)), strict=True):
        assert_same(left, right, 1e-2)
    torch = need("torch")
    need("array_api_compat")
    tensors = wrappers.NumpyToTorch(vectorised)
    tensors.reset(seed=0)
    following, reward, *_ = tensors.step(torch.zeros(NUM_ENVS, 6))
    assert following.dtype is torch.float32 and following.shape == (NUM_ENVS, 29)
    assert isinstance(reward, torch.Tensor)


def test_pictures_show_the_state(opengl, single, vectorised):
    single.reset(seed=0)
    first = single.render()
    assert first.shape == (480, 640, 3) and first.dtype == np.uint8
    # The arm is orange.
    red, green, blue = first.reshape(-1, 3).astype(int).T
    assert ((red > 150) & (green > 50) & (green < 150) & (blue < 80)).sum() > 2000
    for _ in range(8):
        single.step(np.ones(6, np.float32))
    assert (np.abs(single.render().astype(int) - first).max(axis=-1) > 60).sum() > 300
    vectorised.reset(seed=0)
    pictures = vectorised.render()
    assert [picture.shape for picture in pictures] == [(64, 96, 3)] * NUM_ENVS
    assert not np.array_equal(pictures[0], pictures[1])


def test_the_first_picture_opens_opengl(monkeypatch) -> None:
    """SB3's `make_vec_env` asks for pictures that nobody draws; OpenGL beside triton ends the
    process."""

    def refuse() -> None:
        raise UserError("no OpenGL")

    monkeypatch.setattr(offscreen, "choose_opengl", refuse)
    single = environments.make_env(render_mode="rgb_array", episode_seconds=0.01 * LIMIT)
    vector = make_vec(render_mode="rgb_array")
    for env in (single, vector):
        env.reset(seed=0)
        env.step(env.action_space.sample())
        with pytest.raises(UserError, match="no OpenGL"):
            env.render()
        env.close()


def test_a_program_that_closes_no_environment_ends_in_silence(opengl) -> None:
    """Also where a library has asked for its own ends before OpenGL is opened."""
    script = f"""
import weakref
class Library: pass
library = Library()
weakref.finalize(library, print, "end")
import gymnasium, bounce_mjx.adapters.gymnasium
env = gymnasium.make({ENV_ID!r}, render_mode="rgb_array", width=64, height=48)
env.reset()
print(env.render().shape)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "(48, 64, 3)\nend\n", "")


def test_use_before_reset_or_with_a_wrong_action_gives_one_sentence(vectorised):
    single, vector = environments.make_env(episode_seconds=0.01), make_vec()
    for env in (single, vector):
        with pytest.raises(UserError, match="before its reset") as caught:
            env.step(env.action_space.sample())
        assert isinstance(caught.value, gymnasium.error.ResetNeeded)
        env.reset(seed=0)
    for env, action, shapes in (
        (single, np.zeros(5), r"shape \(5,\), but must have \(6,\)"),
        (vector, np.zeros(6), r"shape \(6,\), but must have \(3, 6\)"),
        (single, "left", r"must be an array of numbers \(6,\)"),
    ):
        with pytest.raises(UserError, match=shapes):
            env.step(action)
    assert single.step(np.zeros(6))[3]
    with pytest.raises(gymnasium.error.ResetNeeded, match="episode has ended; call reset"):
        single.step(np.zeros(6))


def test_np_random_decides_the_episodes(single):
    """Gymnasium's generator is the only source of randomness: one set by the user, the seed of an
    environment that was not given one, and a state put back, each repeat the episodes."""
    env = single.unwrapped
    first = [env.reset(seed=5)[0], env.reset()[0]]
    assert not np.array_equal(*first)
    env.np_random, _ = gymnasium.utils.seeding.np_random(5)
    np.testing.assert_array_equal([env.reset()[0], env.reset()[0]], first)
    env.np_random = None
    unseeded = env.reset()[0]
    np.testing.assert_array_equal(env.reset(seed=env.np_random_seed)[0], unseeded)
    state = env.np_random.bit_generator.state
    later = env.reset()[0]
    env.np_random.bit_generator.state = state
    np.testing.assert_array_equal(env.reset()[0], later)


def test_copies_and_pickles_continue_the_episodes(opengl, vectorised, single):
    for env in (vectorised, single.unwrapped):
        env.reset(seed=3)
        action = env.action_space.sample()
        env.step(action)
        twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
        expected = env.step(action)
        for twin in twins:
            assert data_equivalence(twin.step(action), expected, exact=True)
            assert data_equivalence(twin.render(), env.render(), exact=True)
            twin.close()


def test_torchrl_wraps_single_and_vectorised_environments(need):
    """TorchRL's own checks pass, and the next observation is the last one of an ended episode."""
    torchrl = need("torchrl.envs")
    torch = need("torch")
    torchrl.utils.check_env_specs(torchrl.GymEnv(ENV_ID))
    actions = torch.tensor(falling_actions(LIMIT))
    for mode in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):
        envs = torchrl.GymWrapper(make_vec(mode))
        data = envs.reset(seed=[5, 6, 9])
        for action in actions:
            data = envs.step(data.set("action", action))
            last, data = data["next"], torchrl.utils.step_mdp(data)
            if last["done"].any():
                target = last["observation"][:, TARGET]
                data = envs.maybe_reset(data)
                ended = last["done"].squeeze(-1)
                assert (last["observation"][ended, 8] < 0.05).any() or last["truncated"].any()
                assert torch.equal(data["observation"][:, TARGET] != target, ended)


def test_skrl_wraps_the_vector(need, opengl, vectorised):
    """Tensors with the numbers of the arrays; skrl's trainers call the rest at every step."""
    wrap_env, torch = need("skrl.envs.wrappers.torch").wrap_env, need("torch")
    envs = wrap_env(vectorised, verbose=False)
    assert (envs.num_envs, envs.observation_space.shape) == (NUM_ENVS, (29,))
    envs.reset()
    twin = copy.deepcopy(vectorised)
    observation, *others, _ = envs.step(torch.full((NUM_ENVS, 6), 0.1))
    expected = twin.step(np.full((NUM_ENVS, 6), 0.1, np.float32))
    np.testing.assert_array_equal(observation, expected[0])
    for given, array in zip(others, expected[1:4], strict=True):
        assert given.shape == (NUM_ENVS, 1)
        np.testing.assert_allclose(given[:, 0], array, rtol=1e-6)
    assert len(envs.render()) == NUM_ENVS
    twin.close()


def test_process_forked_after_jax_ran_refuses_to_hang(monkeypatch):
    env = environments.make_env()
    monkeypatch.setattr(batch, "_jax_process", 1)
    with pytest.raises(UserError, match='set_start_method."forkserver".*context="forkserver"'):
        env.reset()


@pytest.mark.slow
def test_async_environments_run_after_jax_ran_in_the_parent(tmp_path):
    """Gymnasium's processes start from a server; a fork would hang. The compiled programs are
    cached where the commands cache them."""
    kept = tmp_path / "bounce_mjx/jax"
    shutil.copytree(os.environ["JAX_COMPILATION_CACHE_DIR"], kept, copy_function=os.link)
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    script = f"""
import gymnasium, jax, numpy as np, bounce_mjx
if __name__ == "__main__":
    single = gymnasium.make({ENV_ID!r})
    expected, _ = single.reset(seed=3)
    server = {{"context": "forkserver"}}
    envs = gymnasium.make_vec({ENV_ID!r}, 1, vectorization_mode="async", vector_kwargs=server)
    observation, _ = envs.reset(seed=3)
    np.testing.assert_array_equal(observation[0], expected)
    envs.step(np.zeros((1, 6), np.float32))
    envs.close()
    print(jax.config.jax_compilation_cache_dir)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300,
        env=environment | {"XDG_CACHE_HOME": str(tmp_path)},
    )  # fmt: skip
    assert done.stdout == f"{tmp_path}/bounce_mjx/jax\n", done.stderr
