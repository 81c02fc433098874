"""The results of an evaluation as tables and lines of text."""

import typing

import numpy as np
from rich.table import Table

from bounce_mjx.evaluation.results import Report, Result

if typing.TYPE_CHECKING:
    pass


def results_table(report: Report, title: str) -> Table:
    """The five results as a table."""
    table = Table(title=title, title_justify="left")
    for column, justify in (
        ("result", "left"),
        ("measured", "left"),
        ("value", "right"),
        ("bound", "left"),
        ("", "left"),
    ):
        table.add_column(column, justify=justify)
    for result in report.results:
        colour = {True: "[green]", False: "[red]", None: ""}[result.passed]
        table.add_row(
            result.name,
            result.measured,
            f"{result.value:.2f}",
            result.bound,
            colour + verdict(result),
        )
    return table


def seeds_table(reports: dict[int, Report | None]) -> Table:
    """The five results of several seeds, the mean number of bounces in a row and the mean apex
    error, with mean and standard deviation over the seeds.

    Args:
      reports: by seed; None for one that diverged before any evaluation.
    """
    known = [report for report in reports.values() if report is not None]
    table = Table(title="best checkpoint of each seed", title_justify="left")
    table.add_column("seed", justify="right")
    for result in known[0].results:
        table.add_column(result.name.split()[0], justify="right")
    for column in ("bounces", "apex, cm", "all five"):
        table.add_column(column, justify="right")

    def figures(report: Report) -> list[float]:
        values = [result.value for result in report.results]
        details = report.details
        apex_error = 100 * details["mean_apex_error_m"]
        return [*values, details["mean_consecutive_bounces"], apex_error]

    for seed, report in reports.items():
        if report is None:
            table.add_row(str(seed), "diverged")
            continue
        met = "[green]pass" if report.passed else "[red]FAIL"
        table.add_row(str(seed), *[f"{value:.2f}" for value in figures(report)], met)
    table.add_section()
    values = np.array([figures(report) for report in known])
    passed = sum(report.passed for report in known)
    table.add_row("mean", *[f"{v:.2f}" for v in values.mean(axis=0)], f"{passed}/{len(reports)}")
    table.add_row("std", *[f"{v:.2f}" for v in values.std(axis=0)], "")
    return table


def results_markdown(report: Report) -> str:
    """The five results as a Markdown table."""
    lines = ["| result | measured | value | bound | |", "|---|---|---:|---|---|"]
    for result in report.results:
        # A bare | would begin a new cell.
        cells = (result.name, result.measured.replace("|", "&#124;"), f"{result.value:.2f}")
        lines.append(f"| {' | '.join(cells)} | {result.bound} | {verdict(result)} |")
    return "\n".join(lines)


def verdict(result: Result) -> str:
    """What became of a result, in a word or two."""
    return {True: "pass", False: "FAIL", None: "not judged"}[result.passed]


def details_line(report: Report) -> str:
    """The figures beside the five results, in one line."""
    d = report.details
    return (
        f"{d['episodes']:.0f} episodes: {d['mean_consecutive_bounces']:.1f} consecutive bounces, "
        f"|apex error| {100 * d['mean_apex_error_m']:.1f} cm, return {d['mean_return']:.0f}, "
        f"length {d['mean_length_s']:.2f} s (means)"
    )
