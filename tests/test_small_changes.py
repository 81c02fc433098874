"""The page docs/small-changes.md: its file runs, and each change has its effect."""

import runpy
from pathlib import Path

import numpy as np
import pytest

import bounce_mjx
from bounce_mjx.reports import figures
from bounce_mjx.reports.curves import read_curves
from bounce_mjx.runs import checkpoints

PAGE = Path(__file__).parents[1] / "docs/small-changes.md"
SHORT = {"num_envs": 8, "rollout_length": 8, "num_minibatches": 2, "hidden_layers": (16,)}
SHORT |= {"block_steps": 64, "total_steps": 256, "eval_every": 192, "save_every": 64}
SHORT |= {"eval_episodes": 4, "screening_episodes": 0, "episode_seconds": 0.5, "quiet": True}


@pytest.mark.slow
def test_each_small_change_has_its_effect(tmp_path: Path, monkeypatch, quick_compilation) -> None:
    blocks = PAGE.read_text(encoding="utf-8").split("```python\n")[1:]
    code = "\n\n".join(block.split("```")[0] for block in blocks)
    (tmp_path / "small.py").write_text(code.replace("episodes=64", "episodes=4"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(figures, "RUN_PLOTS", dict(figures.RUN_PLOTS))
    train, saved = bounce_mjx.train, []
    save = checkpoints.save_checkpoint

    def noted(run, config, steps, *args, **options):
        saved.append(steps)
        return save(run, config, steps, *args, **options)

    monkeypatch.setattr(checkpoints, "save_checkpoint", noted)
    monkeypatch.setattr(bounce_mjx, "train", lambda **given: train(**given | SHORT), raising=False)
    run = runpy.run_path("small.py", run_name="__main__")["run"]

    curves = read_curves(run.folder).curves
    scale = run.config.env.action_scale
    noise, targets = curves["policy/action_std"], curves["policy/target_std"]
    np.testing.assert_allclose(targets.values, scale * noise.values, rtol=1e-5)
    assert curves["low_targets/stable"].steps.tolist() == [192, 256]
    # The point of a block of one iteration is the rate at its beginning.
    rates = run.config.ppo.learning_rate * 0.5 ** (np.arange(4) * 64 / 1e6)
    np.testing.assert_allclose(curves["policy/learning_rate"].values, rates, rtol=1e-6)
    assert saved == [64, 128, 192, 256]
    assert ">Noise of the servo targets<" in (run.folder / "report.html").read_text()
