"""Figures of a training and of an evaluation, drawn with matplotlib.

They do not use pyplot, so they need no display and can be drawn in several threads.
"""

import contextlib
import io
from collections.abc import Iterator, Sequence

import jax
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.recording import Recording, apex_errors, hit_points, settled_bounces
from bounce_mjx.evaluation.statistics import MAX_APEX_ERROR, SETTLING_SECONDS
from bounce_mjx.reports.curves import Group, mean_and_band
from bounce_mjx.task.rewards import TERM_NAMES

# Tags of the log, their titles in the figure, and the factor to the displayed unit.
CURVES = (
    ("episode/return", "return of an episode", 1.0),
    ("episode/bounces", "bounces in a row at its end", 1.0),
    ("task/apex_error", "|apex − target height|, cm", 100.0),
)
# Okabe and Ito's palette, whose colours colour-blind readers can distinguish.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_GREY = "#777777"
_STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e3e3e3",
    "axes.axisbelow": True,
    "legend.frameon": False,
    # The same figure gives the same file.
    "svg.hashsalt": "bounce_mjx",
}


def curves_figure(groups: Sequence[Group]) -> Figure:
    """Return, bounces and apex error over the training, with a dotted line where a run first met
    all five results."""
    with style():
        figure = Figure(figsize=(10.0, 3.2))
        grid = figure.subplots(
            1, 3, gridspec_kw=dict(left=0.06, right=0.985, top=0.91, bottom=0.26, wspace=0.22)
        )
        for axes, (name, title, factor) in zip(grid, CURVES, strict=True):
            _draw_curve(axes, groups, name, title, factor)
            axes.set_ylim(bottom=0.0)
            for group, colour in _coloured(groups):
                for run in group.runs:
                    if run.solved_steps is not None:
                        axes.axvline(run.solved_steps, color=colour, linestyle=":", linewidth=1.0)
        _add_legend(figure, groups, solved=True)
    return figure


def rewards_figure(groups: Sequence[Group]) -> Figure:
    """The weighted reward terms over the training."""
    columns = 5
    rows = -(-len(TERM_NAMES) // columns)
    height = 1.8 * rows
    with style():
        figure = Figure(figsize=(10.0, height))
        # The margins, in inches, do not depend on the number of rows.
        margins = dict(top=1.0 - 0.7 / height, bottom=0.6 / height)
        grid = figure.subplots(
            rows,
            columns,
            squeeze=False,
            gridspec_kw=dict(left=0.06, right=0.985, wspace=0.42, hspace=0.55, **margins),
        )
        for axes, name in zip(grid.flat, TERM_NAMES, strict=False):
            _draw_curve(axes, groups, f"reward/{name}", name.replace("_", " "), 1.0)
            axes.set_xlabel("")
        for axes in grid.flat[len(TERM_NAMES) :]:
            axes.remove()
        figure.suptitle(
            "weighted reward terms over environment steps, mean of a control step", fontsize=10
        )
        _add_legend(figure, groups, solved=False)
    return figure


def evaluation_figure(env: Env, recording: Recording) -> Figure:
    """The ball's height and its target over the first recorded episode, and the apex errors and
    the hits on the paddle of all recorded episodes."""
    recording = jax.device_get(recording)
    bounces = settled_bounces(recording, round(SETTLING_SECONDS / env.dt))
    with style():
        figure = Figure(figsize=(10.0, 5.6))
        grid = figure.add_gridspec(
            2,
            2,
            width_ratios=(1.5, 1.0),
            left=0.05,
            right=0.985,
            top=0.94,
            bottom=0.08,
            hspace=0.36,
        )
        _draw_heights(figure.add_subplot(grid[0, :]), env, recording)
        _draw_apex_errors(figure.add_subplot(grid[1, 0]), apex_errors(recording, bounces))
        _draw_hits(figure.add_subplot(grid[1, 1]), env, hit_points(env, recording, bounces))
    return figure


def image(figure: Figure, suffix: str) -> bytes:
    """A figure as an image file of the format `suffix`, "png" or "svg"."""
    buffer = io.BytesIO()
    with style():
        figure.savefig(
            buffer, format=suffix, dpi=150, metadata={"Date": None} if suffix == "svg" else None
        )
    return buffer.getvalue()


def pixels(figure: Figure) -> np.ndarray:
    """A figure as a picture [height, width, 3] (uint8)."""
    with style():
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def literal(text: str) -> str:
    """A text that matplotlib does not read as a formula."""
    return text.replace("$", r"\$")


@contextlib.contextmanager
def style() -> Iterator[None]:
    """The look of all figures."""
    with matplotlib.rc_context(_STYLE):
        yield


def _coloured(groups: Sequence[Group]) -> list[tuple[Group, str]]:
    return [(group, _COLOURS[i % len(_COLOURS)]) for i, group in enumerate(groups)]


def _draw_curve(axes: Axes, groups: Sequence[Group], name: str, title: str, factor: float) -> None:
    """One line for a group of one run; for several runs, faint lines, their mean, and a band of one
    standard deviation on each side."""
    for group, colour in _coloured(groups):
        curves = [run.curves[name] for run in group.runs if name in run.curves]
        if not curves:
            continue
        if len(curves) > 1:
            for curve in curves:
                axes.plot(curve.steps, factor * curve.values, color=colour, alpha=0.3, lw=0.7)
        steps, mean, deviation = mean_and_band(curves)
        mean, deviation = factor * mean, factor * deviation
        axes.plot(steps, mean, color=colour, linewidth=1.6)
        if len(curves) > 1:
            axes.fill_between(
                steps, mean - deviation, mean + deviation, color=colour, alpha=0.2, linewidth=0
            )
    axes.set_title(title)
    axes.set_xlabel("environment steps")
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(FuncFormatter(_steps_label))
    axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_formatter(FuncFormatter(_value_label))


def _steps_label(steps: float, _) -> str:
    return f"{steps / 1e6:g}M" if steps >= 1e5 else f"{steps / 1e3:g}k" if steps else "0"


def _value_label(value: float, _) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _add_legend(figure: Figure, groups: Sequence[Group], *, solved: bool) -> None:
    axes = figure.axes[0]
    handles = [
        axes.plot([], [], color=colour, linewidth=1.6, label=literal(group.label))[0]
        for group, colour in _coloured(groups)
    ]
    if solved and any(run.solved_steps is not None for group in groups for run in group.runs):
        handles += axes.plot([], [], color=_GREY, linestyle=":", label="all five results met")
    figure.legend(handles=handles, loc="lower center", ncols=min(3, len(handles)))


def _draw_heights(axes: Axes, env: Env, recording: Recording) -> None:
    """The first recorded episode, up to its end."""
    steps = int(np.asarray(recording.running[:, 0]).sum())
    time = env.dt * (1 + np.arange(steps))
    target = float(recording.target_height[0, 0])
    axes.axhspan(
        target - MAX_APEX_ERROR, target + MAX_APEX_ERROR, color="#009E73", alpha=0.12, lw=0
    )
    axes.axhline(target, color="#009E73", label=f"target {target:.2f} m, ± {MAX_APEX_ERROR} m")
    axes.plot(time, recording.ball[:steps, 2, 0], color=_COLOURS[0], label="ball")
    axes.plot(time, recording.paddle[:steps, 2, 0], color=_COLOURS[1], label="paddle")
    axes.set_xlim(0.0, env.config.episode_seconds)
    axes.set_ylim(bottom=0.0)
    axes.set_title("height over the first recorded episode, m", loc="left")
    axes.set_xlabel("time, s")
    axes.legend(loc="lower right", ncols=3, bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)


def _draw_apex_errors(axes: Axes, errors: np.ndarray) -> None:
    axes.set_title(f"apex minus target height, cm ({len(errors):,} bounces after 2 s)")
    axes.set_ylabel("bounces")
    if not len(errors):
        _note_no_bounce(axes)
        return
    half = max(1.25 * MAX_APEX_ERROR, 1.05 * float(np.abs(errors).max()))
    axes.hist(100 * errors, bins=51, range=(-100 * half, 100 * half), color=_COLOURS[0])
    for side in (-1, 1):
        axes.axvline(side * 100 * MAX_APEX_ERROR, color="#009E73", linestyle="--")
    axes.axvline(0.0, color=_GREY, linewidth=0.8)


def _draw_hits(axes: Axes, env: Env, points: np.ndarray) -> None:
    """The paddle's outline with a dot for each hit."""
    half_x, half_y = env.mj_model.geom("blocker").size[:2]
    axes.set_title(f"hits on the paddle, cm ({len(points):,})")
    axes.add_patch(
        Rectangle(
            (-100 * half_y, -100 * half_x),
            200 * half_y,
            200 * half_x,
            facecolor="#f6ebe0",
            edgecolor=_COLOURS[1],
        )
    )
    axes.plot([0], [0], "+", color=_GREY)
    axes.plot(
        100 * points[:, 1],
        100 * points[:, 0],
        ".",
        markersize=3,
        alpha=0.4,
        color=_COLOURS[0],
        markeredgewidth=0,
    )
    axes.set_xlim(-130 * half_y, 130 * half_y)
    axes.set_ylim(-130 * half_x, 130 * half_x)
    axes.set_aspect("equal")
    axes.set_xlabel("paddle's y")
    axes.set_ylabel("paddle's x")
    if not len(points):
        _note_no_bounce(axes)


def _note_no_bounce(axes: Axes) -> None:
    axes.text(
        0.5,
        0.5,
        "no bounce after 2 s",
        ha="center",
        va="center",
        transform=axes.transAxes,
        color=_GREY,
    )
