"""The results of an evaluation as tables and lines of text."""

import re

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from bounce_mjx.evaluation.results import Report, Result

# A figure's name, and the unit at its end.
_NAME = re.compile("(.+?)(?:_((?:m|rad)_s|m|s|rad|kg|N))?")


def figure_text(value: float | None, spec: str = ".2f") -> str:
    """A measured figure as text; "-" if there was nothing to measure."""
    return "-" if value is None else f"{value:{spec}}"


def result_text(result: Result, digits: int = 2, form: str = "f") -> str:
    """A result's value as text, with as many more digits as it takes not to read as its bound:
    98.997 is no 99.00 that misses 99.

    Args:
      digits: precision otherwise.
      form: format of a number, f or g.
    """
    value = result.value
    if value is None:
        return figure_text(value)
    limits = [float(number) for number in re.findall(r"\d+(?:\.\d+)?", result.bound)]
    text = f"{value:.{digits}{form}}"
    while float(text) in limits and float(text) != value:
        digits += 1
        text = f"{value:.{digits}{form}}"
    return text


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


def print_table(console: Console, table: Table) -> None:
    """Prints a table; elsewhere than on a terminal, without blanks at the ends of its lines."""
    if console.is_terminal:
        console.print(table)
        return
    with console.capture() as captured:
        console.print(table)
    for line in captured.get().splitlines():
        console.out(line.rstrip(), highlight=False)


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
        texts = [result.name, result.measured, result_text(result), bound]
        table.add_row(*map(escape, texts), colour)
    if not_judged:
        table.caption = escape("\n".join(not_judged))
    return table


def seeds_table(reports: dict[int, Report | None]) -> Table:
    """The results of the best checkpoint of each seed, with their mean and standard deviation over
    the seeds that have results.

    Args:
      reports: reports by seed; None for a seed that diverged before its first evaluation.
    """
    known = [report for report in reports.values() if report is not None]
    columns = []
    for header in ("seed", *(result.name for result in known[0].results), "all met"):
        text = escape(header.replace(" ", "\n"))
        columns.append(Column(text, justify="right"))
    table = plain_table("best checkpoint of each seed", *columns)
    for seed, report in reports.items():
        if report is None:
            table.add_row(str(seed), "diverged")
            continue
        met = "[green]pass" if report.passed else "[red]FAIL"
        table.add_row(str(seed), *map(result_text, report.results), met)
    means = []
    deviations = []
    for i in range(len(known[0].results)):
        values = [report.results[i].value for report in known]
        # The mean of those that have a figure would be too favourable.
        is_complete = None not in values
        means.append(figure_text(np.mean(values) if is_complete else None))
        deviations.append(figure_text(np.std(values) if is_complete else None))
    passed = sum(report.passed for report in known)
    # A seed that diverged is in no mean.
    of_known = "" if len(known) == len(reports) else f" of {len(known)}"
    table.add_row(f"mean{of_known}", *means, f"{passed}/{len(reports)}")
    table.add_row(f"std{of_known}", *deviations, "")
    return table


def result_cells(result: Result) -> list[str]:
    """A result as texts: name, measured quantity, value, bound and verdict."""
    verdict = {True: "pass", False: "FAIL", None: "not judged"}[result.passed]
    return [result.name, result.measured, result_text(result), result.bound, verdict]


def unsolved_line(report: Report, num_seeds: int = 1) -> str:
    """What the best policy of a training misses, and what may help; empty if it meets all
    results.

    Args:
      num_seeds: seeds of the training.
    """
    missed = []
    for result in report.results:
        if result.passed is False:
            missed.append(f"{result.name} {result_text(result)} ({result.bound})")
    if not missed:
        return ""
    others = "other seeds (--seed, --num-seeds 8)" if num_seeds == 1 else "other seeds (--seed)"
    return (
        f"not solved: {', '.join(missed)}; train longer while the return rises (bounce-mjx plot); "
        f"once it does not, {others} or another reward may help"
    )


def details_line(report: Report) -> str:
    """The other figures of an evaluation, in one line."""
    parts = []
    for name, value in report.details.items():
        title, unit = _NAME.fullmatch(name).groups("")
        title = title.replace("_", " ")
        unit = unit.replace("_", "/")
        if name != "episodes":
            rounded = None if value is None else float(f"{value:.4g}")
            parts.append(f"{title} {figure_text(rounded, 'g')} {unit}".rstrip())
    return f"{report.details['episodes']:,.0f} episodes: {', '.join(parts)}"
