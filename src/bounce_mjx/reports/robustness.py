"""Robustness reports as a table and as a figure."""

import string
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from rich.markup import escape
from rich.table import Column, Table

from bounce_mjx.evaluation.results import is_share
from bounce_mjx.evaluation.robustness import ConditionOutcome, RobustnessReport
from bounce_mjx.evaluation.suite import NOMINAL, strength_text
from bounce_mjx.reports.figures import PANEL_WIDTH, style
from bounce_mjx.reports.tables import figure_text, plain_table
from bounce_mjx.runs.storage import read_stored

ROBUSTNESS_FILE = "robustness.json"

# Vermilion, sand and blue, which colour-blind readers can distinguish.
_COLOURS = LinearSegmentedColormap.from_list("stable", ["#c2451e", "#f4e3c3", "#2b7bba"])
# Most of the colour range covers the interesting shares near 100%.
_SCALE = PowerNorm(2.5, 0.0, 100.0)
_INK, _PAPER = "#222222", "#ffffff"
_TICK = "\u2713"
# Height of a row, in.
_LINE = 0.29


def load_robustness(folder: Path) -> RobustnessReport | None:
    """Reads the report of `bounce-mjx robustness` from a folder; None if there is none.

    Raises:
      UserError: the file is damaged.
    """
    return read_stored(folder / ROBUSTNESS_FILE, RobustnessReport)


def summary(report: RobustnessReport) -> str:
    """The score of a report in one sentence."""
    return (
        f"{report.met} of {len(report.outcomes)} conditions {_suite_name(report)} meet all judged "
        f"results, with {report.episodes} episodes each"
    )


def _suite_name(report: RobustnessReport) -> str:
    """The suite by its version, or else by its file's name or what it consists of."""
    if report.version:
        return f"of {report.version}"
    path = Path(report.suite)
    return f"({path.stem if path.suffix in ('.yaml', '.yml') else report.suite})"


def robustness_table(report: RobustnessReport) -> Table:
    """Table of the results in each condition; an asterisk marks a missed bound."""
    letters = result_letters(report)
    # A word that is wider than the terminal leaves continues in the next line.
    columns = [Column("condition", overflow="fold"), Column("strength", justify="right")]
    columns += [Column(f"{letter} ", justify="right") for letter in letters.values()]
    table = plain_table(summary(report), *columns, Column(justify="right"))
    legend = []
    for result, letter in letters.items():
        legend.append(f"{letter}  {result}: {report.measured.get(result, '')}")
    legend.append("*  misses its bound")
    table.caption = escape("\n".join(legend))
    for _, outcomes in _rows(report.outcomes):
        for i, outcome in enumerate(outcomes):
            name = escape(outcome.perturbation) if i == 0 else ""
            strength = strength_text(outcome.strength, outcome.unit)
            figures = [_figure_cell(outcome, result) for result in outcome.values]
            verdict = "[green]pass" if outcome.passed else "[red]FAIL"
            table.add_row(name, strength, *figures, verdict)
    return table


def _figure_cell(outcome: ConditionOutcome, result: str) -> str:
    """A result in a condition, with an asterisk if it misses its bound."""
    value = outcome.values[result]
    is_small = value is None or abs(value) < 10.0
    text = figure_text(value, ".2f" if is_small else ".1f")
    return f"[red]{text}*" if result in outcome.failed else f"{text} "


def result_letters(report: RobustnessReport) -> dict[str, str]:
    """A letter for each result."""
    return dict(zip(report.outcomes[0].values, string.ascii_letters.swapcase(), strict=False))


@style()
def robustness_figure(report: RobustnessReport) -> Figure:
    """Chart of perturbations by strength. The colour of a cell shows `worst_share`. A cell has a
    tick or the letters of the missed results; a frame marks conditions within the training
    ranges."""
    letters = result_letters(report)
    rows = _rows(report.outcomes)
    figure = Figure(figsize=(2.0 * PANEL_WIDTH, _LINE * len(rows) + 1.8), layout="constrained")
    figure.suptitle(summary(report), fontsize=10, wrap=True)
    axes = figure.subplots()
    widest = max(8, *(len(outcomes) for _, outcomes in rows))
    axes.set(xlim=(0.0, widest), ylim=(len(rows), 0.0), xticks=[], frame_on=False)
    axes.set_yticks(np.arange(len(rows)) + 0.5, [label for label, _ in rows])
    axes.tick_params(length=0, labelsize=8)
    axes.grid(False)
    for y, (_, outcomes) in enumerate(rows):
        if not outcomes:
            axes.get_yticklabels()[y].set_fontweight("bold")
        for x, outcome in enumerate(outcomes):
            missed = "".join(letters[name] for name in outcome.failed)
            _draw_cell(axes, (x, y), outcome, report.worst_share(outcome), missed)
    has_shares = any(map(is_share, report.measured.values()))
    label = "lowest result of those in %" if has_shares else "episodes that last, %"
    _draw_scale(figure, axes, label)
    missed = "   ".join(f"{letter} {name}" for name, letter in letters.items())
    below = f"{_TICK} all judged results met; missed: {missed}; framed: within the trained ranges"
    figure.supxlabel(below, fontsize=8, wrap=True)
    return figure


def _draw_cell(
    axes: Axes, corner: tuple[int, int], outcome: ConditionOutcome, share: float, missed: str
) -> None:
    """A condition's cell, of the size 1.

    Args:
      share: the lowest of its results that are shares, from 0 to 1.
      missed: letters of the results that it misses.
    """
    x, y = corner
    shade = float(_SCALE(100.0 * share))
    edge = _INK if outcome.trained else "none"
    face = _COLOURS(shade)
    axes.add_patch(Rectangle((x + 0.05, y + 0.06), 0.9, 0.88, facecolor=face, edgecolor=edge))
    # The unit stands beside the row.
    text = f"{strength_text(outcome.strength, '')}\n{missed or _TICK}"
    ink = _INK if 0.2 < shade < 0.8 else _PAPER
    axes.text(x + 0.5, y + 0.5, text, fontsize=7, ha="center", va="center", color=ink)


def _draw_scale(figure: Figure, axes: Axes, label: str) -> None:
    """The colours of the shares, below the cells."""
    bar = figure.colorbar(
        ScalarMappable(_SCALE, _COLOURS),
        ax=axes,
        location="bottom",
        ticks=(0, 50, 75, 90, 100),
        shrink=0.5,
        aspect=50,
    )
    bar.set_label(label, fontsize=8)


def _rows(outcomes: Sequence[ConditionOutcome]) -> list[tuple[str, list[ConditionOutcome]]]:
    """Each perturbation and its outcomes, below the heading of its group, without outcomes, in the
    order of the suite."""
    rows: list[tuple[str, list[ConditionOutcome]]] = []
    for group, members in groupby(outcomes, lambda outcome: outcome.group):
        rows += [(group, [])] if group != NOMINAL else []
        for name, cells in groupby(members, lambda outcome: outcome.perturbation):
            row = list(cells)
            rows.append((f"{name}, {row[0].unit}".rstrip(", "), row))
    return rows
