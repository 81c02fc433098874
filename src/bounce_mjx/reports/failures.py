"""The failed episodes of an evaluation as a table, and the terms that go with failure as lines and
as a figure."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from rich.markup import escape
from rich.table import Column, Table

from bounce_mjx.evaluation.failures import Association, Failure
from bounce_mjx.reports.figures import make_panels, style
from bounce_mjx.reports.tables import plain_table

_SHOWN_EPISODES = 20
_SHOWN_TERMS = 3
_PANELS = 6
_BAR = "#c2451e"


def failures_table(
    failures: Sequence[Failure], associations: Sequence[Association], episodes: int
) -> Table:
    """The failed episodes, the shortest first, with the terms of their worlds that go with failure
    the most."""
    names = [one.name for one in associations[:_SHOWN_TERMS]]
    missed = sum(failure.lasted for failure in failures)
    title = (
        f"{len(failures)} of {episodes:,} episodes failed: {len(failures) - missed} ended early, "
        f"{missed} lasted and missed a result"
    )
    headers = "episode", "at, s", *names
    columns = [Column(header, justify="right") for header in headers]
    table = plain_table(title, *columns, "what failed")
    ordered = sorted(failures, key=lambda failure: (failure.seconds, failure.episode))
    for failure in ordered[:_SHOWN_EPISODES]:
        values = [f"{_value(failure, name):.3g}" for name in names]
        end = "-" if failure.lasted else f"{failure.seconds:.2f}"
        table.add_row(str(failure.episode), end, *values, escape(", ".join(failure.failed)))
    if len(ordered) > _SHOWN_EPISODES:
        table.caption = f"and {len(ordered) - _SHOWN_EPISODES} more"
    return table


def association_lines(associations: Sequence[Association]) -> list[str]:
    """The terms that go with failure, each with its share of failures by third of its range."""
    clear = [one for one in associations if one.is_clear]
    if not clear:
        return ["no term of the world goes clearly with failure (95% intervals of its thirds meet)"]
    lines = ["terms that go with failure: share of failures by third of the range (95% interval)"]
    for one in clear[:_PANELS]:
        parts = []
        for third in one.thirds:
            share = _percent(third.failed, third.episodes)
            low, high = third.interval
            interval = f"{100 * low:.1f} to {100 * high:.1f}"
            parts.append(f"{third.low:.3g} to {third.high:.3g}: {share} ({interval})")
        lines.append(f"  {one.name}: {'; '.join(parts)}")
    return lines


def failures_figure(associations: Sequence[Association]) -> Figure:
    """The share of failures by third of the ranges of the terms that go with it the most.

    Args:
      associations: at least one.
    """
    shown = list(associations[:_PANELS])
    with style():
        figure, axes = make_panels(len(shown), 3, 2.4)
        for panel, one in zip(axes, shown, strict=True):
            thirds = one.thirds
            shares = np.array([100.0 * t.failed / max(1, t.episodes) for t in thirds])
            ends = 100.0 * np.array([t.interval for t in thirds])
            errors = np.abs(ends.T - shares)
            panel.bar(range(len(thirds)), shares, color=_BAR, yerr=errors, capsize=4)
            labels = [f"{t.low:.2g}\nto {t.high:.2g}\n({t.episodes})" for t in thirds]
            panel.set_xticks(range(len(thirds)), labels, fontsize=7)
            panel.set_title(f"{one.name} (episodes)", fontsize=9)
            panel.set_ylabel("failures, %")
        # One scale, so that the panels can be compared.
        highest = max(panel.get_ylim()[1] for panel in axes)
        for panel in axes:
            panel.set_ylim(0.0, highest)
    return figure


def _value(failure: Failure, name: str) -> float:
    """A failed episode's value of a goal, of a term, or of an entry of a term."""
    if name in failure.goal:
        return failure.goal[name]
    term, _, index = name.partition("[")
    value = np.ravel(failure.world[term])
    return float(value[int(index.rstrip("]")) if index else 0])


def _percent(failed: int, episodes: int) -> str:
    return f"{100.0 * failed / episodes:.1f}%" if episodes else "-"
