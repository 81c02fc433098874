"""Overhead of the PyTorch adapter: the time of a step through it, and of the jitted step alone.

    python benchmarks/adapter.py --num-envs 4096 32768

Each figure is the median over rounds, in which the variants take turns. Within a round the steps
follow one another as in a training run; only the end of the round waits for the device.
"""

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
from pydantic import Field
from tables import device_name, markdown_table, write

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.env import vector
from bounce_mjx.env.bounce_ball import BounceBall
from bounce_mjx.errors import exit_on_user_error


class Command(StrictModel):
    """The command line."""

    num_envs: tuple[Annotated[int, Field(ge=1)], ...] = (4096,)
    """Batch sizes."""
    steps: Annotated[int, Field(ge=1)] = 1000
    """Steps per round."""
    rounds: Annotated[int, Field(ge=1)] = 7
    """Rounds of each variant."""
    out: Path = Path("benchmarks/results")
    """Folder for adapter.json and adapter.md."""


def make_variants(num_envs: int) -> dict[str, Callable[[int], None]]:
    """Functions that take a number of steps and wait for the last one."""
    import torch

    from bounce_mjx.adapters.torch import TorchVectorEnv
    from bounce_mjx.adapters.torch.rsl_rl_env import RslRlVecEnv

    env = BounceBall()
    episode_steps = env.config.episode_steps

    def step(state, action, key):
        key, reset_key = jax.random.split(key)
        state, result = vector.step(env, state, action, reset_key, episode_steps)
        return state, result, key

    jitted = jax.jit(step, donate_argnums=0)
    state = vector.reset(env, jax.random.PRNGKey(0), num_envs)
    key = jax.random.PRNGKey(1)
    jax_action = jnp.zeros((num_envs, env.action_size))

    def jitted_alone(steps: int) -> None:
        # A step gives the memory of its state to the next one.
        nonlocal state, key
        for _ in range(steps):
            state, result, key = jitted(state, jax_action, key)
        jax.block_until_ready(result)

    tensors = TorchVectorEnv(env, num_envs)
    tensors.reset()
    vec_env = RslRlVecEnv(TorchVectorEnv(env, num_envs))
    action = torch.zeros((num_envs, env.action_size), device=tensors.device)

    def wait(tensor: torch.Tensor) -> None:
        tensor.sum().item()

    def torch_vector_env(steps: int) -> None:
        for _ in range(steps):
            result = tensors.step(action)
        wait(result.observation)

    def rsl_rl_vec_env(steps: int) -> None:
        for _ in range(steps):
            observations, *_ = vec_env.step(action)
        wait(observations["policy"])

    return {
        "jitted step alone": jitted_alone,
        "TorchVectorEnv": torch_vector_env,
        "RslRlVecEnv": rsl_rl_vec_env,
    }


def measure(command: Command, num_envs: int) -> dict[str, float]:
    """Seconds per step of each variant."""
    variants = make_variants(num_envs)
    for run in variants.values():
        run(3)
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(command.rounds):
        for name, run in variants.items():
            started = time.perf_counter()
            run(command.steps)
            seconds[name].append((time.perf_counter() - started) / command.steps)
    return {name: statistics.median(values) for name, values in seconds.items()}


def main() -> None:
    """Runs the command line."""
    with exit_on_user_error():
        doc = __doc__.split("\n")[0]
        command = parse(Command, sys.argv[1:], prog="benchmarks/adapter.py", description=doc)
        records = []
        rows = []
        for num_envs in command.num_envs:
            seconds = measure(command, num_envs)
            records.append({"num_envs": num_envs, "seconds": seconds})
            alone = seconds["jitted step alone"]
            for name, value in seconds.items():
                rows.append(
                    [
                        f"{num_envs:,}",
                        name,
                        f"{1e6 * value:.0f}",
                        f"{num_envs / value / 1e6:.2f}",
                        f"{100.0 * (value / alone - 1.0):+.1f}",
                    ]
                )
        header = ["environments", "interface", "us per step", "M env steps/s", "overhead, %"]
        device = device_name()
        text = f"Device: {device}\n\n{markdown_table(header, rows)}"
        write(command.out, "adapter", {"device": device, "records": records}, text)


if __name__ == "__main__":
    main()
