"""benchmarks/sweep.py: the search over hyperparameters trains populations, and continues."""

from pathlib import Path

import optuna
import pytest

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
CONFIG = """
env: {episode_seconds: 0.2}
ppo: {num_envs: 8, rollout_length: 8, num_minibatches: 2, num_epochs: 1, hidden_layers: [16]}
eval_every: 64
"""


@pytest.fixture
def sweep(monkeypatch, tmp_path: Path):
    """The module of the search, and its command with two trials."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import sweep

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


def test_an_interrupted_search_continues(sweep, monkeypatch):
    module, command = sweep
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
