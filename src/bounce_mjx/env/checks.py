"""What an environment refuses before its first step: settings that its task or its model cannot
have. Each check raises a `UserError` of one sentence."""

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.robot.model import Addresses, joint_names, joint_ranges
from bounce_mjx.task.task import Curve, Task
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import TERMS

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

# Two turns of a joint without a range, rad; or m.
_MAX_ANGLE = 4.0 * np.pi
# Poses in files are rounded, rad or m.
_ROUNDING = 1e-3
# A ball that starts farther beside the paddle falls before the paddle is under it, m.
_FARTHEST_BESIDE = 0.3


def check_has_task(config: WorldConfig) -> None:
    """Refuses settings of the world alone."""
    if config.task is None:
        raise UserError(
            f"{type(config).__name__} has the settings of a world without a task; give a task's, "
            "such as BounceConfig or your task's Config"
        )


def check_task(config: WorldConfig, task: Task) -> None:
    """Refuses what the task cannot have, whatever the model."""
    _check_names_of_commands(config)
    _check_commands_are_seen(config)
    _check_num_balls(config, task)


def _check_names_of_commands(config: WorldConfig) -> None:
    """Refuses a command named like a term of the randomisation or a measurement, which would be
    taken for it."""
    quantities = config.observation.quantities()
    for name in config.commands:
        is_measurement = name in quantities and quantities[name].group != "command"
        if name in TERMS or is_measurement:
            kind = "a term of the randomisation" if name in TERMS else "a measurement"
            raise UserError(f"the command {name} has the name of {kind}; choose another name")


def check_metrics(names: Iterable[str], task: Task) -> None:
    """Refuses metrics of a task's step that the environment has itself."""
    for name in names:
        if name in _TAKEN_METRICS or name.startswith(METRIC_PREFIXES):
            raise UserError(
                f"the metric {name} of the task {type(task).__name__} has a name of the "
                f"environment's own ({', '.join(_TAKEN_METRICS)}, or one that begins with "
                f"{', '.join(METRIC_PREFIXES)}); choose another name"
            )


def unnamed_metrics(metrics: Iterable[str], curves: Sequence[Curve]) -> list[str]:
    """The task's metrics that no curve shows or counts. A training logs each by the tag
    `task/<metric>`, as its mean over the steps."""
    named = {curve.metric for curve in curves} | {curve.over for curve in curves}
    known = named.union(ENDS)
    return [name for name in metrics if name not in known and not name.startswith(METRIC_PREFIXES)]


def check_tags(task: Task, metrics: Iterable[str]) -> None:
    """Refuses a curve in whose place the log would have another one, or the reverse; `metrics` are
    the names of those of the task's step."""
    taken = {*_TAKEN_TAGS}
    taken.update(f"task/{name}" for name in unnamed_metrics(metrics, task.curves))
    for curve in task.curves:
        if curve.tag in taken or curve.tag.startswith(_TAKEN_TAG_PREFIXES):
            raise UserError(
                f"the tag {curve.tag} of a curve of the task {type(task).__name__} is taken; "
                "choose another one"
            )
        taken.add(curve.tag)


def _check_commands_are_seen(config: WorldConfig) -> None:
    """Refuses a command that varies and that the policy does not see."""
    if config.observation.counts("task"):
        # The task computes its own quantities from all measurements and commands.
        return
    seen = config.observation.counts()
    for name, command in config.commands.items():
        varies = command.low < command.high
        if varies and name not in seen and not command.hidden:
            raise UserError(
                f"the policy does not see the command {name}, which varies from "
                f"{command.low:g} to {command.high:g}; give the observation a quantity {name}, "
                "fix the command, or mark it as hidden if it acts through others"
            )


def _check_num_balls(config: WorldConfig, task: Task) -> None:
    """Refuses a number of balls that the task does not take."""
    if config.num_balls in task.num_balls:
        return
    takes = " or ".join(map(str, task.num_balls))
    raise UserError(
        f"num_balls is {config.num_balls}, but the task {type(task).__name__} takes {takes}; set "
        f"num_balls to {takes}"
    )


def check_joint_angles(config: WorldConfig, mj_model: mujoco.MjModel, addresses: Addresses) -> None:
    """Refuses joint angles of a reset that do not fit the arm."""
    angles = config.default_joint_angles
    joints = joint_names(mj_model, addresses)
    if len(angles) != len(joints):
        model = f"the MJCF file {config.mjcf}" if config.mjcf else "the model"
        raise UserError(
            f"default_joint_angles has {len(angles)} numbers, but {model} has {len(joints)} "
            f"joints with an actuator ({', '.join(joints)}); give one number for each"
        )
    ranges = joint_ranges(mj_model, addresses)
    lows, highs = np.nan_to_num(ranges, posinf=_MAX_ANGLE, neginf=-_MAX_ANGLE)
    for joint, angle, low, high in zip(joints, angles, lows, highs, strict=True):
        if not low - _ROUNDING <= angle <= high + _ROUNDING:
            raise UserError(
                f"default_joint_angles has {angle:g} for {joint}, whose range is {low:.4g} to "
                f"{high:.4g}; give radians, or metres for a slide, within the range"
            )


def check_start(config: WorldConfig, task: Task) -> None:
    """Refuses heights that are not over the paddle of a reset, and a ball that starts within or
    beside it; a task that throws the ball has its own start. It needs `task.geometry`."""
    geometry = task.geometry
    paddle_x, paddle_y, paddle_height = geometry.paddle_home
    for name, height in config.heights.items():
        if height <= paddle_height:
            raise UserError(
                f"{name} has the height {height:g} m, which is not over the paddle at "
                f"{paddle_height:.4g} m, where default_joint_angles hold it; change one of the two"
            )
    throws = type(task).throw is not Task.throw
    if throws:
        return
    ball_x, ball_y, ball_height = config.ball_init_pos
    beside = np.hypot(ball_x - paddle_x, ball_y - paddle_y)
    if beside > _FARTHEST_BESIDE:
        raise UserError(
            f"ball_init_pos is {beside:.3g} m beside the paddle at ({paddle_x:.3g}, "
            f"{paddle_y:.3g}) m, where default_joint_angles hold it; start it over the paddle"
        )
    rest_height = paddle_height + geometry.rest_height
    if ball_height < rest_height - _ROUNDING:
        raise UserError(
            f"ball_init_pos has the height {ball_height:g} m, but a ball of the radius "
            f"{geometry.ball_radius:g} m rests on the paddle at {rest_height:.4g} m; raise it"
        )
