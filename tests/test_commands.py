"""The commands: the files that they write, and their messages after mistakes."""

import json
import pwd
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import jax
import pytest
from rich.console import Console

import bounce_mjx
from bounce_mjx.commands import eval as eval_command
from bounce_mjx.commands import train as train_command
from bounce_mjx.commands.main import COMMANDS
from bounce_mjx.commands.main import main as console_script
from bounce_mjx.config.command_line import flags_of
from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import TrainConfig, load_config, train_config
from bounce_mjx.runs.folders import choose_checkpoint
from bounce_mjx.tasks.registry import find_task
from bounce_mjx.training.command import TrainCommand
from bounce_mjx.training.setup import set_up_jax
from tiny_runs import STEPS, TINY, TRAIN_SCRIPT, contents, shared_run

RESULT_NAMES = ("consecutive bounces", "horizontal position", "height", "upward speed", "stable")

Fails = Callable[..., str]


@pytest.fixture(scope="module")
def trained() -> Path:
    """The folder of a run of 256 steps."""
    return shared_run()


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
    "near miss of a switch": ("--no-stop-if-solved", "did you mean --no-stop-when-solved?"),
    "not a number": ("--num-envs abc", "--num-envs is abc", "integer"),
    "control step": ("--control-dt 0.0105", "control_dt 0.0105", "multiple of physics_dt"),
    "rollout longer than an episode": (
        "--num-envs 8 --rollout-length 8 --episode-seconds 0.05",
        "rollout_length 8",
        "5 control steps",
        "shorter rollout",
    ),
    "scale nan": ("--action-scale nan", "--action-scale is nan", "a finite number"),
    "preset and resume": ("--config a.yaml --resume b", "--config", "--resume", "combined"),
    "preset missing": ("--config a.yaml", "a.yaml", "No such file", "configs/default.yaml"),
    "no such preset": ("--config nope", "no preset is named nope", "cpu, default, finetune"),
    "no such robot": ("--robot nope", "no robot is named nope", "iiwa, panda, peitian, ur5e"),
    "MJCF missing": ("--mjcf a.xml", "a.xml", "does not exist", "give the path"),
}


@pytest.mark.parametrize("case", BAD_FLAGS.values(), ids=BAD_FLAGS)
def test_bad_flag(fails: Fails, case: tuple[str, ...]) -> None:
    flags, *words = case
    assert_says(fails(train_command.main, flags.split()), words)


BAD_YAML = {
    "no YAML": (b"ppo: [1\nseed: {", "cannot be read", "line 2", "configs/default.yaml"),
    "key twice": (
        b"ppo: {num_envs: 8}\nenv: {}\nppo: {discount: 0.9}",
        "the key ppo appears twice, in lines 1 and 3; join the two",
    ),
    "unknown key": (b"zzz: 3", "unknown key zzz", "known keys here are", "total_steps"),
    "deep near miss": (
        b"env: {reward: {height: {wieght: 3}}}",
        "env.reward.height.wieght",
        "did you mean env.reward.height.weight?",
    ),
}


@pytest.mark.parametrize("case", BAD_YAML.values(), ids=BAD_YAML)
def test_bad_config_file(fails: Fails, tmp_path: Path, case: tuple) -> None:
    text, *words = case
    (tmp_path / "my.yaml").write_bytes(text)
    assert_says(fails(train_command.main, ["--config", "my.yaml"]), ["my.yaml", *words])


ODD_YAML = (
    b"\xff\xfe\x00",
    b"? [1]\n: 2",
    b"seed: !!int ''",
    b"seed: !!python/object/apply:os.system [touch ran]",
    b"env: &e {env: *e}",
    b"seed: " + b"[" * 5000,
    b"env: {mjcf: ~nobody/a.xml, physics: mjx}",
    b'log_dir: "a\\0b"',
    b'"a\\nb\\e[31m": 1',
    b"env: {control_dt: 1.0e+308, physics_dt: 1.0e-308}",
)


@pytest.mark.parametrize("data", ODD_YAML, ids=range(len(ODD_YAML)))
def test_config_file_of_any_bytes_is_refused_in_one_sentence(
    fails: Fails, tmp_path: Path, data: bytes
) -> None:
    (tmp_path / "my.yaml").write_bytes(data)
    sentence = fails(train_command.main, ["--config", "my.yaml"])
    assert len(sentence) < 5000 and sentence[:-1].isprintable()


def test_flag_is_validated_on_top_of_the_config_file(fails: Fails, tmp_path: Path) -> None:
    (tmp_path / "my.yaml").write_text("ppo: {num_envs: 8, rollout_length: 8, num_minibatches: 4}")
    sentence = fails(train_command.main, "--config my.yaml --num-envs 9 --rollout-length 5".split())
    assert_says(sentence, ("num_minibatches 4", "45 samples", "choose a divisor of 45"))


MJCF = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
BAD_MJCF = {
    "text": ("hello", "does not compile", "correct it"),
    "ball": (MJCF.replace('"ball_link"', '"ball"'), "no body named ball_link", "needs the names"),
    "actuator": (
        re.sub(r'<position [^>]*joint="Joint2"[^>]*/>', "", MJCF),
        "default_joint_angles has 6 numbers",
        "5 joints with an actuator (Joint1, Joint3",
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
    "target below the floor": ("--target-height -1", "--target-height is -1.0", ">= 0.001"),
    "json in no folder": ("--json nowhere/a.json", "nowhere/a.json", "make it"),
}


@pytest.mark.parametrize("case", BAD_EVAL_FLAGS.values(), ids=BAD_EVAL_FLAGS)
def test_bad_eval_flag(fails: Fails, case: tuple[str, ...]) -> None:
    flags, *words = case
    assert_says(fails(eval_command.main, flags.split()), words)


def test_run_without_checkpoint(fails: Fails, run: Path) -> None:
    shutil.rmtree(run / "checkpoints")
    assert_says(fails(eval_command.main, ["run"]), ("run", "no checkpoint", "give another"))
    assert_says(fails(train_command.main, ["--resume", "run"]), ("run", "no checkpoint", "give"))


@pytest.mark.parametrize(
    ("item", "main", "args"),
    [
        ("policy", eval_command.main, [f"run/checkpoints/{STEPS}"]),
        ("training", train_command.main, ["--resume", "run", "--total-steps", "512"]),
    ],
    ids=["eval", "resume"],
)
def test_damaged_checkpoint_is_refused(fails: Fails, run: Path, item, main, args) -> None:
    for path in (run / f"checkpoints/{STEPS}/{item}").glob("**/d/*"):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert_says(fails(main, args), (f"run/checkpoints/{STEPS}", "damaged", "give another"))


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
        [TRAIN_SCRIPT, "--config", "my.yaml"],
        ["-m", "bounce_mjx.eval", "--episode", "3"],
    ],
    ids=["train", "eval"],
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


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_plain_forms_and_no_empty_default(command: str, monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        console_script([command, "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", "").split())
    assert f"usage: bounce-mjx {command} " in shown
    for oddity in ("None}", "{None", "[[", "...]]", "(default: )", "(default: None)", "{True"):
        assert oddity not in shown


def test_the_help_of_a_training_is_one_screen_and_the_whole_help_has_every_flag(capsys) -> None:
    pages = []
    for flag in ("--help", "--help-all"):
        with pytest.raises(SystemExit):
            console_script(["train", "--config", "cpu", "--seed", "3", flag])
        pages.append(capsys.readouterr().out)
    lines = pages[0].splitlines()
    assert len(lines) <= 45 and max(map(len, pages[1].splitlines())) <= 100
    assert "--num-envs INT          Environments that run in parallel (default: 512)" in pages[0]
    shown = {*re.findall(r"^  (--[\w.-]+)", pages[1], re.MULTILINE)}
    known = {*flags_of(train_config(find_task("bounce"), TrainCommand))}
    assert shown <= known
    plain = {flag.replace("--no-", "--").replace(".no-", ".") for flag in known}
    assert {flag.replace("--no-", "--").replace(".no-", ".") for flag in shown} == plain
    assert pages[1].index("\nppo:\n") < pages[1].index("--learning-rate FLOAT")


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


def test_a_policy_is_named_by_its_run_or_its_checkpoint(trained: Path, monkeypatch) -> None:
    best = json.loads((trained / "results.json").read_text())["best_steps"]
    log_dir = TrainConfig().log_dir
    monkeypatch.chdir(trained.parent.parent.parent)
    for given, steps in (
        (None, best),
        (trained.relative_to(Path.cwd()), best),
        (trained / "checkpoints", best),
        (trained / f"checkpoints/{STEPS}", STEPS),
    ):
        found = choose_checkpoint(given, log_dir, Console(quiet=True))
        assert found.folder.resolve() == trained / f"checkpoints/{steps}"


def test_eval_takes_a_fixed_target_and_a_seed(trained: Path, tmp_path: Path) -> None:
    args = [trained, "--target-height", "0.8", "--seed", "5"]
    report, again = (evaluate(args, tmp_path / "a.json") for _ in range(2))
    assert report == again and report["commands"] == {"target_height": 0.8}
    speed = report["results"][RESULT_NAMES.index("upward speed")]
    assert speed["passed"] is None
