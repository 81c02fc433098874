"""Names of the scene's parts, and of a model's joints in sentences."""

from collections.abc import Iterable

import mujoco

from bounce_mjx.errors import shorten

BALL_BODY_NAME = "ball_link"
PADDLE_GEOM_NAME = "blocker"
"""The paddle, which blocks the ball's way: the name that whole scenes of users have."""
PADDLE_BODY_NAME = "paddle"
"""The body of an adopted arm's paddle."""
BALL_NUMBERS = ("", "2", "3")
"""Ends of the names of a scene's balls and of their parts, one for each ball that it may have."""


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Name of a joint; an unnamed joint has its index for a name."""
    return model.joint(joint).name or f"joint{joint}"


def listed(names: Iterable[str], most: int = 8) -> str:
    """Names with commas, for a sentence; a list of more than `most` is cut."""
    names = [name for name in names if name]
    if not names:
        return "none"
    text = ", ".join(shorten(name, 40) for name in names[:most])
    if len(names) > most:
        text += f" and {len(names) - most} more"
    return text
