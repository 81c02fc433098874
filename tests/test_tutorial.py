"""The page of the tutorial: its task adds what it says to bouncing, and its commands run."""

import re
import shlex
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from bounce_mjx import task
from bounce_mjx.commands.main import main
from bounce_mjx.config.user_code import import_code
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.task.bounce import Bounce
from bounce_mjx.task.registry import find_task
from tiny_runs import TINY

CHECKOUT = Path(__file__).parent.parent
LINE = CHECKOUT / "examples" / "line_task.py"
PAGE = CHECKOUT / "docs" / "tutorial.md"
SHORT = {
    "eval": "--episodes 4",
    "play": "--seconds 0.2 --size 64 64",
    "export": "",
    "plot": "",
    "rehearse": "--seconds 0.5",
}


@pytest.fixture(autouse=True)
def line() -> type[Bounce]:
    import_code(LINE)
    return find_task("line")


@pytest.mark.parametrize("paddle_y, line_y", [(0.0, 0.03), (0.02, -0.03), (0.0, -0.005)])
def test_the_line_adds_its_term_and_its_metric_to_bouncing(
    line: type[Bounce], paddle_y: float, line_y: float
) -> None:
    """All else is bouncing's, number by number."""
    config = line.Config()
    angles = jnp.zeros(6)
    still = jnp.zeros(3)
    truth = task.Kinematics(
        angles,
        jnp.array([0.59, 0.0, 0.4]),
        None,
        angles,
        still,
        still,
        jnp.array([0.59, 0.0, 0.05]),
    )
    truth = truth._replace(paddle_position=truth.paddle_position.at[1].set(paddle_y))
    goal = {"target_height": jnp.float32(0.5), "line_y": jnp.float32(line_y)}
    step = task.Step(truth, goal, angles, angles)
    start = task.Start(truth, goal, jnp.zeros(0))
    lined, plain = line(config), Bounce(Bounce.Config())
    result = lined.step(lined.reset(start), step)
    expected = plain.step(plain.reset(start), step)
    right_by = max(0.0, 0.01 - (paddle_y - line_y))
    assert result.reward.pop("left_of_line") == pytest.approx(-2.0 * right_by / 0.03, abs=1e-6)
    assert bool(result.metrics.pop("left_of_line")) == (paddle_y > line_y)
    jax.tree.map(np.testing.assert_array_equal, result, expected)
    with pytest.raises(UserError, match="has the metric bounced already; choose another name"):
        result.plus(metrics={"bounced": 1.0})
    with pytest.raises(UserError, match="has the term of the reward height already"):
        result.plus(reward={"height": 1.0})
    tally = task.Tally({"hits": 1.0}).plus({"steps": 1.0}, {"longest": 2.0})
    assert tally == task.Tally({"hits": 1.0, "steps": 1.0}, {"longest": 2.0})
    with pytest.raises(UserError, match="has the sum hits already"):
        tally.plus({"hits": 1.0})


def test_the_policy_sees_the_line_which_moves_in_every_world(line: type[Bounce]) -> None:
    env = Env(line.Config())
    state = jax.eval_shape(lambda key: env.step(env.reset(key), jnp.zeros(6)), jax.random.key(0))
    assert env.layout["line_y"] == slice(29, 30) and "reward/left_of_line" in state.metrics
    assert env.config.in_world(task.RandomizationConfig()).randomization.goal_interval == (3, 3)


def copy_of_run(runs: Path, printed: str) -> None:
    """Copies the only run of a folder, with the config that `train --print-config` printed last."""
    (run,) = runs.iterdir()
    config = printed[printed.rindex("task: line") :]
    assert yaml.safe_load(config)["env"]["reward"]["left_of_line"]["weight"] == 0.2
    shutil.copytree(run, runs / "other")
    (runs / "other" / "config.yaml").write_text(config)


@pytest.mark.slow
def test_the_commands_of_the_tutorial_run(
    tmp_path: Path, monkeypatch, capsys, quick_compilation
) -> None:
    """From top to bottom, with a small training, which no result passes. LLVM takes most of the
    time, and its optimisations change nothing that this test sees."""
    monkeypatch.chdir(tmp_path)
    lines = re.findall(r"^ {4}bounce-mjx (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    ran = []
    for text in lines:
        name, *words = shlex.split(text.replace("examples/line_task.py", str(LINE)))
        if name == "view":
            # The page of a browser waits for its user.
            words += ["--html", "view.html", "--seconds", "0.1"]
        elif name == "train" and "train" in ran:
            # Its programs differ from the first one's by a constant, and take as long to compile.
            words += [*TINY, "--print-config"]
        elif name == "train":
            words += [*TINY, "--total-steps", "128"]
        else:
            words += SHORT[name].split()
        if name == "plot":
            trained = capsys.readouterr().out
            copy_of_run(tmp_path / "runs/line", trained)
            runs = sorted(map(str, (tmp_path / "runs/line").iterdir()))
            words = [*runs, *(word for word in words if "*" not in word), "--formats", "svg"]
        try:
            main([name, *words])
        except SystemExit as end:
            # An untrained policy passes no result.
            assert end.code in (0, 1), capsys.readouterr().err
        ran.append(name)
    assert ran == ["view", "train", "eval", "play", "export", "rehearse", "train", "plot"]
    assert "left of the line" in trained
    for file in ("view.html", "line.mp4", "line.onnx"):
        assert (tmp_path / file).stat().st_size > 1000
    for report in tmp_path.glob("runs/line/*/report.html"):
        assert "left of the line" in report.read_text(encoding="utf-8")
    legend = (tmp_path / "plots/curves.svg").read_text(encoding="utf-8")
    assert "weight 0.2" in legend and "weight 2.0" in legend
