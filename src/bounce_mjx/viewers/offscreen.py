"""Rendering without a screen."""

import atexit
import contextlib
import functools
import importlib
import os
import subprocess
import sys
from collections.abc import Mapping

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.viewers.display import (
    FIELD_OF_VIEW,
    NO_METRICS,
    TRAIL_RGB,
    Display,
    camera_pose,
)

_TRAIL_RADIUS = 0.004
# Runs in a separate process: a library that fails to load would remain partly loaded in this one.
_PROBE = """
import mujoco
from mujoco.{backend} import GLContext
context = GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
"""


def choose_backend() -> str:
    """A working OpenGL library: the one that MUJOCO_GL names; otherwise EGL or OSMesa, and that of
    the system where it is not Linux, which is not tried.

    Raises:
      UserError: no library works on Linux.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    if sys.platform != "linux":
        return wanted or ("cgl" if sys.platform == "darwin" else "glfw")
    for backend in (wanted,) if wanted else ("egl", "osmesa"):
        if works(backend):
            return backend
    tried = f"MUJOCO_GL={wanted} does not work" if wanted else "neither EGL nor OSMesa works"
    raise UserError(
        f"pictures cannot be rendered, because {tried} here; install an OpenGL library, on Debian "
        "or Ubuntu with: apt-get install libegl1 libgl1-mesa-dri, or: apt-get install libosmesa6"
    )


def works(backend: str) -> bool:
    """Whether an OpenGL library can render on this machine, tested in a separate process."""
    probe = [sys.executable, "-c", _PROBE.format(backend=backend)]
    return subprocess.run(probe, capture_output=True).returncode == 0


@functools.cache
def choose_opengl() -> None:
    """Chooses the library for every later `mujoco.Renderer`, by replacing MuJoCo's own choice.

    MuJoCo chooses when it is imported, and without MUJOCO_GL takes GLFW, which needs a screen.

    Raises:
      UserError: no library works.
    """
    gl_context.GLContext = importlib.import_module(f"mujoco.{choose_backend()}").GLContext


class Renderer(contextlib.AbstractContextManager):
    """Renders one environment. A context manager, which frees the GPU's memory.

    The first picture opens OpenGL: a program that draws none needs no library for it, and loads
    none beside its own, such as Mesa's LLVM beside triton's, which end the process together.
    """

    def __init__(
        self,
        env: Env,
        width: int,
        height: int,
        camera: str | None = None,
        plain: bool = False,
        zoom: float = 1.0,
    ):
        """Compiles the displayed model.

        Args:
          camera: name of a camera of the model; None for that of the pages, `camera_pose`.
          plain: leaves out shadows and antialiasing, which take 7/8 of the time on a CPU.
          zoom: see `camera_pose`.

        Raises:
          UserError: the model has no such camera.
        """
        self._display = Display(env)
        model = self._display.model
        cameras = [model.camera(i).name for i in range(model.ncam)]
        if camera is not None and camera not in cameras:
            raise UserError(
                f"the model has no camera {camera!r}; its cameras are: "
                f"{', '.join(cameras) or 'none'}"
            )
        self._camera = camera or page_camera(env, width / height, zoom)
        model.vis.global_.fovy = FIELD_OF_VIEW
        model.vis.global_.offwidth = width
        model.vis.global_.offheight = height
        # Half of the model's setting: twice as fast on a CPU, and still smooth.
        shadows, samples = (0, 0) if plain else (2048, 4)
        model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, shadows)
        model.vis.quality.offsamples = min(model.vis.quality.offsamples, samples)
        self._size = height, width
        self._has_shadows = not plain
        self._opened: mujoco.Renderer | None = None

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Frees the GPU's memory."""
        if self._opened is None:
            return
        # Otherwise this would free objects of the renderer that drew last.
        self._opened._gl_context.make_current()
        self._opened.close()
        self._opened = None
        atexit.unregister(self.close)

    def render(
        self,
        qpos: np.ndarray,
        goal: dict[str, float],
        metrics: Mapping[str, float] = NO_METRICS,
        trail: np.ndarray | None = None,
    ) -> np.ndarray:
        """A picture [height, width, 3] (uint8).

        Args:
          qpos: generalised positions [nq].
          goal: the goals, which place the markers, as do the last step's metrics.
          trail: positions of each ball [P, B, 3] to connect by a line, oldest first, m.

        Raises:
          UserError: no OpenGL library works.
        """
        renderer = self._renderer()
        self._display.pose(qpos, goal, metrics)
        renderer.update_scene(self._display.data, self._camera)
        if trail is not None:
            draw_trail(renderer.scene, trail)
        return renderer.render()

    def _renderer(self) -> mujoco.Renderer:
        if self._opened is None:
            choose_opengl()
            self._opened = mujoco.Renderer(self._display.model, *self._size)
            self._opened.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._has_shadows
            # Before MuJoCo ends OpenGL, which it has asked of `atexit` when it was loaded.
            atexit.register(self.close)
        return self._opened


def page_camera(env: Env, aspect: float, zoom: float = 1.0) -> mujoco.MjvCamera:
    """The camera of the pages, see `camera_pose`."""
    position, look_at = camera_pose(np.zeros((1, 3)), np.array(env.task.focus()), aspect, zoom)
    x, y, z = look_at - position
    camera = mujoco.MjvCamera()
    camera.lookat[:] = look_at
    camera.distance = np.linalg.norm(look_at - position)
    camera.azimuth = np.degrees(np.arctan2(y, x))
    camera.elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    return camera


def draw_trail(scene: mujoco.MjvScene, trail: np.ndarray) -> None:
    """Adds lines through positions [P, B, 3] to a scene; older segments are fainter."""
    for i, ball in np.ndindex(len(trail) - 1, trail.shape[1]):
        start, end = trail[i : i + 2, ball]
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        rgba = np.array([*TRAIL_RGB / 255.0, (i + 1) / len(trail)], np.float32)
        capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
        mujoco.mjv_initGeom(geom, capsule, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
        mujoco.mjv_connector(geom, capsule, _TRAIL_RADIUS, start, end)
        scene.ngeom += 1
