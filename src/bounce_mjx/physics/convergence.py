"""Does MuJoCo's C solver converge with a model's own settings? The fused engine computes the
converged solution, whatever the settings say. A training with the fused engine and an evaluation
with the C engine print the warning."""

import copy
from collections.abc import Iterable

import mujoco
import numpy as np

from bounce_mjx.physics.friction import solver_model
from bounce_mjx.robot.model import find_addresses

_SETTINGS = ("solver", "iterations", "tolerance", "ls_iterations", "ls_tolerance")
_NUM_BOUNCES = 8
_NUM_STEPS = 30
# Resolution of the arm's and the ball's speeds in float32, m/s or rad/s.
_LARGEST_ERROR = 1e-5


def solver_warning(mj_model: mujoco.MjModel) -> str | None:
    """A sentence that names the settings with which MuJoCo's C solver stops before it converges;
    None if it converges.

    Several bounces are simulated with `mj_step`, each step also with MuJoCo's default settings,
    which converge for the contact of a ball.
    """
    mj_model = solver_model(mj_model, find_addresses(mj_model))
    default = mujoco.MjOption()
    changed = [name for name in _SETTINGS if getattr(mj_model.opt, name) != getattr(default, name)]
    if not changed:
        return None
    converged = _with_defaults(mj_model, changed)
    error = _largest_error(mj_model, converged)
    if error < _LARGEST_ERROR:
        return None
    at_fault = []
    for name in changed:
        error_without_it = _largest_error(_with_defaults(mj_model, [name]), converged)
        if error_without_it < _LARGEST_ERROR:
            at_fault.append(name)
    words = " and ".join(_as_in_mjcf(mj_model.opt, name) for name in at_fault or changed)
    return (
        f"MuJoCo's C solver stops before it converges with {words} (errors up to {error:.2g} m/s "
        "or rad/s in a step of a bounce), and the fused physics is the converged solution; leave "
        "it out of the MJCF's <option> to get the same on the C engine"
    )


def _with_defaults(mj_model: mujoco.MjModel, settings: Iterable[str]) -> mujoco.MjModel:
    """A copy of the model with MuJoCo's defaults of some settings."""
    default = mujoco.MjOption()
    copied = copy.copy(mj_model)
    for name in settings:
        setattr(copied.opt, name, getattr(default, name))
    return copied


def _largest_error(mj_model: mujoco.MjModel, converged: mujoco.MjModel) -> float:
    """Largest error of a velocity after one step, m/s or rad/s, over several bounces of the first
    ball with a moving arm."""
    addresses = find_addresses(mj_model)
    arm_qpos = list(addresses.arm_qpos)
    arm_qvel = list(addresses.arm_qvel)
    servos = list(addresses.actuators)
    gear = mj_model.actuator_gear[servos, 0]
    ball = addresses.balls[0]
    half_size = mj_model.geom_size[addresses.paddle_geom]
    thin_axis = np.argmin(half_size)
    distance = half_size[thin_axis] + 1.05 * mj_model.geom_size[ball.geom, 0]
    rng = np.random.default_rng(0)
    largest = 0.0
    for _ in range(_NUM_BOUNCES):
        truth = mujoco.MjData(converged)
        data = mujoco.MjData(mj_model)
        truth.qpos[arm_qpos] += rng.uniform(-0.5, 0.5, len(arm_qpos))
        truth.qvel[arm_qvel] = rng.uniform(-1.0, 1.0, len(arm_qvel))
        truth.ctrl[servos] = gear * truth.qpos[arm_qpos]
        mujoco.mj_kinematics(converged, truth)
        normal = truth.geom_xmat[addresses.paddle_geom].reshape(3, 3)[:, thin_axis]
        centre = truth.geom_xpos[addresses.paddle_geom]
        truth.qpos[list(ball.qpos[:3])] = centre + distance * normal
        truth.qvel[list(ball.qvel[:3])] = -rng.uniform(0.5, 4.0) * normal
        data.ctrl[:] = truth.ctrl
        for _ in range(_NUM_STEPS):
            # Each solver keeps its own warm start.
            data.qpos[:] = truth.qpos
            data.qvel[:] = truth.qvel
            mujoco.mj_step(mj_model, data)
            mujoco.mj_step(converged, truth)
            largest = max(largest, float(np.max(np.abs(data.qvel - truth.qvel))))
    return largest


def _as_in_mjcf(option: mujoco.MjOption, setting: str) -> str:
    value = getattr(option, setting)
    if setting == "solver":
        return f'solver="{mujoco.mjtSolver(value).name.removeprefix("mjSOL_")}"'
    return f'{setting}="{value:g}"'
