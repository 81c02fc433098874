"""The page about an identified robot: estimates, fits, measured and simulated traces."""

import base64
import html
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from bounce_mjx.identify.stages import Identified
from bounce_mjx.identify.words import estimates, sentences
from bounce_mjx.reports.figures import image
from bounce_mjx.reports.page import STYLE, table

_SHOWN_WINDOWS = 6


def identification_page(found: Identified, source: str, joint_names: Sequence[str]) -> str:
    """The page, self-contained."""
    rows = [
        [
            e.label,
            f"{e.value:.5g}",
            f"{e.low:.5g} to {e.high:.5g}",
            e.unit,
            "" if e.seen else "not shown by the log",
        ]
        for e in estimates(found, joint_names)
    ]
    parts = found.before, found.after, found.held_out
    fits = [
        [name, *(f"{part[name]:.2f}" if name in part else "-" for part in parts)]
        for name in found.after
    ]
    said = "".join(f"<li>{html.escape(text)}</li>\n" for text in sentences(found, joint_names))
    picture = base64.b64encode(image(traces_figure(found, joint_names), "svg")).decode()
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>bounce_mjx: identified from {html.escape(source)}</title>
<style>{STYLE}</style>
</head>
<body>
<h1>Identified from {html.escape(source)}</h1>
<ul>
{said}</ul>
<h2>Errors in units of the sensors' noise</h2>
{table(["sensor", "model's own world", "identified", "windows held out"], fits)}
<h2>Measured and simulated</h2>
<img alt="Measured and simulated traces" src="data:image/svg+xml;base64,{picture}">
<h2>Estimates</h2>
{table(["term", "estimate", "95% interval", "unit", ""], rows)}
</body>
</html>
"""


def traces_figure(found: Identified, joint_names: Sequence[str]) -> Figure:
    """Measured (dots) and simulated (lines) angles and heights of the ball in some windows."""
    w = found.windows
    with_ball = np.flatnonzero(w.has_ball)
    arm = np.flatnonzero(~w.has_ball)
    chosen = [
        *arm[np.linspace(0, len(arm) - 1, min(3, len(arm))).astype(int)],
        *with_ball[
            np.linspace(0, len(with_ball) - 1, min(_SHOWN_WINDOWS - 3, len(with_ball))).astype(int)
        ],
    ]
    figure = Figure(figsize=(12.0, 6.0), layout="constrained")
    axes = figure.subplots(2, max(len(chosen), 1), squeeze=False)
    for column, s in enumerate(chosen):
        above, below = axes[:, column]
        used = w.angle_weights[s] > 0.0
        t = w.angle_times[s][used]
        for j, name in enumerate(joint_names):
            middle = np.mean(w.angles[s][used, j]) if len(t) else 0.0
            colour = f"C{j}"
            above.plot(t, w.angles[s][used, j] - middle, ".", ms=3, color=colour)
            above.plot(
                t, found.fit.predicted.angles[s][used, j] - middle, lw=1, color=colour, label=name
            )
        seen = w.picture_weights[s] > 0.0
        t = w.picture_times[s][seen]
        if len(t):
            below.plot(t, w.balls[s][seen, 2], ".", ms=3, color="k")
            below.plot(t, found.fit.predicted.balls[s][seen, 2], lw=1, color="C1")
        else:
            below.set_axis_off()
        below.set_xlabel("time in the window [s]")
    axes[0, 0].set_ylabel("joint angles minus their means [rad]")
    axes[0, 0].legend(fontsize=7)
    axes[1, -1].set_ylabel("height of the ball [m]")
    return figure
