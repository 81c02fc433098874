"""train_torch.py: its files, which the rest of the package can use."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
import torch
from jax.experimental.compilation_cache import compilation_cache
from rsl_rl.runners import OnPolicyRunner

from bounce_mjx.adapters.torch.rsl_rl_ppo import RslRlVecEnv, algorithm_config
from bounce_mjx.adapters.torch.trainer import TorchTrainer, make_vector_env
from bounce_mjx.commands import eval as eval_command
from bounce_mjx.commands import train as train_command
from bounce_mjx.commands import train_torch as torch_train
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import judge
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.runs.config import load_config
from bounce_mjx.runs.folders import best_checkpoint, find_checkpoint, latest_checkpoint
from bounce_mjx.runs.reading import read_policy
from bounce_mjx.tasks.bounce_ball import BounceBall
from bounce_mjx.training import run_command
from tiny_runs import arrays

SCRIPT = Path(__file__).parent.parent / "train_torch.py"
TINY = (
    "--num-envs 8 --rollout-length 8 --num-minibatches 2 --num-epochs 1 --hidden-layers 16 "
    "--block-steps 64 --eval-every 128 --eval-episodes 4 --screening-episodes 0 "
    "--no-stop-when-solved --episode-seconds 0.2 --total-steps 256 --target-height-range .3 .8"
).split()


# As if PyTorch were not installed; some libraries cannot handle a None in sys.modules.
NO_TORCH = """
import sys
class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "torch":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, NoTorch())
"""


@pytest.fixture(scope="module", autouse=True)
def compiled_once(tmp_path_factory) -> Iterator[None]:
    """Keeps compiled programs in a cache for this module."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = [getattr(jax.config, name) for name in names]
    with pytest.MonkeyPatch.context() as patch:
        # The command does not change a cache that the user has chosen.
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path_factory.mktemp("user")))
        for name, value in zip(names, (str(tmp_path_factory.mktemp("cache")), 0.0), strict=True):
            jax.config.update(name, value)
        compilation_cache.reset_cache()
        yield
    for name, value in zip(names, before, strict=True):
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def train(log_dir: Path, library: str, *flags: str) -> Path:
    """The folder of a new run."""
    torch.set_num_threads(1)
    torch_train.main([*TINY, "--library", library, "--log-dir", str(log_dir), *flags])
    (folder,) = log_dir.iterdir()
    return folder


@pytest.fixture(scope="module", params=("rsl_rl", "skrl"))
def library(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def run(library, tmp_path_factory) -> Path:
    """The folder of a run of each library."""
    return train(tmp_path_factory.mktemp(library), library)


def test_run_folder_has_the_same_files_as_in_jax(run):
    results = json.loads((run / "results.json").read_text(encoding="utf-8"))
    assert results["library"] in run.parent.name
    assert [e["steps"] for e in results["evaluations"]] == [128, 256]
    assert results["trained_steps"] == 256
    assert len(results["results"]) == 5
    assert load_config(run / "config.yaml").env.target_height_range == (0.3, 0.8)
    assert find_checkpoint(run / "checkpoints" / "latest").steps == 256
    assert list(run.glob("events.out.tfevents.*"))
    assert [p.name for p in run.rglob("*.p*") if p.suffix in (".pt", ".pth", ".pkl")] == [
        "model.pt"
    ]


def test_rsl_rls_runner_opens_the_model(run, library):
    """Its runner continues from the last networks, optimizer and iteration."""
    if library != "rsl_rl":
        pytest.skip("the format of rsl_rl's runner")
    config = load_config(run / "config.yaml")
    vector = make_vector_env(config.ppo, BounceBall(config.env), seed=0)
    runner = OnPolicyRunner(RslRlVecEnv(vector), algorithm_config(config.ppo))
    fresh = runner.get_inference_policy().mlp[0].weight.clone()
    runner.load(str(run / "model.pt"))
    assert runner.current_learning_iteration == 256 // config.ppo.batch_steps
    actor = runner.get_inference_policy()
    assert not torch.equal(actor.mlp[0].weight, fresh)
    assert runner.alg.optimizer.state_dict()["state"][0]["step"] > 0
    # The latest checkpoint holds the same policy.
    policy = read_policy(find_checkpoint(run / "checkpoints" / "latest"), config)
    kernel = policy.params["params"]["MLP_0"]["hidden_0"]["kernel"]
    np.testing.assert_array_equal(actor.mlp[0].weight.detach().numpy().T, kernel)


@pytest.mark.slow
def test_run_is_evaluated_without_torch(run, tmp_path):
    """The same command prints the same table, and the best checkpoint gives the same results
    again."""
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


def test_best_policy_is_the_evaluated_policy(run):
    config = load_config(run / "config.yaml")
    checkpoint = find_checkpoint(run)
    results = json.loads((run / "results.json").read_text(encoding="utf-8"))
    assert checkpoint.steps == results["best_steps"]
    env = BounceBall(config.env)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    evaluate = make_evaluator(env, networks, config.eval_episodes)
    key = jax.random.split(jax.random.PRNGKey(np.uint32(config.eval_seed + 2**31)))[0]
    report = judge(env, evaluate(read_policy(checkpoint, config), key))
    for again, stored in zip(report.results, results["results"], strict=True):
        assert again.name == stored["name"]
        measured = stored["value"] is not None
        assert again.value == (pytest.approx(stored["value"], rel=1e-4) if measured else None)
    assert report.details["mean_return"] == pytest.approx(
        results["details"]["mean_return"], rel=1e-4
    )


def test_run_has_a_report(run):
    results = json.loads((run / "results.json").read_text(encoding="utf-8"))["results"]
    judged = [result["passed"] for result in results if result["passed"] is not None]
    kind = "results" if len(judged) == 5 else "judged results"
    report = (run / "report.html").read_text(encoding="utf-8")
    assert f"{sum(judged)} of {len(judged)} {kind} met" in report


def test_resumed_run_is_the_same_as_an_uninterrupted_one(run, library, tmp_path):
    half = train(tmp_path / "half", library, "--total-steps", "128", "--no-report")
    # Without --library, which the run records.
    torch_train.main(["--resume", str(half), "--total-steps", "256", "--no-report"])
    ours, theirs = (arrays(latest_checkpoint(folder)) for folder in (half, run))
    assert ours.keys() == theirs.keys()
    for name, expected in theirs.items():
        np.testing.assert_array_equal(ours[name], expected, err_msg=name)
    assert int(ours["iteration"]) == 4
    both = [json.loads((folder / "results.json").read_text()) for folder in (half, run)]
    assert both[0]["evaluations"] == both[1]["evaluations"]
    assert both[0]["results"] == both[1]["results"]


def test_stopped_run_has_the_model_of_its_checkpoint(tmp_path, monkeypatch):
    """It stops after an iteration, also when it was resumed; another run in the same folder gets no
    model."""
    (other := tmp_path / "2000-01-01").mkdir()
    (other / "config.yaml").touch()
    run_block = TorchTrainer.run

    def stop(trainer: TorchTrainer, iterations, stopping):
        os.kill(os.getpid(), signal.SIGTERM)
        while not stopping():
            time.sleep(0.01)
        return run_block(trainer, iterations, stopping)

    monkeypatch.setattr(TorchTrainer, "run", stop)
    # The process would end there.
    monkeypatch.setattr(run_command, "leave", sys.exit)
    flags = [*TINY, "--block-steps", "128", "--log-dir", str(tmp_path)]
    for steps in (64, 128):
        with pytest.raises(SystemExit) as exit_info:
            torch_train.main(flags)
        assert exit_info.value.code == 0
        (run,) = set(tmp_path.iterdir()) - {other}
        model, state = torch.load(run / "model.pt"), arrays(latest_checkpoint(run))
        assert latest_checkpoint(run).steps == steps and model["iter"] == steps // 64
        weights = [name for name in state if re.match(r"modules\..*weight$", name)]
        assert len(weights) == 4
        for name in weights:
            _, module, key = name.split(".", 2)
            np.testing.assert_array_equal(model[f"{module}_state_dict"][key], state[name])
        flags = ["--resume", str(run)]
    assert [path.name for path in other.iterdir()] == ["config.yaml"]


@pytest.mark.slow
def test_a_seed_trains_as_if_alone_and_stays_diverged(run, library, tmp_path, monkeypatch, capfd):
    run_block = TorchTrainer.run

    def spoilt(trainer: TorchTrainer, *args):
        if trainer.learners[1].iteration == 2:
            with torch.no_grad():
                trainer.learners[1]._parameters()[0].fill_(torch.nan)
        return run_block(trainer, *args)

    with monkeypatch.context() as patch:
        patch.setattr(TorchTrainer, "run", spoilt)
        seeds = train(tmp_path, library, "--num-seeds", "2", "--no-report")
    said = capfd.readouterr().out
    assert re.search(r"seed 1 diverged: .* was the first that was not finite, at iteration 3", said)
    together, alone = (arrays(latest_checkpoint(folder)) for folder in (seeds, run))
    for name, expected in alone.items():
        np.testing.assert_array_equal(together[name][0], expected, err_msg=name)

    torch_train.main(["--resume", str(seeds), "--total-steps", "512", "--no-report"])
    evaluated = [
        [e["steps"] for e in json.loads((seeds / seed / "results.json").read_text())["evaluations"]]
        for seed in ("seed_000", "seed_001")
    ]
    assert evaluated == [[128, 256, 384, 512], [128]]
    assert best_checkpoint(seeds / "seed_001").steps == 128


def test_run_of_another_library_is_not_resumed(run, library, capfd):
    with pytest.raises(SystemExit):
        train_command.main(["--resume", str(run), "--total-steps", "512"])
    sentence = capfd.readouterr().err
    assert f"was trained with {library}, not with jax" in sentence
    assert f"bounce-mjx train-torch --library {library} --resume {run}" in sentence


MISTAKES = {
    "library": ("--library tianshou", ("--library", "rsl_rl", "skrl", "tianshou")),
    "near miss": ("--num-envz 3", ("did you mean --num-envs?", "bounce-mjx train-torch --help")),
    "rollout": ("--num-envs 8 --rollout-length 8 --num-minibatches 7", ("divisor of 64",)),
}


@pytest.mark.parametrize("flags, words", MISTAKES.values(), ids=MISTAKES)
def test_mistakes_give_one_sentence(flags, words, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        torch_train.main(flags.split())
    error = capfd.readouterr().err
    assert exit_info.value.code == 2
    assert error.startswith("error: ") and error.count("\n") == 1
    assert all(word in error for word in words), error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("missing, library", [("rsl_rl", "rsl_rl"), ("skrl", "skrl")])
def test_missing_library_gives_one_sentence(missing, library, tmp_path):
    script = f"""
import sys
sys.modules[{missing!r}] = None
sys.argv = ["train_torch.py"] + {["--library", library, *TINY]!r}
from bounce_mjx.commands.train_torch import main
main(sys.argv[1:])
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
    """The newest run in a folder of runs, whichever trainer wrote it."""
    with pytest.raises(SystemExit):
        eval_command.main(["--log-dir", str(run.parent), "--episodes", "4"])
    assert str(run) in capsys.readouterr().out
