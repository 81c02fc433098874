"""The examples and the notebook run to their end."""

import json
import re
import runpy
import sys
from pathlib import Path

import pytest

from bounce_mjx.runs.config import load_config
from tiny_runs import TINY

EXAMPLES = Path(__file__).parents[1] / "examples"
# Three environments, whose compiled step the examples share.
SMALL = ["--num-envs", "3", "--steps"]


@pytest.mark.parametrize(
    "example, arguments, libraries, printed",
    [
        # A ball that the arm misses reaches the floor after 0.3 s.
        ("gymnasium_policy.py", ["--steps", "150"], ["onnxruntime"], r"[2-9] bounces in 1\.50 s"),
        ("gymnasium_policy.py", ["robust", "--steps", "150"], ["onnxruntime"], r"[2-9] bounces in"),
        ("sb3_ppo.py", [*SMALL, "96", "--judged-steps", "5"], ["stable_baselines3"], "5. stable"),
        ("sbx_ppo.py", [*SMALL, "96"], ["sbx"], ""),
        ("torchrl_ppo.py", [*SMALL, "96"], ["torchrl"], r"batch=0, reward=-?\d"),
        ("skrl_ppo.py", [*SMALL, "33"], ["skrl"], ""),
        ("cleanrl_ppo.py", [*SMALL, "192"], ["torch"], r"iteration=\d, episodic_return=-?\d"),
    ],
)
def test_example_runs(example, arguments, libraries, printed, need, monkeypatch, capsys, tmp_path):
    for library in libraries:
        need(library)
    if example != "gymnasium_policy.py":
        need("torch").set_num_threads(1)
    monkeypatch.setattr(sys, "argv", [example, *arguments])
    # skrl writes its log into the working folder.
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / example), run_name="__main__")
    assert re.search(printed, capsys.readouterr().out)


def test_notebook_trains_with_two_rewards_and_compares(need, opengl, tmp_path):
    """Every cell, with other parameters: two videos, a table of the two runs' results, curves."""
    nbformat, nbclient = need("nbformat"), need("nbclient")
    need("ipykernel")
    notebook = nbformat.read(EXAMPLES / "notebook.ipynb", as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    (parameters,) = (cell for cell in code if "parameters" in cell.metadata.get("tags", ()))
    training = " ".join([*TINY, "--total-steps 64 --no-report"])
    video = "--seconds 0.1 --size 96 64 --fps 20"
    parameters.source = f"SOURCE, TRAINING, VIDEO = '', '{training}', '{video}'"
    nbclient.NotebookClient(
        notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    shown = [output.data for cell in code for output in cell.outputs if "data" in output]
    *videos, table, curves = shown
    assert len(videos) == 2 and all("data:video/mp4" in data["text/html"] for data in videos)
    assert videos[0] != videos[1] and "image/png" in curves
    runs = [next((tmp_path / "runs" / name).iterdir()) for name in ("first", "calm")]
    weights = [load_config(run / "config.yaml").env.reward.action_rate.weight for run in runs]
    assert weights == [0.0001, 0.02]
    rows = re.findall(r"^\| (.+) \| .+ \| (.+) \| (.+) \|$", table["text/markdown"], re.MULTILINE)
    for i, run in enumerate(runs):
        results = json.loads((run / "results.json").read_text())["results"]
        expected = [(x["name"], x["value"]) for x in results]
        given = [(row[0], None if row[1 + i] == "-" else float(row[1 + i])) for row in rows[1:]]
        assert given == [
            (name, value and pytest.approx(value, rel=1e-3)) for name, value in expected
        ]


def test_examples_are_short():
    """Except a robot's control loop, which belongs to no library."""
    for path in set(EXAMPLES.glob("*.py")) - {EXAMPLES / "deploy.py"}:
        assert 15 <= len(path.read_text().splitlines()) <= 60, path.name
