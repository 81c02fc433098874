"""The main job: trains a policy, and leaves a run's folder with it (`python train_jax.py`)."""

import concurrent.futures
import contextlib
import dataclasses
import importlib
import os
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import tyro
from rich.console import Console

from bounce_mjx.cli import parse
from bounce_mjx.config import EnvConfig, PPOConfig, TrainConfig, differing_keys, load_config
from bounce_mjx.env import BounceBall
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation import Report, judge, make_recording_evaluator
from bounce_mjx.policy import Policy, make_networks
from bounce_mjx.ppo import CHECKED, Trainer, TrainingState, make_trainer, policy_of
from bounce_mjx.recording import RECORDED_EPISODES
from bounce_mjx.reporting import Reporter, details_line, open_log, results_table
from bounce_mjx.resources import resource_path
from bounce_mjx.runs import (
    RESUMABLE_KEYS,
    Checkpoint,
    CheckpointWriter,
    best_checkpoint,
    create_run,
    find_checkpoint,
    has_checkpoint,
    latest_checkpoint,
    load_progress,
    load_run_config,
    load_training_state,
    save_config,
)
from bounce_mjx.signals import StopRequest

# Time between two attempts to save on a full disk once the training is over.
RETRY_SECONDS = 2.0

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
    """A run's folder to go on with, in place, from its latest checkpoint. The other flags may then
    change only total-steps, eval-every, eval-episodes, screening-episodes, eval-seed,
    stop-when-solved and log-dir, and mjcf where that file has moved."""
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


class TrainingStopped(Exception):
    """The user stopped the training; its text says how to go on."""


def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        args = sys.argv[1:] if args is None else args
        enable_compilation_cache()
        command = read_command(args)
        console = Console()
        try:
            outcome = train(command, console)
        except TrainingStopped as stopped:
            console.print(str(stopped), highlight=False, soft_wrap=True)
            # Without waiting for a compilation or an evaluation that is still going on.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(0)
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
        changed = differing_keys(base, config_of(command)) - RESUMABLE_KEYS
        if changed:
            raise UserError(
                f"--resume cannot change {', '.join(sorted(changed))}; leave those flags out, or "
                "start a new run"
            )
    return command


def config_of(command: TrainCommand) -> TrainConfig:
    """The run's part of a command line."""
    return TrainConfig(**{key: getattr(command, key) for key in TrainConfig.model_fields})


def train(command: TrainCommand, console: Console) -> Outcome:
    """Trains as the command says.

    Raises:
      UserError: the run's folder, the model or the resumed checkpoint is not usable, the training
        diverged, or its end could not be saved.
      TrainingStopped: SIGINT or SIGTERM came; the state is saved.
    """
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(StopRequest())
        pool = concurrent.futures.ThreadPoolExecutor()
        stack.callback(pool.shutdown, wait=False, cancel_futures=True)
        return _train(
            config_of(command), command.resume, command.report, console, stop, pool, stack
        )


def _train(
    config: TrainConfig,
    resume: Path | None,
    report: bool,
    console: Console,
    stop: StopRequest,
    pool: concurrent.futures.Executor,
    stack: contextlib.ExitStack,
) -> Outcome:
    clock = _Clock()
    env = BounceBall(config.env)
    trainer = make_trainer(config.ppo, env, config.env.episode_steps)
    iterations = max(1, round(config.block_steps / config.ppo.batch_steps))
    block_steps = iterations * config.ppo.batch_steps
    eval_steps = block_steps * max(1, round(config.eval_every / block_steps))
    key = jax.random.PRNGKey(config.seed)
    if resume:
        run = find_checkpoint(resume, resume).run
        state, progress = _resume(run, jax.eval_shape(trainer.init, key))
        _write_config(run, config)
    else:
        run, state, progress = create_run(config), None, _Progress()
    go_on = f"go on with: python train_jax.py --resume {shlex.quote(str(run))}"

    console.print(f"physics: {env.engine.name} ({env.engine.reason})", highlight=False)
    device = jax.devices()[0].device_kind
    console.print(f"device: {device}  run: {run}", highlight=False, soft_wrap=True)
    clock.lap("setup")

    with console.status("compiling"):
        first_step = None if state is None else int(state.iteration) * config.ppo.batch_steps
        log = pool.submit(open_log, run, first_step)
        if report:
            log.add_done_callback(lambda _: importlib.import_module(_REPORT_MODULE))
        compiling = pool.submit(compile_programs, config, env, trainer, iterations, pool)
        if not stop.wait_for(compiling):
            if resume:
                raise TrainingStopped(f"stopped before anything was trained; {go_on}")
            shutil.rmtree(run, ignore_errors=True)
            raise TrainingStopped(
                f"stopped before anything was trained, so its folder {run} is removed"
            )
        programs = compiling.result()
        if state is None:
            state = jax.block_until_ready(programs.init(key))
    clock.lap("compile")

    steps = int(state.iteration) * config.ppo.batch_steps
    writer = CheckpointWriter(run, config)
    stack.callback(writer.close)
    reporter = stack.enter_context(Reporter(log.result(), console, config, steps))

    def save(*names: str) -> None:
        plain = progress.to_dict()
        results = None
        if progress.best is not None:
            results = {
                "best_steps": progress.best_steps,
                "solved_steps": progress.solved_steps,
                "trained_steps": steps,
                "seconds": clock.seconds,
                "device": device,
                **progress.best.to_dict(),
                "evaluations": progress.evaluations,
            }
        writer.save(names, steps, policy_of(state), state, plain, results)
        clock.lap("save")

    def is_due() -> bool:
        done = steps >= config.total_steps
        at_evaluation = steps > 0 and (done or steps % eval_steps == 0)
        return (at_evaluation and not progress.has(steps)) or (done and progress.best is None)

    if resume and progress.best_steps == steps > 0 and not has_checkpoint(run, "best", steps):
        # The process was killed after saving the latest and before saving the best.
        save("latest", "best")
    while not stop.requested:
        if is_due():
            evaluating = pool.submit(programs.evaluate, state)
            if not stop.wait_for(evaluating):
                break
            report = evaluating.result()
            clock.lap("evaluate")
            reporter.evaluation(steps, report)
            save("latest", *(["best"] if progress.improves(report, steps) else []))
            if report.passed and config.stop_when_solved:
                break
        if steps >= config.total_steps:
            break
        started = time.perf_counter()
        block = pool.submit(_run_block, programs, state)
        if not stop.wait_for(block):
            reporter.say("stopping after this block; the same signal again ends it at once")
        state, metrics = block.result()
        seconds = time.perf_counter() - started
        faults = metrics.pop("fault")
        steps += block_steps
        metrics["speed/steps_per_second"] = np.array([block_steps / seconds])
        reporter.block(steps, seconds, metrics)
        reporter.saving_problem(writer.problem(wait=False))
        _check_faults(faults, steps // config.ppo.batch_steps - iterations, run, writer)
        clock.lap("train")

    if stop.requested and not progress.has(steps):
        save("latest")
    _wait_until_saved(writer, reporter, stop)
    clock.lap("save")
    if stop.requested:
        raise TrainingStopped(f"stopped after {steps:,} steps; {go_on}")
    return Outcome(run, progress.best, progress.best_steps, progress.solved_steps, clock.seconds)


def _run_block(
    programs: "Programs", state: TrainingState
) -> tuple[TrainingState, dict[str, np.ndarray]]:
    state, metrics = programs.run(state)
    return state, {name: np.asarray(value) for name, value in metrics.items()}


def _check_faults(
    faults: np.ndarray, iterations_before: int, run: Path, writer: CheckpointWriter
) -> None:
    """Ends a training that diverged, whose state is worth nothing any more.

    Args:
      faults: the metric "fault" of a block [I].
    """
    if not faults.any():
        return
    first = int(np.argmax(faults != 0))
    writer.problem()
    try:
        kept = f"the last good checkpoint is {latest_checkpoint(run).folder}"
    except UserError:
        kept = "no checkpoint had been saved yet"
    raise UserError(
        f"the training was stopped as it diverged: {CHECKED[faults[first] - 1]} was the first that "
        f"was not finite, at iteration {iterations_before + first + 1}; {kept}, and a new run may "
        "do with a lower learning rate or other rewards"
    )


def _wait_until_saved(writer: CheckpointWriter, reporter: Reporter, stop: StopRequest) -> None:
    """Keeps the process, and with it the training's state, until the state is on the disk."""
    stopping = stop.requested
    while (problem := writer.problem()) is not None:
        if stop.requested and not stopping:
            raise UserError(f"{problem}, so the end of the training is lost; make room, and resume")
        reporter.saving_problem(problem, "it is kept in memory, and saved as soon as there is room")
        time.sleep(RETRY_SECONDS)
        writer.retry()
    reporter.saving_problem(None)


def _write_config(run: Path, config: TrainConfig) -> None:
    try:
        save_config(run, config)
    except OSError as error:
        raise UserError(
            f"{run} cannot be written ({error.strerror}); make room there or make it writable"
        ) from error


def _resume(run: Path, template: TrainingState) -> tuple[TrainingState, "_Progress"]:
    """The state and the evaluations from which a run goes on."""
    latest = latest_checkpoint(run)
    state, plain = load_training_state(latest, template)
    progress = _Progress.from_dict(plain, latest)
    if progress.best is not None and progress.best_steps == latest.steps:
        return state, progress
    # The best checkpoint itself knows best what it holds: it may be older than the latest one
    # says, or newer, where the process was killed between the two.
    progress.best, progress.best_steps = None, 0
    with contextlib.suppress(UserError):
        best = best_checkpoint(run)
        stored = _Progress.from_dict(load_progress(best), best)
        progress.best, progress.best_steps = stored.best, stored.best_steps
    return state, progress


@dataclasses.dataclass
class _Progress:
    """The evaluations of a run so far."""

    best: Report | None = None
    best_steps: int = 0
    solved_steps: int | None = None
    evaluations: list[dict] = dataclasses.field(default_factory=list)

    @classmethod
    def from_dict(cls, plain: dict[str, Any], checkpoint: Checkpoint) -> "_Progress":
        """That of `to_dict`, as it was stored in a checkpoint.

        Raises:
          UserError: it is something else.
        """
        try:
            best = None if plain["best"] is None else Report.from_dict(plain["best"])
            progress = cls(
                best, int(plain["best_steps"]), plain["solved_steps"], list(plain["evaluations"])
            )
            if best is not None:
                best.score  # noqa: B018
            for evaluation in progress.evaluations:
                int(evaluation["steps"])
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise UserError(
                f"the evaluations in the checkpoint {checkpoint.folder} are not as train_jax.py "
                "writes them; give another checkpoint"
            ) from error
        return progress

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for JSON."""
        best = None if self.best is None else self.best.to_dict()
        return {
            "best": best,
            "best_steps": self.best_steps,
            "solved_steps": self.solved_steps,
            "evaluations": self.evaluations,
        }

    def has(self, steps: int) -> bool:
        """Whether the state after so many steps was evaluated."""
        return any(evaluation["steps"] == steps for evaluation in self.evaluations)

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


if __name__ == "__main__":
    main()
