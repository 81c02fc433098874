"""Writes the tables of README.md, docs/ and RESULTS.md from figures.yaml:

python benchmarks/figures.py

A table stands in a page after a line <!-- figures: NAME -->, and ends before the next empty line.
A figure that no table names is in no page.
"""

import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml

CHECKOUT = Path(__file__).resolve().parent.parent
PAGES = [CHECKOUT / "README.md", CHECKOUT / "benchmarks/RESULTS.md", *CHECKOUT.glob("docs/*.md")]
COLUMNS = {
    "claim": "claim",
    "figure": "value",
    "target": "target",
    "command": "command",
    "device": "device",
    "date": "date",
    "commit": "commit",
}
"""The keys of a figure by the titles of their columns, where a table says no others."""
_NUMBER = r"-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?"
_NUMBERS = re.compile(rf"({_NUMBER})%?(?: (?:to|and) ({_NUMBER}))?")
TABLE = re.compile(r"(<!-- figures: (\w+) -->\n)(?:.+\n)*")


def tables() -> dict[str, str]:
    """The tables of figures.yaml by name, as Markdown."""
    source = yaml.safe_load((CHECKOUT / "benchmarks/figures.yaml").read_text(encoding="utf-8"))
    figures = {
        name: figure | _judged_shares(figure, source["criteria"]) | _judged_target(figure)
        for name, figure in source["figures"].items()
    }
    return {name: _table(table, figures) for name, table in source["tables"].items()}


def drawn(text: str, known: dict[str, str]) -> str:
    """A page's text with its tables as they are in figures.yaml.

    Raises:
      KeyError: figures.yaml has no table of that name.
    """
    return TABLE.sub(lambda found: found[1] + known[found[2]], text)


def verdict(target: str, measured: str) -> str:
    """Whether a figure, by the worst of its numbers, reaches a target: see figures.yaml.

    Raises:
      ValueError: the target is a number, and the figure does not begin with one.
    """
    is_upper = target.startswith("at most ")
    is_lower = target.startswith("at least ")
    bounds = _numbers(target.removeprefix("at most ").removeprefix("at least "))
    if not bounds:
        return "reached" if measured == target else "missed"
    numbers = _numbers(measured)
    if not numbers:
        raise ValueError(f"{measured!r} begins with no number, for {target!r}; add `measured`")
    low = -math.inf if is_upper else bounds[0]
    high = math.inf if is_lower else bounds[-1]
    is_reached = all(low <= number <= high for number in numbers)
    return "reached" if is_reached else "missed"


def _judged_target(figure: dict[str, Any]) -> dict[str, str]:
    """The target with its verdict and its note, where there is one."""
    if "target" not in figure:
        return {}
    judged = figure.get("judged", "value")
    measured = figure["measured"] if "measured" in figure else figure[judged]
    note = f": {figure['note']}" if "note" in figure else ""
    return {"target": f"{figure['target']}, {verdict(figure['target'], str(measured))}{note}"}


def _judged_shares(figure: dict[str, Any], criteria: dict[str, float]) -> dict[str, str]:
    """The shares of a run in another simulator that miss their criterion, with that word."""
    if not {"simulator", "world"} <= figure.keys():
        return {}
    missed = [name for name, bound in criteria.items() if float(figure[name]) < bound]
    return {name: f"{figure[name]}, missed" for name in missed}


def _numbers(text: str) -> list[float]:
    """The number with which a text begins, or both of a range or of two; none of another text."""
    found = _NUMBERS.match(text)
    numbers = found.groups() if found else ()
    return [float(number.replace(",", "")) for number in numbers if number is not None]


def _table(source: str | dict[str, Any], figures: dict[str, dict[str, Any]]) -> str:
    if isinstance(source, str):
        named = {name: SimpleNamespace(**figure) for name, figure in figures.items()}
        return source.format_map(named)
    columns = source.get("columns", COLUMNS)
    rows = [
        [str(figures[name].get(key, "")) for key in columns.values()] for name in source["figures"]
    ]
    head = [name.strip() for name in columns]
    lines = ["| " + " | ".join(row) + " |\n" for row in [head, *rows]]
    return "".join([lines[0], "|" + "---|" * len(columns) + "\n", *lines[1:]])


def main() -> None:
    """Writes the pages, all or none."""
    known = tables()
    texts = [drawn(page.read_text(encoding="utf-8"), known) for page in PAGES]
    for page, text in zip(PAGES, texts, strict=True):
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
