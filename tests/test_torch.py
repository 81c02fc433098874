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
import torch
from tensordict import TensorDict
from torch import nn

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.adapters.torch import TorchVectorEnv
from bounce_mjx.adapters.torch.policy import to_policy, write_run
from bounce_mjx.adapters.torch.rsl_rl_env import RslRlVecEnv
from bounce_mjx.adapters.torch.skrl_env import SkrlEnv
from bounce_mjx.env import vector
from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import Policy, make_networks
from bounce_mjx.runs.checkpoints import read_policy
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import find_checkpoint, runs_in

# Threads that wait for a busy core slow tiny networks down a hundredfold.
torch.set_num_threads(1)
NUM_ENVS = 4
# Each test includes both a fall (the ball reaches the floor after 0.3 s) and time-outs.
EPISODE_STEPS = 20
EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def task() -> BounceBall:
    return BounceBall(EnvConfig(physics="fused", episode_seconds=0.01 * EPISODE_STEPS))


@pytest.fixture(scope="module")
def env(task) -> TorchVectorEnv:
    return TorchVectorEnv(task, NUM_ENVS, seed=3)


def random_actions(steps: int) -> torch.Tensor:
    """Actions [steps, B, 6], some of them beyond the limits."""
    return 1.5 * torch.randn(steps, NUM_ENVS, 6, generator=torch.Generator().manual_seed(0))


def test_actions_and_results_share_the_memory_of_jax(env, monkeypatch):
    seen, arrays = [], []
    env.reset()
    step = env._jit_step

    def spy(carried, action):
        seen.append(action.unsafe_buffer_pointer())
        carried, result = step(carried, action)
        arrays.extend(result)
        return carried, result

    monkeypatch.setattr(env, "_jit_step", spy)
    # PyTorch aligns a tensor as JAX needs it unless it is a part of another tensor.
    action = torch.zeros(NUM_ENVS, 6)
    for tensor, array in zip(env.step(action), arrays, strict=True):
        assert tensor.data_ptr() == array.unsafe_buffer_pointer()
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
    policy: Policy
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
            inputs = {"observations": names["seen"](observation)}
            return names["models"]["policy"].act(inputs)[1]["mean_actions"]

    return Trained(out, names["policy"], act)


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
def test_rsl_rl_exports_the_policy(trained):
    """TorchScript and ONNX give the actions of the trained network."""
    if not (folder := trained.out / "rsl_rl").exists():
        pytest.skip("skrl exports nothing")
    observation = torch.randn(8, 29)
    with torch.no_grad():
        expected = trained.act(observation)
        torch.testing.assert_close(torch.jit.load(folder / "policy.pt")(observation), expected)
    session = onnxruntime.InferenceSession(folder / "policy.onnx")
    for row, action in zip(observation, expected, strict=True):
        (given,) = session.run(None, {"obs": row[None].numpy()})
        np.testing.assert_allclose(given[0], action, rtol=1e-4, atol=1e-5)


def linear_policy(sizes: list[int], activation: type[nn.Module] = nn.SiLU) -> Policy:
    layers = [x for a, b in itertools.pairwise(sizes) for x in (nn.Linear(a, b), activation())]
    mean, std = torch.zeros(sizes[0]), torch.ones(sizes[0])
    return to_policy(nn.Sequential(*layers[:-1]), mean, std, torch.zeros(sizes[-1]))


def test_another_network_is_refused(task, tmp_path):
    with pytest.raises(UserError, match="layers Linear, ELU, Linear, but"):
        linear_policy([29, 8, 6], nn.ELU)
    with pytest.raises(UserError, match="give the environment of the training"):
        write_run(tmp_path, task, linear_policy([28, 8, 6]), steps=0)
    assert not list(tmp_path.iterdir())


def test_a_written_policy_is_read(task, tmp_path):
    policy = linear_policy([29, 8, 12, 6])
    run = write_run(tmp_path, task, policy, steps=64, seed=7)
    config = load_run_config(run)
    assert config.env == task.config and config.seed == 7
    jax.tree.map(np.testing.assert_array_equal, read_policy(find_checkpoint(run), config), policy)
