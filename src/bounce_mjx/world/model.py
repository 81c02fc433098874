"""The model of a world, compiled from its settings, and its own values of the randomised terms."""

import functools

import mujoco
import numpy as np

from bounce_mjx.physics import PhysicsParameters, edited_model
from bounce_mjx.robot.model import load_model
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import TERMS
from bounce_mjx.world.sampling import nominal_values


def world_model(config: WorldConfig, visual: bool = True) -> mujoco.MjModel:
    """Compiles the model of a world; `visual` and the errors are those of `load_model`."""
    mj_model = load_model(
        config.mjcf,
        config.physics_dt,
        visual=visual,
        robot=config.robot,
        num_balls=config.num_balls,
    )
    given = {"contact_friction": config.friction, "ball_inertia": config.ball_inertia}
    numbers = {name: np.float64(value) for name, value in given.items() if value is not None}
    return edited_model(mj_model, PhysicsParameters(**numbers)) if numbers else mj_model


@functools.lru_cache(maxsize=8)
def model_nominals(config: WorldConfig) -> dict[str, np.ndarray]:
    """The `nominal_values` of all terms for a config, whose model it compiles."""
    return nominal_values(world_model(config, visual=False), TERMS)
