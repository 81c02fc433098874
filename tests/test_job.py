"""What a training job evaluates, saves, keeps and says, with a trainer and evaluations in NumPy."""

import concurrent.futures
import dataclasses
import errno
import io
import itertools
import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
from rich.console import Console

from bounce_mjx.commands import train as train_command
from bounce_mjx.config.user_code import import_code
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.results import Report, Result
from bounce_mjx.interrupt import Interrupted
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.ppo import PPO
from bounce_mjx.learning.registry import find_algorithm
from bounce_mjx.runs import checkpoints
from bounce_mjx.runs.checkpoints import policy_shapes, read_networks, read_policy, read_record
from bounce_mjx.runs.config import TrainConfig, import_flags_of_run, load_run_config
from bounce_mjx.runs.folders import (
    Checkpoint,
    best_checkpoint,
    find_checkpoint,
    latest_checkpoint,
    place_or_newest,
    stored_checkpoints,
)
from bounce_mjx.runs.layers import BEYOND_RESULTS, read_layers
from bounce_mjx.runs.start import Choice
from bounce_mjx.runs.storage import lock_run
from bounce_mjx.training import hosts, job, saving
from bounce_mjx.training.events import Event, block_line, evaluation_line
from bounce_mjx.training.faults import why_unlearnable
from bounce_mjx.training.run import Run, print_results
from bounce_mjx.training.seeds import SeedRun
from bounce_mjx.training.trainer import Snapshot
from tiny_runs import contents

BLOCK = 64
SEEDS = 3
RETURNS = {1: 5.0, 2: 9.0, 3: 7.0, 4: 8.0}


class CountingTrainer:
    """Its state is the number of its iterations, and all numbers of its policy are that number."""

    checked = ("reward", "loss")
    faults: dict[tuple[int, int], int] = {}
    """By seed and iteration, the quantity of `checked` that is not finite, from 1."""

    def __init__(self, config: TrainConfig, env):
        self.mesh = jax.sharding.Mesh(jax.devices()[:1], ("devices",))
        self.shapes, self.seeds, self.state = policy_shapes(config), config.num_seeds, np.int32(0)

    state_template = jax.ShapeDtypeStruct((), np.int32)

    def compile(self, pool):
        return pool.submit(lambda: None)

    def start(self, state, networks):
        self.state = np.int32(0) if state is None else state

    def train_block(self):
        names = (
            "fault",
            "episode/ended",
            "episode/return",
            "episode/bounces_at_end",
            "task/non_finite",
        )
        metrics = {name: np.zeros((self.seeds, 1)) for name in names}
        self.state = np.int32(self.state + 1)
        for (seed, iteration), number in self.faults.items():
            if iteration == self.state:
                metrics["fault"][seed] = number
        return metrics

    def snapshot(self):
        policy = jax.tree.map(lambda x: np.full(x.shape, self.state, x.dtype), self.shapes)
        return Snapshot([policy] * self.seeds, self.state)


def before(iteration: int, act: Callable) -> type[CountingTrainer]:
    """A trainer that calls `act` before it trains an iteration."""

    class Acting(CountingTrainer):
        def train_block(self):
            if self.state == iteration - 1:
                act()
            return super().train_block()

    return Acting


class Scores:
    """Evaluations whose mean return and margin are given by the number of iterations, or for each
    seed."""

    def __init__(self, returns: dict[int, float], margins: dict, screening: bool):
        self.returns, self.margins, self.screening = returns, margins, screening

    def __call__(self, config, env, mesh, pool) -> "Scores":
        return self

    def select(self, policies, progresses) -> list[Report]:
        return [self.report(seed, policy) for seed, policy in enumerate(policies)]

    def report(self, seed: int, policy) -> Report:
        iterations = int(np.ravel(jax.tree.leaves(policy)[0])[0])
        margin = self.margins.get(iterations)
        if isinstance(margin, tuple):
            margin = margin[seed]
        result = Result("stable", "episodes, %", 0.0, ">= 99", margin is not None, margin)
        mean_return = float(np.broadcast_to(self.returns[iterations], SEEDS)[seed])
        details = {"episodes": 1.0, "mean_length_s": 1.0, "mean_return": mean_return}
        return Report((result,), details, screening=self.screening)

    def final(self, policies) -> list[Report]:
        reports = self.select(policies, None)
        return [dataclasses.replace(report, screening=False) for report in reports]


def train(
    log_dir: Path,
    returns: dict[int, float],
    resume: Path | None = None,
    *,
    trainer: type[CountingTrainer] = CountingTrainer,
    scores: type[Scores] = Scores,
    margins: dict | None = None,
    screening: bool = False,
    callbacks=(),
    said: io.StringIO | None = None,
    **settings,
) -> Path:
    """The folder of a run that evaluates after each block of one iteration."""
    ppo = PPOConfig(num_envs=8, rollout_length=8, num_minibatches=2, hidden_layers=(4,))
    given = {"block_steps": BLOCK, "eval_every": BLOCK, "total_steps": BLOCK * max(returns)}
    given |= {"stop_when_solved": False} | settings
    config = TrainConfig(ppo=ppo, **given).model_copy(update={"log_dir": log_dir})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PPO, "make_trainer", staticmethod(trainer))
        return _run_of(config, resume, callbacks, said, scores(returns, margins or {}, screening))


def _run_of(config: TrainConfig, resume, callbacks, said, evaluators) -> Path:
    members = job.train(
        config,
        Console(file=said or io.StringIO()),
        resume=resume,
        callbacks=callbacks,
        make_evaluators=evaluators,
    )
    return members[0].run if len(members) == 1 else members[0].run.parent


def results_of(run: Path) -> dict:
    return json.loads((run / "results.json").read_text())


def evaluated_steps(run: Path) -> list[int]:
    return [evaluation["steps"] for evaluation in results_of(run)["evaluations"]]


def iterations_of(checkpoint: Checkpoint) -> int:
    """The iterations after which the policy of a checkpoint was saved."""
    leaves = jax.tree.leaves(read_policy(checkpoint, load_run_config(checkpoint.run)))
    (iterations,) = {float(x) for leaf in leaves for x in np.ravel(leaf)}
    return int(iterations)


def fail(monkeypatch: pytest.MonkeyPatch, *saves: int) -> None:
    """Lets some saves, by number from 1, find a full disk."""
    usage, count = shutil.disk_usage, itertools.count(1)

    def free(path: Path) -> object:
        found = usage(path)
        return found._replace(free=0) if next(count) in saves else found

    monkeypatch.setattr(shutil, "disk_usage", free)


def test_a_resumed_training_knows_the_best_policy(tmp_path: Path) -> None:
    run = train(tmp_path, {1: 9.0, 2: 1.0})
    train(tmp_path, {3: 2.0, 4: 3.0, 1: 9.0}, run)
    assert results_of(run)["best_steps"] == BLOCK and iterations_of(best_checkpoint(run)) == 1
    assert iterations_of(latest_checkpoint(run)) == 4
    record = read_record(latest_checkpoint(run))
    assert [e["steps"] for e in record.progress["evaluations"]] == [64, 128, 192, 256]


def test_results_that_are_newer_than_the_checkpoint_do_not_count(tmp_path: Path) -> None:
    """As after a crash that lost the last checkpoint, but not the files written after it."""
    run, longer = train(tmp_path / "a", {1: 1.0, 2: 2.0}), train(tmp_path / "b", RETURNS)
    shutil.copy(longer / "results.json", run)
    train(tmp_path, {1: 1.0, 2: 2.0, 3: 3.0}, run)
    assert evaluated_steps(run) == [64, 128, 192]


def test_what_a_killed_process_was_writing_is_removed(tmp_path: Path) -> None:
    run = train(tmp_path, {1: 1.0})
    folder, (latest,) = run / "checkpoints", (run / "checkpoints").iterdir()
    shutil.copytree(latest, folder / ".unfinished/128")
    assert latest_checkpoint(run).folder == latest
    train(tmp_path, {1: 1.0, 2: 2.0}, run)
    assert [path.name for path in folder.iterdir()] == ["128"]


def test_a_failed_screening_is_no_evaluation(tmp_path: Path) -> None:
    run = train(tmp_path, {1: 1.0, 2: 2.0}, screening=True, said=(said := io.StringIO()))
    assert said.getvalue().count("screening (1 of 1,024 episodes) at") == 2
    assert "evaluation at" not in said.getvalue()
    assert [e["screening"] for e in results_of(run)["evaluations"]] == [True, True]
    # The end reports all episodes.
    assert results_of(run)["screening"] is False


def test_a_state_is_saved_between_evaluations_where_save_every_asks_for_it(
    tmp_path: Path, monkeypatch
) -> None:
    saved, save = [], checkpoints.save_checkpoint

    def noted(run: Path, config: TrainConfig, steps: int, *args, **options) -> int:
        saved.append(steps // BLOCK)
        return save(run, config, steps, *args, **options)

    monkeypatch.setattr(checkpoints, "save_checkpoint", noted)
    returns = dict.fromkeys(range(1, 7), 1.0)
    run = train(tmp_path, returns, eval_every=3 * BLOCK, save_every=2 * BLOCK)
    assert saved == [2, 3, 4, 6]
    assert evaluated_steps(run) == [3 * BLOCK, 6 * BLOCK]


OWN_TRAINER = """
from bounce_mjx.learning.algorithm import Algorithm
from bounce_mjx.learning.config import PPOConfig
from test_job import CountingTrainer

class Counting(Algorithm):
    class Config(PPOConfig):
        start_steps: int = 8
        "Steps of random actions."

        @property
        def batch_steps(self):
            return 32

    @classmethod
    def make_trainer(cls, config, env):
        assert config.ppo.start_steps == 8
        return CountingTrainer(config, env)
"""


def test_an_algorithm_brings_its_own_trainer(tmp_path: Path, monkeypatch) -> None:
    """By its name, with its own settings and steps, and it is resumed as PPO is."""
    (tmp_path / "counting.py").write_text(OWN_TRAINER)
    import_code(tmp_path / "counting.py")
    monkeypatch.setitem(sys.modules, "test_job", sys.modules[__name__])
    choice = Choice(algorithm="counting", config=())
    said = {"num_envs": 8, "rollout_length": 8, "num_minibatches": 2, "hidden_layers": (4,)}
    said |= {"block_steps": 64, "eval_every": 64, "total_steps": 128, "log_dir": tmp_path / "runs"}
    config = read_layers(choice).config(said | {"stop_when_solved": False})
    scores = Scores({1: 5.0, 2: 9.0, 3: 7.0}, {}, False)
    run = _run_of(config, None, (), io.StringIO(), scores)
    assert (config.ppo.start_steps, config.iterations_per_block) == (8, 2)
    assert results_of(run)["best_steps"] == 128
    assert import_flags_of_run(run) == []
    copy = str(run / "algorithm/counting.py")
    assert import_flags_of_run(run, to_train=True) == ["--import", copy]
    longer = read_layers(Choice(word=str(run))).config({"total_steps": 192})
    _run_of(longer, run, (), io.StringIO(), scores)
    assert evaluated_steps(run) == [64, 128, 192]
    # What PPO refuses before the training is nothing to another algorithm.
    long_rollout = said | {"rollout_length": 10_000, "seed": 21}
    train_command.print_config(read_layers(choice).config(long_rollout))
    with pytest.raises(UserError, match="rollout"):
        train_command.print_config(read_layers(Choice()).config(long_rollout))
    (tmp_path / "without.py").write_text(
        "from bounce_mjx.learning.algorithm import Algorithm\nclass Without(Algorithm):\n    pass"
    )
    import_code(tmp_path / "without.py")
    config = read_layers(Choice(algorithm="without")).config(said)
    with pytest.raises(UserError, match="the algorithm Without has no make_trainer"):
        _run_of(config, None, (), io.StringIO(), scores)
    # Not the trainer of PPO.
    forgets = classmethod(lambda cls, config, env: None)
    monkeypatch.setattr(find_algorithm("without"), "make_trainer", forgets)
    with pytest.raises(UserError, match="make_trainer of the algorithm Without has returned None"):
        _run_of(config, None, (), io.StringIO(), scores)


def test_a_history_of_checkpoints_stays_where_it_is_asked_for(tmp_path: Path) -> None:
    """In addition to the best one; what was trained after one that is resumed counts no more."""

    def stored(run: Path) -> list[int]:
        return sorted(checkpoint.number // BLOCK for checkpoint in stored_checkpoints(run))

    returns = {1: 9.0, 2: 5.0, 3: 5.0, 4: 5.0}
    assert stored(train(tmp_path / "one", returns)) == [1, 4]
    assert stored(train(tmp_path / "two", returns, keep_checkpoints=2)) == [1, 3, 4]
    run = train(tmp_path / "all", returns, keep_checkpoints="all")
    assert stored(run) == [1, 2, 3, 4]
    assert iterations_of(find_checkpoint(run / f"checkpoints/{3 * BLOCK}")) == 3
    for place, mean_return in ((run, 9.0), (run / f"checkpoints/{3 * BLOCK}", 5.0)):
        assert Run(place).results.details["mean_return"] == mean_return
    third = run / f"checkpoints/{2 * BLOCK}"
    returns = {1: 9.0, 3: 6.0, 4: 7.0, 5: 8.0}
    train(tmp_path / "all", returns, third, keep_checkpoints="all")
    again = stored_checkpoints(run)
    assert sorted(read_record(checkpoint).steps // BLOCK for checkpoint in again) == [1, 2, 3, 4, 5]
    # Of several seeds, it is the state of all.
    seeds = train(tmp_path / "seeds", RETURNS, num_seeds=SEEDS, keep_checkpoints=3)
    assert (stored(seeds), stored(seeds / "seed_001")) == ([2, 3, 4], [2])


def test_the_state_of_all_seeds_is_no_policy_and_no_damage(tmp_path: Path) -> None:
    """Of no command: a warm start, a plot and a report find it as an evaluation does."""
    run = train(tmp_path / "evaluated", RETURNS, num_seeds=SEEDS)
    with pytest.raises(UserError, match="holds the state of all 3 seeds, with which .*; give"):
        find_checkpoint(run / "checkpoints")
    signalled = before(2, lambda: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(job.TrainingStopped):
        train(tmp_path, RETURNS, trainer=signalled, num_seeds=SEEDS, eval_every=4 * BLOCK)
    (run,) = tmp_path.glob("2*")
    with pytest.raises(UserError, match="no policy is evaluated yet; resume it: bounce-mjx train"):
        find_checkpoint(run)


@pytest.mark.parametrize(("given", "trained"), [(170, 192), (80, 64)])
def test_a_training_ends_at_the_whole_block_nearest_to_its_steps(
    tmp_path: Path, given: int, trained: int
) -> None:
    run = train(tmp_path, RETURNS, total_steps=given, said=(said := io.StringIO()))
    line = f"steps: {trained}, in blocks of 64; evaluated and saved every 64\n"
    assert line in said.getvalue()
    assert results_of(run)["trained_steps"] == trained


def test_a_progress_line_has_each_curves_unit() -> None:
    """The log has metres; a number without a unit, and a curve without a point, get none."""
    points = []
    for apex_error in (0.05, 0.09):
        curves = {"episode/bounces_at_end": 2.0, "task/apex_error": apex_error}
        points.append({"speed/steps_per_second": 1.0, "episode/return": 407.4} | curves)
    config = TrainConfig(stop_when_solved=True)
    several = block_line(config, 64, 4.93, None, points)
    assert several == (
        "64 steps  1 steps/s  return 407 +- 0  bounces at end 2 +- 0  apex error 7 +- 2 cm  "
        "block 4.9 s"
    )
    one = block_line(config, 64, 4.93, 652.0, points[:1])
    assert one.endswith("  apex error 5 cm  block 4.9 s, ends in 652 s or by its results")


def test_a_screening_whose_policy_meets_all_results_says_why_it_ended() -> None:
    result = Result("stable", "episodes, %", 99.7, ">= 99", True, 0.5)
    full = Report((result,), {"episodes": 1024.0})
    screened = Report((result,), {"episodes": 128.0}, screening=True)
    config = TrainConfig()
    met = "1 of 1 results met (stable 99.7)"
    at = f"at 64 steps: {met}"
    assert evaluation_line(config, 64, [full]) == f"evaluation {at}, not yet with a margin"
    no_better = "with no larger margin than the best so far"
    words = f"screening (128 of 1,024 episodes) {at}, {no_better}"
    assert evaluation_line(config, 64, [screened]) == words
    several = evaluation_line(TrainConfig(num_seeds=2), 64, [screened, screened])
    assert several.endswith(f": 2 of 2 seeds meet all results, {no_better}")


def test_the_best_checkpoint_is_told_by_what_chose_it(tmp_path: Path) -> None:
    """Not by its figures on fresh resets, which it may miss."""
    clear = Result("stable", "episodes, %", 99.9, ">= 99", True, 1.0)
    close = Result("height", "bounces, %", 95.2, ">= 95", True, 0.1)
    missed = dataclasses.replace(close, value=94.9, passed=False, margin=0.0)
    details = {"episodes": 64.0, "mean_return": 1.0}

    def reason(chosen: Result) -> str:
        seed = SeedRun(tmp_path, TrainConfig(), {"train": 1.0})
        seed.add_report(Report((clear, chosen), details), None, 64, 0.0)
        seed.progress.best = Report((clear, missed), details)
        print_results([seed], Console(file=(said := io.StringIO())))
        lines = said.getvalue().splitlines()
        assert lines == [line.rstrip() for line in lines]
        assert lines[0].startswith("best checkpoint, 64 steps, on fresh")
        (line,) = (line for line in lines if line.startswith("chosen for"))
        return line

    assert reason(close) == "chosen for the largest margin (its tightest: height)"
    assert reason(missed) == "chosen for the most results met, then the highest return"
    with_margin = dataclasses.replace(close, margin=1.0)
    assert reason(with_margin) == "chosen for a margin in all results, then the highest return"


def test_a_training_stops_once_its_results_have_a_margin(tmp_path: Path) -> None:
    """It tells the first evaluation that met all results, and the end; resumed with more steps, it
    goes on."""
    margins = {2: 0.5, 3: 1.0, 4: 1.0}
    said = io.StringIO()
    run = train(tmp_path, RETURNS, margins=margins, stop_when_solved=True, said=said)
    assert "the training ends: all results are met with a margin" in said.getvalue()
    results = results_of(run)
    steps = [results[name] for name in ("solved_steps", "margin_steps", "trained_steps")]
    assert steps == [128, 192, 192]
    assert 0.0 < results["solved_seconds"] < sum(results["seconds"].values())
    assert best_checkpoint(run).steps == 192
    train(
        tmp_path,
        RETURNS,
        run,
        margins=margins,
        stop_when_solved=True,
        said=(shown := io.StringIO()),
    )
    assert f"{run} has met all results, 192 steps; add --total-steps N" in shown.getvalue()
    # Results are not needed to resume.
    (run / "results.json").write_text("damaged")
    layers = read_layers(Choice(word=str(run)))
    going_on = layers.config({"total_steps": 10**6})
    assert not going_on.stop_when_solved
    assert going_on.sources["total_steps"] == "train()"
    assert going_on.sources["stop_when_solved"] == BEYOND_RESULTS
    assert layers.config().stop_when_solved
    assert latest_checkpoint(run).steps == 192
    train(tmp_path, RETURNS, run, margins=margins, said=(shown := io.StringIO()))
    assert latest_checkpoint(run).steps == 256
    assert "the training ends after its 256 steps (total_steps)" in shown.getvalue()
    train(tmp_path, RETURNS, run, margins=margins, said=(shown := io.StringIO()))
    assert f"{run} has been trained to its end, 256 steps;" in shown.getvalue()
    # What `stop_when_solved` did not end, no steps go beyond.
    going_on = read_layers(Choice(word=str(run))).config({"total_steps": 10**6})
    assert going_on.sources["stop_when_solved"] != BEYOND_RESULTS


def test_settings_that_cannot_be_trained_are_refused_before_a_save(tmp_path: Path) -> None:
    class Falling(CountingTrainer):
        def train_block(self):
            return super().train_block() | {"episode/ended": np.full((1, 1), float(BLOCK))}

    class OtherUnit(CountingTrainer):
        """A reward in mm for m, among terms that are in order."""

        def train_block(self):
            terms = {"reward/alive": 1.0, "reward/height": -2e5}
            return super().train_block() | {name: np.full((1, 1), x) for name, x in terms.items()}

    with pytest.raises(UserError, match="these settings cannot be trained: an episode lasts 0.01"):
        train(tmp_path, RETURNS, trainer=Falling)
    with pytest.raises(UserError, match=r"reward term height is -2e\+05 on average, not within 1"):
        train(tmp_path, RETURNS, trainer=OtherUnit)
    assert not list(tmp_path.iterdir())
    # Its scale counts.
    ppo = PPOConfig(num_envs=8, rollout_length=8, num_minibatches=2, reward_scale=0.04)
    metrics = OtherUnit.train_block(OtherUnit(TrainConfig(ppo=ppo), None))
    assert why_unlearnable(metrics, TrainConfig(ppo=ppo)) is None


def test_a_callback_sees_blocks_and_evaluations_and_ends_the_training(tmp_path: Path) -> None:
    """The training ends as after its last step: with an evaluation, and results."""
    seen = []

    class Tracker:
        def start(self, run: Path, config: TrainConfig) -> None:
            seen.append(config.total_steps)

        def __call__(self, event: Event) -> bool | None:
            figure = event.metrics.get("results/mean_return", event.metrics.get("episode/return"))
            seen.append((event.steps, figure, event.report is not None))
            return event.steps < 2 * BLOCK

        def close(self) -> None:
            seen.append("closed")

    said = io.StringIO()
    run = train(tmp_path, {1: 5.0, 2: 9.0, 3: 7.0}, callbacks=[Tracker()], said=said)
    ends = "a callback ended the training after 128 steps; continue with: bounce-mjx train "
    assert ends in said.getvalue()
    # The first block, during which other programs are compiled, says nothing about those to come.
    blocks = [line for line in said.getvalue().splitlines() if "steps/s" in line]
    assert [", ends in " in line for line in blocks] == [False, True]
    blocks = [(64, 0.0, False), (64, 5.0, True), (128, 0.0, False), (128, 9.0, True)]
    assert seen == [3 * BLOCK, *blocks, "closed"]
    results = results_of(run)
    assert (results["trained_steps"], results["best_steps"]) == (2 * BLOCK, 2 * BLOCK)
    assert results["fresh_resets"]


@pytest.mark.parametrize("is_at_evaluation", [False, True])
def test_an_error_in_a_callback_ends_the_training_once_all_is_saved(
    tmp_path: Path, is_at_evaluation: bool
) -> None:
    """Nothing that was trained is lost, and the other callbacks know the event. As after a signal,
    an evaluation that is due is left out; and the callback is called no more."""
    seen = []
    failed = 0

    def fail(event: Event) -> None:
        nonlocal failed
        is_evaluation = event.report is not None
        if event.steps == 2 * BLOCK and is_evaluation >= is_at_evaluation:
            failed += 1
            raise RuntimeError("pruned")

    said = io.StringIO()
    callbacks = [fail, lambda event: seen.append(event.steps)]
    with pytest.raises(RuntimeError, match="pruned"):
        train(tmp_path, {1: 5.0, 2: 9.0, 3: 7.0}, callbacks=callbacks, said=said)
    (run,) = tmp_path.iterdir()
    assert seen == [BLOCK, BLOCK, *([2 * BLOCK] * (1 + is_at_evaluation))]
    assert failed == 1
    assert "a callback failed after 128 steps; continue with: bounce-mjx train" in said.getvalue()
    assert iterations_of(latest_checkpoint(run)) == 2
    train(tmp_path, {2: 9.0, 3: 7.0}, run)
    assert results_of(run)["best_steps"] == 2 * BLOCK


def test_a_callback_that_failed_for_one_seed_is_not_called_for_another(tmp_path: Path) -> None:
    seen = []

    def fail(event: Event) -> None:
        seen.append(event.config.seed)
        raise RuntimeError("pruned")

    with pytest.raises(RuntimeError, match="pruned"):
        train(tmp_path, {1: 5.0, 2: 9.0}, callbacks=[fail], num_seeds=2)
    assert seen == [0]


def test_an_error_in_a_callback_is_the_cause_where_its_state_cannot_be_saved(
    tmp_path: Path, monkeypatch
) -> None:
    def prune(event: Event) -> None:
        if event.steps == 2 * BLOCK:
            raise RuntimeError("pruned")

    fail(monkeypatch, 2)
    with pytest.raises(UserError, match="the end of the training is lost") as caught:
        train(tmp_path, {1: 5.0, 2: 9.0}, callbacks=[prune])
    assert str(caught.value.__cause__) == "pruned"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_saves_and_says_how_to_resume(tmp_path: Path, number: signal.Signals) -> None:
    signalled = before(2, lambda: os.kill(os.getpid(), number))
    num_evaluations = 0

    class Counted(Scores):
        def select(self, policies, progresses):
            nonlocal num_evaluations
            num_evaluations += 1
            return super().select(policies, progresses)

    with pytest.raises(job.TrainingStopped) as stopped:
        train(tmp_path, RETURNS, trainer=signalled, scores=Counted)
    # None is begun whose end nobody waits for.
    assert num_evaluations == 1
    (run,) = tmp_path.iterdir()
    continues = f"stopped after 128 steps; continue with: bounce-mjx train {run}"
    assert f"{continues} (its report so far: bounce-mjx report {run})" in str(stopped.value)
    assert latest_checkpoint(run).steps == 2 * BLOCK
    train(tmp_path, RETURNS, run)
    assert evaluated_steps(run) == [64, 128, 192, 256]


def test_a_signal_during_the_last_save_is_not_lost(tmp_path: Path, monkeypatch) -> None:
    start = saving.Saver.start

    def interrupted(self, snapshot, steps, about):
        # That of the final results has no state.
        if snapshot is None:
            os.kill(os.getpid(), signal.SIGTERM)
        start(self, snapshot, steps, about)

    monkeypatch.setattr(saving.Saver, "start", interrupted)
    ended = "after 128 steps, at the end of the training; the results are in"
    with pytest.raises(job.TrainingStopped, match=ended):
        train(tmp_path, {1: 5.0, 2: 9.0})
    (run,) = tmp_path.iterdir()
    assert results_of(run)["fresh_resets"]


def test_a_signal_during_the_final_evaluation_leaves_it_out(tmp_path: Path) -> None:
    ended = threading.Event()

    class Waiting(Scores):
        def final(self, policies) -> list[Report]:
            os.kill(os.getpid(), signal.SIGTERM)
            ended.wait()
            return super().final(policies)

    try:
        with pytest.raises(job.TrainingStopped, match="128 steps, before the final evaluation; "):
            train(tmp_path, {1: 5.0, 2: 9.0}, scores=Waiting)
    finally:
        ended.set()
    (run,) = tmp_path.iterdir()
    assert not results_of(run)["fresh_resets"]


def test_a_signal_while_the_callbacks_are_closed_is_not_lost(tmp_path: Path) -> None:
    class Closing:
        def __call__(self, event) -> None:
            pass

        def close(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)

    ended = "after 64 steps, at the end of the training; the results are in"
    with pytest.raises(job.TrainingStopped, match=ended):
        train(tmp_path, {1: 5.0}, callbacks=[Closing()])


def test_a_signal_during_the_compilation_leaves_nothing(tmp_path: Path) -> None:
    ended = concurrent.futures.Future()

    class Compiling(CountingTrainer):
        def compile(self, pool):
            os.kill(os.getpid(), signal.SIGTERM)
            return ended

    try:
        with pytest.raises(Interrupted):
            train(tmp_path, RETURNS, trainer=Compiling)
    finally:
        ended.set_result(None)
    assert not list(tmp_path.iterdir())


def test_an_evaluation_that_was_stopped_is_repeated(tmp_path: Path) -> None:
    """The signal does not wait for it. Its checkpoint has the next number, as the one without it
    had the steps."""

    class Stopped(Scores):
        def select(self, policies, progresses):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.5)
            return super().select(policies, progresses)

    with pytest.raises(job.TrainingStopped, match="stopped after 64 steps"):
        train(tmp_path, {1: 5.0}, scores=Stopped)
    (run,) = tmp_path.iterdir()
    assert latest_checkpoint(run).steps == BLOCK
    train(tmp_path, {1: 5.0}, run)
    best = best_checkpoint(run)
    assert (best.number, best.steps) == (BLOCK + 1, BLOCK)
    assert results_of(run)["best_steps"] == BLOCK


def test_a_training_holds_the_lock_of_its_run(tmp_path: Path) -> None:
    run = train(tmp_path, {1: 1.0})
    refusals = []

    def look() -> None:
        with pytest.raises(UserError, match="is in use by another training") as refused:
            with lock_run(run):
                pass
        refusals.append(refused)

    train(tmp_path, {1: 1.0, 2: 2.0}, run, trainer=before(2, look))
    assert refusals and not list(run.glob(".*"))
    saved = contents(run)
    with lock_run(run), pytest.raises(UserError, match=f"{run} is in use by another training"):
        train(tmp_path, RETURNS, run)
    assert contents(run) == saved


def test_a_training_goes_on_while_it_cannot_save(tmp_path: Path, monkeypatch) -> None:
    """It says so once, saves its newest state once there is room again, and says that."""
    fail(monkeypatch, 2, 3)
    returns = {iteration: float(iteration) for iteration in range(1, 6)}
    run = train(tmp_path, returns, said=(said := io.StringIO()))
    assert said.getvalue().count("cannot be written (No space left on device)") == 1
    assert said.getvalue().count("the state is saved again, after 256 steps") == 1
    assert iterations_of(latest_checkpoint(run)) == 5


def test_an_error_of_orbax_does_not_end_a_training(tmp_path: Path, monkeypatch) -> None:
    """Nor does one that is no OSError."""
    write, count = checkpoints.seal, itertools.count(1)

    def breaks(folder: Path) -> None:
        if next(count) == 2:
            raise ValueError("NOT_FOUND:\nError reading")
        write(folder)

    monkeypatch.setattr(checkpoints, "seal", breaks)
    run = train(tmp_path, RETURNS, said=(said := io.StringIO()))
    assert "cannot be written (NOT_FOUND: Error reading); training continues" in said.getvalue()
    assert iterations_of(latest_checkpoint(run)) == 4


def test_a_folder_that_is_moved_during_a_training_is_not_made_again(tmp_path: Path) -> None:
    """The training goes on, and saves once the folder is back."""
    moved = tmp_path / "moved"

    class Moved(CountingTrainer):
        def train_block(self):
            if self.state == 1:
                (run,) = (tmp_path / "runs").iterdir()
                while not (run / "results.json").exists():
                    time.sleep(0.01)
                self.place = run.rename(moved), run
            if self.state == 3:
                assert not list((tmp_path / "runs").iterdir())
                moved.rename(self.place[1])
            return super().train_block()

    run = train(tmp_path / "runs", RETURNS, trainer=Moved, said=(said := io.StringIO()))
    assert "cannot be written (it was moved or removed)" in said.getvalue()
    assert iterations_of(latest_checkpoint(run)) == 4 and (run / "config.yaml").is_file()


def test_a_named_checkpoint_is_the_one_that_is_resumed(tmp_path: Path) -> None:
    """What was trained after it counts no more, even if it was better."""
    run = train(tmp_path, {1: 9.0, 2: 1.0})
    with pytest.raises(UserError, match="there is no run and no policy"):
        train(tmp_path, RETURNS, run / "checkpoints/192")
    train(tmp_path, {1: 9.0, 2: 3.0, 3: 2.0}, run / "checkpoints/64")
    assert evaluated_steps(run) == [64, 128, 192]
    values = [e["stable"] for e in results_of(run)["evaluations"]]
    assert len(values) == 3 and iterations_of(best_checkpoint(run)) == 1
    newest = latest_checkpoint(run)
    train(tmp_path, {1: 9.0, 2: 3.0, 3: 2.0, 4: 5.0}, newest.folder)
    assert iterations_of(best_checkpoint(run)) == 1 and iterations_of(latest_checkpoint(run)) == 4


@pytest.mark.parametrize("wrong", ["best", "newest", "newest of three"])
def test_a_resumed_training_goes_on_from_what_is_intact(tmp_path: Path, wrong: str, capsys) -> None:
    """Results, checkpoints and what is resumed agree on the best policy that is left. A process
    that is killed may leave three checkpoints."""
    run = train(tmp_path, {1: 9.0, 2: 1.0})
    steps = {"best": 64, "newest": 128, "newest of three": 192}[wrong]
    if wrong == "newest of three":
        shutil.copytree(run / "checkpoints/128", run / "checkpoints/192")
    (run / f"checkpoints/{steps}/record/metadata").write_text("")
    train(tmp_path, {1: 9.0, 2: 1.0, 3: 0.5}, run)
    assert f"checkpoints/{steps} is damaged" in capsys.readouterr().err
    best = 2 if wrong == "best" else 1
    assert results_of(run)["best_steps"] == best * BLOCK
    assert iterations_of(best_checkpoint(run)) == best
    assert evaluated_steps(run) == [64, 128, 192]
    stored = {iterations_of(checkpoint) for checkpoint in stored_checkpoints(run)}
    assert stored == {best, 3}
    # It may be repaired.
    assert (run / f"checkpoints/{steps}.damaged/policy").is_dir()


def test_a_policy_that_could_not_be_saved_is_not_the_best(tmp_path: Path, monkeypatch) -> None:
    fail(monkeypatch, 2)
    run = train(tmp_path, {1: 5.0, 2: 9.0, 3: 7.0})
    assert results_of(run)["best_steps"] == 3 * BLOCK and iterations_of(best_checkpoint(run)) == 3
    fail(monkeypatch, 2)
    run = train(tmp_path, {1: 5.0, 2: 9.0, 3: 4.0})
    assert results_of(run)["best_steps"] == BLOCK and iterations_of(best_checkpoint(run)) == 1
    # The final evaluation is that of the policy that was saved.
    assert results_of(run)["details"]["mean_return"] == 5.0


def test_results_that_could_not_be_saved_do_not_end_a_training(tmp_path: Path, monkeypatch) -> None:
    """Neither by their margin nor by the wait for one; what was saved again counts."""
    fail(monkeypatch, 1)
    settings = {"margins": {1: 0.5, 3: 0.5}, "stop_when_solved": True}
    run = train(tmp_path, dict.fromkeys(range(1, 7), 1.0), **settings)
    results = results_of(run)
    assert (results["solved_steps"], results["trained_steps"]) == (3 * BLOCK, 5 * BLOCK)
    assert evaluated_steps(run) == [128, 192, 256, 320]


def test_a_checkpoint_without_its_value_network_is_no_warm_start(tmp_path: Path) -> None:
    run = train(tmp_path, {1: 1.0})
    with pytest.raises(UserError, match="is without its value network; give robust_small"):
        read_networks(latest_checkpoint(run), load_run_config(run))


def test_a_training_that_ends_without_room_says_so(tmp_path: Path, monkeypatch) -> None:
    """The last good checkpoint stays, and the training resumes from it."""
    with monkeypatch.context() as patch:
        fail(patch, 2, 3)
        sentence = (
            r"\(No space left on device\), so the end of the training is lost; make room, and"
        )
        with pytest.raises(UserError, match=f"{sentence} continue with: bounce-mjx train "):
            train(tmp_path, {1: 5.0, 2: 9.0, 3: 7.0})
    (run,) = tmp_path.iterdir()
    assert iterations_of(latest_checkpoint(run)) == 1
    train(tmp_path, {2: 9.0, 3: 7.0}, run)
    assert results_of(run)["best_steps"] == 2 * BLOCK and iterations_of(best_checkpoint(run)) == 2


def test_final_results_that_cannot_be_written_cost_no_step(tmp_path: Path, monkeypatch) -> None:
    write = saving.write_atomically

    def full(path: Path, content: str) -> None:
        if '"fresh_resets": true' in content:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(path, content)

    monkeypatch.setattr(saving, "write_atomically", full)
    sentence = r"\(No space left on device\), so the final results are not saved; make room, and"
    with pytest.raises(UserError, match=sentence):
        train(tmp_path, {1: 5.0, 2: 9.0})
    (run,) = tmp_path.iterdir()
    assert iterations_of(latest_checkpoint(run)) == 2


def test_a_warm_start_that_meets_all_results_is_trained_until_a_margin(
    tmp_path: Path, monkeypatch
) -> None:
    """The wait for a margin counts from a policy that was trained; one with a margin needs none."""
    networks = "networks of a warm start"
    monkeypatch.setattr(checkpoints, "read_warm_start", lambda config, env: networks)
    returns = dict.fromkeys(range(6), 1.0)
    settings = {"warm_start": Path("robust_small"), "stop_when_solved": True}
    run = train(tmp_path / "a", returns, margins={0: 0.5, 1: 0.5, 3: 1.0}, **settings)
    assert evaluated_steps(run) == [0, 64, 128]
    assert results_of(run)["solved_steps"] == 0
    run = train(tmp_path / "b", returns, margins={0: 0.5, 3: 0.5, 4: 1.0}, **settings)
    assert evaluated_steps(run) == [0, 64, 128, 192, 256]
    said = io.StringIO()
    run = train(tmp_path / "c", returns, margins={0: 1.0}, said=said, **settings)
    assert evaluated_steps(run) == [0]
    assert "the training ends: all results are met with a margin" in said.getvalue()


def test_a_signal_after_the_evaluation_of_a_warm_start_says_how_to_resume(
    tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(checkpoints, "read_warm_start", lambda config, env: "networks")

    def stop(event: Event) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    settings = {"warm_start": Path("robust_small")}
    with pytest.raises(job.TrainingStopped, match="stopped after 0 steps; continue with: "):
        train(tmp_path, {0: 1.0, 1: 2.0}, callbacks=[stop], **settings)
    (run,) = tmp_path.iterdir()
    assert latest_checkpoint(run).steps == 0
    train(tmp_path, {1: 2.0}, run, **settings)
    assert evaluated_steps(run) == [0, 64]


def test_a_callback_ends_a_training_on_several_hosts_after_a_block_or_an_evaluation(
    tmp_path: Path, monkeypatch
) -> None:
    """Two threads stand for two processes: one that waits for the other in vain breaks it off."""
    number = threading.local()
    values: dict[int, object] = {}
    together = threading.Barrier(2, timeout=10)

    def exchange(value: object) -> list[object]:
        values[number.process] = json.loads(json.dumps(value))
        together.wait()
        both = [values[0], values[1]]
        together.wait()
        return both

    monkeypatch.setattr(hosts, "exchange", exchange)
    monkeypatch.setattr(hosts, "is_leader", lambda: number.process == 0)

    def host(process: int, log_dir: Path, callback) -> Path:
        number.process = process
        return train(log_dir, RETURNS, callbacks=[callback])

    def train_on_both(log_dir: Path, callback) -> Path:
        with concurrent.futures.ThreadPoolExecutor() as pool:
            runs = [pool.submit(host, process, log_dir, callback) for process in range(2)]
            run, same = (run.result() for run in runs)
        assert run == same
        return run

    run = train_on_both(tmp_path / "evaluation", lambda event: np.bool_(event.report is None))
    assert evaluated_steps(run) == [64]
    run = train_on_both(tmp_path / "block", lambda event: event.report is not None)
    assert evaluated_steps(run) == [64]


@pytest.mark.parametrize("wrong", ["one", "all"])
def test_a_seed_whose_best_policy_is_damaged_gets_another_one(
    tmp_path: Path, wrong: str, capsys
) -> None:
    """Also where the run has met all results; a line names what was damaged."""
    margins = {1: 1.0}
    settings = {"num_seeds": SEEDS, "margins": margins, "stop_when_solved": True}
    run = train(tmp_path, RETURNS, **settings)
    damaged = [0] if wrong == "one" else range(SEEDS)
    for seed in damaged:
        (run / f"seed_{seed:03d}/checkpoints/64/record/metadata").write_text("")
        (run / f"seed_{seed:03d}/results.json").unlink()
    train(tmp_path, RETURNS, run, **settings)
    warnings = capsys.readouterr().err
    for seed in range(SEEDS):
        folder = run / f"seed_{seed:03d}"
        assert (f"{folder}/checkpoints/64 is damaged" in warnings) == (seed in damaged)
        assert results_of(folder)["best_steps"] == BLOCK
        assert iterations_of(best_checkpoint(folder)) == 1
        # It may be repaired.
        assert (folder / "checkpoints/64.damaged/policy").is_dir() == (seed in damaged)


def test_damaged_states_of_several_seeds_are_set_aside(tmp_path: Path) -> None:
    """As where a process was killed between the writing of one and the removal of the other, and
    whatever was set aside before."""
    run = train(tmp_path, {1: 1.0, 2: 2.0}, num_seeds=SEEDS)
    states = run / "checkpoints"
    shutil.copytree(states / "128", states / "192")
    shutil.copytree(states / "128", states / "192.damaged")
    (states / "192/record/metadata").write_text("")
    said = io.StringIO()
    train(tmp_path, {1: 1.0, 2: 2.0, 3: 3.0}, run, num_seeds=SEEDS, said=said)
    assert (states / "192.damaged_2/training").is_dir() and (states / "192.damaged").is_dir()
    assert f"the damaged checkpoint is kept as {states}/192.damaged_2" in said.getvalue()
    assert iterations_of(best_checkpoint(run / "seed_000")) == 3


def test_a_seed_whose_config_was_edited_is_refused(tmp_path: Path) -> None:
    """Its config would be written anew, and the next best policy would take the place of its."""
    run = train(tmp_path, {1: 1.0}, num_seeds=SEEDS)
    config = run / "seed_001/config.yaml"
    config.write_text(config.read_text().replace("discount: 0.98", "discount: 0.5"))
    with pytest.raises(UserError, match="seed_001/checkpoints/64 has a different config"):
        train(tmp_path, {1: 1.0, 2: 2.0}, run, num_seeds=SEEDS)


class Diverging(CountingTrainer):
    """In the third iteration, the loss of seed 1 is not finite."""

    faults = {(1, 3): 2}


def test_divergence_ends_the_training_and_keeps_the_last_good_state(tmp_path: Path) -> None:
    class Alone(CountingTrainer):
        faults = {(0, 3): 2}

    with pytest.raises(UserError) as diverged:
        train(tmp_path, RETURNS, trainer=Alone)
    (run,) = tmp_path.iterdir()
    good = f"the last good checkpoint is {latest_checkpoint(run).folder}"
    assert f"loss became infinite or NaN at iteration 3; {good}" in str(diverged.value)
    assert iterations_of(latest_checkpoint(run)) == 2


def test_a_device_that_fails_is_told_with_the_last_checkpoint(tmp_path: Path) -> None:
    def breaks() -> None:
        raise jax.errors.JaxRuntimeError("INTERNAL: CUDA_ERROR_UNKNOWN\nin a graph")

    with pytest.raises(UserError) as failed:
        train(tmp_path, RETURNS, trainer=before(3, breaks))
    (run,) = tmp_path.iterdir()
    assert str(failed.value) == (
        "cpu failed after 128 steps (INTERNAL: CUDA_ERROR_UNKNOWN in a graph); continue with: "
        f"bounce-mjx train {run} (the last checkpoint is {run}/checkpoints/128)"
    )


def test_a_full_device_is_told_in_one_sentence(tmp_path: Path) -> None:
    def full() -> None:
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")

    reason = r"too little memory for 8 environments \(RESOURCE_EXHAUSTED: Out of memory\)"
    with pytest.raises(UserError, match=f"cpu has {reason}; lower num_envs"):
        train(tmp_path, RETURNS, trainer=before(1, full))


def test_each_seed_has_a_run_of_its_own_and_the_best_one_is_found(tmp_path: Path) -> None:
    returns = {1: (1.0, 7.0, 2.0), 2: (3.0, 1.0, 2.0), 3: (2.0, 1.0, 6.0)}
    run = train(tmp_path, returns, num_seeds=SEEDS)
    folders = [run / f"seed_{i:03d}" for i in range(SEEDS)]
    assert sorted(p for p in run.iterdir() if p.name.startswith("seed")) == folders
    for i, (folder, best) in enumerate(zip(folders, (2, 1, 3), strict=True)):
        config = load_run_config(folder)
        assert (config.seed, config.num_seeds) == (i, 1)
        assert evaluated_steps(folder) == [64, 128, 192]
        assert results_of(folder)["best_steps"] == BLOCK * best
        assert iterations_of(best_checkpoint(folder)) == best
    assert find_checkpoint(place_or_newest(None, tmp_path)) == best_checkpoint(folders[1])
    # Resumed, each knows its best one.
    train(tmp_path, returns | {4: (2.5, 9.0, 1.0)}, run, num_seeds=SEEDS)
    assert [results_of(folder)["best_steps"] for folder in folders] == [128, 256, 192]


def test_a_seed_that_diverges_leaves_the_others(tmp_path: Path) -> None:
    settings = {"num_seeds": SEEDS, "trainer": Diverging}
    run = train(tmp_path, {1: 1.0, 2: 2.0, 3: 3.0}, said=(said := io.StringIO()), **settings)
    assert "seed 1 diverged: loss became infinite or NaN at iteration 3" in (said.getvalue())
    # It stays diverged when the training is resumed.
    train(tmp_path, {1: 1.0, 2: 2.0, 3: 3.0, 4: 4.0}, run, **settings)
    evaluated = [evaluated_steps(run / f"seed_{i:03d}") for i in range(SEEDS)]
    assert evaluated == [[64, 128, 192, 256], [64, 128], [64, 128, 192, 256]]
    assert iterations_of(best_checkpoint(run / "seed_001")) == 2


def test_a_seed_whose_save_failed_is_not_solved_as_the_others_diverge(
    tmp_path: Path, monkeypatch
) -> None:
    """Whether the save succeeds is known only once it has ended."""

    class DivergingLater(CountingTrainer):
        faults = {(1, 3): 2, (2, 3): 2}

    fail(monkeypatch, 1)
    settings = {"num_seeds": SEEDS, "trainer": DivergingLater, "stop_when_solved": True}
    settings |= {"margins": {2: (1.0, None, None)}, "eval_every": 2 * BLOCK}
    run = train(tmp_path, RETURNS, **settings)
    assert evaluated_steps(run / "seed_000") == [256]
    assert iterations_of(best_checkpoint(run / "seed_000")) == 4


def test_a_solved_run_goes_on_with_more_steps_also_beside_a_seed_that_diverged(
    tmp_path: Path,
) -> None:
    class DivergingAtOnce(CountingTrainer):
        faults = {(1, 1): 2}

    settings = {"num_seeds": SEEDS, "stop_when_solved": True, "margins": {1: 1.0}}
    run = train(tmp_path, RETURNS, trainer=DivergingAtOnce, **settings)
    assert evaluated_steps(run / "seed_000") == [64]
    assert not read_layers(Choice(word=str(run))).config({"total_steps": 10**6}).stop_when_solved
