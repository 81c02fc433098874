"""MuJoCo's own window, on a machine with a display."""

import os
import queue
import subprocess
import sys
from collections.abc import Callable

import mujoco
import mujoco.viewer
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.viewers.controls import DEFAULT_PUSH, direction, keys
from bounce_mjx.viewers.display import Display
from bounce_mjx.viewers.offscreen import draw_trail
from bounce_mjx.viewers.options import SPEED_RANGE
from bounce_mjx.viewers.pace import in_real_time
from bounce_mjx.viewers.simulation import Simulation, frame_readings, pose_of
from bounce_mjx.viewers.trail import Trail

_KEYS = "RTGMNIKJL"
# Flags that MuJoCo's window toggles with the same keys.
_OPTION_FLAGS = [i for i, (*_, key) in enumerate(mujoco.mjVISSTRING) if key and key in _KEYS]
_SCENE_FLAGS = [i for i, (*_, key) in enumerate(mujoco.mjRNDSTRING) if key and key in _KEYS]


def has_display() -> bool:
    """Whether a window can be opened."""
    if sys.platform == "linux":
        named = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        # The display may be dead. A separate process tries it, as a failure may stay.
        probe = [sys.executable, "-c", "import glfw, sys; sys.exit(not glfw.init())"]
        return bool(named) and subprocess.run(probe, capture_output=True).returncode == 0
    # On a Mac, MuJoCo's viewer needs its own interpreter, mjpython.
    return sys.platform != "darwin" or "MJPYTHON_BIN" in os.environ


def check_display() -> None:
    """Raises:
    UserError: no window can be opened.
    """
    if not has_display():
        raise UserError(
            "--viewer native needs a display that works (DISPLAY names it), and on a Mac mjpython; "
            "use --viewer browser"
        )


class Window:
    """Shows the first environment of a simulation."""

    def __init__(self, simulation: Simulation, speed: float):
        self._simulation = simulation
        self._display = Display(simulation.env)
        self._paused, self._speed = False, speed
        self._camera = mujoco.MjvCamera()
        # Keys arrive in the window's thread and take effect between two steps.
        self._pressed: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._keys = keys(self, simulation.env.config)

    def run(self, seconds: float | None, between: Callable[[], None]) -> None:
        """Shows it until the window is closed, or the simulated `seconds` are over.

        Args:
          between: called between two pictures.
        """
        simulation, display = self._simulation, self._display
        trail = Trail(simulation.env.dt)
        trail.add(simulation.frame)
        display.pose(*pose_of(simulation.frame, 0))
        with mujoco.viewer.launch_passive(
            display.model,
            display.data,
            key_callback=self._pressed.put,
            show_left_ui=False,
            show_right_ui=False,
        ) as viewer:
            with viewer.lock():
                mujoco.mjv_defaultFreeCamera(display.model, viewer.cam)
            self._camera = viewer.cam
            flags = viewer.opt.flags[_OPTION_FLAGS], viewer.user_scn.flags[_SCENE_FLAGS]
            for frames in in_real_time(simulation, seconds, self._pace):
                if not viewer.is_running():
                    return
                between()
                while not self._pressed.empty():
                    self.press(self._pressed.get())
                for frame in frames:
                    trail.add(frame)
                frame = simulation.frame
                with viewer.lock():
                    viewer.opt.flags[_OPTION_FLAGS], viewer.user_scn.flags[_SCENE_FLAGS] = flags
                    display.pose(*pose_of(frame, 0))
                    viewer.user_scn.ngeom = 0
                    draw_trail(viewer.user_scn, trail.points[:, 0])
                viewer.set_texts(self._texts())
                viewer.sync()

    def _pace(self) -> float:
        return 0.0 if self._paused else self._speed

    def press(self, code: int) -> None:
        """Does what a key does, of a GLFW code."""
        for _, key, act in self._keys:
            if code == ord(" " if key == "space" else key):
                act(None)

    def pause(self, _: object) -> None:
        """Pauses the simulation, or resumes it."""
        self._paused = not self._paused

    def reset(self, _: object) -> None:
        """Starts a new episode."""
        self._simulation.reset()

    def move(self, steps: float) -> None:
        """Moves the first command by a number of its steps."""
        simulation = self._simulation
        name, command = next(iter(simulation.env.config.commands.items()))
        value = float(simulation.frame.command[name][0]) + steps * command.step
        value = float(np.clip(value, command.least, command.greatest))
        simulation.command = simulation.command | {name: value}

    def hasten(self, change: float) -> None:
        """Changes the speed."""
        self._speed = float(np.clip(self._speed + change, *SPEED_RANGE))

    def push(self, towards: str, _: object) -> None:
        """Pushes the ball in a direction as the camera sees it."""
        azimuth = np.radians(self._camera.azimuth)
        view = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        self._simulation.push(DEFAULT_PUSH * direction(towards, view))

    def _texts(self) -> list[tuple]:
        frame = self._simulation.frame
        state = {
            **frame_readings(self._simulation.env, frame),
            "ball": f"{frame.ball[0, 2]:.2f} m",
            "speed": "paused" if self._paused else f"{self._speed:.1f}",
        }
        font, corner = mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos
        return [
            (font, position, "\n".join(lines), "\n".join(lines.values()))
            for position, lines in (
                (corner.mjGRID_TOPLEFT, state),
                (corner.mjGRID_BOTTOMLEFT, {key: label for label, key, _ in self._keys}),
            )
        ]
