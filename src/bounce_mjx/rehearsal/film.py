"""A film of a rehearsal."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.rehearsal.arm import Moved
from bounce_mjx.viewers.offscreen import Renderer
from bounce_mjx.viewers.video import caption

# Time of the ball's path that is drawn, s.
_TRAIL = 0.5


def pictures(
    env: Env,
    path: Sequence[Moved],
    goals: Callable[[float], Mapping[str, float]],
    size: tuple[int, int],
    fps: float,
) -> Iterator[np.ndarray]:
    """The frames of a rehearsal, each [height, width, 3] (uint8).

    Args:
      env: of the arm and its task.
      path: of the arm.
      goals: time (s) -> what the task asked for.
      size: width and height in pixels.
    """
    times = np.array([moved.time for moved in path])
    ball = list(env.addresses.balls[0].qpos[:3])
    with Renderer(env, *size, plain=True) as renderer:
        for time in np.arange(times[0], times[-1], 1.0 / fps):
            newest = int(np.searchsorted(times, time))
            oldest = int(np.searchsorted(times, time - _TRAIL))
            asked = goals(time)
            trail = np.array([[moved.qpos[ball]] for moved in path[oldest : newest + 1]])
            picture = renderer.render(path[newest].qpos, dict(asked), trail=trail)
            readings = {"rehearsal": f"{time:.1f} s"}
            readings |= {name: f"{value:.2f}" for name, value in asked.items()}
            yield caption(picture, readings, float(path[newest].qpos[ball[2]]))
