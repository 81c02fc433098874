"""MuJoCo's own window, on a machine with a display."""

import os
import subprocess
import sys
from collections.abc import Callable

import mujoco
import mujoco.viewer

from bounce_mjx.viewers.display import Display, Trail
from bounce_mjx.viewers.offscreen import draw_trail
from bounce_mjx.viewers.simulation import Simulation, environment_pose, in_real_time


def has_display() -> bool:
    """Whether a window can be opened."""
    if sys.platform == "linux":
        named = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        # The display may be dead. A separate process tries it, as a failure may stay.
        probe = [sys.executable, "-c", "import glfw, sys; sys.exit(not glfw.init())"]
        return bool(named) and subprocess.run(probe, capture_output=True).returncode == 0
    # On a Mac, MuJoCo's viewer needs its own interpreter, mjpython.
    return sys.platform != "darwin" or "MJPYTHON_BIN" in os.environ


def show_window(simulation: Simulation, seconds: float | None, is_over: Callable[[], bool]) -> None:
    """Shows the first environment of a simulation in real time until the window is closed.

    Args:
      seconds: simulated time; None for no end.
      is_over: called between two pictures; whether to close the window.
    """
    display = Display(simulation.env)
    trail = Trail(simulation.env.dt)
    trail.add(simulation.frame)
    display.pose(*environment_pose(simulation.frame, 0))
    with mujoco.viewer.launch_passive(
        display.model, display.data, show_left_ui=False, show_right_ui=False
    ) as viewer:
        with viewer.lock():
            mujoco.mjv_defaultFreeCamera(display.model, viewer.cam)
        for frames in in_real_time(simulation, seconds):
            if is_over() or not viewer.is_running():
                return
            for frame in frames:
                trail.add(frame)
            with viewer.lock():
                display.pose(*environment_pose(simulation.frame, 0))
                viewer.user_scn.ngeom = 0
                draw_trail(viewer.user_scn, trail.points[:, 0])
            viewer.sync()
