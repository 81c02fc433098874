"""Pictures without a screen, by whichever of MuJoCo's OpenGL back ends works on the machine."""

import functools
import importlib
import os
import subprocess
import sys

import mujoco
from mujoco.rendering.classic import gl_context

from bounce_mjx.errors import UserError

_BACKENDS = ("egl", "osmesa", "glfw")
_PROBE_SECONDS = 60.0


def make_renderer(mj_model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """A renderer of pictures [height, width, 3], uint8. `MUJOCO_GL` chooses the back end; without
    it, the first that works is taken.

    Raises:
      UserError: none works.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if not chosen:
        backend = find_backend()
        if backend is None:
            raise UserError(
                f"MuJoCo can draw no pictures on this machine, as none of {', '.join(_BACKENDS)} "
                "works; install a driver with EGL, or OSMesa (Debian: apt-get install libosmesa6)"
            )
        # MuJoCo chooses a back end when it is imported, which it already is.
        gl_context.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext
    try:
        return mujoco.Renderer(mj_model, height, width)
    # A back end raises many types.
    except Exception as error:
        raise UserError(
            f"MuJoCo cannot draw with MUJOCO_GL={chosen or backend} ({type(error).__name__}: "
            f"{error!s}); choose another of {', '.join(_BACKENDS)}, or leave MUJOCO_GL unset"
        ) from error


@functools.cache
def find_backend() -> str | None:
    """The first back end that can draw here; None if none can.

    Each is tried in a process of its own, as one that fails leaves OpenGL set up for itself.
    """
    script = "import mujoco; mujoco.GLContext(8, 8).make_current()"
    for backend in _BACKENDS:
        environment = os.environ | {"MUJOCO_GL": backend}
        try:
            tried = subprocess.run(
                [sys.executable, "-c", script],
                env=environment,
                capture_output=True,
                timeout=_PROBE_SECONDS,
            )
        except subprocess.TimeoutExpired:
            continue
        if tried.returncode == 0:
            return backend
    return None
