"""A log as the frames of a viewer: the measured robot next to the simulated one."""

import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.identify.replay import Replay
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.viewers.simulation import EnvFrame

# Below the floor, m: a ball that is not shown, and the markers of commands that a log lacks.
_HIDDEN = -10.0


def recording(env: Env, found: Replay, command: dict[str, float]) -> EnvFrame:
    """The frames [T, 2, ...] of the measured and the simulated robot, for a page.

    Each time at which a ball appears or vanishes counts as a reset, over which no line is drawn.

    Args:
      command: known values of the task's commands.
    """
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
        paddle=np.zeros((*shape, 3)),
        command={name: np.full(shape, value) for name, value in known.items()},
        metrics={},
        over=over,
        lost=np.zeros(shape, bool),
    )
