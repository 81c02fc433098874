"""benchmarks/rank.py: its limits, hits, intervals, and rows."""

import re
from pathlib import Path

import numpy as np
import pytest

from bounce_mjx.evaluation.robustness import ConditionOutcome


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
