"""When a training is solved, and what its results may hold."""

import json
import math
import os
from pathlib import Path

import jax
import numpy as np
import pytest

from bounce_mjx.evaluation.results import Report
from bounce_mjx.runs.checkpoints import read_policy
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.runs.progress import Progress
from bounce_mjx.runs.storage import to_json, write_output
from bounce_mjx.task import Result
from bounce_mjx.training.evaluators import Evaluators


@pytest.mark.parametrize(
    ("evaluations", "solved"),
    [
        ([(64, None)], False),
        ([(64, None), (128, 1.0)], True),
        ([(128, 0.5)], False),
        # Half as many steps again.
        ([(128, 0.5), (191, 0.5)], False),
        ([(128, 0.5), (192, 0.5)], True),
        ([(128, 0.5), (192, None)], True),
        ([(128, 0.5), (160, 1.0)], True),
    ],
)
def test_a_training_does_not_wait_long_for_a_margin(evaluations, solved: bool) -> None:
    """Each evaluation has steps and a margin; None is a missed result."""
    progress = Progress()
    for steps, margin in evaluations:
        result = Result("stable", "episodes, %", 0.0, ">= 99", margin is not None, margin)
        progress.add(Report((result,), {"mean_return": 1.0}), steps, 0.0)
    assert progress.may_end is solved


def test_of_equal_evaluations_the_newest_is_the_best() -> None:
    """And a screening is never better than a full evaluation."""
    progress = Progress()
    result = Result("stable", "episodes, %", 99.5, ">= 99", True, 0.5)
    full = Report((result,), {"mean_return": 1.0})
    screened = Report((result,), {"mean_return": 9.0}, screening=True)
    for steps, report, is_best in ((64, full, True), (128, full, True), (192, screened, False)):
        assert progress.add(report, steps, 0.0) is is_best
    assert progress.best_steps == 128


def report(passed: bool, margin: float | None, screening: bool = False) -> Report:
    result = Result("stable", "episodes, %", 99.5, ">= 99", passed, margin)
    return Report((result,), {"mean_return": 1.0}, screening=screening)


def test_a_full_evaluation_is_for_a_policy_that_may_be_the_best() -> None:
    """Before a trained policy has met all results, one that meets them; then one with a larger
    margin than the best. The policy of a warm start is none that was trained."""
    progress = Progress()
    missed, little, more = report(False, 0.0), report(True, 0.3), report(True, 0.6)
    for steps in (0, 64):
        assert [progress.may_be_best(each) for each in (missed, little, more)] == [0, 1, 1]
        progress.add(little, steps, 0.0)
    assert [progress.may_be_best(each) for each in (missed, little, more)] == [0, 0, 1]


@pytest.mark.parametrize(
    ("misses_from", "simulated", "is_screening"),
    [(1, [128], True), (400, [128, 256, 512], True), (1001, [128, 256, 512, 1000], False)],
)
def test_an_evaluation_doubles_its_episodes_while_the_policy_may_be_the_best(
    misses_from: int, simulated: list[int], is_screening: bool, monkeypatch
) -> None:
    """The policy misses a result from a number of episodes on."""
    ends, starts = [], []

    def run(self, policies, seed: int, first: int, episodes: int) -> list:
        starts.append(first)
        ends.append(episodes)
        return [None] * (-(-episodes // 128) - first)

    def judge(self, chunks, episodes: int) -> list[Report]:
        assert len(chunks) == -(-episodes // 128)
        return [report(episodes < misses_from, 0.3)]

    monkeypatch.setattr(Evaluators, "__init__", lambda self: None)
    monkeypatch.setattr(Evaluators, "_run", run)
    monkeypatch.setattr(Evaluators, "_judge", judge)
    evaluators = Evaluators()
    evaluators._config = TrainConfig(eval_episodes=1000)
    evaluators._chunk = 128
    (found,) = evaluators.select([None], [Progress()])
    assert (ends, found.screening) == (simulated, is_screening)
    assert starts == [0, 1, 2, 4][: len(starts)]


def test_a_screening_meets_no_results() -> None:
    """Also where its few episodes do: no full evaluation did."""
    progress = Progress()
    progress.add(report(True, 1.0, screening=True), 64, 0.0)
    assert progress.evaluations[0]["passed"] is False
    assert (progress.solved_steps, progress.margin_steps) == (None, None)


def test_json_has_null_where_there_is_no_finite_number() -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    text = to_json({"numpy": np.float64(math.nan), "tuple": (math.inf, 1)})
    assert json.loads(text, parse_constant=refuse) == {"numpy": None, "tuple": [None, 1]}


def test_json_holds_any_path() -> None:
    path = os.fsdecode(b"a\xff")
    assert json.loads(to_json({"path": path})) == {"path": path}


def test_a_pipe_that_the_user_names_stays_one() -> None:
    read, write = os.pipe()
    write_output(Path(f"/dev/fd/{write}"), "results")
    assert os.read(read, 100) == b"results"
    os.close(read)
    os.close(write)


def test_a_policy_is_read_where_double_precision_is_on() -> None:
    checkpoint = find_checkpoint("pretrained")
    config = load_run_config(checkpoint.run)
    single = read_policy(checkpoint, config)
    with jax.enable_x64(True):
        double = read_policy(checkpoint, config)
    jax.tree.map(np.testing.assert_array_equal, single, double)
