"""Robustness reports as a table and as a figure."""

import string
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from rich.markup import escape
from rich.table import Column, Table

from bounce_mjx.evaluation.robustness import ConditionOutcome, RobustnessReport
from bounce_mjx.evaluation.suite import NOMINAL
from bounce_mjx.reports.figures import PANEL_WIDTH, style
from bounce_mjx.reports.tables import figure_text, plain_table
from bounce_mjx.runs.files import read_stored

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
    version = f" of {report.version}" if report.version else ""
    return (
        f"{report.met} of {len(report.outcomes)} conditions{version} meet all judged results, with "
        f"{report.episodes} episodes each"
    )


def robustness_table(report: RobustnessReport) -> Table:
    """Table of the results in each condition; an asterisk marks a missed bound."""
    letters = result_letters(report)
    described = [f"{x}  {name}: {report.measured.get(name, '')}" for name, x in letters.items()]
    headers = "strength", *(f"{letter} " for letter in letters.values()), ""
    columns = [Column(header, justify="right") for header in headers]
    # A word that is wider than the terminal leaves continues in the next line.
    table = plain_table(summary(report), Column("condition", overflow="fold"), *columns)
    table.caption = escape("\n".join([*described, "*  misses its bound"]))
    for _, rows in _rows(report.outcomes):
        for i, outcome in enumerate(rows):
            name = escape(outcome.perturbation) if i == 0 else ""
            strength = "" if outcome.strength is None else f"{outcome.strength:g} {outcome.unit}"
            verdict = "[green]pass" if outcome.passed else "[red]FAIL"
            figures = []
            for result, value in outcome.values.items():
                text = figure_text(value, ".2f" if value is None or abs(value) < 10.0 else ".1f")
                figures.append(f"[red]{text}*" if result in outcome.failed else f"{text} ")
            table.add_row(name, strength.rstrip(), *figures, verdict)
    return table


def result_letters(report: RobustnessReport) -> dict[str, str]:
    """A letter for each result."""
    return dict(zip(report.outcomes[0].values, string.ascii_uppercase, strict=False))


@style()
def robustness_figure(report: RobustnessReport) -> Figure:
    """Chart of perturbations by strength. The colour of a cell shows the lowest of the results that
    are shares. A cell has a tick or the letters of the missed results; a frame marks conditions
    within the training ranges."""
    letters, rows = result_letters(report), _rows(report.outcomes)
    figure = Figure(figsize=(2.0 * PANEL_WIDTH, _LINE * len(rows) + 1.8), layout="constrained")
    figure.suptitle(summary(report), fontsize=10, wrap=True)
    axes = figure.subplots()
    cells = max(8, *(len(outcomes) for _, outcomes in rows))
    axes.set(xlim=(0.0, cells), ylim=(len(rows), 0.0), xticks=[], frame_on=False)
    axes.set_yticks(np.arange(len(rows)) + 0.5, [label for label, _ in rows])
    axes.tick_params(length=0, labelsize=8)
    axes.grid(False)
    for y, (label, (_, outcomes)) in enumerate(zip(axes.get_yticklabels(), rows, strict=True)):
        label.set_fontweight("normal" if outcomes else "bold")
        for x, outcome in enumerate(outcomes):
            shade = float(_SCALE(100.0 * report.worst_share(outcome)))
            edge = _INK if outcome.trained else "none"
            cell = Rectangle(
                (x + 0.05, y + 0.06), 0.9, 0.88, facecolor=_COLOURS(shade), edgecolor=edge
            )
            axes.add_patch(cell)
            strength = "" if outcome.strength is None else f"{outcome.strength:g}"
            missed = "".join(letters[name] for name in outcome.failed)
            ink = _INK if 0.2 < shade < 0.8 else _PAPER
            text = f"{strength}\n{missed or _TICK}"
            axes.text(x + 0.5, y + 0.5, text, fontsize=7, ha="center", va="center", color=ink)
    scale = ScalarMappable(_SCALE, _COLOURS)
    bar = figure.colorbar(
        scale, ax=axes, location="bottom", ticks=(0, 50, 75, 90, 100), shrink=0.5, aspect=50
    )
    bar.set_label("lowest result of those in %", fontsize=8)
    missed = "   ".join(f"{letter} {name}" for name, letter in letters.items())
    below = f"{_TICK} all judged results met; missed: {missed}; framed: within the trained ranges"
    figure.supxlabel(below, fontsize=8, wrap=True)
    return figure


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
