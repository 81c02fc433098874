"""The trainers of six libraries on one task: environment steps/s, time and steps to the five
results, return.

    python benchmarks/jax_vs_torch.py                                    # all trainers and seeds
    python benchmarks/jax_vs_torch.py --methods rsl_rl skrl --seeds 0    # some of them
    python benchmarks/jax_vs_torch.py --methods --merge FILES            # existing records only

The trainers are ours, brax's PPO on the fused and on the mjx physics, rsl_rl and skrl, which use
the config's hyperparameters as far as each library has them (`trainers.py`); and FastTD3 and
FlashSAC, which are off-policy, with their authors' own scripts and settings. Each run is a separate
process with an empty compilation cache. All begin with the task's resets, and all but brax, whose
environments return to their first state, sample a new start for each episode. Every `eval_every`
steps, the same evaluation measures the policy without noise, on the same resets and on the config's
physics.

- Training clock: time in the trainer, without evaluations. Ours is compiled before it; the first
  two blocks of another trainer may compile, so each of them counts as at most the median of the
  later blocks. The clock of a run that ends within its first two blocks has the compiling in it.
- From process start: the whole time, including the evaluations, whose program compiles while the
  trainer trains.
- Each evaluation is written to jax_vs_torch.jsonl when it ends, so that an interrupted run keeps
  its evaluations. A new run of a method and seed replaces the earlier one, also where it fails
  before its first evaluation.

Of a preset, only the flags below count: it says neither when a run here ends nor what it saves.
"""

import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import jax
from tables import device_name, markdown_table
from trainers import TRAINERS, Method

from bounce_mjx.commands.doctor import version_of
from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import Count, NonNegativeInt, Positive, StrictModel
from bounce_mjx.env.bounce_ball import BounceBall
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import judge
from bounce_mjx.interrupt import in_daemon_thread
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Actor, make_networks, untrained_policy
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.task.bounce import Config as EnvConfig
from bounce_mjx.training.setup import compiler_options

METHODS: tuple[Method, ...] = typing.get_args(Method)
_NAMES = {
    "ours": "bounce_mjx (JAX)",
    "brax": "brax ppo, fused physics",
    "brax_mjx": "brax ppo, mjx physics",
    "rsl_rl": "rsl_rl (PyTorch)",
    "skrl": "skrl (PyTorch)",
    "fast_td3": "FastTD3 (PyTorch), 1,024 environments",
    "flash_sac": "FlashSAC (PyTorch), 1,024 environments",
}
_STARTED = "BOUNCE_MJX_BENCHMARK_STARTED"
_RECORDS = "jax_vs_torch.jsonl"
_LIBRARIES = ("jax", "jaxlib", "torch", "brax", "rsl-rl-lib", "skrl")
# brax compiles some programs again in its second block.
_COMPILING_BLOCKS = 2

Record = dict[str, Any]


class Command(StrictModel):
    """The command line: the settings that all trainers have, and what to train."""

    env: EnvConfig = EnvConfig()
    ppo: PPOConfig = PPOConfig()
    total_steps: Count = 20_000_000
    """Environment steps of each run."""
    eval_every: Count = 1_000_000
    """Environment steps between two evaluations, rounded to whole iterations."""
    eval_episodes: Count = 1024
    """Episodes of an evaluation."""
    eval_seed: NonNegativeInt = 10_000
    """Seed of the evaluations."""
    config: Path | None = None
    """Preset: a YAML file. The default is the device's preset, configs/default.yaml on a GPU."""
    methods: tuple[Method, ...] = METHODS
    """Trainers to run; give none to show only the existing records."""
    seeds: tuple[NonNegativeInt, ...] = (0, 1, 2)
    """Seeds of the runs."""
    max_seconds: Positive = 570.0
    """Time limit of a training's process, s; after it, the training ends at its next evaluation."""
    stop_at_solved: bool = False
    """End each run at its first evaluation that meets all five results."""
    merge: tuple[Path, ...] = ()
    """Further .jsonl files with records to show; an evaluation in two of them counts once."""
    out: Path = Path("benchmarks/results")
    """Folder for jax_vs_torch.jsonl, .md and .png."""

    def training(self, seed: int) -> TrainConfig:
        """The settings of one run."""
        return TrainConfig(
            env=self.env,
            ppo=self.ppo,
            seed=seed,
            total_steps=self.total_steps,
            eval_every=self.eval_every,
            eval_episodes=self.eval_episodes,
            eval_seed=self.eval_seed,
        )


class _FirstFlag(StrictModel):
    """The flag that decides the config on which the others lie."""

    config: Path | None = None


def main() -> None:
    """Runs the command line."""
    with exit_on_user_error():
        args = sys.argv[1:]
        command = read_command(args)
        command.out.mkdir(parents=True, exist_ok=True)
        failed = []
        for seed in command.seeds:
            for method in command.methods:
                if not train_in_a_process(command, args, method, seed):
                    failed.append(f"{method} with seed {seed}")
        files = [path for path in (*command.merge, command.out / _RECORDS) if path.is_file()]
        records = [json.loads(line) for path in files for line in path.read_text().splitlines()]
        runs = newest_runs(records)
        if runs:
            text = table(runs)
            print(text)
            (command.out / "jax_vs_torch.md").write_text(text + "\n", encoding="utf-8")
            plot(runs, command.out / "jax_vs_torch.png")
        if failed:
            raise UserError(f"failed: {', '.join(failed)}; the lines above say why")
        if not runs:
            raise UserError(f"{command.out / _RECORDS} holds no evaluation yet; name some methods")


def read_command(args: list[str]) -> Command:
    """Reads the command line on top of the preset.

    Raises:
      UserError: a flag is wrong, or the preset is of another task.
    """
    first = parse(_FirstFlag, args, prog="benchmarks/jax_vs_torch.py", is_first=True)
    preset = read_preset(first.config)
    if type(preset.env) is not EnvConfig:
        raise UserError(
            f"--config {first.config} is a preset of the task {preset.task}, and the trainers are "
            "compared on bounce; give one of bounce"
        )
    default = Command(
        env=preset.env,
        ppo=preset.ppo,
        eval_episodes=preset.eval_episodes,
        eval_seed=preset.eval_seed,
    )
    doc = __doc__.split("\n\n")[0]
    return parse(Command, args, prog="benchmarks/jax_vs_torch.py", description=doc, default=default)


def train_in_a_process(command: Command, args: list[str], method: Method, seed: int) -> bool:
    """Trains one method with one seed in a new process, with an empty compilation cache; whether it
    succeeded."""
    started = time.time()
    run = {
        "run": f"{method}-{seed}-{started:.3f}",
        "method": method,
        "seed": seed,
        "versions": versions(),
    }
    with (command.out / _RECORDS).open("a", encoding="utf-8") as file:
        file.write(json.dumps(run) + "\n")
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "TORCHINDUCTOR_CACHE_DIR": f"{cache}/torch",
            # JAX would otherwise reserve most of the memory, and PyTorch needs some of it.
            "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
            _STARTED: repr(started),
        }
        script = Path(__file__).with_name("one_training.py")
        finished = subprocess.run(
            [sys.executable, script, method, str(seed), *args],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    lines = finished.stdout.strip().splitlines()
    if finished.returncode:
        print(f"{method}, seed {seed}: failed: {' / '.join(lines[-6:])}", flush=True)
    else:
        print(lines[-1], flush=True)
    return finished.returncode == 0


def versions() -> dict[str, str]:
    """The versions of the libraries that are installed, and the commits of this checkout and of the
    cloned repositories."""
    found = {}
    for library in _LIBRARIES:
        version = version_of(library)
        if version is not None:
            found[library] = version
    benchmarks = Path(__file__).resolve().parent
    repositories = {"bounce_mjx": benchmarks.parent}
    for clone in (benchmarks / "sources").glob("*"):
        repositories[clone.name] = clone
    for name, folder in repositories.items():
        if (folder / ".git").exists():
            command = ["git", "-C", folder, "describe", "--always", "--dirty", "--abbrev=40"]
            commit = subprocess.run(command, capture_output=True, text=True)
            found[name] = commit.stdout.strip() or "unknown"
    return found


def train_here(command: Command, method: Method, seed: int) -> None:
    """Trains in this process, and writes each evaluation as it ends."""
    config = command.training(seed)
    with (command.out / _RECORDS).open("a", encoding="utf-8") as file:
        TRAINERS[method](config, _Judge(command, config, method, file))


class _Judge:
    """Evaluates the policy after every block and writes a record; an `OnBlock`."""

    def __init__(self, command: Command, config: TrainConfig, method: Method, file: TextIO):
        self._command = command
        self._config = config
        self._method = method
        self._file = file
        self._started = float(os.environ[_STARTED])
        self._env = BounceBall(config.env)
        self._key = jax.random.PRNGKey(config.eval_seed)
        self._device = device_name()

    def prepare(self, actor: Actor | None = None, policy: Any = None) -> None:
        """Starts the compilation of the evaluation."""
        if actor is None:
            actor = make_networks(
                self._config.ppo, self._env.observation_size, self._env.action_size
            )
            key = jax.random.PRNGKey(0)
            size = self._env.observation_size
            policy = jax.eval_shape(lambda: untrained_policy(actor, size, key))
        self._shapes = jax.eval_shape(lambda: policy)
        self._evaluator = in_daemon_thread(lambda: self._compile(actor))

    def _compile(self, actor: Actor) -> Callable[[Any, jax.Array], tuple]:
        evaluate = make_evaluator(self._env, actor, self._config.eval_episodes)
        return evaluate.lower(self._shapes, self._key).compile(compiler_options())

    def __call__(self, steps: int, seconds: float, policy: Any) -> bool:
        config = self._config
        method = self._method
        # The program was compiled for these types.
        policy = jax.tree.map(
            lambda array, shape: jax.numpy.asarray(array, shape.dtype), policy, self._shapes
        )
        evaluate = self._evaluator.result()
        report = judge(self._env, *evaluate(policy, self._key))
        process_seconds = time.time() - self._started
        record = {
            "run": f"{method}-{config.seed}-{self._started:.3f}",
            "method": method,
            "seed": config.seed,
            "device": self._device,
            "num_envs": config.ppo.num_envs,
            "total_steps": config.total_steps,
            "steps": steps,
            "block_seconds": seconds,
            "process_seconds": process_seconds,
            "passed": report.passed,
            "return": report.details["mean_return"],
            "results": {result.name: result.value for result in report.results},
        }
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()
        print(
            f"{method}, seed {config.seed}: {steps:,} steps, {process_seconds:.1f} s from the "
            f"start, return {record['return']:.0f}, {'passed' if report.passed else 'not passed'}",
            flush=True,
        )
        return (
            steps >= config.total_steps
            or process_seconds > self._command.max_seconds
            or (report.passed and self._command.stop_at_solved)
        )


def newest_runs(records: list[Record]) -> dict[tuple[Method, int], list[Record]]:
    """The evaluations of the newest run of each method and seed, in order; each evaluation gets its
    training clock, `train_seconds`. A run that failed before its first evaluation has none, and is
    left out with the earlier ones."""
    newest: dict[tuple[Method, int], str] = {}
    for record in sorted(records, key=lambda record: _start_of(record["run"])):
        newest[record["method"], record["seed"]] = record["run"]
    runs = {}
    for key, name in newest.items():
        # By their steps, as several files may hold the same evaluation.
        evaluations = {
            record["steps"]: dict(record)
            for record in records
            if record["run"] == name and "steps" in record
        }
        if evaluations:
            runs[key] = with_training_clock([evaluations[steps] for steps in sorted(evaluations)])
    return runs


def _start_of(run: str) -> float:
    """When a run started, s since 1970."""
    return float(run.rsplit("-", 1)[1])


def with_training_clock(run: list[Record]) -> list[Record]:
    """A run's evaluations with `train_seconds`, the time of all blocks so far."""
    blocks = [record["block_seconds"] for record in run]
    if len(blocks) > _COMPILING_BLOCKS:
        usual = statistics.median(blocks[_COMPILING_BLOCKS:])
        compiling = [min(seconds, usual) for seconds in blocks[:_COMPILING_BLOCKS]]
        blocks = [*compiling, *blocks[_COMPILING_BLOCKS:]]
    clock = itertools.accumulate(blocks)
    return [record | {"train_seconds": seconds} for record, seconds in zip(run, clock, strict=True)]


def summarize(runs: dict[tuple[Method, int], list[Record]]) -> dict[Method, dict[str, list]]:
    """The figures of each seed by method; None for a figure that a run did not reach."""
    summary: dict[Method, dict[str, list]] = {}
    for method in METHODS:
        of_method = [run for (name, _), run in sorted(runs.items()) if name == method]
        if not of_method:
            continue
        solved = [next((r for r in run if r["passed"]), None) for run in of_method]
        ends = [run[-1] for run in of_method]
        summary[method] = {
            "rate": [end["steps"] / end["train_seconds"] for end in ends],
            "solved_steps": _of_each(solved, "steps"),
            "solved_train": _of_each(solved, "train_seconds"),
            "solved_process": _of_each(solved, "process_seconds"),
            "return": [
                end["return"] if end["steps"] >= end["total_steps"] else None for end in ends
            ],
            "steps": [end["steps"] for end in ends],
        }
    return summary


def _of_each(records: list[Record | None], key: str) -> list[float | None]:
    return [None if record is None else record[key] for record in records]


def table(runs: dict[tuple[Method, int], list[Record]]) -> str:
    """One row for each method: the mean over the seeds, and their range."""
    summary = summarize(runs)
    ours = summary.get("ours", {})
    settings = {
        key: sorted({record[key] for run in runs.values() for record in run})
        for key in ("device", "num_envs", "total_steps")
    }
    devices = " or ".join(settings["device"])
    num_envs = " or ".join(f"{number:,}" for number in settings["num_envs"])
    lengths = " or ".join(f"{steps / 1e6:g}" for steps in settings["total_steps"])
    rows = []
    for method, figures in summary.items():
        solved = [value for value in figures["solved_train"] if value is not None]
        rows.append(
            [
                _NAMES[method],
                f"{_mean(figures['rate']) / 1e6:.3f}",
                f"{len(solved)} of {len(figures['solved_train'])}",
                _spread(figures["solved_steps"], 1e-6),
                _spread(figures["solved_train"]),
                _ratio(figures["solved_train"], ours.get("solved_train")),
                _spread(figures["solved_process"]),
                _ratio(figures["solved_process"], ours.get("solved_process")),
                _spread(figures["return"], form=",.0f"),
                _range(figures["steps"], 1e-6),
            ]
        )
    header = [
        "trainer",
        "M env steps/s",
        "seeds solved",
        "solved, M steps",
        "training clock, s",
        "x ours",
        "from process start, s",
        "x ours",
        f"return after {lengths} M steps",
        "trained, M steps",
    ]
    return (
        f"Device: {devices}, {num_envs} environments. Mean over the seeds that reached the figure "
        f"(minimum to maximum).\n\n{markdown_table(header, rows)}"
    )


def plot(runs: dict[tuple[Method, int], list[Record]], path: Path) -> None:
    """Draws the return over the training clock and over the steps, with a circle at the first
    evaluation that meets all five results."""
    try:
        import matplotlib
    except ImportError as error:
        raise UserError("the plot needs matplotlib; pip install matplotlib") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(12, 4.5), sharey=True, layout="constrained")
    for (method, _), run in sorted(runs.items(), key=lambda item: METHODS.index(item[0][0])):
        color = f"C{METHODS.index(method)}"
        # The legend names a method once.
        is_named = _NAMES[method] in axes[0].get_legend_handles_labels()[1]
        label = None if is_named else _NAMES[method]
        for axis, key, scale in zip(axes, ("train_seconds", "steps"), (1.0, 1e-6), strict=True):
            abscissa = [scale * record[key] for record in run]
            returns = [record["return"] for record in run]
            axis.plot(abscissa, returns, color=color, label=label)
            solved = next((i for i, record in enumerate(run) if record["passed"]), None)
            if solved is not None:
                axis.plot(abscissa[solved], returns[solved], "o", color=color, mec="black")
    axes[0].set(xscale="log", xlabel="training clock, s", ylabel="mean return of an evaluation")
    axes[1].set(xlabel="environment steps, M")
    axes[0].set_title("circle: first evaluation that meets all five results", fontsize="medium")
    for axis in axes:
        axis.grid(alpha=0.3)
    axes[1].legend(loc="lower right", fontsize="small")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _mean(values: list[float | None]) -> float:
    return statistics.mean(value for value in values if value is not None)


def _spread(values: list[float | None], scale: float = 1.0, form: str = ".4g") -> str:
    present = [scale * value for value in values if value is not None]
    if not present:
        return "-"
    return f"{_mean(present):{form}} ({min(present):{form}} to {max(present):{form}})"


def _range(values: list[float], scale: float) -> str:
    ends = [f"{scale * end:.1f}" for end in (min(values), max(values))]
    return " to ".join(dict.fromkeys(ends))


def _ratio(values: list[float | None], ours: list[float | None] | None) -> str:
    if not ours or None in values or None in ours:
        return "-"
    return f"{_mean(values) / _mean(ours):.1f}"


if __name__ == "__main__":
    main()
