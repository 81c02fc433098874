"""Time of whole training runs, and the five results of their policies on every engine, over seeds.

    python benchmarks/train.py --seeds 0 1 2 3 4 --engines fused mjx mujoco

Each training run is a separate process with an empty compilation cache. It runs
`train_jax.py --stop-when-solved` as a user would, with the flags that follow `--`. "solved" is the
first evaluation that meets all five results; the training, and its time, continue until they have a
margin. (Code without a margin ended at that evaluation.) `start.py` measures the time to it.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from tables import device_name, markdown_table, write

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.reports.tables import figure_text

PHASES = ("import", "setup", "compile", "train", "evaluate", "save")


class Command(StrictModel):
    """The command line."""

    seeds: tuple[Annotated[int, Field(ge=0)], ...] = (0, 1, 2, 3, 4)
    """Seeds of the runs."""
    engines: tuple[Literal["fused", "mjx", "mujoco"], ...] = ("fused", "mujoco")
    """Engines on which each trained policy is evaluated, 1,024 episodes each."""
    stop_when_solved: bool = True
    """End a training run once its results have a margin, or at total_steps."""
    out: Path = Path("benchmarks/results")
    """Folder for train.json and train.md."""


def train_once(seed: int, folder: Path, stop_when_solved: bool, extra: list[str]) -> dict:
    """Runs one cold training and returns its results with the time of each phase."""
    stop = "--stop-when-solved" if stop_when_solved else "--no-stop-when-solved"
    command = [sys.executable, "train_jax.py", "--seed", str(seed), stop]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache")}
    started = time.perf_counter()
    finished = subprocess.run(
        [*command, "--log-dir", str(folder / "runs"), *extra],
        env=environment,
        cwd=Path(__file__).resolve().parent.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    total = time.perf_counter() - started
    if finished.returncode:
        raise UserError(f"the training with seed {seed} failed: {finished.stdout[-500:]}")
    run = next((folder / "runs").iterdir())
    results = json.loads((run / "results.json").read_text(encoding="utf-8"))
    seconds = results["seconds"]
    seconds["import"] = total - sum(seconds.values())
    return {"seed": seed, "run": str(run), "total_seconds": total, **results}


def evaluate_on(run: str, engine: str, folder: Path) -> dict:
    """The five results of a run's policy on one engine."""
    out = folder / f"{engine}.json"
    finished = subprocess.run(
        [sys.executable, "-m", "bounce_mjx.eval", run, "--physics", engine, "--json", str(out)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    # Status 1 means that a result failed, which is a valid measurement.
    if finished.returncode not in (0, 1):
        raise UserError(f"the evaluation on {engine} failed: {finished.stderr[-500:]}")
    return json.loads(out.read_text(encoding="utf-8"))


def later_passes(record: dict) -> list[bool]:
    """For each evaluation after the first pass, whether it passed too."""
    solved = record["solved_steps"] or float("inf")
    return [e["passed"] for e in record["evaluations"] if e["steps"] > solved]


def table(records: list[dict], engines: tuple[str, ...]) -> str:
    """Two tables: the time to the five results, and the five results on each engine."""
    times = [
        [
            str(r["seed"]),
            "-" if r["solved_steps"] is None else f"{r['solved_steps'] / 1e6:.2f}",
            *[f"{r['seconds'][phase]:.1f}" for phase in PHASES],
            f"{r['total_seconds']:.1f}",
            f"{sum(later)} of {len(later)}" if (later := later_passes(r)) else "-",
        ]
        for r in records
    ]
    results = [
        [
            str(r["seed"]),
            engine,
            *[figure_text(result["value"]) for result in r["engines"][engine]["results"]],
            "pass" if r["engines"][engine]["passed"] else "FAIL",
            f"{r['engines'][engine]['details']['mean_consecutive_bounces']:.1f}",
            figure_text(100.0 * r["engines"][engine]["details"]["mean_apex_error_m"], ".1f"),
        ]
        for r in records
        for engine in engines
    ]
    time_header = ["seed", "solved, M steps", *[f"{phase} s" for phase in PHASES], "total s"]
    time_header.append("later evaluations passed")
    result_header = [
        "seed",
        "engine",
        "1 bounces %",
        "2 horizontal %",
        "3 height %",
        "4 speed m/s",
        "5 stable %",
        "",
        "mean bounces",
        "mean apex error, cm",
    ]
    return f"{markdown_table(time_header, times)}\n\n{markdown_table(result_header, results)}"


def main() -> None:
    """Runs the command line."""
    with exit_on_user_error():
        args = sys.argv[1:]
        extra = args[args.index("--") + 1 :] if "--" in args else []
        own = args[: args.index("--")] if "--" in args else args
        command = parse(
            Command, own, prog="benchmarks/train.py", description=__doc__.split("\n")[0]
        )
        records = []
        for seed in command.seeds:
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                record = train_once(seed, folder, command.stop_when_solved, extra)
                record["engines"] = {
                    engine: evaluate_on(record["run"], engine, folder) for engine in command.engines
                }
                records.append(record)
                solved = record["solved_steps"]
                verdicts = ", ".join(
                    f"{engine} {'pass' if report['passed'] else 'FAIL'} "
                    + "/".join(figure_text(result["value"]) for result in report["results"])
                    for engine, report in record["engines"].items()
                )
                print(
                    f"seed {seed}: {record['total_seconds']:.1f} s, solved at {solved}, {verdicts}",
                    flush=True,
                )
        device = device_name()
        text = f"Device: {device}\n\n{table(records, command.engines)}"
        write(command.out, "train", {"device": device, "records": records}, text)


if __name__ == "__main__":
    main()
