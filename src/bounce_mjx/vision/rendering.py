"""What two real cameras would see of a simulated arm: pictures with the lens' distortion, motion
blur, noise, and light from one side. Nothing here tells the tracker where the ball is.

Needs an OpenGL library that renders without a screen: MUJOCO_GL=egl or osmesa.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.vision.camera import Camera, rough_camera

WIDTH, HEIGHT = 640, 480
FOCAL_LENGTH = 560.0
"""Of both cameras, pixels."""
DISTORTION = np.array([-0.12, 0.03, 0.0005, -0.0005, 0.0])
PLACES = ((1.45, 0.85, 0.75), (1.45, -0.85, 0.75))
"""Where the cameras stand in the robot's frame, m."""
GAZE = (0.59, 0.0, 0.48)
"""The point at which both look, m."""
SHIFTS = np.array([(-0.125, 0.375), (0.375, -0.375), (-0.375, -0.125), (0.125, 0.125)])
"""A picture is the mean of these sub-frames: shifts to the right and down, pixels, by which edges
become smooth; in the order of time, with which they hardly rise or fall, as that would blur a
moving ball."""
SHADOW_SIZE = 1024
"""Width of a shadow's map, pixels; MuJoCo's own, 4096, takes three times as long for edges that the
blur of a picture hides."""
FLOOR_GROUP = 4
"""Group of a floor that is drawn once."""
HIDDEN_GROUP = 5
"""Group of what no picture shows."""
FLOOR_HEIGHT = 0.03
"""Height under which the floor may hide a part of the ball, m."""
BALL_COLOURS = {"white": (0.98, 0.98, 0.95, 1.0), "orange": (1.0, 0.45, 0.05, 1.0)}


class Picture(NamedTuple):
    """A pair of pictures."""

    taken: float
    """Middle of the exposure, s."""
    arrives: float
    """Time at which a program gets it, s."""
    pictures: tuple[np.ndarray, np.ndarray]
    """BGR [H, W, 3], uint8."""
    ball: np.ndarray
    """True mean place of the ball during the exposure [3], m, to measure errors with."""


def true_cameras() -> tuple[Camera, ...]:
    """The cameras as they are, which only the renderer knows."""
    field_of_view = np.degrees(2.0 * np.arctan(0.5 * WIDTH / FOCAL_LENGTH))
    cameras = []
    for place in PLACES:
        straight = rough_camera(place, GAZE, (WIDTH, HEIGHT), field_of_view)
        cameras.append(straight._replace(distortion=DISTORTION))
    return tuple(cameras)


def taped_cameras(error: float = 0.03) -> tuple[Camera, ...]:
    """The cameras as somebody measured them with a tape: off by some centimetres (m) and, in the
    focal length, by 2%."""
    field_of_view = np.degrees(2.0 * np.arctan(0.5 * WIDTH / (1.02 * FOCAL_LENGTH)))
    cameras = []
    for k, place in enumerate(PLACES):
        off = error * np.array([1.0, -1.0, 0.5]) * (1 - 2 * k)
        gaze = np.array(GAZE) + error
        cameras.append(rough_camera(np.array(place) + off, gaze, (WIDTH, HEIGHT), field_of_view))
    return tuple(cameras)


def make_model(
    mjcf: str, ball: str = "white", light_from_one_side: bool = False, quick: bool = False
) -> mujoco.MjModel:
    """The arm's model with the ball's colour and the lights of a laboratory.

    Args:
      quick: without shadows, which take 5 of 6 parts of the time where no GPU renders.
        `RenderedCameras` then draws the floor and the sky once.
    """
    spec = mujoco.MjSpec.from_file(mjcf)
    # Sub-frames that are shifted within a pixel smooth the edges in place of samples.
    spec.visual.quality.offsamples = 0
    spec.visual.quality.shadowsize = SHADOW_SIZE
    if quick:
        spec.visual.quality.shadowsize = 0
        spec.geom("floor").group = FLOOR_GROUP
    spec.material("celluloid").rgba = BALL_COLOURS[ball]
    spec.visual.global_.offwidth = len(PLACES) * WIDTH
    spec.visual.global_.offheight = len(SHIFTS) * HEIGHT
    # Markers are for people.
    for site in spec.sites:
        site.group = HIDDEN_GROUP
    if light_from_one_side:
        spec.material("celluloid").emission = 0.1
        spec.visual.headlight.ambient = [0.22, 0.22, 0.22]
        spec.visual.headlight.diffuse = [0.0, 0.0, 0.0]
        spec.light("key").dir = [0.2, -1.0, -0.4]
        spec.light("fill").diffuse = [0.0, 0.0, 0.0]
    return spec.compile()


class RenderedCameras:
    """Pictures of two synchronous cameras."""

    def __init__(
        self,
        model: mujoco.MjModel,
        cameras: Sequence[Camera],
        rate: float = 120.0,
        exposure: float = 0.004,
        transport: float = 0.004,
        noise: float = 3.0,
        seed: int = 0,
    ):
        """Args:
        model: see `make_model`.
        rate: pictures in a second, Hz.
        exposure: time of exposure, s; its picture is the mean of sub-frames.
        transport: time from the end of the exposure until a program has the picture, s.
        noise: standard deviation of a pixel, of 255.
        """
        self.rate = rate
        self.exposure = exposure
        self.transport = transport
        self.noise = noise
        self._random = np.random.default_rng(seed)
        self._lenses = tuple(_Lens(camera) for camera in cameras)
        self._sheet = _Sheet(model, self._lenses)
        self._model = model
        self._drawn = mujoco.MjData(model)
        self._begun = 0
        self._times: list[float] = []
        self._places: list[np.ndarray] = []

    def look(self, data: mujoco.MjData) -> Picture | None:
        """Sees one instant, of which `time` and `qpos` count; call it after each physics step.
        Returns a pair after its last sub-frame.

        A sub-frame is due in the middle of each fourth of the exposure, and is taken at the first
        physics step from then on.
        """
        start = self._begun / self.rate
        due = start + (len(self._times) + 0.5) / len(SHIFTS) * self.exposure
        if data.time < due - 1e-9:
            return None
        # After a step, the data's geoms and lights are still where they were before it.
        self._drawn.qpos[:] = data.qpos
        mujoco.mj_kinematics(self._model, self._drawn)
        mujoco.mj_comPos(self._model, self._drawn)
        mujoco.mj_camlight(self._model, self._drawn)
        self._sheet.draw(self._drawn, sub_frame=len(self._times))
        self._times.append(data.time)
        self._places.append(data.joint("ball_link").qpos[:3].copy())
        if len(self._times) < len(SHIFTS):
            return None
        middle = float(np.mean(self._times))
        arrives = middle + 0.5 * self.exposure + self.transport
        ball = np.mean(self._places, axis=0)
        self._times = []
        self._places = []
        self._begun += 1
        return Picture(middle, arrives, self._develop(), ball)

    def still(self, data: mujoco.MjData) -> tuple[np.ndarray, ...]:
        """A pair of pictures of something that rests."""
        for sub_frame in range(len(SHIFTS)):
            self._sheet.draw(data, sub_frame)
        return self._develop()

    def _develop(self) -> tuple[np.ndarray, ...]:
        """The pictures of the sub-frames that were drawn last."""
        pictures = []
        for lens, frames in zip(self._lenses, self._sheet.read(), strict=True):
            total = frames[0].astype(np.float32)
            for frame in frames[1:]:
                cv2.accumulate(frame, total)
            distorted = lens.distort(total / len(frames))
            # OpenCV's normal numbers take a third of the time of NumPy's, but have one state a
            # process.
            cv2.setRNGSeed(int(self._random.integers(2**31)))
            noise = cv2.randn(np.empty_like(distorted), 0.0, self.noise)
            pictures.append(np.clip(distorted + noise, 0.0, 255.0).astype(np.uint8))
        return tuple(pictures)

    def close(self) -> None:
        """Frees the renderer."""
        self._sheet.close()


class _Lens:
    """MuJoCo's renderer knows no lens distortion: a wider picture is rendered, and the lens then
    bends it."""

    def __init__(self, camera: Camera):
        columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(float)
        straight = cv2.undistortPoints(pixels, camera.matrix, camera.distortion).reshape(-1, 2)
        self._tangent = float(np.max(np.abs(straight / np.array([WIDTH / HEIGHT, 1.0])))) * 1.01
        scale = 0.5 * HEIGHT / self._tangent
        self._columns = (0.5 * WIDTH + scale * straight[:, 0] - 0.5).reshape(HEIGHT, WIDTH)
        self._rows = (0.5 * HEIGHT + scale * straight[:, 1] - 0.5).reshape(HEIGHT, WIDTH)
        self._columns = self._columns.astype(np.float32)
        self._rows = self._rows.astype(np.float32)
        self._camera = camera

    def aim(self, scene: mujoco.MjvScene, shift: np.ndarray) -> None:
        """Has a scene seen from here, without distortion.

        Args:
          shift: of the picture to the right and down [2], pixels.
        """
        near = 0.05
        half_height = near * self._tangent
        right, down = 2.0 * half_height / HEIGHT * shift
        for gl_camera in scene.camera:
            gl_camera.pos[:] = self._camera.centre
            gl_camera.forward[:] = self._camera.rotation[2]
            gl_camera.up[:] = -self._camera.rotation[1]
            gl_camera.orthographic = 0
            gl_camera.frustum_near = near
            gl_camera.frustum_far = 10.0
            gl_camera.frustum_center = -right
            gl_camera.frustum_width = half_height * WIDTH / HEIGHT
            gl_camera.frustum_bottom = -half_height + down
            gl_camera.frustum_top = half_height + down

    def distort(self, straight: np.ndarray) -> np.ndarray:
        """The picture of the real lens."""
        return cv2.remap(straight, self._columns, self._rows, cv2.INTER_LINEAR)


class _Sheet:
    """The sub-frames of a pair of pictures side by side in one buffer, as each reading waits for
    the GPU: a column for each camera, a row for each sub-frame."""

    def __init__(self, model: mujoco.MjModel, lenses: Sequence[_Lens]):
        """Draws the empty room, if the model is a quick one."""
        self._lenses = lenses
        try:
            self._renderer = mujoco.Renderer(model, len(SHIFTS) * HEIGHT, len(lenses) * WIDTH)
        except mujoco.FatalError as error:
            raise UserError(
                "pictures cannot be rendered here; without a display, set MUJOCO_GL=egl or "
                "MUJOCO_GL=osmesa"
            ) from error
        self._empty_room: np.ndarray | None = None
        if model.geom("floor").group == FLOOR_GROUP:
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            for sub_frame in range(len(SHIFTS)):
                self._render(data, sub_frame, arm=False, room=True)
            self._empty_room = self._read()

    def draw(self, data: mujoco.MjData, sub_frame: int) -> None:
        """Draws what all cameras see.

        Nothing stands behind the sky or under the floor, so where both were drawn before, they are
        seen wherever nothing else is drawn. That takes half the time.
        """
        floor_hides_ball = data.joint("ball_link").qpos[2] < FLOOR_HEIGHT
        room = self._empty_room is None or floor_hides_ball
        self._render(data, sub_frame, arm=True, room=room)

    def read(self) -> list[list[np.ndarray]]:
        """For each camera its sub-frames that were drawn last, of a lens without distortion, BGR
        [H, W, 3]."""
        sheet = self._read()
        if self._empty_room is not None:
            is_empty = cv2.inRange(sheet, (0, 0, 0), (0, 0, 0))
            cv2.copyTo(self._empty_room, is_empty, sheet)
        pictures = []
        for column in range(len(self._lenses)):
            columns = slice(column * WIDTH, (column + 1) * WIDTH)
            frames = []
            for sub_frame in range(len(SHIFTS)):
                rows = slice(sub_frame * HEIGHT, (sub_frame + 1) * HEIGHT)
                # OpenGL's rows go up.
                frames.append(cv2.flip(sheet[rows, columns], 0))
            pictures.append(frames)
        return pictures

    def _render(self, data: mujoco.MjData, sub_frame: int, arm: bool, room: bool) -> None:
        """Draws the arm with the ball, the room (floor and sky), or both. What is empty is
        black."""
        option = mujoco.MjvOption()
        option.geomgroup[:FLOOR_GROUP] *= arm
        option.geomgroup[FLOOR_GROUP] = room
        renderer = self._renderer
        renderer._gl_context.make_current()
        renderer.update_scene(data, scene_option=option)
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = room
        for column, lens in enumerate(self._lenses):
            lens.aim(renderer.scene, SHIFTS[sub_frame])
            place = mujoco.MjrRect(column * WIDTH, sub_frame * HEIGHT, WIDTH, HEIGHT)
            mujoco.mjr_render(place, renderer.scene, renderer._mjr_context)

    def _read(self) -> np.ndarray:
        """The whole sheet as it was drawn, BGR."""
        renderer = self._renderer
        renderer._gl_context.make_current()
        sheet = np.empty((renderer.height, renderer.width, 3), np.uint8)
        whole = mujoco.MjrRect(0, 0, renderer.width, renderer.height)
        mujoco.mjr_readPixels(sheet, None, whole, renderer._mjr_context)
        return cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR)

    def close(self) -> None:
        """Frees the renderer."""
        # Otherwise this would free objects of the renderer that drew last.
        self._renderer._gl_context.make_current()
        self._renderer.close()
