"""MuJoCo's own window, on a machine with a display."""

import os
import queue
import subprocess
import sys
import time
from collections.abc import Callable

import mujoco
import mujoco.viewer
import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.viewers.controls import direction, words
from bounce_mjx.viewers.display import Display
from bounce_mjx.viewers.offscreen import draw_trail
from bounce_mjx.viewers.pace import Pace
from bounce_mjx.viewers.simulation import Simulation, frame_readings, of_environment
from bounce_mjx.viewers.trail import Trail

_PICTURE_RATE = 60.0
_PUSH = 0.2
_KEYS = "RTGMNIKJL"
# Flags that MuJoCo's window toggles with the same keys.
_OPTION_FLAGS = [i for i, (*_, key) in enumerate(mujoco.mjVISSTRING) if key and key in _KEYS]
_SCENE_FLAGS = [i for i, (*_, key) in enumerate(mujoco.mjRNDSTRING) if key and key in _KEYS]
_SPACE = 32  # GLFW's code; the code of a letter is its character.


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
            "--viewer native needs a display"
            + (
                " and mjpython"
                if sys.platform == "darwin"
                else ", but DISPLAY names none that works"
            )
            + "; use --viewer browser"
        )


def _help(env: Env) -> dict[str, str]:
    """What each key does."""
    moved = [("T / G", words(name)) for name in list(env.config.commands)[:1]]
    return {
        "space": "pause",
        "R": "reset",
        **dict(moved),
        "M / N": "speed",
        "I K J L": "push the ball",
    }


class Window:
    """Shows the first environment of a simulation."""

    def __init__(self, simulation: Simulation, speed: float):
        self._simulation = simulation
        self._display = Display(simulation.env)
        self._paused, self._speed = False, speed
        self._camera = mujoco.MjvCamera()
        # Keys arrive in the window's thread and take effect between two steps.
        self._keys: queue.SimpleQueue[int] = queue.SimpleQueue()

    def run(self, seconds: float | None, between: Callable[[], None]) -> None:
        """Shows it until the window is closed, or the simulated `seconds` are over.

        Args:
          between: called between two pictures.
        """
        simulation, display = self._simulation, self._display
        dt = simulation.env.dt
        pace, trail = Pace(dt), Trail(dt)
        trail.add(simulation.frame)
        steps_left = float("inf") if seconds is None else round(seconds / dt)
        display.pose(simulation.frame.qpos[0], of_environment(simulation.frame.command, 0))
        with mujoco.viewer.launch_passive(
            display.model,
            display.data,
            key_callback=self._keys.put,
            show_left_ui=False,
            show_right_ui=False,
        ) as viewer:
            with viewer.lock():
                mujoco.mjv_defaultFreeCamera(display.model, viewer.cam)
            self._camera = viewer.cam
            flags = viewer.opt.flags[_OPTION_FLAGS], viewer.user_scn.flags[_SCENE_FLAGS]
            while viewer.is_running() and steps_left > 0:
                between()
                while not self._keys.empty():
                    self._press(self._keys.get())
                due = 0 if self._paused else min(pace.due(self._speed), steps_left)
                steps_left -= due
                for _ in range(due):
                    trail.add(simulation.step())
                frame = simulation.frame
                with viewer.lock():
                    viewer.opt.flags[_OPTION_FLAGS], viewer.user_scn.flags[_SCENE_FLAGS] = flags
                    display.pose(frame.qpos[0], of_environment(frame.command, 0))
                    viewer.user_scn.ngeom = 0
                    draw_trail(viewer.user_scn, trail.points[:, 0])
                viewer.set_texts(self._texts())
                viewer.sync()
                time.sleep(1.0 / _PICTURE_RATE)
                if self._paused:
                    pace.forget()

    def _press(self, key: int) -> None:
        simulation = self._simulation
        pushes = {"I": "up", "K": "back", "J": "left", "L": "right"}
        if key == _SPACE:
            self._paused = not self._paused
        elif key == ord("R"):
            simulation.reset()
        elif key in (ord("T"), ord("G")):
            self._change_command(1.0 if key == ord("T") else -1.0)
        elif key in (ord("M"), ord("N")):
            factor = 1.25 if key == ord("M") else 0.8
            self._speed = float(np.clip(self._speed * factor, 0.1, 4.0))
        elif chr(key) in pushes:
            azimuth = np.radians(self._camera.azimuth)
            view = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            simulation.push(_PUSH * direction(pushes[chr(key)], view))

    def _change_command(self, direction: float) -> None:
        """Moves the first command by its step."""
        simulation = self._simulation
        for name, command in list(simulation.env.config.commands.items())[:1]:
            value = float(simulation.frame.command[name][0]) + direction * command.step
            value = float(np.clip(value, command.least, command.greatest))
            simulation.command = simulation.command | {name: value}

    def _texts(self) -> list[tuple]:
        frame = self._simulation.frame
        state = {
            **frame_readings(self._simulation.env, frame),
            "ball": f"{frame.ball[0, 2]:.2f} m",
            "speed": "paused" if self._paused else f"{self._speed:.2g}",
        }
        font, corner = mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos
        return [
            (font, position, "\n".join(lines), "\n".join(lines.values()))
            for position, lines in (
                (corner.mjGRID_TOPLEFT, state),
                (corner.mjGRID_BOTTOMLEFT, _help(self._simulation.env)),
            )
        ]
