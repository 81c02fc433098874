"""Ten minutes without a reset: the share of environments that keep the ball up, and the memory.

    python benchmarks/endurance.py RUN --num-envs 1024 --minutes 10

The policy acts without a time limit and without resets. An environment fails when its episode first
terminates, for example because the ball falls or flies away. Each row is one minute of simulated
time.
"""

import resource
import sys
import time
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
from pydantic import Field
from tables import device_name, markdown_table, write

from bounce_mjx import BounceBall
from bounce_mjx.config.command_line import Flag, parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.evaluation.config import DEFAULT_SEED
from bounce_mjx.evaluation.results import judge
from bounce_mjx.evaluation.statistics import accumulate, empty_statistics
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.reports.tables import figure_text
from bounce_mjx.runs.checkpoints import read_policy
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import find_checkpoint, place_or_newest

# Minimum share of environments that keep the ball up throughout.
MIN_SHARE = 0.99


class Command(StrictModel):
    """The command line."""

    checkpoint: Annotated[Path | None, Flag(is_positional=True)] = None
    """A run's folder or a checkpoint in it. The default is the newest run."""
    num_envs: Annotated[int, Field(ge=1)] = 1024
    """Number of environments."""
    minutes: Annotated[int, Field(ge=1)] = 10
    """Simulated minutes of each environment."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = DEFAULT_SEED
    """Seed of the resets."""
    log_dir: Path = Path("runs/bounce_ball")
    """Folder in which to look for the newest run."""
    out: Path = Path("benchmarks/results")
    """Folder for endurance.json and endurance.md."""


def measure(command: Command) -> list[dict]:
    """One record per minute."""
    checkpoint = find_checkpoint(place_or_newest(command.checkpoint, command.log_dir))
    config = load_run_config(checkpoint.run)
    env = BounceBall(config.env)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    policy = read_policy(checkpoint, config)
    steps = round(60.0 / env.dt)

    @jax.jit
    def start(key):
        states = jax.vmap(env.reset, out_axes=-1)(jax.random.split(key, command.num_envs))
        return states, empty_statistics(env, states), jnp.int32(0)

    def advance(_, carry):
        states, statistics, step = carry
        actions = networks.act(policy, states.obs.T)
        states = jax.vmap(env.step, in_axes=-1, out_axes=-1)(states, actions.T)
        return states, accumulate(env, statistics, states, step), step + 1

    def play_minute(carry):
        return jax.lax.fori_loop(0, steps, advance, carry)

    carry = start(jax.random.PRNGKey(command.seed))
    # Compiled before the first minute is timed.
    minute = jax.jit(play_minute, donate_argnums=0).lower(carry).compile()
    records = []
    for number in range(1, command.minutes + 1):
        started = time.perf_counter()
        carry = jax.block_until_ready(minute(carry))
        seconds = time.perf_counter() - started
        _, statistics, _ = carry
        report = judge(env, statistics)
        memory = jax.devices()[0].memory_stats() or {}
        records.append(
            {
                "minute": number,
                "up_share": float(statistics.running.mean()),
                "results": {result.name: result.value for result in report.results},
                "mean_apex_error_m": report.details["mean_apex_error_m"],
                "seconds": seconds,
                "peak_process_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
                "device_mib": memory.get("bytes_in_use", 0) / 2**20,
            }
        )
        print(f"minute {number}: {records[-1]['up_share']:.2%} up, {seconds:.1f} s", flush=True)
    return records


def table(records: list[dict]) -> str:
    """One row per minute."""
    rows = [
        [
            str(r["minute"]),
            f"{100 * r['up_share']:.2f}",
            figure_text(r["results"]["horizontal position"]),
            figure_text(r["results"]["height"]),
            figure_text(100.0 * r["mean_apex_error_m"], ".1f"),
            f"{r['seconds']:.1f}",
            f"{r['peak_process_mib']:.0f}",
            f"{r['device_mib']:.0f}",
        ]
        for r in records
    ]
    header = [
        "minute",
        "ball up since the start %",
        "horizontal %",
        "height %",
        "mean apex error, cm",
        "s",
        "process, MiB (peak)",
        "device, MiB",
    ]
    return markdown_table(header, rows)


def main() -> None:
    """Runs the command line; the exit status is 1 if too few environments kept the ball up."""
    with exit_on_user_error():
        command = parse(
            Command,
            sys.argv[1:],
            prog="benchmarks/endurance.py",
            description=__doc__.split("\n")[0],
        )
        records = measure(command)
        device = device_name()
        record = {"device": device, "num_envs": command.num_envs, "records": records}
        write(command.out, "endurance", record, f"Device: {device}\n\n{table(records)}")
    sys.exit(0 if records[-1]["up_share"] >= MIN_SHARE else 1)


if __name__ == "__main__":
    main()
