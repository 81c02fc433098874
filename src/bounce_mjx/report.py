"""The report of a run, one self-contained page: `python -m bounce_mjx.report [RUN]`.

The main job writes it too, once it has printed its results.
"""

import base64
import html
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro
from matplotlib.figure import Figure

from bounce_mjx.cli import parse
from bounce_mjx.config import StrictModel, TrainConfig, dump_config
from bounce_mjx.env import BounceBall
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation import DEFAULT_SEED, Report, make_recording_evaluator
from bounce_mjx.figures import curves_figure, evaluation_figure, image, pixels, rewards_figure
from bounce_mjx.learning_curves import group_runs
from bounce_mjx.policy import make_networks
from bounce_mjx.recording import RECORDED_EPISODES, Recording
from bounce_mjx.reporting import details_line, open_log, verdict
from bounce_mjx.runs import (
    Checkpoint,
    find_checkpoint,
    load_policy,
    load_results,
    load_run_config,
)

REPORT_FILE = "report.html"


class ReportCommand(StrictModel):
    """The command line."""

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """A run's folder; left out: the newest run."""
    log_dir: Path = Path("runs/bounce_ball")
    """Where to look for the newest run."""


def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        command = parse(
            ReportCommand,
            sys.argv[1:] if args is None else args,
            prog="python -m bounce_mjx.report",
            description="Writes the report of a run, report.html in its folder.",
        )
        checkpoint = find_checkpoint(command.run, command.log_dir)
        path, _ = write_report(checkpoint.run, record_checkpoint(checkpoint))
        print(path)


def record_checkpoint(checkpoint: Checkpoint) -> Recording:
    """Runs the policy of a checkpoint for some episodes, on the physics engine of its config."""
    config = load_run_config(checkpoint.run)
    policy = load_policy(checkpoint, config)
    env = BounceBall(config.env)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    evaluate = make_recording_evaluator(env, networks, RECORDED_EPISODES, RECORDED_EPISODES)
    return evaluate(policy, jax.random.PRNGKey(DEFAULT_SEED))[1]


def report_training(run: Path, report: Report, steps: int) -> Path:
    """Writes the report of a training that has just ended, and its picture of the evaluation into
    the TensorBoard log.

    Args:
      report: of the best checkpoint; its recording is missing if the run was resumed and none of
        the new evaluations was the best.
      steps: environment steps at the best checkpoint.

    Returns:
      The page.

    Raises:
      UserError: the page cannot be written.
    """
    recording = report.recording or record_checkpoint(find_checkpoint(run, run))
    page, evaluation = write_report(run, recording)
    # A file of its own, as that of the training is closed.
    with open_log(run, suffix=".report") as log:
        log.add_image("evaluation", pixels(evaluation), steps, dataformats="HWC")
    return page


def write_report(run: Path, recording: Recording) -> tuple[Path, Figure]:
    """Writes `report.html` into a run's folder.

    Args:
      recording: episodes of the run's best checkpoint.

    Returns:
      The page, and its picture of the evaluation.

    Raises:
      UserError: the run has no results or no log yet, or the page cannot be written.
    """
    results = load_results(run)
    if results is None:
        raise UserError(f"{run} has no results yet; wait for the end of its training")
    config = load_run_config(run)
    groups = group_runs([run])
    evaluation = evaluation_figure(BounceBall(config.env), recording)
    figures = {
        "Learning curves": curves_figure(groups),
        "The best checkpoint": evaluation,
        "Reward terms": rewards_figure(groups),
    }
    page = run / REPORT_FILE
    try:
        page.write_text(_page(run, config, results, figures), encoding="utf-8")
    except OSError as error:
        raise UserError(
            f"{page} cannot be written ({error.strerror}); make the folder writable"
        ) from error
    return page, evaluation


def _page(run: Path, config: TrainConfig, results: dict[str, Any], figures: dict[str, Figure]):
    report = Report.from_dict(results)
    met = sum(result.passed is not False for result in report.results)
    pictures = "".join(
        f'<h2>{title}</h2>\n<img alt="{title}" src="{_embed(figure)}">\n'
        for title, figure in figures.items()
    )
    seconds = results["seconds"]
    phases = [[name, f"{value:.1f}"] for name, value in seconds.items()]
    names = [result.name for result in report.results]
    evaluations = [
        [f"{e['steps']:,}", *[f"{e[name]:.2f}" for name in names], "pass" if e["passed"] else "-"]
        for e in results["evaluations"]
    ]
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>bounce_mjx: {html.escape(run.name)}</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>{met} of {len(report.results)} results met</h1>
<p>Run <code>{html.escape(str(run))}</code>, seed {config.seed}, on
{html.escape(results["device"])}. The best of {len(evaluations)} evaluations, after
{results["best_steps"]:,} of {results["trained_steps"]:,} environment steps:
{html.escape(details_line(report))}.</p>
{_results(report)}
{pictures}
<h2>Where the time went</h2>
{_table(["phase", "seconds"], [*phases, ["together", f"{sum(seconds.values()):.1f}"]])}
<h2>All evaluations</h2>
{_table(["environment steps", *names, "all five"], evaluations)}
<details><summary>Config</summary><pre>{html.escape(dump_config(config))}</pre></details>
</body>
</html>
"""


def _results(report: Report) -> str:
    rows = [
        [result.name, result.measured, f"{result.value:.2f}", result.bound, verdict(result)]
        for result in report.results
    ]
    return _table(["result", "measured", "value", "bound", ""], rows)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; a cell is coloured where it is a verdict."""

    def row(tag: str, cells: Sequence[str]) -> str:
        inner = "".join(f'<{tag} class="{_class(c)}">{html.escape(c)}</{tag}>' for c in cells)
        return f"<tr>{inner}</tr>\n"

    body = "".join(row("td", cells) for cells in rows)
    return f"<table>\n{row('th', header)}{body}</table>"


def _class(cell: str) -> str:
    return {"pass": "pass", "FAIL": "fail"}.get(cell, "")


def _embed(figure: Figure) -> str:
    return f"data:image/svg+xml;base64,{base64.b64encode(image(figure, 'svg')).decode()}"


_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 68rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; background: #fff; }
h1 { margin-bottom: 0; } h2 { margin: 2rem 0 0.5rem; font-size: 1.15rem; }
img { width: 100%; }
table { border-collapse: collapse; }
th, td { padding: 0.2rem 0.9rem 0.2rem 0; text-align: left; border-bottom: 1px solid #ddd; }
.pass { color: #00704f; font-weight: bold; } .fail { color: #b00020; font-weight: bold; }
code, pre { font-size: 13px; } summary { cursor: pointer; margin-top: 2rem; font-weight: bold; }
"""


if __name__ == "__main__":
    main()
