"""The ball from two cameras: circles, geometry, the calibration, the tracker, the capture."""

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest

from bounce_mjx import load_policy
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.errors import UserError
from bounce_mjx.resources import resource_path

cv2 = pytest.importorskip("cv2")

EXAMPLES = Path(__file__).parent.parent / "examples"
from bounce_mjx.vision import rendering, simulated  # noqa: E402
from bounce_mjx.vision.calibration import calibrate  # noqa: E402
from bounce_mjx.vision.camera import RADIUS, Camera, rough_camera, triangulate  # noqa: E402
from bounce_mjx.vision.circles import COLOURS, Expected, find_circles, fit_circle  # noqa: E402
from bounce_mjx.vision.poses import ball_positions, nominal_ball, plan_poses  # noqa: E402
from bounce_mjx.vision.tracker import GRAVITY, Tracker  # noqa: E402
from bounce_mjx.vision.view import highest_seen, report_height  # noqa: E402

SIZE = 640, 480
GAZE = (0.59, 0.0, 0.48)
PLACES = (1.45, 0.85, 0.75), (1.45, -0.85, 0.75)
SEEN = np.array([[x, y, z] for x in (0.5, 0.7) for y in (-0.1, 0.1) for z in (0.15, 0.4, 0.7)])


def true_cameras() -> tuple[Camera, ...]:
    """Two cameras with a lens that bends lines."""
    straight = [rough_camera(place, GAZE, SIZE, 60.0) for place in PLACES]
    distortion = np.array([-0.12, 0.03, 0.0005, -0.0005, 0.0])
    return tuple(camera._replace(distortion=distortion) for camera in straight)


def picture_of_disc(
    centre: np.ndarray,
    radius: float,
    motion: np.ndarray,
    seed: int,
    colour: tuple[int, ...] = (10, 115, 250),
) -> np.ndarray:
    """A picture [H, W, 3] of a disc that moves during the exposure, before a grey ground; each
    pixel is the mean of 8 x 8 points and 16 instants."""
    columns, rows = np.meshgrid((np.arange(96 * 8) + 0.5) / 8, (np.arange(96 * 8) + 0.5) / 8)
    cover = np.zeros((96, 96))
    for share in (np.arange(16) + 0.5) / 16.0 - 0.5:
        x, y = centre + share * motion
        inside = (columns - 0.5 - x) ** 2 + (rows - 0.5 - y) ** 2 < radius**2
        cover += inside.reshape(96, 8, 96, 8).mean(axis=(1, 3)) / 16.0
    picture = 110.0 + cover[..., None] * (np.array(colour) - 110.0)
    noise = 3.0 * np.random.default_rng(seed).standard_normal(picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("motion", "tolerance"), [((0.0, 0.0), 0.2), ((3.0, 5.0), 0.3)])
@pytest.mark.parametrize("hidden", [0.0, 0.15, 0.45])
def test_a_circle_is_found_in_part_and_in_motion(motion, tolerance, hidden) -> None:
    blur = np.array(motion)
    counts = []
    for seed in range(4):
        centre = np.array([47.3, 50.6]) + 0.25 * seed
        picture = picture_of_disc(centre, 9.0, blur, seed)
        # Something of another colour hides its lower part, as the paddle does.
        edge = centre[1] + 9.0 * (1.0 - 2.0 * hidden)
        if hidden:
            picture[int(edge) :] = (20, 20, 180)
        expected = Expected(centre + 6.0, 9.0, blur)
        circles = find_circles(picture, COLOURS["orange"], None, expected)
        # What is hidden in part gives its centre or nothing.
        assert len(circles) == 1 or hidden
        limit = tolerance if not hidden else 2.0 if blur.any() else 0.8
        for circle in circles:
            assert np.linalg.norm(circle.centre - centre) < limit
        counts.append(len(circles))
    assert sum(counts) >= 2 or blur.any()


def test_what_is_no_ball_gives_nothing() -> None:
    colour = COLOURS["orange"]
    picture = picture_of_disc(np.array([48.0, 48.0]), 9.0, np.zeros(2), 0)
    far_smaller = Expected(np.array([48.0, 48.0]), 15.0, np.zeros(2))
    assert find_circles(picture, colour, None, far_smaller) == []
    bar = np.full((96, 96, 3), 110, np.uint8)
    bar[40:52, 10:86] = (10, 115, 250)
    near = Expected(np.array([48.0, 46.0]), 9.0, np.zeros(2))
    assert find_circles(bar, colour, None, near) == []


@pytest.mark.filterwarnings("error")
def test_points_without_a_circle_give_nothing_or_a_circle_of_a_ball() -> None:
    """Also where the fit's centre comes to lie on one of them."""
    mask = np.full((60, 60), 255, np.uint8)
    for seed in range(100):
        rng = np.random.default_rng(seed)
        points = rng.integers(20, 30, (int(rng.integers(8, 40)), 2)).astype(float)
        circle = fit_circle(points, mask, (2.0, 6.0), rng.uniform(-8.0, 8.0, 2))
        assert circle is None or 2.0 <= circle.radius <= 6.0


def test_rays_and_projections_are_inverse() -> None:
    pair = true_cameras()
    for place in SEEN:
        pixels = [camera.project(place[None])[0] for camera in pair]
        np.testing.assert_allclose(triangulate(pair, pixels), place, atol=1e-6)


def observed(seed: int) -> tuple:
    """The arm's 20 poses, and what both cameras see with 0.3 pixels of noise."""
    metadata = load_policy("robust").metadata
    rng = np.random.default_rng(seed)
    rough = [
        rough_camera(np.array(place) + 0.03, np.array(GAZE) - 0.02, SIZE, 58.5) for place in PLACES
    ]
    poses = plan_poses(metadata, rough, SIZE, seed=seed)
    ball = nominal_ball(metadata) + 0.003 * rng.standard_normal(3)
    places = ball_positions(metadata, poses, ball)
    seen = np.stack([camera.project(places) for camera in true_cameras()])
    return metadata, rough, poses, seen + 0.3 * rng.standard_normal(seen.shape)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_arm_calibrates_both_cameras(seed) -> None:
    metadata, rough, poses, pixels = observed(seed)
    low, high = np.array(metadata.joint_ranges).T
    assert poses.shape == (20, 6) and np.all((poses > low) & (poses < high))
    found = calibrate(metadata, rough, poses, pixels)
    errors = []
    for place in SEEN:
        seen = [camera.project(place[None])[0] for camera in true_cameras()]
        errors.append(triangulate(found.cameras, seen) - place)
    assert np.sqrt(np.mean(np.square(errors), axis=0)).max() < 2e-3
    assert found.bad == ()
    # What it says of itself is about what it is.
    assert 0.3e-3 < np.sqrt(np.nanmean(np.square(found.errors))) < 3e-3


def test_a_pose_that_does_not_fit_is_named() -> None:
    metadata, rough, poses, pixels = observed(2)
    pixels[1, 7] += 6.0
    pixels[0, 12] = np.nan
    found = calibrate(metadata, rough, poses, pixels)
    assert found.bad == (7,)
    assert "18 poses" in found.report() and "pose 8" in found.report()


def test_two_poses_with_another_thing_in_place_of_the_ball_are_left_out() -> None:
    metadata = load_policy("robust").metadata
    rng = np.random.default_rng(0)
    # Poses of an episode in which a lens was bent to meet the ring of the wrist.
    rough = rendering.taped_cameras()
    poses = plan_poses(metadata, rough, SIZE, seed=1053)
    places = ball_positions(metadata, poses, nominal_ball(metadata))
    pair = rendering.true_cameras()
    pixels = np.stack([camera.project(places) for camera in pair])
    pixels += 0.3 * rng.standard_normal(pixels.shape)
    pixels[0, 2] += (-74.0, -22.0)
    pixels[0, 18] += (79.0, 17.0)
    found = calibrate(metadata, rough, poses, pixels)
    assert found.bad == (2, 18)
    for camera, true_camera in zip(found.cameras, pair, strict=True):
        assert np.linalg.norm(camera.centre - true_camera.centre) < 0.03


def test_a_calibration_that_no_policy_bears_is_refused() -> None:
    metadata, rough, poses, pixels = observed(4)
    # An arm that stops short of each pose, by a degree or two.
    reached = poses + np.random.default_rng(0).normal(0.0, 0.025, poses.shape)
    with pytest.raises(UserError, match="the poses do not agree .* 10 mm is the most"):
        calibrate(metadata, rough, reached, pixels)


def test_what_lies_below_a_falling_ball_is_not_it() -> None:
    """Such as the paddle's corner: a bounce throws a ball up, and never down."""
    tracker = Tracker(true_cameras(), COLOURS["orange"])
    start, velocity = np.array([0.6, 0.02, 0.5]), np.array([0.1, -0.1, -1.0])
    for k in range(12):
        time = k / 120.0
        place = start + velocity * time + 0.5 * GRAVITY * time**2
        pictures = scene(place, (), k)
        if k >= 3:
            below = place - np.array([0.0, 0.0, 0.085])
            for picture, camera in zip(pictures, true_cameras(), strict=True):
                centre = tuple(int(pixel) for pixel in camera.project(below[None])[0])
                radius = round(camera.radius_at(below))
                cv2.circle(picture, centre, radius, (10, 115, 250), -1, cv2.LINE_AA)
                # A part of the ball itself is hidden.
                x, y = (int(pixel) for pixel in camera.project(place[None])[0])
                cv2.rectangle(picture, (x - 20, y + 5), (x + 20, y + 12), (110, 110, 110), -1)
        fix = tracker.update(pictures, time)
        assert fix is not None and np.linalg.norm(fix.position - place) < 5e-3


@pytest.mark.parametrize("middle", [-0.001, 0.0, 0.001])
def test_a_ball_that_bounces_within_the_exposure_is_seen(middle) -> None:
    """It is blurred less than in the flight that goes before; before a paddle, the pixels of its
    rim have another colour."""
    exposure = 0.004
    contact = 0.004
    tracker = Tracker(true_cameras(), COLOURS["orange"], exposure)
    lowest = np.array([0.6, 0.02, 0.3])

    def place_at(time: float) -> np.ndarray:
        """The ball falls at 4.5 m/s to a contact around the time `middle`, and rises at 4 m/s."""
        before = min(time - middle + 0.5 * contact, 0.0)
        after = max(time - middle - 0.5 * contact, 0.0)
        path = np.array([0.0, 0.0, 4.0 * after - 4.5 * before])
        return lowest + path + 0.5 * GRAVITY * (before + after) ** 2

    for k in range(-8, 3):
        taken = k / 120.0
        instants = taken + exposure * ((np.arange(16) + 0.5) / 16.0 - 0.5)
        frames = [scene(place_at(instant), (), 100 + k, 0.9) for instant in instants]
        pictures = [np.mean(frame, axis=0).astype(np.uint8) for frame in zip(*frames, strict=True)]
        fix = tracker.update(pictures, taken)
        seen = np.mean([place_at(instant) for instant in instants], axis=0)
        assert fix is not None and np.linalg.norm(fix.position - seen) < 3e-3


def test_how_high_the_cameras_see_is_told_beside_how_high_the_policy_plays() -> None:
    metadata = load_policy("robust").metadata
    home = paddle_position(metadata, np.array(metadata.default_joint_angles))
    for gaze, is_too_low in ((0.33, True), (0.48, False)):
        pair = [rough_camera(place, (*home[:2], gaze), SIZE, 60.0) for place in PLACES]
        # A camera without distortion: the upper edge's angle, less that of the ball's radius.
        distance = np.hypot(*(np.array(PLACES[0][:2]) - home[:2]))
        half_view = np.arctan(SIZE[1] / SIZE[0] * np.tan(np.radians(30.0)))
        pitch = np.arctan2(gaze - PLACES[0][2], distance)
        highest = PLACES[0][2] + distance * np.tan(pitch + half_view) - RADIUS
        assert highest_seen(pair, SIZE, home) == pytest.approx(highest, abs=0.02)
        text = report_height(pair, SIZE, metadata)
        assert "apexes are at 0.80 m at most" in text
        assert ("aim higher" in text) == is_too_low
    assert "apex" not in report_height(pair, SIZE, load_policy("balance").metadata)
    assert highest_seen(true_cameras(), SIZE, home) > 0.9


def scene(
    place: np.ndarray | None, others: tuple = (), seed: int = 0, share: float = 1.0
) -> list[np.ndarray]:
    """Pictures of both cameras: a ball, and other discs of its colour at pixels (x, y, radius); of
    the ball's radius, a share has its colour."""
    rng = np.random.default_rng(seed)
    pictures = []
    for camera in true_cameras():
        picture = np.full((SIZE[1], SIZE[0], 3), 110, np.uint8)
        discs = (
            []
            if place is None
            else [(*camera.project(place[None])[0], share * camera.radius_at(place))]
        )
        for x, y, radius in (*discs, *others):
            centre = (round(16 * x), round(16 * y))
            cv2.circle(picture, centre, round(16 * radius), (10, 115, 250), -1, cv2.LINE_AA, 4)
        noise = 3.0 * rng.standard_normal(picture.shape)
        pictures.append(np.clip(picture + noise, 0, 255).astype(np.uint8))
    return pictures


def test_the_tracker_follows_a_flight_and_nothing_else() -> None:
    tracker = Tracker(true_cameras(), COLOURS["orange"])
    start, velocity = np.array([0.6, 0.02, 0.3]), np.array([0.1, -0.1, 1.5])
    other = ((100.0, 400.0, 9.0), (500.0, 60.0, 25.0))
    for k in range(12):
        time = k / 120.0
        place = start + velocity * time + 0.5 * GRAVITY * time**2
        fix = tracker.update(scene(place, other, k), time)
        assert np.linalg.norm(fix.position - place) < 2e-3
    # What looks like it, but where it cannot have flown, is not it.
    beside = place + np.array([0.085, 0.0, 0.0])
    assert tracker.update(scene(beside, (), 12), 12 / 120.0) is None
    # Without the ball there is no place, also where both cameras see something of its colour.
    for k in range(13, 19):
        assert tracker.update(scene(None, other, k), k / 120.0) is None


@pytest.mark.slow
def test_a_policy_plays_from_rendered_pictures(tmp_path) -> None:
    environment = dict(os.environ, MUJOCO_GL=os.environ.get("MUJOCO_GL", "egl"))
    arguments = ["deploy.py", "--cameras", "--camera-rate", "60", "--seconds", "0.6"]
    done = subprocess.run(
        [sys.executable, *arguments], cwd=EXAMPLES, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    num_poses = int(done.stdout.split(" poses")[0].split()[-1])
    num_pairs = int(done.stdout.split(" pairs of pictures, 0 without a ball")[0].split()[-1])
    # Those of 0.6 s, and those of the braking at its end.
    assert num_poses >= 18 and num_pairs >= 36
    error = float(done.stdout.split("off by ")[1].split(" mm")[0])
    assert error < 4.0


@pytest.mark.parametrize("side_light", [False, True])
def test_a_background_that_was_drawn_before_changes_the_foot_of_the_arm_at_most(
    opengl, monkeypatch, side_light
) -> None:
    mjcf = str(resource_path("mjcf/bounce_ball.xml"))
    model = rendering.make_model(mjcf, "orange", side_light, quick=True)
    lenses = [rendering._Lens(camera) for camera in rendering.true_cameras()]
    sheet = rendering._Sheet(model, lenses)
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    sub_frames = range(len(rendering.SHIFTS))
    for _ in range(4):
        data.qpos[:] = model.qpos0 + rng.uniform(-1.0, 1.0, model.nq)
        data.joint("ball_link").qpos[:3] = rng.uniform((0.3, -0.3, 0.03), (0.8, 0.3, 0.9))
        mujoco.mj_forward(model, data)
        for sub_frame in sub_frames:
            sheet.draw(data, sub_frame)
        quick = np.array(sheet.read())
        for sub_frame in sub_frames:
            sheet._render(data, sub_frame, arm=True, room=True)
        with monkeypatch.context() as patch:
            patch.setattr(sheet, "_empty_room", None)
            whole = np.array(sheet.read())
        # Where the arm's foot meets the floor, either may be drawn.
        assert np.mean(np.any(quick != whole, axis=-1)) < 1e-5
        assert np.mean(quick[:, 0] != quick[:, -1]) > 0.03
    sheet.close()


def test_a_sub_frame_is_shifted_by_pixels_to_the_right_and_down(opengl, monkeypatch) -> None:
    np.testing.assert_allclose(np.mean(rendering.SHIFTS, axis=0), 0.0)
    monkeypatch.setattr(rendering, "SHIFTS", np.array([(0.0, 0.0), (3.0, 2.0)]))
    mjcf = str(resource_path("mjcf/bounce_ball.xml"))
    model = rendering.make_model(mjcf)
    lenses = [rendering._Lens(camera) for camera in rendering.true_cameras()]
    sheet = rendering._Sheet(model, lenses)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for sub_frame in range(2):
        sheet.draw(data, sub_frame)
    for straight, shifted in sheet.read():
        assert np.mean(shifted[2:, 3:] != straight[:-2, :-3]) < 0.01
        assert np.mean(shifted != straight) > 0.03
    sheet.close()


def test_a_picture_shows_the_instant_of_its_qpos_in_the_light_of_the_room(opengl) -> None:
    """Not what MuJoCo's step leaves behind: places of one step ago, lights without direction."""
    mjcf = str(resource_path("mjcf/bounce_ball.xml"))
    model = rendering.make_model(mjcf)
    rendered = rendering.RenderedCameras(model, rendering.true_cameras(), noise=0.0)
    data = mujoco.MjData(model)
    data.joint("ball_link").qpos[:3] = 0.59, 0.0, 0.6
    data.joint("ball_link").qvel[:3] = 0.0, 3.0, 0.0
    for _ in range(10):
        mujoco.mj_step(model, data)
    here = data.qpos.copy()
    picture = None
    while picture is None:
        data.time += 0.001
        picture = rendered.look(data)
    np.testing.assert_allclose(picture.ball, here[-7:-4])
    fresh = mujoco.MjData(model)
    fresh.qpos[:] = here
    mujoco.mj_forward(model, fresh)
    for drawn, right in zip(picture.pictures, rendered.still(fresh), strict=True):
        assert np.array_equal(drawn, right)
    rendered.close()


def test_a_ball_before_a_thing_of_its_colour_is_told_from_it(opengl) -> None:
    """An orange ball before the paddle's wooden handle in the shade: one edge encloses both,
    and a ball that is still just after its bounce was expected to fall."""
    metadata = load_policy("robust").metadata
    mjcf = str(resource_path("mjcf/bounce_ball.xml"))
    model = rendering.make_model(mjcf, "orange", True)
    pair = rendering.true_cameras()
    rendered = rendering.RenderedCameras(model, pair)
    data = mujoco.MjData(model)
    home = np.array(metadata.default_joint_angles)
    backgrounds = rendered.still(simulated.posed(model, data, metadata, home, None))
    # Away from its home, the arm is in no background.
    lower = home + np.array([0.0, 0.05, -0.05, 0.0, 0.0, 0.0])
    for beside in [(0.0, 0.01), (-0.01, 0.0), (-0.02, 0.0)]:
        simulated.posed(model, data, metadata, lower, np.array(beside))
        place = data.joint("ball_link").qpos[:3]
        pictures = rendered.still(data)
        for camera, picture, background in zip(pair, pictures, backgrounds, strict=True):
            pixel = camera.project(place[None])[0]
            expected = Expected(pixel, camera.radius_at(place), np.array([0.0, 4.0]))
            circles = find_circles(picture, COLOURS["orange"], background, expected)
            assert np.linalg.norm(circles[0].centre - pixel) < 1.5
    rendered.close()


class DrawnCameras:
    """Stands in for `RenderedCameras`: a grey wall, and the ball as a disc. It needs no OpenGL."""

    exposure = 0.004

    def __init__(self, pair: tuple[Camera, ...], rate: float = 120.0):
        self._pair = pair
        self._rate = rate
        self._count = 0
        noise = 3.0 * np.random.default_rng(0).standard_normal((SIZE[1], SIZE[0], 3))
        self.wall = np.clip(110.0 + noise, 0, 255).astype(np.uint8)
        self.covered: set[int] = set()
        """Cameras before which somebody holds a hand."""

    def look(self, data: mujoco.MjData) -> rendering.Picture | None:
        if data.time < self._count / self._rate - 1e-9:
            return None
        self._count += 1
        place = data.joint("ball_link").qpos[:3].copy()
        pictures = []
        for number, camera in enumerate(self._pair):
            picture = self.wall.copy()
            if number not in self.covered:
                x, y = camera.project(place[None])[0]
                centre = (round(16 * x), round(16 * y))
                radius = round(16 * camera.radius_at(place))
                cv2.circle(picture, centre, radius, (250, 250, 250), -1, cv2.LINE_AA, 4)
            pictures.append(picture)
        return rendering.Picture(data.time, data.time + 0.006, tuple(pictures), place)


class Play(NamedTuple):
    """What happened while a policy played from drawn pictures."""

    bounces: int
    fault: str
    """Code of the first fault; empty for none."""
    braking_after: float
    """Time from the covering of a camera to the braking, s."""
    largest_step: float
    """Largest change of a command in a control step, rad."""


def play_from_drawn_pictures(
    believed: tuple[Camera, ...], cover: int | None = None, seconds: float = 2.0
) -> Play:
    """The robust policy plays until its supervisor stops it. One camera is covered after 1 s.

    Args:
      believed: the cameras as a calibration gives them.
      cover: number of the camera that is covered.
    """
    policy = load_policy("robust")
    model = mujoco.MjModel.from_xml_path(str(resource_path("mjcf/bounce_ball.xml")))
    data = mujoco.MjData(model)
    drawn = DrawnCameras(true_cameras())
    tracker = Tracker(believed, COLOURS["white"], exposure=1e-4)
    tracker.learn_background([(drawn.wall, drawn.wall)])
    camera = simulated.SeenBall(drawn, tracker, calibration=None)
    arm = policy.supervise(rate=1.0 / model.opt.timestep)
    joints = [data.joint(name) for name in policy.metadata.joint_names]
    for joint, angle in zip(joints, policy.metadata.default_joint_angles, strict=True):
        joint.qpos = angle
    ball = data.joint("ball_link")
    held = ball.qpos.copy()
    camera.look(data)
    bounces, was_falling, largest_step, last = 0, False, 0.0, None
    begun, covered_at, braking_at, fault = None, None, None, ""
    while data.time < seconds:
        measured = {
            "joint_angles": [joint.qpos[0] for joint in joints],
            "joint_velocities": [joint.qvel[0] for joint in joints],
            "target_height": 0.5,
            "time": data.time,
            **camera.measure(data.time),
        }
        commands = arm.commands(measured)
        if last is not None:
            largest_step = max(largest_step, np.max(np.abs(commands[-1] - last)))
        last = commands[-1]
        if arm.state == "ready" and "ball_position" in measured and begun is None:
            arm.start()
            begun = data.time
        if begun is not None and cover is not None and data.time > begun + 1.0:
            if covered_at is None:
                covered_at = data.time
            drawn.covered = {cover}
        if arm.state in ("braking", "stopped") and braking_at is None:
            braking_at, fault = data.time, arm.fault
        if arm.state == "stopped":
            break
        for command in commands:
            data.ctrl[:] = command
            mujoco.mj_step(model, data)
            if arm.state not in ("running", "braking"):
                ball.qpos[:], ball.qvel[:] = held, 0.0
            bounces += bool(was_falling and ball.qvel[2] > 0.0)
            was_falling = ball.qvel[2] < 0.0
            camera.look(data)
    braking_after = np.nan
    if braking_at is not None and covered_at is not None:
        braking_after = braking_at - covered_at
    return Play(bounces, fault, braking_after, largest_step)


def test_a_policy_plays_from_pictures_alone() -> None:
    play = play_from_drawn_pictures(true_cameras())
    assert play.fault == "" and play.bounces >= 2


def test_a_covered_camera_brakes_the_arm() -> None:
    play = play_from_drawn_pictures(true_cameras(), cover=1, seconds=3.0)
    assert play.fault == "old_picture"
    assert 0.05 < play.braking_after < 0.3
    assert play.largest_step <= max(load_policy("robust").metadata.largest_step) + 1e-9


def moved(camera: Camera, shift: np.ndarray, turn: np.ndarray) -> Camera:
    """A camera as somebody believes it to stand: moved (m) and turned (rad) from where it is."""
    rotation = camera.rotation @ cv2.Rodrigues(np.array(turn))[0].T
    return camera._replace(rotation=rotation, translation=-rotation @ (camera.centre + shift))


@pytest.mark.parametrize(
    ("shift", "turn"),
    [((0.0, 0.0, 0.10), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.05))],
)
def test_one_camera_that_was_moved_gives_no_place(shift, turn) -> None:
    """The rays do not meet, so the arm never starts."""
    first, second = true_cameras()
    believed = (first, moved(second, np.array(shift), np.array(turn)))
    play = play_from_drawn_pictures(believed, seconds=0.5)
    assert play.bounces == 0


def test_cameras_in_a_wrong_frame_end_with_the_supervisor() -> None:
    """Both are off together by 12 cm: the places fit each other, and the arm misses the ball."""
    shift = np.array([0.0, 0.12, 0.0])
    believed = tuple(moved(camera, shift, np.zeros(3)) for camera in true_cameras())
    play = play_from_drawn_pictures(believed, seconds=3.0)
    assert play.fault == "ball_lost" and play.bounces == 0
    assert play.largest_step <= max(load_policy("robust").metadata.largest_step) + 1e-9
