"""The fused engine: MuJoCo's equations for one kind of model, as straight-line scalar arithmetic.

The supported kind: a serial chain of hinges with position servos, one to three free balls, contact
pairs of each ball (a sphere) with the paddle (a box) and of the balls with each other, with or
without sliding friction, and the implicitfast integrator. `read_model` reads the constants of a
compiled `mujoco.MjModel` and refuses any other kind.
"""

from bounce_mjx.physics.fused.dynamics import paddle_position, step
from bounce_mjx.physics.fused.model import FusedModel, read_model
from bounce_mjx.physics.fused.support import UnsupportedModelError, unsupported_feature

__all__ = [
    "FusedModel",
    "UnsupportedModelError",
    "paddle_position",
    "read_model",
    "step",
    "unsupported_feature",
]
