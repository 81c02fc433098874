"""The training job: trains until it is finished or stopped, and evaluates and saves in between.

It is the same for every algorithm that has the interface of `PPOTrainer`.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import importlib
import shlex
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

import bounce_mjx
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError, reason_of, shorten
from bounce_mjx.evaluation.results import Report
from bounce_mjx.interrupt import Interrupted, StopRequest
from bounce_mjx.learning.policy import Policy
from bounce_mjx.physics.convergence import solver_warning
from bounce_mjx.runs import checkpoints, folders
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.files import to_json, writable
from bounce_mjx.runs.progress import RESULTS_FILE, Progress
from bounce_mjx.tasks.registry import is_file
from bounce_mjx.training import events, hosts, ppo_trainer
from bounce_mjx.training.evaluators import Evaluators
from bounce_mjx.training.first_block import fault_of
from bounce_mjx.training.log import TensorBoardLog
from bounce_mjx.training.saving import Save, Saver

# Imported by name during the compilation, because these imports take half a second each.
_SLOW_MODULES = "orbax.checkpoint", "bounce_mjx.reports.page"


@dataclasses.dataclass(frozen=True)
class Best:
    """The best policy of a seed."""

    policy: Policy
    report: Report
    steps: int
    number: int | None = None
    """Of its checkpoint, once it is saved."""


@dataclasses.dataclass
class SeedRun:
    """One seed of a training run."""

    run: Path
    """Folder of the seed's best checkpoint and log; with one seed, the run's folder itself."""
    config: TrainConfig
    """The config of this seed, as for a training of one seed."""
    seconds: dict[str, float]
    """Seconds by phase, for all seeds together."""
    progress: Progress = dataclasses.field(default_factory=Progress)
    best: Best | None = None
    saved: Best | None = None
    """The best one of those that were saved."""

    def take_best(self, best: Best | None) -> None:
        """Takes a policy for the best one."""
        self.best = best
        self.progress.best = best and best.report
        self.progress.best_steps = best.steps if best else 0

    def recall_best(self, place: Path | None) -> None:
        """Takes for the best what the best intact checkpoint in a folder of the run says."""
        self.take_best(None)
        with contextlib.suppress(UserError):
            checkpoint = folders.best_checkpoint(self.run, place)
            record = checkpoints.read_record(checkpoint)
            if record.report is not None:
                policy = checkpoints.read_policy(checkpoint, self.config)
                self.saved = Best(policy, record.report, record.steps, checkpoint.steps)
                self.take_best(self.saved)


class TrainingStopped(Interrupted):
    """The user stopped the training; the text says how to continue."""


def train(
    config: TrainConfig,
    console: Console,
    *,
    resume: Path | None = None,
    callbacks: Sequence[events.Callback] = (),
    make_trainer: Callable[[TrainConfig, Env], ppo_trainer.PPOTrainer] = ppo_trainer.PPOTrainer,
    make_evaluators: Callable[..., Evaluators] = Evaluators,
) -> list[SeedRun]:
    """Trains with a config, and returns its seeds.

    Args:
      resume: the run to continue, whose config is `config`: its folder, or a checkpoint in it.
      callbacks: see `Callback`.
      make_trainer: builds the trainer; raises UserError where the config does not fit it.
      make_evaluators: builds what evaluates the policies, with the arguments of `Evaluators`.

    Raises:
      UserError: the run's folder, the model, the devices or the resumed checkpoint are not usable,
        another process trains in the run's folder, the hosts have different configs, a device
        failed, the training diverged, or its final state could not be saved.
      TrainingStopped: SIGINT, SIGTERM or SIGHUP came; the state is saved.
      Interrupted: the signal came before the first block, and there is no run.
    """
    hosts.agree(config, resume)
    with contextlib.ExitStack() as stack:
        job = Job(config, console, resume, callbacks, stack, make_trainer)
        job.open()
        try:
            job.compile(make_evaluators)
            job.train()
            job.finish()
        except jax.errors.JaxRuntimeError as error:
            raise UserError(job.failure(error)) from error
        return job.members


def named_task(config: TrainConfig) -> list[str]:
    """The flag with which a later command has to name a task's file again."""
    return ["--task", config.task] if is_file(config.task) else []


class Job:
    """A training run in progress.

    With several seeds the run's folder has the latest state of all seeds. Each seed has its own
    folder in it, which looks like the folder of a run of one seed. On several hosts every process
    does the same work, but only the leader writes.
    """

    def __init__(
        self,
        config: TrainConfig,
        console: Console,
        resume: Path | None,
        callbacks: Sequence[events.Callback],
        stack: contextlib.ExitStack,
        make_trainer: Callable[[TrainConfig, Env], ppo_trainer.PPOTrainer],
    ):
        """Builds what may refuse the config, before a folder is made."""
        self.console, self.resume, self.stack = console, resume, stack
        self.say = functools.partial(events.say, console)
        self.callbacks = callbacks if hosts.is_leader() else ()
        self.pool = concurrent.futures.ThreadPoolExecutor()
        stack.callback(self.pool.shutdown, wait=False, cancel_futures=True)
        self.seconds, self.lap_started = {}, time.perf_counter()
        self.block_steps = ppo_trainer.iterations_per_block(config) * config.ppo.batch_steps
        blocks = max(1, round(config.total_steps / self.block_steps))
        self.config = config.model_copy(update={"total_steps": blocks * self.block_steps})
        self.eval_steps = self.block_steps * max(1, round(config.eval_every / self.block_steps))
        self.env = Env(config.env)
        self.trainer = make_trainer(config, self.env)
        warm = config.warm_start is not None and resume is None
        self.first = checkpoints.read_start(config, self.env) if warm else None
        self.state: Any = None
        self.steps = 0
        self.ended = False
        self.opening = self.pool.submit(lambda: None)

    def open(self) -> None:
        """Makes the folder of a new run, or reads the resumed one, and says what is trained."""
        # Before, a signal ends the process by its default action.
        self.stop = self.stack.enter_context(StopRequest())
        config = self.config
        if self.resume is None:
            made = str(folders.create_run(config)) if hosts.is_leader() else None
            self.run = Path(hosts.exchange(made)[0])
        else:
            self.run = folders.find_run(self.resume)
        self.saver = Saver(self.run, self.pool, self.say)
        self.stack.push(self._remove_unstarted)
        if hosts.is_leader():
            self.stack.enter_context(folders.lock_run(self.run))
        self.stack.callback(self.saver.wait)
        self.members = []
        for seed in range(config.seed, config.seed + config.num_seeds):
            folder = self.run / f"seed_{seed:03d}" if config.num_seeds > 1 else self.run
            alone = config.model_copy(update={"seed": seed, "num_seeds": 1})
            self.members.append(SeedRun(folder, alone, self.seconds))
        if self.resume is not None:
            self._read_state()
        configs = {self.run: config} | {member.run: member.config for member in self.members}
        for folder, own in configs.items() if hosts.is_leader() else ():
            with writable(folder, "make room there or make it writable"):
                folder.mkdir(exist_ok=True)
                folders.save_config(folder, own)
        mesh = self.trainer.mesh
        count = f"{mesh.size} x " if mesh.size > 1 else ""
        self.device = f"{count}{mesh.devices.flat[0].device_kind}"
        self.say(f"physics: {self.env.engine.name} ({self.env.engine.reason})")
        if self.env.engine.name == "fused":
            warning = solver_warning(self.env.mj_model)
            if warning is not None:
                self.say(f"warning: {warning}")
        for term in config.env.unseen_noise:
            self.say(f"warning: the policy does not see what {term} changes")
        self.say(f"device: {self.device}  run: {self.run}")
        bound = "at most " if config.stop_when_solved else ""
        self.say(f"steps: {bound}{config.total_steps:,}, in blocks of {self.block_steps:,}")
        self._lap("setup")

    def _read_state(self) -> None:
        """Reads the checkpoint from which the resumed run continues."""
        checkpoint = folders.latest_checkpoint(self.run, self.resume)
        self.state, record = checkpoints.read_training(checkpoint, self.trainer.state_template)
        self.steps = record.steps
        # What was trained after a checkpoint that the user named does not count any more.
        newest = max(stored.steps for stored in folders.stored_checkpoints(self.run))
        place = None if checkpoint.steps == newest else checkpoint.folder
        evaluated = record.progress.get("seeds", [record.progress])
        for member, plain in zip(self.members, evaluated, strict=True):
            member.progress = Progress.model_validate(plain)
            member.recall_best(place if member.run == self.run else None)
        if self._is_done() or self._is_solved():
            met = "has met all results" if self._is_solved() else "has been trained to its end"
            self.say(f"{self.run} {met}, {self.steps:,} steps; add --total-steps N to train on")

    def _lap(self, name: str) -> None:
        """Adds the time since the last lap to that of a phase."""
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self.lap_started
        self.lap_started = now

    @property
    def _go_on(self) -> str:
        name = self.config.algorithm
        own = ["--algorithm", name] if is_file(name) else []
        flags = [*named_task(self.config), *own, "--resume", str(self.run)]
        return f"continue with: bounce-mjx train {shlex.join(flags)}"

    def failure(self, error: jax.errors.JaxRuntimeError) -> str:
        """What a device's failure means to the user."""
        reason = shorten(reason_of(error), 200)
        if reason.startswith("RESOURCE_EXHAUSTED"):
            envs = f"{self.config.ppo.num_envs:,} environments"
            return f"{self.device} has too little memory for {envs} ({reason}); lower num_envs"
        fewer = ", with --num-devices 1 if one is left" if self.trainer.mesh.size > 1 else ""
        return f"{self.device} failed after {self.steps:,} steps ({reason}); {self._advice}{fewer}"

    @property
    def _advice(self) -> str:
        """What to do after the death of a device or a save."""
        if latest := self._latest():
            return f"{self._go_on} (the last checkpoint is {latest})"
        return "start again, as no checkpoint had been saved yet"

    def _latest(self) -> Path | None:
        """The newest checkpoint, once the last save has ended."""
        self.saver.wait()
        with contextlib.suppress(UserError):
            return folders.latest_checkpoint(self.run).folder

    def _remove_unstarted(self, error: type[BaseException] | None, *_) -> None:
        """Removes the folder of a new run without a checkpoint or a block."""
        is_new = self.resume is None and self.steps == 0
        if error is not None and is_new and hosts.is_leader() and self._latest() is None:
            # A log that is opened later would make the folder again.
            concurrent.futures.wait([self.opening])
            shutil.rmtree(self.run, ignore_errors=True)

    def compile(self, make_evaluators: Callable[..., Evaluators]) -> None:
        """Compiles the programs that training needs to start. Evaluations are compiled, logs are
        opened, and the libraries that save and draw are imported in the background, also while the
        training already runs."""

        def compile() -> None:
            # The longest program is traced first: Python traces one program at a time while XLA
            # compiles others.
            compiling = self.trainer.compile(self.pool)
            self.evaluators = make_evaluators(self.config, self.env, self.trainer.mesh, self.pool)
            self.opening = self.pool.submit(self._open_logs)
            self.opening.add_done_callback(lambda _: [*map(importlib.import_module, _SLOW_MODULES)])
            compiling.result()

        with self.console.status("compiling"):
            compiling = self.pool.submit(compile)
            if not self.stop.wait_for(compiling):
                raise Interrupted
        compiling.result()
        # A callback may refuse the run.
        self.opening.result()
        self.stack.callback(events.call_all, self.callbacks, "close")
        if jax.process_count() > 1:
            # A process that finds its programs in the cache waits here for a process that compiles
            # them; otherwise the exchange between devices would time out after 30 s.
            self.evaluators.wait()
            hosts.any_of(False)
        self.trainer.start(self.state, self.first)
        self.state = None
        self._lap("compile")

    def _restart_estimate(self) -> None:
        """Estimates the time that is left from what follows: while the first block and the first
        evaluation run, other programs are still compiled."""
        self.started, self.first_step = time.monotonic(), self.steps

    def _open_logs(self) -> None:
        """Opens the log, where it is written, and tells the callbacks of each seed."""
        if hosts.is_leader():
            resumed = None if self.resume is None else self.steps
            self.callbacks = [TensorBoardLog(resumed), *self.callbacks]
        for member in self.members:
            events.call_all(self.callbacks, "start", member.run, member.config)

    def _tell(self, member: SeedRun, metrics: dict[str, float], **evaluation: Any) -> None:
        """Tells the callbacks an `Event` of a seed."""
        event = events.Event(member.run, member.config, self.steps, metrics, **evaluation)
        answers = [callback(event) for callback in self.callbacks]
        self.ended |= any(answer is False for answer in answers)

    def train(self) -> None:
        """Trains until the last step, or until a stop is requested."""
        while not self._stopping():
            if self._is_due() and not self._evaluate():
                break
            if self._is_done() or self._is_solved():
                break
            self._run_block()
            self.ended = hosts.any_of(self.ended)

    def finish(self) -> None:
        """Waits until everything is saved, and evaluates the best policy on fresh resets.

        Raises:
          TrainingStopped: a stop was requested.
        """
        stopping = self._stopping()
        if self.ended and self.steps < self.config.total_steps:
            self.say(f"a callback ended the training after {self.steps:,} steps; {self._go_on}")
        if stopping and not self._is_evaluated():
            if self.resume is None and self.steps == 0:
                jax.distributed.shutdown()
                raise Interrupted
            self._end_save()
            self._save(self.trainer.snapshot(), {})
        self._end_save(is_last=True)
        evaluated = not stopping and self._evaluate_best()
        jax.distributed.shutdown()
        if not evaluated:
            where = "" if stopping else ", before the final evaluation"
            raise TrainingStopped(f"stopped after {self.steps:,} steps{where}; {self._go_on}")

    def _stopping(self) -> bool:
        return hosts.any_of(self.stop.requested)

    def _healthy(self) -> list[SeedRun]:
        return [member for member in self.members if member.progress.fault is None]

    def _is_solved(self) -> bool:
        solved = all(member.progress.solved for member in self._healthy())
        return self.config.stop_when_solved and solved

    def _is_evaluated(self) -> bool:
        return all(member.progress.has(self.steps) for member in self._healthy())

    def _is_done(self) -> bool:
        return self.ended or self.steps >= self.config.total_steps

    def _is_due(self) -> bool:
        done = self._is_done()
        if done and any(member.progress.best is None for member in self._healthy()):
            return True
        # The policy of a warm start is the one to beat.
        trained = self.steps > 0 or self.first is not None
        at_evaluation = done or self.steps % self.eval_steps == 0
        return trained and at_evaluation and not self._is_evaluated()

    def _evaluate(self) -> bool:
        """Evaluates and saves; returns False if a stop was requested meanwhile."""
        is_first = "evaluate" not in self.seconds
        snapshot = self.trainer.snapshot()
        reports = self._wait_for_reports(self.evaluators.select, snapshot.policies)
        if reports is None:
            return False
        each = zip(self.members, reports, snapshot.policies, strict=True)
        evaluated = [one for one in each if one[0].progress.fault is None]
        judged = [report for _, report, _ in evaluated]
        self.say(events.evaluation_line(self.config.num_seeds, self.steps, judged))
        seconds = sum(self.seconds.values())
        self._end_save()
        for member, report, policy in evaluated:
            self._tell(member, events.points_of(report), report=report, policy=policy)
            if member.progress.improves(report, self.steps, seconds):
                member.best = Best(policy, report, self.steps)
        self._save(snapshot, {member.run: report for member, report, _ in evaluated})
        if is_first:
            self._restart_estimate()
        return True

    def _evaluate_best(self) -> bool:
        """Evaluates the best policies on fresh resets, and writes the results; returns False if a
        stop was requested meanwhile."""
        # A seed that diverged before its first evaluation has no best policy; another seed's policy
        # takes its place in the batch.
        best = [member.best and member.best.policy for member in self.members]
        other = next(policy for policy in best if policy is not None)
        reports = self._wait_for_reports(self.evaluators.final, [x or other for x in best])
        if reports is None:
            return False
        for member, report in zip(self.members, reports, strict=True):
            member.progress.best = report if member.best else None
        if hosts.is_leader():
            self.saver.start([], self._results(fresh_resets=True), self.steps)
        self._end_save(is_last=True)
        return True

    def _wait_for_reports(
        self, evaluate: Callable[[list[Policy]], list[Report]], policies: list[Policy]
    ) -> list[Report] | None:
        """Returns a report of each seed, or None if a stop was requested meanwhile."""
        evaluating = self.pool.submit(evaluate, policies)
        # On several hosts, a process that stopped on its own would keep the others waiting.
        if not self.stop.wait_for(evaluating) and jax.process_count() == 1:
            return None
        reports = evaluating.result()
        self._lap("evaluate")
        return reports

    def _run_block(self) -> None:
        started = time.perf_counter()
        block = self.pool.submit(self.trainer.run)
        if not self.stop.wait_for(block):
            self.say("stopping after this block; the same signal again ends it at once")
        metrics = block.result()
        seconds = time.perf_counter() - started
        if self.steps == 0 and (wrong := fault_of(metrics, self.config)) is not None:
            raise UserError(f"these settings cannot be trained: {wrong}")
        faults = metrics.pop("fault")
        self.steps += self.block_steps
        rate = len(faults) * self.block_steps / seconds
        metrics["speed/steps_per_second"] = np.full((len(faults), 1), rate)
        points = events.block_points(metrics)
        if "train" in self.seconds:
            # At the mean speed with the evaluations.
            share = (self.config.total_steps - self.steps) / (self.steps - self.first_step)
            left = share * (time.monotonic() - self.started)
        else:
            self._restart_estimate()
            left = None
        self.say(events.block_line(self.config, self.steps, seconds, left, points))
        if total := int(sum(point["task/non_finite"] for point in points)):
            self.say(f"states that were not finite, whose environments were reset: {total:,}")
        for member, own in zip(self.members, points, strict=True):
            self._tell(member, own)
        self._check_faults(faults)
        self._lap("train")

    def _check_faults(self, faults: np.ndarray) -> None:
        """Ends a run that diverged, because its state is useless; with several seeds, the
        other seeds continue.

        Args:
          faults: the metric "fault" of a block [seeds, I].
        """
        before = self.steps // self.config.ppo.batch_steps - faults.shape[1]
        for member, block_faults in zip(self.members, faults, strict=True):
            if member.progress.fault is not None or not block_faults.any():
                continue
            first = int(np.argmax(block_faults != 0))
            quantity = self.trainer.checked[int(block_faults[first]) - 1]
            where = f"iteration {before + first + 1}"
            member.progress.fault = f"{quantity} became infinite or NaN at {where}"
            if self.config.num_seeds > 1:
                self.say(f"seed {member.config.seed} diverged: {member.progress.fault}")
        if self._healthy():
            return
        raise UserError(
            f"training diverged: {self.members[-1].progress.fault}; the last good checkpoint is "
            f"{self._latest() or 'none'}; lower the learning rate, or change the rewards"
        )

    def _end_save(self, is_last: bool = False) -> None:
        """Waits for the last save. A policy that could not be saved is not the best one.

        Raises:
          UserError: it failed, and no other follows.
        """
        outcome = self.saver.wait()
        if outcome.problem and is_last:
            raise UserError(
                f"{self.run} cannot be written ({outcome.problem}), so the end of the training is "
                f"lost; make room, and {self._advice}"
            )
        self.saver.say(outcome)
        numbers, has_failed = hosts.exchange([outcome.numbers, outcome.problem is not None])[0]
        for member in self.members:
            number = numbers.get(str(member.run))
            if number is not None and member.best is not member.saved:
                member.saved = member.best = dataclasses.replace(member.best, number=number)
            if has_failed:
                member.take_best(member.saved)
        self._lap("save")

    def _save(self, snapshot: ppo_trainer.Snapshot, reports: dict[Path, Report]) -> None:
        """Starts to save the state, and with several seeds the policies that are the best of their
        seed.

        Args:
          reports: evaluations of the policies by the seed's folder.
        """
        if hosts.is_leader():
            # A copy, because the training reuses its buffers meanwhile.
            policies, state, networks = jax.tree.map(np.array, snapshot)
            training, is_alone = {checkpoints.TRAINING: state}, len(self.members) == 1
            saves, records = [], [member.progress.model_dump() for member in self.members]
            for i, member in enumerate(self.members):
                is_best = member.best is not member.saved
                kept = None if is_best or member.saved is None else member.saved.number
                items = training.copy() if is_alone else {}
                items[checkpoints.POLICY] = policies[i]
                items[checkpoints.NETWORKS] = networks and networks[i]
                if is_alone or is_best:
                    where = member.run, member.config, self.steps
                    report = reports.get(member.run)
                    saves.append(Save(*where, items, records[i], report, kept))
            if not is_alone:
                # Last, as it refers to the best policies of the seeds.
                saves.append(Save(self.run, self.config, self.steps, training, {"seeds": records}))
            self.saver.start(saves, self._results(), self.steps)
        self._lap("save")

    def _results(self, fresh_resets: bool = False) -> dict[Path, str]:
        """The content of each seed's results.json; none before its first evaluation."""
        about = {"trained_steps": self.steps, "seconds": self.seconds, "device": self.device}
        about |= {"fresh_resets": fresh_resets, "version": bounce_mjx.__version__}
        return {
            member.run / RESULTS_FILE: to_json(member.progress.results(**about))
            for member in self.members
            if member.progress.best is not None
        }
