"""The results of an evaluation as tables and lines of text."""

import numpy as np
from rich.markup import escape
from rich.table import Table

from bounce_mjx.evaluation.results import Report, Result


def figure_text(value: float | None, spec: str = ".2f", scale: float = 1.0, unit: str = "") -> str:
    """A measured figure times `scale`, as text; "-" if there was nothing to measure."""
    return "-" if value is None else f"{scale * value:{spec}}{unit}"


def _plain_table(title: str) -> Table:
    """A table without lines, so that the five results fit into 80 columns."""
    return Table(
        title=escape(title), title_justify="left", box=None, pad_edge=False, padding=(0, 1, 0, 0)
    )


def results_table(report: Report, title: str) -> Table:
    """The five results as a table."""
    table = _plain_table(title)
    for column in ("result", "measured"):
        table.add_column(column)
    table.add_column("value", justify="right")
    table.add_column("bound")
    table.add_column()
    for result in report.results:
        bound, _, condition = result.bound.partition(" (")
        if result.passed is None:
            table.caption = f"{result.name}: {verdict(result)} ({condition}"
            table.caption_justify = "left"
        colour = {True: "[green]pass", False: "[red]FAIL", None: "-"}[result.passed]
        table.add_row(result.name, result.measured, figure_text(result.value), bound, colour)
    return table


def seeds_table(reports: dict[int, Report | None]) -> Table:
    """The best checkpoint of each seed, with the mean and the standard deviation over the seeds:
    the five results, the consecutive bounces and the apex error.

    Args:
      reports: reports by seed; None for a seed that diverged before its first evaluation.
    """
    known = [report for report in reports.values() if report is not None]
    table = _plain_table("best checkpoint of each seed")
    table.add_column("seed", justify="right")
    for result in known[0].results:
        table.add_column(result.name.split()[0], justify="right")
    for column in ("bounces", "apex, cm", "all met"):
        table.add_column(column, justify="right")

    for seed, report in reports.items():
        if report is None:
            table.add_row(str(seed), "diverged")
            continue
        met = "[green]pass" if report.passed else "[red]FAIL"
        table.add_row(str(seed), *map(figure_text, _seed_figures(report)), met)
    table.add_section()
    columns = list(zip(*map(_seed_figures, known), strict=True))
    passed = sum(report.passed for report in known)
    # If a seed lacks a figure, the mean of the other seeds would be too favourable.
    for name, statistic, met in (
        ("mean", np.mean, f"{passed}/{len(reports)}"),
        ("std", np.std, ""),
    ):
        cells = [figure_text(None if None in c else statistic(c)) for c in columns]
        table.add_row(name, *cells, met)
    return table


def _seed_figures(report: Report) -> list[float | None]:
    """A seed's row in the table."""
    apex_error = report.details["mean_apex_error_m"]
    return [
        *[result.value for result in report.results],
        report.details["mean_consecutive_bounces"],
        None if apex_error is None else 100.0 * apex_error,
    ]


def results_markdown(report: Report) -> str:
    """The five results as a Markdown table."""
    lines = ["| result | measured | value | bound | |", "|---|---|---:|---|---|"]
    for result in report.results:
        # An unescaped | would begin a new cell.
        measured = result.measured.replace("|", "&#124;")
        cells = (result.name, measured, figure_text(result.value), result.bound, verdict(result))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def verdict(result: Result) -> str:
    """Whether a result met its bound, in a word or two."""
    return {True: "pass", False: "FAIL", None: "not judged"}[result.passed]


def details_line(report: Report) -> str:
    """The other figures of an evaluation, in one line."""
    details = report.details
    apex_error = figure_text(details["mean_apex_error_m"], ".1f", 100.0, " cm")
    return (
        f"{details['episodes']:.0f} episodes: "
        f"{details['mean_consecutive_bounces']:.1f} consecutive bounces, "
        f"|apex error| {apex_error}, return {details['mean_return']:.0f}, "
        f"length {details['mean_length_s']:.2f} s (means)"
    )
