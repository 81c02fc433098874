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
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.recording import paddle_points
from bounce_mjx.reports.curves import Group, mean_and_band
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.task.shown import Curve, Histogram, Hits, Recording

_REWARD = "reward/"
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
    """The return and the curves of the task over the training, with a dotted line where a run first
    met all results."""
    shown = [Curve("episode/return", "", title="return of an episode")]
    for group in groups:
        shown += [curve for curve in group.task_curves if curve.title and curve not in shown]
    with style():
        figure, panels = _panels(len(shown), columns=3, size=2.1, top=0.3, bottom=0.8, wspace=0.22)
        for axes, curve in zip(panels, shown, strict=True):
            _draw_curve(axes, groups, curve)
            axes.set_ylim(bottom=0.0)
            for group, colour in _coloured(groups):
                for run in group.runs:
                    if run.solved_steps is not None:
                        axes.axvline(run.solved_steps, color=colour, linestyle=":", linewidth=1.0)
        _add_legend(figure, groups, solved=True)
    return figure


def rewards_figure(groups: Sequence[Group]) -> Figure:
    """The weighted reward terms over the training."""
    logged = dict.fromkeys(name for group in groups for run in group.runs for name in run.curves)
    terms = [name for name in logged if name.startswith(_REWARD)]
    with style():
        figure, panels = _panels(len(terms), columns=5, size=1.4, top=0.7, bottom=0.6, wspace=0.42)
        for axes, name in zip(panels, terms, strict=True):
            title = name.removeprefix(_REWARD).replace("_", " ")
            _draw_curve(axes, groups, Curve(name, "", title=title))
            axes.set_xlabel("")
        figure.suptitle(
            "weighted reward terms over environment steps, mean of a control step", fontsize=10
        )
        _add_legend(figure, groups, solved=False)
    return figure


def evaluation_figure(env: Env, recording: Recording) -> Figure:
    """The heights of ball and paddle over the first recorded episode, and what the task draws of
    all recorded episodes."""
    recording = jax.device_get(recording)
    plots = env.task.plots(recording)
    rows = 1 + -(-len(plots) // 2)
    height = 2.8 * rows
    with style():
        figure = Figure(figsize=(10.0, height))
        grid = figure.add_gridspec(
            rows,
            2,
            width_ratios=(1.5, 1.0),
            left=0.06,
            right=0.985,
            top=1.0 - 0.34 / height,
            bottom=0.45 / height,
            hspace=0.36,
        )
        _draw_heights(figure.add_subplot(grid[0, :]), env, recording)
        for i, plot in enumerate(plots):
            axes = figure.add_subplot(grid[1 + i // 2, i % 2])
            if isinstance(plot, Hits):
                _draw_hits(axes, env, plot, paddle_points(env, recording, plot.steps))
            else:
                _draw_histogram(axes, plot)
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


def _panels(
    count: int, columns: int, size: float, top: float, bottom: float, wspace: float
) -> tuple[Figure, list[Axes]]:
    """A figure with a number of panels in rows.

    Args:
      size: height of a row, in.
      top, bottom: margins, in.
    """
    columns = max(1, min(columns, count))
    rows = max(1, -(-count // columns))
    height = size * rows + top + bottom
    figure = Figure(figsize=(10.0, height))
    margins = dict(left=0.06, right=0.985, top=1.0 - top / height, bottom=bottom / height)
    grid = figure.subplots(
        rows, columns, squeeze=False, gridspec_kw=dict(wspace=wspace, hspace=0.55, **margins)
    )
    for axes in grid.flat[count:]:
        axes.remove()
    return figure, [*grid.flat[:count]]


def _draw_curve(axes: Axes, groups: Sequence[Group], shown: Curve) -> None:
    """One line for a group of one run; for several runs, faint lines, their mean, and a band of one
    standard deviation on each side."""
    name, factor = shown.tag, shown.scale
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
    axes.set_title(literal(shown.title))
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
    handles = [
        Line2D([], [], color=colour, linewidth=1.6, label=literal(group.label))
        for group, colour in _coloured(groups)
    ]
    if solved and any(run.solved_steps is not None for group in groups for run in group.runs):
        handles.append(Line2D([], [], color=_GREY, linestyle=":", label="all results met"))
    figure.legend(handles=handles, loc="lower center", ncols=min(3, len(handles)))


def _draw_heights(axes: Axes, env: Env, recording: Recording) -> None:
    """The first recorded episode, up to its end."""
    steps = int(recording.running[:, 0].sum())
    time = env.dt * (1 + np.arange(steps))
    commands = {name: values[:, 0].tolist() for name, values in recording.command.items()}
    levels = [
        env.task.levels({name: values[step] for name, values in commands.items()})
        for step in range(steps)
    ]
    for i, name in enumerate(levels[0]):
        heights = [level[name] for level in levels]
        constant = f" {heights[0]:.2f} m" if len(set(heights)) == 1 else ""
        label = literal(f"{name}{constant}")
        axes.plot(time, heights, color=_COLOURS[(2 + i) % len(_COLOURS)], label=label)
    axes.plot(time, recording.ball[:steps, ..., 2, 0], color=_COLOURS[0], label="ball")
    axes.plot(time, recording.paddle[:steps, 2, 0], color=_COLOURS[1], label="paddle")
    axes.set_xlim(0.0, env.config.episode_seconds)
    if axes.dataLim.y0 >= 0.0:
        axes.set_ylim(bottom=0.0)
    axes.set_title("height over the first recorded episode, m", loc="left")
    axes.set_xlabel("time, s")
    axes.legend(
        loc="lower right", ncols=2 + len(levels[0]), bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0
    )


def _draw_histogram(axes: Axes, plot: Histogram) -> None:
    values, bound = plot.values, plot.bound
    axes.set_title(literal(f"{plot.title} ({len(values):,} {plot.counted})"))
    axes.set_ylabel(literal(plot.counted))
    if not len(values):
        _note(axes, f"no {plot.counted}")
        return
    half = max(1.25 * bound, 1.05 * float(np.abs(values).max()))
    axes.hist(values, bins=51, range=(-half, half), color=_COLOURS[0])
    for side in (-1, 1):
        axes.axvline(side * bound, color=_COLOURS[2], linestyle="--")
    axes.axvline(0.0, color=_GREY, linewidth=0.8)


def _draw_hits(axes: Axes, env: Env, plot: Hits, points: np.ndarray) -> None:
    """The paddle's outline with a dot for each hit."""
    half_x, half_y = env.mj_model.geom_size[find_addresses(env.mj_model).paddle_geom, :2]
    axes.set_title(literal(f"{plot.title} ({len(points):,})"))
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
        _note(axes, "none")


def _note(axes: Axes, text: str) -> None:
    place = dict(ha="center", va="center", transform=axes.transAxes)
    axes.text(0.5, 0.5, literal(text), color=_GREY, **place)
