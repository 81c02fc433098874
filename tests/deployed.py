"""Shipped policies whose files say something else, and balls that fly."""

import math
from typing import Any

import numpy as np
import onnx

from bounce_mjx.deploy.metadata import to_entries
from bounce_mjx.deploy.policy import DeployedPolicy
from bounce_mjx.resources import policy_folder


def changed_policy(name: str, **changes: Any) -> DeployedPolicy:
    """A policy of the package, of which some fields of the metadata are others."""
    content = (policy_folder(name) / f"{name}.onnx").read_bytes()
    metadata = DeployedPolicy(content, name).metadata._replace(**changes)
    model = onnx.load_from_string(content)
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, to_entries(metadata))
    return DeployedPolicy(model.SerializeToString(), name)


def bouncing(time: float, apex: float = 0.4) -> tuple[float, float]:
    """Height (m) above its lowest place and upward speed (m/s) of a ball that is let go at an apex
    and bounces without loss."""
    fall = math.sqrt(2.0 * apex / 9.81)
    since_apex = (time + fall) % (2.0 * fall) - fall
    return apex - 0.5 * 9.81 * since_apex**2, -9.81 * since_apex


def ball_over(paddle: np.ndarray, now: float, apex: float = 0.4, **others: Any) -> dict[str, Any]:
    """Measurements of a ball that bounces on a paddle at rest."""
    height, speed = bouncing(now, apex)
    ball = {"ball_position": paddle + [0.0, 0.0, 0.03 + height]}
    return ball | {"ball_velocity": np.array([0.0, 0.0, speed])} | others
