"""The comparison of the trainers on a tiny scale, and the summary of its records."""

from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch):
    """The module of the benchmark."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import jax_vs_torch

    return jax_vs_torch


def evaluation(method, seed, steps, block_seconds, passed=False, run=1.0):
    return {
        "run": f"{method}-{seed}-{run}",
        "method": method,
        "seed": seed,
        "device": "a device",
        "num_envs": 8,
        "total_steps": 400,
        "steps": steps,
        "block_seconds": block_seconds,
        "process_seconds": 10.0 + steps,
        "passed": passed,
        "return": float(steps),
        "results": {},
    }


def test_training_clock_excludes_compilation(benchmark):
    seconds = (9.0, 3.0, 1.0, 2.0)
    records = [evaluation("brax", 0, 100 * (i + 1), s) for i, s in enumerate(seconds)]
    run = benchmark.newest_runs(records)["brax", 0]
    assert [record["train_seconds"] for record in run] == [1.5, 3.0, 4.0, 6.0]


def test_the_newest_run_counts_even_if_it_is_incomplete(benchmark):
    old = [evaluation("ours", 0, 100, 1.0, passed=True)]
    new = [evaluation("ours", 0, steps, 1.0, steps > 200, run=2.0) for steps in (100, 200, 300)]
    whole = [evaluation("rsl_rl", 0, steps, 2.0, steps > 300) for steps in (100, 200, 300, 400)]
    summary = benchmark.summarize(benchmark.newest_runs([*whole, *new, *old, *new]))
    assert summary["ours"]["solved_steps"] == [300]
    assert summary["ours"]["solved_train"] == [3.0]
    assert summary["ours"]["return"] == [None]
    assert summary["rsl_rl"]["return"] == [400.0]
    assert summary["rsl_rl"]["solved_process"] == [410.0]
    assert summary["rsl_rl"]["rate"] == [50.0]
