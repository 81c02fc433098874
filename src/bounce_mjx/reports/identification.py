"""The page about an identified robot: what was found, how sure it is, and what to do."""

import html
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from bounce_mjx.identify.stages import Identified
from bounce_mjx.identify.world import estimates, misfit, sentences
from bounce_mjx.reports.figures import add_legend, make_panels, style
from bounce_mjx.reports.html_page import figures_html, page, table

# Windows of the arm alone, and of a bounce.
_NUM_WINDOWS = 2


def identification_page(
    found: Identified, source: str, joint_names: Sequence[str], world: Path
) -> str:
    """The page, self-contained.

    Args:
      world: the file of the identified world.
    """
    listed = estimates(found, joint_names)
    marks = {True: "", False: "not shown by the log: the prior"}
    rows = [
        [e.label, f"{e.value:.3g}", f"{e.low:.3g} to {e.high:.3g} {e.unit}", marks[e.seen]]
        for e in sorted(listed, key=lambda e: not e.seen)
    ]
    parts = found.before, found.after, found.held_out
    fits = [
        [name, *(f"{part[name]:.3g}" if name in part else "-" for part in parts)]
        for name in found.after
    ]
    seen = sum(e.seen for e in listed)
    caveats = sentences(found, joint_names)
    doubts = [text for text in caveats if text.startswith(("warning:", "The model does not"))]
    said = "".join(f"<li>{html.escape(text)}</li>\n" for text in caveats or ["Nothing."])
    figures = {"Measured (dots) and simulated (lines)": traces_figure(found, joint_names)}
    body = f"""<h1>Identified from {html.escape(source)}</h1>
<p><b>Found:</b> the log shows {seen} of {len(listed)} quantities of the robot's world, each
below with the interval that contains it with 95% probability.</p>
<p><b>How sure:</b> {_describe_fit(found)}</p>
<p><b>What to do:</b> {_advise(bool(doubts), world)}</p>
<h2>Estimates</h2>
{table(["quantity", "estimate", "95% interval", ""], rows)}
<h2>Errors in units of the sensors' noise</h2>
{table(["sensor", "model's own world", "identified", "windows held out"], fits)}
{figures_html(figures)}
<h2>What the log leaves open</h2>
<ul>
{said}</ul>"""
    return page(f"identified from {source}", body)


def _describe_fit(found: Identified) -> str:
    """How well the identified world explains the log."""
    errors = found.held_out or found.after
    where = "in windows that the search had not seen" if found.held_out else "in the log"
    named = " and ".join(f"{error:.3g} ({name})" for name, error in errors.items())
    wider = "" if misfit(found) == 1.0 else " The intervals are widened by the excess."
    fit = f"the world's errors {where} are {named} times the sensors' noise; 1 is perfect."
    return html.escape(fit + wider)


def _advise(has_doubts: bool, world: Path) -> str:
    """What to do with the world, as HTML."""
    name = html.escape(str(world))
    train = "bounce-mjx train --warm-start robust_small --config finetune --world"
    if has_doubts:
        return "do not train with this world yet: heed the warnings below, and identify again."
    return (
        f"adapt a policy with <code>{train} {name}</code>, and check the robot later with "
        f"<code>bounce-mjx identify LOG --check {name}</code>."
    )


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
    bounces = [s for s in chosen if windows.has_ball[s]]
    figure, panels = make_panels(len(chosen) + len(bounces), _NUM_WINDOWS, height=2.2)
    for axes, s in zip(panels, chosen, strict=False):
        used = windows.angle_weights[s] > 0.0
        times, measured = windows.angle_times[s, used], windows.angles[s, used]
        means = np.mean(measured, axis=0)
        for j, name in enumerate(joint_names):
            axes.plot(times, measured[:, j] - means[j], ".", ms=3, color=f"C{j}")
            simulated = angles[s, used, j] - means[j]
            axes.plot(times, simulated, lw=1, color=f"C{j}", label=name)
        axes.set_title("joint angles minus means, rad")
    for axes, s in zip(panels[len(chosen) :], bounces, strict=True):
        used = windows.picture_weights[s] > 0.0
        times = windows.picture_times[s, used]
        axes.plot(times, windows.balls[s, used, 2], ".", ms=3, color="k")
        axes.plot(times, balls[s, used, 2], lw=1, color="C1")
        axes.set_title("height of the ball, m")
    for axes in panels:
        axes.set_xlabel("time in the window, s")
    add_legend(figure)
    return figure
