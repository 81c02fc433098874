"""The examples run to their end."""

import re
import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
# Three environments, whose compiled step the examples share.
SMALL = ["--num-envs", "3", "--steps"]


@pytest.mark.parametrize(
    "example, arguments, libraries, printed",
    [
        # A ball that the arm misses reaches the floor after 0.3 s.
        ("gymnasium_policy.py", ["--steps", "150"], ["onnxruntime"], r"[2-9] bounces in 1\.50 s"),
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
    assert 15 <= len((EXAMPLES / example).read_text().splitlines()) <= 60
