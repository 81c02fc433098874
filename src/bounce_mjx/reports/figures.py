"""Figures of a training run and of an evaluation, drawn with matplotlib.

They do not use pyplot, so they need no display and can be drawn in several threads.
"""

import functools
import io
from collections.abc import Sequence

import jax
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter, MaxNLocator

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.recording import paddle_points
from bounce_mjx.reports.curves import Group, mean_and_band
from bounce_mjx.task.shown import Curve, Histogram, Hits, Recording

RETURN = "episode/return"
"""Tag of the return in a training's log."""
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
_POINTS = dict(marker="o", markersize=4.0, linestyle="none")
PANEL_WIDTH = 2.6
"""Width of a panel in inches: two of them fit a phone."""
style = functools.partial(matplotlib.rc_context, _STYLE)
"""The look of all figures, around what draws them."""


@style()
def curves_figure(groups: Sequence[Group], columns: int = 3) -> Figure:
    """The return and the curves of the task over the training, with points for evaluations.

    Args:
      columns: most panels side by side.
    """
    shown = [Curve(RETURN, "", title="return of an episode")]
    for group in groups:
        shown += [curve for curve in group.task_curves if curve.title and curve not in shown]
    figure, panels = make_panels(len(shown), columns, height=2.4)
    has_evaluations = False
    for axes, curve in zip(panels, shown, strict=True):
        _draw_curve(axes, groups, curve)
        has_evaluations |= _draw_evaluations(axes, groups, curve)
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("environment steps")
    points = [Line2D([], [], color=_GREY, label="evaluation, without noise", **_POINTS)]
    _add_legend(figure, groups, points if has_evaluations else [])
    return figure


@style()
def rewards_figure(groups: Sequence[Group], columns: int = 5) -> Figure:
    """The weighted reward terms over the training, at most `columns` panels side by side."""
    logged = dict.fromkeys(name for group in groups for run in group.runs for name in run.curves)
    terms = [name for name in logged if name.startswith(_REWARD)]
    figure, panels = make_panels(len(terms), columns, height=1.6)
    for axes, name in zip(panels, terms, strict=True):
        title = name.removeprefix(_REWARD).replace("_", " ")
        _draw_curve(axes, groups, Curve(name, "", title=title))
    title = "weighted reward terms over environment steps,\nmean of a control step"
    figure.suptitle(title, fontsize=10)
    _add_legend(figure, groups)
    return figure


@style()
def evaluation_figure(env: Env, recording: Recording, width: float = 10.0) -> Figure:
    """The heights of ball and paddle over the first recorded episode, and what the task draws of
    all recorded episodes, in a figure of a width in inches."""
    recording = jax.device_get(recording)
    plots = env.task.plots(recording)
    rows = 1 + -(-len(plots) // 2)
    figure = Figure(figsize=(width, 2.8 * rows), layout="constrained")
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.2, 1.0))
    _draw_heights(figure.add_subplot(grid[0, :]), env, recording)
    for i, plot in enumerate(plots):
        axes = figure.add_subplot(grid[1 + i // 2, i % 2])
        if isinstance(plot, Hits):
            _draw_hits(axes, env, plot, paddle_points(env, recording, plot.steps))
        else:
            _draw_histogram(axes, plot)
    return figure


@style()
def image(figure: Figure, suffix: str) -> bytes:
    """A figure as an image file of the format `suffix`, "png" or "svg"."""
    buffer = io.BytesIO()
    metadata = {"Date": None} if suffix == "svg" else None
    figure.savefig(buffer, format=suffix, dpi=150, metadata=metadata)
    return buffer.getvalue()


@style()
def pixels(figure: Figure) -> np.ndarray:
    """A figure as an image [height, width, 3] (uint8)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def literal(text: str) -> str:
    """A text that matplotlib does not read as a formula."""
    return text.replace("$", r"\$")


def _with_colours(groups: Sequence[Group]) -> list[tuple[Group, str]]:
    return [(group, _COLOURS[i % len(_COLOURS)]) for i, group in enumerate(groups)]


def make_panels(count: int, columns: int, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with a number of panels in rows of a height in inches."""
    columns = max(1, min(columns, count))
    rows = max(1, -(-count // columns))
    size = PANEL_WIDTH * columns, height * rows + 0.6
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat[count:]:
        axes.remove()
    return figure, [*grid.flat[:count]]


def _draw_curve(axes: Axes, groups: Sequence[Group], shown: Curve) -> None:
    """One line for a group of one run; for several runs, faint lines, their mean, and a band of one
    standard deviation on each side. A dotted line shows where a run first met all results."""
    name, factor = shown.tag, shown.scale
    for group, colour in _with_colours(groups):
        for run in group.runs:
            if run.solved_steps is not None:
                axes.axvline(run.solved_steps, color=colour, linestyle=":", linewidth=1.0)
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
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))


def _draw_evaluations(axes: Axes, groups: Sequence[Group], shown: Curve) -> bool:
    """A point for each evaluation of the quantity, in which actions are not sampled; whether there
    is one."""
    name = "mean_return" if shown.tag == RETURN else f"mean_{shown.metric}_m"
    found = False
    for group, colour in _with_colours(groups):
        for run in group.runs:
            if (curve := run.curves.get(f"results/{name}")) is not None:
                axes.plot(curve.steps, shown.scale * curve.values, color=colour, **_POINTS)
                found = True
    return found


def _add_legend(figure: Figure, groups: Sequence[Group], others: Sequence[Line2D] = ()) -> None:
    handles = [
        Line2D([], [], color=colour, linewidth=1.6, label=literal(group.label))
        for group, colour in _with_colours(groups)
    ]
    if any(run.solved_steps is not None for group in groups for run in group.runs):
        handles.append(Line2D([], [], color=_GREY, linestyle=":", label="all results met"))
    handles += others
    columns = max(1, round(figure.get_figwidth() / PANEL_WIDTH))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(columns, len(handles)))


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
    axes.legend(loc="upper center", ncols=2 + len(levels[0]), bbox_to_anchor=(0.5, -0.2))


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
    outline = env.mj_model.geom_size[env.addresses.paddle_geom, :2]
    half_x, half_y = 100.0 * outline
    axes.add_patch(
        Rectangle(
            (-half_y, -half_x),
            2.0 * half_y,
            2.0 * half_x,
            facecolor="#f6ebe0",
            edgecolor=_COLOURS[1],
        )
    )
    axes.plot([0], [0], "+", color=_GREY)
    x, y = 100.0 * points.T[:2]
    axes.plot(y, x, ".", markersize=3, alpha=0.4, color=_COLOURS[0], markeredgewidth=0)
    axes.set(
        title=literal(f"{plot.title} ({len(points):,})"),
        xlabel="paddle's y",
        ylabel="paddle's x",
        xlim=(-1.3 * half_y, 1.3 * half_y),
        ylim=(-1.3 * half_x, 1.3 * half_x),
        aspect="equal",
    )
    if not len(points):
        _note(axes, "none")


def _note(axes: Axes, text: str) -> None:
    place = dict(ha="center", va="center", transform=axes.transAxes)
    axes.text(0.5, 0.5, literal(text), color=_GREY, **place)
