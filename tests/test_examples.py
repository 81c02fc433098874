"""The examples and the notebook run to their end."""

import json
import re
import runpy
import sys
from pathlib import Path

import pytest

from bounce_mjx.runs.layers import read_preset

EXAMPLES = Path(__file__).parents[1] / "examples"
# Three environments, whose compiled step the examples share.
SMALL = ["--num-envs", "3", "--steps"]


def last_value_is_the_reward(names: dict) -> bool:
    """The distribution of the return at the last step of an episode has the reward as its mean."""
    torch = names["torch"]
    rewards, inputs = torch.tensor([-0.33, 0.0, 7.21]), torch.zeros(3, names["num_inputs"])
    distribution = names["target_distribution"](rewards, torch.zeros(3), inputs)
    torch.testing.assert_close(distribution.sum(-1), torch.ones(3))
    torch.testing.assert_close(distribution @ names["support"], rewards, atol=1e-4, rtol=0.0)
    return True


def judges_other_episodes(names: dict) -> bool:
    """No judged environment has a seed of the training."""
    trained_seeds = set(names["train_envs"].venv._envs.np_random_seed)
    return trained_seeds == {0, 1, 2} and not trained_seeds & set(names["eval_envs"].np_random_seed)


@pytest.mark.slow
@pytest.mark.parametrize(
    "example, arguments, libraries, shown",
    [
        # A ball that the arm misses reaches the floor after 0.3 s.
        ("gymnasium_policy.py", ["--steps", "150"], ["onnxruntime"], r"[2-9] bounces in 1\.50 s"),
        (
            "sb3_ppo.py",
            [*SMALL, "96", "--judged-steps", "5"],
            ["stable_baselines3"],
            judges_other_episodes,
        ),
        ("sbx_ppo.py", [*SMALL, "96"], ["sbx"], lambda names: names["model"].num_timesteps == 96),
        ("torchrl_ppo.py", [*SMALL, "96"], ["torchrl"], r"batch=0, reward=-?\d"),
        ("cleanrl_ppo.py", [*SMALL, "192"], ["torch"], r"iteration=\d, episodic_return=-?\d"),
        ("fasttd3.py", [*SMALL, "60", "--batch-size", "8"], ["torch"], last_value_is_the_reward),
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


# In place of the notebook's trainings, which take a minute each.
SHORT = {"num_envs": 8, "rollout_length": 8, "num_minibatches": 2, "num_epochs": 1}
SHORT |= {"hidden_layers": (16,), "block_steps": 64, "eval_every": 64, "eval_episodes": 4}
SHORT |= {"screening_episodes": 0, "episode_seconds": 0.5, "total_steps": 128}


@pytest.mark.slow
def test_notebook_shows_two_rewards_and_compares(need, opengl, tmp_path, quick_compilation):
    """Every cell, with a short video: the video, a table of the two runs' results, curves."""
    nbformat, nbclient = need("nbformat"), need("nbclient")
    need("ipykernel")
    notebook = nbformat.read(EXAMPLES / "notebook.ipynb", as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    (parameters,) = (cell for cell in code if "parameters" in cell.metadata.get("tags", ()))
    video = "--seconds 0.2 --size 96 64 --fps 10"
    parameters.source = f"SOURCE, TRAINING, VIDEO = '', {SHORT}, '{video}'"
    nbclient.NotebookClient(
        notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    shown = [output.data for cell in code for output in cell.outputs if "data" in output]
    printed = "".join(out.get("text", "") for cell in code for out in cell.outputs)
    assert "written: first.gif" in printed and "\x1b" not in printed
    assert len(re.findall(r"^0.00 M steps: \d of 5 results met$", printed, re.MULTILINE)) == 4
    video, table, curves = shown
    assert video["image/png"].startswith("R0lGOD") and "image/png" in curves
    runs = [next((tmp_path / "runs" / name).iterdir()) for name in ("first", "calm")]
    configs = [read_preset(run / "config.yaml") for run in runs]
    assert [config.env.reward.action_rate.weight for config in configs] == [0.0001, 0.02]
    rows = re.findall(r"^\| (.+) \| .+ \| (.+) \| (.+) \|$", table["text/markdown"], re.MULTILINE)
    for i, run in enumerate(runs):
        results = json.loads((run / "results.json").read_text())["results"]
        expected = [
            (x["name"], "-" if x["value"] is None else f"{x['value']:.4g}") for x in results
        ]
        assert [(row[0], row[1 + i]) for row in rows[1:]] == expected
