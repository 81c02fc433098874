"""Ranks policies by figures beyond the expected results: `bounce-mjx benchmark POLICY...`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import Progress

from bounce_mjx.commands.run_options import ActorCommand
from bounce_mjx.config.command_line import parse, stdout
from bounce_mjx.config.settings import Count, NonNegativeInt
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation.config import (
    DEFAULT_CONDITION_EPISODES,
    DEFAULT_SEED,
    EvaluationOptions,
    Physics,
    on_engine,
)


class BenchmarkCommand(ActorCommand):
    """Ranks policies by figures beyond the expected results (docs/benchmark.md)."""

    policies: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="POLICY ...")]
    """Rows of the table: a run, a checkpoint, a policy that comes with the package, mirror for the
    mirror law, or a folder whose runs are the seeds of one training run."""
    episodes: Count = DEFAULT_CONDITION_EPISODES
    """Episodes in each condition."""
    seed: NonNegativeInt = DEFAULT_SEED
    """Seed of the resets."""
    physics: Physics = "config"
    """Physics engine of the conditions; config is the engine used in training."""
    out: Path = Path("benchmark")
    """Folder for benchmark.json, benchmark.md and benchmark.html."""


@exit_on_user_error()
def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 2 on a mistake."""
    command = parse(BenchmarkCommand, args, prog="bounce-mjx benchmark")
    import jax

    import bounce_mjx
    from bounce_mjx.env.env import Env
    from bounce_mjx.evaluation.benchmark import measure
    from bounce_mjx.reports import benchmark as reports
    from bounce_mjx.reports.tables import robot_name
    from bounce_mjx.runs.files import to_json, writable, write_output
    from bounce_mjx.runs.folders import runs_of_row
    from bounce_mjx.runs.reading import read_actor
    from bounce_mjx.training.setup import set_up_jax

    if not command.policies:
        raise UserError("no policy is given; give one, such as pretrained")
    console = stdout()
    members = [
        [command.choose(path, console) for path in runs_of_row(path)] for path in command.policies
    ]
    configs = [[command.config_of(checkpoint) for checkpoint in row] for row in members]
    set_up_jax(*(on_engine(c.env, command.physics) for row in configs for c in row))
    with writable(command.out, "choose another folder with --out"):
        command.out.mkdir(parents=True, exist_ok=True)
    options = EvaluationOptions(command.episodes, command.seed, command.physics)
    engine = "mujoco" if command.physics == "mujoco" else Env(configs[0][0].env).engine.name
    done = 0
    benchmark = reports.Benchmark(
        version=bounce_mjx.__version__,
        device=jax.devices()[0].device_kind,
        physics=engine,
        episodes=command.episodes,
        seed=command.seed,
        rows=[],
    )
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("policies", total=sum(map(len, members)))

        def show(share: float) -> None:
            bar.update(task, completed=done + share)

        for path, checkpoints, of_row in zip(command.policies, members, configs, strict=True):
            figures = []
            for checkpoint, config in zip(checkpoints, of_row, strict=True):
                _, *actor = read_actor(checkpoint, config)
                figures.append(measure(*actor, config.env, options, show))
                done += 1
            task_and_robot = of_row[0].task, robot_name(of_row[0].env)
            row = reports.Row(str(path), *task_and_robot, figures)
            console.out(reports.line(row), highlight=False)
            benchmark.rows.append(row)
            # Each row takes minutes, so the files have those so far.
            files = {
                reports.BENCHMARK_FILE: to_json(benchmark),
                "benchmark.md": reports.markdown(benchmark),
                "benchmark.html": reports.page(benchmark),
            }
            for name, content in files.items():
                with writable(command.out, "choose another folder with --out"):
                    write_output(command.out / name, content)
    print(files["benchmark.md"])
    print(*(command.out / name for name in files), sep="\n")
