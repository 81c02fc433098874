"""Two calibrated cameras and which device each of them is, as a file."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from bounce_mjx.errors import UserError, shorten
from bounce_mjx.vision.camera import Camera


class Rig(NamedTuple):
    """What is known of two cameras."""

    cameras: tuple[Camera, ...]
    size: tuple[int, int]
    """Width and height of their pictures, pixels."""
    devices: tuple[str, ...]
    """Of each camera, the name under which the computer finds it again (`capture.device_names`)."""


def save_rig(path: Path, rig: Rig, pictures: Sequence[np.ndarray] = ()) -> None:
    """Writes a rig as JSON, and beside it one picture of each camera, by which a person sees which
    one it is.

    Args:
      pictures: of each camera, BGR [H, W, 3]; none for no pictures.
    """
    entries = []
    for camera, device in zip(rig.cameras, rig.devices, strict=True):
        values = {name: value.tolist() for name, value in camera._asdict().items()}
        entries.append({"device": device, **values})
    text = json.dumps({"size": list(rig.size), "cameras": entries}, indent=1)
    path.write_text(text + "\n")
    for number, picture in enumerate(pictures, start=1):
        cv2.imwrite(str(picture_path(path, number)), picture)


def picture_path(path: Path, number: int) -> Path:
    """Where the picture of a rig's first (1) or second (2) camera is."""
    return path.with_name(f"{path.stem}.{number}.png")


def load_rig(path: Path) -> Rig:
    """Reads what `save_rig` wrote.

    Raises:
      UserError: there is no such file, or it is none.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}; write it with two_cameras.py calibrate")
    try:
        saved = json.loads(path.read_text())
        width, height = saved["size"]
        cameras = []
        devices = []
        for entry in saved["cameras"]:
            devices.append(str(entry["device"]))
            values = {name: np.array(entry[name], float) for name in Camera._fields}
            cameras.append(Camera(**values))
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(
            f"{path} is no file of calibrated cameras ({type(error).__name__}: "
            f"{shorten(str(error))}); calibrate them again"
        ) from error
    return Rig(tuple(cameras), (width, height), tuple(devices))
