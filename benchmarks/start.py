"""Time from process start to all five results, cold and with the compilation cache, by phase.

    python benchmarks/start.py --seeds 1 2

A cold start has an empty compilation cache; each second start uses the cache of the cold start
before it. Each is a process of `bounce-mjx train --stop-when-solved`, as a user starts it, with
the flags that follow `--`.

The phases setup to save are the training's own. "import" is the rest of the time until it prints
them: Python, the imports, the config, and the end of the last save. So these six add up to that
moment; "total" also has the end of the process. "tracing", "lowering" and "xla" overlap the phases
and each other: at least one such event was in progress, in any thread.

"results" is the end of the first evaluation that meets all five; the training, and its phases,
continue until they have a margin. (Code without a margin ended there, and its "results" include the
final evaluation.) The benchmark also times `import bounce_mjx`, the import of the environment, and
`--help`. Python keeps its bytecode, as it does by default: the benchmark unsets
PYTHONDONTWRITEBYTECODE, and imports the modules of a training run once before.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field
from tables import device_name, markdown_table, write

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import UserError, exit_on_user_error

PHASES = ("setup", "compile", "train", "evaluate", "save")

TIMED = Path(__file__).with_name("timed_train.py")
TRACE = "/jax/core/compile/jaxpr_trace_duration"
LOWER = "/jax/core/compile/jaxpr_to_mlir_module_duration"
COMPILE = "/jax/core/compile/backend_compile_duration"
REQUEST = "/jax/compilation_cache/compile_requests_use_cache"
HIT = "/jax/compilation_cache/cache_hits"

QUICK = {
    "python": ["-c", ""],
    "import bounce_mjx": ["-c", "import bounce_mjx"],
    "from bounce_mjx import BounceBall": ["-c", "from bounce_mjx import BounceBall"],
    "bounce-mjx train --help": ["-m", "bounce_mjx", "train", "--help"],
    "bounce-mjx plot --help": ["-m", "bounce_mjx", "plot", "--help"],
}
# Imported once before, so that Python has their bytecode.
MODULES = (
    "bounce_mjx.commands.train",
    "bounce_mjx.training.job",
    "bounce_mjx.training.ppo_trainer",
    "bounce_mjx.reports.page",
    "jax.experimental.pallas.mosaic_gpu",
    "tensorboardX",
)


class Command(StrictModel):
    """The command line."""

    seeds: tuple[Annotated[int, Field(ge=0)], ...] = (1, 2)
    """Seeds of the runs; each starts cold, then again."""
    repetitions: Annotated[int, Field(ge=1)] = 3
    """Repetitions of each import and each `--help`; the shortest time counts."""
    out: Path = Path("benchmarks/results")
    """Folder for start.json and start.md."""


def quick_seconds(arguments: Sequence[str], repetitions: int) -> float:
    """The shortest time of a Python process, s."""
    seconds = []
    for _ in range(repetitions):
        started = time.perf_counter()
        subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def start_once(seed: int, cache: Path, extra: Sequence[str]) -> dict:
    """One training run to the five results; the times of its phases, s."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        flags = ["--seed", str(seed), "--stop-when-solved", "--log-dir", str(folder / "runs")]
        environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "PYTHONUNBUFFERED": "1",
            "TIMED_TRAIN_EVENTS": str(folder / "events.json"),
        }
        started = time.time()
        process = subprocess.Popen(
            [sys.executable, TIMED, *flags, *extra],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        printed = {}
        lines = []
        with process:
            try:
                for line in process.stdout:
                    printed[line.split(":")[0]] = time.time() - started
                    lines.append(line)
            except BaseException:
                # Otherwise it would go on training in a folder that is deleted.
                process.kill()
                raise
        if process.returncode:
            raise UserError(f"the training with seed {seed} failed: {''.join(lines)[-500:]}")
        total = time.time() - started
        run = next((folder / "runs").iterdir())
        results = json.loads((run / "results.json").read_text(encoding="utf-8"))
        events = json.loads((folder / "events.json").read_text(encoding="utf-8"))
    seconds = results["seconds"]
    solved = results["solved_seconds"]
    imports = printed["time"] - sum(seconds.values())
    return {
        "seed": seed,
        "passed": results["passed"],
        "solved_steps": results["solved_steps"],
        "import": imports,
        **{phase: seconds[phase] for phase in PHASES},
        "results": None if solved is None else imports + solved,
        "total": total,
        "tracing": covered(events, TRACE),
        "lowering": covered(events, LOWER),
        "xla": covered(events, COMPILE),
        "compiled": count(events, REQUEST) - count(events, HIT),
        "read": count(events, HIT),
    }


def covered(events: Sequence[Sequence], name: str) -> float:
    """Time in which at least one event of this name was in progress, s."""
    spans = sorted((end - duration, end) for event, end, duration in events if event == name)
    total = 0.0
    until = 0.0
    for start, end in spans:
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return total


def count(events: Sequence[Sequence], name: str) -> int:
    """Number of events of this name."""
    return sum(event == name for event, *_ in events)


def table(records: Sequence[dict], quick: dict[str, float]) -> str:
    """Two tables: the starts by phase, and the imports."""
    columns = ("import", *PHASES, "results", "total", "tracing", "lowering", "xla")
    rows = [
        [
            str(r["seed"]),
            r["start"],
            "-" if r["solved_steps"] is None else f"{r['solved_steps'] / 1e6:.2f}",
            *["-" if r[column] is None else f"{r[column]:.1f}" for column in columns],
            str(r["compiled"]),
            str(r["read"]),
        ]
        for r in records
    ]
    header = ["seed", "start", "solved, M steps", *[f"{c} s" for c in columns]]
    starts = markdown_table([*header, "programs compiled", "read from the cache"], rows)
    imports = [[name, f"{seconds:.2f}"] for name, seconds in quick.items()]
    return f"{starts}\n\n{markdown_table(['process', 's'], imports)}"


def main() -> None:
    """Runs the command line."""
    with exit_on_user_error():
        args = sys.argv[1:]
        end = args.index("--") if "--" in args else len(args)
        own = args[:end]
        extra = args[end + 1 :]
        description = (__doc__ or "").split("\n")[0]
        command = parse(Command, own, prog="benchmarks/start.py", description=description)
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        subprocess.run([sys.executable, "-c", f"import {', '.join(MODULES)}"], check=True)
        quick = {name: quick_seconds(words, command.repetitions) for name, words in QUICK.items()}
        records = []
        try:
            for seed in command.seeds:
                with tempfile.TemporaryDirectory() as cache:
                    for start in ("cold", "second"):
                        times = {"start": start} | start_once(seed, Path(cache), extra)
                        records.append(times)
                        print(times, flush=True)
        finally:
            # Also where a later start failed.
            if records:
                device = device_name()
                record = {"device": device, "starts": records, "quick": quick}
                text = f"Device: {device}\n\n{table(records, quick)}"
                write(command.out, "start", record, text)


if __name__ == "__main__":
    main()
