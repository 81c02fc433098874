"""What viewers and reports draw of a task."""

from __future__ import annotations

from typing import Literal, NamedTuple

from bounce_mjx.lazy import jax, np


class Marker(NamedTuple):
    """A shape in the scene without contact. A site of its name in the MJCF replaces its look."""

    name: str
    position: tuple[float, float, float]
    """Centre, m."""
    size: tuple[float, float, float]
    """Half-sizes of a box or of a frame; radius and half-height of a cylinder, and 0, m."""
    rgba: tuple[float, float, float, float]
    shape: Literal["box", "frame", "cylinder"] = "box"
    """A frame is the outline of a box around its z axis."""


class Recording(NamedTuple):
    """T control steps of K episodes; entries after the end of an episode are undefined."""

    joint_angles: jax.Array
    """Positions of the acting joints after the step [T, n, K], rad."""
    ball: jax.Array
    """Ball positions after the step [T, 3, K], m."""
    paddle: jax.Array
    """Positions of the paddle's centre after the step [T, 3, K], m."""
    command: dict[str, jax.Array]
    """Commands [T, K]."""
    running: jax.Array
    """Whether the episode had not ended before the step [T, K], bool."""
    command_velocity: jax.Array | None = None
    """Velocities of the joints' commands at the end of the step [T, n, K], rad/s; None if the
    commands do not move within limits."""
    qpos: jax.Array | None = None
    """Generalised positions after the step [T, nq, K], in MuJoCo's order."""
    metrics: dict[str, jax.Array] = {}
    """Metrics of the step [T, K]."""


class Curve(NamedTuple):
    """A number that the training logs: how a metric adds up over a rollout."""

    tag: str
    """Name in the log."""
    metric: str
    """Metric of the environment's step."""
    over: str = "steps"
    """steps for the mean over steps, episodes for the mean of the last values of episodes, or the
    metric that counts the events over which it is the mean."""
    title: str = ""
    """Title in the report; "" leaves it out there."""
    scale: float = 1.0
    """Factor from the metric's unit to the title's."""


class Histogram(NamedTuple):
    """A histogram of errors, with lines at a bound on each side of 0."""

    title: str
    """With the unit of the values."""
    counted: str
    """What is counted, such as bounces."""
    values: np.ndarray
    """[N]."""
    bound: float


class Hits(NamedTuple):
    """Positions of the ball over the paddle at some steps, in the paddle's own frame."""

    title: str
    steps: np.ndarray
    """Whether a step of a recording is drawn [T, K], bool."""
