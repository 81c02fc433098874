"""What an environment refuses before its first step: settings that its task or its model cannot
have, and what a task's code returns that an environment cannot use. Each check raises a `UserError`
of one sentence. None is part of a compiled program: they read names, shapes and types alone."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.errors import UserError, shorten
from bounce_mjx.physics import PhysicsParameters
from bounce_mjx.robot.model import Addresses, joint_names, joint_ranges
from bounce_mjx.task.rewards import check_names
from bounce_mjx.task.task import Curve, Tally, Task, TaskStep
from bounce_mjx.world.config import Command, WorldConfig
from bounce_mjx.world.randomization import TERMS
from bounce_mjx.world.sampling import check_overlap

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
# Throws by which the starts of a task's balls are known.
_SAMPLED_THROWS = 32


def check_has_task(config: WorldConfig) -> None:
    """Refuses settings of the world alone."""
    if config.task is None:
        raise UserError(
            f"{type(config).__name__} has the settings of a world without a task; give a task's, "
            "such as BounceConfig or your task's Config"
        )


def check_task(config: WorldConfig, task: Task) -> None:
    """Refuses what the task cannot have, whatever the model."""
    _check_curves(task)
    _check_commands(config, task)
    _check_names_of_commands(config)
    _check_commands_are_seen(config)
    _check_quantities_of_commands(config)
    _check_num_balls(config, task)


def _check_curves(task: Task) -> None:
    """Refuses curves that are not a tuple of them, such as a single one without its comma."""
    curves = task.curves
    is_sequence = isinstance(curves, Sequence) and not isinstance(curves, Curve)
    if not is_sequence or not all(isinstance(curve, Curve) for curve in curves):
        raise UserError(
            f"curves of the task {type(task).__name__} is {shorten(repr(curves))}; give a tuple of "
            "task.Curve, such as (task.Curve(...),)"
        )


def _check_commands(config: WorldConfig, task: Task) -> None:
    """Refuses commands of another type, and ranges from which nothing can be sampled."""
    of_task = f"of the task {type(task).__name__}"
    commands = config.commands
    if not isinstance(commands, Mapping):
        raise UserError(
            f"the commands {of_task} are {shorten(repr(commands))}; return a dictionary of a "
            "task.Command for each name"
        )
    for name, command in commands.items():
        if not isinstance(command, Command):
            raise UserError(
                f"the command {name} {of_task} is {shorten(repr(command))}; give a "
                "task.Command(low, high)"
            )
        low, high = command.low, command.high
        if not (math.isfinite(low) and math.isfinite(high) and low <= high):
            raise UserError(
                f"the command {name} {of_task} is sampled from {low:g} to {high:g}; give two "
                "finite numbers, the lower one first"
            )


def _check_names_of_commands(config: WorldConfig) -> None:
    """Refuses a command named like a term of the randomisation or a measurement, which would be
    taken for it."""
    quantities = config.observation.quantities()
    for name in config.commands:
        is_measurement = name in quantities and quantities[name].group != "command"
        if name in TERMS or is_measurement:
            kind = "a term of the randomisation" if name in TERMS else "a measurement"
            remedy = "choose another name"
            if name in quantities and quantities[name].group == "task":
                kind = "a quantity of the task"
                remedy += ", or give the quantity the group command if it shows the command"
            raise UserError(f"the command {name} has the name of {kind}; {remedy}")


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


def _check_quantities_of_commands(config: WorldConfig) -> None:
    """Refuses a quantity of the observation that shows a command that there is not, or shows one,
    which is one number, as something else."""
    quantities = config.observation.quantities()
    for name in config.observation.counts("command"):
        if name not in config.commands:
            there_are = ", ".join(config.commands) or "none"
            raise UserError(
                f"the observation shows the command {name}, which there is not; there are: "
                f"{there_are}"
            )
        quantity = quantities[name]
        if quantity.size != 1 or quantity.per_ball:
            raise UserError(
                f"the observation shows the command {name} as {quantity}, but a command is one "
                f'number; give it task.Quantity(1, {quantity.unit!r}, "command")'
            )


def _check_num_balls(config: WorldConfig, task: Task) -> None:
    """Refuses a number of balls that the task does not take."""
    if not isinstance(task.num_balls, Collection):
        raise UserError(
            f"num_balls of the task {type(task).__name__} is {task.num_balls!r}; give a tuple of "
            f"the numbers that it takes, such as ({task.num_balls!r},)"
        )
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
    if _throws(task):
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


def check_starts(
    config: WorldConfig, mj_model: mujoco.MjModel, addresses: Addresses, task: Task
) -> None:
    """Refuses displacements of the start (`joint_start`, `ball_start`) with which the arm starts
    outside of its joints' ranges, or a ball within, under or far beside the paddle, or under the
    floor. It needs `task.geometry`."""
    if config.randomization.joint_start is not None:
        _check_joint_start(config, mj_model, addresses)
    if config.randomization.ball_start is not None:
        _check_ball_start(config, task)


def _check_joint_start(config: WorldConfig, mj_model: mujoco.MjModel, addresses: Addresses) -> None:
    """Refuses a displacement of the joints beyond a joint's range, with the noise of the reset."""
    joints = joint_names(mj_model, addresses)
    low, high = _entrywise(config.randomization.joint_start, len(joints))
    noise = config.reset.joint_angles
    angles = np.array(config.default_joint_angles)
    lows, highs = joint_ranges(mj_model, addresses)
    lowest = angles + low - noise
    highest = angles + high + noise
    for i, joint in enumerate(joints):
        if not lows[i] - _ROUNDING <= lowest[i] <= highest[i] <= highs[i] + _ROUNDING:
            raise UserError(
                f"randomization.joint_start ({low[i]:g}, {high[i]:g}) starts {joint} from "
                f"{lowest[i]:.4g} to {highest[i]:.4g} with the noise of env.reset, but its range "
                f"is {lows[i]:.4g} to {highs[i]:.4g}; give a narrower one"
            )


def _check_ball_start(config: WorldConfig, task: Task) -> None:
    """Refuses a displacement of the ball with which it starts within or under the paddle, under the
    floor, or, if it is not thrown, far beside the paddle."""
    geometry = task.geometry
    paddle_x, paddle_y, paddle_height = geometry.paddle_home
    low, high = _entrywise(config.randomization.ball_start, 3)
    noise = config.reset.ball_position
    term = f"randomization.ball_start {config.randomization.ball_start}"
    for start in _ball_starts(config, task):
        lowest = start + low - noise
        highest = start + high + noise
        corners = np.array([lowest, highest]) - geometry.paddle_home
        farthest = np.hypot(*np.max(np.abs(corners), axis=0)[:2])
        nearest_x = np.clip(paddle_x, lowest[0], highest[0]) - paddle_x
        nearest_y = np.clip(paddle_y, lowest[1], highest[1]) - paddle_y
        if farthest > _FARTHEST_BESIDE and not _throws(task):
            raise UserError(
                f"{term} starts a ball up to {farthest:.3g} m beside the paddle, where none is "
                "reached; give a narrower one"
            )
        rests_on = "floor"
        rest_height = geometry.ball_radius
        if np.hypot(nearest_x, nearest_y) <= _FARTHEST_BESIDE:
            rests_on = "paddle"
            rest_height = paddle_height + geometry.rest_height
        if lowest[2] < rest_height - _ROUNDING:
            raise UserError(
                f"{term} starts a ball at the height {lowest[2]:.4g} m, but it rests on the "
                f"{rests_on} at {rest_height:.4g} m; give a higher one"
            )


def _throws(task: Task) -> bool:
    """Whether the task has its own start of the balls."""
    return type(task).throw is not Task.throw


def _ball_starts(config: WorldConfig, task: Task) -> np.ndarray:
    """Starts of the balls without noise [N, 3]; of a task that throws them, some of them."""
    at_rest = np.array([config.ball_init_pos])
    if not _throws(task):
        return at_rest
    draws = np.random.default_rng(0).uniform(size=(_SAMPLED_THROWS, task.num_draws))
    places = np.linspace(0.0, 1.0, _SAMPLED_THROWS)
    commands = {}
    for name, command in config.commands.items():
        commands[name] = command.low + (command.high - command.low) * places

    def positions(draws: jax.Array, command: Mapping[str, jax.Array]) -> Any:
        thrown = task.throw(draws, command)
        check_throw(thrown, config.num_balls, task)
        return jnp.asarray(at_rest[0] if thrown is None else thrown[0])

    # Also within the trace of a reset, whose ranges are known.
    with jax.ensure_compile_time_eval():
        return np.asarray(jax.vmap(positions)(draws, commands)).reshape(-1, 3)


def _entrywise(ends: Any, count: int) -> np.ndarray:
    """Both ends of a range for each of `count` entries [2, count]."""
    return np.stack([np.broadcast_to(np.asarray(end, float), (count,)) for end in ends])


def check_randomize(
    randomize: Callable[[jax.Array], PhysicsParameters],
    config: WorldConfig,
    mj_model: mujoco.MjModel,
    addresses: Addresses,
) -> None:
    """Refuses a `randomize` that returns something else than parameters, or parameters that a term
    of the config samples too."""
    returned = jax.eval_shape(randomize, jax.random.PRNGKey(0))
    if not isinstance(returned, PhysicsParameters):
        raise UserError(
            f"randomize returns {_described(returned)}; return a physics.PhysicsParameters"
        )
    check_overlap(mj_model, addresses, config.randomization.terms, returned)


def check_throw(thrown: Any, num_balls: int, task: Task) -> None:
    """Refuses a throw that is not a position and a velocity of each ball."""
    if thrown is None:
        return
    parts = []
    if isinstance(thrown, tuple | list) or _has_shape(thrown):
        # The shapes alone, also of a list of coordinates.
        parts = jax.eval_shape(lambda: [jnp.asarray(part) for part in thrown])
    allowed = [(num_balls, 3)] if num_balls > 1 else [(3,), (1, 3)]
    shapes = [part.shape for part in parts]
    if len(shapes) != 2 or not all(shape in allowed for shape in shapes):
        returned = _described(thrown)
        if isinstance(thrown, tuple | list):
            returned += f" of the shapes {', '.join(map(str, shapes)) or 'none'}"
        raise UserError(
            f"throw of the task {type(task).__name__} returns {returned}; return the position and "
            f"the velocity of the ball, two arrays of the shape {allowed[0]}"
        )


def check_commands(code: str, commands: Any, expected: Mapping[str, Any]) -> None:
    """Refuses what a method of the task returns for commands, unless it has the expected names, and
    one number of floating point for each.

    Args:
      code: the method, for the error.
    """
    if not isinstance(commands, Mapping):
        raise UserError(
            f"{code} returns {_described(commands)}; return a dictionary of one number for each "
            "command"
        )
    check_names(code, "command", commands, expected)
    for name, command in commands.items():
        is_number = _has_shape(command) and command.shape == ()
        if not (is_number and jnp.issubdtype(command.dtype, jnp.floating)):
            raise UserError(
                f"{code} returns {_described(command)} for the command {name}; return one number, "
                "a JAX array of the shape () and of a floating-point type"
            )


def check_task_step(result: Any, state: Any, task: Task) -> None:
    """Refuses what the step of a task returns, where a training could not use it.

    Args:
      result: what it returns, as the shapes and types of its arrays (`jax.eval_shape`).
      state: the task's state before it, likewise.
    """
    name = type(task).__name__
    if not isinstance(result, TaskStep):
        raise UserError(
            f"step of the task {name} returns {_described(result)}; return a task.TaskStep"
        )
    _check_numbers("reward term", result.reward, f"reward of the step of the task {name}")
    _check_numbers("metric", result.metrics, f"metrics of the step of the task {name}")
    ended = result.ended
    if not (_has_shape(ended) and ended.shape == () and ended.dtype == bool):
        raise UserError(
            f"ended of the step of the task {name} is {_described(ended)}; return one bool, such "
            "as height < 0"
        )
    _check_state(result.state, state, task)
    check_metrics(result.metrics, task)


def _check_state(after: Any, before: Any, task: Task) -> None:
    """Refuses a state after a step that is of another kind than that of the reset, both as shapes
    and types: no loop of JAX could carry it."""
    name = type(task).__name__
    if jax.tree.structure(after) != jax.tree.structure(before):
        raise UserError(
            f"the state of the task {name} is {_described(before)} at a reset and "
            f"{_described(after)} after a step; return the same structure from both"
        )
    places, _ = jax.tree_util.tree_flatten_with_path(before)
    for (path, old), new in zip(places, jax.tree.leaves(after), strict=True):
        if (new.shape, new.dtype) != (old.shape, old.dtype):
            raise UserError(
                f"the state{jax.tree_util.keystr(path)} of the task {name} is {_described(old)} at "
                f"a reset and {_described(new)} after a step; return the same shape and type from "
                "both"
            )


def check_tally(tally: Any, task: Task) -> None:
    """Refuses a tally that is not numbers by name."""
    name = type(task).__name__
    if not isinstance(tally, Tally):
        raise UserError(
            f"tally of the task {name} returns {_described(tally)}; return a task.Tally, such as "
            "task.Tally(sums)"
        )
    _check_numbers("sum", tally.sums, f"sums of the tally of the task {name}")
    _check_numbers("maximum", tally.maxima, f"maxima of the tally of the task {name}")


def _check_numbers(kind: str, numbers: Any, code: str) -> None:
    """Refuses anything but one number for each name.

    Args:
      kind: what a number is, for the error.
      code: what the numbers are of, for the error.
    """
    if not isinstance(numbers, Mapping):
        raise UserError(
            f"the {code} is {_described(numbers)}; return a dictionary of one number for each name"
        )
    for name, number in numbers.items():
        is_number = number.shape == () if _has_shape(number) else isinstance(number, int | float)
        if not is_number:
            raise UserError(
                f"the {kind} {name} in the {code} is {_described(number)}; return one number, an "
                "array of the shape ()"
            )


def _has_shape(value: Any) -> bool:
    """Whether a value is an array, or stands for one."""
    return hasattr(value, "shape") and hasattr(value, "dtype")


def _described(value: Any) -> str:
    """What a task's code returned, for an error."""
    if _has_shape(value):
        return f"{value.dtype} of the shape {value.shape}"
    return "None" if value is None else shorten(f"a {type(value).__name__}")
