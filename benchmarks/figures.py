"""Writes the tables of README.md, docs/ and RESULTS.md from figures.yaml:

python benchmarks/figures.py

A table stands in a page after a line <!-- figures: NAME -->, and ends before the next empty line.
"""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml

CHECKOUT = Path(__file__).resolve().parent.parent
PAGES = [CHECKOUT / "README.md", CHECKOUT / "benchmarks/RESULTS.md", *CHECKOUT.glob("docs/*.md")]
COLUMNS = {
    name if name != "value" else "figure": name
    for name in ("claim", "value", "target", "command", "device", "date", "commit")
}
TABLE = re.compile(r"(<!-- figures: (\w+) -->\n)(?:.+\n)*")


def tables() -> dict[str, str]:
    """The tables of figures.yaml by name, as Markdown."""
    source = yaml.safe_load((CHECKOUT / "benchmarks/figures.yaml").read_text(encoding="utf-8"))
    return {name: _table(table, source["figures"]) for name, table in source["tables"].items()}


def drawn(text: str, known: dict[str, str]) -> str:
    """A page's text with its tables as they are in figures.yaml."""
    return TABLE.sub(lambda found: found[1] + known[found[2]], text)


def _table(table: str | dict[str, Any], figures: dict[str, dict[str, Any]]) -> str:
    if isinstance(table, str):
        named = {name: SimpleNamespace(**figure) for name, figure in figures.items()}
        return table.format_map(named)
    columns = table.get("columns", COLUMNS)
    rows = [
        [str(figures[name].get(key, "")) for key in columns.values()] for name in table["figures"]
    ]
    head = [name.strip() for name in columns]
    lines = ["| " + " | ".join(row) + " |\n" for row in [head, *rows]]
    return "".join([lines[0], "|" + "---|" * len(columns) + "\n", *lines[1:]])


def main() -> None:
    """Writes the pages."""
    known = tables()
    for page in PAGES:
        page.write_text(drawn(page.read_text(encoding="utf-8"), known), encoding="utf-8")


if __name__ == "__main__":
    main()
