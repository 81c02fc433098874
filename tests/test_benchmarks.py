"""The benchmarks: figures of the ranking, and the search."""

import importlib
import re
from pathlib import Path

import numpy as np
import optuna
import pytest

from bounce_mjx.evaluation.robustness import ConditionOutcome


def script(name: str):
    """A fixture: the module of a benchmark."""

    @pytest.fixture(name=name)
    def module(monkeypatch):
        monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))
        return importlib.import_module(name)

    return module


rank, sweep = map(script, ("rank", "sweep"))


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


CONFIG = """
env: {episode_seconds: 0.2}
ppo: {num_envs: 8, rollout_length: 8, num_minibatches: 2, num_epochs: 1, hidden_layers: [16]}
eval_every: 64
"""


@pytest.fixture
def search(sweep, tmp_path: Path):
    """The module of the search, and its command with two trials."""
    (tmp_path / "tiny.yaml").write_text(CONFIG)
    command = sweep.Command(
        config=tmp_path / "tiny.yaml",
        trials=2,
        seeds=2,
        steps=128,
        episodes=2,
        storage=tmp_path / "sweep.db",
        out=tmp_path,
    )
    return sweep, command


def states(storage: Path) -> list[str]:
    study = optuna.load_study(study_name="bounce_mjx", storage=f"sqlite:///{storage}")
    return [trial.state.name for trial in study.trials]


def test_an_interrupted_search_continues(search, monkeypatch):
    module, command = search
    base = module.read_preset(command.config)
    tried = []

    def killed(trial, *_):
        trial.suggest_float("discount", *module.SPACE["discount"][:2])
        raise SystemExit

    def value(trial, *_):
        discount = trial.suggest_float("discount", *module.SPACE["discount"][:2])
        tried.append(discount)
        trial.set_user_attr("spread_over_seeds", 0.0)
        trial.set_user_attr("solved_at_the_end", 0)
        return discount

    monkeypatch.setattr(module, "run_trial", killed)
    with pytest.raises(SystemExit):
        module.search(command, base)
    monkeypatch.setattr(module, "run_trial", value)
    module.search(command, base)
    # The interrupted trial is repeated with the same values, which are the preset's.
    assert tried[0] == base.ppo.discount
    assert states(command.storage).count("COMPLETE") == 2
    module.search(command, base)
    assert len(tried) == 2, "a finished search tries nothing more"
