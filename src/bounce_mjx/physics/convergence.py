"""Check of a model's solver settings: does MuJoCo's C solver converge with them?"""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from bounce_mjx.robot.model import find_addresses

_SETTINGS = ("solver", "iterations", "tolerance", "ls_iterations", "ls_tolerance")
_NUM_BOUNCES, _NUM_STEPS = 8, 30
# Resolution of the arm's and the ball's speeds in float32 (m/s, rad/s).
_MAX_ERROR = 1e-5


def solver_warning(mj_model: mujoco.MjModel) -> str | None:
    """Warning that names the settings with which MuJoCo's C solver stops before it converges; None
    if it converges.

    The check simulates several bounces with `mj_step` and compares them to the same bounces with
    MuJoCo's default settings, which converge for a single contact.
    """
    default = mujoco.MjOption()
    converged = _with_settings(mj_model, default, _SETTINGS)
    error = _largest_error(mj_model, converged)
    if error < _MAX_ERROR:
        return None
    changed = [s for s in _SETTINGS if getattr(mj_model.opt, s) != getattr(default, s)]
    at_fault = [
        setting
        for setting in changed
        if _largest_error(_with_settings(mj_model, default, [setting]), converged) < _MAX_ERROR
    ]
    named = " and ".join(_as_in_mjcf(mj_model.opt, setting) for setting in at_fault or changed)
    return (
        f"MuJoCo's C solver stops before it converges with {named} (errors up to {error:.2g} m/s "
        "in a step of a bounce), and the fused physics is the converged solution: results on the "
        "C engine will differ; MuJoCo's default converges"
    )


def _with_settings(
    mj_model: mujoco.MjModel, default: mujoco.MjOption, settings: Sequence[str]
) -> mujoco.MjModel:
    """Copy of the model with the named solver settings of `default`."""
    changed = copy.copy(mj_model)
    for setting in settings:
        setattr(changed.opt, setting, getattr(default, setting))
    return changed


def _largest_error(mj_model: mujoco.MjModel, converged: mujoco.MjModel) -> float:
    """Largest velocity error (m/s, rad/s) of a single step, over several bounces with a moving
    arm."""
    addresses = find_addresses(mj_model)
    rng = np.random.default_rng(0)
    half_size = mj_model.geom_size[addresses.paddle_geom]
    axis = np.argmin(half_size)
    gear = mj_model.actuator_gear[list(addresses.actuators), 0]
    errors = []
    for _ in range(_NUM_BOUNCES):
        truth, data = mujoco.MjData(converged), mujoco.MjData(mj_model)
        truth.qpos[addresses.arm_qpos,] += rng.uniform(-0.5, 0.5, len(addresses.arm_qpos))
        truth.qvel[addresses.arm_qvel,] = rng.uniform(-1.0, 1.0, len(addresses.arm_qvel))
        truth.ctrl[addresses.actuators,] = gear * truth.qpos[addresses.arm_qpos,]
        mujoco.mj_kinematics(converged, truth)
        normal = truth.geom_xmat[addresses.paddle_geom].reshape(3, 3)[:, axis]
        distance = half_size[axis] + 1.05 * mj_model.geom_size[addresses.ball_geom, 0]
        truth.qpos[addresses.ball_qpos[:3],] = (
            truth.geom_xpos[addresses.paddle_geom] + distance * normal
        )
        truth.qvel[addresses.ball_qvel[:3],] = -rng.uniform(0.5, 4.0) * normal
        data.ctrl[:] = truth.ctrl
        for _ in range(_NUM_STEPS):
            # Each solver keeps its own warm start.
            data.qpos[:], data.qvel[:], data.act[:] = truth.qpos, truth.qvel, truth.act
            mujoco.mj_step(mj_model, data)
            mujoco.mj_step(converged, truth)
            errors.append(np.max(np.abs(data.qvel - truth.qvel)))
    return float(np.max(errors))


def _as_in_mjcf(options: mujoco.MjOption, setting: str) -> str:
    value = getattr(options, setting)
    if setting == "solver":
        return f'solver="{mujoco.mjtSolver(value).name.removeprefix("mjSOL_")}"'
    return f'{setting}="{value:g}"'
