"""The page about an identified robot: what was found, how sure it is, and what to do."""

import html
import math
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from bounce_mjx.identify.estimates import Estimate, estimates
from bounce_mjx.identify.hypotheses import table_of
from bounce_mjx.identify.identification import Identified
from bounce_mjx.identify.inspection import Checkup
from bounce_mjx.identify.log import Log
from bounce_mjx.identify.sentences import sentences
from bounce_mjx.reports.figures import add_legend, make_panels, style
from bounce_mjx.reports.html_page import figures_html, page, table

# Windows of the arm alone, and of a bounce.
_NUM_WINDOWS = 2
# Most points of a joint in a figure of a whole log.
_DRAWN = 600


def inspection_page(logs: Sequence[Log], checkups: Sequence[Checkup]) -> str:
    """The page about logs alone, self-contained: their faults, and how the joints follow."""
    source = ", ".join(log.source for log in logs)
    faults = sum(len(checkup.faults) for checkup in checkups)
    advice = "mend them before a fit." if faults else "identify the robot from these logs."
    body = f"""<h1>{html.escape(source)}</h1>
<p><b>Found:</b> {faults} faults.</p>
<p><b>What to do:</b> {advice}</p>
{_describe_logs(logs, checkups)}"""
    return page(f"logs {source}", body)


def _describe_logs(logs: Sequence[Log], checkups: Sequence[Checkup]) -> str:
    """Findings, table and figure of each log, as HTML."""
    parts = []
    for log, checkup in zip(logs, checkups, strict=True):
        said = [str(finding) for finding in checkup.findings] or ["no faults"]
        rows = [
            [
                joint.name,
                f"{joint.measured:.2f}",
                f"{joint.slope:.3f}",
                f"{1e3 * joint.offset:.2f}",
                f"{1e3 * joint.delay:.0f}",
                f"{1e3 * joint.remainder:.2f}",
            ]
            for joint in checkup.joints
        ]
        header = ["joint", "moves, rad", "slope", "offset, mrad", "delay, ms", "remainder, mrad"]
        figures = {
            "Commanded, later by the delay (wide lines), and measured (thin lines)": (
                following_figure(log, checkup)
            ),
            "Measured less commanded, later by the delay": difference_figure(log, checkup),
        }
        parts.append(
            f"<h2>{html.escape(log.source)}: angles against their commands</h2>\n<ul>"
            + "".join(f"<li>{html.escape(text)}</li>\n" for text in said)
            + f"</ul>\n{table(header, rows)}\n"
            + figures_html(figures.items())
        )
    return "\n".join(parts)


def identification_page(
    found: Identified,
    logs: Sequence[Log],
    checkups: Sequence[Checkup],
    joint_names: Sequence[str],
    world: Path,
    doubts: Sequence[str],
    robot: str | None,
) -> str:
    """The page, self-contained.

    Args:
      world: the file of the identified world.
      doubts: why it does not explain the logs.
      robot: whose logs they are, as for --robot; None for the project's own arm.
    """
    source = ", ".join(log.source for log in logs)
    listed = estimates(found, joint_names)
    rows = [_row(entry) for entry in sorted(listed, key=lambda entry: not entry.seen)]
    parts = found.before, found.after, found.held_out
    fits = [
        [name, *(f"{part[name]:.3g}" if name in part else "-" for part in parts)]
        for name in found.after
    ]
    seen = sum(e.seen for e in listed)
    caveats = sentences(found, joint_names)
    said = "".join(f"<li>{html.escape(text)}</li>\n" for text in caveats or ["Nothing."])
    figures = {"Measured (dots) and simulated (lines)": traces_figure(found, joint_names)}
    body = f"""<h1>Identified from {html.escape(source)}</h1>
<p><b>Found:</b> the log shows {seen} of {len(listed)} quantities of the robot's world, each
below with the interval that contains it with 95% probability.</p>
<p><b>How sure:</b> {_describe_fit(found)}</p>
<p><b>What to do:</b> {_advise(doubts, world, robot)}</p>
<h2>Estimates</h2>
{table(["quantity", "estimate", "95% interval", ""], rows)}
<h2>Errors in units of the sensors' noise</h2>
{table(["sensor", "model's own world", "identified", "windows held out"], fits)}
{_describe_hypotheses(found)}
{_describe_joints(found, joint_names)}
{figures_html(figures.items())}
<h2>What the log leaves open</h2>
<ul>
{said}</ul>
{_describe_logs(logs, checkups)}"""
    return page(f"identified from {source}", body)


def _row(entry: Estimate) -> list[str]:
    """An estimate's row of the table."""
    value = f"{entry.value:.3g}"
    if entry.chosen:
        return [entry.label, value, "-", "chosen for an arm that follows its commands"]
    interval = f"{entry.low:.3g} to {entry.high:.3g} {entry.unit}"
    return [entry.label, value, interval, "" if entry.seen else "not shown by the log: the prior"]


def _describe_hypotheses(found: Identified) -> str:
    """The hypotheses of the arm, compared, as HTML."""
    if not found.choice.trials:
        return ""
    header = ["the arm is", "unknowns", "error of each joint, mrad", ""]
    rows = [[name, str(count), *rest] for name, count, *rest in table_of(found.choice)]
    return (
        "<h2>What explains the arm, in windows that no fit had seen</h2>\n"
        f"{table(header, rows)}\n<p>The least error wins. A difference within the spread of a "
        "bootstrap over these windows is a tie, and goes to the fewer unknowns.</p>"
    )


def _describe_joints(found: Identified, joint_names: Sequence[str]) -> str:
    """What each joint's intervals rest on, as HTML."""
    columns = found.noise.angles, found.counted.angles, found.joint_errors
    rows = [
        [name, *(f"{1e3 * column[j]:.2f}" for column in columns)]
        for j, name in enumerate(joint_names)
    ]
    header = ["joint", "encoder's noise", "counted as noise", "held out: identified"]
    return f"<h2>Errors of each joint, mrad</h2>\n{table(header, rows)}"


def _describe_fit(found: Identified) -> str:
    """How well the identified world explains the log."""
    errors = found.held_out or found.after
    where = "in windows that the search had not seen" if found.held_out else "in the log"
    named = " and ".join(f"{error:.3g} ({name})" for name, error in errors.items())
    return html.escape(
        f"the arm is explained by {found.choice.chosen.name}; the world's errors {where} are "
        f"{named} times the sensors' noise; 1 is perfect. The intervals are those of the estimates "
        "from resampled windows."
    )


def _advise(doubts: Sequence[str], world: Path, robot: str | None) -> str:
    """What to do with the world, as HTML."""
    if doubts:
        return f"do not train with this world: {html.escape(doubts[0])}"
    if robot is None:
        verb = "adapt"
        train = "bounce-mjx train --warm-start robust_small --config finetune"
        robot_flag = ""
    else:
        # `robust_small` is a policy of the project's own arm, and a warm start refuses another one.
        verb = "train"
        train = "bounce-mjx train --config robust_cpu"
        robot_flag = f" --robot {shlex.quote(robot)}"
    name = shlex.quote(str(world))
    train = html.escape(f"{train} --world {name}")
    check = html.escape(f"bounce-mjx identify LOG{robot_flag} --check {name}")
    return (
        f"{verb} a policy with <code>{train}</code>, and check the robot later with "
        f"<code>{check}</code>."
    )


@style()
def following_figure(log: Log, checkup: Checkup) -> Figure:
    """Each joint's command, later by the joint's delay (wide lines), and its measured angle (thin
    ones)."""
    figure, panels = make_panels(len(checkup.joints), 3, height=1.6)
    rows = _drawn_rows(log)
    for j, (axes, joint) in enumerate(zip(panels, checkup.joints, strict=False)):
        times = log.times[rows]
        late = checkup.response.late_command(log, j, times)
        axes.plot(times, late, lw=4, color="C1", alpha=0.5)
        axes.plot(times, log.joint_angles[rows, j], lw=1, color="C0")
        axes.set_title(f"{joint.name}, rad")
        axes.set_xlabel("time, s")
    return figure


@style()
def difference_figure(log: Log, checkup: Checkup) -> Figure:
    """Each joint's measured angle less its command, later by the joint's delay: an offset, a wrong
    slope or a stretch of rows shows here where both curves look like one."""
    figure, panels = make_panels(len(checkup.joints), 3, height=1.6)
    rows = _drawn_rows(log)
    for j, (axes, joint) in enumerate(zip(panels, checkup.joints, strict=False)):
        late = checkup.response.late_command(log, j, log.times[rows])
        off = log.joint_angles[rows, j] - late
        axes.plot(log.times[rows], 1e3 * off, lw=1, color="C0")
        axes.set_title(f"{joint.name}, mrad")
        axes.set_xlabel("time, s")
    return figure


def _drawn_rows(log: Log) -> slice:
    """The rows of a log that a figure draws."""
    return slice(None, None, max(math.ceil(len(log.times) / _DRAWN), 1))


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
