"""benchmarks/rank.py: its limits, hits, intervals, and rows."""

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from bounce_mjx import EnvConfig
from bounce_mjx.baselines.mirror import MirrorLaw
from bounce_mjx.evaluation.robustness import ConditionOutcome
from bounce_mjx.resources import resource_path


@pytest.fixture
def rank(monkeypatch: pytest.MonkeyPatch):
    """The module."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))
    import rank

    return rank


def outcome(name: str, strength: float, lasted: float) -> ConditionOutcome:
    return ConditionOutcome(
        perturbation=name, group="", unit="", strength=strength, trained=False, physics="fused",
        values={"stable": 100.0 * lasted}, failed=[], lasted=lasted, mean_length_s=1.0,
    )  # fmt: skip


def test_a_limit_ends_before_the_first_failure(rank) -> None:
    rows = [outcome("late", s, x) for s, x in ((10, 1.0), (20, 0.99), (30, 0.98), (40, 1.0))]
    assert rank.largest_stable([*rows, outcome("push", 5, 0.0)], "late") == 20
    assert rank.largest_stable(rows[2:], "late") == 0.0


def test_the_interval_is_that_of_the_mean(rank) -> None:
    values = np.random.default_rng(1).normal(5.0, 2.0, 40)
    found = rank.interval(list(values), ".3f")
    mean, low, high = map(float, re.findall(r"[\d.]+", found))
    half = 1.96 * values.std(ddof=1) / np.sqrt(40)
    assert mean == pytest.approx(values.mean(), abs=1e-3)
    np.testing.assert_allclose([low, high], [mean - half, mean + half], atol=0.15 * half)
    assert rank.interval([None], ".1f") == "-" and rank.interval([2.0, 2.0], ".1f") == "2.0"


@pytest.mark.slow
def test_the_mirror_law_hits_until_the_cap(rank, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its apexes are near the target, some above and some below."""
    monkeypatch.setattr(rank, "MOST_HITS", 8)
    found = rank.measure_nominal(None, MirrorLaw, EnvConfig(episode_seconds=2.5), seed=3)
    assert found["hits"] == 8
    assert abs(found["apex bias, cm"]) < found["apex RMS, cm"] < 10.0


def test_seeds_of_a_training_are_one_row(rank, tmp_path: Path, monkeypatch, capsys) -> None:
    """The runs in a folder are one row, and so are the seeds of a run; other runs in a run's folder
    do not count."""
    for name in ("a", "b"):
        run = tmp_path / "seeds" / name
        run.parent.mkdir(exist_ok=True)
        run.symlink_to(resource_path("pretrained"))
    outer = tmp_path / "outer"
    outer.mkdir()
    for part in (*resource_path("pretrained").glob("*.*"), resource_path("pretrained/checkpoints")):
        (outer / part.name).symlink_to(part)
    for name in ("robust", "robust_small"):
        (outer / name).symlink_to(resource_path(f"pretrained/{name}"))
    several = tmp_path / "several"
    for seed in ("seed_000", "seed_001"):
        shutil.copytree(resource_path("pretrained/robust_small"), several / seed)
    shutil.copy(several / "seed_000/config.yaml", several)
    hits = iter((10.0, 20.0, 30.0, 40.0, 50.0, 60.0))

    def measure(command, checkpoint) -> dict:
        assert command.episodes == 64 and checkpoint.steps > 0
        return {"suite met": 7, "suite conditions": 9, "latency, ms": 20.0, "hits": next(hits)}

    monkeypatch.setattr(rank, "measure", measure)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", "rank.py seeds robust outer several --out found".split())
    rank.main()
    stored = json.loads((tmp_path / "found/rank.json").read_text())
    assert [len(row) for row in stored["rows"].values()] == [2, 1, 1, 2]
    table = (tmp_path / "found/rank.md").read_text()
    assert table in capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[4:]]
    assert rows[:2] == [
        ["seeds", "2", "7 of 9", "20", "15 (10 to 20)"],
        ["robust", "1", "7 of 9", "20", "30"],
    ]


def test_no_policy_is_a_mistake(rank, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["rank.py"])
    with pytest.raises(SystemExit) as exit_info:
        rank.main()
    assert exit_info.value.code == 2 and "pretrained" in capsys.readouterr().err
