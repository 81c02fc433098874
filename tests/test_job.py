"""The training job with a trainer and evaluations in NumPy: what it evaluates, saves and keeps."""

import errno
import io
import itertools
import json
import os
import signal
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from rich.console import Console

from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.results import Report, Result
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.runs import writing
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.folders import Checkpoint, best_checkpoint, latest_checkpoint
from bounce_mjx.runs.reading import policy_shapes, read_policy, read_record
from bounce_mjx.training import job
from bounce_mjx.training.callbacks import Event
from bounce_mjx.training.trainer import Snapshot

BLOCK = 64


class CountingTrainer:
    """Its state is the number of its iterations, and all numbers of its policy are that number."""

    checked = ("loss",)

    def __init__(self, config: TrainConfig, env):
        self.mesh = jax.sharding.Mesh(jax.devices()[:1], ("devices",))
        self.shapes, self.state = policy_shapes(config), np.int32(0)

    def state_template(self):
        return jax.ShapeDtypeStruct((), np.int32)

    def compile(self, pool):
        return pool.submit(lambda: None)

    def start(self, state=None):
        self.state = np.int32(0) if state is None else state

    def run(self, iterations, stopping):
        self.state = np.int32(self.state + iterations)
        names = "fault", "episode/ended", "episode/return", "episode/bounces", "task/non_finite"
        return {name: np.zeros((1, iterations)) for name in names}

    def snapshot(self):
        policy = jax.tree.map(lambda x: np.full(x.shape, self.state, x.dtype), self.shapes)
        return Snapshot([policy], self.state)


class Scores:
    """Evaluations whose mean return is given by the number of iterations."""

    def __init__(self, returns: dict[int, float]):
        self.returns = returns

    def __call__(self, config, env, mesh, pool) -> "Scores":
        return self

    def select(self, policies) -> list[Report]:
        iterations = int(np.ravel(jax.tree.leaves(policies)[0])[0])
        result = Result("stable", "episodes, %", 0.0, ">= 99", False)
        return [
            Report(
                (result,),
                {"mean_return": self.returns[iterations], "episodes": 1.0, "mean_length_s": 1.0},
            )
        ]

    final = select


def train(
    log_dir: Path,
    returns: dict[int, float],
    resume: Path | None = None,
    scores=Scores,
    callbacks=(),
) -> Path:
    """The folder of a run that evaluates after each block of one iteration."""
    ppo = PPOConfig(num_envs=8, rollout_length=8, num_minibatches=2, hidden_layers=(4,))
    config = TrainConfig(
        ppo=ppo, block_steps=BLOCK, eval_every=BLOCK, total_steps=BLOCK * max(returns)
    ).model_copy(update={"log_dir": log_dir})
    (seed,) = job.train(
        config,
        Console(file=io.StringIO()),
        resume=resume,
        callbacks=callbacks,
        make_trainer=CountingTrainer,
        make_evaluators=scores(returns),
    )
    return seed.run


def best_steps(run: Path) -> int:
    return json.loads((run / "results.json").read_text())["best_steps"]


def iterations_of(checkpoint: Checkpoint) -> int:
    """The iterations after which the policy of a checkpoint was saved."""
    leaves = jax.tree.leaves(read_policy(checkpoint, load_run_config(checkpoint.run)))
    (iterations,) = {float(x) for leaf in leaves for x in np.ravel(leaf)}
    return int(iterations)


def fail(monkeypatch: pytest.MonkeyPatch, *saves: int) -> None:
    """Lets some saves, by number from 1, find a full disk."""
    save, count = writing.save_checkpoint, itertools.count(1)

    def full(*args) -> None:
        if next(count) in saves:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(*args)

    monkeypatch.setattr(writing, "save_checkpoint", full)


def test_the_newest_and_the_best_state_are_kept(tmp_path: Path) -> None:
    run = train(tmp_path, {1: 5.0, 2: 9.0, 3: 1.0})
    assert best_steps(run) == 2 * BLOCK
    assert iterations_of(best_checkpoint(run)) == 2
    assert iterations_of(latest_checkpoint(run)) == 3


def test_a_resumed_training_knows_the_best_policy(tmp_path: Path) -> None:
    run = train(tmp_path, {1: 9.0, 2: 1.0})
    train(tmp_path, {3: 2.0, 4: 3.0, 1: 9.0}, run)
    assert best_steps(run) == BLOCK and iterations_of(best_checkpoint(run)) == 1
    record = read_record(latest_checkpoint(run))
    assert [e["steps"] for e in record.progress["evaluations"]] == [64, 128, 192, 256]


def test_a_policy_that_could_not_be_saved_is_not_the_best(tmp_path: Path, monkeypatch) -> None:
    fail(monkeypatch, 2)
    run = train(tmp_path, {1: 5.0, 2: 9.0, 3: 7.0})
    assert best_steps(run) == 3 * BLOCK and iterations_of(best_checkpoint(run)) == 3


def test_a_training_that_ends_without_room_says_so(tmp_path: Path, monkeypatch) -> None:
    """The last good checkpoint stays, and the training resumes from it."""
    with monkeypatch.context() as patch:
        fail(patch, 2, 3)
        sentence = (
            r"\(No space left on device\), so the end of the training is lost; make room, and"
        )
        with pytest.raises(UserError, match=f"{sentence} continue with: bounce-mjx train --resume"):
            train(tmp_path, {1: 5.0, 2: 9.0, 3: 7.0})
    (run,) = tmp_path.iterdir()
    assert iterations_of(latest_checkpoint(run)) == 1
    train(tmp_path, {2: 9.0, 3: 7.0}, run)
    assert best_steps(run) == 2 * BLOCK and iterations_of(best_checkpoint(run)) == 2


def test_an_evaluation_that_was_stopped_is_repeated(tmp_path: Path) -> None:
    """Its checkpoint has the next number, as the one without it had the steps."""

    class Stopped(Scores):
        def select(self, policies):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.5)
            return super().select(policies)

    with pytest.raises(job.TrainingStopped, match="stopped after 64 steps"):
        train(tmp_path, {1: 5.0}, scores=Stopped)
    (run,) = tmp_path.iterdir()
    assert latest_checkpoint(run).steps == BLOCK
    train(tmp_path, {1: 5.0}, run)
    best = best_checkpoint(run)
    assert (best.steps, read_record(best).steps, best_steps(run)) == (BLOCK + 1, BLOCK, BLOCK)


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

    run = train(tmp_path, {1: 5.0, 2: 9.0, 3: 7.0}, callbacks=[Tracker()])
    blocks = [(64, 0.0, False), (64, 5.0, True), (128, 0.0, False), (128, 9.0, True)]
    assert seen == [3 * BLOCK, *blocks, "closed"]
    results = json.loads((run / "results.json").read_text())
    assert (results["trained_steps"], results["best_steps"]) == (2 * BLOCK, 2 * BLOCK)
    assert results["fresh_resets"]


def test_an_error_in_a_callback_ends_the_training(tmp_path: Path) -> None:
    """What was saved stays, and the training resumes from it."""

    def fail(event: Event) -> None:
        if event.steps == 2 * BLOCK:
            raise RuntimeError("pruned")

    with pytest.raises(RuntimeError, match="pruned"):
        train(tmp_path, {1: 5.0, 2: 9.0}, callbacks=[fail])
    (run,) = tmp_path.iterdir()
    assert iterations_of(latest_checkpoint(run)) == 1
    train(tmp_path, {1: 5.0, 2: 9.0}, run)
    assert best_steps(run) == 2 * BLOCK
