"""Learning curves, pictures, the report of a run, and the TensorBoard log."""

import base64
import io
import json
import math
import os
import re
import resource
import shutil
import signal
import threading
import time
import xml.etree.ElementTree
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboardX import SummaryWriter

import bounce_mjx
from bounce_mjx import BounceBall
from bounce_mjx.commands import plot as plot_command
from bounce_mjx.commands import report as report_command
from bounce_mjx.commands import train as train_command
from bounce_mjx.config.command_line import stdout
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.results import Report
from bounce_mjx.evaluation.statistics import empty_recording
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.reports import figures
from bounce_mjx.reports import page as report_page
from bounce_mjx.reports.curves import (
    Group,
    LoggedCurve,
    RunCurves,
    group_runs,
    mean_and_band,
    read_curves,
)
from bounce_mjx.reports.figures import curves_figure, rewards_figure
from bounce_mjx.reports.tables import result_cells, results_table, unsolved_line
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.creation import save_config
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.runs.progress import load_results
from bounce_mjx.task import Curve, term_names
from bounce_mjx.task.bounce import Bounce, Rewards
from bounce_mjx.task.bounce import Config as BounceConfig
from bounce_mjx.task.registry import find_task
from bounce_mjx.task.results import Result
from bounce_mjx.task.task import Hits
from bounce_mjx.training import setup
from bounce_mjx.training.events import Event
from bounce_mjx.training.job import TrainingStopped
from bounce_mjx.training.log import TensorBoardLog
from bounce_mjx.training.run import leave_report
from bounce_mjx.training.seeds import SeedRun
from tiny_runs import TINY

CHECKOUT = Path(__file__).parents[1]
TERMS = term_names(Rewards)
CURVES = (
    Curve("episode/return", "", title="return of an episode"),
    *(curve for curve in Bounce.curves if curve.title),
)


def write_run(folder: Path, config: TrainConfig, scalars: dict[str, dict[int, float]]) -> Path:
    """A run's folder with a config and a log, but no training."""
    folder.mkdir(parents=True)
    save_config(folder, config)
    with SummaryWriter(logdir=str(folder)) as log:
        for name, values in scalars.items():
            for step, value in values.items():
                log.add_scalar(name, value, step)
    return folder


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    """Three seeds of one config, of different lengths, and one run of another config."""
    rng = np.random.default_rng(0)
    folders = []
    for seed, num_envs, points in ((0, 4096, 5), (1, 4096, 4), (2, 4096, 5), (0, 2048, 5)):
        names = [curve.tag for curve in CURVES] + [f"reward/{name}" for name in TERMS]
        scalars = {
            name: {1000 * (i + 1): float(rng.random()) for i in range(points)} for name in names
        }
        config = TrainConfig(
            seed=seed,
            ppo=PPOConfig(num_envs=num_envs),
            log_dir=tmp_path / str(num_envs),
            total_steps=1000 * points,
        )
        folders.append(write_run(tmp_path / f"{seed}_{num_envs}", config, scalars))
    return folders


def test_runs_that_differ_in_the_seed_are_one_group(runs: list[Path]) -> None:
    groups = group_runs(runs)
    assert [[run.run for run in group.runs] for group in groups] == [runs[:3], runs[3:]]
    assert [group.label for group in groups] == [
        "num_envs 4096 (3 runs)",
        "num_envs 2048 (one run)",
    ]
    assert [group.label for group in group_runs(runs[:3])] == ["3 runs"]
    # How often a training is evaluated and saved changes nothing in it.
    path = runs[0] / "config.yaml"
    text = path.read_text()
    path.write_text(text.replace("eval_every: 2000000", "eval_every: 1000000"))
    assert path.read_text() != text
    assert [group.label for group in group_runs(runs[:3])] == ["3 runs"]


def test_a_sweep_of_an_own_algorithms_setting_is_several_groups(tmp_path: Path) -> None:
    """Though its code is not run."""
    runs = []
    for cost in (0.02, 0.2):
        config = TrainConfig(algorithm="smoothppo")
        run = write_run(tmp_path / str(cost), config, {"episode/return": {1: 1.0}})
        path = run / "config.yaml"
        path.write_text(path.read_text().replace("ppo:\n", f"ppo:\n  smoothness_cost: {cost}\n"))
        runs.append(run)
    labels = [group.label for group in group_runs(runs)]
    assert labels == ["smoothness_cost 0.02 (one run)", "smoothness_cost 0.2 (one run)"]
    plain = write_run(tmp_path / "plain", TrainConfig(), {"episode/return": {1: 1.0}})
    labels = [group.label for group in group_runs([plain, *runs])]
    assert labels[0] == "algorithm ppo (one run)"
    assert "smoothness_cost 0.2" in labels[2]


def test_the_labels_of_groups_differ(tmp_path: Path) -> None:
    """Whatever else the groups have of their own."""
    runs = []
    fast = BounceConfig(control_dt=0.005, action_scale=0.01, episode_seconds=10.0)
    for env, discount in ((BounceConfig(), 0.98), (fast, 0.98), (fast, 0.97)):
        config = TrainConfig(env=env, ppo=PPOConfig(discount=discount))
        run = tmp_path / str(len(runs))
        runs.append(write_run(run, config, {"episode/return": {1: 1.0}}))
    labels = [group.label for group in group_runs(runs)]
    assert len(set(labels)) == 3
    assert all("discount" in label and "control_dt" in label for label in labels)


def test_a_label_has_words_of_the_user(tmp_path: Path) -> None:
    """A key as far as it takes to know which weight it is, and a file's name; the code of its
    content only where another file has that name."""
    runs = []
    for name, own, weight in (("a", "", 1.0), ("b", "# mine", 1.0), ("c", "", 2.0)):
        reward = {"height": {"weight": weight}}
        config = TrainConfig(env=BounceConfig(reward=reward), algorithm="other")
        runs.append(write_run(tmp_path / name, config, {"episode/return": {1: 1.0}}))
        (runs[-1] / "algorithm").mkdir()
        (runs[-1] / "algorithm/other.py").write_text(own)
    labels = [group.label for group in group_runs(runs[::2])]
    assert labels == ["height.weight 1.0 (one run)", "height.weight 2.0 (one run)"]
    scaled = TrainConfig(env=BounceConfig(reward={"position": {"base_scale": 0.4}}))
    pair = []
    for name, config in (("scaled", scaled), ("usual", TrainConfig())):
        pair.append(write_run(tmp_path / name, config, {"episode/return": {1: 1.0}}))
    assert group_runs(pair)[0].label == "position.base_scale 0.4 (one run)"
    labels = [group.label for group in group_runs(runs[:2])]
    assert all(re.fullmatch(r"algorithm other [0-9a-f]{8} \(one run\)", label) for label in labels)
    assert len(set(labels)) == 2
    config = TrainConfig(env=BounceConfig(reward={"height": {"weight": 1.0}}))
    plain = write_run(tmp_path / "plain", config, {"episode/return": {1: 1.0}})
    assert [group.label for group in group_runs([plain, runs[0]])] == [
        "algorithm ppo (one run)",
        "algorithm other (one run)",
    ]


def test_a_legend_is_grey_where_groups_share_a_label() -> None:
    """The groups' own labels have their colours."""
    steps = np.array([1e6, 2e6])
    curves = {
        "episode/return": LoggedCurve(steps, np.array([1.0, 2.0])),
        "results/mean_return": LoggedCurve(steps, np.array([7.0, 9.0])),
    }
    groups = [Group(label, [RunCurves(Path("run"), curves, None)]) for label in ("a", "b")]
    colours = {}
    for number in (1, 2):
        (legend,) = curves_figure(groups[:number]).legends
        texts = [text.get_text() for text in legend.get_texts()]
        shown = [handle.get_color() for handle in legend.legend_handles]
        colours[number] = dict(zip(texts, shown, strict=True))
    points = "evaluation, actions not sampled"
    assert colours[1][points] == colours[1]["a"]
    assert colours[2][points] not in (colours[2]["a"], colours[2]["b"])
    assert colours[2]["a"] == colours[1]["a"] != colours[2]["b"]


@pytest.mark.parametrize(
    ("target_kl", "name"), [(0.01, "first learning_rate"), (0.0, "learning_rate")]
)
def test_a_learning_rate_that_adapts_is_labelled_as_the_first(target_kl, name, tmp_path) -> None:
    runs = []
    for rate in (1e-3, 1e-4):
        ppo = PPOConfig(learning_rate=rate, target_kl=target_kl)
        run = tmp_path / str(rate)
        runs.append(write_run(run, TrainConfig(ppo=ppo), {"episode/return": {1: 1.0}}))
    labels = [group.label for group in group_runs(runs)]
    assert labels == [f"{name} 0.001 (one run)", f"{name} 0.0001 (one run)"]


def test_a_curve_has_the_values_logged_last(tmp_path: Path) -> None:
    """A run that was resumed from step 2 logs step 3 again."""
    run = write_run(
        tmp_path / "run", TrainConfig(), {"episode/return": {1: 10.0, 2: 20.0, 3: 30.0}}
    )
    with SummaryWriter(logdir=str(run), filename_suffix=".resumed") as log:
        for step, value in ((3, 31.0), (4, 41.0)):
            log.add_scalar("episode/return", value, step)
    curve = read_curves(run).curves["episode/return"]
    assert curve.steps.tolist() == [1, 2, 3, 4]
    assert curve.values.tolist() == [10.0, 20.0, 31.0, 41.0]


def test_a_run_without_a_log_is_an_error(tmp_path: Path) -> None:
    save_config(tmp_path, TrainConfig())
    with pytest.raises(UserError, match="no learning curves.*start again"):
        read_curves(tmp_path)


def logged(run: Path, name: str) -> dict[int, float]:
    """The values of a scalar by step, read from the file itself."""
    (file,) = run.glob("events*")
    return {event.step: event.value for event in EventAccumulator(str(file)).Reload().Scalars(name)}


def test_only_the_figures_that_are_numbers_count(tmp_path: Path) -> None:
    values = {1: 2.0, 2: math.inf, 3: math.nan}
    scalars = {"episode/return": values, "reward/height": {1: -math.inf}}
    run = write_run(tmp_path / "run", TrainConfig(), scalars)
    curves = read_curves(run).curves
    assert list(curves) == ["episode/return"]
    assert (curves["episode/return"].steps, curves["episode/return"].values) == ([1], [2.0])
    # A figure without panels has its title alone.
    assert not rewards_figure(group_runs([run])).axes
    # The run was resumed and diverged: its first value is not that of the final policy.
    with SummaryWriter(logdir=str(run), filename_suffix=".resumed") as log:
        log.add_scalar("episode/return", math.nan, 1)
    with pytest.raises(UserError, match="no learning curves.*diverged"):
        read_curves(run)


def test_the_band_is_one_deviation_around_the_mean(runs: list[Path]) -> None:
    """The band covers the steps that all three seeds reached."""
    seeds = [logged(run, "episode/return") for run in runs[:3]]
    steps = [1000, 2000, 3000, 4000]
    values = np.array([[seed[step] for step in steps] for seed in seeds])
    (group,) = group_runs(runs[:3])
    at, mean, deviation = mean_and_band([run.curves["episode/return"] for run in group.runs])
    assert at.tolist() == steps
    np.testing.assert_allclose(mean, values.mean(axis=0))
    np.testing.assert_allclose(deviation, values.std(axis=0))

    axes = curves_figure([group]).axes[0]
    (band,) = axes.collections
    corners = band.get_paths()[0].vertices
    at_2000 = corners[corners[:, 0] == 2000.0, 1]
    expected = values[:, 1].mean() + values[:, 1].std() * np.array([-1.0, 1.0])
    np.testing.assert_allclose(sorted(set(at_2000)), expected)
    lengths = sorted(len(line.get_xdata()) for line in axes.lines)
    assert [n for n in lengths if n] == [4, 4, 5, 5]  # the mean, and each seed to its end


@pytest.mark.parametrize(
    ("first", "last", "lowest"), [(-900.0, -20.0, -900.0), (-50.0, 300.0, -50.0), (5.0, 90.0, 0.0)]
)
def test_a_panel_shows_its_whole_curve(first: float, last: float, lowest: float) -> None:
    """Also a return that is negative throughout; one that is not begins at 0."""
    steps = np.arange(1.0, 11.0)
    curves = {"episode/return": LoggedCurve(steps, np.linspace(first, last, 10))}
    figure = curves_figure([Group("one run", [RunCurves(Path("run"), curves, None)])])
    bottom, top = figure.axes[0].get_ylim()
    assert top > last and (bottom == 0.0 if lowest == 0.0 else bottom < lowest)


def test_a_panel_has_a_point_for_each_evaluation_and_steps_in_millions() -> None:
    """Beside the line of the training; and where all results were met, a line."""
    steps = np.array([1e6, 2e6, 4e6])
    curves = {
        "episode/return": LoggedCurve(steps, np.array([1.0, 2.0, 3.0])),
        "results/mean_return": LoggedCurve(steps[1:], np.array([7.0, 9.0])),
    }
    task_curves = (Curve("task/height", "", title="without a point yet"),)
    group = Group("one run", [RunCurves(Path("run"), curves, 4_000_000)], task_curves)
    axes, empty = curves_figure([group]).axes
    assert empty.get_xlim() == axes.get_xlim()
    (points,) = [
        line for line in axes.lines if line.get_label() == "evaluation, actions not sampled"
    ]
    assert (points.get_marker(), points.get_linestyle()) == ("o", "None")
    assert points.get_xydata().tolist() == [[2e6, 7.0], [4e6, 9.0]]
    (met,) = [line for line in axes.lines if line.get_label() == "all results met"]
    assert set(met.get_xdata()) == {4_000_000}
    assert [axes.xaxis.get_major_formatter()(x) for x in (0, 5e5, 2e6)] == ["0", "500k", "2M"]


def test_each_ball_is_drawn_and_the_legend_has_one_word_for_all() -> None:
    """Juggling, before the first step."""
    env = Env(find_task("juggle").Config())
    keys = jax.random.split(jax.random.PRNGKey(0), 1)
    shapes = jax.eval_shape(jax.vmap(env.reset, out_axes=-1), keys)
    states = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    recording = empty_recording(env, states, 1)
    recording = recording._replace(running=jnp.ones_like(recording.running))
    axes = figures.evaluation_figure(env, recording).axes[0]
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels[-2:] == ["balls", "paddle"] and labels.count("balls") == 1
    assert len(axes.lines) == len(labels) + 1


def test_hits_beside_the_paddle_are_drawn(env: BounceBall) -> None:
    """A ball bounces off an edge too, up to its radius beside the face."""
    half_x, half_y, _ = env.mj_model.geom_size[env.addresses.paddle_geom]
    points = np.array([[half_x + 0.018, 0.0, 0.0], [0.0, -half_y - 0.03, 0.0]])
    axes = Figure().subplots()
    figures.draw_hits(axes, env, Hits("hits", np.ones((2, 1), bool)), points)
    (right, left), (top, bottom) = axes.get_xlim(), axes.get_ylim()
    for x, y, _ in 100.0 * points:
        assert min(left, right) < y < max(left, right) and min(top, bottom) < x < max(top, bottom)


@pytest.fixture
def own_plots(monkeypatch):
    """Registers a plot for each of some titles, named own_0, own_1, ..."""
    monkeypatch.setattr(figures, "RUN_PLOTS", dict(figures.RUN_PLOTS))

    def register(*titles: str) -> None:
        for i, title in enumerate(titles):
            figures.run_plot(f"own_{i}", title)(lambda groups, columns=1: Figure((1.0, 1.0)))

    return register


@pytest.mark.parametrize("name", ["curves", "rewards", "evaluation"])
def test_no_plot_takes_the_place_of_one_of_the_package(name: str) -> None:
    with pytest.raises(UserError, match=f"'{name}' has the name of .*; choose another name"):
        figures.run_plot(name, "Mine")


def test_plot_of_several_runs(trained: Path, tmp_path: Path, own_plots, monkeypatch) -> None:
    """Set up as in any command that simulates."""
    set_up = []
    monkeypatch.setattr(setup, "set_up_jax", lambda *configs: set_up.extend(configs))
    other = shutil.copytree(trained, tmp_path / "other")
    save_config(other, read_preset(trained / "config.yaml").model_copy(update={"seed": 1}))
    (tmp_path / "p").mkdir()
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "p/curves.svg").symlink_to(tmp_path / "mine")
    own_plots("Mine", "Mine")
    plot_command.main([str(trained), str(other), "--formats", "svg", "--out", str(tmp_path / "p")])
    names = {"curves.svg", "rewards.svg", "own_0.svg", "own_1.svg"}
    assert {path.name for path in (tmp_path / "p").iterdir()} == names
    assert len(set_up) == 2
    assert (tmp_path / "mine").read_text() == "mine"


def check_report(run: Path, own_plots: int = 0) -> str:
    """The text of a report, after checking that the page is complete and needs no other file."""
    page = (run / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    replays = [source for source in sources if source.startswith("data:text/html;base64,")]
    assert len(replays) == 1 and b"<title>bounce_mjx</title>" in base64.b64decode(
        replays[0].partition(",")[2]
    )
    # Curves, the best checkpoint, and a panel for each reward term.
    assert len(sources) - len(replays) == 2 + own_plots + len(TERMS)
    for source in set(sources) - set(replays):
        kind, _, data = source.partition(",")
        assert kind == "data:image/svg+xml;base64"
        root = xml.etree.ElementTree.fromstring(base64.b64decode(data))
        # On a phone of 390 pixels, a text of 9 points is 9 pixels high.
        assert float(root.get("width").removesuffix("pt")) < 390
    assert "<script" not in page and "@import" not in page
    results = load_results(run)
    for result in results.best.results:
        assert f">{result.name}</td>" in page
        assert f">{as_shown(result.value)}</td>" in page
    for phase, seconds in results.seconds.items():
        assert re.search(rf">{phase}</td><td class=\"\">{seconds:.1f}</td>", page)
    config = re.search(r"<pre>(.*)</pre>", page, re.DOTALL)[1]
    shown = TrainConfig.model_validate(yaml.safe_load(config))
    assert shown == read_preset(run / "config.yaml")
    return page


def test_each_result_that_is_not_judged_is_explained() -> None:
    """Below the console's table, in which a name in brackets is no style."""
    bounds = {"height": "at most 0.1 (of 3 episodes)", "[speed]": "at most 2"}
    results = [Result(name, "error, m", 1.0, bound, None) for name, bound in bounds.items()]
    printed = io.StringIO()
    Console(file=printed, width=80).print(results_table(Report(tuple(results), {}), "results"))
    lines = [line.strip() for line in printed.getvalue().splitlines()]
    assert lines[-2:] == ["height: not judged (of 3 episodes)", "[speed]: not judged"]
    assert lines[3].startswith("[speed]")


@pytest.mark.parametrize(
    "value, bound, passed, text",
    [
        (98.997, ">= 99", False, "98.997"),
        (98.99, ">= 99", False, "98.99"),
        (99.004, ">= 99", True, "99.004"),
        (99.0, ">= 99", True, "99.00"),
        (1.4997154, "0.1 to 1.5 (targets 0.4 to 0.6 only)", True, "1.4997"),
        (1.5004, "0.1 to 1.5 (targets 0.4 to 0.6 only)", False, "1.5004"),
        (None, ">= 99", False, "-"),
    ],
)
def test_a_missed_bound_is_not_printed_as_its_value(value, bound, passed, text: str) -> None:
    result = Result("stable", "episodes, %", value, bound, passed)
    assert result_cells(result)[2] == text
    if not passed:
        assert f"stable {text} ({bound})" in unsolved_line(Report((result,), {}))


def test_the_advice_after_several_seeds_is_not_to_train_several() -> None:
    report = Report((Result("stable", "episodes, %", 90.0, ">= 99", False),), {})
    assert "--num-seeds" in unsolved_line(report)
    # Nor is a training, however short, told why it has not solved its task.
    assert "train longer while the return rises" in unsolved_line(report, num_seeds=2)
    assert "--num-seeds" not in unsolved_line(report, num_seeds=2)


def as_shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


NOMINAL_OUTCOME = {
    "perturbation": "nominal", "group": "nominal", "unit": "", "strength": None, "trained": True,
    "physics": "fused", "values": {"stable": 98.0}, "failed": [], "lasted": 1.0,
    "mean_length_s": 20.0,
}  # fmt: skip
ROBUSTNESS = {
    "checkpoint": "c", "steps": 12_000, "suite": "s.yaml", "episodes": 4, "seed": 0,
    "outcomes": [NOMINAL_OUTCOME],
}  # fmt: skip


def test_training_leaves_a_report(trained: Path) -> None:
    """The run's episodes of 0.5 s end before the height is measured."""
    page = check_report(trained)
    height = load_results(trained).best.results[2]
    assert (height.value, height.passed) == (None, False)
    assert ">-</td>" in re.search(r"<td[^>]*>height</td>.*", page)[0]
    assert "apex error - m, " in page
    assert "They show another policy" not in page
    # The log has no point either, which a curve would show as a perfect value.
    log = EventAccumulator(str(trained)).Reload().Tags()["scalars"]
    assert "results/stable" in log and "results/mean_return" in log
    assert not {"results/height", "results/mean_apex_error_m"} & set(log)
    met = sum(r.passed for r in load_results(trained).best.results)
    assert f"<h1>{met} of 5 results met</h1>" in page


@pytest.mark.slow
def test_report_is_drawn_again(
    trained: Path, tmp_path: Path, own_plots, capsys, monkeypatch
) -> None:
    """With each plot of the user's code, also of one title."""
    run, other = shutil.copytree(trained, tmp_path / "run"), tmp_path / "other"
    other.write_text("mine")
    (run / "report.html").unlink()
    (run / "report.html").symlink_to(other)
    own_plots("Mine", "Mine", "The best checkpoint")
    monkeypatch.setattr(report_page.mujoco, "__version__", "9.9")
    # The save of the results was interrupted, and the robustness is that of an earlier policy.
    results = json.loads((run / "results.json").read_text())
    results["best_steps"] += 1
    (run / "results.json").write_text(json.dumps(results))
    (run / "robustness.json").write_text(json.dumps(ROBUSTNESS))
    report_command.main([str(run)])
    check_report(run, own_plots=4)
    assert other.read_text() == "mine"
    page = (run / "report.html").read_text("utf-8")
    drawn_steps = results["best_steps"] - 1
    assert f"They show another policy than the results, that after {drawn_steps:,} steps." in page
    assert ">Perturbed worlds, of the policy after 12,000 steps</h2>" in page
    # A later MuJoCo writes the page, but did not train.
    versions = re.search("<p>Trained on .* with bounce_mjx (.*)\n.* MuJoCo 9.9, JAX", page)
    assert versions[1] == f"{bounce_mjx.__version__}." and "Peitian AIR4-560" in page
    # On a phone, what is wide scrolls by itself.
    assert page.count("<table>") == page.count('<div class="wide"><')
    assert capsys.readouterr().out.endswith("run/report.html\n")


@pytest.mark.slow
def test_a_failure_to_draw_does_not_lose_the_training(tmp_path: Path, monkeypatch, capsys) -> None:
    def fail(*_):
        raise RuntimeError("no\nfonts")

    monkeypatch.setattr(report_page, "write_report", fail)
    train_command.main([*TINY, "--total-steps", "128", "--log-dir", str(tmp_path)])
    (run,) = tmp_path.iterdir()
    assert json.loads((run / "results.json").read_text())["trained_steps"] == 128
    shown = capsys.readouterr().out
    assert f"report: not drawn (no fonts); draw it with: bounce-mjx report {run}\n" in shown
    assert shown.index("best checkpoint") < shown.index("report: not drawn")


def test_a_signal_while_the_report_is_drawn_says_how_to_draw_it(
    tmp_path: Path, monkeypatch
) -> None:
    """It does not wait for the drawing, whose run is already saved."""
    is_drawn = threading.Event()

    def draw(*_) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        is_drawn.wait()

    monkeypatch.setattr(report_page, "write_report", draw)
    seed = SeedRun(tmp_path, TrainConfig(), {})
    seed.progress.best = Report((), {})
    words = f"report: not drawn, as a signal came; draw it with: bounce-mjx report {tmp_path}"
    with pytest.raises(TrainingStopped, match=re.escape(words)):
        leave_report(seed, stdout(quiet=True))
    is_drawn.set()


def test_a_metric_that_no_curve_names_has_a_panel() -> None:
    points = LoggedCurve(np.array([1e6, 2e6]), np.array([0.1, 0.2]))
    curves = {"episode/return": points, "task/left_of": points, "task/too_fast": points}
    curves |= {"task/hidden": points, "reward/right": points}
    hidden = (Curve("task/hidden", "hidden", title=""),)
    group = Group("one run", [RunCurves(Path("run"), curves, None)], hidden)
    assert [axes.get_title() for axes in curves_figure([group]).axes] == [
        "return of an episode",
        "left of",
    ]


def test_tensorboard_reads_everything_back(trained: Path) -> None:
    log = EventAccumulator(str(trained)).Reload()
    tags = log.Tags()
    settings = log.SummaryMetadata("_hparams_/session_start_info").plugin_data
    assert settings.plugin_name == "hparams" and b"ppo.num_envs" in settings.content
    assert not any(tags[kind] for kind in ("audio", "histograms", "distributions", "images"))
    groups = {name.partition("/")[0] for name in tags["scalars"]}
    assert groups == {"episode", "loss", "policy", "results", "reward", "speed", "task"}

    # results.json measures the best policy once more, on fresh resets.
    logged_values = {event.step: event.value for event in log.Scalars("results/stable")}
    evaluations = load_results(trained).evaluations
    assert logged_values == {e["steps"]: pytest.approx(e["stable"]) for e in evaluations}


def test_a_full_disk_costs_points(tmp_path: Path) -> None:
    """The log stays one file, which TensorBoard reads to its end."""
    log = TensorBoardLog()
    log.start(tmp_path, TrainConfig())
    log(Event(tmp_path, TrainConfig(), 64, {"episode/return": 2.5}))
    (file,) = tmp_path.iterdir()
    free, (_, limit) = file.stat().st_size + 9, resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free, limit))
    try:
        log(Event(tmp_path, TrainConfig(), 128, {"episode/return": 3.5}))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    log(Event(tmp_path, TrainConfig(), 192, {"episode/return": 4.5}))
    assert list(tmp_path.iterdir()) == [file]
    assert logged(tmp_path, "episode/return") == {64: 2.5, 192: 4.5}


def test_a_clock_that_is_set_back_changes_no_curve(tmp_path: Path, monkeypatch) -> None:
    """The points that a killed training logged after its checkpoint do not count."""
    save_config(tmp_path, TrainConfig())
    killed = TensorBoardLog()
    for steps, value in ((64, 1.0), (128, 2.0), (192, 3.0)):
        killed(Event(tmp_path, TrainConfig(), steps, {"episode/return": value}))
    hour_ago = time.time() - 3600.0
    monkeypatch.setattr(time, "time", lambda: hour_ago)
    resumed = TensorBoardLog(64)
    resumed.start(tmp_path, TrainConfig())
    resumed(Event(tmp_path, TrainConfig(), 128, {"episode/return": 20.0}))
    curve = read_curves(tmp_path).curves["episode/return"]
    assert (curve.steps.tolist(), curve.values.tolist()) == ([64, 128], [1.0, 20.0])
    log = EventAccumulator(str(tmp_path)).Reload()
    assert [event.step for event in log.Scalars("episode/return")] == [64, 128]
