"""Which camera is which, when its pictures were taken, and whether it is where the arm has it."""

import json
import re
import types
from collections import deque
from pathlib import Path

import numpy as np
import pytest

from bounce_mjx import load_policy
from bounce_mjx.errors import UserError

cv2 = pytest.importorskip("cv2")

from bounce_mjx.vision import capture as capture_module  # noqa: E402
from bounce_mjx.vision.camera import Camera, rough_camera  # noqa: E402
from bounce_mjx.vision.capture import Capture, device_names  # noqa: E402
from bounce_mjx.vision.check import Seen, check_rig, plan_check  # noqa: E402
from bounce_mjx.vision.circles import COLOURS  # noqa: E402
from bounce_mjx.vision.poses import ball_positions, nominal_ball  # noqa: E402
from bounce_mjx.vision.procedures import calibrate_by_hand, check_by_hand  # noqa: E402
from bounce_mjx.vision.rig import Rig, load_rig, picture_path, save_rig  # noqa: E402

SIZE = 640, 480
GAZE = (0.59, 0.0, 0.48)
PLACES = (1.45, 0.85, 0.75), (1.45, -0.85, 0.75)
EXPOSURE, TRANSPORT = 0.004, 0.004


def make_rig(devices: tuple[str, ...] = ("left", "right")) -> Rig:
    pair = tuple(rough_camera(place, GAZE, SIZE, 60.0) for place in PLACES)
    return Rig(pair, SIZE, devices)


class Bus:
    """A clock that goes on only while a program works or waits, and cameras with a common trigger:
    each exposure's picture goes into a camera's queue, unless that is full."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        rate: float = 60.0,
        depths: tuple[int, ...] = (4, 4),
        size: tuple[int, int] = SIZE,
    ):
        self.now = 100.0
        self.rate = rate
        self.size = size
        self.depths = deque(depths)
        self.lost: set[tuple[int, int]] = set()
        """Cameras, 0 and 1, and the numbers of the exposures that each loses."""
        self.pictures = None
        """What each camera sees; None for a picture with the number of its exposure."""
        monkeypatch.setattr(
            capture_module, "time", types.SimpleNamespace(monotonic=lambda: self.now)
        )
        monkeypatch.setattr(cv2, "VideoCapture", self.open)

    def open(self, source: int | str) -> "Device":
        return Device(self, source, self.depths.popleft())

    def arrival(self, number: int) -> float:
        """When the picture of an exposure arrives, s."""
        return 100.0 + number / self.rate

    def middle(self, number: int) -> float:
        """Middle of an exposure, s."""
        return self.arrival(number) - TRANSPORT - 0.5 * EXPOSURE


class Device:
    """Stands in for `cv2.VideoCapture` of a driver that heeds no setting."""

    def __init__(self, bus: Bus, source: int | str, depth: int):
        self.bus = bus
        self.source = source
        self.depth = depth
        self.place = 1 - len(bus.depths)
        """0 for the first camera."""
        self.queue: deque[int] = deque()
        self.next = 0

    def isOpened(self) -> bool:
        return True

    def set(self, name: int, value: float) -> bool:
        return False

    def _fill(self) -> None:
        while self.bus.arrival(self.next) <= self.bus.now + 1e-12:
            is_lost = (self.place, self.next) in self.bus.lost
            if len(self.queue) < self.depth and not is_lost:
                self.queue.append(self.next)
            self.next += 1

    def grab(self) -> bool:
        self._fill()
        self.bus.now += 50e-6
        while not self.queue:
            self.bus.now = max(self.bus.now, self.bus.arrival(self.next))
            self._fill()
        self.grabbed = self.queue.popleft()
        return True

    def retrieve(self) -> tuple[bool, np.ndarray]:
        if self.bus.pictures is not None:
            return True, self.bus.pictures(self.source)
        width, height = self.bus.size
        picture = np.zeros((height, width, 3), np.uint8)
        picture[0, 0] = np.frombuffer(np.int32(self.grabbed).tobytes(), np.uint8)[:3]
        return True, picture


def number_of(picture: np.ndarray) -> int:
    """The number of a picture's exposure."""
    return int.from_bytes(picture[0, 0].tobytes(), "little")


@pytest.mark.parametrize("work", [0.0, 0.012, 0.0166, 0.020, 0.030, 0.3])
@pytest.mark.parametrize("depths", [(4, 4), (1, 4), (4, 2)])
def test_a_picture_has_the_time_of_its_exposure_however_slow_the_program_is(
    monkeypatch, work, depths
) -> None:
    bus = Bus(monkeypatch, depths=depths)
    capture = Capture(["0", "1"], SIZE, 60.0, EXPOSURE, TRANSPORT)
    last = -1
    for _ in range(40):
        pictures, taken = capture.read()
        first, second = (number_of(picture) for picture in pictures)
        assert first == second > last
        assert taken == pytest.approx(bus.middle(first), abs=2e-3)
        last = first
        bus.now += work


@pytest.mark.parametrize("work", [0.0, 0.010])
@pytest.mark.parametrize("lost", [{0: (90,)}, {1: (90,)}, {0: (90,), 1: (91,)}, {1: (90, 91)}])
def test_a_lost_picture_of_one_camera_leaves_pairs_of_one_exposure(monkeypatch, lost, work) -> None:
    bus = Bus(monkeypatch)
    bus.lost = {(place, number) for place in lost for number in lost[place]}
    capture = Capture(["0", "1"], SIZE, 60.0, EXPOSURE, TRANSPORT)
    seen = []
    while not seen or seen[-1] < 120:
        pictures, taken = capture.read()
        first, second = (number_of(picture) for picture in pictures)
        assert first == second
        assert taken == pytest.approx(bus.middle(first), abs=2e-3)
        seen.append(first)
        bus.now += work
    assert min(seen) < 85 and len(seen) > 120 - min(seen) - 6


def test_a_camera_straight_above_its_gaze_has_x_at_the_top() -> None:
    camera = rough_camera((0.6, 0.0, 2.0), (0.6, 0.0, 0.5), SIZE, 60.0)
    ahead = camera.project(np.array([0.7, 0.0, 0.5]))[0]
    middle = camera.project(np.array([0.6, 0.0, 0.5]))[0]
    left = camera.project(np.array([0.6, 0.1, 0.5]))[0]
    np.testing.assert_allclose(middle, [320.0, 240.0], atol=1e-9)
    assert ahead[1] < middle[1] - 10.0 and left[0] < middle[0] - 10.0


def test_a_fast_program_gets_every_picture(monkeypatch) -> None:
    bus = Bus(monkeypatch)
    capture = Capture(["0", "1"], SIZE, 60.0, EXPOSURE, TRANSPORT)
    numbers = []
    for _ in range(20):
        numbers.append(number_of(capture.read()[0][0]))
        bus.now += 0.010
    assert np.all(np.diff(numbers) == 1)


def test_a_pose_is_seen_in_a_picture_whose_exposure_begins_in_it(monkeypatch) -> None:
    bus = Bus(monkeypatch)
    capture = Capture(["0", "1"], SIZE, 60.0, EXPOSURE, TRANSPORT)
    for wait in (0.0, 0.005, 0.5):
        bus.now += wait
        asked = bus.now
        first, second = capture.read_exposed_from_now()
        assert number_of(first) == number_of(second)
        assert bus.middle(number_of(first)) - 0.5 * EXPOSURE > asked - 1e-3


@pytest.mark.parametrize("rate", [30.0, 60.0, 200.0])
def test_cameras_of_another_rate_than_asked_for_are_refused(monkeypatch, rate) -> None:
    Bus(monkeypatch, rate)
    with pytest.raises(UserError, match=f"0, 1 give {rate:g} pairs .* not 120; .* --rate {rate:g}"):
        Capture(["0", "1"], SIZE, 120.0, EXPOSURE, TRANSPORT)


def test_a_file_is_no_camera(monkeypatch) -> None:
    Bus(monkeypatch, rate=1e5)
    with pytest.raises(UserError, match="nobody knows when they were taken; give cameras"):
        Capture(["a.mp4", "b.mp4"], SIZE, 120.0, EXPOSURE, TRANSPORT)


def test_pictures_of_another_size_than_the_calibrated_one_are_refused(monkeypatch) -> None:
    Bus(monkeypatch, size=(1280, 720))
    capture = Capture(["0", "1"], SIZE, 60.0, EXPOSURE, TRANSPORT)
    with pytest.raises(UserError, match="1280 x 720, not 640 x 480; .* --size 1280 720"):
        capture.read()


def make_devices(folder: Path, links: dict[str, str]) -> None:
    """Devices as udev makes them: links such as by-id/NAME to a file such as video0."""
    for link, device in links.items():
        path = folder / "v4l" / link
        path.parent.mkdir(parents=True, exist_ok=True)
        (folder / device).touch()
        path.symlink_to(folder / device)


def test_a_camera_is_found_again_when_its_number_has_changed(tmp_path, monkeypatch) -> None:
    before = tmp_path / "before"
    make_devices(before, {"by-id/usb-A_1": "video0", "by-id/usb-A_2": "video2"})
    monkeypatch.setattr(capture_module, "_DEVICES", before)
    names = device_names(["0", str(before / "video2")])
    assert [Path(name).name for name in names] == ["usb-A_1", "usb-A_2"]
    # After a reboot the second one has the number 0.
    after = tmp_path / "after"
    make_devices(after, {"by-id/usb-A_2": "video0", "by-id/usb-A_1": "video4"})
    monkeypatch.setattr(capture_module, "_DEVICES", after)
    bus = Bus(monkeypatch)
    kept = [name.replace(str(before), str(after)) for name in names]
    capture = Capture(kept, SIZE, 60.0)
    assert [device.source for device in capture._captures] == [4, 0]
    bus.depths = deque([4, 4])
    gone = str(after / "v4l/by-id/usb-B_1")
    with pytest.raises(UserError, match="usb-B_1 is not connected"):
        Capture([kept[0], gone], SIZE, 60.0)


def test_cameras_without_a_serial_number_are_told_apart_by_their_sockets(
    tmp_path, monkeypatch
) -> None:
    """Two of a kind have one name, which leads to whichever came last."""
    monkeypatch.setattr(capture_module, "_DEVICES", tmp_path)
    make_devices(
        tmp_path,
        {"by-id/usb-A": "video2", "by-path/usb-0:1": "video0", "by-path/usb-0:2": "video2"},
    )
    assert [Path(name).name for name in device_names(["0", "2"])] == ["usb-0:1", "usb-0:2"]
    assert device_names(["0", "rtsp://x/1"]) == ("0", "rtsp://x/1")


def test_a_rig_is_written_with_its_devices_and_a_picture_of_each(tmp_path) -> None:
    path = tmp_path / "cameras.json"
    with pytest.raises(UserError, match="there is no file .*cameras.json; write it with"):
        load_rig(path)
    rig = make_rig()
    seen = [np.full((4, 6, 3), 40 * number, np.uint8) for number in (1, 2)]
    save_rig(path, rig, seen)
    loaded = load_rig(path)
    assert loaded.size == SIZE and loaded.devices == ("left", "right")
    for camera, saved in zip(loaded.cameras, rig.cameras, strict=True):
        for name in Camera._fields:
            np.testing.assert_array_equal(getattr(camera, name), getattr(saved, name))
    for number in (1, 2):
        np.testing.assert_array_equal(cv2.imread(str(picture_path(path, number))), seen[number - 1])
    path.write_text(json.dumps({"cameras": []}))
    with pytest.raises(UserError, match="no file of calibrated cameras .*; calibrate them again"):
        load_rig(path)


WALL = np.full((SIZE[1], SIZE[0], 3), 110, np.uint8)


def picture_of(camera: Camera, place: np.ndarray) -> np.ndarray:
    """A picture of an orange ball before a wall."""
    picture = WALL.copy()
    centre = tuple(round(16 * x) for x in camera.project(place[None])[0].tolist())
    radius = round(16 * camera.radius_at(place))
    cv2.circle(picture, centre, radius, (10, 115, 250), -1, cv2.LINE_AA, 4)
    return picture


def see(rig: Rig, poses: np.ndarray, true: Rig, beside: tuple = (0.0, 0.0, 0.0)) -> np.ndarray:
    """The check of a rig by pictures of other cameras, with a ball beside the paddle's middle."""
    metadata = load_policy("robust").metadata
    places = ball_positions(metadata, poses, nominal_ball(metadata)) + np.array(beside)
    seen = []
    for angles, place in zip(poses, places, strict=True):
        seen.append(Seen(angles, [picture_of(camera, place) for camera in true.cameras]))
    return check_rig(metadata, rig, seen, [WALL, WALL], COLOURS["orange"])


def moved(camera: Camera, shift: tuple[float, ...]) -> Camera:
    return camera._replace(translation=-camera.rotation @ (camera.centre + np.array(shift)))


def test_a_check_compares_the_ball_with_forward_kinematics() -> None:
    rig = make_rig()
    poses = plan_check(load_policy("robust").metadata, rig)
    errors = see(rig, poses, rig, beside=(0.004, 0.003, 0.0))
    np.testing.assert_allclose(errors, np.tile([0.004, 0.003, 0.0], (len(poses), 1)), atol=1e-3)


@pytest.mark.parametrize("skew", [0.0, 0.03, 0.1])
def test_cameras_in_each_others_place_are_refused(skew) -> None:
    """Also where they stand as mirror images of one another, and agree everywhere."""
    rig = make_rig()
    rig = rig._replace(cameras=(moved(rig.cameras[0], (skew, skew, -skew)), rig.cameras[1]))
    poses = plan_check(load_policy("robust").metadata, rig)
    exchanged = rig._replace(cameras=rig.cameras[::-1])
    with pytest.raises(UserError, match="in each other's place: left sees what right saw"):
        see(rig, poses, exchanged)


@pytest.mark.parametrize("shift", [(0.05, 0.0, 0.0), (0.0, 0.05, 0.0), (0.0, 0.0, 0.05)])
@pytest.mark.parametrize("both", [False, True])
def test_cameras_that_were_moved_are_refused(shift, both) -> None:
    rig = make_rig()
    poses = plan_check(load_policy("robust").metadata, rig)
    first, second = rig.cameras
    true = rig._replace(cameras=(moved(first, shift), moved(second, shift) if both else second))
    with pytest.raises(UserError, match="calibrate again"):
        see(rig, poses, true)


def test_a_person_calibrates_and_checks_two_cameras(monkeypatch, tmp_path) -> None:
    metadata = load_policy("robust").metadata
    true = make_rig()
    bus = Bus(monkeypatch)
    capture = Capture(["0", "1"], SIZE, 60.0)
    said = []
    places: list[np.ndarray] = []
    order = [0, 1]

    def ask(text: str) -> None:
        """The person does what the text says."""
        said.append(text)
        if "move the arm to" in text:
            angles = np.array(re.findall(r"-?\d+\.\d{3}", text), float)
            places.append(ball_positions(metadata, angles, nominal_ball(metadata)))

    def look(source: int) -> np.ndarray:
        if not places or "Take the ball away" in said[-1]:
            return WALL
        return picture_of(true.cameras[order[source]], places[-1])

    bus.pictures = look
    path = tmp_path / "cameras.json"
    colour = COLOURS["orange"]
    rough = [rough_camera(np.array(place) + 0.02, GAZE, SIZE, 59.0) for place in PLACES]
    words = calibrate_by_hand(metadata, capture, rough, colour, path, ask)
    assert len(places) == 20 and "20 poses; error x" in words and "up to a height of" in words
    assert "camera 1 is 0, which sees" in words and picture_path(path, 2).is_file()
    rig = load_rig(path)
    assert rig.devices == ("0", "1")
    words = check_by_hand(metadata, capture, rig, colour, ask)
    assert "where the arm has it, at most" in words
    # The numbers change.
    order.reverse()
    with pytest.raises(UserError, match="the cameras are in each other's place"):
        check_by_hand(metadata, capture, rig, colour, ask)
    with pytest.raises(UserError, match="there is no folder"):
        calibrate_by_hand(metadata, capture, rough, colour, tmp_path / "no" / "x.json", ask)
