"""What an environment refuses before its first episode: what a task declares and cannot have, and
starts that the arm and the balls cannot have, with the geometry of the model."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.env.contract import CheckedTask
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.robot.model import Addresses, joint_names, joint_ranges
from bounce_mjx.task.task import Curve, Task
from bounce_mjx.world.config import Goal, WorldConfig
from bounce_mjx.world.limits import check_within
from bounce_mjx.world.randomization import TERMS

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
            "such as Bounce.Config or your task's Config"
        )


def check_task(config: WorldConfig, task: Task) -> None:
    """Refuses what the task declares and cannot have, whatever the model."""
    name = type(task).__name__
    curves = task.curves
    is_sequence = isinstance(curves, Sequence)
    if not is_sequence or not all(isinstance(curve, Curve) for curve in curves):
        raise UserError(
            f"curves of the task {name} is {shorten(repr(curves))}; give a tuple of task.Curve, "
            "such as (task.Curve(...),)"
        )
    goals = config.goals
    if not isinstance(goals, Mapping):
        raise UserError(
            f"the goals of the task {name} are {shorten(repr(goals))}; return a dictionary "
            "of a task.Goal for each name"
        )
    for goal_name, goal in goals.items():
        if not isinstance(goal, Goal):
            raise UserError(
                f"the goal {goal_name} of the task {name} is {shorten(repr(goal))}; give "
                "a task.Goal(low, high)"
            )
    if not isinstance(task.num_balls, Collection):
        raise UserError(
            f"num_balls of the task {name} is {task.num_balls!r}; give a tuple of the numbers "
            f"that it takes, such as ({task.num_balls!r},)"
        )
    if config.num_balls not in task.num_balls:
        takes = " or ".join(map(str, task.num_balls))
        raise UserError(
            f"num_balls is {config.num_balls}, but the task {name} takes {takes}; set num_balls "
            f"to {takes}"
        )
    _check_names_of_goals(config)
    _check_goals_are_seen(config)
    _check_goals_are_there(config)


def _check_names_of_goals(config: WorldConfig) -> None:
    """Refuses a goal named like a term of the randomisation or a measurement, which would be
    taken for it."""
    quantities = config.observation.quantities()
    for name in config.goals:
        is_measurement = name in quantities and quantities[name].group != "goal"
        if name in TERMS or is_measurement:
            kind = "a term of the randomisation" if name in TERMS else "a measurement"
            remedy = "choose another name"
            if name in quantities and quantities[name].group == "task":
                kind = "a quantity of the task"
                remedy += ", or give the quantity the group goal if it shows the goal"
            raise UserError(f"the goal {name} has the name of {kind}; {remedy}")


def _check_goals_are_there(config: WorldConfig) -> None:
    """Refuses a quantity of the observation that shows a goal that there is not."""
    for name in config.observation.counts("goal"):
        if name not in config.goals:
            there_are = ", ".join(config.goals) or "none"
            raise UserError(
                f"the observation shows the goal {name}, which there is not; there are: {there_are}"
            )


def _check_goals_are_seen(config: WorldConfig) -> None:
    """Refuses a goal that varies and that the policy does not see."""
    if config.observation.counts("task"):
        # The task computes its own quantities from all measurements and goals.
        return
    seen = config.observation.counts()
    for name, goal in config.goals.items():
        varies = goal.low < goal.high
        if varies and name not in seen and not goal.hidden:
            raise UserError(
                f"the policy does not see the goal {name}, which varies from "
                f"{goal.low:g} to {goal.high:g}; give the observation a quantity {name}, "
                "fix the goal, or mark it as hidden if it acts through others"
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
    """Refuses what the task cannot have with its geometry, heights that are not over the paddle of
    a reset, and a ball that starts within or beside it; a task that throws the ball has its own
    start. It needs `task.geometry`."""
    task.check()
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
    check_within(config.limits, [config.ball_init_pos], config.targets, "ball_init_pos")
    rest_height = paddle_height + geometry.rest_height
    if ball_height < rest_height - _ROUNDING:
        raise UserError(
            f"ball_init_pos has the height {ball_height:g} m, but a ball of the radius "
            f"{geometry.ball_radius:g} m rests on the paddle at {rest_height:.4g} m; raise it"
        )


def check_starts(
    config: WorldConfig, mj_model: mujoco.MjModel, addresses: Addresses, task: Task
) -> None:
    """Refuses displacements of the start (`joint_start`, `ball_start`, the noise of the ball) with
    which the arm starts outside of its joints' ranges, or a ball within, under or far beside the
    paddle, under the floor, or where the episode ends. It needs `task.geometry`."""
    if config.randomization.joint_start is not None:
        _check_joint_start(config, mj_model, addresses)
    if config.randomization.ball_start is not None:
        low, high = _entrywise(config.randomization.ball_start, 3)
        term = f"randomization.ball_start {config.randomization.ball_start}"
    elif not _throws(task):
        low, high = np.zeros((2, 3))
        term = f"env.reset.ball_position {config.reset.ball_position:g}"
    else:
        return
    noise = config.reset.ball_position
    for start in _ball_starts(config, task):
        _check_ball_box(config, task, start + low - noise, start + high + noise, term)


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


def _check_ball_box(
    config: WorldConfig, task: Task, lowest: np.ndarray, highest: np.ndarray, term: str
) -> None:
    """Refuses a box of starts of the ball, between two corners [3], that is in part within or under
    the paddle, under the floor, where the episode ends or, if the ball is not thrown, far beside
    the paddle.

    Args:
      term: what displaces the ball, for the error.
    """
    geometry = task.geometry
    corners = np.array([lowest, highest])
    farthest = np.hypot(*np.max(np.abs(corners - geometry.paddle_home), axis=0)[:2])
    if farthest > _FARTHEST_BESIDE and not _throws(task):
        raise UserError(
            f"{term} starts a ball up to {farthest:.3g} m beside the paddle, where none is "
            "reached; give less"
        )
    check_within(config.limits, corners, config.targets, f"ball_init_pos with {term}")
    nearest = np.clip(geometry.paddle_home, lowest, highest) - geometry.paddle_home
    rests_on = "floor"
    rest_height = geometry.ball_radius
    if np.hypot(*nearest[:2]) <= _FARTHEST_BESIDE:
        rests_on = "paddle"
        rest_height = geometry.paddle_home[2] + geometry.rest_height
    if lowest[2] < rest_height - _ROUNDING:
        raise UserError(
            f"{term} starts a ball at the height {lowest[2]:.4g} m, but it rests on the "
            f"{rests_on} at {rest_height:.4g} m; give a higher start"
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
    goals = {}
    for name, goal in config.goals.items():
        goals[name] = goal.low + (goal.high - goal.low) * places

    def positions(draws: jax.Array, goal: Mapping[str, jax.Array]) -> Any:
        thrown = CheckedTask(task, config).throw(draws, goal)
        return jnp.asarray(at_rest[0] if thrown is None else thrown[0])

    # Also within the trace of a reset, whose ranges are known.
    with jax.ensure_compile_time_eval():
        return np.asarray(jax.vmap(positions)(draws, goals)).reshape(-1, 3)


def _entrywise(ends: Any, count: int) -> np.ndarray:
    """Both ends of a range for each of `count` entries [2, count]."""
    return np.stack([np.broadcast_to(np.asarray(end, float), (count,)) for end in ends])
