"""How often the ball bounces in a row in an episode without an end: median and worst of 64.

    python benchmarks/endless.py pretrained robust --minutes 60
    python benchmarks/endless.py robust --minutes 60 --world fast_servo

A row is a policy in the nominal world or in a condition of endless.yaml, or in a named world. The
target height is sampled once for each episode, from 0.4 to 0.6 m. An episode ends when the task
ends it, as the ball is lost; "at the height" are bounces in a row whose apex was not more than 0.1
m too low (`n_bounces`), of which one low apex restarts the count. Medians and worst ones count an
episode whose ball is kept until the end as it is then: it would have gone on.
"""

import functools
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from tables import device_name, markdown_table, write

from bounce_mjx.commands.which_policy import MirrorRobot, WhichPolicy
from bounce_mjx.config.command_line import Flag, parse
from bounce_mjx.config.settings import Count, NonNegativeInt
from bounce_mjx.env.env import Env
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.evaluation.config import DEFAULT_SEED
from bounce_mjx.evaluation.episodes import begin, reset_episodes, run_until
from bounce_mjx.evaluation.suite import Condition, load_suite
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.runs.checkpoints import read_actor
from bounce_mjx.runs.worlds import settings_in_world
from bounce_mjx.training.setup import set_up_jax
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import TERMS, RandomizationConfig

EPISODES = 64
MINUTE = 60.0
"""Time between two looks at whether a ball is left, s."""


class EndlessCommand(WhichPolicy):
    """The command line."""

    policies: Annotated[tuple[Path, ...], Flag(metavar="POLICY ...", is_positional=True)]
    """Policies of the task bounce."""
    robot: MirrorRobot = None
    world: Path | None = None
    """Named world in place of the conditions of endless.yaml."""
    minutes: Count = 60
    """Longest episode, minutes of simulated time."""
    seed: NonNegativeInt = DEFAULT_SEED
    """Seed of the resets."""
    out: Path = Path("benchmarks/results")
    """Folder for endless.json and endless.md."""


def main() -> None:
    """Runs the command line; each policy's rows are written as they end."""
    with exit_on_user_error():
        doc = __doc__.split("\n")[0]
        command = parse(EndlessCommand, sys.argv[1:], prog="benchmarks/endless.py", description=doc)
        records = []
        for name in command.policies:
            (checkpoint,) = command.choose(name, robot=command.robot)
            config = command.config_of(checkpoint, command.robot)
            world = None if command.world is None else settings_in_world(config.env, command.world)
            suite = Path(__file__).with_name("endless.yaml")
            conditions = load_suite(suite, config.env, world)
            if world is not None:
                nominal = conditions[0]
                conditions = [nominal]
            set_up_jax(config.env)
            _, policy, actor = read_actor(checkpoint, config)
            started = time.perf_counter()
            rows = measure(policy, actor, conditions, command.minutes, command.seed)
            for row in rows:
                row |= {"policy": str(name), "seconds": time.perf_counter() - started}
                row["world"] = row["condition"] if world is None else str(command.world)
            records += rows
            device = device_name()
            record = {"device": device, "minutes": command.minutes, "records": records}
            write(command.out, "endless", record, f"Device: {device}\n\n{table(records)}")


def measure(
    policy: Policy | None,
    actor: Callable[[Env], Actor],
    conditions: Sequence[Condition],
    minutes: int,
    seed: int,
) -> list[dict]:
    """The bounces of every episode, a record for each condition. One program simulates all
    conditions at once, from the same resets."""
    env = Env(spanning_world(conditions))
    ranges = {}
    for name in (*env.config.randomization.terms, *env.config.goals):
        lows, highs = zip(*(condition.range(name) for condition in conditions), strict=True)
        ranges[name] = (
            jnp.asarray(np.stack(lows), jnp.float32),
            jnp.asarray(np.stack(highs), jnp.float32),
        )
    num_episodes = EPISODES * len(conditions)
    start = jax.jit(lambda key: reset_episodes(env, key, num_episodes, ranges))
    now = begin(env, start(jax.random.PRNGKey(seed)), recorded=0)
    advance = jax.jit(functools.partial(run_until, env, actor(env)))
    minute_steps = round(MINUTE / env.dt)
    for minute in range(1, minutes + 1):
        now = advance(policy, now, minute * minute_steps)
        kept = np.asarray(now.statistics.running).reshape(-1, EPISODES).sum(1)
        print(f"minute {minute}: balls kept {kept.tolist()}", flush=True)
        if not kept.any():
            break
    statistics = now.statistics
    size = len(conditions), EPISODES
    kept = np.asarray(statistics.running).reshape(size).sum(axis=1)
    bounces = np.asarray(statistics.tally.sums["hits"]).reshape(size)
    at_the_height = np.asarray(statistics.tally.maxima["n_bounces"]).reshape(size)
    steps = np.asarray(statistics.steps).reshape(size)
    return [
        {
            "condition": condition.perturbation.name,
            "kept": int(kept[i]),
            "bounces": bounces[i].tolist(),
            "at_the_height": at_the_height[i].tolist(),
            "steps": steps[i].tolist(),
        }
        for i, condition in enumerate(conditions)
    ]


def spanning_world(conditions: Sequence[Condition]) -> WorldConfig:
    """The world with all terms of the conditions, in ranges that contain theirs."""
    names = {name for condition in conditions for name in condition.ranges} & TERMS.keys()
    spans = {}
    for name in sorted(names):
        lows, highs = zip(*(condition.range(name) for condition in conditions), strict=True)
        spans[name] = float(np.min(lows)), float(np.max(highs))
    # Wider than the limits of a config where a condition is beyond them.
    sampled = RandomizationConfig().model_copy(update=spans)
    return conditions[0].env.model_copy(update={"randomization": sampled})


def table(records: Sequence[dict]) -> str:
    """One row for each policy and condition."""
    header = ["policy", "world", "bounces, median", "worst", "at the height, median", "worst"]
    rows = [
        [
            record["policy"],
            record["world"],
            f"{np.median(record['bounces']):,.0f}",
            f"{min(record['bounces']):,.0f}",
            f"{np.median(record['at_the_height']):,.0f}",
            f"{min(record['at_the_height']):,.0f}",
            f"{record['kept']} of {EPISODES}",
        ]
        for record in records
    ]
    return markdown_table([*header, "balls kept to the end"], rows)


if __name__ == "__main__":
    main()
