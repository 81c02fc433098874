"""The report of a run: one self-contained HTML page.

Training writes it after its results; `bounce-mjx report [RUN]` writes it again.
"""

import html
from pathlib import Path

import jax
import mujoco

from bounce_mjx.config.files import dump_config
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.config import EvaluationOptions
from bounce_mjx.evaluation.policy_evaluation import evaluate_policy
from bounce_mjx.evaluation.statistics import RECORDED_EPISODES
from bounce_mjx.reports import figures
from bounce_mjx.reports.curves import group_runs
from bounce_mjx.reports.html_page import data_url, figures_html, page, panels_html, table
from bounce_mjx.reports.robustness import load_robustness, robustness_figure
from bounce_mjx.reports.tables import details_line, result_cells
from bounce_mjx.runs.checkpoints import read_actor
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import best_checkpoint
from bounce_mjx.runs.progress import load_results
from bounce_mjx.runs.records import Checkpoint
from bounce_mjx.runs.storage import write_output
from bounce_mjx.task.task import Recording
from bounce_mjx.viewers.page import replay_first_and_worst, worst_episode

# Panels side by side in a figure that fits a phone, and its width in inches.
_COLUMNS = 2
_WIDTH = _COLUMNS * figures.PANEL_WIDTH


def record_checkpoint(checkpoint: Checkpoint) -> Recording:
    """Records some episodes of a checkpoint's policy, on the physics engine of its config."""
    config = load_run_config(checkpoint.run)
    _, policy, actor = read_actor(checkpoint, config)
    options = EvaluationOptions(RECORDED_EPISODES)
    evaluated = evaluate_policy(policy, config.env, actor, options, recorded=RECORDED_EPISODES)
    return evaluated.report.recording


def write_report(run: Path, recording: Recording | None = None) -> Path:
    """Writes `report.html` into a run's folder; its path.

    Args:
      recording: episodes of the run's best checkpoint; by default, new ones.

    Raises:
      UserError: the run has no results or no log yet, one of their files is damaged, or the page
        cannot be written.
    """
    results = load_results(run)
    if results is None:
        raise UserError(f"{run} has no results yet; wait for the end of its training")
    config = load_run_config(run)
    groups = group_runs([run])
    env = Env(config.env)
    drawn_steps = results.best_steps
    if recording is None:
        checkpoint = best_checkpoint(run)
        drawn_steps = checkpoint.steps
        recording = record_checkpoint(checkpoint)
    robustness = load_robustness(run)
    drawn = [("The best checkpoint", figures.evaluation_figure(env, recording, _WIDTH))]
    for plot in figures.RUN_PLOTS.values():
        if plot.title is not None:
            drawn.append((plot.title, plot.draw(groups, columns=_COLUMNS)))
    if robustness is not None:
        title = f"Perturbed worlds, of the policy after {robustness.steps:,} steps"
        drawn.append((title, robustness_figure(robustness)))
    robot = "Peitian AIR4-560" if config.env.mjcf is None else config.env.mjcf.stem
    replay = replay_first_and_worst(env, recording)
    report = results.best
    num_recorded = recording.running.shape[-1]
    worst = "the worst" if worst_episode(recording) == 0 else "and in the worst"
    seconds = results.seconds | {"total": sum(results.seconds.values())}
    phases = [[name, f"{value:.1f}"] for name, value in seconds.items()]
    another = ""
    if drawn_steps != results.best_steps:
        # A save was interrupted, or the best checkpoint is damaged.
        another = f" They show another policy than the results, that after {drawn_steps:,} steps."
    resets = "fresh resets" if results.fresh_resets else "the resets of the selection"
    body = f"""<h1>{html.escape(report.summary)}</h1>
<p>Run <code>{html.escape(str(run))}</code>, seed {config.seed}, task {html.escape(config.task)} on
the robot {html.escape(robot)}. The best of {len(results.evaluations)} evaluations,
after {results.best_steps:,} of {results.trained_steps:,} environment steps, on {resets}:
{html.escape(details_line(report))}.</p>
<p>Trained on {html.escape(results.device)} with bounce_mjx {html.escape(results.version or "?")}.
Replayed and drawn with {env.engine.name} physics, MuJoCo {mujoco.__version__}, JAX
{jax.__version__}.{another}</p>
{table(["result", "measured", "value", "bound", ""], map(result_cells, report.results))}
<h2>The policy in its first recorded episode, {worst} of {num_recorded}</h2>
<iframe title="Replay" src="{data_url("text/html", replay.encode())}"></iframe>
<p>In the learning curves, lines are the training, whose actions are sampled (exploration); points
are evaluations, whose actions are not. Errors may rise first, when sampled actions scatter
most.</p>
{figures_html(drawn)}
<h2>Reward terms</h2>
<p>Weighted, the mean of a control step, over environment steps. The dotted line is the first
evaluation that met all results.</p>
{panels_html(figures.reward_panels(groups))}
<h2>Where the time went</h2>
{table(["phase", "seconds"], phases)}
<details><summary>Config</summary><pre>{html.escape(dump_config(config))}</pre></details>"""
    path = run / "report.html"
    write_output(path, page(run.absolute().name, body))
    return path
