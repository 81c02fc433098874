"""The table of the benchmark, in Markdown and as a page. A row is a policy, or the seeds of one
training."""

import dataclasses
import re
from collections.abc import Sequence

import numpy as np

from bounce_mjx.evaluation.benchmark import MOST_HITS, Figures
from bounce_mjx.reports.page import STYLE, table

BENCHMARK_FILE = "benchmark.json"
_HEADER = ("policy", "seeds", "suite met", "latency, ms", "push, m/s", "hits")
_RESAMPLES = 10_000


@dataclasses.dataclass(frozen=True)
class Row:
    """The seeds of one training run, or one policy."""

    name: str
    task: str
    robot: str
    figures: list[Figures]


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Content of benchmark.json."""

    version: str
    device: str
    physics: str
    episodes: int
    seed: int
    rows: list[Row]

    @property
    def ranking(self) -> list[str]:
        """Names of the tasks' own figures."""
        return _ranking(self.rows)

    @property
    def header(self) -> tuple[str, ...]:
        """The columns of the table."""
        return *_HEADER, *self.ranking

    @property
    def cells(self) -> list[list[str]]:
        """The rows of the table."""
        return [cells(row, self.ranking) for row in self.rows]


def _ranking(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(n for row in rows for f in row.figures for n in f.ranking))


def cells(row: Row, ranking: Sequence[str]) -> list[str]:
    """A row of the table: the mean over the seeds and, for several, its interval.

    Args:
      ranking: names of the tasks' own figures.
    """
    suite = interval([f.suite_met for f in row.figures], ".0f")
    return [
        row.name,
        str(len(row.figures)),
        f"{suite} of {row.figures[0].suite_conditions}",
        interval([f.latency_ms for f in row.figures], ".0f"),
        interval([f.push_m_s for f in row.figures], ".2f"),
        interval([f.hits for f in row.figures], ",.0f"),
        *(interval([f.ranking.get(name) for f in row.figures], ".2f") for name in ranking),
    ]


def line(row: Row) -> str:
    """A row as a line of text, such as "robust: seeds 1; suite met 137 of 144; latency, ms 100"."""
    ranking = _ranking([row])
    name, *values = cells(row, ranking)
    titles = (*_HEADER, *ranking)[1:]
    return f"{name}: " + "; ".join(
        f"{title} {value}" for title, value in zip(titles, values, strict=True) if value != "-"
    )


def interval(values: Sequence[float | None], spec: str) -> str:
    """The mean and, for several different values, its 95% interval by the percentile bootstrap
    (Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021).
    """
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    mean = f"{np.mean(known):{spec}}"
    if min(known) == max(known):
        return mean
    drawn = np.random.default_rng(0).choice(known, (_RESAMPLES, len(known))).mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return f"{mean} ({low:{spec}} to {high:{spec}})"


def markdown(benchmark: Benchmark) -> str:
    """The table in Markdown."""
    header = benchmark.header
    rows = [header, ["---"] * len(header), *benchmark.cells]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + f"\n\n{caption(benchmark)}\n"


def caption(benchmark: Benchmark) -> str:
    """What was measured, on what."""
    places = sorted({f"{row.task} on {row.robot}" for row in benchmark.rows})
    return (
        f"bounce_mjx {benchmark.version}, {benchmark.physics} physics, {benchmark.device}; "
        f"{', '.join(places)}; {benchmark.episodes} episodes in each condition, seed "
        f"{benchmark.seed}. Hits: the median, at most {MOST_HITS:,}. Several seeds: mean (95% "
        "interval)."
    )


def page(benchmark: Benchmark) -> str:
    """The table as a page of HTML, in which no interval is broken into two lines."""
    rows = [
        [re.sub(r"\(.*?\)", lambda part: part[0].replace(" ", "\u00a0"), cell) for cell in row]
        for row in benchmark.cells
    ]
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>bounce_mjx: benchmark</title>
<style>{STYLE}</style>
</head>
<body>
<h1>Benchmark</h1>
<p>{caption(benchmark)}</p>
{table(benchmark.header, rows, has_many_columns=True)}
</body>
</html>
"""
