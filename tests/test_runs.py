"""Files of a run from elsewhere; each is valid or is refused in one sentence."""

import concurrent.futures
import dataclasses
import errno
import json
import os
import re
import shutil
import threading
import unittest.mock
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pydantic
import pytest
from pydantic import Field

from bounce_mjx import Run
from bounce_mjx.commands import train as train_command
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.config.user_code import import_code
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.results import Report, Result
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.model import fingerprint, load_model
from bounce_mjx.runs import creation
from bounce_mjx.runs import presets as presets_module
from bounce_mjx.runs.checkpoints import read_record
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.creation import create_run, save_config
from bounce_mjx.runs.folders import (
    best_checkpoint,
    choose_checkpoint,
    find_checkpoint,
    latest_checkpoint,
    place_or_newest,
)
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.runs.presets import preset_files
from bounce_mjx.runs.progress import Progress, load_results
from bounce_mjx.runs.storage import seal, to_json
from bounce_mjx.task import Proportional
from bounce_mjx.training import run as training_run
from bounce_mjx.world.config import ActionConfig
from tiny_runs import contents, settings_of

CATCH = resource_path("configs/catch/cpu.yaml")
DRIBBLE = Path(__file__).parents[1] / "examples/dribble_task.py"
NAMES = ("consecutive bounces", "horizontal position", "height", "upward speed", "stable")


def report_of(values: list[float | None]) -> Report:
    results = tuple(Result(n, "%", v, ">= 1", False) for n, v in zip(NAMES, values, strict=True))
    details = dict.fromkeys(("episodes", "mean_consecutive_bounces", "mean_return"), 1.0)
    return Report(results, details | {"mean_length_s": 2.0, "mean_apex_error_m": None})


def results_of(progress: Progress) -> dict:
    return progress.results(trained_steps=64, seconds={"train": 1.0}, device="cpu")


@pytest.fixture
def progress() -> Progress:
    progress = Progress()
    assert progress.add(report_of([1.0, 2.0, None, 4.0, 5.0]), 64, 0.0)
    return progress


def test_runs_started_at_once_have_folders_of_their_own(tmp_path: Path) -> None:
    number = 16
    start = threading.Barrier(number)

    def create(_) -> Path:
        start.wait()
        return create_run(TrainConfig(log_dir=tmp_path))

    with concurrent.futures.ThreadPoolExecutor(number) as pool:
        runs = list(pool.map(create, range(number)))
    assert len(set(runs)) == number
    assert all(load_run_config(run).log_dir == tmp_path for run in runs)


@pytest.fixture
def runs(tmp_path: Path, progress: Progress) -> Path:
    """A folder of runs: the first solved, the second not, the third without a checkpoint."""
    for name, passed in (("2026-01-01", True), ("2026-01-02", False), ("2026-01-03", None)):
        run = tmp_path / name
        run.mkdir()
        save_config(run, TrainConfig())
        if passed is not None:
            (run / "checkpoints/64").mkdir(parents=True)
            results = [dataclasses.replace(r, passed=passed) for r in progress.best.results]
            results[3] = dataclasses.replace(results[3], passed=None)
            progress.best = dataclasses.replace(progress.best, results=tuple(results))
            (run / "results.json").write_text(to_json(results_of(progress)))
    return tmp_path


@pytest.mark.parametrize("name", [None, Path("latest")])
def test_the_newest_run_is_introduced(runs: Path, name: Path | None, capsys) -> None:
    """A result that is not judged counts neither as met nor as missed."""
    assert choose_checkpoint(name, runs).run == runs / "2026-01-02"
    assert capsys.readouterr().out.splitlines() == [
        f"using the newest run: {runs}/2026-01-02 (0 of 4 judged results met)"
    ]


@pytest.mark.parametrize(
    ("mjcf", "arm"),
    [("package:some_arms/panda/robot.xml", "panda/robot.xml"), ("robot/heron.xml", "heron")],
)
def test_the_arm_of_the_newest_run_is_named(runs: Path, mjcf: str, arm: str, capsys) -> None:
    """The runs of all arms lie in the task's folder, and each has its own copy of its arm."""
    run = runs / "2026-01-02"
    (run / "robot").mkdir()
    (run / "robot/heron.xml").touch()
    seal(run / "robot")
    (run / "config.yaml").write_text(f"env: {{mjcf: '{mjcf}'}}")
    choose_checkpoint(None, runs)
    assert f"2026-01-02 of the arm {arm} (0 of 4" in capsys.readouterr().out


def test_latest_is_a_name_for_every_command(runs: Path, monkeypatch) -> None:
    monkeypatch.chdir(runs)
    for word in (Path("latest"), None):
        assert place_or_newest(word, runs) == runs / "2026-01-02"
    command = settings_of(["latest", "--log-dir", str(runs)])
    assert command.layers.start.place == runs / "2026-01-02"
    (runs / "latest").mkdir()
    assert place_or_newest(Path("latest"), runs) == Path("latest")


def test_the_newest_run_is_not_the_greatest_name(tmp_path: Path) -> None:
    """Time stamps count, whatever the copy's number or the words after them."""
    stamps = "2026-01-02_10-00-00", "2026-01-02_10-00-00_2", "2026-01-02_10-00-00_10"
    names = ["zebra", "2026-01-01_10-00-00", *stamps, "2026-01-04_10-00-00 long"]
    for name in sorted(names):
        (tmp_path / name / "checkpoints/64").mkdir(parents=True)
        save_config(tmp_path / name, TrainConfig())
    while names:
        assert place_or_newest(None, tmp_path).name == names.pop()
        shutil.rmtree(place_or_newest(None, tmp_path))


def test_a_run_is_opened_by_its_path_and_reads_its_policy_once(trained: Path, monkeypatch) -> None:
    """A program may ask for the policy in each of its steps."""
    # An earlier test of this process may have read it.
    training_run._read_policy.cache_clear()
    run, reads = Run(str(trained)), []
    monkeypatch.setattr(training_run, "read_actor", counted(training_run.read_actor, reads))
    observation = np.zeros(run.config.env.layout.size, np.float32)
    actions = [run.policy(observation) for _ in range(2)]
    assert run.folder == trained and run.results == load_results(trained).best
    assert run.checkpoint == find_checkpoint(str(trained)) == find_checkpoint(trained)
    assert actions[0].shape == (6,) and np.array_equal(*actions) and len(reads) == 1
    checkpoint = Run(run.checkpoint.folder)
    assert (checkpoint.config, checkpoint.checkpoint) == (run.config, run.checkpoint)
    for attribute in ("config", "checkpoint", "policy"):
        with pytest.raises(UserError, match="is a folder of runs; give one of them, such as"):
            getattr(Run(trained.parent), attribute)


def counted(function: Callable, calls: list) -> Callable:
    def count(*arguments):
        calls.append(arguments)
        return function(*arguments)

    return count


@pytest.mark.parametrize("key", ["env.estimator", "ppo.min_noise_std", "num_robots"])
def test_a_config_of_another_version_is_one_sentence(key: str, tmp_path: Path) -> None:
    """And not a guess at what the user has mistyped."""
    *groups, name = key.split(".")
    (tmp_path / "config.yaml").write_text(
        "".join(f"{g}: {{" for g in groups) + f"{name}: 1" + "}" * len(groups)
    )
    with pytest.raises(UserError, match=f"has the setting {key}, .*another version.*; train again"):
        load_run_config(tmp_path)


def test_checkpoints_of_another_version_are_one_sentence(runs: Path) -> None:
    """Of the folders and of the records of one that came before."""
    run = runs / "2026-01-02"
    folder = run / "checkpoints/64"
    (folder / "run.json").write_text("{}")
    with pytest.raises(UserError, match="checkpoints/64 is damaged or of another version .*; give"):
        read_record(find_checkpoint(run))
    folder.rename(run / "checkpoints/best")
    with pytest.raises(UserError, match="no checkpoint, .* or another version wrote it; start"):
        find_checkpoint(run)


def test_a_run_without_a_checkpoint_is_told_as_such(runs: Path) -> None:
    for find in (latest_checkpoint, best_checkpoint, find_checkpoint):
        with pytest.raises(UserError, match="2026-01-03 has no checkpoint, .*; start again"):
            find(runs / "2026-01-03")


@pytest.fixture
def robot_run(tmp_path: Path) -> Path:
    """A run of a robot whose MJCF includes a file and has a mesh in another folder; the original
    files are gone."""
    original = tmp_path / "original"
    for folder in ("mjcf", "meshes"):
        (original / folder).mkdir(parents=True)
    text = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
    text, count = re.subn("<worldbody>", '<include file="more.xml"/><worldbody>', text, count=1)
    assert count == 1
    (original / "mjcf/my robot.xml").write_text(text, encoding="utf-8")
    (original / "mjcf/more.xml").write_text(
        '<mujoco><compiler meshdir="../meshes"/><asset><mesh name="m" file="m.obj"/></asset>'
        '<worldbody><geom type="mesh" mesh="m" pos="9 9 9"/></worldbody></mujoco>'
    )
    faces = "f 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n"
    (original / "meshes/m.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n{faces}")
    config = TrainConfig(env={"mjcf": original / "mjcf/my robot.xml"}, log_dir=tmp_path / "runs")
    run = create_run(config)
    shutil.rmtree(original)
    return run


def test_a_run_has_a_copy_of_its_robot(robot_run: Path, tmp_path: Path, monkeypatch) -> None:
    """The copy is used wherever the run is moved, and is not copied again by a resumed training."""
    moved = tmp_path / "moved"
    robot_run.rename(moved)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other").mkdir()
    for run in (moved, Path("moved"), Path("other/../moved")):
        env = load_run_config(run).env
        assert env.mjcf == moved / "robot/mjcf/my robot.xml"
        assert load_model(env.mjcf, 0.001).nmesh == 1
        before = contents(moved)
        save_config(run, load_run_config(run))
        assert contents(moved) == before
    # The config is a preset too, for a new run.
    assert read_preset(moved / "config.yaml").env.mjcf == env.mjcf


def test_a_robot_of_a_package_is_copied(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "some_robots").mkdir()
    (tmp_path / "some_robots/__init__.py").touch()
    shutil.copy(resource_path("mjcf/bounce_ball.xml"), tmp_path / "some_robots")
    monkeypatch.syspath_prepend(tmp_path)
    packaged = Path("package:some_robots/bounce_ball.xml")
    (tmp_path / "my.yaml").write_text(f"env: {{mjcf: '{packaged}'}}")
    config = read_preset(tmp_path / "my.yaml")
    assert config.env.mjcf == packaged
    run = create_run(config.model_copy(update={"log_dir": tmp_path / "runs"}))
    assert load_run_config(run).env.mjcf == run / "robot/bounce_ball.xml"
    copy = load_model(run / "robot/bounce_ball.xml", 0.001)
    assert fingerprint(copy) == fingerprint(load_model(packaged, 0.001))


def test_an_absolute_path_in_a_robot_is_refused(tmp_path: Path) -> None:
    """The copy would use the original file."""
    text = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
    named, mjcf = tmp_path / "more.xml", tmp_path / "own/robot.xml"
    mjcf.parent.mkdir()
    named.write_text("<mujoco><size/></mujoco>")
    include = f'<include file="{named}"/><worldbody>'
    mjcf.write_text(text.replace("<worldbody>", include, 1), encoding="utf-8")
    assert load_model(mjcf, 0.001).nmesh == 0
    with pytest.raises(UserError, match=f"names {named} by an absolute path"):
        create_run(TrainConfig(env={"mjcf": mjcf}, log_dir=tmp_path / "runs"))
    assert not list((tmp_path / "runs").iterdir())


def test_an_edited_copy_of_the_robot_is_refused(robot_run: Path, refused) -> None:
    name = "meshes/m.obj"
    with (robot_run / "robot" / name).open("a") as file:
        file.write("\n")
    words = f"{robot_run}/robot is not the robot", f"{name} is not as it was"
    refused(["train", robot_run], *words)
    # Every other command reads the config in the same way.
    with pytest.raises(UserError, match="restore that folder"):
        load_run_config(robot_run)


def test_a_preset_has_a_name(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert read_preset(Path("seed")) == read_preset(resource_path("configs/seed.yaml"))
    with pytest.raises(UserError, match="no preset is named sead; give one of"):
        read_preset(Path("sead"))
    robots = (
        read_preset(Path("seed"), Path("ur5e")),
        read_preset(Path("seed"), resource_path("configs/robots/ur5e.yaml")),
    )
    assert robots[0] == robots[1] != read_preset(Path("seed"))
    (tmp_path / "seed").write_text("seed: 7")
    assert read_preset(Path("seed")).seed == 7


def test_a_task_has_its_own_preset_of_a_name(tmp_path: Path, monkeypatch) -> None:
    for name, seed in (("cpu", 1), ("bounce/cpu", 2), ("seed", 3)):
        file = tmp_path / "configs" / f"{name}.yaml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"seed: {seed}")
    monkeypatch.setattr(presets_module, "resource_path", lambda name: tmp_path / name)
    monkeypatch.setattr(presets_module, "has_accelerator", lambda: False)
    assert read_preset(None).seed == read_preset(Path("cpu"), task="bounce").seed == 2
    assert read_preset(Path("seed")).seed == 3
    import_code(DRIBBLE)
    assert read_preset(None, task="dribble").seed == 1


@pytest.fixture
def presets(tmp_path: Path, monkeypatch) -> Path:
    """A working directory on a machine without an accelerator, with a preset of the user's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(presets_module, "has_accelerator", lambda: False)
    (tmp_path / "my.yaml").write_text("ppo: {learning_rate: 0.001}")
    return tmp_path


def read_file(folder: Path, text: str) -> TrainConfig:
    (folder / "given.yaml").write_text(text)
    return read_preset(Path("given.yaml"))


def test_a_file_of_the_user_lies_on_the_preset_of_its_task(presets: Path) -> None:
    assert read_file(presets, "").ppo == read_preset(Path("cpu")).ppo
    given = read_file(presets, "ppo: {learning_rate: 0.001}").ppo
    cpu = read_preset(Path("cpu")).ppo
    assert given == cpu.model_copy(update={"learning_rate": 0.001}) != cpu
    assert read_file(presets, "task: track") == read_preset(Path("cpu"), task="track")
    with pytest.raises(UserError, match="given.yaml is of the task track, and .* first word, or"):
        read_preset(Path("given.yaml"), task="bounce")
    assert read_file(presets, "base: randomized") == read_preset(Path("randomized"))
    alone = read_file(presets, "base: null\nseed: 3")
    assert alone == TrainConfig(seed=3)
    with pytest.raises(UserError, match="given.yaml: base is 'nope'; give the name of a preset"):
        read_file(presets, "base: nope")
    on_gpu = read_preset(Path("my.yaml"), machine=Path("default"))
    assert on_gpu.ppo.num_envs == read_preset(Path("default")).ppo.num_envs != cpu.num_envs


def test_a_run_keeps_its_settings_as_a_preset(presets: Path) -> None:
    config = TrainConfig(seed=3, total_steps=1000, log_dir=presets)
    run = create_run(config)
    assert load_run_config(run) == read_preset(run / "config.yaml") == config
    # A setting that a later version adds must not come from the preset.
    text = (run / "config.yaml").read_text().replace("stop_when_solved: false\n", "")
    assert not read_file(presets, text).stop_when_solved


def test_files_of_the_user_lie_on_each_other(presets: Path) -> None:
    (presets / "more.yaml").write_text("ppo: {learning_rate: 0.002, discount: 0.9}")
    orders = {
        "--config my.yaml --config=more.yaml": 0.002,
        "--config more.yaml --config my.yaml": 0.001,
    }
    for flags, rate in orders.items():
        config = settings_of(flags.split()).config
        assert config.ppo.learning_rate == rate and config.ppo.discount == 0.9
        assert config.ppo.num_envs == read_preset(None).ppo.num_envs
        files = train_command.read_command(flags.split()).flags.config
        cpu, named, given = preset_files(files, config.task)
        assert [file.path for file in cpu] == [resource_path("configs/cpu.yaml")] and not named
        words = flags.replace("--config=", "").replace("--config ", "")
        assert " ".join(str(file.path) for file in given) == words
    (presets / "more.yaml").write_text("base: randomized")
    with pytest.raises(UserError, match="more.yaml lies on my.yaml, so its base is not used"):
        read_preset([Path("my.yaml"), Path("more.yaml")])


def test_a_run_that_cannot_be_written_leaves_no_folder(tmp_path: Path, monkeypatch) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(creation, "write_atomically", unittest.mock.Mock(side_effect=full))
    with pytest.raises(UserError, match="cannot be written .No space left on device"):
        create_run(TrainConfig(log_dir=tmp_path))
    assert not list(tmp_path.iterdir())


def test_a_group_given_in_part_keeps_its_other_defaults(tmp_path: Path) -> None:
    """Those of the task, where they differ from those of the group's class."""
    file = tmp_path / "preset.yaml"
    file.write_text(
        "task: catch\nenv: {action: {max_lead: 0.2}, reward: {action_rate: {}, fall: {scale: 0.3}}}"
    )
    env = read_preset(file).env
    default = read_preset(CATCH).env
    assert env.action.base == "target" and env.action.max_lead == 0.2
    assert env.reward.fall.scale == 0.3 and env.reward.action_rate == default.reward.action_rate
    assert default.reward.action_rate != Proportional()
    # Also a default that is made anew.
    made = Field(default_factory=lambda: ActionConfig(base="target", max_lead=0.3))
    own = pydantic.create_model("Own", __base__=StrictModel, action=(ActionConfig, made))
    action = own.model_validate({"action": {"max_lead": 0.2}}).action
    assert action == ActionConfig(base="target", max_lead=0.2)


def test_whole_numbers_may_have_an_exponent(tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    path.write_text("total_steps: 1e6\nppo: {num_envs: 2e2, hidden_layers: [1.6e1, 8]}\nseed: 1e0")
    config = read_preset(path)
    assert (config.total_steps, config.ppo.num_envs, config.seed) == (10**6, 200, 1)
    assert config.ppo.hidden_layers == (16, 8)
    for bad in ("1e-1", "1.5e0", "1e400", "1e13"):
        path.write_text(f"total_steps: {bad}")
        with pytest.raises(UserError, match="total_steps is"):
            read_preset(path)


def test_results_are_read_as_they_were_written(tmp_path: Path, progress: Progress) -> None:
    (tmp_path / "results.json").write_text(to_json(results_of(progress)))
    results = load_results(tmp_path)
    assert results.evaluations == [
        {"steps": 64, "passed": False, "screening": False}
        | dict(zip(NAMES, [1.0, 2.0, None, 4.0, 5.0], strict=True))
    ]
    assert results.best == progress.best
    assert Progress.model_validate(json.loads(to_json(progress.model_dump()))) == progress


@pytest.mark.parametrize("change", [None, {"results": [3]}])
def test_results_of_another_shape(tmp_path: Path, progress: Progress, change) -> None:
    path = tmp_path / "results.json"
    path.write_text(json.dumps(results_of(progress) | change if change else []))
    with pytest.raises(UserError, match=rf"^{path} is damaged \(.*delete it to continue") as found:
        load_results(tmp_path)
    assert len(str(found.value)) < 500 and "http" not in str(found.value)
