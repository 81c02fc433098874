"""A working OpenGL library for `mujoco.Renderer`, which brax and MuJoCo Playground use."""

import functools
import importlib

from mujoco.rendering.classic import gl_context

from bounce_mjx.viewers.offscreen import choose_backend


@functools.cache
def choose_opengl() -> None:
    """Chooses the library for every later `mujoco.Renderer`.

    MuJoCo itself chooses when it is imported, and without MUJOCO_GL takes GLFW, which needs a
    screen.

    Raises:
      UserError: no library works.
    """
    gl_context.GLContext = importlib.import_module(f"mujoco.{choose_backend()}").GLContext
