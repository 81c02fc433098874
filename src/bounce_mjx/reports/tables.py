"""The results of an evaluation as tables and lines of text."""

import re

import numpy as np
from rich.markup import escape
from rich.table import Column, Table

from bounce_mjx.evaluation.results import Report, Result

# A figure's name, and the unit at its end.
_NAME = re.compile("(.+?)(?:_((?:m|rad)_s|m|s|rad|kg|N))?")


def figure_text(value: float | None, spec: str = ".2f") -> str:
    """A measured figure as text; "-" if there was nothing to measure."""
    return "-" if value is None else f"{value:{spec}}"


def count_text(count: float) -> str:
    """A large number in short, such as 1.23M, 45k or 678."""
    if count >= 1e6:
        return f"{count / 1e6:.2f}M"
    return f"{count / 1e3:.0f}k" if count >= 1e4 else f"{count:,.0f}"


def plain_table(title: str, *columns: Column | str) -> Table:
    """A table without lines, so that the results fit into 80 columns."""
    left = dict(title_justify="left", caption_justify="left")
    look = dict(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    return Table(*columns, title=escape(title), **left, **look)


def results_table(report: Report, title: str) -> Table:
    """The results as a table."""
    value = Column("value", justify="right")
    table = plain_table(title, "result", "measured", value, "bound", "")
    not_judged = []
    for result in report.results:
        bound, _, condition = result.bound.partition(" (")
        if result.passed is None:
            not_judged.append(f"{result.name}: not judged" + (condition and f" ({condition}"))
        colour = {True: "[green]pass", False: "[red]FAIL", None: "-"}[result.passed]
        texts = [result.name, result.measured, figure_text(result.value), bound]
        table.add_row(*map(escape, texts), colour)
    if not_judged:
        table.caption = escape("\n".join(not_judged))
    return table


def seeds_table(reports: dict[int, Report | None]) -> Table:
    """The results of the best checkpoint of each seed, with their mean and standard deviation over
    the seeds.

    Args:
      reports: reports by seed; None for a seed that diverged before its first evaluation.
    """
    known = [report for report in reports.values() if report is not None]
    headers = "seed", *(result.name for result in known[0].results), "all met"
    columns = [Column(escape(header.replace(" ", "\n")), justify="right") for header in headers]
    table = plain_table("best checkpoint of each seed", *columns)
    for seed, report in reports.items():
        if report is None:
            table.add_row(str(seed), "diverged")
            continue
        met = "[green]pass" if report.passed else "[red]FAIL"
        table.add_row(str(seed), *(figure_text(result.value) for result in report.results), met)
    columns = zip(*([result.value for result in report.results] for report in known), strict=True)
    # If a seed lacks a figure, the mean of the other seeds would be too favourable.
    complete = [None if None in column else column for column in columns]
    passed = f"{sum(report.passed for report in known)}/{len(reports)}"
    for name, statistic, met in (("mean", np.mean, passed), ("std", np.std, "")):
        table.add_row(name, *(figure_text(x and statistic(x)) for x in complete), met)
    return table


def result_cells(result: Result) -> list[str]:
    """A result as texts: name, measured quantity, value, bound and verdict."""
    verdict = {True: "pass", False: "FAIL", None: "not judged"}[result.passed]
    return [result.name, result.measured, figure_text(result.value), result.bound, verdict]


def unsolved_line(report: Report) -> str:
    """What a policy misses, and what may help; empty if it meets all results."""
    missed = [
        f"{r.name} {figure_text(r.value)} ({r.bound})" for r in report.results if r.passed is False
    ]
    if not missed:
        return ""
    return (
        f"not solved: {', '.join(missed)}; if the return still rises (bounce-mjx plot), train "
        "longer; if not, the seed is in a local optimum: try --seed or --num-seeds 8"
    )


def details_line(report: Report) -> str:
    """The other figures of an evaluation, in one line."""
    parts = []
    for name, value in report.details.items():
        title, unit = (part.replace("_", " ") for part in _NAME.fullmatch(name).groups(""))
        unit = unit.replace(" ", "/")
        if name != "episodes":
            rounded = None if value is None else float(f"{value:.4g}")
            parts.append(f"{title} {figure_text(rounded, 'g')} {unit}".rstrip())
    return f"{report.details['episodes']:.0f} episodes: {', '.join(parts)}"
