"""The parts of an HTML page: its frame, figures and tables."""

import base64
import html
from collections.abc import Iterable, Mapping, Sequence

from matplotlib.figure import Figure

from bounce_mjx.reports.figures import image

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 68rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; background: #fff; }
h1 { margin-bottom: 0; } h2 { margin: 2rem 0 0.5rem; font-size: 1.15rem; }
.wide { overflow-x: auto; }
.figures { display: grid; gap: 0 2rem; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); }
.panels { display: grid; gap: 0.5rem; align-items: end;
  grid-template-columns: repeat(auto-fill, minmax(min(48%, 12rem), 1fr)); }
figure { margin: 0; } img { width: 100%; }
iframe { width: 100%; height: 28rem; border: 1px solid #ddd; }
table { border-collapse: collapse; }
th, td { padding: 0.2rem 0.9rem 0.2rem 0; text-align: left; border-bottom: 1px solid #ddd; }
.pass { color: #00704f; font-weight: bold; } .fail { color: #b00020; font-weight: bold; }
code, pre { font-size: 13px; overflow-wrap: anywhere; white-space: pre-wrap; }
summary { cursor: pointer; margin-top: 2rem; font-weight: bold; }
@media (max-width: 30rem) {
  th, td { padding-right: 0.4rem; font-size: 13px; }
}
"""


def page(title: str, body: str) -> str:
    """A self-contained page."""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>bounce_mjx: {html.escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
{body}
</body>
</html>
"""


def figures_html(figures: Iterable[tuple[str, Figure]]) -> str:
    """Figures below their titles, side by side where the page is wide enough.

    Args:
      figures: each with its title; several may have the same one.
    """
    parts = []
    for title, figure in figures:
        source = data_url("image/svg+xml", image(figure, "svg"))
        title = html.escape(title)
        parts.append(f'<figure><h2>{title}</h2><img alt="{title}" src="{source}"></figure>\n')
    return f'<div class="figures">{"".join(parts)}</div>'


def panels_html(panels: Mapping[str, Figure]) -> str:
    """Small figures, which have their titles, as many side by side as there is room for."""
    parts = []
    for title, figure in panels.items():
        source = data_url("image/svg+xml", image(figure, "svg"))
        parts.append(f'<img alt="{html.escape(title)}" src="{source}">\n')
    return f'<div class="panels">{"".join(parts)}</div>'


def data_url(kind: str, content: bytes) -> str:
    """A file of a media type as the address of itself."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in HTML, with coloured verdicts. On a phone, it scrolls sideways by itself."""

    def row(tag: str, cells: Sequence[str]) -> str:
        parts = []
        for cell in cells:
            name = {"pass": "pass", "FAIL": "fail"}.get(cell, "")
            parts.append(f'<{tag} class="{name}">{html.escape(cell)}</{tag}>')
        return f"<tr>{''.join(parts)}</tr>\n"

    body = "".join(row("td", cells) for cells in rows)
    return f'<div class="wide"><table>\n{row("th", header)}{body}</table></div>'
