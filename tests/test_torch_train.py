"""train_torch.py: what it leaves behind, and that the rest of the package can use it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from bounce_mjx.commands import eval as eval_command
from bounce_mjx.commands import train_torch as torch_train
from bounce_mjx.runs.config import load_config
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.runs.reading import load_policy

SCRIPT = Path(__file__).parent.parent / "train_torch.py"
TINY = (
    "--num-envs 8 --rollout-length 8 --num-minibatches 2 --num-epochs 1 --hidden-layers 16 "
    "--block-steps 64 --eval-every 128 --eval-episodes 4 --screening-episodes 0 "
    "--no-stop-when-solved --episode-seconds 0.2 --total-steps 256"
).split()


# As where PyTorch is not installed; some libraries mind a None in sys.modules.
NO_TORCH = """
import sys
class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "torch":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, NoTorch())
"""


@pytest.fixture(scope="module", params=("rsl_rl", "skrl"))
def run(request, tmp_path_factory) -> Path:
    """The folder of a run of each library."""
    torch.set_num_threads(1)
    log_dir = tmp_path_factory.mktemp(request.param)
    library = ["--library", request.param]
    torch_train.main(
        [*TINY, *library, "--log-dir", str(log_dir), "--target-height-range", ".3", ".8"]
    )
    (folder,) = log_dir.iterdir()
    return folder


def test_run_folder_is_that_of_the_trainer_in_jax(run):
    results = json.loads((run / "results.json").read_text(encoding="utf-8"))
    assert results["library"] in run.parent.name
    assert [e["steps"] for e in results["evaluations"]] == [128, 256]
    assert results["trained_steps"] == 256
    assert len(results["results"]) == 5
    assert load_config(run / "config.yaml").env.target_height_range == (0.3, 0.8)
    assert find_checkpoint(run / "checkpoints" / "latest", run).steps == 256
    assert list(run.glob("events.out.tfevents.*"))
    assert not [p for p in run.rglob("*") if p.suffix in (".pt", ".pth", ".pkl", ".pickle")]


def test_run_is_evaluated_without_torch(run, tmp_path):
    """By the same command with the same table; the best checkpoint gives its results again."""
    out = tmp_path / "results.json"
    seed = load_config(run / "config.yaml").eval_seed
    script = f"""{NO_TORCH}
from bounce_mjx.commands.eval import main
main([{str(run)!r}, "--episodes", "4", "--seed", "{seed}", "--json", {str(out)!r}])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    assert "consecutive bounces" in done.stdout
    assert len(json.loads(out.read_text(encoding="utf-8"))["results"]) == 5


def test_best_policy_is_the_one_that_was_judged(run):
    config = load_config(run / "config.yaml")
    checkpoint = find_checkpoint(run, run)
    results = json.loads((run / "results.json").read_text(encoding="utf-8"))
    assert checkpoint.steps == results["best_steps"]
    evaluate = torch_train.make_evaluation(config, torch_train.BounceBall(config.env))
    report = evaluate(load_policy(checkpoint, config))
    for again, stored in zip(report.results, results["results"], strict=True):
        assert again.value == pytest.approx(stored["value"], rel=1e-4)


MISTAKES = {
    "library": ("--library tianshou", ("--library", "rsl_rl", "skrl", "tianshou")),
    "near miss": ("--num-envz 3", ("did you mean --num-envs?", "train_torch.py --help")),
    "rollout": ("--num-envs 8 --rollout-length 8 --num-minibatches 7", ("divisor of 64",)),
}


@pytest.mark.parametrize("flags, words", MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_told_in_a_sentence(flags, words, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        torch_train.main(flags.split())
    error = capfd.readouterr().err
    assert exit_info.value.code == 2
    assert error.startswith("error: ") and error.count("\n") == 1
    assert all(word in error for word in words), error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("missing, library", [("rsl_rl", "rsl_rl"), ("skrl", "skrl")])
def test_missing_library_is_told_in_a_sentence(missing, library, tmp_path):
    script = f"""
import sys
sys.modules[{missing!r}] = None
sys.argv = ["train_torch.py"] + {["--library", library, *TINY]!r}
from bounce_mjx.commands.train_torch import main
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 2, done.stderr
    assert f"{library} cannot be imported" in done.stderr and "pip install" in done.stderr
    assert not list(tmp_path.iterdir())


def test_script_shows_its_flags():
    done = subprocess.run([sys.executable, SCRIPT, "--help"], capture_output=True, text=True)
    assert done.returncode == 0
    for flag in ("--library", "--num-envs", "--stop-when-solved", "--reward.height.weight"):
        assert flag in done.stdout


def test_evaluation_command_lists_the_run(run, capsys):
    """The newest run in a folder of runs, whichever trainer made it."""
    with pytest.raises(SystemExit):
        eval_command.main(["--log-dir", str(run.parent), "--episodes", "4"])
    assert str(run) in capsys.readouterr().out
