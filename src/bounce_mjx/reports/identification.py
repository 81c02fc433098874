"""The page about an identified robot: estimates, fits, measured and simulated traces."""

import html
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from bounce_mjx.identify.stages import Identified
from bounce_mjx.identify.world import estimates, sentences
from bounce_mjx.reports.figures import style
from bounce_mjx.reports.html_page import page, picture, table

# Windows of the arm alone, and of a bounce.
_NUM_WINDOWS = 3


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
    body = f"""<h1>Identified from {html.escape(source)}</h1>
<ul>
{said}</ul>
<h2>Errors in units of the sensors' noise</h2>
{table(["sensor", "model's own world", "identified", "windows held out"], fits)}
{picture("Measured (dots) and simulated (lines)", traces_figure(found, joint_names))}
<h2>Estimates</h2>
{table(["term", "estimate", "95% interval", "unit", ""], rows)}"""
    return page(f"identified from {source}", body)


@style()
def traces_figure(found: Identified, joint_names: Sequence[str]) -> Figure:
    """Measured (dots) and simulated (lines) joint angles and heights of the ball in some windows:
    those of the arm alone, then those of a bounce."""
    windows = found.windows
    angles, balls = windows.split(found.fit.predicted)
    chosen = [
        group[i]
        for group in (np.flatnonzero(~windows.has_ball), np.flatnonzero(windows.has_ball))
        for i in np.unique(np.linspace(0, len(group) - 1, _NUM_WINDOWS).astype(int))
        if len(group)
    ]
    figure = Figure(figsize=(12.0, 6.0), layout="constrained")
    axes = figure.subplots(2, len(chosen), squeeze=False)
    for (above, below), s in zip(axes.T, chosen, strict=True):
        used = windows.angle_weights[s] > 0.0
        times, measured = windows.angle_times[s, used], windows.angles[s, used]
        means = np.mean(measured, axis=0)
        for j, name in enumerate(joint_names):
            above.plot(times, measured[:, j] - means[j], ".", ms=3, color=f"C{j}")
            simulated = angles[s, used, j] - means[j]
            above.plot(times, simulated, lw=1, color=f"C{j}", label=name)
        above.set_xlabel("time in the window, s")
        used = windows.picture_weights[s] > 0.0
        times = windows.picture_times[s, used]
        below.plot(times, windows.balls[s, used, 2], ".", ms=3, color="k")
        below.plot(times, balls[s, used, 2], lw=1, color="C1")
        below.set_xlabel("time in the window, s")
        below.set_visible(bool(windows.has_ball[s]))
    axes[0, 0].set_ylabel("joint angles minus their means, rad")
    axes[0, 0].legend(fontsize=7)
    for below in [below for below in axes[1] if below.get_visible()][:1]:
        below.set_ylabel("height of the ball, m")
    return figure
