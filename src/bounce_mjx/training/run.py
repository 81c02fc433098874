"""`train`, and the run that it leaves.

`train` in Python and `bounce-mjx train` read their settings, and call `run_training`: it says what
the config means, prints the results, and calls `job.train`, the loop that trains.
"""

import dataclasses
import functools
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from bounce_mjx.config.command_line import stdout
from bounce_mjx.config.validation import validate
from bounce_mjx.deploy.environments import environment
from bounce_mjx.deploy.interface import check_interface, interface_of
from bounce_mjx.deploy.wrappers import environments_in, for_any_arrays
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError, reason_of, shorten
from bounce_mjx.evaluation.config import EvaluationOptions
from bounce_mjx.evaluation.policy_evaluation import evaluate_policy
from bounce_mjx.evaluation.results import Report
from bounce_mjx.interrupt import StopRequest, in_daemon_thread
from bounce_mjx.reports.tables import (
    details_line,
    print_table,
    results_table,
    seeds_table,
    unsolved_line,
)
from bounce_mjx.resources import POLICIES, policy_path
from bounce_mjx.runs import folders
from bounce_mjx.runs.checkpoints import read_actor, read_record
from bounce_mjx.runs.config import TrainConfig, import_flags_of_run, load_run_config
from bounce_mjx.runs.layers import FLAGS, PYTHON, Layers, layers_on
from bounce_mjx.runs.progress import load_results
from bounce_mjx.runs.start import FileFlags, StartFlags, find_start
from bounce_mjx.task.registry import task_name
from bounce_mjx.task.task import Task
from bounce_mjx.training import hosts, job
from bounce_mjx.training.events import Callback, say
from bounce_mjx.training.setup import set_up_jax


@dataclasses.dataclass(frozen=True)
class Run:
    """A run's folder, read when it is asked for. With several seeds, its policy and results are
    those of the best one."""

    folder: Path
    """The folder; a checkpoint in it, in place of the best one; or the name of a policy that comes
    with the package, such as robust."""

    def __post_init__(self):
        object.__setattr__(self, "folder", policy_path(self.folder))

    @property
    def _name(self) -> str:
        """What a user calls it: a policy by its name, a run by its folder."""
        for policy in POLICIES:
            if policy_path(policy) == self.folder:
                return policy
        return str(self.folder)

    @property
    def config(self) -> TrainConfig:
        """The run's config."""
        return load_run_config(folders.run_of(self.folder))

    @property
    def seeds(self) -> tuple["Run", ...]:
        """The run of each seed; with one seed, this run."""
        return tuple(Run(seed) for seed in folders.runs_of_seeds(self.folder))

    @property
    def checkpoint(self) -> folders.Checkpoint:
        """The best checkpoint."""
        return folders.find_checkpoint(self.folder)

    @property
    def results(self) -> Report | None:
        """The results of the best checkpoint; None before the first evaluation. Those of another
        checkpoint are of the evaluation after which it was saved, if there was one."""
        checkpoint = self.checkpoint
        if checkpoint != folders.best_checkpoint(checkpoint.run):
            return read_record(checkpoint).report
        found = load_results(checkpoint.run)
        return None if found is None else found.best

    @property
    def curves(self) -> dict[str, Any]:
        """The learning curves by name, such as "episode/return": each has `steps` and `values`."""
        from bounce_mjx.reports.curves import read_curves

        return read_curves(self.checkpoint.run).curves

    @property
    def policy(self) -> Callable[[jax.Array], jax.Array]:
        """The best checkpoint's policy: the most likely actions [..., A] of observations [..., N].
        It can be compiled and differentiated."""
        return _read_policy(self.checkpoint)

    def env(self, world: str | Path | None = None, **settings: Any) -> Env:
        """The environment of the policy, by default in the nominal world.

        Args:
          world: nominal (the default), training for the worlds that the training sampled, or a
            named world.
          settings: fields of the task's config, such as episode_seconds=30, on top of it.

        Raises:
          UserError: a setting is wrong, or the policy relies on another value of it.
        """
        return environment(world=world, policy=self.folder, **settings)

    def policy_in(self, env: Any) -> Callable[[Any], Any]:
        """The best checkpoint's policy in an environment of any library: the most likely actions
        [..., A] of its observations [..., N], as arrays of the same library.

        Args:
          env: of Gymnasium, Stable-Baselines3, PyTorch, brax, gymnax or Playground, or an `Env`.

        Raises:
          UserError: the environment has another task, arm, action, control step or observation than
            that of the policy's training, is in another process, or is in a wrapper that is not
            known to leave these as they are (`deploy/wrappers.py`).
        """
        name = self._name
        config = self.config.env
        advice = f"make the environment with policy={name!r}, or take Run({name!r}).env()"
        for found in environments_in(env):
            check_interface(interface_of(config), interface_of(found.config), name, advice)
        return for_any_arrays(jax.jit(self.policy), config.layout.size)

    def evaluate(self, **options: Any) -> Report:
        """Measures the results of the best checkpoint, as `bounce-mjx eval` does.

        Args:
          options: fields of `EvaluationOptions`, such as episodes=64, or goals={"target_height":
            0.5}.

        Raises:
          UserError: the engine does not support the model.
        """
        _, arrays, actor = read_actor(self.checkpoint, self.config)
        options = EvaluationOptions(**options)
        return evaluate_policy(arrays, self.config.env, actor, options).report


# A program may ask for the policy in each of its steps.
@functools.lru_cache(maxsize=16)
def _read_policy(checkpoint: folders.Checkpoint) -> Callable[[jax.Array], jax.Array]:
    config = load_run_config(checkpoint.run)
    _, arrays, actor = read_actor(checkpoint, config)
    return functools.partial(actor(Env(config.env)).act, arrays)


def train(
    start: str | Path | type[Task] | None = None,
    config: str | Path | Sequence[str | Path] | TrainConfig = (),
    *,
    robot: str | Path | None = None,
    world: str | Path | None = None,
    warm_start: str | Path | None = None,
    callbacks: Sequence[Callback] = (),
    report: bool = False,
    quiet: bool = False,
    **settings: Any,
) -> Run:
    """Trains a policy, and returns its run; `bounce-mjx train` from Python.

        run = train("bounce", "cpu", num_envs=512, seed=1, reward={"height": {"weight": 2.0}})
        print(run.results.summary)

    In the main thread, a first Ctrl-C saves the state and raises `TrainingStopped`, a
    KeyboardInterrupt; before there is anything to save, it raises `Interrupted`, another one.
    Compiled programs are kept in the user's cache folder. On a CPU, JAX starts with an option that
    halves compilation; MJX needs a process of its own then.

    Args:
      start: the first word of the command: the name or the class of a task; a policy of the
        package, from whose networks and environment the training starts; or a run's folder or a
        checkpoint in it, to continue in place, of which only the length, the evaluations and the
        saves may change (`runs.config.RESUMABLE_KEYS`).
      config: name of a preset or a YAML file, or several, each of which lies on those before it; by
        default, the preset for this machine. Or a whole config, which stands alone.
      robot: name or file of a robot's config.
      world: name or file of a world.
      warm_start: run, or policy of the package, from whose networks and environment the training
        starts.
      callbacks: functions that are called with an `Event` for each block and each evaluation; the
        training ends once one returns False.
      report: whether to write report.html into the run's folder.
      quiet: whether to print nothing.
      settings: keys of the config, such as seed=1. Those of `env` and `ppo` need no prefix, and
        nested ones are mappings.

    Raises:
      UserError: a setting is wrong; or as `job.train`.
      TrainingStopped: the user stopped the training, or the report.
    """
    for name in ("task", "resume"):
        if name in settings:
            raise UserError(f"{name} is the first argument: train({str(settings[name])!r}, ...)")
    if isinstance(start, TrainConfig):
        raise UserError("the first argument is a config; give it by name: train(config=...)")
    if isinstance(config, Mapping):
        raise UserError("config is a mapping; give its keys as arguments: train(..., **config)")
    word = None if start is None else str(start)
    if isinstance(start, type):
        word = task_name(start)
    whole: TrainConfig | None = None
    files: Sequence[str | Path] = ()
    if isinstance(config, TrainConfig):
        whole = config
    elif isinstance(config, str | Path):
        files = (config,)
    else:
        files = config
    of_start = {key: settings[key] for key in ("algorithm", "log_dir") if key in settings}
    of_start["warm_start"] = warm_start
    beginning = find_start(word, validate(StartFlags, of_start, PYTHON), whole)
    of_files = {"config": files, "robot": robot, "world": world}
    layers = layers_on(beginning, validate(FileFlags, of_files, PYTHON))
    config = layers.config(settings)
    set_up_jax(config.env)
    console = stdout(quiet=quiet or not hosts.is_leader())
    return run_training(layers, config, console, callbacks, report)


def run_training(
    layers: Layers,
    config: TrainConfig,
    console: Console,
    callbacks: Sequence[Callback],
    report: bool,
) -> Run:
    """Trains with a config, which has its settings from layers, and returns the run.

    Raises:
      UserError: as `job.train`.
    """
    resume = layers.start.place
    if resume is None:
        say(console, f"config: {layers.title}")
    notes = notes_on_learning_rate(config) + notes_on_worlds(config) + notes_on_intervals(config)
    for note in (*layers.notes, *notes):
        say(console, f"note: {note}")
    seeds = job.train(config, console, resume=resume, callbacks=callbacks)
    best = print_results(seeds, console)
    if report and hosts.is_leader():
        leave_report(best, console)
    run = best.run if len(seeds) == 1 else best.run.parent
    return Run(run)


def notes_on_learning_rate(config: TrainConfig) -> list[str]:
    """A sentence where the user sets the learning rate, and it is only the one at the start."""
    is_said = config.sources["ppo.learning_rate"] in (FLAGS, PYTHON)
    if not (is_said and config.adapts_learning_rate):
        return []
    return [
        f"ppo.learning_rate {config.ppo.learning_rate} is only the first one, since ppo.target_kl "
        f"{config.ppo.target_kl} adapts it after each minibatch; to compare learning rates, set "
        "target_kl to 0, or change target_kl itself"
    ]


def notes_on_worlds(config: TrainConfig) -> list[str]:
    """A sentence where most episodes do not have the numbers of a named world, as a preset's share
    decides how often each term is sampled at all."""
    share = config.env.randomization.share
    prefix = "env.randomization."
    of_world = [
        key
        for key, source in config.sources.items()
        if key.startswith(prefix) and source.startswith("the world ")
    ]
    source = config.sources[f"{prefix}share"]
    if share == 1.0 or not of_world or source in (FLAGS, PYTHON):
        return []
    return [
        f"{shorten(source)} samples each number of {config.sources[of_world[0]]} in {share:.0%} of "
        "the episodes (or as often as shares says), and the rest has the model's own; a --config "
        "file with env: {randomization: {share: 1.0, shares: null}} trains in that world alone"
    ]


def notes_on_intervals(config: TrainConfig) -> list[str]:
    """A sentence for each interval that is shorter than a block, which nothing interrupts."""
    notes = []
    for key in ("eval_every", "save_every"):
        steps = getattr(config, key)
        if steps is not None and steps < config.steps_per_block:
            notes.append(
                f"{key} {steps:,} is shorter than a block, so it is done every "
                f"{config.steps_per_block:,} steps; a smaller block_steps makes it more often"
            )
    return notes


def print_results(seeds: Sequence[job.SeedRun], console: Console) -> job.SeedRun:
    """Prints the results of a training run; returns the best seed."""
    reports = {seed.config.seed: seed.progress.best for seed in seeds}
    evaluated = [seed for seed in seeds if seed.progress.best is not None]
    best_seed = max(evaluated, key=lambda seed: seed.progress.best.score)
    # On fresh resets; the report that chose the checkpoint is of other ones.
    report = best_seed.progress.best
    if len(seeds) > 1:
        print_table(console, seeds_table(reports))
    else:
        title = f"best checkpoint, {best_seed.progress.best_steps:,} steps, on fresh resets"
        print_table(console, results_table(report, title))
        say(console, details_line(report))
        say(console, f"chosen for {best_seed.best.report.merit}")
    if unsolved := unsolved_line(report, len(seeds)):
        say(console, unsolved)
    spent = ", ".join(f"{name} {value:.1f} s" for name, value in best_seed.seconds.items())
    say(console, f"time: {spent}")
    label = "run" if len(seeds) == 1 else f"best seed: {best_seed.config.seed}  run"
    say(console, f"{label}: {best_seed.run}")
    return best_seed


def leave_report(seed: job.SeedRun, console: Console) -> None:
    """Draws the report. The training is already saved, so a failure only prints one line.

    Raises:
      TrainingStopped: a signal came meanwhile.
    """
    started = time.perf_counter()
    words = shlex.join([str(seed.run), *import_flags_of_run(seed.run)])
    again = f"draw it with: bounce-mjx report {words}"
    try:
        # Imported during the compilation (`Job.compile`).
        from bounce_mjx.reports.page import write_report

        with StopRequest() as stop:
            drawing = in_daemon_thread(lambda: write_report(seed.run, seed.progress.best.recording))
            if not stop.wait_for(drawing):
                raise job.TrainingStopped(f"report: not drawn, as a signal came; {again}")
        path = drawing.result()
    except Exception as error:
        say(console, f"report: not drawn ({reason_of(error)}); {again}")
    else:
        say(console, f"report: {path}  ({time.perf_counter() - started:.1f} s)")
