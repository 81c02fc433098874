"""The 3D scene of the live page and of the replay page, built with viser."""

import contextlib
import math
import time
from collections.abc import Sequence

import numpy as np
import viser

from bounce_mjx.env.env import Env
from bounce_mjx.viewers.display import (
    FIELD_OF_VIEW,
    TRAIL_RGB,
    Display,
    Trail,
    body_scenes,
    camera_pose,
)
from bounce_mjx.viewers.simulation import EnvFrame, environment_pose, frame_readings

_SPACING = np.array([1.3, 0.9, 0.0])
_LABEL_HEIGHT = 0.74
# Distance of a label above its target, which the ball may exceed.
_LABEL_DISTANCE = 0.14
ANNOUNCED_SECONDS = 1.5
"""Time for which a label says that an episode was lost, s."""
_BACKGROUND = np.array([222.0, 228.0, 235.0])
# Where there are more robots than this, their labels are short.
_MAX_LONG_LABELS = 4
# A page lays out its panels within this time, s.
_LAYOUT_SECONDS = 5.0


class Scene:
    """Up to 16 environments side by side on a viser server."""

    def __init__(
        self,
        server: viser.ViserServer,
        env: Env,
        num_envs: int,
        names: Sequence[str] | None = None,
        dt: float | None = None,
    ):
        """
        Args:
          names: a name of each environment for its label; by default their numbers.
          dt: time between two frames, s; None for a control step.
        """
        self._server = server
        self._env = env
        self._names = names
        self._dt = dt or env.dt
        self._display = Display(env)
        self.show(num_envs)
        # After the scene is built: a page that is there already is welcomed at once.
        server.on_client_connect(self._welcome)

    def show(self, num_envs: int) -> None:
        """Builds the scene for the first `num_envs` environments of the next frames."""
        self.num_envs = num_envs
        """Number of environments that are shown."""
        self._offsets = _grid(num_envs)
        scene = self._server.scene
        scene.reset()
        scene.set_up_direction("+z")
        scene.configure_environment_map(hdri=None)
        scene.configure_default_lights(True, cast_shadow=True)
        scene.add_light_hemisphere("/sky", ground_color=(170, 165, 160), intensity=1.3)
        _add_floor(scene)
        model = self._display.model
        self._bodies = {}
        for body, shapes in body_scenes(model):
            is_marker = model.body_mocapid[body] >= 0
            self._bodies[body] = scene.add_batched_glb(
                # By its number: a body need not have a name, and a slash in one would nest it.
                f"/robot/{body}",
                shapes.export(file_type="glb"),
                batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (num_envs, 1)),
                batched_positions=self._offsets,
                lod="off",
                cast_shadow=not is_marker,
            )
        self._trail = Trail(self._dt)
        num_lines = num_envs * self._env.config.num_balls
        segments = self._trail.length - 1
        age = np.linspace(1.0, 0.0, self._trail.length)[:, None, None]
        colors = age * _BACKGROUND + (1.0 - age) * TRAIL_RGB
        colors = np.stack([colors[:-1], colors[1:]], axis=2)
        self._line = scene.add_line_segments(
            "/trail",
            np.zeros((segments * num_lines, 2, 3)),
            np.repeat(colors, num_lines, axis=1).reshape(-1, 2, 3).astype(np.uint8),
            thickness=0.006,
        )
        self._focus = focus = np.array(self._env.task.focus())
        self._label_places = self._offsets + focus * (1.0, 1.0, 0.0)
        font_scale = 0.8
        if num_envs <= 4:
            font_scale = 1.0
        if num_envs == 1:
            font_scale = 1.4
        self._labels = []
        for i, place in enumerate(self._label_places):
            label = scene.add_label(
                f"/labels/{i}",
                "",
                position=place + (0.0, 0.0, _LABEL_HEIGHT),
                anchor="bottom-center",
                visible=False,
                font_screen_scale=font_scale,
            )
            self._labels.append(label)
        self._lost = np.zeros(num_envs, bool)
        for client in self._server.get_clients().values():
            self._frame(client)
        position, look_at = camera_pose(self._offsets, focus)
        camera = self._server.initial_camera
        camera.position = tuple(position)
        camera.look_at = tuple(look_at)
        camera.up = (0.0, 0.0, 1.0)
        camera.fov = math.radians(FIELD_OF_VIEW)

    def update(self, frames: Sequence[EnvFrame]) -> None:
        """Shows the last of the frames since the last update; the trail uses all of them."""
        display = self._display
        positions = np.zeros((self.num_envs, display.model.nbody, 3))
        rotations = np.zeros((self.num_envs, display.model.nbody, 4))
        for frame in frames:
            self._trail.add(frame)
            over = frame.over[: self.num_envs]
            self._lost = np.where(over, frame.lost[: self.num_envs], self._lost)
            # Said for so long; a reset begins an episode without a loss before it.
            self._lost &= over | (frame.time[: self.num_envs] < ANNOUNCED_SECONDS)
        frame = frames[-1]
        with self._server.atomic():
            for i, label in enumerate(self._labels):
                qpos, goal, metrics = environment_pose(frame, i)
                display.pose(qpos, goal, metrics)
                positions[i] = display.data.xpos
                rotations[i] = display.data.xquat
                # An empty label would be a white stroke.
                label.text = self._label(frame, i)
                label.visible = bool(label.text)
                top = max(self._env.task.levels(goal).values(), default=0.0)
                height = max(_LABEL_HEIGHT, top + _LABEL_DISTANCE)
                label.position = self._label_places[i] + (0.0, 0.0, height)
            for body, handle in self._bodies.items():
                # What moves: a joint's body, or a marker.
                if display.model.body_weldid[body]:
                    handle.batched_positions = positions[:, body] + self._offsets
                    handle.batched_wxyzs = rotations[:, body]
            path = self._trail.points[:, : self.num_envs] + self._offsets[:, None]
            self._line.points = np.stack([path[:-1], path[1:]], axis=3).reshape(-1, 2, 3)

    def _label(self, frame: EnvFrame, index: int) -> str:
        """An environment's name if there are several, and the task's readings, or that its episode
        is lost."""
        name = "" if self.num_envs == 1 else f"{index + 1}:  "
        if self._names is not None:
            name = f"{self._names[index]}:  "
        short = self.num_envs > _MAX_LONG_LABELS
        if self._lost[index]:
            return f"{name}LOST"
        readings = frame_readings(self._env, frame, index)
        if short:
            return name + next(iter(readings.values()), "")
        text = name + "   ".join(f"{word} {value}" for word, value in readings.items())
        return text.strip(": ")

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Turns the camera of a new page, and once more when its panels have taken their room."""
        self._frame(client)
        aspect = client.camera.aspect
        until = time.monotonic() + _LAYOUT_SECONDS

        @client.camera.on_update
        def _(camera: viser.CameraHandle) -> None:
            nonlocal aspect
            if time.monotonic() < until and camera.aspect != aspect:
                aspect = camera.aspect
                self._frame(client)

    def _frame(self, client: viser.ClientHandle) -> None:
        """Turns the camera of a page towards the environments."""
        # A page whose own camera is invalid keeps it.
        with contextlib.suppress(ValueError, TypeError, AssertionError, ZeroDivisionError):
            position, look_at = camera_pose(self._offsets, self._focus, client.camera.aspect)
            if np.all(np.isfinite(position)):
                client.camera.position = position
                client.camera.look_at = look_at


def _grid(number: int) -> np.ndarray:
    """Offsets [number, 3] of a grid of environments around the origin, m."""
    columns = math.ceil(math.sqrt(number))
    row, column = np.divmod(np.arange(number), columns)
    offsets = np.stack([row, column, np.zeros(number)], axis=1) * _SPACING
    return offsets - 0.5 * (offsets.min(axis=0) + offsets.max(axis=0))


def _add_floor(scene: viser.SceneApi) -> None:
    """A floor of 0.2 m squares, as a scale."""
    scene.set_background_image(np.full((1, 1, 3), _BACKGROUND, np.uint8))
    scene.add_grid(
        "/floor",
        width=12.0,
        height=12.0,
        cell_size=0.2,
        cell_color=(176, 184, 193),
        section_size=1.0,
        section_color=(140, 150, 162),
        plane_color=(206, 213, 221),
        plane_opacity=1.0,
        shadow_opacity=0.35,
    )
