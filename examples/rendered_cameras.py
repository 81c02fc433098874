"""What two real cameras would see of a simulated arm: pictures with the lens' distortion, motion
blur, noise, and light from one side. Nothing here tells the tracker where the ball is.
`deploy.py --cameras` plays from it.

Needs mujoco, OpenCV, and an OpenGL library that renders without a screen: MUJOCO_GL=egl or osmesa.
"""

import time
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import mujoco
import numpy as np
from two_cameras import (
    COLOURS,
    Calibration,
    Camera,
    Tracker,
    calibrate,
    find_fixed_ball,
    plan_poses,
    report_height,
    rough_camera,
)

from bounce_mjx.errors import UserError

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


class Film:
    """What both cameras see, side by side, with a ring around the ball where the tracker sees it,
    and its last places."""

    def __init__(self, every: int = 4, seconds_each: float = 0.1):
        """Args:
        every: of so many pairs one is shown.
        seconds_each: how long it is shown, s.
        """
        self._every = every
        self._seconds_each = seconds_each
        self._count = 0
        self._places: list[np.ndarray] = []
        self._frames: list[np.ndarray] = []

    def add(
        self, pictures: Sequence[np.ndarray], cameras: Sequence[Camera], place: np.ndarray | None
    ) -> None:
        """Adds a pair of pictures, and the place of the ball [3] (m), if it was found."""
        if place is not None:
            self._places = [*self._places[-30:], place]
        self._count += 1
        if (self._count - 1) % self._every:
            return
        views = []
        for picture, camera in zip(pictures, cameras, strict=True):
            view = picture.copy()
            if self._places:
                path = np.round(camera.project(np.array(self._places))).astype(np.int32)
                cv2.polylines(view, [path], False, (60, 200, 60), 1, cv2.LINE_AA)
            if place is not None:
                radius = round(camera.radius_at(place)) + 5
                cv2.circle(view, path[-1].tolist(), radius, (60, 60, 250), 2, cv2.LINE_AA)
            views.append(cv2.resize(view, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        self._frames.append(np.hstack(views))

    def save(self, path: str) -> None:
        """Writes the film as an animated picture, .webp or .gif."""
        animation = cv2.Animation()
        animation.frames = self._frames
        animation.durations = [round(1e3 * self._seconds_each)] * len(self._frames)
        cv2.imwriteanimation(path, animation, [cv2.IMWRITE_WEBP_QUALITY, 70])


class SeenBall:
    """The ball as a robot's program gets it: pictures, the tracker, and their delays.

    It has the interface of `deploy.Camera`.
    """

    def __init__(
        self,
        cameras: RenderedCameras,
        tracker: Tracker,
        calibration: Calibration,
        processing: float = 0.004,
    ):
        """Args:
        processing: time that the tracker takes, s.
        """
        self._cameras = cameras
        self._tracker = tracker
        self.calibration = calibration
        self._processing = processing
        self.errors: list[np.ndarray] = []
        """Measured less true place of each ball that was found [3], m, for the report alone."""
        self.tracking_times: list[float] = []
        """Processor's time that the tracker took for each pair, s."""
        self._measured: list[tuple[float, float, np.ndarray]] = []
        self.num_pairs = 0
        """Pairs of pictures so far."""
        self.num_missed = 0
        """Pairs in which no ball was found."""
        self.pictures: tuple[np.ndarray, np.ndarray] | None = None
        """The newest pair."""
        self.film: Film | None = None
        """Where the pairs go, if a film is wanted."""

    def look(self, data: mujoco.MjData) -> bool:
        """Sees one instant; call it after each physics step. Tells whether a ball was found."""
        picture = self._cameras.look(data)
        if picture is None:
            return False
        self.num_pairs += 1
        self.pictures = picture.pictures
        begun = time.process_time()
        fix = self._tracker.update(picture.pictures, picture.taken)
        self.tracking_times.append(time.process_time() - begun)
        if self.film is not None:
            place = None if fix is None else fix.position
            self.film.add(picture.pictures, self.calibration.cameras, place)
        if fix is None:
            self.num_missed += 1
            return False
        self.errors.append(fix.position - picture.ball)
        arrives = picture.arrives + self._processing
        self._measured = [*self._measured[-20:], (arrives, fix.time, fix.position)]
        return True

    def report(self) -> str:
        """How well the ball was seen, in words."""
        text = f"{self.num_pairs} pairs of pictures, {self.num_missed} without a ball"
        if not self.errors:
            return text
        distances = 1e3 * np.linalg.norm(self.errors, axis=1)
        root_mean_square = np.sqrt(np.mean(distances**2))
        return (
            f"{text}; off by {root_mean_square:.1f} mm (root mean square), at most "
            f"{np.max(distances):.1f} mm"
        )

    def close(self) -> None:
        """Frees the renderer."""
        self._cameras.close()

    def measure(self, now: float) -> dict:
        """The newest place of the ball that has arrived, if any, and its velocity from two."""
        arrived = [entry for entry in self._measured if entry[0] <= now + 1e-6]
        if not arrived:
            return {}
        _, taken, position = arrived[-1]
        _, before, last_position = arrived[max(len(arrived) - 2, 0)]
        velocity = (position - last_position) / max(taken - before, 1e-3)
        return {"ball_position": position, "ball_velocity": velocity, "ball_age": now - taken}


def calibrate_with_arm(
    model: mujoco.MjModel,
    metadata,
    cameras: RenderedCameras,
    ball: str = "white",
    seed: int = 0,
) -> Calibration:
    """The cameras in the frame of the base, from 20 poses of the arm with the ball on its paddle.

    The ball is taped to the paddle some millimetres beside its centre, as a person would do it.
    """
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    rough = taped_cameras()
    joint_angles = plan_poses(metadata, rough, (WIDTH, HEIGHT), seed=seed)
    beside = 0.003 * rng.standard_normal(2)
    pixels = np.full((2, len(joint_angles), 2), np.nan)
    background = cameras.still(_posed(model, data, metadata, joint_angles[0], None))
    for pose, angles in enumerate(joint_angles):
        pictures = cameras.still(_posed(model, data, metadata, angles, beside))
        for k, picture in enumerate(pictures):
            pixels[k, pose] = find_fixed_ball(
                metadata, rough[k], angles, picture, COLOURS[ball], background[k]
            )
    return calibrate(metadata, rough, joint_angles, pixels)


def how_high(calibration: Calibration, metadata) -> str:
    """In words, whether the rendered cameras see as high as a policy plays."""
    return report_height(calibration.cameras, (WIDTH, HEIGHT), metadata)


def _posed(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    metadata,
    joint_angles: np.ndarray,
    beside: np.ndarray | None,
) -> mujoco.MjData:
    """The arm at joint angles with the ball on its paddle, beside its centre by x and y (m) in the
    paddle's frame; None for no ball."""
    for name, angle in zip(metadata.joint_names, joint_angles, strict=True):
        data.joint(name).qpos = angle
    mujoco.mj_forward(model, data)
    paddle = model.geom("blocker").id
    # Without a ball it is above what the cameras see, where the floor cannot hide it either.
    place = np.array([0.0, 0.0, 5.0])
    if beside is not None:
        frame = data.geom_xmat[paddle].reshape(3, 3)
        up = frame[:, 2] * np.sign(frame[2, 2])
        height = model.geom_size[paddle, 2] + model.geom("ball").size[0]
        place = data.geom_xpos[paddle] + frame[:, :2] @ beside + height * up
    data.joint("ball_link").qpos[:3] = place
    mujoco.mj_forward(model, data)
    return data


def seen_ball(
    model: mujoco.MjModel, metadata, ball: str = "white", rate: float = 120.0, seed: int = 0
) -> SeenBall:
    """Two cameras that the arm has calibrated, and the tracker that has learned the background."""
    cameras = RenderedCameras(model, true_cameras(), rate, seed=seed)
    calibration = calibrate_with_arm(model, metadata, cameras, ball, seed)
    tracker = Tracker(calibration.cameras, COLOURS[ball], cameras.exposure)
    home = np.array(metadata.default_joint_angles)
    empty = _posed(model, mujoco.MjData(model), metadata, home, None)
    tracker.learn_background([cameras.still(empty) for _ in range(8)])
    return SeenBall(cameras, tracker, calibration)
