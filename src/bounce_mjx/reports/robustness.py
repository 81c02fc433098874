"""Robustness reports as a table and as a figure."""

import string
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from rich import box
from rich.markup import escape
from rich.table import Table

from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.robustness import ConditionOutcome, RobustnessReport
from bounce_mjx.evaluation.suite import NOMINAL
from bounce_mjx.reports.figures import literal, style
from bounce_mjx.reports.tables import short_text
from bounce_mjx.runs.files import read_json

ROBUSTNESS_FILE = "robustness.json"

# Vermilion, sand and blue, which colour-blind readers can distinguish.
_COLOURS = LinearSegmentedColormap.from_list("stable", ["#c2451e", "#f4e3c3", "#2b7bba"])
# Most of the colour range covers the interesting shares near 100%.
_SCALE = PowerNorm(2.5, 0.0, 100.0)
_INK, _PAPER = "#222222", "#ffffff"

# Lengths in inches.
_WIDTH, _LINE, _LABEL = 10.0, 0.29, 1.95
_TOP, _BOTTOM = 0.65, 0.95


def load_robustness(folder: Path) -> RobustnessReport | None:
    """Reads the report of `bounce-mjx robustness` from a folder; None if there is none.

    Raises:
      UserError: the file is damaged.
    """
    path = folder / ROBUSTNESS_FILE
    if not path.is_file():
        return None
    try:
        return read_json(path, RobustnessReport)
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path} cannot be read ({error}); delete it, or write it again with bounce-mjx "
            "robustness"
        ) from error


def summary(report: RobustnessReport) -> str:
    """Summary of a report in one sentence."""
    return (
        f"{report.met} of {len(report.outcomes)} conditions meet all judged results, with "
        f"{report.episodes} episodes each"
    )


def robustness_table(report: RobustnessReport) -> Table:
    """Table of the results in each condition; an asterisk marks a missed bound."""
    letters = result_letters(report)
    described = [
        f"{letter}  {name}: {report.measured[name]}" if report.measured else f"{letter}  {name}"
        for name, letter in letters.items()
    ]
    table = Table(
        title=summary(report),
        title_justify="left",
        caption=escape("\n".join([*described, "*  misses its bound"])),
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 0, 0, 1),
        pad_edge=False,
    )
    table.add_column("condition")
    table.add_column("strength", justify="right")
    for header in (*(f"{letter} " for letter in letters.values()), ""):
        table.add_column(header, justify="right")
    for rows in _perturbations(report.outcomes):
        for i, outcome in enumerate(rows):
            name = escape(outcome.perturbation) if i == 0 else ""
            strength = "" if outcome.strength is None else f"{outcome.strength:g} {outcome.unit}"
            verdict = "[green]pass" if outcome.passed else "[red]FAIL"
            table.add_row(name, strength.rstrip(), *_figures(outcome), verdict)
    return table


def result_letters(report: RobustnessReport) -> dict[str, str]:
    """A letter for each result: an initial of its name that no other has, if there is one. The
    results with the fewest words choose first."""
    letters = dict.fromkeys(report.outcomes[0].values, "")
    for name in sorted(letters, key=lambda name: len(name.split())):
        wanted = [word[0] for word in name.split()] + [*name, *string.ascii_letters]
        free = [x.upper() for x in wanted if x.isalnum() and x.upper() not in letters.values()]
        letters[name] = free[0] if free else "?"
    return letters


def robustness_figure(report: RobustnessReport) -> Figure:
    """Chart of perturbations by strength. The colour of a cell shows the share of the episodes
    that last until their time limit. A cell has a tick or the letters of the missed results; a
    frame marks conditions within the training ranges."""
    columns, letters = _columns(report.outcomes), result_letters(report)
    lines = max(sum(_lines(group) for group in column) for column in columns)
    height = _LINE * lines + _TOP + _BOTTOM
    with style():
        figure = Figure(figsize=(_WIDTH, height))
        title = f"{report.met} of {len(report.outcomes)} conditions meet all judged results"
        below = f"{report.episodes} episodes in each condition, {_engines_text(report)}"
        figure.text(0.02, 1 - 0.25 / height, title, va="center", fontsize=11, fontweight="bold")
        figure.text(0.02, 1 - 0.48 / height, literal(below), va="center", fontsize=8.5)
        cells = max(len(row) for column in columns for _, rows in column for row in rows)
        for i, column in enumerate(columns):
            axes = figure.add_axes(
                (
                    (i * _WIDTH / 2 + _LABEL) / _WIDTH,
                    _BOTTOM / height,
                    (_WIDTH / 2 - _LABEL - 0.12) / _WIDTH,
                    _LINE * lines / height,
                )
            )
            axes.set_xlim(0.0, max(8, cells))
            axes.set_ylim(lines, 0.0)
            axes.axis("off")
            _draw_column(axes, column, letters)
        framed = any(outcome.trained for outcome in report.outcomes[1:])
        _draw_legend(figure, height, letters, framed)
    return figure


def _engines_text(report: RobustnessReport) -> str:
    """Engine of most perturbations, and the perturbations that other engines simulated."""
    names = {"fused": "the fused engine", "mjx": "MJX", "mujoco": "MuJoCo's C engine"}
    engines = report.engines
    most = max(engines, key=lambda engine: len(engines[engine]))
    others = (
        f"; {', '.join(sorted(engines[other]))} on {names[other]}"
        for other in sorted(engines.keys() - {most})
    )
    return f"on {names[most]}{''.join(others)}"


def _figures(outcome: ConditionOutcome) -> Iterable[str]:
    """Cells of a table row for the results."""
    for name, value in outcome.values.items():
        text = short_text(value)
        yield f"[red]{text}*" if name in outcome.failed else f"{text} "


def _perturbations(outcomes: Sequence[ConditionOutcome]) -> list[list[ConditionOutcome]]:
    """Outcomes grouped by perturbation, in the order of the suite."""
    return [list(rows) for _, rows in groupby(outcomes, lambda outcome: outcome.perturbation)]


_Heading = tuple[str, list[list[ConditionOutcome]]]
"""A group's name, and the outcomes of each of its perturbations."""


def _columns(outcomes: Sequence[ConditionOutcome]) -> list[list[_Heading]]:
    """Groups of perturbations in two columns of about equal length."""
    rows = _perturbations(outcomes)
    groups = [(name, list(members)) for name, members in groupby(rows, lambda row: row[0].group)]
    lengths = [_lines(group) for group in groups]
    splits = range(1, len(groups) + 1)
    split = min(splits, key=lambda i: max(sum(lengths[:i]), sum(lengths[i:])))
    return [groups[:split], groups[split:]] if groups[split:] else [groups[:split]]


def _lines(group: _Heading) -> float:
    """Height of a group in lines, including its heading and a gap."""
    name, rows = group
    return len(rows) + (0.3 if name == NOMINAL else 1.6)


def _draw_column(axes: Axes, groups: Sequence[_Heading], letters: dict[str, str]) -> None:
    y = 0.0
    for name, rows in groups:
        if name != NOMINAL:
            heading = literal(name)
            axes.text(
                -0.15, y + 0.75, heading, ha="right", va="center", fontsize=9, fontweight="bold"
            )
            y += 1.3
        for row in rows:
            unit = row[0].unit
            label = f"{row[0].perturbation}, {unit}" if unit else row[0].perturbation
            axes.text(
                -0.15, y + 0.5, literal(label), ha="right", va="center", fontsize=8, color=_INK
            )
            for x, outcome in enumerate(row):
                _draw_cell(axes, x, y, outcome, letters)
            _draw_frames(axes, y, [outcome.trained for outcome in row])
            y += 1.0
        y += 0.3


def _draw_cell(
    axes: Axes, x: float, y: float, outcome: ConditionOutcome, letters: dict[str, str]
) -> None:
    shade = float(_SCALE(100.0 * outcome.lasted))
    axes.add_patch(
        Rectangle((x + 0.03, y + 0.04), 0.94, 0.92, facecolor=_COLOURS(shade), edgecolor="none")
    )
    ink = _INK if 0.2 < shade < 0.8 else _PAPER
    if outcome.strength is not None:
        text = f"{outcome.strength:g}".replace("-", "\u2212")
        axes.text(x + 0.5, y + 0.3, text, ha="center", va="center", fontsize=7.5, color=ink)
    missed = "".join(letter for name, letter in letters.items() if name in outcome.failed)
    axes.text(
        x + 0.5,
        y + (0.5 if outcome.strength is None else 0.71),
        missed or "\u2713",
        ha="center",
        va="center",
        fontsize=6 if missed else 8,
        fontweight="normal" if missed else "bold",
        color=ink,
    )


def _draw_frames(axes: Axes, y: float, trained: Sequence[bool]) -> None:
    """Draws one frame around each row of neighbouring cells within the training ranges."""
    x = 0
    for inside, cells in groupby(trained):
        width = len(list(cells))
        if inside:
            axes.add_patch(
                Rectangle(
                    (x + 0.03, y + 0.04),
                    width - 0.06,
                    0.92,
                    fill=False,
                    edgecolor=_INK,
                    linewidth=1.5,
                    clip_on=False,
                )
            )
        x += width


def _draw_legend(figure: Figure, height: float, letters: dict[str, str], framed: bool) -> None:
    bar = figure.add_axes((0.02, 0.52 / height, 0.22, 0.14 / height))
    scale = ScalarMappable(_SCALE, _COLOURS)
    figure.colorbar(scale, cax=bar, orientation="horizontal", ticks=(0, 50, 75, 90, 100))
    bar.set_title("episodes until the time limit, %", fontsize=8)
    bar.tick_params(labelsize=8, length=0)
    first = next(iter(letters.values()))
    missed = literal("   ".join(f"{letter} {name}" for name, letter in letters.items()))
    handles = [
        Line2D([], [], marker="$\u2713$", linestyle="", color=_INK, label="all judged results met"),
        Line2D([], [], marker=f"${first}$", linestyle="", color=_INK, label=f"missed: {missed}"),
    ]
    if framed:
        handles.insert(
            2,
            Patch(
                facecolor="none", edgecolor=_INK, linewidth=1.5, label="within the trained ranges"
            ),
        )
    figure.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(0.27, 0.0), fontsize=8, ncols=1
    )
