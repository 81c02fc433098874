"""The newest pictures of two cameras, each with the time of its exposure.

The time of a picture is told by its arrival, so only a picture that was seen to arrive counts: one
for which the program had to wait. One that is there at once has waited in a queue, nobody knows how
long, and is dropped. So no queue of a driver can make a time wrong, however deep it is.
"""

import os
import re
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from bounce_mjx.errors import UserError

_DEVICES = Path("/dev")
# Links to the cameras of Linux, by the maker's name with a serial number, and by the socket.
_LINKS = ("v4l/by-id", "v4l/by-path")
# Shares of a camera's interval: the wait for the second camera within which both pictures are of
# one exposure, and the time from the last pair beyond which one was lost.
_TOGETHER = 0.5
_NEXT = 1.5
# Share of the time between two pictures for which the program waits at least for one that has just
# arrived.
_WAITING = 0.1
# Pictures in a row that may have waited in a queue; a file's are more.
_QUEUED = 200
# Time in which a camera comes to its rate, and in which the rate is measured, s; how far it may be
# from the rate that was asked for, as a share.
_SETTLING = 0.5
_MEASURED = 0.4
_RATE_TOLERANCE = 0.1


def device_names(sources: Sequence[str]) -> tuple[str, ...]:
    """The names of cameras that they keep through a reboot, when their numbers may change.

    Args:
      sources: numbers of cameras, files such as /dev/video0, or addresses such as rtsp://...

    Returns:
      Links of /dev/v4l/by-id; of /dev/v4l/by-path, if cameras without a serial number have one name
      together; the sources themselves, if the computer has neither.
    """
    for folder in _LINKS:
        names = [_link_to(source, _DEVICES / folder) for source in sources]
        if None not in names and len(set(names)) == len(names):
            return tuple(str(name) for name in names)
    return tuple(sources)


def _link_to(source: str, folder: Path) -> Path | None:
    """The link of a folder to a camera, if there is one."""
    device = _DEVICES / f"video{source}" if source.isdigit() else Path(source)
    if not folder.is_dir() or not device.exists():
        return None
    links = sorted(folder.iterdir())
    return next((link for link in links if link.resolve() == device.resolve()), None)


def _open(name: str) -> cv2.VideoCapture:
    """Opens the camera of a name; UserError if it does not open."""
    source: int | str = int(name) if name.isdigit() else name
    if name.startswith(str(_DEVICES)):
        # OpenCV opens the devices of Linux by their numbers.
        number = re.fullmatch(r"video(\d+)", os.path.basename(os.path.realpath(name)))
        if number is None or not os.path.exists(name):
            raise UserError(f"the camera {name} is not connected; plug it in, or calibrate again")
        source = int(number[1])
    capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        raise UserError(f"the camera {name} does not open; give its number or address")
    return capture


class Capture:
    """Two cameras of OpenCV, such as USB or GigE ones.

    The time stamp is that of the exposure's middle: the arrival of the second picture less the
    time of transport and half of the exposure. Cameras without a common trigger expose at different
    times, and a ball of 4 m/s moves by 4 mm in each millisecond between them: wire the trigger.
    """

    def __init__(
        self,
        devices: Sequence[str],
        size: tuple[int, int],
        rate: float = 120.0,
        exposure: float = 0.004,
        transport: float = 0.004,
    ):
        """Opens the cameras, and measures their rate.

        Args:
          devices: as `device_names`, in the order of the calibration.
          size: width and height of the pictures, pixels.
          rate: pictures in a second, Hz.
          exposure: as it is set in the cameras, s; it is not set here.
          transport: from the end of the exposure until a picture has arrived, s.

        Raises:
          UserError: a camera does not open, has another rate, or its pictures do not come one by
            one.
        """
        self.devices = tuple(devices)
        self.size = size
        self.rate = rate
        self._exposure = exposure
        self._behind = transport + 0.5 * exposure
        self._least_wait = _WAITING / rate
        self._captures = [_open(device) for device in devices]
        for capture in self._captures:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
            # A driver may refuse these two, or take them and do otherwise.
            capture.set(cv2.CAP_PROP_FPS, rate)
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._arrived = 0.0
        """When the last pair arrived, s."""
        self._check_rate()

    def read(self) -> tuple[tuple[np.ndarray, ...], float]:
        """The next pair of pictures that arrives, and the middle of its exposure (s, of
        `time.monotonic`).

        Raises:
          UserError: a camera gives no picture, or one of another size.
        """
        arrived = self._wait()
        pictures = tuple(capture.retrieve()[1] for capture in self._captures)
        for device, picture in zip(self.devices, pictures, strict=True):
            if picture is None:
                raise UserError(f"the camera {device} gives no picture; check its cable")
            height, width = picture.shape[:2]
            if (width, height) != self.size:
                raise UserError(
                    f"the camera {device} gives pictures of {width} x {height}, not "
                    f"{self.size[0]} x {self.size[1]}; set the camera, or calibrate with --size "
                    f"{width} {height}"
                )
        return pictures, arrived - self._behind

    def read_exposed_from_now(self) -> tuple[np.ndarray, ...]:
        """The first pair whose exposure begins after this call, of an arm that rests now."""
        now = time.monotonic()
        while True:
            pictures, taken = self.read()
            if taken - 0.5 * self._exposure > now:
                return pictures

    def _wait(self) -> float:
        """Grabs the next pair that arrives: its time, s.

        Both are grabbed before either is decoded, which takes milliseconds.
        """
        first, second = self._captures
        last = self._arrived
        is_late = self._grab(first) < self._least_wait
        has_lost = time.monotonic() - last > _NEXT / self.rate
        if is_late or has_lost or self._grab(second) > _TOGETHER / self.rate:
            # The program came late, or a camera lost a picture: the two queues may hold different
            # ones.
            return self._catch_up()
        self._arrived = time.monotonic()
        return self._arrived

    def _catch_up(self) -> float:
        """Empties both queues, and grabs the next pair: its time, s."""
        behind, ahead = self._captures
        self._empty(behind)
        self._empty(ahead)
        # The other camera's picture of this instant is there as well, unless it came before or was
        # lost: then it has the next one.
        for _ in range(_QUEUED):
            if self._grab(behind) <= _TOGETHER / self.rate:
                break
            behind, ahead = ahead, behind
        self._arrived = time.monotonic()
        return self._arrived

    def _empty(self, capture: cv2.VideoCapture) -> None:
        """Grabs pictures until one arrives."""
        for _ in range(_QUEUED):
            if self._grab(capture) >= self._least_wait:
                return
        raise UserError(
            f"{_QUEUED} pictures of {', '.join(self.devices)} came faster than at {self.rate:g} "
            "Hz, so that nobody knows when they were taken; give cameras, no files"
        )

    def _grab(self, capture: cv2.VideoCapture) -> float:
        """Grabs a picture: the time for which it was waited, s."""
        begun = time.monotonic()
        if not capture.grab():
            device = self.devices[self._captures.index(capture)]
            raise UserError(f"the camera {device} gives no picture; check its cable")
        return time.monotonic() - begun

    def _check_rate(self) -> None:
        """Raises UserError if the cameras have another rate than the one that was asked for."""
        settled = time.monotonic() + _SETTLING
        begun = self._catch_up()
        while begun < settled:
            begun = self._wait()
        count = max(round(_MEASURED * self.rate), 4)
        for _ in range(count):
            for capture in self._captures:
                self._grab(capture)
        rate = count / (time.monotonic() - begun)
        if abs(rate / self.rate - 1.0) > _RATE_TOLERANCE:
            raise UserError(
                f"the cameras {', '.join(self.devices)} give {rate:.0f} pairs of pictures a "
                f"second, not {self.rate:g}; set their rate and a shorter exposure, or give "
                f"--rate {rate:.0f}"
            )
