"""Pictures of the environments, quick enough for 30 frames a second on a CPU."""

import functools
import weakref
from typing import Any

import numpy as np

from bounce_mjx.adapters.gymnasium.batch import Batch
from bounce_mjx.config.validation import checked_count
from bounce_mjx.errors import UserError
from bounce_mjx.viewers.offscreen import Renderer


class Pictures:
    """Draws the environments of a batch. A copy or an unpickled one opens its own renderer."""

    def __init__(
        self, batch: Batch, render_mode: str | None, width: int, height: int, camera: str | None
    ):
        """Makes the renderer, if there is a mode; its first picture opens OpenGL.

        Args:
          render_mode: "rgb_array", or None for no pictures.
          width: in pixels, as is `height`.
          camera: name of a camera of the model; None for the overview.

        Raises:
          UserError: the mode, the size or the camera is wrong.
        """
        if render_mode not in (None, "rgb_array"):
            raise UserError(f'render_mode is {render_mode!r}; choose "rgb_array" or omit it')
        self._batch = batch
        self._is_on = render_mode is not None
        self._width = checked_count("width", width)
        self._height = checked_count("height", height)
        self._camera = camera
        if self._is_on:
            _ = self._renderer  # which a missing camera makes fail

    def draw(self, index: int) -> np.ndarray | None:
        """The picture [height, width, 3], uint8, of one environment; None without a mode.

        Raises:
          UserError: no OpenGL library works.
        """
        return self._renderer.render(*self._batch.pose(index)) if self._is_on else None

    def close(self) -> None:
        """Frees the renderer."""
        if self.__dict__.pop("_renderer", None) is not None:
            self._close_renderer()

    @functools.cached_property
    def _renderer(self) -> Renderer:
        renderer = Renderer(self._batch.core, self._width, self._height, self._camera, plain=True)
        self._close_renderer = weakref.finalize(self, renderer.close)
        # The renderer closes itself.
        self._close_renderer.atexit = False
        return renderer

    def __getstate__(self) -> dict[str, Any]:
        opened = "_renderer", "_close_renderer"
        return {name: value for name, value in self.__dict__.items() if name not in opened}
