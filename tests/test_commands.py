"""The commands: the files that they write, and their messages after mistakes."""

import contextlib
import io
import json
import os
import pwd
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest
import tyro
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import bounce_mjx
from bounce_mjx.commands import eval as eval_command
from bounce_mjx.commands import train as train_command
from bounce_mjx.commands.main import COMMANDS
from bounce_mjx.commands.main import main as console_script
from bounce_mjx.config import command_line
from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import Policy
from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import TrainConfig, load_config, load_run_config
from bounce_mjx.runs.folders import (
    latest_checkpoint,
    newest_run,
    pretrained_checkpoint,
)
from bounce_mjx.runs.reading import read_policy
from bounce_mjx.task import term_names
from bounce_mjx.tasks.bounce_rewards import BounceReward
from bounce_mjx.training.setup import set_up_jax
from tiny_runs import STEPS, TINY, TRAIN_SCRIPT, arrays, contents

RESULT_NAMES = ("consecutive bounces", "horizontal position", "height", "upward speed", "stable")

Fails = Callable[..., str]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of 256 steps, in `runs/bounce_ball` of a working directory."""
    log_dir = tmp_path_factory.mktemp("trained") / "runs" / "bounce_ball"
    train_command.main([*TINY, "--total-steps", str(STEPS), "--log-dir", str(log_dir)])
    (run,) = log_dir.iterdir()
    return run


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may damage, in the working directory of `fails`."""
    return shutil.copytree(trained, tmp_path / "run")


@pytest.fixture
def fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd) -> Fails:
    """A function (main, arguments) -> the sentence with which the command refuses the arguments.
    The command runs in an empty directory, which it must leave unchanged.
    """
    monkeypatch.chdir(tmp_path)

    def call(main: Callable[[list[str]], None], args: list[str]) -> str:
        before = contents(tmp_path)
        capfd.readouterr()
        with pytest.raises(SystemExit) as exit_info:
            main([str(arg) for arg in args])
        out, err = capfd.readouterr()
        assert exit_info.value.code == 2
        assert "Traceback" not in out
        assert re.fullmatch(r"error: .+\n", err), err
        assert contents(tmp_path) == before
        return err

    return call


def assert_says(sentence: str, words: tuple[str, ...]) -> None:
    missing = [word for word in words if word not in sentence]
    assert not missing, sentence


BAD_FLAGS = {
    "unknown flag": ("--zzz 3", "--zzz", "--help"),
    "near miss": ("--num-envz 3", "--num-envz", "did you mean --num-envs?"),
    "near miss of a term": (
        "--reward.height.wieght 3",
        "--reward.height.wieght",
        "did you mean --reward.height.weight?",
    ),
    "near miss of a switch": ("--no-stop-if-solved", "did you mean --no-stop-when-solved?"),
    "with its group": ("--ppo.num-envs 3", "did you mean --num-envs?"),
    "stray word": ("seed.yaml", "seed.yaml", "--help"),
    "no environments": ("--num-envs 0", "--num-envs is 0", "greater than or equal to 1"),
    "not a number": ("--num-envs abc", "--num-envs is abc", "integer"),
    "not a number after =": ("--num_envs=abc --seed 3", "--num-envs is abc", "integer"),
    "fraction": ("--num-envs 1.5", "--num-envs is 1.5", "integer"),
    "minibatches": (
        "--num-envs 8 --rollout-length 8 --num-minibatches 7",
        "num_minibatches 7",
        "64 samples",
        "choose a divisor of 64",
    ),
    "targets reversed": ("--target-height-range 0.6 0.4", "(0.6, 0.4)", "lower end first"),
    "one target": ("--target-height-range 0.6", "--target-height-range is 0.6", "item is missing"),
    "target below the floor": ("--target-height-range -1 0.4", "is -1,", "greater than 0 m"),
    "target nan": ("--target-height-range nan 0.4", "is nan", "greater than 0 m"),
    "control step": ("--control-dt 0.0105", "control_dt 0.0105", "multiple of physics_dt"),
    "short episode": ("--episode-seconds 0.001", "episode_seconds 0.001", "longer episode"),
    "rollout longer than an episode": (
        "--num-envs 8 --rollout-length 8 --episode-seconds 0.05",
        "rollout_length 8",
        "5 control steps",
        "shorter rollout",
    ),
    "scale nan": ("--action-scale nan", "--action-scale is nan", "0 rad"),
    "angle nan": ("--default-joint-angles 0 0 nan 0 0 0", "--default-joint-angles", "finite"),
    "ball at infinity": ("--ball-init-pos 0 0 inf", "--ball-init-pos is inf", "finite"),
    "weight nan": ("--reward.height.weight nan", "--reward.height.weight is nan", "finite"),
    "width zero": ("--reward.height.scale 0", "--reward.height.scale is 0,", "greater than 0"),
    "negative noise": ("--reset.joint-angles -0.1", "--reset.joint-angles is -0.1", "equal to 0"),
    "negative rate": ("--learning-rate -1", "--learning-rate is -1,", "greater than 0"),
    "discount": ("--discount 1.5", "--discount is 1.5", "less than or equal to 1"),
    "negative seed": ("--seed -1", "--seed is -1", "greater than or equal to 0"),
    "no layers": ("--hidden-layers", "--hidden-layers is empty", "at least 1 item"),
    "empty layer": ("--hidden-layers 16 0", "--hidden-layers is 0", "equal to 1"),
    "unknown engine": ("--physics warp", "--physics is warp", "'fused'"),
    "preset and resume": ("--config a.yaml --resume b", "--config", "--resume", "combined"),
    "preset missing": ("--config a.yaml", "a.yaml", "No such file", "configs/default.yaml"),
    "no such preset": ("--config nope", "no preset is named nope", "cpu, default, finetune"),
    "no such robot": ("--robot nope", "no robot is named nope", "iiwa, panda, peitian, ur5e"),
    "run missing": ("--resume nowhere", "nowhere", "give a run's folder"),
    "MJCF missing": ("--mjcf a.xml", "a.xml", "does not exist", "give the path"),
}


@pytest.mark.parametrize("case", BAD_FLAGS.values(), ids=BAD_FLAGS)
def test_bad_flag(fails: Fails, case: tuple[str, ...]) -> None:
    flags, *words = case
    assert_says(fails(train_command.main, flags.split()), words)


def test_a_flag_without_its_value_is_named(capfd) -> None:
    with pytest.raises(SystemExit) as exit_info:
        train_command.main(["--num-envs", "--seed", "3"])
    assert exit_info.value.code == 2
    assert "Missing value for argument '--num-envs'" in capfd.readouterr().err


BAD_YAML = {
    "list": (b"- 1\n", "a list", "mapping", "configs/default.yaml"),
    "no YAML": (b"ppo: [1\nseed: {", "cannot be read", "line 2", "configs/default.yaml"),
    "binary": (bytes(range(256)), "cannot be read", "utf-8", "configs/default.yaml"),
    "key twice": (
        b"ppo: {num_envs: 8}\nenv: {}\nppo: {discount: 0.9}",
        "the key ppo appears twice, in lines 1 and 3; join the two",
    ),
    "unknown key": (b"zzz: 3", "unknown key zzz", "known keys here are", "total_steps"),
    "near miss": (b"ppo: {num_env: 3}", "unknown key ppo.num_env;", "did you mean ppo.num_envs?"),
    "deep near miss": (
        b"env: {reward: {height: {wieght: 3}}}",
        "env.reward.height.wieght",
        "did you mean env.reward.height.weight?",
    ),
    "wrong level": (b"num_envs: 3", "unknown key num_envs", "did you mean ppo.num_envs?"),
    "number as a key": (b"1: 2", "unknown key 1", "known keys here are"),
    "group missing": (b"ppo: 3", "ppo is 3", "valid dictionary"),
    "no environments": (b"ppo: {num_envs: 0}", "ppo.num_envs is 0", "equal to 1"),
    "minibatches": (
        b"ppo: {num_envs: 8, rollout_length: 8, num_minibatches: 7}",
        "ppo: num_minibatches 7",
        "choose a divisor of 64",
    ),
    "nan": (b"env: {action_scale: .nan}", "env.action_scale is nan", "0 rad"),
    "word": (b"env: {default_joint_angles: [a, 0, 0, 0, 0, 0]}", "'a'", "valid number"),
    "too few": (b"env: {target_height_range: [0.4]}", "[0.4]", "item is missing"),
    "too many": (b"env: {target_height_range: [0.4, 0.5, 0.6]}", "0.6]", "at most 2 items"),
    "no list": (b"env: {target_height_range: 0.4}", "target_height_range is 0.4", "tuple"),
    "no layers": (b"ppo: {hidden_layers: []}", "ppo.hidden_layers is []", "at least 1 item"),
    "unknown engine": (b"env: {physics: warp}", "env.physics is 'warp'", "'fused'"),
}


@pytest.mark.parametrize("case", BAD_YAML.values(), ids=BAD_YAML)
def test_bad_config_file(fails: Fails, tmp_path: Path, case: tuple) -> None:
    text, *words = case
    (tmp_path / "my.yaml").write_bytes(text)
    assert_says(fails(train_command.main, ["--config", "my.yaml"]), ["my.yaml", *words])


def test_a_path_that_libraries_would_misspell_is_refused(fails: Fails, tmp_path: Path) -> None:
    name = os.fsdecode(b"a\xff")
    shutil.copyfile(resource_path("mjcf/bounce_ball.xml"), tmp_path / f"{name}.xml")
    (tmp_path / name).mkdir()
    (tmp_path / name / "config.yaml").write_text("seed: 1")
    for main, args in (
        (train_command.main, [*TINY, "--log-dir", name]),
        (train_command.main, [*TINY, "--mjcf", f"{name}.xml"]),
        (train_command.main, ["--resume", name]),
        (eval_command.main, [name]),
    ):
        assert_says(fails(main, args), ("a\\udcff", "is not UTF-8", "rename"))
    code = "import pathlib, bounce_mjx.files; bounce_mjx.files.check_name(pathlib.Path('{}'))"
    unlike_utf8 = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    for word, environment, status in (
        ("caf\\xe9", unlike_utf8, 1),
        ("cafe", unlike_utf8, 0),
        ("caf\\xe9", {"PYTHONUTF8": "1"}, 0),
    ):
        command = [sys.executable, "-c", code.format(word)]
        done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True)
        assert done.returncode == status, done.stderr
        assert status == 0 or "or the locale of this process is not" in done.stderr


def test_flag_is_validated_on_top_of_the_config_file(fails: Fails, tmp_path: Path) -> None:
    (tmp_path / "my.yaml").write_text("ppo: {num_envs: 8, rollout_length: 8, num_minibatches: 4}")
    sentence = fails(train_command.main, "--config my.yaml --num-envs 9 --rollout-length 5".split())
    assert_says(sentence, ("num_minibatches 4", "45 samples", "choose a divisor of 45"))


MJCF = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
BAD_MJCF = {
    "text": ("hello", "does not compile", "correct it"),
    "paddle": (MJCF.replace('"blocker"', '"bat"'), "no geom named blocker", "needs the names"),
    "ball": (MJCF.replace('"ball_link"', '"ball"'), "no body named ball_link", "needs the names"),
    "actuator": (
        re.sub(r'<position [^>]*joint="Joint2"[^>]*/>', "", MJCF),
        "default_joint_angles has 6 numbers",
        "5 joints with an actuator (Joint1, Joint3",
    ),
    "motor": (
        re.sub(r'<position [^>]*joint="Joint2"[^>]*/>', '<motor joint="Joint2"/>', MJCF),
        "an actuator on Joint2 that is not a position servo",
        '<position joint="Joint2"/>',
    ),
}


@pytest.mark.parametrize("case", BAD_MJCF.values(), ids=BAD_MJCF)
def test_bad_mjcf(fails: Fails, tmp_path: Path, case: tuple[str, ...]) -> None:
    text, *words = case
    assert text != MJCF
    (tmp_path / "my.xml").write_text(text, encoding="utf-8")
    assert_says(fails(train_command.main, ["--mjcf", "my.xml"]), ["my.xml", *words])


@pytest.mark.parametrize("log_dir", ["file", "file/inside"])
def test_log_dir_that_cannot_be_made(fails: Fails, tmp_path: Path, log_dir: str) -> None:
    (tmp_path / "file").write_text("mine")
    sentence = fails(train_command.main, [*TINY, "--log-dir", log_dir])
    assert_says(sentence, (f"in {log_dir} ", "choose", "--log-dir"))


BAD_EVAL_FLAGS = {
    "unknown flag": ("--num-envs 3", "--num-envs", "--help"),
    "near miss": ("--target-hight 0.5", "did you mean --target-height?"),
    "near miss of a renamed flag": ("--jsn a", "did you mean --json?"),
    "no episodes": ("--episodes 0", "--episodes is 0", "equal to 1"),
    "target below the floor": ("--target-height -1", "--target-height is -1.0", ">= 0.001"),
    "target nan": ("--target-height nan", "--target-height is nan", "finite"),
    "unknown engine": ("--physics warp", "--physics", "'mujoco'", "warp"),
    "json in no folder": ("--json nowhere/a.json", "nowhere/a.json", "make it"),
    "json is a folder": ("--json .", "is a folder", "give a file"),
    "checkpoint missing": ("nowhere", "nowhere", "give a run's folder", "pretrained, robust, "),
    "no runs": ("--log-dir mine", "no run", "in mine", "bounce-mjx train"),
    "no run": (".", "config.yaml", "give a folder that bounce-mjx train made"),
}


@pytest.mark.parametrize("case", BAD_EVAL_FLAGS.values(), ids=BAD_EVAL_FLAGS)
def test_bad_eval_flag(fails: Fails, case: tuple[str, ...]) -> None:
    flags, *words = case
    assert_says(fails(eval_command.main, flags.split()), words)


def test_run_without_checkpoint(fails: Fails, run: Path) -> None:
    shutil.rmtree(run / "checkpoints")
    assert_says(fails(eval_command.main, ["run"]), ("run", "no checkpoint", "give another"))
    assert_says(fails(train_command.main, ["--resume", "run"]), ("run", "no checkpoint", "give"))


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def zero(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def empty(path: Path) -> None:
    path.write_bytes(b"")


DAMAGES = {
    "index halved": ("manifest.ocdbt", halve),
    "index deleted": ("manifest.ocdbt", Path.unlink),
    "arrays halved": ("**/d/*", halve),
    "arrays emptied": ("**/d/*", empty),
    "arrays zeroed": ("**/d/*", zero),
    "arrays deleted": ("**/d/*", Path.unlink),
    "all deleted": ("", shutil.rmtree),
}


def damage(item: Path, pattern: str, how: Callable[[Path], None]) -> None:
    paths = list(item.glob(pattern)) if pattern else [item]
    assert paths
    for path in paths:
        how(path)


@pytest.mark.parametrize("case", DAMAGES.values(), ids=DAMAGES)
def test_damaged_checkpoint_is_not_evaluated(fails: Fails, run: Path, case: tuple) -> None:
    damage(run / f"checkpoints/{STEPS}/policy", *case)
    sentence = fails(eval_command.main, [f"run/checkpoints/{STEPS}"])
    assert_says(sentence, (f"run/checkpoints/{STEPS}", "damaged", "give another"))


@pytest.mark.parametrize("name", ["arrays halved", "index deleted"])
def test_damaged_checkpoint_is_not_resumed(fails: Fails, run: Path, name: str) -> None:
    damage(run / f"checkpoints/{STEPS}/training", *DAMAGES[name])
    sentence = fails(train_command.main, ["--resume", "run", "--total-steps", "512"])
    assert_says(sentence, (f"run/checkpoints/{STEPS}", "damaged", "give another"))


@pytest.mark.parametrize("layers", ["[8]", "[16, 16]"])
def test_checkpoint_of_another_network(fails: Fails, run: Path, layers: str) -> None:
    config = run / "config.yaml"
    text = re.sub(r"hidden_layers:\n(  - \d+\n)+", f"hidden_layers: {layers}\n", config.read_text())
    config.write_text(text)
    assert load_config(config).ppo.hidden_layers == tuple(json.loads(layers))
    assert_says(
        fails(eval_command.main, ["run"]), ("different config", "run/config.yaml", "restore")
    )


def test_damaged_config_of_a_run(fails: Fails, run: Path) -> None:
    (run / "config.yaml").write_text("ppo: {num_envs: 0}")
    assert_says(fails(eval_command.main, ["run"]), ("run/config.yaml", "ppo.num_envs is 0"))


RESUME_CHANGES = {
    "ppo.num_envs": "--num-envs 16",
    "env.reward.height.weight": "--reward.height.weight 1",
    "seed": "--seed 7",
    "block_steps": "--block-steps 128",
}


@pytest.mark.parametrize("key", RESUME_CHANGES)
def test_resume_cannot_change_the_shapes_of_the_state(fails: Fails, run: Path, key: str) -> None:
    sentence = fails(train_command.main, ["--resume", "run", *RESUME_CHANGES[key].split()])
    assert_says(sentence, (f"cannot change {key};", "leave those flags out"))


@pytest.mark.parametrize(
    "command",
    [
        [TRAIN_SCRIPT, "--num-envs", "0"],
        [TRAIN_SCRIPT, "--config", "my.yaml"],
        ["-m", "bounce_mjx.eval", "--episode", "3"],
    ],
    ids=["train", "config", "eval"],
)
def test_whole_process_exits_without_a_traceback(tmp_path: Path, command: list) -> None:
    (tmp_path / "my.yaml").write_text("ppo: {num_env: 8}")
    done = subprocess.run(
        [sys.executable, *map(str, command)], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert re.fullmatch(r"error: .+\n", done.stderr), done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["my.yaml"]


def test_whole_process_exits_without_a_traceback_on_a_damaged_checkpoint(run: Path) -> None:
    damage(run / f"checkpoints/{STEPS}/policy", *DAMAGES["arrays halved"])
    done = subprocess.run(
        [sys.executable, "-m", "bounce_mjx.eval", f"run/checkpoints/{STEPS}"],
        cwd=run.parent,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert re.fullmatch(r"error: .+\n", done.stderr), done.stderr


def test_path_that_the_output_cannot_encode() -> None:
    program = (
        "from bounce_mjx.errors import exit_on_user_error\n"
        "with exit_on_user_error(): print('runs/f\\xfcr_alle')"
    )
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True)
    assert done.stdout == rb"runs/f\xfcr_alle" + os.linesep.encode(), done.stderr


def test_a_user_without_a_home_has_no_cache(monkeypatch) -> None:
    """As in a container whose user is a number without a name."""

    def unknown(number: int) -> NoReturn:
        raise KeyError(number)

    for name in ("HOME", "XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    chosen = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        set_up_jax()
        assert jax.config.jax_compilation_cache_dir is None
    finally:
        jax.config.update("jax_compilation_cache_dir", chosen)


@pytest.mark.parametrize("main", [train_command.main, eval_command.main], ids=["train", "eval"])
def test_help(main: Callable[[list[str]], None], capsys) -> None:
    with pytest.raises(SystemExit) as exit_info:
        main(["--help"])
    assert exit_info.value.code == 0
    flag = "--num-envs" if main is train_command.main else "--target-height"
    assert flag in capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_plain_forms_and_no_empty_default(command: str, monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        console_script([command, "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", "").split())
    assert "usage: " in shown
    for oddity in ("None}", "{None", "[[", "...]]", "(default: )", "(default: None)", "{True"):
        assert oddity not in shown


def test_help_shows_the_form_of_each_kind_of_value(monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")

    class Inner(StrictModel):
        pair: tuple[float, float] | None = (1.0, 2.0)
        """A pair
        of numbers."""

    class Command(StrictModel):
        files: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
        path: Path | None = None
        counts: tuple[int, ...] = (3, 4)
        limits: tuple[float | None, ...] | None = None
        shares: dict[str, float] | None = None
        kind: Literal["a", "b"] | None = None
        switch: bool = True
        inner: Inner = Inner()

    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), pytest.raises(SystemExit):
        parse(Command, ["--help"], prog="it")
    assert "A pair of numbers." in shown.getvalue(), "a docstring's line break remains"
    text = " ".join(shown.getvalue().replace("│", "").split())
    for form in (
        "[PATH ...]",
        "--path PATH",
        "--counts INT ... (default: 3 4)",
        "--limits FLOAT ...",
        "--shares STR FLOAT ...",
        "--kind {a,b}",
        "--switch, --no-switch (default: True)",
        "--inner.pair FLOAT FLOAT A pair of numbers. (default: 1.0 2.0)",
    ):
        assert form in text, form
    command = parse(Command, ["--inner.pair", "None", "--limits", "1", "None"], prog="it")
    assert command.inner.pair is None and command.limits == (1.0, None)
    assert parse(Command, ["a", "b"], prog="it").files == (Path("a"), Path("b"))


def test_training_ends_at_the_whole_block_nearest_to_its_steps(tmp_path: Path, capsys) -> None:
    """170 steps are 2.66 blocks of 64, and 80 are 1.25; the training says how many it makes."""
    for given, trained in ((170, 192), (80, 64)):
        log_dir = tmp_path / str(given)
        flags = ["--total-steps", str(given), "--log-dir", str(log_dir), "--no-report"]
        train_command.main([*TINY, *flags])
        assert f"steps: {trained}, in blocks of 64\n" in capsys.readouterr().out
        (results,) = log_dir.glob("*/results.json")
        assert json.loads(results.read_text())["trained_steps"] == trained


@pytest.mark.parametrize(
    ("compiling", "seconds", "said"),
    [
        # The rest of a short evaluation takes less than 10 s, however long it compiled.
        (60.0, 8.0, []),
        (0.0, 8.0, []),
        (60.0, 80.0, ["30% evaluated", "50% evaluated", "70% evaluated"]),
    ],
)
def test_an_evaluation_in_a_pipe_says_only_what_is_worth_a_line(
    monkeypatch, compiling: float, seconds: float, said: list[str]
) -> None:
    now = 0.0
    monkeypatch.setattr(command_line.time, "monotonic", lambda: now)
    shown = io.StringIO()
    with command_line.progress(Console(file=shown), "evaluating", "evaluated") as progress:
        for share in (0.1, 0.3, 0.5, 0.7, 0.9, 1.0):
            now = compiling + share * seconds
            progress(share)
    assert shown.getvalue().splitlines() == said


def test_presets_are_valid() -> None:
    found = resource_path("configs").glob("*.yaml")
    files = {p.stem: p for p in found if not p.stem.startswith("robustness")}
    presets = {name: load_config(path) for name, path in files.items()}
    assert {"default", "cpu", "seed"} <= presets.keys()
    seed = presets["seed"]
    assert seed.total_steps == 50_000_000
    assert (seed.ppo.num_envs, seed.ppo.rollout_length) == (1024, 128)
    assert (seed.ppo.num_epochs, seed.ppo.num_minibatches) == (15, 16)
    assert seed.ppo.learning_rate == 2e-4
    assert seed.ppo.hidden_layers == (512, 512, 512)


def test_run_keeps_the_resolved_config(trained: Path) -> None:
    kept = load_config(trained / "config.yaml")
    command = train_command.read_command([*TINY, "--total-steps", str(STEPS)])
    for key in TrainConfig.model_fields.keys() - {"log_dir"}:
        assert getattr(kept, key) == getattr(command, key), key
    assert kept.log_dir == trained.parent


def test_run_holds_both_checkpoints_and_the_results(trained: Path) -> None:
    results = json.loads((trained / "results.json").read_text())
    assert results["trained_steps"] == STEPS
    assert results["solved_steps"] is None and results["passed"] is False
    assert results["version"] == bounce_mjx.__version__
    head = (trained / "config.yaml").read_text().splitlines()[0]
    assert head == f"# bounce_mjx {bounce_mjx.__version__}"
    kept = {int(path.name) for path in (trained / "checkpoints").iterdir()}
    assert kept == {STEPS, results["best_steps"]}
    assert tuple(result["name"] for result in results["results"]) == RESULT_NAMES


def test_run_logs_to_tensorboard(trained: Path) -> None:
    """A result without a figure, such as the height without a bounce, has no point in the log."""
    log = EventAccumulator(str(trained)).Reload()
    evaluations = json.loads((trained / "results.json").read_text())["evaluations"]
    measured = {name for name in RESULT_NAMES if any(e[name] is not None for e in evaluations)}
    assert measured >= {"consecutive bounces", "stable"}
    expected = {
        "episode/return",
        "episode/length",
        "loss/policy",
        "loss/value",
        "policy/kl",
        "policy/learning_rate",
        "policy/action_std",
        "speed/steps_per_second",
        *(f"reward/{name}" for name in term_names(BounceReward)),
        *(f"results/{name.replace(' ', '_')}" for name in measured),
    }
    tags = set(log.Tags()["scalars"])
    assert expected <= tags
    assert not {f"results/{name.replace(' ', '_')}" for name in {*RESULT_NAMES} - measured} & tags
    assert [event.step for event in log.Scalars("loss/value")] == [64, 128, 192, 256]
    assert [event.step for event in log.Scalars("results/stable")] == [128, 256]
    for name in expected:
        assert np.isfinite([event.value for event in log.Scalars(name)]).all(), name


def evaluate(args: list[str], json_file: Path) -> dict:
    """Runs the command on a policy that fails, and returns the content of its JSON file."""
    with pytest.raises(SystemExit) as exit_info:
        eval_command.main([*map(str, args), "--episodes", "4", "--json", str(json_file)])
    assert exit_info.value.code == 1
    return json.loads(json_file.read_text())


def test_eval_reports_five_results(trained: Path, tmp_path: Path, capsys) -> None:
    report = evaluate([trained], tmp_path / "a.json")
    assert tuple(result["name"] for result in report["results"]) == RESULT_NAMES
    assert not report["passed"]
    assert False in [result["passed"] for result in report["results"]]
    shown = " ".join(capsys.readouterr().out.split())
    for result in report["results"]:
        value = result["value"]
        assert value is None or isinstance(value, float)
        figure = "-" if value is None else f"{value:.2f}"
        assert f"{figure} {result['bound']}" in shown
    assert "FAIL" in shown


def test_eval_finds_the_checkpoint(trained: Path, tmp_path: Path, monkeypatch) -> None:
    best = json.loads((trained / "results.json").read_text())["best_steps"]
    monkeypatch.chdir(trained.parent.parent.parent)
    latest = f"checkpoints/{STEPS}"
    for given, found in (
        ([], f"checkpoints/{best}"),
        ([trained.relative_to(Path.cwd())], f"checkpoints/{best}"),
        ([trained / "checkpoints"], f"checkpoints/{best}"),
        ([trained / latest], latest),
    ):
        report = evaluate(given, tmp_path / "a.json")
        assert Path(report["checkpoint"]) == trained / found


def test_eval_repeats_itself_for_a_seed(trained: Path, tmp_path: Path) -> None:
    first, again = (evaluate([trained, "--seed", "5"], tmp_path / "a.json") for _ in range(2))
    assert first == again
    other = evaluate([trained, "--seed", "6"], tmp_path / "a.json")
    assert other["details"]["mean_return"] != first["details"]["mean_return"]


def test_eval_takes_a_fixed_target(trained: Path, tmp_path: Path) -> None:
    report = evaluate([trained, "--target-height", "0.8"], tmp_path / "a.json")
    assert report["commands"] == {"target_height": 0.8}
    speed = report["results"][RESULT_NAMES.index("upward speed")]
    assert speed["passed"] is None


def test_eval_on_mujoco_agrees(trained: Path, tmp_path: Path) -> None:
    fused = evaluate([trained], tmp_path / "a.json")
    mujoco = evaluate([trained, "--physics", "mujoco"], tmp_path / "a.json")
    assert (fused["physics"], mujoco["physics"]) == ("fused", "mujoco")
    for name in ("mean_return", "mean_length_s"):
        assert mujoco["details"][name] == pytest.approx(fused["details"][name], rel=0.02)


def test_policy_is_read_as_orbax_reads_it() -> None:
    """orbax wrote the shipped policies, and the runs of older versions."""
    checkpoint = pretrained_checkpoint()
    ours = read_policy(checkpoint, load_run_config(checkpoint.run))
    with ocp.StandardCheckpointer() as checkpointer:
        theirs = checkpointer.restore(checkpoint.folder.absolute() / "policy")
    assert isinstance(ours, Policy)
    jax.tree.map(
        np.testing.assert_array_equal, ours.params, jax.tree.map(np.asarray, theirs["params"])
    )
    np.testing.assert_array_equal(ours.normalizer.mean, theirs["normalizer"]["mean"])


def test_newest_run_is_one_with_a_finished_checkpoint(tmp_path: Path) -> None:
    for folder in (
        "2026-01-01/checkpoints/64",
        "2026-01-02/checkpoints/128",
        "2026-01-03/checkpoints/64.orbax-checkpoint-tmp",
        "2026-01-04/checkpoints/replaced/64",
    ):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder.split("/")[0] / "config.yaml").touch()
    assert newest_run(tmp_path) == tmp_path / "2026-01-02"
    with pytest.raises(UserError, match="no run with a checkpoint"):
        newest_run(tmp_path / "2026-01-04")


@pytest.mark.slow
def test_resumed_run_equals_an_uninterrupted_one(trained: Path, tmp_path: Path) -> None:
    log_dir = tmp_path / "runs"
    train_command.main([*TINY, "--total-steps", str(STEPS // 2), "--log-dir", str(log_dir)])
    (run,) = log_dir.iterdir()
    train_command.main(["--resume", str(run), "--total-steps", str(STEPS)])
    assert list(log_dir.iterdir()) == [run]

    log = EventAccumulator(str(run)).Reload()
    assert [event.step for event in log.Scalars("loss/value")] == [64, 128, 192, 256]
    resumed, straight = (arrays(latest_checkpoint(folder)) for folder in (run, trained))
    assert resumed.keys() == straight.keys() != set()
    jax.tree.map(np.testing.assert_array_equal, resumed, straight)
