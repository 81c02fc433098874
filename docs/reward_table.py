"""Writes the table of the reward terms in docs/task.md: their weights, and the formulas of their
docstrings with the numbers of the settings.

python docs/reward_table.py
"""

import inspect
import re
from pathlib import Path

from bounce_mjx.task import RewardTerm, term_names
from bounce_mjx.task.bounce_rewards import Rewards

PAGE = Path(__file__).parent / "task.md"
_TABLE = re.compile(r"(?<=<!-- reward terms -->\n)(\|.*\n)+")


def main() -> None:
    """Replaces the page's table."""
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


def with_table(page: str) -> str:
    """The page with the table of the present terms."""
    return _TABLE.sub(lambda _: table(), page)


def table() -> str:
    """The table, Markdown."""
    defaults = Rewards()
    rows = ["| term | weight | formula |", "|---|---|---|"]
    for name in term_names(Rewards):
        term = getattr(defaults, name)
        weight = repr(term.weight).replace("e-0", "e-")
        rows.append(f"| `{name}` | {weight} | `{formula(term)}` |")
    return "\n".join(rows) + "\n"


def formula(term: RewardTerm) -> str:
    """A term's formula with the numbers of its settings: the start of the docstring of `value`, up
    to the first full stop, comma, "for" or "with" outside of parentheses."""
    text = " ".join(inspect.getdoc(type(term).value).split())
    end = len(text)
    depth = 0
    for i, character in enumerate(text):
        depth += {"(": 1, ")": -1}.get(character, 0)
        if depth == 0 and re.match(r"[.,]| for | with ", text[i:]):
            end = i
            break
    symbols = text[:end]
    for name, value in term:
        symbols = re.sub(rf"\b{name}\b", f"{value:g}", symbols)
    return symbols


if __name__ == "__main__":
    main()
