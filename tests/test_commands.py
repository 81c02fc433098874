"""The commands: the files that they write, and their messages after mistakes."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import bounce_mjx
from bounce_mjx.commands import eval as eval_command
from bounce_mjx.commands.main import main as console_script
from bounce_mjx.commands.play import PlayCommand, film_command
from bounce_mjx.commands.train import fields_of_command
from bounce_mjx.config.command_line import all_flags, parse
from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.folders import choose_checkpoint
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.runs.start import StartFlags, find_start
from bounce_mjx.viewers.simulation import Simulation
from tiny_runs import STEPS, TINY, TRAIN_SCRIPT, shared_run

RESULT_NAMES = ("consecutive bounces", "horizontal position", "height", "upward speed", "stable")

Refuse = Callable[..., str]


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may damage, in the working directory of `refused`."""
    return shutil.copytree(trained, tmp_path / "run")


MISTAKES = (
    ("train --no-stop-if-solved", "did you mean --no-stop-when-solved?"),
    ("train --num-envs abc", "--num-envs is abc", "integer"),
    (
        "train --hidden-layers x y",
        "--hidden-layers is x, but must be a valid integer (",
    ),
    # Also printed, since training refuses it.
    (
        "train --rollout-length 201 --training-episode-seconds 2 --print-config",
        "rollout_length 201 is longer than an episode of 200 control steps; choose",
    ),
    ("train --control-dt 0.0105", "control_dt 0.0105", "multiple of physics_dt"),
    (
        "train --num-envs 8 --rollout-length 8 --episode-seconds 0.05",
        "rollout_length 8",
        "5 control steps",
        "shorter rollout",
    ),
    ("train --action-scale nan", "--action-scale is nan", "a finite number"),
    ("train {run} --config a.yaml", "has its config, with which it is resumed"),
    (
        "train --resume b",
        "unknown argument --resume; its value has no flag, and stands first: [TASK|POLICY|RUN]",
    ),
    (
        "train --task=catch",
        "unknown argument --task=catch; its value has no flag, and stands first: [TASK|",
    ),
    ("train --seed 3 4", "there is no task, policy or run 4; give"),
    ("train {run}/config.yaml", "config.yaml is a file, and no task,", "give --config {run}/con"),
    ("train {here}", "give --import {here}"),
    ("eval {run}/..", "is a folder of runs; give one of them, such as {run}/../"),
    ("train --seed 3 catch", "catch is what the training begins with; give it first"),
    ("train cach", "no task, policy or run cach; did you mean catch?"),
    ("train robust_small --warm-start robust", "are two policies; leave one out"),
    (
        "train --keep-checkpoints 0",
        "--keep-checkpoints is 0, but must be greater than or equal to 1, or be 'all'",
    ),
    ("train --config a.yaml", "a.yaml", "No such file", "configs/default.yaml"),
    ("train --config nope", "no preset is named nope", "cpu, default, finetune"),
    ("train --robot nope", "no robot is named nope", "iiwa, panda, peitian, ur5e"),
    ("train --mjcf a.xml", "a.xml", "does not exist", "give the path"),
    ("eval --target-height -1", "--target-height is '-1'", ">= 0.05"),
    ("eval --json nowhere/a.json", "nowhere/a.json", "make it"),
    ("evl", "unknown command evl", "did you mean eval?", "bounce-mjx --help"),
    ("--num-envs 3", "unknown command --num-envs", "choose train, eval"),
    ("eval pretraned", "there is no run and no policy pretraned; did you mean"),
    ("eval miror", "no policy miror; did you mean mirror?"),
    ("export robst_small", "no policy robst_small; did you mean robust_small?"),
    ("play ur5", "no policy ur5; did you mean ur5e?"),
    ("train --warm-start robust_smal", "did you mean robust_small?"),
    ("train latst", "there is no task, policy or run latst; did you mean latest?"),
    ("eval --import", "--import needs a file or a module"),
    ("eval --import no.py", "no.py cannot be read (No such file or directory); give --import"),
    (
        "train --reward.height.weight three",
        "--reward.height.weight is three, but must be a valid number (",
    ),
    ("train --randomization.ball-mass 0.5", "ball_mass: 0.5 is not a range; give two numbers"),
    ("train --target-height-range 0.5", "target_height_range: 0.5 is not a range; give two"),
    ("eval pretrained --robot ur5e", "give mirror"),
    ("eval pretrained --log-dir typo", "--log-dir is where the newest run is looked for, and pret"),
    ("robustness mirror --log-dir typo", "and mirror is named; omit one of them"),
    ("play robust pretrained --log-dir typo", "and robust is named"),
    ("plot nowhere --log-dir typo", "and nowhere is named"),
    ("report nowhere --log-dir typo", "and nowhere is named"),
    ("export robust --log-dir typo", "and robust is named"),
    ("play robust latest --log-dir typo", "there is no run with a checkpoint in typo"),
    ("eval --nominal --randomization.air-drag 0 1", "--nominal and --randomization", "omit one"),
    (
        "eval robust --randomization.first-goal-range 0.5 --randomization.warmup-steps 5",
        "--randomization is given without a term",
    ),
    ("eval catch --target-height 0.5", "--target-height is not a goal of the run's task; omit"),
    ("export robust --out a.onnx", "unknown argument --out; did you mean --onnx?"),
    ("eval robust --out=a.json", "unknown argument --out=a.json; did you mean --json?"),
    ("play robust --out a.mp4", "unknown argument --out; did you mean --video?"),
    ("report robust", "the policy robust comes with the package", "give a run's folder"),
    ("plot catch", "the policy catch comes with the package"),
    ("play --nominal", "--nominal needs --episode; add it"),
    (
        "play robust --suite robustness_v2 --episode 3",
        "--suite needs --condition; add it, or omit --suite",
    ),
    (
        "robustness robust --world fast_servo --assumed --suite robustness_v2",
        "--assumed and --suite cannot",
    ),
    ("robustness robust --assumed", "--assumed needs --world; add it"),
    ("play robust --condition late --episode 3", "no condition 'late'", "one such as"),
    ("play robust --condition nominal --nominal --episode 3", "--condition and --nominal cannot"),
    ("play robust --condition nominal --episode 64", "episodes 0 to 63"),
    ("play robust --episode 64 --episodes 64", "--episode is 64", "0 to 63"),
    ("play robust catch --episode 1", "one episode of one policy"),
    ("eval mirror --task catch", "target_height"),
    ("eval mirror --robot nope", "no robot is named nope"),
    ("plot {run} --formats gif", "--formats is gif", "'png' or 'svg'"),
    ("plot {run} --out {run}/config.yaml", "cannot be written", "--out"),
    ("train --eval-seed 20000", "eval_seed: 20000 is the seed of bounce-mjx eval,", "give another"),
    (
        "train catch --warm-start robust",
        "the warm start is a policy of the task bounce, and this training of catch; leave catch",
    ),
    ("train --warm-start robust", "without its value network; give robust_small"),
    ("train --warm-start robust_small --hidden-layers 8", "other hidden layers"),
    ("train --warm-start robust_small --observation.action 1", "another observation"),
    ("train --warm-start robust_small --robot ur5e", "the robot ur5e is given, and a policy"),
    ("train --warm-start nowhere", "there is no run and no policy nowhere; give a run"),
    ("train {run} --warm-start robust_small", "has its warm_start", "--warm-start {run}"),
    ("train {run} --reward.height.weight 1", "cannot change env.reward.height.weight;"),
    ("train {run} --block-steps 128", "cannot change block_steps;", "leave those out"),
    ("identify", "no log is given"),
    ("identify nowhere.csv", "the log nowhere.csv cannot be read"),
    ("identify x.csv --check nowhere.yaml", "nowhere.yaml"),
    ("excite --out a.csv --table-height 0.5", "the start pose has a contact of the table and"),
    ("excite --out a.csv --seconds 3", "3 s are too short to move 6 joints; give at least"),
    ("excite --out a.csv --robot nowhere", "nowhere"),
    ("play --video a.avi", "--video a.avi", ".mp4 or .webp or .gif", "rename"),
    ("play --video no/a.mp4", "no/a.mp4", "does not exist", "make it"),
    ("play --video a.mp4 --size 321 240", "--size 321 240", "even"),
    ("play --video a.gif --fps 60", "--fps 60", "GIF", "25 or 50"),
    ("play --viewer browser --video a.mp4", "--viewer browser", "give only one"),
    ("view --viewer native", "--viewer native", "display", "--viewer browser"),
    ("view --viewer browser --host 192.0.2.1", "--host 192.0.2.1", "127.0.0.1"),
    ("play pretrained pretrained --video a.mp4", "shows one policy", "browser"),
)


@pytest.mark.parametrize("case", MISTAKES, ids=lambda case: case[0])
def test_a_mistake_is_one_sentence(refused: Refuse, monkeypatch, case: tuple[str, ...]) -> None:
    """Before anything is compiled."""
    monkeypatch.setattr(Simulation, "__init__", None)
    line, *words = case
    run = shared_run() if "{run}" in line else None
    known = {"run": run, "here": __file__}
    refused(line.format(**known), *(word.format(**known) for word in words))


ALIASES = b"a0: &a0 [1, 2]\n" + b"".join(
    b"a%d: &a%d [*a%d, *a%d]\n" % (i, i, i - 1, i - 1) for i in range(1, 40)
)
BAD_YAML = {
    "no YAML": (b"ppo: [1\nseed: {", "cannot be read", "line 2", "configs/default.yaml"),
    "key twice": (
        b"ppo: {num_envs: 8}\nenv: {}\nppo: {discount: 0.9}",
        "the key ppo appears twice, in lines 1 and 3; join the two",
    ),
    "unknown key": (b"zzz: 3", "unknown key zzz", "known keys here are", "total_steps"),
    "many values": (b"a: [" + b"1," * 20000 + b"]", "it has more than 20,000 values"),
    "aliases": (ALIASES, "it has more than 20,000 values"),
    "deep near miss": (
        b"env: {reward: {height: {wieght: 3}}}",
        "env.reward.height.wieght",
        "did you mean env.reward.height.weight?",
    ),
    "aliases of aliases": (
        b"a: &a [1, 2, 3, 4, 5, 6, 7, 8, 9]\nb: &b [*a, *a, *a, *a, *a, *a, *a, *a, *a]\n"
        b"c: &c [*b, *b, *b, *b, *b, *b, *b, *b, *b]\nd: &d [*c, *c, *c, *c, *c, *c, *c, *c, *c]\n"
        b"e: [*d, *d, *d, *d, *d, *d, *d, *d, *d]",
        "it has more than 20,000 values",
    ),
    "too many keys": (
        "\n".join(f"key{i}: 1" for i in range(10_001)).encode(),
        "it has more than 20,000 values",
    ),
}


ODD_YAML = (
    b"\xff\xfe\x00",
    b"? [1]\n: 2",
    b"seed: !!int ''",
    b"seed: !!python/object/apply:os.system [touch ran]",
    b"env: &e {env: *e}",
    b"seed: " + b"[" * 5000,
    b"env: {control_dt: 1.0e+308, physics_dt: 1.0e-308}",
)


@pytest.mark.parametrize("case", [*BAD_YAML.values(), *((data,) for data in ODD_YAML)])
def test_bad_config_file(refused: Refuse, tmp_path: Path, case: tuple) -> None:
    text, *words = case
    (tmp_path / "my.yaml").write_bytes(text)
    assert len(refused("train --config my.yaml", *words)) < 5000


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
def test_bad_mjcf(refused: Refuse, tmp_path: Path, case: tuple[str, ...]) -> None:
    text, *words = case
    assert text != MJCF
    (tmp_path / "my.xml").write_text(text, encoding="utf-8")
    refused("train --mjcf my.xml", "my.xml", *words)


@pytest.mark.parametrize("log_dir", ["file", "file/inside"])
def test_log_dir_that_cannot_be_made(refused: Refuse, tmp_path: Path, log_dir: str) -> None:
    (tmp_path / "file").write_text("mine")
    refused(["train", *TINY, "--log-dir", log_dir], f"{log_dir} ", "choose", "--log-dir")


@pytest.mark.parametrize(
    ("item", "line"),
    [
        ("policy", f"eval run/checkpoints/{STEPS}"),
        ("training", "train run --total-steps 512"),
    ],
)
def test_damaged_checkpoint_is_refused(refused: Refuse, run: Path, item: str, line: str) -> None:
    for path in (run / f"checkpoints/{STEPS}/{item}").glob("**/d/*"):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    refused(line, f"run/checkpoints/{STEPS}", "damaged", "give another")


@pytest.mark.parametrize("line", [f"{TRAIN_SCRIPT} --config a.yaml", "-m bounce_mjx.eval --x 3"])
def test_whole_process_exits_without_a_traceback(tmp_path: Path, line: str) -> None:
    (tmp_path / "a.yaml").write_text("ppo: {num_env: 8}")
    command = [sys.executable, *line.split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"error: .+\n", done.stderr), done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["a.yaml"]


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
    shown |= {*re.findall(r"^  --.+, (--no-[\w.-]+)", pages[1], re.MULTILINE)}
    known = {*all_flags(fields_of_command(find_start(None, StartFlags())))}
    assert shown == known
    assert pages[1].index("\nppo:\n") < pages[1].index("--learning-rate FLOAT")


def test_a_default_with_a_percent_sign_is_shown(tmp_path: Path, capsys) -> None:
    """In a path, for example."""
    folder = tmp_path / "50%"
    shutil.copytree(resource_path("pretrained/robust_small"), folder)
    with pytest.raises(SystemExit):
        console_script(["train", "--warm-start", str(folder), "--help-all"])
    assert "50%/checkpoints" in re.sub(r"\s", "", capsys.readouterr().out)


def test_presets_are_valid() -> None:
    found = resource_path("configs").glob("*.yaml")
    files = {p.stem: p for p in found if not p.stem.startswith("robustness")}
    presets = {name: read_preset(path) for name, path in files.items()}
    assert {"default", "cpu", "seed"} <= presets.keys()
    seed = presets["seed"]
    assert seed.total_steps == 50_000_000
    assert (seed.ppo.num_envs, seed.ppo.rollout_length) == (1024, 128)
    assert (seed.ppo.num_epochs, seed.ppo.num_minibatches) == (15, 16)
    assert seed.ppo.learning_rate == 2e-4
    assert seed.ppo.hidden_layers == (512, 512, 512)


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


def test_eval_reports_five_results(trained: Path, tmp_path: Path, capsys) -> None:
    """At a fixed target, in a world that the file names."""
    file = tmp_path / "a.json"
    line = f"{trained} --episodes 4 --target-height 0.8 --seed 5 --json {file}"
    line += " --randomization.ball-mass 0.9 1.1"
    with pytest.raises(SystemExit) as exit_info:
        eval_command.main(line.split())
    assert exit_info.value.code == 1
    report = json.loads(file.read_text(), parse_constant=pytest.fail)
    assert report["goals"] == {"target_height": 0.8}
    assert report["world"] is None and report["randomization"] == {"ball_mass": [0.9, 1.1]}
    (unjudged,) = (result for result in report["results"] if result["passed"] is None)
    assert unjudged["name"] == "upward speed"
    assert tuple(result["name"] for result in report["results"]) == RESULT_NAMES
    assert not report["passed"]
    assert False in [result["passed"] for result in report["results"]]
    shown = " ".join(capsys.readouterr().out.split())
    for result in report["results"]:
        value = result["value"]
        assert value is None or isinstance(value, float)
        figure = "-" if value is None else f"{value:.2f}"
        assert result == unjudged or f"{figure} {result['bound']}" in shown
    assert "FAIL" in shown and re.search(r"checkpoint: .+ physics: ", shown)


@pytest.mark.parametrize(
    "line",
    [
        "RUN --failures --json a.json --nominal",
        "RUN --failures=true --no-limits --contacts=False --json=a.json --nominal",
        "RUN --no-failures --physics config --nominal=true",
    ],
)
def test_the_command_of_a_film_has_no_flag_that_play_lacks(line: str) -> None:
    shown = film_command(line.split(), eval_command.EvalCommand, "--episode", "3")
    assert shown == "bounce-mjx play RUN --nominal --episode 3"
    parse(PlayCommand, shown.split()[2:], prog="bounce-mjx play")


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
        found = choose_checkpoint(given, log_dir)
        assert found.folder.resolve() == trained / f"checkpoints/{steps}"


def test_a_report_of_one_checkpoint_is_refused(trained: Path, refused) -> None:
    """It would show the best one."""
    words = f"a report is of a run's best checkpoint; give {trained}, not"
    refused(f"report {trained}/checkpoints/{STEPS}", words)


@pytest.mark.parametrize("command", ["plot", "report"])
def test_a_mistyped_run_is_told_before_what_draws_is_imported(
    command: str, refused, monkeypatch
) -> None:
    for module in ("reports.figures", "reports.page", "viewers.page"):
        monkeypatch.setitem(sys.modules, f"bounce_mjx.{module}", None)
    refused(f"{command} nowhere", "there is no run and no policy nowhere; give a run's folder")
