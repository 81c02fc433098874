"""Pictures of the environments, quick enough for 30 frames a second on a CPU."""

import weakref
from typing import Any

import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.viewers.offscreen import Renderer

WIDTH, HEIGHT = 640, 480
"""Default size of a picture, pixels."""


class Pictures:
    """Draws states of the environment. A copy or an unpickled one opens its own renderer."""

    def __init__(self, task: Env, width: int, height: int, camera: str | None):
        """Opens the renderer.

        Args:
          width: in pixels, as is `height`.
          camera: name of a camera of the model; None for the overview.

        Raises:
          UserError: the size or the camera is wrong, or there is no OpenGL library.
        """
        for name, value in (("width", width), ("height", height)):
            if not isinstance(value, int) or not 1 <= value <= 4096:
                raise UserError(f"{name} is {value!r}, but must be a whole number from 1 to 4096")
        self._settings = (width, height, camera)
        self._renderer: Renderer | None = None
        self._open(task)

    def draw(self, task: Env, qpos: np.ndarray, command: dict[str, float]) -> np.ndarray:
        """The picture [height, width, 3], uint8, of generalised positions [nq] and commands."""
        if self._renderer is None:
            self._open(task)
        return self._renderer.render(qpos, command)

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._close()
            self._renderer = None

    def _open(self, task: Env) -> None:
        self._renderer = Renderer(task, *self._settings, plain=True)
        # Also closed at exit, where OpenGL would be unloaded before the renderer.
        self._close = weakref.finalize(self, self._renderer.close)

    def __getstate__(self) -> dict[str, Any]:
        return {"_settings": self._settings, "_renderer": None}


def check_render_mode(render_mode: str | None) -> None:
    """Checks the render mode.

    Raises:
      UserError: it is neither "rgb_array" nor None.
    """
    if render_mode not in (None, "rgb_array"):
        raise UserError(f'render_mode is {render_mode!r}; choose "rgb_array" or omit it')
