"""Pictures of the environments, quick enough for 30 frames a second on a CPU."""

import weakref
from typing import Any

import numpy as np

from bounce_mjx.adapters.gymnasium.batch import Batch
from bounce_mjx.errors import UserError
from bounce_mjx.viewers.offscreen import Renderer

WIDTH, HEIGHT = 640, 480
"""Default size of a picture, pixels."""


class Pictures:
    """Draws the environments of a batch. A copy or an unpickled one opens its own renderer."""

    def __init__(
        self, batch: Batch, render_mode: str | None, width: int, height: int, camera: str | None
    ):
        """Opens the renderer.

        Args:
          render_mode: "rgb_array", or None for no pictures.
          width: in pixels, as is `height`.
          camera: name of a camera of the model; None for the overview.

        Raises:
          UserError: the mode, the size or the camera is wrong, or there is no OpenGL library.
        """
        if render_mode not in (None, "rgb_array"):
            raise UserError(f'render_mode is {render_mode!r}; choose "rgb_array" or omit it')
        self._batch = batch
        self._settings: tuple[Any, ...] | None = None
        self._renderer: Renderer | None = None
        if render_mode is None:
            return
        for name, value in (("width", width), ("height", height)):
            if not isinstance(value, int) or not 1 <= value <= 4096:
                raise UserError(f"{name} is {value!r}, but must be a whole number from 1 to 4096")
        self._settings = (width, height, camera)
        self._open()

    def draw(self, index: int) -> np.ndarray | None:
        """The picture [height, width, 3], uint8, of one environment; None without a mode."""
        if self._settings is None:
            return None
        pose = self._batch.pose(index)
        if self._renderer is None:
            self._open()
        return self._renderer.render(*pose)

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._close()
            self._renderer = None

    def _open(self) -> None:
        self._renderer = Renderer(self._batch.task, *self._settings, plain=True)
        # Also closed at exit, where OpenGL would be unloaded before the renderer.
        self._close = weakref.finalize(self, self._renderer.close)

    def __getstate__(self) -> dict[str, Any]:
        return {"_batch": self._batch, "_settings": self._settings, "_renderer": None}
