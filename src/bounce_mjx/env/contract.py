"""The contract of a task: what its methods return, and the names that it may use. A mistake is a
`UserError` of one sentence, before anything is compiled. None is part of a compiled program: names,
shapes and types alone are read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bounce_mjx.env.expected import (
    ANY_NUMBER,
    FLOATING,
    TRUTH,
    Code,
    Exactly,
    Like,
    Named,
    described,
    has_shape,
)
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.task.results import Episodes, Result
from bounce_mjx.task.rewards import check_names
from bounce_mjx.task.task import Curve, Moment, Start, Step, Tally, Task, TaskStep
from bounce_mjx.world.config import WorldConfig

ENDS = ("non_finite", "too_fast")
"""Metrics of the ends of an episode that are no task's; an environment of another kind may lack
them."""
WORLD_PREFIXES = ("world/", "true/")
"""Prefixes of the metrics that an environment has only where its world is sampled (`world/`), or
where its observation may differ from the true state of one instant (`true/`)."""
METRIC_PREFIXES = ("reward", *WORLD_PREFIXES)
"""Prefixes of the environment's metrics that are neither its ends nor its task's."""
_TAKEN_METRICS = (*ENDS, "steps", "episodes")
"""Names that a task's metrics cannot have; the last two are what a curve may be over."""
_TAKEN_TAGS = (
    "steps",
    "ended",
    "return",
    "length",
    "episode/return",
    "episode/length",
    "episode/ended",
    *(f"task/{end}" for end in ENDS),
)
"""Tags that a curve cannot have: the curves that every training has, and the sums behind them."""
_TAKEN_TAG_PREFIXES = ("reward", "loss/", "policy/", "speed/", "results/")
"""Prefixes of what a training logs beside the curves of a task."""
# Episodes of the figures with which the results are tried.
_TRIED_EPISODES = 4


def unnamed_metrics(metrics: Iterable[str], curves: Sequence[Curve]) -> list[str]:
    """The task's metrics that no curve shows or counts. A training logs each by the tag
    `task/<metric>`, as its mean over the steps."""
    named = {curve.metric for curve in curves} | {curve.over for curve in curves}
    known = named.union(ENDS)
    return [name for name in metrics if name not in known and not name.startswith(METRIC_PREFIXES)]


class Outline(NamedTuple):
    """What an environment has to know of a task's step before the first one."""

    metrics: list[str]
    """Names of the metrics that it adds: its weighted terms and its own."""
    reads_time: bool
    """Whether it reads `Step.seconds`."""


class CheckedTask:
    """A task, with what its methods return compared with what an environment expects of them.

    An environment asks it at a reset and for what the sensors remember; what a reset does not need
    is compared there all the same (`outline`), and then asked of the task itself.
    """

    def __init__(self, task: Task, config: WorldConfig):
        self._task = task
        self._config = config

    def _code(self, method: str) -> Code:
        """A method of the task."""
        name = f"{method} of the task {type(self._task).__name__}"
        return Code(getattr(self._task, method), name)

    def throw(
        self, draws: jax.Array, goal: Mapping[str, jax.Array]
    ) -> tuple[jax.Array, jax.Array] | None:
        """`Task.throw`: None, or a position and a velocity of each ball."""
        code = self._code("throw")
        thrown = code(draws, goal)
        if thrown is None:
            return None
        parts = []
        if isinstance(thrown, tuple | list) or has_shape(thrown):
            # The shapes alone, also of a list of coordinates.
            parts = jax.eval_shape(lambda: [jnp.asarray(part) for part in thrown])
        num_balls = self._config.num_balls
        allowed = [(num_balls, 3)] if num_balls > 1 else [(3,), (1, 3)]
        shapes = [part.shape for part in parts]
        if len(shapes) != 2 or not all(shape in allowed for shape in shapes):
            returned = described(thrown)
            if isinstance(thrown, tuple | list):
                returned += f" of the shapes {', '.join(map(str, shapes)) or 'none'}"
            raise UserError(
                f"{code.named} returns {returned}; return the position and the velocity of the "
                f"ball, two arrays of the shape {allowed[0]}"
            )
        return thrown

    def first_goal(self, sampled: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """`Task.first_goal`: one number of floating point for each goal."""
        code = self._code("first_goal")
        goal = code(sampled)
        code.compare(goal, Exactly("goal", dict.fromkeys(sampled, FLOATING)))
        return goal

    def reset(self, start: Start) -> Any:
        """`Task.reset`: any tree."""
        return self._code("reset")(start)

    def next_goal(self, state: Any, goal: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """`Task.next_goal`: one number of floating point for each goal."""
        code = self._code("next_goal")
        following = code(state, goal)
        code.compare(following, Exactly("goal", dict.fromkeys(goal, FLOATING)))
        return following

    def first_quantities(self, measured: dict[str, jax.Array]) -> tuple[Any, dict[str, jax.Array]]:
        """`Task.first_quantities`: at least one value of each of its quantities that the policy
        sees, and none with the name of one of the world's."""
        code = self._code("first_quantities")
        memory, quantities = code.pair("what it remembers and its first quantities", measured)
        code.compare(quantities, Named(None))
        for name in self._config.observation.counts():
            if name not in quantities and name not in measured:
                raise UserError(
                    f"{code.named} lacks the observation's quantity {shorten(name)}; return its "
                    "first value too"
                )
        for name in quantities:
            if name in measured:
                raise UserError(
                    f"{code.named} has the quantity {shorten(name)}, which is one of the world's; "
                    "give it another name"
                )
        return memory, quantities

    def next_quantities(
        self, memory: Any, histories: dict[str, jax.Array], measured: dict[str, jax.Array]
    ) -> tuple[Any, dict[str, jax.Array]]:
        """`Task.next_quantities`: a memory and histories like those before."""
        code = self._code("next_quantities")
        wanted = "what it remembers and the histories"
        next_memory, following = code.pair(wanted, memory, dict(histories), measured)
        if set(following) != set(histories):
            raise UserError(
                f"{code.named} returns the histories {', '.join(following) or 'none'}; return "
                f"those of its argument: {', '.join(sorted(histories)) or 'none'}"
            )
        code.compare(following, Like(histories, "its argument"), "the histories")
        code.compare(next_memory, Like(memory, "what it remembered before"), "what it remembers")
        return next_memory, following

    def outline(self, state: Any, step: Step, own_metrics: Sequence[str]) -> Outline:
        """What a step of the task returns, compared, with its curves, its tally and its results;
        nothing of them is computed.

        Args:
          state: the task's at a reset.
          step: a first step; its values are not read.
          own_metrics: names of the environment's own metrics.
        """
        result, reads_time = self._check_step(state, step)
        rewards = [f"reward/{name}" for name in result.reward]
        metrics = [*rewards, *result.metrics]
        self._check_curves([*metrics, *own_metrics], result.metrics)
        tally = self._check_tally(result, step, [*metrics, *own_metrics])
        self._check_results(tally)
        return Outline(metrics, reads_time)

    def _check_step(self, state: Any, step: Step) -> tuple[TaskStep, bool]:
        """What a step returns, as shapes and types, and whether it reads the time."""
        code = self._code("step")
        zero = jnp.zeros_like(step.truth.joint_angles[0])
        result, reads_time = code.traced(
            lambda seconds: (state, step._replace(seconds=seconds)), zero
        )
        state_before = jax.eval_shape(lambda: state)
        code.compare(
            result,
            TaskStep(
                state=Like(state_before, "at a reset"),
                reward=Named(ANY_NUMBER),
                ended=TRUTH,
                metrics=Named(ANY_NUMBER),
            ),
        )
        for name in result.metrics:
            if name in _TAKEN_METRICS or name.startswith(METRIC_PREFIXES):
                raise UserError(
                    f"the metric {name} of the task {type(self._task).__name__} has a name of the "
                    f"environment's own ({', '.join(_TAKEN_METRICS)}, or one that begins with "
                    f"{', '.join(METRIC_PREFIXES)}); choose another name"
                )
        return result, reads_time

    def _check_curves(self, metrics: Sequence[str], of_task: Mapping[str, Any]) -> None:
        """Refuses a curve of a metric that there is not, and one in whose place the log would have
        another one, or the reverse.

        Args:
          metrics: all metrics of the environment.
          of_task: those of the task's step.
        """
        for curve in self._task.curves:
            named = {curve.metric}
            if curve.over not in ("steps", "episodes"):
                named.add(curve.over)
            # A curve may not name an unknown metric, and need not name them all.
            check_names(f"the curve {curve.tag}", "metric", {*metrics, *named}, metrics)
        # After the names, as a mistyped metric leaves another one without its curve.
        taken = {*_TAKEN_TAGS}
        taken.update(f"task/{name}" for name in unnamed_metrics(of_task, self._task.curves))
        for curve in self._task.curves:
            if curve.tag in taken or curve.tag.startswith(_TAKEN_TAG_PREFIXES):
                raise UserError(
                    f"the tag {curve.tag} of a curve of the task {type(self._task).__name__} is "
                    "taken; choose another one"
                )
            taken.add(curve.tag)

    def _check_tally(self, result: TaskStep, step: Step, metrics: Sequence[str]) -> Tally:
        code = self._code("tally")
        zero = jnp.zeros(())
        moment = Moment(
            truth=step.truth,
            goal=step.goal,
            state=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), result.state),
            metrics=dict.fromkeys(metrics, zero),
            seconds=zero,
            goal_seconds=zero,
        )
        tally = code.shapes(moment)
        code.compare(tally, Tally(sums=Named(ANY_NUMBER), maxima=Named(ANY_NUMBER)))
        return tally

    def _check_results(self, tally: Tally) -> None:
        """Refuses results that cannot be computed from the figures of the tally, or that are none:
        they are tried with 1 for each figure."""
        if type(self._task).results is Task.results:
            # Without an evaluation, it needs none.
            return
        code = self._code("results")
        ones = np.ones(_TRIED_EPISODES)
        episodes = Episodes(
            sums=dict.fromkeys(tally.sums, ones),
            maxima=dict.fromkeys(tally.maxima, ones),
            lasted=ones > 0,
            goals={name: (each.low, each.high) for name, each in self._config.goals.items()},
        )
        # The figures are none of real episodes.
        with np.errstate(all="ignore"):
            results = code(episodes)
            self._code("details")(episodes)
        is_sequence = isinstance(results, tuple | list)
        if not is_sequence or not all(isinstance(result, Result) for result in results):
            raise UserError(
                f"{code.named} returns {described(results)}; return a tuple of task.Result, such "
                "as (task.share_of_episodes(...),)"
            )
