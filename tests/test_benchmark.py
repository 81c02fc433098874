"""The benchmark: its limits, hits, intervals, and the files of its command."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from bounce_mjx import EnvConfig
from bounce_mjx.baselines.mirror import MirrorLaw
from bounce_mjx.commands import benchmark as command
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation import benchmark
from bounce_mjx.evaluation.benchmark import Figures, largest_stable, measure_nominal
from bounce_mjx.evaluation.robustness import ConditionOutcome
from bounce_mjx.reports.benchmark import interval
from bounce_mjx.resources import resource_path


def outcome(name: str, strength: float, lasted: float) -> ConditionOutcome:
    return ConditionOutcome(
        perturbation=name, group="", unit="", strength=strength, trained=False, physics="fused",
        values={"stable": 100.0 * lasted}, failed=[], lasted=lasted, mean_length_s=1.0,
    )  # fmt: skip


def test_a_limit_ends_before_the_first_failure() -> None:
    rows = [outcome("late", s, x) for s, x in ((10, 1.0), (20, 0.99), (30, 0.98), (40, 1.0))]
    assert largest_stable([*rows, outcome("push", 5, 0.0)], "late") == 20
    assert largest_stable(rows[2:], "late") == 0.0


def test_the_interval_is_that_of_the_mean() -> None:
    values = np.random.default_rng(1).normal(5.0, 2.0, 40)
    mean, low, high = map(float, re.findall(r"[\d.]+", interval(list(values), ".3f")))
    half = 1.96 * values.std(ddof=1) / np.sqrt(40)
    assert mean == pytest.approx(values.mean(), abs=1e-3)
    np.testing.assert_allclose([low, high], [mean - half, mean + half], atol=0.15 * half)
    assert interval([None], ".1f") == "-" and interval([2.0, 2.0], ".1f") == "2.0"


@pytest.mark.slow
def test_the_mirror_law_hits_until_the_cap(monkeypatch) -> None:
    """Its apexes are near the target, some above and some below."""
    monkeypatch.setattr(benchmark, "MOST_HITS", 8)
    hits, found = measure_nominal(None, MirrorLaw, EnvConfig(), seed=3)
    assert hits == 8
    assert abs(found["apex bias, cm"]) < found["apex RMS, cm"] < 10.0


def test_the_command_writes_a_row_for_each_policy(tmp_path: Path, monkeypatch, capsys) -> None:
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

    def measure(policy, actor, trained, options, progress) -> Figures:
        assert policy is not None and options.episodes == 64
        return Figures(
            suite_met=7, suite_conditions=9, latency_ms=20, push_m_s=0.1, hits=next(hits)
        )

    monkeypatch.setattr(benchmark, "measure", measure)
    monkeypatch.chdir(tmp_path)
    command.main(["seeds", "robust", "outer", "several", "--out", "found"])
    stored = json.loads((tmp_path / "found/benchmark.json").read_text())
    assert [len(row["figures"]) for row in stored["rows"]] == [2, 1, 1, 2]
    table = (tmp_path / "found/benchmark.md").read_text()
    printed = capsys.readouterr().out
    assert table in printed
    assert "robust: seeds 1; suite met 7 of 9; latency, ms 20; push, m/s 0.10; hits 30\n" in printed
    first, second = table.splitlines()[2:4]
    assert first.startswith("| seeds | 2 | 7 of 9 | 20 | 0.10 | 15 (10 to 20) |")
    assert second.startswith("| robust | 1 | 7 of 9 | 20 | 0.10 | 30 |")
    assert 'title="policy">robust</td>' in (tmp_path / "found/benchmark.html").read_text()


def test_an_interrupted_benchmark_leaves_the_rows_so_far(tmp_path: Path, monkeypatch) -> None:
    def measure(policy, *_) -> Figures:
        if policy is None:
            raise UserError("interrupted")
        return Figures(suite_met=7, suite_conditions=9, latency_ms=20, push_m_s=0.1)

    monkeypatch.setattr(benchmark, "measure", measure)
    with pytest.raises(SystemExit):
        command.main(["pretrained", "mirror", "--out", str(tmp_path)])
    stored = json.loads((tmp_path / "benchmark.json").read_text())
    assert [row["name"] for row in stored["rows"]] == ["pretrained"]


def test_no_policy_is_a_mistake(capsys) -> None:
    with pytest.raises(SystemExit) as exit_info:
        command.main([])
    assert exit_info.value.code == 2 and "pretrained" in capsys.readouterr().err
