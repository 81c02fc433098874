"""The page of a log: the measured robot beside the simulated one."""

import mujoco
import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.identify.replay import Replay
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.viewers.page import replay
from bounce_mjx.viewers.simulation import EnvFrame
from bounce_mjx.world.config import WorldConfig

NAMES = ("measured", "simulated")
# Below the floor, m: a ball that is not shown, and the markers of commands that a log lacks.
_HIDDEN = -10.0


def comparison_page(config: WorldConfig, found: Replay, fps: int, command: dict[str, float]) -> str:
    """A page (HTML) with both robots.

    Args:
      command: known values of the task's commands.
    """
    env = Env(config)
    return replay(env, recording(env, found, command), fps, NAMES)


def recording(env: Env, found: Replay, command: dict[str, float]) -> EnvFrame:
    """The frames [T, 2, ...] of both robots. Each time at which a ball appears or vanishes counts
    as a reset, over which no viewer draws a line."""
    model = env.mj_model
    addresses, shape = find_addresses(model), found.angles.shape[:2]
    hidden = np.isnan(found.balls[..., 0])
    over = np.append(hidden[1:] != hidden[:-1], np.zeros((1, 2), bool), axis=0)
    balls = np.where(hidden[..., None], (0.0, 0.0, _HIDDEN), found.balls)
    qpos = np.tile(model.qpos0, (*shape, 1))
    qpos[..., list(addresses.arm_qpos)] = found.angles
    qpos[..., list(addresses.balls[0].qpos[:3])] = balls
    steps = np.arange(shape[0])[:, None]
    begins = np.maximum.accumulate(np.where(np.roll(over, 1, axis=0), steps, 0))
    known = dict.fromkeys(env.config.commands, _HIDDEN) | command
    return EnvFrame(
        time=(steps - begins) * env.dt,
        qpos=qpos,
        balls=balls[:, :, None],
        paddle=_paddles(model, qpos),
        command={name: np.full(shape, value) for name, value in known.items()},
        metrics={},
        over=over,
        lost=np.zeros(shape, bool),
    )


def _paddles(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """The paddle's centre [..., 3] at positions [..., nq]."""
    data, geom = mujoco.MjData(model), find_addresses(model).paddle_geom
    places = np.zeros((*qpos.shape[:-1], 3))
    for index in np.ndindex(qpos.shape[:-1]):
        data.qpos[:] = qpos[index]
        mujoco.mj_kinematics(model, data)
        places[index] = data.geom_xpos[geom]
    return places
