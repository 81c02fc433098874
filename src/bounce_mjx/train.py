"""The main job: trains a policy, and leaves a run's folder with it (`python train_jax.py`)."""

import concurrent.futures
import dataclasses
import importlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import numpy as np
import tyro
from rich.console import Console

from bounce_mjx.cli import parse
from bounce_mjx.config import EnvConfig, PPOConfig, TrainConfig, load_config
from bounce_mjx.env import BounceBall
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation import Report, judge, make_recording_evaluator
from bounce_mjx.policy import Policy, make_networks
from bounce_mjx.ppo import Trainer, TrainingState, make_trainer, policy_of
from bounce_mjx.recording import RECORDED_EPISODES
from bounce_mjx.reporting import Reporter, details_line, open_log, results_table
from bounce_mjx.resources import resource_path
from bounce_mjx.runs import (
    CheckpointWriter,
    create_run,
    find_checkpoint,
    latest_checkpoint,
    load_results,
    load_run_config,
    load_training_state,
    save_config,
    save_results,
)

# What a resumed run may change: everything else shapes the state that it goes on from.
RESUMABLE_KEYS = frozenset(
    {
        "total_steps",
        "eval_every",
        "eval_episodes",
        "screening_episodes",
        "eval_seed",
        "stop_when_solved",
        "log_dir",
    }
)

# Imported by name, beside the compilation, as drawing takes half a second to import.
_REPORT_MODULE = "bounce_mjx.report"


class TrainCommand(TrainConfig):
    """The command line: the config's keys as flags, and where to start from."""

    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = EnvConfig()
    ppo: Annotated[PPOConfig, tyro.conf.arg(name="")] = PPOConfig()
    config: Path | None = None
    """Preset: a YAML file such as configs/seed.yaml. Left out: configs/default.yaml where there is
    an accelerator, else configs/cpu.yaml."""
    resume: Path | None = None
    """A run's folder to go on with, in place; the flags may change only how long it goes on and
    how it is evaluated."""
    report: bool = True
    """Leave report.html in the run's folder, drawn when the results are printed."""


class Outcome(NamedTuple):
    """What a training came to."""

    run: Path
    """The run's folder."""
    report: Report
    """Evaluation of the best checkpoint."""
    best_steps: int
    """Environment steps at the best checkpoint."""
    solved_steps: int | None
    """Environment steps at the first evaluation that met all five results."""
    seconds: dict[str, float]
    """Where the time went."""


def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        args = sys.argv[1:] if args is None else args
        enable_compilation_cache()
        command = read_command(args)
        console = Console()
        outcome = train(command, console)
        console.print(
            results_table(outcome.report, f"best checkpoint, {outcome.best_steps:,} steps")
        )
        console.print(details_line(outcome.report), highlight=False)
        spent = ", ".join(f"{name} {value:.1f} s" for name, value in outcome.seconds.items())
        console.print(f"time: {spent}", highlight=False)
        console.print(
            f"run: {outcome.run}  (python -m bounce_mjx.eval {outcome.run})",
            highlight=False,
            soft_wrap=True,
        )
        if command.report:
            leave_report(outcome, console)


def leave_report(outcome: Outcome, console: Console) -> None:
    """Draws the report. The training is safe by now, so whatever fails is only told."""
    started = time.perf_counter()
    try:
        report_module = importlib.import_module(_REPORT_MODULE)
        page = report_module.report_training(outcome.run, outcome.report, outcome.best_steps)
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        again = f"python -m {_REPORT_MODULE} {outcome.run}"
        text = f"report: not drawn ({reason}); {again} draws it"
    else:
        text = f"report: {page}  ({time.perf_counter() - started:.1f} s)"
    console.print(text, highlight=False, soft_wrap=True)


def enable_compilation_cache() -> None:
    """Keeps compiled programs in the user's cache folder, so that a second start is quick.
    `JAX_COMPILATION_CACHE_DIR` chooses another folder."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(caches / "bounce_mjx" / "jax"))


def read_command(args: Sequence[str]) -> TrainCommand:
    """Reads the command line on top of the preset, or of the resumed run's config.

    Raises:
      UserError: a flag or the preset is wrong, or a resumed run is to change what it may not.
    """
    config_path, resume = _path_flag(args, "--config"), _path_flag(args, "--resume")
    if config_path and resume:
        raise UserError("--config and --resume exclude each other; a resumed run has its config")
    if resume:
        base = load_run_config(find_checkpoint(resume, resume).run)
    elif config_path:
        base = load_config(config_path)
    else:
        preset = "cpu" if jax.default_backend() == "cpu" else "default"
        base = load_config(resource_path(f"configs/{preset}.yaml"))
    command = parse(
        TrainCommand,
        args,
        prog="train_jax.py",
        description="Trains a policy that keeps the ball bouncing.",
        default=TrainCommand(**dict(base), config=config_path, resume=resume),
    )
    if resume:
        changed = [
            key
            for key in TrainConfig.model_fields
            if key not in RESUMABLE_KEYS and getattr(command, key) != getattr(base, key)
        ]
        if changed:
            raise UserError(
                f"--resume cannot change {', '.join(_differing_keys(base, command, changed))}; "
                "leave those flags out, or start a new run"
            )
    return command


def train(command: TrainCommand, console: Console) -> Outcome:
    """Trains as the command says.

    Raises:
      UserError: the run's folder, the model or the resumed checkpoint is not usable.
    """
    clock = _Clock()
    config = TrainConfig(**{key: getattr(command, key) for key in TrainConfig.model_fields})
    env = BounceBall(config.env)
    trainer = make_trainer(config.ppo, env, config.env.episode_steps)
    iterations = max(1, round(config.block_steps / config.ppo.batch_steps))
    block_steps = iterations * config.ppo.batch_steps
    blocks_per_eval = max(1, round(config.eval_every / block_steps))
    key = jax.random.PRNGKey(config.seed)
    if command.resume:
        run = find_checkpoint(command.resume, command.resume).run
        progress = _Progress.of_run(run)
        template = jax.eval_shape(trainer.init, key)
        resumed = load_training_state(latest_checkpoint(run), template)
        save_config(run, config)
    else:
        run, progress, resumed = create_run(config), _Progress(), None

    console.print(f"physics: {env.engine.name} ({env.engine.reason})", highlight=False)
    device = jax.devices()[0].device_kind
    console.print(f"device: {device}  run: {run}", highlight=False, soft_wrap=True)
    clock.lap("setup")

    pool = concurrent.futures.ThreadPoolExecutor()
    with console.status("compiling"):
        log = pool.submit(open_log, run)
        if command.report:
            log.add_done_callback(lambda _: importlib.import_module(_REPORT_MODULE))
        programs = compile_programs(config, env, trainer, iterations, pool)
        state = jax.block_until_ready(programs.init(key) if resumed is None else resumed)
    pool.shutdown(wait=False)
    clock.lap("compile")

    steps = int(state.iteration) * config.ppo.batch_steps
    writer = CheckpointWriter(run)
    with Reporter(log.result(), console, config, steps) as reporter:

        def evaluate() -> Report:
            report = programs.evaluate(state)
            clock.lap("evaluate")
            reporter.evaluation(steps, report)
            writer.save("latest", steps, state)
            if progress.improves(report, steps):
                writer.save("best", steps, state)
            clock.lap("save")
            return report

        if progress.best is None and steps >= config.total_steps:
            evaluate()
        blocks = 0
        while steps < config.total_steps:
            started = time.perf_counter()
            state, metrics = programs.run(state)
            metrics = {name: np.asarray(value) for name, value in metrics.items()}
            seconds = time.perf_counter() - started
            steps += block_steps
            blocks += 1
            metrics["speed/steps_per_second"] = np.array([block_steps / seconds])
            reporter.block(steps, seconds, metrics)
            clock.lap("train")
            if blocks % blocks_per_eval == 0 or steps >= config.total_steps:
                report = evaluate()
                if report.passed and config.stop_when_solved:
                    break
    writer.close()
    clock.lap("save")

    outcome = Outcome(run, progress.best, progress.best_steps, progress.solved_steps, clock.seconds)
    save_results(
        run,
        {
            "best_steps": outcome.best_steps,
            "solved_steps": outcome.solved_steps,
            "trained_steps": steps,
            "seconds": outcome.seconds,
            "device": device,
            **outcome.report.to_dict(),
            "evaluations": progress.evaluations,
        },
    )
    return outcome


@dataclasses.dataclass
class _Progress:
    """The evaluations of a run so far."""

    best: Report | None = None
    best_steps: int = 0
    solved_steps: int | None = None
    evaluations: list[dict] = dataclasses.field(default_factory=list)

    @classmethod
    def of_run(cls, run: Path) -> "_Progress":
        """That of a run which is resumed."""
        results = load_results(run)
        if results is None:
            return cls()
        return cls(
            Report.from_dict(results),
            results["best_steps"],
            results["solved_steps"],
            results["evaluations"],
        )

    def improves(self, report: Report, steps: int) -> bool:
        """Takes a new evaluation in, and tells whether it is the best."""
        values = {result.name: result.value for result in report.results}
        self.evaluations.append({"steps": steps, "passed": report.passed, **values})
        if report.passed and self.solved_steps is None:
            self.solved_steps = steps
        if self.best is not None and report.score < self.best.score:
            return False
        self.best, self.best_steps = report, steps
        return True


class Programs(NamedTuple):
    """The compiled programs of a training."""

    init: Callable[[jax.Array], TrainingState]
    run: Callable[[TrainingState], tuple[TrainingState, dict[str, jax.Array]]]
    evaluate: Callable[[TrainingState], Report]


def compile_programs(
    config: TrainConfig,
    env: BounceBall,
    trainer: Trainer,
    iterations: int,
    pool: concurrent.futures.Executor,
) -> Programs:
    """Compiles the programs side by side, as each takes seconds; returns once the training can
    start."""
    key = jax.random.PRNGKey(config.seed)
    init = jax.jit(trainer.init)
    state = jax.eval_shape(init, key)
    policy = jax.eval_shape(policy_of, state)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    run = jax.jit(trainer.run, static_argnums=1, donate_argnums=0)

    def compile_evaluator(episodes: int):
        evaluator = make_recording_evaluator(env, networks, episodes, RECORDED_EPISODES)
        return evaluator.lower(policy, key).compile()

    compiled_run = pool.submit(lambda: run.lower(state, iterations).compile())
    compiled_init = pool.submit(lambda: init.lower(key).compile())
    evaluator = pool.submit(compile_evaluator, config.eval_episodes)
    screening = (
        pool.submit(compile_evaluator, config.screening_episodes)
        if config.screening_episodes
        else None
    )
    eval_key, screening_key = jax.random.split(jax.random.PRNGKey(config.eval_seed))

    def measure(program: concurrent.futures.Future, policy: Policy, key: jax.Array) -> Report:
        statistics, recording = program.result()(policy, key)
        return judge(env, statistics)._replace(recording=recording)

    def evaluate(state: TrainingState) -> Report:
        policy = policy_of(state)
        if screening is not None:
            screened = measure(screening, policy, screening_key)
            if not screened.passed:
                return screened
        return measure(evaluator, policy, eval_key)

    return Programs(compiled_init.result(), compiled_run.result(), evaluate)


class _Clock:
    """Adds up the time between laps by name."""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now


def _path_flag(args: Sequence[str], flag: str) -> Path | None:
    """The value of a flag that decides the defaults of all others, so must be read before them."""
    for i, word in enumerate(args):
        if word == flag and i + 1 < len(args):
            return Path(args[i + 1])
        if word.startswith(f"{flag}="):
            return Path(word.removeprefix(f"{flag}="))
    return None


def _differing_keys(base: TrainConfig, command: TrainConfig, keys: Sequence[str]) -> list[str]:
    """Dotted names of the settings that differ."""
    names = []
    for key in keys:
        old, new = getattr(base, key), getattr(command, key)
        fields = getattr(type(old), "model_fields", None)
        if fields is None:
            names.append(key)
        else:
            inner = [name for name in fields if getattr(old, name) != getattr(new, name)]
            names += [f"{key}.{name}" for name in _differing_keys(old, new, inner)]
    return names


if __name__ == "__main__":
    main()
