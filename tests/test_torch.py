"""The environment for PyTorch: shared memory, the same steps, and the interfaces of PyTorch
libraries."""

import itertools
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

pytest.importorskip("torch")
pytest.importorskip("rsl_rl")
pytest.importorskip("skrl")

import torch
from tensordict import TensorDict
from torch import nn

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.adapters.torch import TorchVectorEnv
from bounce_mjx.adapters.torch.packing import Layout
from bounce_mjx.adapters.torch.policy import TorchPolicy, to_policy, write_run
from bounce_mjx.adapters.torch.rsl_rl_env import RslRlVecEnv
from bounce_mjx.adapters.torch.skrl_env import SkrlEnv
from bounce_mjx.env import vector
from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.runs.checkpoints import read_policy
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import find_checkpoint, runs_in

# Threads that wait for a busy core slow tiny networks down a hundredfold.
torch.set_num_threads(1)
NUM_ENVS = 4
# Each test includes both a fall (the ball reaches the floor after 0.3 s) and time-outs.
EPISODE_STEPS = 20
REWARD_SCALE = 0.25
EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def task() -> BounceBall:
    return BounceBall(EnvConfig(physics="fused", episode_seconds=0.01 * EPISODE_STEPS))


@pytest.fixture(scope="module")
def env(task) -> TorchVectorEnv:
    return TorchVectorEnv(task, NUM_ENVS, seed=3, reward_scale=REWARD_SCALE)


def random_actions(steps: int) -> torch.Tensor:
    """Actions [steps, B, 6], some of them beyond the limits."""
    return 1.5 * torch.randn(steps, NUM_ENVS, 6, generator=torch.Generator().manual_seed(0))


def test_actions_and_results_share_the_memory_of_jax(env, monkeypatch):
    """All tensors of a step are views of one array."""
    seen, arrays = [], []
    env.reset()
    step = env._jit_step

    def spy(carried, action):
        seen.append(action.unsafe_buffer_pointer())
        carried, block = step(carried, action)
        arrays.append(block)
        return carried, block

    monkeypatch.setattr(env, "_jit_step", spy)
    # PyTorch aligns a tensor as JAX needs it unless it is a part of another tensor.
    action = torch.zeros(NUM_ENVS, 6)
    result = env.step(action)
    assert seen == [action.data_ptr()]
    (block,) = arrays
    parts = [(x.data_ptr() - block.unsafe_buffer_pointer(), x.nbytes) for x in result]
    starts, sizes = zip(*parts, strict=True)
    assert starts[0] == 0 and starts[-1] + sizes[-1] == block.nbytes
    # Each begins at the first word after the one before.
    assert list(starts[1:]) == [a + -(-size // 4) * 4 for a, size in parts[:-1]]


def test_arrays_pass_in_one_block():
    """Of every type, and bools whose number is not a multiple of a word's bytes."""
    rng = np.random.default_rng(0)
    arrays = {
        "floats": jnp.asarray(rng.normal(size=(3, 5)), jnp.float32).at[0, 0].set(jnp.nan),
        "flags": jnp.asarray(rng.random((2, 3)) < 0.5),
        "integers": jnp.asarray([-1, 2**31 - 1], jnp.int32),
        "last": jnp.asarray([1e-42, -0.0, jnp.inf], jnp.float32),
        "nothing": jnp.zeros((4, 0)),
    }
    layout = Layout(jax.eval_shape(lambda: arrays))
    block = jax.jit(layout.pack)(arrays)
    assert block.nbytes == 4 * (15 + 2 + 2 + 3 + 0)
    for name, array in layout.unpack(block).items():
        assert array.dtype == arrays[name].dtype
        np.testing.assert_array_equal(array, arrays[name])
    with pytest.raises(UserError, match="has an array of uint8, and TorchVectorEnv takes four-"):
        Layout({"bytes": jnp.zeros(3, jnp.uint8)})
    shared = torch.from_dlpack(block)
    for name, view in layout.views(shared).items():
        assert view.untyped_storage().data_ptr() == shared.data_ptr()
        np.testing.assert_array_equal(view.numpy(), arrays[name])


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
    for wrong in (torch.zeros(NUM_ENVS + 1), torch.zeros(NUM_ENVS, 1), torch.tensor(3)):
        with pytest.raises(UserError, match=r"clock has the shape .*must have \(4,\)"):
            env.clock = wrong
    assert env.clock.tolist() == [1, 2, 3, 4]


def test_a_warm_up_goes_on_through_the_resets_of_a_training():
    """skrl resets a single environment after each episode; only a seed begins anew."""
    growing = {"first_goal_range": 0.01, "warmup_steps": NUM_ENVS * 5}
    config = EnvConfig(physics="fused", target_height_range=(0.5, 0.9), randomization=growing)
    env = TorchVectorEnv(BounceBall(config), NUM_ENVS)

    def spread() -> float:
        heights = env.reset()[0][:, 28]
        return float(heights.max() - heights.min())

    assert spread() < 0.01
    assert spread() < 0.01
    for _ in range(5):
        env.step(torch.zeros(NUM_ENVS, 6))
    assert spread() > 0.05
    assert spread() > 0.05
    env.reset(seed=0)
    assert spread() < 0.01


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


def test_tensors_of_a_step_outlive_the_following_steps(env):
    """They stay valid although the state is donated from step to step."""
    first, _ = env.reset()
    kept, copies = [first], [first.clone()]
    for action in random_actions(2 * EPISODE_STEPS):
        result = env.step(action)
        kept += [result.observation, result.final_observation, result.reward, result.metrics]
        copies += [tensor.clone() for tensor in kept[-4:]]
    assert all(torch.equal(*pair) for pair in zip(kept, copies, strict=True))


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
        np.testing.assert_allclose(result.reward, REWARD_SCALE * expected.reward, atol=1e-4)
        for name in ("observation", "final_observation", "terminated", "truncated"):
            np.testing.assert_allclose(
                getattr(result, name).numpy(), getattr(expected, name), atol=2e-4, err_msg=name
            )
        np.testing.assert_array_equal(result.done, result.terminated | result.truncated)
        np.testing.assert_array_equal(
            result.final_critic_metrics[:, 0], expected.metrics["n_bounces"]
        )
        at = env.metric_names.index("reward/height")
        mean = expected.metrics["reward/height"].mean()
        np.testing.assert_allclose(result.metrics[at], mean, rtol=1e-4)
        ended += int(result.done.sum())
    assert ended >= 2 * NUM_ENVS


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
    for wrong in (0, 2.5):
        with pytest.raises(UserError, match=f"num_envs is {wrong}, but must be a whole number"):
            TorchVectorEnv(task, wrong)
    with pytest.raises(UserError, match="call reset first"):
        _ = TorchVectorEnv(task, NUM_ENVS).clock


def test_rsl_rl_gets_time_outs_and_terminal_observations(env):
    vec_env = RslRlVecEnv(env)
    vec_env.episode_length_buf = torch.tensor([EPISODE_STEPS - 1, 0, 0, EPISODE_STEPS - 2])
    assert vec_env.episode_length_buf.tolist() == [EPISODE_STEPS - 1, 0, 0, EPISODE_STEPS - 2]
    before = vec_env.get_observations()["policy"]
    after, rewards, dones, extras = vec_env.step(torch.zeros(NUM_ENVS, 6))
    assert extras["time_outs"].tolist() == dones.tolist() == [True, False, False, False]
    assert rewards.shape == (NUM_ENVS,)
    terms = [mean for name, mean in extras["log"].items() if name.startswith("task/reward/")]
    torch.testing.assert_close(REWARD_SCALE * sum(terms), rewards.mean())
    assert after["policy"].shape == (NUM_ENVS, 29) and after["critic"].shape == (NUM_ENVS, 1)
    assert vec_env.get_observations() is after
    # In one step of 10 ms nothing moves far, but a reset draws another target height.
    terminal = vec_env.result.final_observation
    torch.testing.assert_close(terminal[:, 28], before[:, 28])
    assert torch.equal(terminal[1:], after["policy"][1:])
    assert terminal[0, 28] != after["policy"][0, 28]
    # A fall is no time-out. It takes longer than an episode here.
    vec_env.episode_length_buf = torch.full((NUM_ENVS,), -1000)
    has_fallen = torch.zeros(NUM_ENVS, dtype=torch.bool)
    for actions in random_actions(200):
        _, _, dones, extras = vec_env.step(actions)
        has_fallen |= dones.bool() & ~extras["time_outs"].bool()
    assert has_fallen.any()


def test_rsl_rl_scripts_find_what_they_touch(env):
    """The attributes and methods that the scripts of mjlab and Isaac Lab use."""
    vec_env = RslRlVecEnv(env)
    assert vec_env.unwrapped is vec_env and vec_env.render_mode is None
    assert (vec_env.step_dt, vec_env.physics_dt) == (0.01, 0.001)
    assert vec_env.seed(7) == 7
    first, extras = vec_env.reset()
    assert extras == {} and vec_env.get_observations() is first
    later, _ = vec_env.reset()
    assert not torch.equal(later["policy"], first["policy"])
    vec_env.seed(7)
    torch.testing.assert_close(vec_env.reset()[0]["policy"], first["policy"])
    vec_env.close()


def test_skrl_gets_terminal_observations(env):
    skrl_env = SkrlEnv(env)
    skrl_env.reset()
    env.clock = torch.tensor([EPISODE_STEPS - 1, 0, 0, 0])
    after, rewards, terminated, truncated, _ = skrl_env.step(torch.zeros(NUM_ENVS, 6))
    assert rewards.shape == terminated.shape == truncated.shape == (NUM_ENVS, 1)
    assert truncated[:, 0].tolist() == [True, False, False, False]
    terminal = skrl_env.result.final_observation
    assert torch.equal(terminal[1:], after[1:]) and not torch.equal(terminal[0], after[0])
    assert skrl_env.state_space.shape == skrl_env.state().shape[1:] == (30,)
    assert torch.equal(skrl_env.state()[:, :29], after)


class Trained(NamedTuple):
    """What an example leaves behind."""

    out: Path
    act: Callable[[torch.Tensor], torch.Tensor]
    """Observations [B, 29] -> the mean actions of the library's own network."""


@pytest.fixture(scope="module", params=("rsl_rl", "skrl"))
def trained(request, tmp_path_factory) -> Trained:
    """Each library's own runner trains for two iterations."""
    out = tmp_path_factory.mktemp(request.param)
    names = run_example(f"{request.param}_ppo.py", out)
    if request.param == "rsl_rl":

        def act(observation: torch.Tensor) -> torch.Tensor:
            return names["actor"](TensorDict({"policy": observation}, [len(observation)]))
    else:

        def act(observation: torch.Tensor) -> torch.Tensor:
            inputs = {"observations": names["preprocessor"](observation)}
            return names["policy_model"].act(inputs)[1]["mean_actions"]

    return Trained(out, act)


def run_example(name: str, out: Path) -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", f"{name} --num-envs 8 --steps 512 --out {out}".split())
        return runpy.run_path(str(EXAMPLES / name), run_name="__main__")


@pytest.mark.slow
def test_the_run_of_a_library_acts_like_its_network(trained):
    """Up to ten standard deviations, at which a policy clips its inputs."""
    (run,) = runs_in(trained.out)
    config = load_run_config(run)
    policy = read_policy(find_checkpoint(run), config)
    mean, std = (np.asarray(x) for x in policy.normalizer)
    normal = np.random.default_rng(1).normal(size=(64, 29)).clip(-9.0, 9.0)
    observation = (mean + np.where(std > 1e-2, normal * std, 0.0)).astype(np.float32)
    with torch.no_grad():
        expected = trained.act(torch.tensor(observation)).clamp(-1.0, 1.0).numpy()
    actions = make_networks(config.ppo, 29, 6).act(policy, observation)
    assert np.abs(expected).max() > 0.01
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert find_checkpoint(run).steps == 512


@pytest.mark.slow
@pytest.mark.parametrize("trained", ["rsl_rl"], indirect=True)
def test_rsl_rl_exports_the_policy(trained):
    """TorchScript and ONNX give the actions of the trained network."""
    folder = trained.out / "rsl_rl"
    observation = torch.randn(8, 29)
    with torch.no_grad():
        expected = trained.act(observation)
        torch.testing.assert_close(torch.jit.load(folder / "policy.pt")(observation), expected)
    session = onnxruntime.InferenceSession(folder / "policy.onnx")
    for row, action in zip(observation, expected, strict=True):
        (given,) = session.run(None, {"obs": row[None].numpy()})
        np.testing.assert_allclose(given[0], action, rtol=1e-4, atol=1e-5)


def linear_network(sizes: list[int], activation: nn.Module) -> nn.Sequential:
    layers = [x for a, b in itertools.pairwise(sizes) for x in (nn.Linear(a, b), activation)]
    return nn.Sequential(*layers[:-1])


def linear_policy(sizes: list[int], activation: nn.Module | None = None) -> TorchPolicy:
    mean, std = torch.zeros(sizes[0]), torch.ones(sizes[0])
    network = linear_network(sizes, activation or nn.SiLU())
    return to_policy(network, mean, std, torch.zeros(sizes[-1]))


def test_another_network_is_refused(task, tmp_path):
    with pytest.raises(UserError, match="layers Linear, GELU, Linear, but"):
        linear_policy([29, 8, 6], nn.GELU())
    with pytest.raises(UserError, match="an ELU with another alpha than 1"):
        linear_policy([29, 8, 6], nn.ELU(0.5))
    mixed = nn.Sequential(nn.Linear(2, 2), nn.Tanh(), nn.Linear(2, 2), nn.ReLU(), nn.Linear(2, 1))
    with pytest.raises(UserError, match="with one of SiLU, ReLU, Tanh or ELU between them"):
        to_policy(mixed, torch.zeros(2), torch.ones(2), torch.zeros(1))
    with pytest.raises(UserError, match="give the environment of the training"):
        write_run(tmp_path, task, linear_policy([28, 8, 6]), steps=0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("activation", [nn.SiLU(), nn.ReLU(), nn.Tanh(), nn.ELU()])
def test_a_policy_acts_as_its_network_in_pytorch(activation):
    """The activations that `ppo.activation` knows, at inputs of both signs."""
    network = linear_network([3, 4, 4, 2], activation)
    mean, std = torch.tensor([1.0, -2.0, 0.5]), torch.tensor([0.5, 2.0, 1.0])
    policy = to_policy(network, mean, std, torch.zeros(2))
    observation = torch.randn(16, 3)
    with torch.no_grad():
        expected = network((observation - mean) / std).clamp(-1.0, 1.0)
    networks = make_networks(policy.config, 3, 2)
    given = networks.act(policy.policy, jnp.asarray(observation.numpy()))
    np.testing.assert_allclose(given, expected, atol=1e-5)


def test_a_written_policy_is_read(task, tmp_path):
    policy = linear_policy([29, 8, 12, 6], nn.Tanh())
    run = write_run(tmp_path, task, policy, steps=64, seed=7)
    config = load_run_config(run)
    assert config.env == task.config and config.seed == 7
    assert config.ppo.activation == "tanh"
    read = read_policy(find_checkpoint(run), config)
    jax.tree.map(np.testing.assert_array_equal, read, policy.policy)
