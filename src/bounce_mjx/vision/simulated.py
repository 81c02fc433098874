"""A simulated arm that sees its ball in rendered pictures, as a robot's program would: it
calibrates its two cameras itself, and gets each place late. `examples/deploy.py --cameras` plays
from it."""

import time
from collections.abc import Sequence

import cv2
import mujoco
import numpy as np

from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.vision.calibration import Calibration, calibrate, find_fixed_ball
from bounce_mjx.vision.camera import Camera
from bounce_mjx.vision.circles import COLOURS
from bounce_mjx.vision.poses import plan_poses
from bounce_mjx.vision.rendering import HEIGHT, WIDTH, RenderedCameras, taped_cameras, true_cameras
from bounce_mjx.vision.tracker import Tracker
from bounce_mjx.vision.view import report_height


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
    metadata: Metadata,
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
    background = cameras.still(posed(model, data, metadata, joint_angles[0], None))
    for pose, angles in enumerate(joint_angles):
        pictures = cameras.still(posed(model, data, metadata, angles, beside))
        for k, picture in enumerate(pictures):
            pixels[k, pose] = find_fixed_ball(
                metadata, rough[k], angles, picture, COLOURS[ball], background[k]
            )
    return calibrate(metadata, rough, joint_angles, pixels)


def how_high(calibration: Calibration, metadata: Metadata) -> str:
    """In words, whether the rendered cameras see as high as a policy plays."""
    return report_height(calibration.cameras, (WIDTH, HEIGHT), metadata)


def posed(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    metadata: Metadata,
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
    model: mujoco.MjModel,
    metadata: Metadata,
    ball: str = "white",
    rate: float = 120.0,
    seed: int = 0,
) -> SeenBall:
    """Two cameras that the arm has calibrated, and the tracker that has learned the background."""
    cameras = RenderedCameras(model, true_cameras(), rate, seed=seed)
    calibration = calibrate_with_arm(model, metadata, cameras, ball, seed)
    tracker = Tracker(calibration.cameras, COLOURS[ball], cameras.exposure)
    home = np.array(metadata.default_joint_angles)
    empty = posed(model, mujoco.MjData(model), metadata, home, None)
    tracker.learn_background([cameras.still(empty) for _ in range(8)])
    return SeenBall(cameras, tracker, calibration)
