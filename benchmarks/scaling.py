"""Scaling of the training with the number of seeds and with the number of devices.

    python benchmarks/scaling.py --num-seeds 1 16
    python benchmarks/scaling.py --config transfer --num-devices 1 2 --num-envs 8192 32768

Each program trains the same environments per seed on all its devices together, so that the global
batch is equal. The programs take turns: a turn is one compiled block of each, and the table has the
median of the blocks and of each turn's ratio to the first program with the same environments, in
the order of the flags' values.
`--profile` also says, from one more block of each program, how long a device computes, exchanges,
and waits.
"""

import concurrent.futures
import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import jax
from jax.profiler import ProfileData
from pydantic import Field
from tables import device_name, markdown_table, write

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.training.ppo_trainer import PPOTrainer
from bounce_mjx.training.setup import set_up_jax

Count = Annotated[int, Field(ge=1)]
Counts = tuple[Count, ...]


class Command(StrictModel):
    """The command line."""

    config: Path | None = None
    """The preset. The default is this machine's."""
    num_seeds: Counts = (1,)
    """Numbers of seeds, which the devices divide among them."""
    num_devices: Counts = (1,)
    """Numbers of devices."""
    num_envs: Counts = ()
    """Numbers of environments of one seed, on all devices together. The default is the preset's."""
    num_minibatches: Count | None = None
    """Minibatches in an epoch. The default is the preset's."""
    iterations: Count | None = None
    """Iterations in one measured block. The default is a block of the training."""
    turns: Count = 12
    """Turns."""
    profile: bool = False
    """Whether to profile one more block of each program."""
    out: Path = Path("benchmarks/results")
    """Folder for scaling.json and scaling.md."""


def configs(command: Command) -> list[TrainConfig]:
    """The config of each program."""
    preset = read_preset(command.config)
    made = []
    for num_envs, num_seeds, num_devices in itertools.product(
        command.num_envs or (preset.ppo.num_envs,), command.num_seeds, command.num_devices
    ):
        minibatches = command.num_minibatches or preset.ppo.num_minibatches
        ppo = preset.ppo.model_copy(update={"num_envs": num_envs, "num_minibatches": minibatches})
        update = {"ppo": ppo, "num_seeds": num_seeds, "num_devices": num_devices}
        if command.iterations is not None:
            update["block_steps"] = command.iterations * ppo.batch_steps
        made.append(preset.model_copy(update=update))
    return made


def programs(configs: list[TrainConfig]) -> list[Callable[[], object]]:
    """Compiles each training and runs its first block; each function runs one more block of it."""
    trainers = [PPOTrainer(config, Env(config.env)) for config in configs]
    with concurrent.futures.ThreadPoolExecutor() as pool:
        for trainer in trainers:
            trainer.compile(pool)

    for trainer in trainers:
        trainer.start()
        trainer.train_block()
    return [trainer.train_block for trainer in trainers]


def seconds_of(block: Callable[[], object]) -> float:
    started = time.perf_counter()
    block()
    return time.perf_counter() - started


def profile(block: Callable[[], object]) -> dict[str, float]:
    """Milliseconds of a block in which the first device computes, only exchanges, and does neither
    (it waits for the processor or for the other devices' start)."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            seconds = seconds_of(block)
        (file,) = Path(folder).rglob("*.xplane.pb")
        plane = ProfileData.from_file(str(file)).find_plane_with_name("/device:GPU:0")
        kernels = [
            ("nccl" in event.name.lower(), event.start_ns, event.start_ns + event.duration_ns)
            for line in plane.lines
            if line.name.startswith("Stream")
            for event in line.events
        ]
    busy = covered((start, end) for _, start, end in kernels)
    computing = covered((start, end) for exchanges, start, end in kernels if not exchanges)
    return {
        "compute_ms": 1e-6 * computing,
        "exchange_ms": 1e-6 * (busy - computing),
        "wait_ms": 1e3 * seconds - 1e-6 * busy,
    }


def covered(intervals: Iterable[tuple[float, float]]) -> float:
    """Length of the union of intervals."""
    total = 0.0
    reached = -float("inf")
    for start, end in sorted(intervals):
        total += max(0.0, end - max(start, reached))
        reached = max(reached, end)
    return total


def measure(command: Command) -> list[dict]:
    """The blocks of every program, alternating.

    Raises:
      UserError: there is no GPU to profile.
    """
    if command.profile and jax.default_backend() != "gpu":
        raise UserError(f"--profile needs a GPU, but JAX runs on {device_name()}; leave it out")
    measured = configs(command)
    blocks = programs(measured)
    turns = [[seconds_of(block) for block in blocks] for _ in range(command.turns)]
    records = []
    # The speeds of the first program with each number of environments.
    reference: dict[int, list[float]] = {}
    for config, block, seconds in zip(measured, blocks, zip(*turns, strict=True), strict=True):
        num_envs = config.ppo.num_envs
        speeds = [steps_of(config) / s for s in seconds]
        if num_envs not in reference:
            reference[num_envs] = speeds
        ratios = [speed / other for speed, other in zip(speeds, reference[num_envs], strict=True)]
        record = {
            "num_seeds": config.num_seeds,
            "num_devices": config.num_devices,
            "num_envs": num_envs,
            "seconds": seconds,
            "steps_per_second": statistics.median(speeds),
            "ratio": statistics.median(ratios),
            "ratios": ratios,
        }
        if command.profile:
            record |= profile(block)
        records.append(record)
    return records


def steps_of(config: TrainConfig) -> int:
    """Steps of all seeds in one block."""
    return config.num_seeds * config.steps_per_block


def table(records: list[dict]) -> str:
    """Milliseconds per block, and steps per second with their ratio to the first program's."""
    header = [
        "seeds",
        "devices",
        "environments",
        "ms per block",
        "M steps/s",
        "x",
        "lowest to highest",
    ]
    profiled = [name for name in ("compute_ms", "exchange_ms", "wait_ms") if name in records[0]]
    rows = [
        [
            str(r["num_seeds"]),
            str(r["num_devices"]),
            f"{r['num_envs']:,}",
            f"{1e3 * statistics.median(r['seconds']):.1f}",
            f"{r['steps_per_second'] / 1e6:.3g}",
            f"{r['ratio']:.2f}",
            f"{min(r['ratios']):.2f} to {max(r['ratios']):.2f}",
            *(f"{r[name]:.1f}" for name in profiled),
        ]
        for r in records
    ]
    return markdown_table([*header, *(name.replace("_", ", ") for name in profiled)], rows)


def main() -> None:
    """Runs the command line."""
    with exit_on_user_error():
        command = parse(
            Command, sys.argv[1:], prog="benchmarks/scaling.py", description=__doc__.split("\n")[0]
        )
        set_up_jax(read_preset(command.config).env)
        records = measure(command)
        device = device_name()
        record = {"device": device, "jax": jax.__version__, "records": records}
        write(command.out, "scaling", record, f"Device: {device}\n\n{table(records)}")


if __name__ == "__main__":
    main()
