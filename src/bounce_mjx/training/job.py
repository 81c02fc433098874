"""The training job: `train` is its loop, and `Job` has what the loop does.

It is the same for every algorithm whose trainer is a `Trainer`.

A training stops, ends or fails. It stops (`must_stop`) by a signal, or by an exception in a
callback: what is new is saved, and the run can be resumed. It ends (`ends_here`) by its steps, by a
callback that returns False, or by its results: then the best policy is evaluated, too. It fails
with an error, such as where every seed has diverged (`mark_diverged`).

From the first signal to its checkpoint:

1. `StopRequest` notes the signal.
2. The block goes on to its end (`train_block`).
3. An evaluation that is due is left out. On several hosts it is done, as a process that stopped
   alone would keep the others waiting.
4. `must_stop` ends the loop.
5. `finish` saves the state, waits until it is written, and raises `TrainingStopped` with the
   command that resumes the run.

A later Ctrl-C or SIGTERM does what it did before the training: in a command, it ends the process at
once (`StopRequest`). What was saved before it stays.

An exception in a callback takes the way of a first signal, and is raised at its end; the callback
is called no more.

| the first signal comes | what a command does (`open_job` enters `StopRequest`) | exit status |
|---|---|---|
| before the run's folder is made | ends at once, by the signal's default action | of the signal |
| before there is anything to save | raises `Interrupted`; a new folder is removed | 130 |
| later | saves what is new, raises `TrainingStopped` | 0 |
| while the report is drawn | leaves it out, raises `TrainingStopped` (`run.leave_report`) | 0 |

In a resumed run, "later" begins once it is compiled, also where nothing is new yet. It lasts
through the last save, until the callbacks are closed (`train`).
"""

import concurrent.futures
import contextlib
import dataclasses
import importlib
import shlex
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from rich.console import Console

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.results import Report
from bounce_mjx.interrupt import Interrupted, StopRequest
from bounce_mjx.learning.policy import Policy
from bounce_mjx.learning.ppo import PPO
from bounce_mjx.learning.registry import find_algorithm
from bounce_mjx.physics.convergence import solver_warning
from bounce_mjx.resources import VERSION
from bounce_mjx.runs import checkpoints, creation, folders
from bounce_mjx.runs.config import TrainConfig, import_flags_of_run
from bounce_mjx.runs.progress import PATIENCE, Progress, all_may_end
from bounce_mjx.runs.storage import lock_run, writable
from bounce_mjx.training import events, faults, hosts
from bounce_mjx.training.clock import Clock
from bounce_mjx.training.evaluators import Evaluators
from bounce_mjx.training.log import TensorBoardLog
from bounce_mjx.training.ppo_trainer import PPOTrainer
from bounce_mjx.training.saving import Saver
from bounce_mjx.training.seeds import SeedRun
from bounce_mjx.training.trainer import BlockMetrics, Snapshot, Trainer

Result = TypeVar("Result")
MakeEvaluators = Callable[..., Evaluators]

# Imported during the compilation, because these imports take half a second each.
_SLOW_MODULES = "orbax.checkpoint", "bounce_mjx.reports.page"


class TrainingStopped(Interrupted):
    """The user stopped the training, or the report that follows it; the text says how to go on."""


def train(
    config: TrainConfig,
    console: Console,
    *,
    resume: Path | None = None,
    callbacks: Sequence[events.Callback] = (),
    make_evaluators: MakeEvaluators = Evaluators,
) -> list[SeedRun]:
    """Trains with a config, and returns its seeds.

    Args:
      resume: the run to continue, whose config is `config`: its folder, or a checkpoint in it.
      callbacks: see `Callback`.
      make_evaluators: builds what evaluates the policies, with the arguments of `Evaluators`.

    Raises:
      UserError: the run's folder, the model, the devices or the resumed checkpoint are not usable,
        another process trains in the run's folder, the hosts have different configs, a device
        failed, the training diverged, or its final state could not be saved.
      TrainingStopped: SIGINT, SIGTERM or SIGHUP came; the state is saved.
      Interrupted: the signal came before there was anything to save: in a new run, before the first
        block or the evaluation of the policy of a warm start; in a resumed one, during the
        compilation. A new run's folder is removed, and a command exits with 130.
    """
    hosts.check_equal_configs(config, resume)
    with contextlib.ExitStack() as stack:
        job = open_job(config, console, stack, resume, callbacks)
        try:
            job.compile(make_evaluators)
            while True:
                if job.evaluation_is_due():
                    job.evaluate()
                if job.save_is_due():
                    job.save()
                if job.must_stop() or job.ends_here():
                    break
                metrics, seconds = job.train_block()
                job.tell_block(metrics, seconds)
                job.mark_diverged(metrics["fault"])
            job.finish()
        except jax.errors.JaxRuntimeError as error:
            raise UserError(job.describe_failure(error)) from error
    # One may have come while the callbacks were closed. No process waits for another any more.
    if job.stop.requested:
        raise job.stopped(job.at_the_end)
    return job.seeds


def open_job(
    config: TrainConfig,
    console: Console,
    stack: contextlib.ExitStack,
    resume: Path | None = None,
    callbacks: Sequence[events.Callback] = (),
) -> "Job":
    """Builds what may refuse the config, then makes the folder of a new run, or reads the resumed
    one, and says what is trained.

    Args:
      stack: closes what the job has opened.
    """
    pool = concurrent.futures.ThreadPoolExecutor()
    stack.callback(pool.shutdown, wait=False, cancel_futures=True)
    clock = Clock()
    total_steps = config.in_whole_blocks(config.total_steps)
    config = config.model_copy(update={"total_steps": total_steps})
    env = Env(config.env)
    trainer = trainer_of(config, env)
    is_warm = config.warm_start is not None and resume is None
    networks = checkpoints.read_warm_start(config, env) if is_warm else None
    # Until here, a signal does what it does without a training: in a command, it ends the process.
    stop = stack.enter_context(StopRequest())
    run = _make_run(config) if resume is None else folders.run_of(resume)
    job = Job(
        config=config,
        env=env,
        trainer=trainer,
        run=run,
        is_new=resume is None,
        networks=networks,
        console=console,
        callbacks=list(callbacks) if hosts.is_leader() else [],
        pool=pool,
        stack=stack,
        stop=stop,
        clock=clock,
    )
    stack.push(job.remove_unstarted)
    if hosts.is_leader():
        stack.enter_context(lock_run(run))
    stack.callback(job.saver.wait)
    if resume is not None:
        job.read_state(resume)
    job.write_configs()
    job.introduce()
    return job


def trainer_of(config: TrainConfig, env: Env) -> Trainer:
    """What trains with the algorithm of a config: what its `make_trainer` returns, or `PPOTrainer`
    where that is None: only `PPO` and its subclasses may, as `learning` may not import `training`.

    Raises:
      UserError: the config does not fit it, or another algorithm has returned None.
    """
    algorithm = find_algorithm(config.algorithm)
    own_trainer = algorithm.make_trainer(config, env)
    if own_trainer is not None:
        return own_trainer
    if not issubclass(algorithm, PPO):
        raise UserError(
            f"make_trainer of the algorithm {algorithm.__name__} has returned None; return a "
            "bounce_mjx.training.trainer.Trainer, or extend PPO"
        )
    return PPOTrainer(config, env)


@dataclasses.dataclass
class Job:
    """A training run in progress.

    With several seeds the run's folder has the latest state of all seeds. Each seed has its own
    folder in it, which looks like the folder of a run of one seed. On several hosts every process
    does the same work, but only the leader writes.
    """

    config: TrainConfig
    env: Env
    trainer: Trainer
    run: Path
    """The run's folder."""
    is_new: bool
    """Whether the run is not resumed."""
    networks: Any
    """Parameters of both networks of a warm start and the statistics of their inputs, as from
    `checkpoints.read_warm_start`; None without one."""
    console: Console
    callbacks: list[Any]
    pool: concurrent.futures.Executor
    stack: contextlib.ExitStack
    stop: StopRequest
    clock: Clock

    steps: int = 0
    """Environment steps of each seed so far."""
    needs_save: bool = False
    """Whether there is something new since the last save was started."""
    ended_by_callback: bool = False
    """Whether a callback has ended the training: it returned False."""
    failure: BaseException | None = None
    """What a callback raised, which stops the training, as a signal does."""
    failed_callbacks: list[events.Callback] = dataclasses.field(default_factory=list)
    """Those that raised."""
    state: Any = None
    """State from which the resumed run starts."""
    snapshot: Snapshot | None = None
    """The current state, once it was asked for; the next block drops it."""
    seeds: list[SeedRun] = dataclasses.field(init=False)
    saver: Saver = dataclasses.field(init=False)
    evaluators: Evaluators = dataclasses.field(init=False)
    """Set by `compile`."""

    def __post_init__(self) -> None:
        config = self.config
        rounded_steps = config.rounded_steps
        self.steps_per_block = config.steps_per_block
        self.eval_steps = rounded_steps["eval_every"]
        self.save_steps = rounded_steps.get("save_every")
        self.seeds = []
        for number in range(config.seed, config.seed + config.num_seeds):
            folder = self.run / f"seed_{number:03d}" if config.num_seeds > 1 else self.run
            alone = config.model_copy(update={"seed": number, "num_seeds": 1})
            self.seeds.append(SeedRun(folder, alone, self.clock.seconds))
        self.saver = Saver(self.run, config, self.seeds, self.pool, self.say)

    # Opening

    def read_state(self, resume: Path) -> None:
        """Reads the checkpoint from which the resumed run continues.

        Its state has all that a block needs: networks, optimizer, environments and random keys. So
        the training goes on bit for bit, on as many devices and with the same compiled programs.

        Args:
          resume: the run's folder, or a checkpoint in it.
        """
        checkpoint = folders.latest_checkpoint(self.run, resume)
        self.state, record = checkpoints.read_training(checkpoint, self.trainer.state_template)
        self.steps = record.steps
        evaluated = record.progress.get("seeds", [record.progress])
        for seed, plain in zip(self.seeds, evaluated, strict=True):
            seed.recall(Progress.model_validate(plain))
            # With one seed, what was trained after a checkpoint that the user named does not count
            # any more, and the next save removes it. A seed's own folder has its best policy alone.
            seed.recall_best(newest=checkpoint if seed.run == self.run else None)
        numbers = [stored.number for stored in folders.stored_checkpoints(self.run)]
        self.saver.recall(number for number in numbers if number <= checkpoint.number)
        # Every process has read what the leader renames.
        hosts.wait_for_all()
        self.set_damaged_aside()
        if self.ends_here():
            met = "has met all results" if self.ends_by_results() else "has been trained to its end"
            self.say(f"{self.run} {met}, {self.steps:,} steps; add --total-steps N to train on")

    def set_damaged_aside(self) -> None:
        """Puts the damaged checkpoints of the run and of its seeds where no save removes them."""
        if hosts.is_leader():
            for folder in self.configs_by_folder():
                for aside in folders.set_damaged_aside(folder):
                    self.say(f"the damaged checkpoint is kept as {aside}")

    def write_configs(self) -> None:
        """Makes the folders of the seeds, and writes the config of each, and of a resumed run,
        whose length may have changed."""
        if not hosts.is_leader():
            return
        configs = self.configs_by_folder()
        if self.is_new:
            # `create_run` has written it.
            del configs[self.run]
        for folder, config in configs.items():
            with writable(folder, "make room there or make it writable"):
                folder.mkdir(exist_ok=True)
                creation.save_config(folder, config)

    def introduce(self) -> None:
        """Says what is trained, where, and for how long."""
        self.say(f"physics: {self.env.engine.name} ({self.env.engine.reason})")
        if self.env.engine.name == "fused":
            warning = solver_warning(self.env.mj_model)
            if warning is not None:
                self.say(f"warning: {warning}")
        for term in self.config.env.unseen_noise:
            self.say(f"warning: the policy does not see what {term} changes")
        self.say(f"device: {self.device}  run: {self.run}")
        bound = "at most " if self.config.stop_when_solved else ""
        steps = f"{self.config.total_steps:,}, in blocks of {self.steps_per_block:,}"
        intervals = f"evaluated and saved every {self.eval_steps:,}"
        if self.save_steps is not None:
            intervals += f", saved every {self.save_steps:,} too"
        self.say(f"steps: {bound}{steps}; {intervals}")
        self.clock.lap("setup")

    def compile(self, make_evaluators: MakeEvaluators) -> None:
        """Compiles the programs that training needs, opens the log, and starts the trainer from the
        resumed state or the networks of a warm start. Evaluations are compiled, and the libraries
        that save and draw are imported, in the background, also while the training already runs."""

        def trace() -> tuple[Evaluators, concurrent.futures.Future]:
            # The longest program is traced first: Python traces one program at a time while XLA
            # compiles others.
            compiling = self.trainer.compile(self.pool)
            evaluators = make_evaluators(self.config, self.env, self.trainer.mesh, self.pool)
            return evaluators, compiling

        # A console that is no terminal shows no status.
        self.say("compiling: the first time, about a minute on a CPU")
        with self.console.status("compiling"):
            self.evaluators, compiling = self.wait_for(self.pool.submit(trace))
            self.open_logs()
            self.pool.submit(_import_slow_modules)
            self.wait_for(compiling)
        if jax.process_count() > 1:
            # A process that finds its programs in the cache waits here for a process that compiles
            # them; otherwise the exchange between devices would time out after 30 s.
            self.evaluators.wait()
            hosts.wait_for_all()
        self.trainer.start(self.state, self.networks)
        self.state = None
        self.clock.lap("compile")

    def open_logs(self) -> None:
        """Opens the log, where it is written, and tells the callbacks of each seed, which may
        refuse the run."""
        if hosts.is_leader():
            # The last one, so that it has the metrics that other callbacks add.
            self.callbacks.append(TensorBoardLog(None if self.is_new else self.steps))
        self.stack.callback(events.call_all, self.callbacks, "close")
        for seed in self.seeds:
            events.call_all(self.callbacks, "start", seed.run, seed.config)

    # The loop

    def evaluation_is_due(self) -> bool:
        """Whether the current policies are to be evaluated."""
        # A finished run that is resumed with a damaged best checkpoint is evaluated again; one that
        # goes on finds another best policy.
        if self.ends_here() and any(seed.best is None for seed in self.healthy()):
            return True
        # The policy of a warm start is the one to beat.
        is_worth_it = self.steps > 0 or self.networks is not None
        is_last = self.ends_by_steps() or self.ended_by_callback
        is_at_evaluation = is_last or self.steps % self.eval_steps == 0
        return is_worth_it and is_at_evaluation and not self.is_evaluated()

    def evaluate(self) -> None:
        """Evaluates the current policies, unless the training is stopping."""
        is_first = "evaluate" not in self.clock.seconds
        policies = self.take_snapshot().policies
        progresses = [seed.progress for seed in self.seeds]
        reports = self.wait_for_reports(self.evaluators.select, policies, progresses)
        if reports is None:
            return
        seconds = sum(self.clock.seconds.values())
        # Before the reports are added, as a save that has failed sets back the best policy.
        self.saver.collect()
        self.clock.lap("save")
        told = []
        for seed, report, policy in zip(self.seeds, reports, policies, strict=True):
            if seed.progress.fault is None:
                told.append(self.event(seed, events.points_of(report), report, policy))
                seed.add_report(report, policy, self.steps, seconds)
        judged = [event.report for event in told]
        self.say(events.evaluation_line(self.config, self.steps, judged))
        self.tell(told)
        self.needs_save = True
        # With the callbacks, such as a video.
        self.clock.lap("evaluate")
        if is_first:
            # Until now, programs were compiled beside the training.
            self.clock.restart_estimate(self.steps)

    def save_is_due(self) -> bool:
        """Whether the current state is to be saved: after each evaluation, and where `save_every`
        asks for it."""
        is_asked_for = self.save_steps is not None and self.steps % self.save_steps == 0
        return self.needs_save and (is_asked_for or self.is_evaluated())

    def save(self) -> None:
        """Starts to save the state, and with several seeds the policies that are the best of their
        seed."""
        self.saver.collect()
        self.saver.start(self.take_snapshot(), self.steps, self.about())
        self.needs_save = False
        self.clock.lap("save")

    def must_stop(self) -> bool:
        """Whether a signal has come to any process, or a callback has failed. On several hosts the
        processes agree on it (`hosts.any_of`), so that every one must call this at the same
        point."""
        return hosts.any_of(self.stop.requested or self.failure is not None)

    def ends_here(self) -> bool:
        """Whether the training ends here: by its steps, by a callback, or by its results. All hosts
        know it without a further exchange: they have the same steps and reports, and learn from
        `tell` what a callback answers, and from `Saver.collect` which evaluations are saved."""
        return self.ends_by_steps() or self.ended_by_callback or self.ends_by_results()

    def train_block(self) -> tuple[BlockMetrics, float]:
        """Trains for a block of I iterations; its metrics, each [S, I], and its duration, s.

        Raises:
          UserError: nothing can be learned from the first block.
        """
        self.snapshot = None
        started = time.perf_counter()
        block = self.pool.submit(self.trainer.train_block)
        if not self.stop.wait_for(block):
            self.say("stopping after this block; Ctrl-C or SIGTERM ends the training at once")
        metrics = block.result()
        seconds = time.perf_counter() - started
        if self.steps == 0 and (wrong := faults.why_unlearnable(metrics, self.config)):
            raise UserError(f"these settings cannot be trained: {wrong}")
        self.steps += self.steps_per_block
        self.needs_save = True
        for seed in self.seeds:
            seed.report = None
        return metrics, seconds

    def tell_block(self, metrics: BlockMetrics, seconds: float) -> None:
        """Says a block, and tells the callbacks, such as the log, of which one may end the
        training."""
        rate = len(self.seeds) * self.steps_per_block / seconds
        shown = {name: values for name, values in metrics.items() if name != "fault"}
        shown["speed/steps_per_second"] = np.full((len(self.seeds), 1), rate)
        points = events.block_points(shown)
        is_first = "train" not in self.clock.seconds
        left = None if is_first else self.clock.left(self.steps, self.config.total_steps)
        if is_first:
            # Other programs were compiled meanwhile.
            self.clock.restart_estimate(self.steps)
        self.say(events.block_line(self.config, self.steps, seconds, left, points))
        if total := int(sum(point["task/non_finite"] for point in points)):
            self.say(f"states that were not finite, whose environments were reset: {total:,}")
        pairs = zip(self.seeds, points, strict=True)
        self.tell([self.event(seed, seed_points) for seed, seed_points in pairs])
        # With the callbacks.
        self.clock.lap("train")

    def finish(self) -> None:
        """Saves what is new, waits until it is written, and evaluates the best policy on fresh
        resets.

        Raises:
          TrainingStopped: a stop was requested.
          Interrupted: it was requested before there was anything to save.
          UserError: the state could not be saved.
          BaseException: what a callback raised.
        """
        stops_early = self.must_stop()
        # The policy of a warm start is saved once it is evaluated.
        has_nothing = self.is_new and self.steps == 0 and not self.is_evaluated()
        if stops_early and has_nothing:
            jax.distributed.shutdown()
            raise self.failure or Interrupted
        if not stops_early:
            self.say(self.why_it_ends())
        if self.needs_save:
            self.save()
        self.end_save("the end of the training is lost")
        where = ""
        if not stops_early:
            is_measured = self.evaluate_best()
            where = self.at_the_end if is_measured else ", before the final evaluation"
        # A signal may have come during the last save, too.
        stops_late = self.must_stop()
        # Every process waits here for the others; after this, none needs another.
        jax.distributed.shutdown()
        if self.failure is not None:
            self.say(f"a callback failed after {self.steps:,} steps; {self.continuing}")
            raise self.failure
        if stops_late:
            raise self.stopped(where)

    def evaluate_best(self) -> bool:
        """Evaluates the best policies on fresh resets, and writes the results; returns False if a
        stop was requested meanwhile."""
        # A seed that diverged before its first evaluation has no best policy; another seed's policy
        # takes its place in the batch.
        other = next(seed.best.policy for seed in self.healthy())
        policies = [seed.best.policy if seed.best else other for seed in self.seeds]
        reports = self.wait_for_reports(self.evaluators.final, policies)
        if reports is None:
            return False
        for seed, report in zip(self.seeds, reports, strict=True):
            # For results.json and what is printed; the checkpoint has the report that chose it.
            seed.progress.best = report if seed.best else None
        self.saver.start(None, self.steps, self.about(fresh_resets=True))
        self.end_save("the final results are not saved")
        return True

    def end_save(self, loss: str) -> None:
        """Waits for the save, whose failure ends the training with a sentence.

        Args:
          loss: what is lost if it failed.

        Raises:
          UserError: it failed.
        """
        problem = self.saver.collect(is_last=True)
        self.clock.lap("save")
        if problem:
            raise UserError(
                f"{self.run} cannot be written ({problem}), so {loss}; make room, and {self.advice}"
            ) from self.failure

    # What is known of the training

    @property
    def device(self) -> str:
        """Name and number of the devices."""
        mesh = self.trainer.mesh
        count = f"{mesh.size} x " if mesh.size > 1 else ""
        return f"{count}{mesh.devices.flat[0].device_kind}"

    def configs_by_folder(self) -> dict[Path, TrainConfig]:
        """The config of the run and, with several seeds, of each, by its folder."""
        return {self.run: self.config} | {seed.run: seed.config for seed in self.seeds}

    def healthy(self) -> list[SeedRun]:
        """The seeds that have not diverged."""
        return [seed for seed in self.seeds if seed.progress.fault is None]

    def ends_by_steps(self) -> bool:
        """Whether the last step is reached (`total_steps`)."""
        return self.steps >= self.config.total_steps

    def ends_by_results(self) -> bool:
        """Whether the results end the training (`stop_when_solved`)."""
        may_end = all_may_end([seed.progress for seed in self.seeds])
        return self.config.stop_when_solved and may_end

    def why_it_ends(self) -> str:
        """Why the training ends here, in words."""
        if self.ended_by_callback and not self.ends_by_steps():
            return f"a callback ended the training after {self.steps:,} steps; {self.continuing}"
        if not self.ends_by_results():
            return f"the training ends after its {self.steps:,} steps (total_steps)"
        if all(seed.progress.margin_steps is not None for seed in self.healthy()):
            return "the training ends: all results are met with a margin (stop_when_solved)"
        return (
            "the training ends: all results are met, and it went on to "
            f"{PATIENCE:g} times the steps of the first time, but they were not met clearly "
            "(with a margin; stop_when_solved)"
        )

    def is_evaluated(self) -> bool:
        """Whether the current policies are evaluated."""
        return all(seed.progress.has(self.steps) for seed in self.healthy())

    def take_snapshot(self) -> Snapshot:
        """The current state, in every process."""
        if self.snapshot is None:
            self.snapshot = self.trainer.snapshot()
        return self.snapshot

    def about(self, fresh_resets: bool = False) -> dict[str, Any]:
        """What the results say of the training, see `Results`."""
        return {
            "trained_steps": self.steps,
            "seconds": self.clock.seconds,
            "device": self.device,
            "fresh_resets": fresh_resets,
            "version": VERSION,
        }

    # Telling

    def say(self, line: str) -> None:
        """Prints a line."""
        events.say(self.console, line)

    def event(
        self,
        seed: SeedRun,
        metrics: dict[str, float],
        report: Report | None = None,
        policy: Policy | None = None,
    ) -> events.Event:
        """What the callbacks are told of a seed at the present step."""
        return events.Event(seed.run, seed.config, self.steps, metrics, report, policy)

    def tell(self, told: Sequence[events.Event]) -> None:
        """Tells the callbacks the events of the seeds. On several hosts, every process learns
        whether a callback has ended the training."""
        for event in told:
            for callback in self.callbacks:
                if any(callback is failed for failed in self.failed_callbacks):
                    continue
                try:
                    answer = callback(event)
                # Raised once the other processes know of it (`must_stop`), and the state is saved.
                except BaseException as failure:  # noqa: BLE001
                    self.failure = self.failure or failure
                    self.failed_callbacks.append(callback)
                    continue
                # A comparison of NumPy's numbers has its own False.
                if isinstance(answer, bool | np.bool_) and not answer:
                    self.ended_by_callback = True
        self.ended_by_callback = hosts.any_of(self.ended_by_callback)

    def stopped(self, where: str) -> TrainingStopped:
        """What is raised where a signal has stopped the training.

        Args:
          where: at which point, as a part of the sentence.
        """
        return TrainingStopped(
            f"stopped after {self.steps:,} steps{where}; {self.continuing}{self.report_so_far}"
        )

    @property
    def at_the_end(self) -> str:
        """Where a signal has stopped a training whose results are written (`stopped`)."""
        return f", at the end of the training; the results are in {self.run}"

    @property
    def continuing(self) -> str:
        """The sentence that continues the run."""
        words = shlex.join([str(self.run), *import_flags_of_run(self.run, to_train=True)])
        return f"continue with: bounce-mjx train {words}"

    @property
    def report_so_far(self) -> str:
        """How to draw the report of a training that is stopped; empty before an evaluation."""
        evaluated = [seed for seed in self.seeds if seed.progress.best is not None]
        if not evaluated:
            return ""
        best = max(evaluated, key=lambda seed: seed.progress.best.score)
        words = shlex.join([str(best.run), *import_flags_of_run(best.run)])
        return f" (its report so far: bounce-mjx report {words})"

    # Signals and faults

    def wait_for(self, future: "concurrent.futures.Future[Result]") -> Result:
        """The result of what is computed before the first block.

        Raises:
          Interrupted: a stop was requested meanwhile. Several hosts do not agree on it here: this
            process ends, and JAX then aborts the others (`hosts.join`).
        """
        if not self.stop.wait_for(future):
            raise Interrupted
        return future.result()

    def wait_for_reports(
        self, evaluate: Callable[..., list[Report]], *given: Any
    ) -> list[Report] | None:
        """What an evaluation reports of each seed, or None if a signal has come or comes meanwhile,
        or a callback has failed.

        Args:
          evaluate: the evaluation.
          given: its arguments.
        """
        # On several hosts, a process that stopped on its own would keep the others waiting.
        may_leave = jax.process_count() == 1
        if may_leave and (self.stop.requested or self.failure is not None):
            return None
        evaluating = self.pool.submit(evaluate, *given)
        if not self.stop.wait_for(evaluating) and may_leave:
            return None
        reports = evaluating.result()
        self.clock.lap("evaluate")
        return reports

    def mark_diverged(self, block_faults: np.ndarray) -> None:
        """Marks the seeds that diverged in the last block; the others continue.

        Args:
          block_faults: the metric "fault" of the last block [S, I].

        Raises:
          UserError: every seed has diverged.
        """
        iterations = block_faults.shape[1]
        first = self.steps // self.config.ppo.batch_steps - iterations + 1
        diverged = faults.mark_diverged(self.seeds, block_faults, self.trainer.checked, first)
        for seed in diverged:
            if len(self.seeds) > 1:
                self.say(f"seed {seed.config.seed} diverged: {seed.progress.fault}")
        if diverged:
            # Without these seeds, the results of the others may end the training (`ends_here`), and
            # those that a failed save has set back no longer count.
            self.saver.collect()
        if not self.healthy():
            raise UserError(
                f"training diverged: {self.seeds[-1].progress.fault}; the last good checkpoint is "
                f"{self.latest() or 'none'}; lower the learning rate, or change the rewards"
            )

    def describe_failure(self, error: jax.errors.JaxRuntimeError) -> str:
        """What the failure of a device means to the user."""
        is_one = self.trainer.mesh.size == 1
        fewer = "" if is_one else ", with --num-devices 1 if one is left"
        advice = f"{self.advice}{fewer}"
        return faults.describe_failure(error, self.device, self.config, self.steps, advice)

    @property
    def advice(self) -> str:
        """What to do after the death of a device or a save."""
        if latest := self.latest():
            return f"{self.continuing} (the last checkpoint is {latest})"
        return "start again, as no checkpoint had been saved yet"

    def latest(self) -> Path | None:
        """The newest checkpoint, once the last save has ended."""
        self.saver.wait()
        with contextlib.suppress(UserError):
            return folders.latest_checkpoint(self.run).folder

    def remove_unstarted(self, error: type[BaseException] | None, *_) -> None:
        """Removes the folder of a new run that has neither a checkpoint nor a block."""
        is_unstarted = self.is_new and self.steps == 0
        if error is not None and is_unstarted and hosts.is_leader() and self.latest() is None:
            shutil.rmtree(self.run, ignore_errors=True)


def _make_run(config: TrainConfig) -> Path:
    """The folder of a new run, which the leader makes."""
    made = str(creation.create_run(config)) if hosts.is_leader() else None
    return Path(hosts.exchange(made)[0])


def _import_slow_modules() -> None:
    for name in _SLOW_MODULES:
        importlib.import_module(name)
