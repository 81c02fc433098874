"""Figures of a training run and of an evaluation, drawn with matplotlib.

They do not use pyplot, so they need no display.
"""

import functools
import io
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter, MaxNLocator

from bounce_mjx.env.contract import ENDS
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.statistics import paddle_points
from bounce_mjx.reports.curves import Group, LoggedCurve, mean_and_band
from bounce_mjx.task.task import Curve, Histogram, Hits, Recording

RETURN = "episode/return"
"""Tag of the return in a training's log."""
_REWARD = "reward/"
_METRIC = "task/"
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
    # Names of tasks may have a $.
    "text.parse_math": False,
    # The same figure gives the same file.
    "svg.hashsalt": "bounce_mjx",
    # Okabe and Ito's palette, whose colours colour-blind readers can distinguish.
    "axes.prop_cycle": matplotlib.cycler(
        color=("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
    ),
}
PANEL_WIDTH = 2.6
"""Width of a panel in inches: two of them fit a phone."""
style = functools.partial(matplotlib.rc_context, _STYLE)
"""The look of all figures, around what draws them."""


Draw = Callable[..., Figure]
"""Draws groups of runs (`curves.Group`). Its argument `columns`, which has a default, is the most
panels side by side."""


class RunPlot(NamedTuple):
    """A plot of trainings."""

    title: str | None
    """Heading in the report; None for a plot that `bounce-mjx plot` alone draws."""
    draw: Draw


@style()
def curves_figure(groups: Sequence[Group], columns: int = 3) -> Figure:
    """The return, the curves of the task, and the mean of each metric that none of them names, over
    the training, with points for evaluations.

    Args:
      columns: most panels side by side.
    """
    shown = [Curve(RETURN, "", title="return of an episode")]
    for group in groups:
        shown += [curve for curve in group.task_curves if curve.title and curve not in shown]
    shown += _unnamed_curves(groups)
    figure = _draw_curves(groups, shown, columns, height=2.4)
    for axes in figure.axes:
        _begin_at_zero(axes)
        axes.set_xlabel("environment steps")
    return figure


@style()
def rewards_figure(groups: Sequence[Group], columns: int = 5) -> Figure:
    """The weighted reward terms over the training, at most `columns` panels side by side."""
    figure = _draw_curves(groups, _reward_curves(groups), columns, height=1.6)
    title = "weighted reward terms over environment steps,\nmean of a control step"
    figure.suptitle(title, fontsize=10)
    return figure


RUN_PLOTS = {
    "curves": RunPlot("Learning curves", curves_figure),
    # The report has `reward_panels`, as many side by side as there is room for.
    "rewards": RunPlot(None, rewards_figure),
}
"""The plots that `bounce-mjx plot` and the report draw, by the names of their files."""

EVALUATION = "evaluation"
"""Name of the file of `evaluation_figure`."""

_TAKEN_NAMES = frozenset((*RUN_PLOTS, EVALUATION))


def run_plot(name: str, title: str | None) -> Callable[[Draw], Draw]:
    """Registers a function as a `RunPlot`, in place of one that was registered with this name. It
    belongs into the task's file, which is imported before anything is drawn.

    Raises:
      UserError: the name is that of a picture of the package.
    """
    if name in _TAKEN_NAMES:
        raise UserError(
            f"the plot {name!r} has the name of a picture of the package; choose another name"
        )

    def register(draw: Draw) -> Draw:
        RUN_PLOTS[name] = RunPlot(title, style()(draw))
        return draw

    return register


@style()
def reward_panels(groups: Sequence[Group]) -> dict[str, Figure]:
    """The panels of `rewards_figure` one by one, without a legend, by the name of the term."""
    panels = {}
    for curve in _reward_curves(groups):
        figure = Figure(figsize=(PANEL_WIDTH, 1.6), layout="constrained")
        _draw_curve(figure.subplots(), groups, curve)
        panels[curve.title] = figure
    return panels


def _reward_curves(groups: Sequence[Group]) -> list[Curve]:
    """The reward terms that any of the runs has logged."""
    return [_curve_of(tag, _REWARD) for tag in _logged(groups) if tag.startswith(_REWARD)]


def _unnamed_curves(groups: Sequence[Group]) -> list[Curve]:
    """The metrics of the tasks that any of the runs has logged and no curve of a task names."""
    named = {f"{_METRIC}{end}" for end in ENDS}
    for group in groups:
        named |= {curve.tag for curve in group.task_curves}
    tags = [tag for tag in _logged(groups) if tag.startswith(_METRIC) and tag not in named]
    return [_curve_of(tag, _METRIC) for tag in tags]


def _logged(groups: Sequence[Group]) -> list[str]:
    """What any of the runs has logged, without repetitions, in its order."""
    tags: dict[str, None] = {}
    for group in groups:
        for run in group.runs:
            tags |= dict.fromkeys(run.curves)
    return list(tags)


def _curve_of(tag: str, prefix: str) -> Curve:
    """The curve of a mean over steps, whose title is the tag without its prefix."""
    return Curve(tag=tag, metric="", title=tag.removeprefix(prefix).replace("_", " "))


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
            draw_hits(axes, env, plot, paddle_points(env, recording, plot.steps))
        else:
            _draw_histogram(axes, plot)
    return figure


@style()
def image(figure: Figure, suffix: str) -> bytes:
    """A figure as an image file of the format `suffix`, "png" or "svg"."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=suffix, dpi=150, metadata={"Date": None})
    return buffer.getvalue()


def make_panels(count: int, columns: int, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with a number of panels in rows of a height in inches.

    Args:
      columns: most panels side by side; no more than the rows need.
    """
    rows = max(1, -(-count // columns))
    columns = max(1, -(-count // rows))
    size = PANEL_WIDTH * columns, height * rows + 0.6
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat[count:]:
        axes.remove()
    return figure, [*grid.flat[:count]]


def _draw_curves(
    groups: Sequence[Group], shown: Sequence[Curve], columns: int, height: float
) -> Figure:
    """A panel for each curve, of a height in inches, and a legend."""
    figure, panels = make_panels(len(shown), columns, height)
    for axes, curve in zip(panels, shown, strict=True):
        _draw_curve(axes, groups, curve)
    # A panel whose curve has no points yet would have its own steps.
    last_step = max((axes.get_xlim()[1] for axes in panels), default=0.0)
    for axes in panels:
        axes.set_xlim(0, last_step)
    add_legend(figure)
    return figure


def _draw_curve(axes: Axes, groups: Sequence[Group], shown: Curve) -> None:
    """One line for a group of one run; for several runs, faint lines, their mean, and a band of one
    standard deviation on each side. A point for each evaluation, in which actions are not sampled,
    and a dotted line where a run first met all results."""
    # Where the task's details have the mean of the metric, as mean_error_m.
    evaluated = "mean_return" if shown.tag == RETURN else f"mean_{shown.metric}_m"
    for i, group in enumerate(groups):
        curves = [run.curves[shown.tag] for run in group.runs if shown.tag in run.curves]
        if curves:
            _draw_group(axes, curves, shown.scale, f"C{i}", group.label)
    for i, group in enumerate(groups):
        for run in group.runs:
            points = run.curves.get(f"results/{evaluated}")
            if points is not None:
                values = shown.scale * points.values
                label = "evaluation, actions not sampled"
                axes.plot(points.steps, values, "o", color=f"C{i}", ms=4.0, label=label)
            if run.solved_steps is not None:
                axes.axvline(
                    run.solved_steps, color=f"C{i}", ls=":", lw=1.0, label="all results met"
                )
    axes.set_title(shown.heading)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))


def _draw_group(
    axes: Axes, curves: Sequence[LoggedCurve], scale: float, colour: str, label: str
) -> None:
    """The mean of a curve over runs, with each run and the band if there are several."""
    steps, mean, deviation = mean_and_band(curves)
    mean = scale * mean
    deviation = scale * deviation
    # A line of one point shows nothing.
    marker = "." if len(steps) == 1 else ""
    axes.plot(steps, mean, color=colour, marker=marker, lw=1.6, label=label)
    if len(curves) == 1:
        return
    for curve in curves:
        axes.plot(curve.steps, scale * curve.values, color=colour, alpha=0.3, lw=0.7)
    axes.fill_between(
        steps, mean - deviation, mean + deviation, color=colour, alpha=0.2, linewidth=0
    )


def _begin_at_zero(axes: Axes) -> None:
    """Begins the vertical axis at 0, unless a line goes below it, as a return may."""
    lowest = min((np.min(line.get_ydata(), initial=0.0) for line in axes.lines), default=0.0)
    if lowest >= 0.0:
        axes.set_ylim(bottom=0.0)


def add_legend(figure: Figure) -> None:
    """A legend of what any panel shows."""
    shown: dict[str, list[Artist]] = {}
    for axes in figure.axes:
        for artist, label in zip(*axes.get_legend_handles_labels(), strict=True):
            shown.setdefault(label, []).append(artist)
    handles = {label: _legend_handle(artists) for label, artists in shown.items()}
    # About 0.1 inches a letter with its share of the line and of the gaps.
    widest = max(0.1 * len(label) + 0.6 for label in handles or [""])
    columns = max(1, min(int(figure.get_figwidth() / widest), len(handles)))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)


def _legend_handle(artists: Sequence[Artist]) -> Artist:
    """What stands in a legend for all that have its label: grey where their colours differ."""
    first = artists[0]
    colours = {artist.get_color() for artist in artists if isinstance(artist, Line2D)}
    if len(colours) < 2:
        return first
    grey = Line2D([], [])
    grey.update_from(first)
    grey.set_color(_GREY)
    return grey


def _draw_heights(axes: Axes, env: Env, recording: Recording) -> None:
    """The first recorded episode, up to its end."""
    steps = int(recording.running[:, 0].sum())
    time = env.dt * (1 + np.arange(steps))
    levels = []
    for step in range(steps):
        goal = {name: float(values[step, 0]) for name, values in recording.goal.items()}
        levels.append(env.task.levels(goal))
    for i, name in enumerate(levels[0]):
        heights = [level[name] for level in levels]
        constant = f" {heights[0]:.2f} m" if len(set(heights)) == 1 else ""
        axes.plot(time, heights, color=f"C{2 + i}", label=f"{name}{constant}")
    balls = recording.ball[:steps, ..., 2, 0].reshape(steps, -1)
    # One label for all of them.
    name = "ball" if balls.shape[1] == 1 else "balls"
    for heights in balls.T:
        axes.plot(time, heights, color="C0", label=name)
        name = None
    axes.plot(time, recording.paddle[:steps, 2, 0], color="C1", label="paddle")
    axes.set_xlim(0.0, env.config.episode_seconds)
    _begin_at_zero(axes)
    axes.set_title("height over the first recorded episode, m", loc="left")
    axes.set_xlabel("time, s")
    axes.legend(loc="upper center", ncols=2 + len(levels[0]), bbox_to_anchor=(0.5, -0.2))


def _draw_histogram(axes: Axes, plot: Histogram) -> None:
    values, bound = plot.values, plot.bound
    axes.set_title(f"{plot.title}\n({len(values):,} {plot.counted})")
    axes.set_ylabel(plot.counted)
    half = max(1.25 * bound, 1.05 * float(np.abs(values).max(initial=0.0)))
    axes.hist(values, bins=51, range=(-half, half), color="C0")
    for side in (-1, 1):
        axes.axvline(side * bound, color="C2", linestyle="--")
    axes.axvline(0.0, color=_GREY, linewidth=0.8)


def draw_hits(axes: Axes, env: Env, plot: Hits, points: np.ndarray) -> None:
    """The paddle's outline with a dot for each hit, also of those beside the paddle's face."""
    outline = env.mj_model.geom_size[env.addresses.paddle_geom, :2]
    half_x, half_y = 100.0 * outline
    corner, size = (-half_y, -half_x), (2.0 * half_y, 2.0 * half_x)
    axes.add_patch(Rectangle(corner, *size, facecolor="#f6ebe0", edgecolor="C1"))
    axes.plot([0], [0], "+", color=_GREY)
    x, y = 100.0 * points.T[:2]
    axes.plot(y, x, ".", markersize=3, alpha=0.4, color="C0", markeredgewidth=0)
    axes.set_title(f"{plot.title}\n({len(points):,})")
    axes.set(xlabel="paddle's y", ylabel="paddle's x", aspect="equal")
    width = max(1.3 * half_y, 1.05 * float(np.abs(y).max(initial=0.0)))
    height = max(1.3 * half_x, 1.05 * float(np.abs(x).max(initial=0.0)))
    axes.set(xlim=(-width, width), ylim=(-height, height))
