"""The environment for PyTorch: shared memory, the same steps, and the interfaces of PyTorch
libraries."""

import runpy
import subprocess
import sys
import types
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from rsl_rl.runners import OnPolicyRunner
from skrl.envs.wrappers.torch import wrap_env
from skrl.trainers.torch import SequentialTrainer
from tensordict import TensorDict

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.adapters.torch import TorchVectorEnv
from bounce_mjx.adapters.torch.gymnasium_env import TorchGymnasiumVectorEnv
from bounce_mjx.adapters.torch.networks import (
    InputNormalizer,
    init_weights,
    linears_of,
    make_mlp,
    to_policy,
)
from bounce_mjx.adapters.torch.packing import Layout
from bounce_mjx.adapters.torch.rsl_rl_ppo import RslRlVecEnv, algorithm_config
from bounce_mjx.adapters.torch.skrl_ppo import SkrlEnv
from bounce_mjx.adapters.torch.trainer import make_learner, make_vector_env, summarize
from bounce_mjx.env import vector
from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.learning.statistics import init_statistics, normalize, update
from bounce_mjx.tasks.bounce import Bounce

NUM_ENVS = 4
# Each test includes both a fall (the ball reaches the floor after 0.3 s) and time-outs.
EPISODE_STEPS = 20
PPO = PPOConfig(
    num_envs=8, rollout_length=8, num_epochs=2, num_minibatches=2, hidden_layers=(16, 12)
)
SMALL = {"num_envs", "rollout_length", "num_epochs", "num_minibatches", "hidden_layers"}
LIBRARIES = ("rsl_rl", "skrl")


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """PyTorch threads that wait for a busy core slow tiny networks down a hundredfold."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def task() -> BounceBall:
    return BounceBall(EnvConfig(physics="fused", episode_seconds=0.01 * EPISODE_STEPS))


@pytest.fixture(scope="module")
def env(task) -> TorchVectorEnv:
    return TorchVectorEnv(task, NUM_ENVS, seed=3)


@pytest.fixture(scope="module")
def learners(task):
    """A learner of each library after two iterations."""
    made = {
        library: make_learner(library, PPO, make_vector_env(PPO, task, 0), 0)
        for library in LIBRARIES
    }
    return {
        library: (learner, [learner.learn() for _ in range(2)]) for library, learner in made.items()
    }


def random_actions(steps: int) -> torch.Tensor:
    """Actions [steps, B, 6], some of them beyond the limits."""
    return 1.5 * torch.randn(steps, NUM_ENVS, 6, generator=torch.Generator().manual_seed(0))


# Memory


def test_observation_shares_the_memory_of_jax(env, monkeypatch):
    blocks = []
    env.reset()
    step = env._jit_step

    def spy(block, action):
        block, result = step(block, action)
        blocks.append(result)
        return block, result

    monkeypatch.setattr(env, "_jit_step", spy)
    result = env.step(torch.zeros(NUM_ENVS, 6))
    # One after another, each at a new word, and none outside the block.
    at = blocks[0].unsafe_buffer_pointer()
    for tensor in result:
        assert tensor.data_ptr() == at and tensor.is_contiguous()
        at += -(-tensor.numel() * tensor.element_size() // 4) * 4
    assert at == blocks[0].unsafe_buffer_pointer() + blocks[0].nbytes


def test_unpacking_a_block_gives_the_packed_arrays():
    """Arrays of every type, and bools whose number is not a multiple of a word's bytes."""

    class Arrays(NamedTuple):
        floats: jax.Array
        flags: jax.Array
        counts: jax.Array
        none: jax.Array
        last: jax.Array

    rng = np.random.default_rng(0)
    arrays = Arrays(
        jnp.asarray(rng.normal(size=(3, 5)), jnp.float32).at[0, 0].set(jnp.nan),
        jnp.asarray(rng.random((2, 3)) < 0.5),
        jnp.asarray([-1, 2**31 - 1], jnp.int32),
        jnp.zeros((4, 0)),
        jnp.asarray([1e-42, -0.0, jnp.inf], jnp.float32),
    )
    layout = Layout(jax.eval_shape(lambda: arrays))
    block = jax.jit(layout.pack)(arrays)
    assert block.nbytes == 4 * (15 + 2 + 2 + 0 + 3)
    for array, back in zip(arrays, layout.unpack(block), strict=True):
        assert back.dtype == array.dtype
        np.testing.assert_array_equal(back, array)
    shared = torch.from_dlpack(block)
    for array, view in zip(arrays, layout.views(shared), strict=True):
        assert view.untyped_storage().data_ptr() == shared.data_ptr()
        np.testing.assert_array_equal(view.numpy(), array)


def test_action_reaches_jax_without_a_copy(env, monkeypatch):
    seen = []
    env.reset()
    step = env._jit_step

    def spy(block, action):
        seen.append(action.unsafe_buffer_pointer())
        return step(block, action)

    monkeypatch.setattr(env, "_jit_step", spy)
    # PyTorch aligns a tensor as JAX needs it unless it is a part of another tensor.
    action = torch.zeros(NUM_ENVS, 6)
    env.step(action)
    assert seen == [action.data_ptr()]


def test_tensors_of_a_step_outlive_the_following_steps(env):
    """They stay valid although the state is donated from step to step."""
    first, _ = env.reset()
    kept, copies = [first], [first.clone()]
    for action in random_actions(2 * EPISODE_STEPS):
        result = env.step(action)
        kept += [result.observation, result.final_observation, result.reward, result.metrics]
        copies += [tensor.clone() for tensor in kept[-4:]]
    assert all(torch.equal(*pair) for pair in zip(kept, copies, strict=True))


def test_clock_is_a_copy(env):
    env.reset()
    clock = env.clock
    clock += 5
    assert torch.equal(env.clock, torch.zeros(NUM_ENVS, dtype=torch.int32))
    given = torch.arange(NUM_ENVS)
    env.clock = given
    given += 7
    env.step(torch.zeros(NUM_ENVS, 6))
    assert env.clock.tolist() == [1, 2, 3, 4]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_step_waits_for_nothing_on_cuda(task):
    env = RslRlVecEnv(TorchVectorEnv(task, NUM_ENVS))
    action = torch.zeros(NUM_ENVS, 6, device="cuda")
    env.step(action)
    torch.cuda.set_sync_debug_mode("error")
    try:
        with jax.transfer_guard("disallow"):
            observations, rewards, dones, extras = env.step(action)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert {t.device.type for t in (rewards, dones, extras["time_outs"])} == {"cuda"}
    assert observations["policy"].device == action.device


# The same steps


def test_steps_equal_vector_steps(task, env):
    """The same resets and actions through `vector.step` give the same episodes."""
    first, _ = env.reset(seed=11)
    _, key = jax.random.split(jax.random.PRNGKey(11))
    key, reset_key = jax.random.split(key)
    state = vector.reset(task, reset_key, NUM_ENVS)
    np.testing.assert_allclose(first, vector.observe(state), atol=1e-6)
    step = jax.jit(lambda state, action, key: vector.step(task, state, action, key, EPISODE_STEPS))
    ended = 0
    for action in random_actions(2 * EPISODE_STEPS):
        key, reset_key = jax.random.split(key)
        state, expected = step(state, jnp.asarray(action.numpy()), reset_key)
        result = env.step(action)
        for name in ("observation", "final_observation", "reward", "terminated", "truncated"):
            np.testing.assert_allclose(
                getattr(result, name).numpy(), getattr(expected, name), atol=2e-4, err_msg=name
            )
        np.testing.assert_array_equal(result.done, result.terminated | result.truncated)
        np.testing.assert_array_equal(
            result.final_critic_metrics[:, 0], expected.metrics["n_bounces"]
        )
        at = env.metric_names.index("reward")
        np.testing.assert_allclose(result.metrics[at], expected.reward.mean(), rtol=1e-4)
        ended += int(result.done.sum())
    assert ended >= 2 * NUM_ENVS


def test_rewards_are_scaled(task, env):
    scaled = TorchVectorEnv(task, NUM_ENVS, reward_scale=0.25, critic_metrics=())
    for each in (env, scaled):
        each.reset(seed=5)
    action = torch.zeros(NUM_ENVS, 6)
    torch.testing.assert_close(scaled.step(action).reward, 0.25 * env.step(action).reward)
    assert scaled.step(action).critic_metrics.shape == (NUM_ENVS, 0)


BAD_ACTIONS = {
    "type": (torch.zeros(NUM_ENVS, 6, dtype=torch.float64), "torch.float64", "torch.float32"),
    "shape": (torch.zeros(6, NUM_ENVS), "(6, 4)", "(4, 6)"),
    "device": (torch.zeros(NUM_ENVS, 6, device="meta"), "on meta", "convert it"),
}


@pytest.mark.parametrize("action, given, advice", BAD_ACTIONS.values(), ids=BAD_ACTIONS)
def test_wrong_action_is_refused(env, action, given, advice):
    env.reset()
    with pytest.raises(UserError) as error:
        env.step(action)
    assert given in str(error.value) and advice in str(error.value)


def test_wrong_environment_is_refused(task):
    with pytest.raises(
        UserError, match="bounces, which the environment .* choose from .*n_bounces"
    ):
        TorchVectorEnv(task, NUM_ENVS, critic_metrics=("bounces",))
    with pytest.raises(UserError, match="call reset first"):
        TorchVectorEnv(task, NUM_ENVS).step(torch.zeros(NUM_ENVS, 6))


def test_package_works_without_torch():
    script = """
import sys
sys.modules["torch"] = None
import jax, bounce_mjx, bounce_mjx.commands.train, bounce_mjx.eval
print(bounce_mjx.BounceBall().reset(jax.random.PRNGKey(0)).obs.shape)
try:
    import bounce_mjx.adapters.torch
except ImportError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    shape, sentence = done.stdout.splitlines()
    assert shape == "(29,)"
    assert sentence.startswith("PyTorch cannot be imported")
    assert sentence.endswith("install it with: pip install 'bounce_mjx[torch]'")


# rsl_rl


def test_rsl_rl_gets_time_outs_and_terminal_observations(env):
    vec_env = RslRlVecEnv(env)
    vec_env.episode_length_buf = torch.tensor([EPISODE_STEPS - 1, 0, 0, EPISODE_STEPS - 2])
    assert vec_env.episode_length_buf.tolist() == [EPISODE_STEPS - 1, 0, 0, EPISODE_STEPS - 2]
    before = vec_env.get_observations()["policy"]
    after, rewards, dones, extras = vec_env.step(torch.zeros(NUM_ENVS, 6))
    assert extras["time_outs"].tolist() == dones.tolist() == [True, False, False, False]
    assert rewards.shape == (NUM_ENVS,)
    assert after["policy"].shape == (NUM_ENVS, 29) and after["critic"].shape == (NUM_ENVS, 1)
    assert vec_env.get_observations() is after
    # In one step of 10 ms nothing moves far, but a reset draws another target height.
    terminal = vec_env.result.final_observation
    torch.testing.assert_close(terminal[:, 28], before[:, 28])
    assert torch.equal(terminal[1:], after["policy"][1:])
    assert terminal[0, 28] != after["policy"][0, 28]


def test_rsl_rl_log_has_the_mean_reward_terms(env):
    vec_env = RslRlVecEnv(env)
    _, rewards, _, extras = vec_env.step(torch.zeros(NUM_ENVS, 6))
    log = extras["log"]
    terms = [value for name, value in log.items() if name.startswith("task/reward/")]
    assert len(terms) == 15
    torch.testing.assert_close(sum(terms), log["task/reward"])
    torch.testing.assert_close(log["task/reward"], rewards.mean())


def test_rsl_rl_scripts_find_what_they_touch(env):
    """The attributes and methods that the scripts of mjlab and Isaac Lab use."""
    vec_env = RslRlVecEnv(env)
    assert vec_env.unwrapped is vec_env and vec_env.step_dt == 0.01 and vec_env.physics_dt == 0.001
    assert vec_env.render_mode is None
    assert vec_env.seed(7) == 7
    first, extras = vec_env.reset()
    assert extras == {} and vec_env.get_observations() is first
    for name, group in first.items():
        assert group.numpy() in vec_env.observation_space[name]
    assert vec_env.action_space.shape == (NUM_ENVS, 6)
    later, _ = vec_env.reset()
    assert not torch.equal(later["policy"], first["policy"])
    vec_env.seed(7)
    torch.testing.assert_close(vec_env.reset()[0]["policy"], first["policy"])
    vec_env.close()


@pytest.mark.slow
def test_rsl_rl_exports_the_policy(learners, tmp_path):
    """TorchScript and ONNX give the actions of the trained network, beyond the normaliser's limit
    too, and with a quantity that never varied."""
    learner, _ = learners["rsl_rl"]
    actor = learner.algorithm.get_policy()
    std = actor.obs_normalizer.std
    actor.obs_normalizer.std = torch.where(torch.arange(29) == 3, 0.0, std)
    observation = 3.0 * torch.randn(8, 29) * torch.tensor([1.0] * 28 + [1e6])
    try:
        runner = types.SimpleNamespace(alg=learner.algorithm)
        OnPolicyRunner.export_policy_to_jit(runner, str(tmp_path))
        OnPolicyRunner.export_policy_to_onnx(runner, str(tmp_path))
        with torch.no_grad():
            expected = actor(TensorDict({"policy": observation}, batch_size=[8]))
    finally:
        # The other tests share the learner.
        actor.obs_normalizer.std = std
    with torch.no_grad():
        scripted = torch.jit.load(tmp_path / "policy.pt")(observation)
    torch.testing.assert_close(scripted, expected)
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    for row, action in zip(observation, expected, strict=True):
        (given,) = session.run(None, {"obs": row[None].numpy()})
        np.testing.assert_allclose(given[0], action, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_example_trains_and_acts_with_its_export(tmp_path):
    main = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "rsl_rl_ppo.py"))["main"]
    rewards = main(tmp_path, iterations=1, **PPO.model_dump(include=SMALL))
    assert (tmp_path / "policy.onnx").stat().st_size > 1000 and list(tmp_path.glob("model_*.pt"))
    assert rewards.shape == (100,) and rewards.isfinite().all() and rewards.std() > 0.0


def test_rsl_rl_runner_trains(task, tmp_path):
    """rsl_rl's own runner trains, with its log and its check for non-finite numbers."""
    env = RslRlVecEnv(TorchVectorEnv(task, PPO.num_envs))
    config = algorithm_config(PPO) | {"check_for_nan": True}
    runner = OnPolicyRunner(env, config, log_dir=str(tmp_path), device=str(env.device))
    before = [p.clone() for p in runner.alg.actor.parameters()]
    runner.learn(2, init_at_random_ep_len=True)
    assert any(
        not torch.equal(*pair) for pair in zip(before, runner.alg.actor.parameters(), strict=True)
    )
    assert list(tmp_path.glob("events.out.tfevents.*"))


# skrl


def test_skrl_gets_terminal_observations(env):
    skrl_env = SkrlEnv(env)
    skrl_env.reset()
    env.clock = torch.tensor([EPISODE_STEPS - 1, 0, 0, 0])
    after, rewards, terminated, truncated, _ = skrl_env.step(torch.zeros(NUM_ENVS, 6))
    assert rewards.shape == terminated.shape == truncated.shape == (NUM_ENVS, 1)
    assert truncated[:, 0].tolist() == [True, False, False, False]
    observations, states = skrl_env.terminal_observations()
    assert torch.equal(observations[1:], after[1:]) and not torch.equal(observations[0], after[0])
    assert torch.equal(states[:, :29], observations) and states.shape[1:] == (30,)
    assert skrl_env.state_space.shape == skrl_env.state().shape[1:]
    assert torch.equal(skrl_env.state()[:, :29], after)


def test_skrl_trainer_trains(learners):
    """skrl's own trainer runs."""
    learner, _ = learners["skrl"]
    before = [p.clone() for p in learner.agent.policy.parameters()]
    cfg = {
        "timesteps": 2 * PPO.rollout_length,
        "headless": True,
        "disable_progressbar": True,
        "close_environment_at_exit": False,
    }
    SequentialTrainer(cfg=cfg, env=learner.env, agents=learner.agent).train()
    after = learner.agent.policy.parameters()
    assert any(not torch.equal(*pair) for pair in zip(before, after, strict=True))


def test_skrl_bootstraps_time_outs_from_the_terminal_observations(learners):
    """skrl's memory holds the reward plus the discounted value of the old episode's last state."""
    learner, _ = learners["skrl"]
    agent, at = learner.agent, learner.agent.memory.memory_index
    learner.vector.clock = torch.full((PPO.num_envs,), EPISODE_STEPS - 1, dtype=torch.int32)
    learner._step()
    result = learner.env.result
    _, states = learner.env.terminal_observations()
    with torch.no_grad():
        value, _ = agent.value.act({"states": agent._state_preprocessor(states)}, role="value")
    assert result.truncated.all()
    expected = result.reward[:, None] + PPO.discount * value
    torch.testing.assert_close(agent.memory.get_tensor_by_name("rewards")[at], expected)


# Gymnasium


def test_gymnasium_vector_env_stays_on_the_device(env):
    made = TorchGymnasiumVectorEnv(env)
    first, _ = made.reset(seed=2)
    again, _ = made.reset(seed=2)
    assert torch.equal(first, again)
    env.clock = torch.tensor([EPISODE_STEPS - 1, 0, 0, 0])
    after, reward, terminated, truncated, info = made.step(torch.zeros(made.action_space.shape))
    assert isinstance(after, torch.Tensor) and after.shape == made.observation_space.shape
    assert info["_final_obs"].tolist() == truncated.tolist() == [True, False, False, False]
    torch.testing.assert_close(info["final_obs"][:, 28], first[:, 28])
    assert after[0, 28] != first[0, 28]
    assert after.numpy() in made.observation_space
    assert reward.shape == terminated.shape == (made.num_envs,)


def test_skrl_wraps_the_vector_env(env):
    """skrl's wrapper gives arrays as actions."""
    made = TorchGymnasiumVectorEnv(env)
    wrapped = wrap_env(made, verbose=False)
    assert wrapped.num_envs == NUM_ENVS and wrapped.action_space == made.single_action_space
    first, _ = wrapped.reset()
    env.reset(seed=7)
    state = env.state
    expected = env.step(torch.full((NUM_ENVS, 6), 0.5))
    expected = expected.observation.clone(), expected.reward[:, None].clone()
    env.state = state
    observation, reward, terminated, truncated, _ = wrapped.step(torch.full((NUM_ENVS, 6), 0.5))
    torch.testing.assert_close((observation, reward), expected)
    assert first.shape == observation.shape and terminated.shape == truncated.shape == (NUM_ENVS, 1)
    wrapped.render()


def test_skrl_env_passes_through_skrls_wrap_env(env):
    """`wrap_env` was imported before the adapter, as a script may do it."""
    skrl_env = SkrlEnv(env)
    assert wrap_env(skrl_env, verbose=False) is skrl_env


def test_gymnasium_records_the_statistics_of_the_vector_env(env):
    """Returns and lengths of all episodes, over falls and time-outs."""
    envs = RecordEpisodeStatistics(TorchGymnasiumVectorEnv(env))
    envs.reset(seed=3)
    returns, lengths = np.zeros(NUM_ENVS), np.zeros(NUM_ENVS, int)
    expected, given = [], []
    actions = random_actions(2 * EPISODE_STEPS + 5)
    for action in actions:
        _, reward, terminated, truncated, info = envs.step(action)
        returns, lengths = returns + reward.numpy().astype(float), lengths + 1
        over = (terminated | truncated).numpy()
        expected += [(returns[i], lengths[i]) for i in np.flatnonzero(over)]
        if over.any():
            np.testing.assert_array_equal(info["_episode"], over)
            given += list(zip(*(info["episode"][key][over] for key in "rl"), strict=True))
        returns[over], lengths[over] = 0.0, 0
    assert len(expected) >= 2 * NUM_ENVS and envs.episode_count == len(expected)
    np.testing.assert_allclose(given, expected, rtol=1e-5)
    np.testing.assert_allclose(envs.length_queue, [length for _, length in expected])


@pytest.mark.slow
def test_the_ranges_of_the_randomisation_grow_over_the_warm_up():
    """Episodes of five steps, a warm-up of ten: the drag of the third episodes is drawn from the
    whole range."""
    ranges = {"air_drag": (0.1, 0.2), "warmup_steps": 10 * NUM_ENVS}
    task = BounceBall(EnvConfig(episode_seconds=0.05, randomization=ranges))
    env = TorchVectorEnv(task, NUM_ENVS, critic_metrics=("world/air_drag",))
    drag = [env.reset()[1]]
    for _ in range(2):
        for _ in range(5):
            result = env.step(torch.zeros(NUM_ENVS, 6))
        drag.append(result.critic_metrics)
    for share, drawn in zip((0.0, 0.5, 1.0), drag, strict=True):
        assert drawn.min() >= 0.1 * share - 1e-6 and drawn.max() <= 0.2 * share + 1e-6
    assert len(drag[2].unique()) == NUM_ENVS


# Networks


def test_normalizer_equals_the_normalizer_in_jax():
    """The statistics over batches and the normalised observations are equal, also for a constant
    observation."""
    rng = np.random.default_rng(0)
    normalizer, statistics = InputNormalizer(3), init_statistics(3)
    for count in (5, 40, 7):
        batch = rng.normal([2.0, -300.0, 0.0], [1.0, 20.0, 0.0], (count, 3)).astype(np.float32)
        seen = normalizer(torch.tensor(batch), train=True)
        statistics = update(statistics, jnp.asarray(batch))
        np.testing.assert_allclose(
            seen, normalize(batch, statistics.normalizer), rtol=1e-3, atol=1e-4
        )
    assert int(normalizer.count) == 52
    np.testing.assert_allclose(normalizer.mean, statistics.mean, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(normalizer.std, statistics.std, rtol=1e-4)
    far = torch.tensor([[1e6, 0.0, 1e6]])
    np.testing.assert_allclose(
        normalizer(far), normalize(far.numpy(), statistics.normalizer), rtol=1e-4
    )
    assert normalizer(far)[0, [0, 2]].tolist() == [10.0, 0.0]


@pytest.mark.parametrize("library", LIBRARIES)
def test_policy_acts_like_the_network(learners, library):
    """The PyTorch network and its `Policy` in JAX give the same actions for the same
    observations."""
    learner, _ = learners[library]
    observation = 3.0 * torch.randn(64, 29, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        if library == "rsl_rl":
            mean = learner.algorithm.get_policy()({"policy": observation})
        else:
            seen = learner.agent._observation_preprocessor(observation)
            mean = learner.agent.policy.act({"observations": seen})[1]["mean_actions"]
    expected = mean.clamp(-1.0, 1.0).numpy()
    actions = make_networks(PPO, 29, 6).act(learner.policy(), observation.numpy())
    assert np.abs(expected).max() > 0.01
    np.testing.assert_allclose(actions, expected, atol=1e-5)


@pytest.mark.parametrize("library", LIBRARIES)
def test_learner_reports_the_same_metrics_as_the_jax_trainer(learners, library):
    _, metrics = learners[library]
    reported = summarize(metrics, Bounce.curves)
    assert {"reward/height", "episode/return", "task/ball_xy_error"} < reported.keys()
    assert {"loss/policy", "loss/value", "policy/learning_rate"} < reported.keys()
    assert all(values.shape == (2,) for values in reported.values())
    terms = [v for name, v in reported.items() if name.startswith("reward/")]
    np.testing.assert_allclose(sum(terms), reported["reward"], rtol=1e-4)


def test_initial_weights_are_distributed_as_in_jax():
    """The weights are orthogonal with the same gains, so they have the same singular values."""
    networks = make_networks(PPO, 29, 6)
    params = networks.policy_network.init(jax.random.PRNGKey(0))["params"]
    mlp = make_mlp(PPO, 29, 6)
    init_weights(mlp, output_gain=0.01)
    layers = [*params["MLP_0"].values(), params["Dense_0"]]
    for linear, layer in zip(linears_of(mlp), layers, strict=True):
        assert linear.weight.T.shape == layer["kernel"].shape
        np.testing.assert_allclose(
            torch.linalg.svdvals(linear.weight.detach()),
            jnp.linalg.svd(layer["kernel"], compute_uv=False),
            rtol=1e-4,
        )


def test_network_of_another_shape_is_refused():
    mlp = make_mlp(PPO.model_copy(update={"hidden_layers": (16,)}), 29, 6)
    with pytest.raises(UserError, match="hidden_layers"):
        to_policy(PPO, InputNormalizer(29), linears_of(mlp), torch.zeros(6))


@pytest.mark.slow
@pytest.mark.parametrize("library", LIBRARIES)
def test_training_makes_episodes_longer(library):
    task = BounceBall(EnvConfig(physics="fused", episode_seconds=5.0))
    config = PPOConfig(
        num_envs=256, rollout_length=24, num_minibatches=4, num_epochs=4, hidden_layers=(64, 64)
    )
    learner = make_learner(library, config, make_vector_env(config, task, 0), 0)
    metrics = [learner.learn() for _ in range(35)]
    lengths = summarize(metrics, task.task.curves)["episode/length"]
    assert lengths[-5:].mean() > 1.3 * lengths[:5].mean()
