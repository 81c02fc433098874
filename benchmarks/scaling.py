"""Scaling of the training with the number of seeds and with the number of devices.

    python benchmarks/scaling.py --num-seeds 1 4 16 --num-devices 1 2 4

Seeds: the time of one block of training with S seeds in one program, relative to one seed. Devices:
environment steps per second on D devices with `--num-envs` environments on each, relative to one
device. The hyperparameters come from the preset. Only the compiled block is timed. The fastest
repeat counts, because other work on the machine can only slow a repeat down.
"""

import sys
import time
from pathlib import Path
from typing import Annotated

import jax
from pydantic import Field
from tables import device_name, markdown_table, write

from bounce_mjx import BounceBall
from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.ppo import make_trainer, population
from bounce_mjx.runs.config import read_preset
from bounce_mjx.training.devices import make_mesh, replicated, state_sharding
from bounce_mjx.training.setup import compiler_options, set_up_gpu

Counts = tuple[Annotated[int, Field(ge=1)], ...]


class Command(StrictModel):
    """The command line."""

    num_seeds: Counts = (1, 16)
    """Numbers of seeds, each on one device."""
    num_devices: Counts = (1,)
    """Numbers of devices, each with one seed."""
    num_envs: Annotated[int, Field(ge=1)] = 4096
    """Environments on each device."""
    num_minibatches: Annotated[int, Field(ge=1)] | None = None
    """Minibatches in an epoch. The default is the preset's."""
    iterations: Annotated[int, Field(ge=1)] = 8
    """Iterations in one measured block."""
    repeats: Annotated[int, Field(ge=1)] = 8
    """Measurements of each block."""
    out: Path = Path("benchmarks/results")
    """Folder for scaling.json and scaling.md."""


def measure(command: Command, num_seeds: int, num_devices: int) -> dict:
    """The time of one block of training."""
    preset = dict(read_preset(None).ppo)
    preset["num_envs"] = command.num_envs * num_devices
    preset["num_minibatches"] = command.num_minibatches or preset["num_minibatches"]
    config = PPOConfig(**preset)
    mesh = make_mesh(num_devices, config, num_seeds)
    env = BounceBall()
    sharing = num_devices if num_seeds == 1 else 1
    trainer = make_trainer(config, env, env.config.episode_steps, sharing)
    key = jax.random.PRNGKey(0)
    if num_seeds > 1:
        trainer, key = population(trainer), jax.random.split(key, num_seeds)
    sharding = state_sharding(mesh, jax.eval_shape(trainer.init, key), num_seeds)
    started = time.perf_counter()
    state = jax.jit(trainer.init, out_shardings=sharding)(key)
    run = jax.jit(
        lambda state: trainer.run(state, command.iterations),
        in_shardings=(sharding,),
        out_shardings=(sharding, replicated(mesh) if num_seeds == 1 else None),
        donate_argnums=0,
        compiler_options=compiler_options(tunes_products=True),
    )
    state, metrics = jax.block_until_ready(run(state))
    compile_seconds = time.perf_counter() - started
    seconds = []
    for _ in range(command.repeats):
        started = time.perf_counter()
        state, metrics = jax.block_until_ready(run(state))
        seconds.append(time.perf_counter() - started)
    steps = num_seeds * command.iterations * config.batch_steps
    return {
        "num_seeds": num_seeds,
        "num_devices": num_devices,
        "num_envs": config.num_envs,
        "seconds": min(seconds),
        "steps_per_second": steps / min(seconds),
        "compile_seconds": compile_seconds,
    }


def table(records: list[dict]) -> str:
    """Milliseconds per block and steps per second, absolute and relative to the first row."""
    first = records[0]
    rows = [
        [
            str(r["num_seeds"]),
            str(r["num_devices"]),
            f"{r['num_envs']:,}",
            f"{1e3 * r['seconds']:.1f}",
            f"{r['steps_per_second'] / 1e6:.2f}",
            f"{r['seconds'] / first['seconds']:.2f}",
            f"{r['steps_per_second'] / first['steps_per_second']:.2f}",
            f"{r['compile_seconds']:.1f}",
        ]
        for r in records
    ]
    header = [
        "seeds",
        "devices",
        "environments per seed",
        "ms per block",
        "M steps/s",
        "time x",
        "steps/s x",
        "compile and first block, s",
    ]
    return markdown_table(header, rows)


def main() -> None:
    """Runs the command line."""
    with exit_on_user_error():
        set_up_gpu()
        command = parse(
            Command, sys.argv[1:], prog="benchmarks/scaling.py", description=__doc__.split("\n")[0]
        )
        records = [measure(command, seeds, 1) for seeds in command.num_seeds]
        records += [measure(command, 1, devices) for devices in command.num_devices if devices > 1]
        device = device_name()
        record = {"device": device, "jax": jax.__version__, "records": records}
        write(command.out, "scaling", record, f"Device: {device}\n\n{table(records)}")


if __name__ == "__main__":
    main()
