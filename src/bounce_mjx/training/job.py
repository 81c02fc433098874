"""The main job's work: trains until it is done or stopped, evaluates and saves on the way."""

import concurrent.futures
import contextlib
import dataclasses
import importlib
import shlex
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from rich.console import Console

from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.results import Report
from bounce_mjx.learning.ppo import CHECKED, TrainingState, make_trainer, policy_of, population
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.folders import (
    Checkpoint,
    best_checkpoint,
    create_run,
    find_run,
    has_checkpoint,
    latest_checkpoint,
    save_config,
    seed_folders,
)
from bounce_mjx.runs.progress import Progress
from bounce_mjx.runs.reading import load_training_state, read_record
from bounce_mjx.runs.writing import CheckpointWriter
from bounce_mjx.task.env import BounceBall
from bounce_mjx.training import hosts
from bounce_mjx.training.console import Reporter
from bounce_mjx.training.devices import make_mesh, state_sharding
from bounce_mjx.training.log import open_log
from bounce_mjx.training.programs import compile_programs, initial_shapes, num_iterations
from bounce_mjx.training.signals import StopRequest

if TYPE_CHECKING:
    from tensorboardX import SummaryWriter

# Time between two attempts to save on a full disk once the training is over.
RETRY_SECONDS = 2.0

# Imported by name, beside the compilation, as drawing takes half a second to import; so is orbax.
REPORT_MODULE = "bounce_mjx.training.report"


class Outcome(NamedTuple):
    """What the training of one seed came to."""

    run: Path
    """The run's folder; of several seeds, the seed's."""
    seed: int
    report: Report | None
    """Evaluation of the best checkpoint; None if the training diverged before any."""
    best_steps: int
    """Environment steps at the best checkpoint."""
    solved_steps: int | None
    """Environment steps at the first evaluation that met all five results."""
    fault: str | None
    """What was the first not to be finite, if the training diverged."""
    seconds: dict[str, float]
    """Where the time went, for all seeds together."""


class TrainingStopped(Exception):
    """The user stopped the training; its text says how to go on."""


def train(
    config: TrainConfig, console: Console, *, resume: Path | None = None, report: bool = True
) -> list[Outcome]:
    """Trains as the config says; an outcome of each seed.

    Args:
      resume: the run to go on with, in place.
      report: prepare for drawing the report, beside the compilation.

    Raises:
      UserError: the run's folder, the model, the devices or the resumed checkpoint are not usable,
        the training diverged, or its end could not be saved.
      TrainingStopped: SIGINT or SIGTERM came; the state is saved.
    """
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(StopRequest())
        pool = concurrent.futures.ThreadPoolExecutor()
        stack.callback(pool.shutdown, wait=False, cancel_futures=True)
        job = _Job(config, console, resume, stop, pool, stack)
        job.compile(report)
        job.train()
        job.finish()
        return job.outcomes()


@dataclasses.dataclass
class _Member:
    """One seed of a training."""

    run: Path
    """Where its best checkpoint and its log go; with one seed, the run's folder itself."""
    config: TrainConfig
    """As if it were trained alone."""
    progress: Progress
    fault: str | None = None
    """What was the first not to be finite, once it diverged."""


class _Job:
    """A training in progress.

    With several seeds the run's folder has the latest state of all, and each seed has a folder of
    its own in it, which is like that of a run of one seed. On several hosts every process does the
    same, but the leader alone writes.
    """

    def __init__(
        self,
        config: TrainConfig,
        console: Console,
        resume: Path | None,
        stop: StopRequest,
        pool: concurrent.futures.Executor,
        stack: contextlib.ExitStack,
    ):
        self.config, self.console, self.resumed = config, console, resume is not None
        self.stop, self.pool, self.stack = stop, pool, stack
        self.clock = Clock()
        self.env = BounceBall(config.env)
        self.mesh = make_mesh(config.num_devices, config.ppo, config.num_seeds)
        # What is wrong with the config must be said before a folder is made.
        trainer = make_trainer(config.ppo, self.env, config.env.episode_steps)
        self.trainer = trainer if config.num_seeds == 1 else population(trainer)
        self.block_steps = num_iterations(config) * config.ppo.batch_steps
        self.eval_steps = self.block_steps * max(1, round(config.eval_every / self.block_steps))
        self.state: TrainingState | None = None
        self.steps = 0
        if resume is None:
            self._create()
        else:
            self._resume(resume)
        self.go_on = f"go on with: python train_jax.py --resume {shlex.quote(str(self.run))}"
        self.device = self.mesh.devices.flat[0].device_kind
        if self.mesh.size > 1:
            self.device = f"{self.mesh.size} x {self.device}"
        console.print(
            f"physics: {self.env.engine.name} ({self.env.engine.reason})", highlight=False
        )
        for warning in self.env.engine.warnings:
            console.print(f"warning: {warning}", highlight=False, markup=False)
        console.print(f"device: {self.device}  run: {self.run}", highlight=False, soft_wrap=True)
        self.clock.lap("setup")

    def _create(self) -> None:
        run = str(create_run(self.config)) if hosts.is_leader() else None
        self.run = Path(hosts.text_from_leader(run))
        self.members = [
            _Member(folder, config, Progress()) for folder, config in self._folders_of_seeds()
        ]
        if self.config.num_seeds > 1 and hosts.is_leader():
            for member in self.members:
                member.run.mkdir()
                _write_config(member.run, member.config)

    def _folders_of_seeds(self) -> list[tuple[Path, TrainConfig]]:
        if self.config.num_seeds == 1:
            return [(self.run, self.config)]
        seeds = range(self.config.seed, self.config.seed + self.config.num_seeds)
        alone = [self.config.model_copy(update={"seed": s, "num_seeds": 1}) for s in seeds]
        return list(zip(seed_folders(self.run, seeds), alone, strict=True))

    def _resume(self, path: Path) -> None:
        self.run = find_run(path)
        shapes = initial_shapes(self.config, self.trainer)
        latest = latest_checkpoint(self.run)
        state, plain = load_training_state(latest, shapes)
        self.state = hosts.distribute(
            state, state_sharding(self.mesh, shapes, self.config.num_seeds)
        )
        self.steps = latest.steps
        of_seeds = [plain] if self.config.num_seeds == 1 else plain["seeds"]
        self.members = [
            _Member(folder, config, _resumed_progress(folder, one, latest))
            for (folder, config), one in zip(self._folders_of_seeds(), of_seeds, strict=True)
        ]
        if hosts.is_leader():
            _write_config(self.run, self.config)

    def compile(self, report: bool) -> None:
        """Compiles the programs, and starts what is written while they run."""
        with self.console.status("compiling"):
            first_step = self.steps if self.resumed else None
            opening: concurrent.futures.Future | None = None

            def open_logs() -> None:
                nonlocal opening
                opening = self.pool.submit(self._open_logs, first_step)
                self.pool.submit(importlib.import_module, "orbax.checkpoint")
                if report:
                    opening.add_done_callback(lambda _: importlib.import_module(REPORT_MODULE))

            compiling = self.pool.submit(
                compile_programs,
                self.config,
                self.env,
                self.trainer,
                self.mesh,
                self.pool,
                open_logs,
            )
            if not self.stop.wait_for(compiling):
                if self.resumed:
                    raise TrainingStopped(f"stopped before anything was trained; {self.go_on}")
                if hosts.is_leader():
                    shutil.rmtree(self.run, ignore_errors=True)
                raise TrainingStopped(
                    f"stopped before anything was trained, so its folder {self.run} is removed"
                )
            self.programs = compiling.result()
            if self.state is None:
                self.state = jax.block_until_ready(self.programs.init())
        self.writers: list[CheckpointWriter] = []
        if hosts.is_leader():
            of_members = [(member.run, member.config) for member in self.members]
            several = self.config.num_seeds > 1
            self.writers = [
                CheckpointWriter(*of)
                for of in ([(self.run, self.config)] if several else []) + of_members
            ]
        for writer in self.writers:
            self.stack.callback(writer.close)
        self.reporter = self.stack.enter_context(
            Reporter(opening.result(), self.console, self.config, self.steps)
        )
        self.clock.lap("compile")

    def _open_logs(self, first_step: int | None) -> list["SummaryWriter"]:
        if not hosts.is_leader():
            return []
        return [open_log(m.run, first_step, config=m.config) for m in self.members]

    def train(self) -> None:
        """Trains until all is done, or a stop is requested."""
        for i, member in enumerate(self.members):
            missing = member.progress.best_steps == self.steps > 0 and not has_checkpoint(
                member.run, "best", self.steps
            )
            if self.resumed and missing:
                # The process was killed after saving the latest and before saving the best.
                self._save(best=[i])
        while not self._stopping():
            if self._is_due():
                if not self._evaluate():
                    break
                if self.config.stop_when_solved and self._all_solved():
                    break
            if self.steps >= self.config.total_steps:
                break
            self._run_block()

    def finish(self) -> None:
        """Waits until all is saved.

        Raises:
          TrainingStopped: a stop was requested.
        """
        stopping = self._stopping()
        if stopping and not self._evaluated():
            self._save(best=[])
        _wait_until_saved(self.writers, self.reporter, self.stop)
        self.clock.lap("save")
        if stopping:
            raise TrainingStopped(f"stopped after {self.steps:,} steps; {self.go_on}")

    def outcomes(self) -> list[Outcome]:
        """What became of each seed."""
        return [
            Outcome(
                m.run,
                m.config.seed,
                m.progress.best,
                m.progress.best_steps,
                m.progress.solved_steps,
                m.fault,
                self.clock.seconds,
            )
            for m in self.members
        ]

    def _stopping(self) -> bool:
        return hosts.any_of(self.stop.requested)

    def _healthy(self) -> list[_Member]:
        return [member for member in self.members if member.fault is None]

    def _all_solved(self) -> bool:
        return all(member.progress.solved_steps is not None for member in self._healthy())

    def _evaluated(self) -> bool:
        return all(member.progress.has(self.steps) for member in self._healthy())

    def _is_due(self) -> bool:
        done = self.steps >= self.config.total_steps
        at_evaluation = self.steps > 0 and (done or self.steps % self.eval_steps == 0)
        nothing = any(member.progress.best is None for member in self._healthy())
        return (at_evaluation and not self._evaluated()) or (done and nothing)

    def _evaluate(self) -> bool:
        """Evaluates and saves; False if a stop was requested meanwhile."""
        evaluating = self.pool.submit(self.programs.evaluate, self.state)
        # On several hosts a process that went its own way would keep the others waiting.
        if not self.stop.wait_for(evaluating) and jax.process_count() == 1:
            return False
        reports = evaluating.result()
        self.clock.lap("evaluate")
        healthy = [member.fault is None for member in self.members]
        self.reporter.evaluation(self.steps, reports, healthy)
        best = [
            i
            for i, (member, report) in enumerate(zip(self.members, reports, strict=True))
            if member.fault is None and member.progress.improves(report, self.steps)
        ]
        self._save(best)
        return True

    def _run_block(self) -> None:
        started = time.perf_counter()
        block = self.pool.submit(self.programs.run, self.state)
        if not self.stop.wait_for(block):
            self.reporter.say("stopping after this block; the same signal again ends it at once")
        self.state, metrics = block.result()
        seconds = time.perf_counter() - started
        faults = metrics.pop("fault")
        self.steps += self.block_steps
        rate = self.block_steps * self.config.num_seeds / seconds
        metrics["speed/steps_per_second"] = np.full((self.config.num_seeds, 1), rate)
        self.reporter.block(self.steps, seconds, metrics)
        problems = [writer.problem(wait=False) for writer in self.writers]
        self.reporter.saving_problem(next(filter(None, problems), None))
        self._check_faults(faults)
        self.clock.lap("train")

    def _check_faults(self, faults: np.ndarray) -> None:
        """Ends a training that diverged, as its state is worth nothing any more; of several seeds,
        the others go on.

        Args:
          faults: the metric "fault" of a block [seeds, I].
        """
        before = (self.steps - self.block_steps) // self.config.ppo.batch_steps
        for member, of_block in zip(self.members, faults, strict=True):
            if member.fault is not None or not of_block.any():
                continue
            first = int(np.argmax(of_block != 0))
            member.fault = (
                f"{CHECKED[of_block[first] - 1]} was the first that was not finite, at iteration "
                f"{before + first + 1}"
            )
            if self.config.num_seeds > 1:
                self.reporter.say(f"seed {member.config.seed} diverged: {member.fault}")
        if self._healthy():
            return
        for writer in self.writers:
            writer.problem()
        try:
            kept = f"the last good checkpoint is {latest_checkpoint(self.run).folder}"
        except UserError:
            kept = "no checkpoint had been saved yet"
        raise UserError(
            f"the training was stopped as it diverged: {self.members[-1].fault}; {kept}, and a new "
            "run may do with a lower learning rate or other rewards"
        )

    def _save(self, best: list[int]) -> None:
        """Starts to save the latest state, and that of the seeds in `best` as their best."""
        state = hosts.gather(self.state)
        if not hosts.is_leader():
            return
        results = [
            member.progress.results(self.steps, self.clock.seconds, self.device)
            for member in self.members
        ]
        plain = [member.progress.model_dump() for member in self.members]
        if self.config.num_seeds == 1:
            names = ("latest", "best") if best else ("latest",)
            self.writers[0].save(names, self.steps, policy_of(state), state, plain[0], results[0])
        else:
            seeds = {"seeds": plain}
            self.writers[0].save(("latest",), self.steps, policy_of(state), state, seeds, None)
            for i, writer in enumerate(self.writers[1:]):
                names = ("best",) if i in best else ()
                one = jax.tree.map(lambda x, i=i: x[i], state)
                writer.save(names, self.steps, policy_of(one), one, plain[i], results[i])
        self.clock.lap("save")


def _wait_until_saved(
    writers: Sequence[CheckpointWriter], reporter: Reporter, stop: StopRequest
) -> None:
    """Keeps the process, and with it the training's state, until the state is on the disk."""
    stopping = stop.requested
    for writer in writers:
        while (problem := writer.problem()) is not None:
            if stop.requested and not stopping:
                raise UserError(
                    f"{problem}, so the end of the training is lost; make room, and resume"
                )
            reporter.saving_problem(
                problem, "it is kept in memory, and saved as soon as there is room"
            )
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


def _resumed_progress(run: Path, plain: dict[str, Any], latest: Checkpoint) -> Progress:
    """The evaluations from which a seed goes on."""
    progress = Progress.from_dict(plain, latest.folder)
    if progress.best is not None and progress.best_steps == latest.steps:
        return progress
    # The best checkpoint itself knows best what it holds: it may be older than the latest one
    # says, or newer, where the process was killed between the two.
    progress.best, progress.best_steps = None, 0
    with contextlib.suppress(UserError):
        best = best_checkpoint(run)
        stored = Progress.from_dict(read_record(best).progress, best.folder)
        progress.best, progress.best_steps = stored.best, stored.best_steps
    return progress


class Clock:
    """Adds up the time between laps by name."""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now
