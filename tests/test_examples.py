"""The examples and the notebook run to their end."""

import json
import re
import runpy
import sys
from pathlib import Path

import pytest

from bounce_mjx.runs.config import load_config

EXAMPLES = Path(__file__).parents[1] / "examples"
# Three environments, whose compiled step the examples share.
SMALL = ["--num-envs", "3", "--steps"]


@pytest.mark.parametrize(
    "example, arguments, libraries, shown",
    [
        # A ball that the arm misses reaches the floor after 0.3 s.
        ("gymnasium_policy.py", ["--steps", "150"], ["onnxruntime"], r"[2-9] bounces in 1\.50 s"),
        ("gymnasium_policy.py", ["robust", "--steps", "150"], ["onnxruntime"], r"[2-9] bounces in"),
        ("sb3_ppo.py", [*SMALL, "96", "--judged-steps", "5"], ["stable_baselines3"], "5. stable"),
        ("sbx_ppo.py", [*SMALL, "96"], ["sbx"], lambda names: names["model"].num_timesteps == 96),
        ("torchrl_ppo.py", [*SMALL, "96"], ["torchrl"], r"batch=0, reward=-?\d"),
        ("cleanrl_ppo.py", [*SMALL, "192"], ["torch"], r"iteration=\d, episodic_return=-?\d"),
    ],
)
def test_example_runs(example, arguments, libraries, shown, need, monkeypatch, capsys, tmp_path):
    """It prints a pattern, or its final names hold the result of an update."""
    for library in libraries:
        need(library)
    if example != "gymnasium_policy.py":
        need("torch").set_num_threads(1)
    monkeypatch.setattr(sys, "argv", [example, *arguments])
    # skrl writes its log into the working folder.
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(EXAMPLES / example), run_name="__main__")
    assert shown(names) if callable(shown) else re.search(shown, capsys.readouterr().out)


# In place of a training, which other tests run: the run that its flags would make, with the
# pretrained policy. The full training takes minutes.
TRAINED = """
import json, sys
from tensorboardX import SummaryWriter
from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import create_run, pretrained_checkpoint
from bounce_mjx.runs.reading import read_policy
from bounce_mjx.runs.writing import save_checkpoint
from bounce_mjx.training.command import read_command

config = read_command(sys.argv[1:]).training
layers = {"hidden_layers": load_run_config(pretrained_checkpoint().run).ppo.hidden_layers}
config = config.model_copy(update={"ppo": config.ppo.model_copy(update=layers)})
run, results = create_run(config), json.loads(resource_path("pretrained/results.json").read_text())
save_checkpoint(run, config, 64, {"policy": read_policy(pretrained_checkpoint(), config)})
(run / "results.json").write_text(json.dumps(results))
with SummaryWriter(logdir=str(run)) as log:
    log.add_scalar("episode/return", 1.0, 1000)
    log.add_scalar("episode/return", 2.0, 2000)
"""


@pytest.mark.slow
def test_notebook_shows_two_rewards_and_compares(need, opengl, tmp_path, monkeypatch):
    """Every cell, with a short video: the video, a table of the two runs' results, curves."""
    nbformat, nbclient = need("nbformat"), need("nbclient")
    need("ipykernel")
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    notebook = nbformat.read(EXAMPLES / "notebook.ipynb", as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    (parameters,) = (cell for cell in code if "parameters" in cell.metadata.get("tags", ()))
    video = "--seconds 0.1 --size 96 64 --fps 20"
    parameters.source = f"SOURCE, TRAINING, VIDEO = '', '--stop-when-solved', '{video}'"
    (tmp_path / "train.py").write_text(TRAINED)
    for cell in code:
        cell.source = cell.source.replace("{COMMAND} train", "{sys.executable} train.py")
    nbclient.NotebookClient(
        notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    shown = [output.data for cell in code for output in cell.outputs if "data" in output]
    printed = "".join(out.get("text", "") for cell in code for out in cell.outputs)
    assert "written: first.mp4" in printed and "\x1b" not in printed
    video, table, curves = shown
    assert "data:video/mp4" in video["text/html"] and "image/png" in curves
    runs = [next((tmp_path / "runs" / name).iterdir()) for name in ("first", "calm")]
    configs = [load_config(run / "config.yaml") for run in runs]
    assert [config.env.reward.action_rate.weight for config in configs] == [0.0001, 0.02]
    assert all(config.stop_when_solved for config in configs)
    rows = re.findall(r"^\| (.+) \| .+ \| (.+) \| (.+) \|$", table["text/markdown"], re.MULTILINE)
    for i, run in enumerate(runs):
        results = json.loads((run / "results.json").read_text())["results"]
        expected = [(x["name"], pytest.approx(x["value"], rel=1e-3)) for x in results]
        assert [(row[0], float(row[1 + i])) for row in rows[1:]] == expected


def test_examples_are_short():
    """Except robots' control loops, a task, and skrl, whose networks are the user's."""
    for path in set(EXAMPLES.glob("*.py")) - {EXAMPLES / "deploy.py"}:
        others = {"dribble_task.py": 120, "ur_rtde_bridge.py": 75, "ros2_bridge.py": 75}
        others["skrl_ppo.py"] = 95
        longest = others.get(path.name, 60)
        assert 15 <= len(path.read_text().splitlines()) <= longest, path.name
