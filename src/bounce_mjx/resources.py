"""The data files that come with the package: `mjcf/`, `configs/` and `pretrained/`."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def resource_path(name: str) -> Path:
    """Path of a data file such as "mjcf/bounce_ball.xml".

    The folders are inside the package in a wheel, and at the top of a source checkout.
    """
    inside = _PACKAGE / name
    return inside if inside.exists() else _PACKAGE.parent.parent / name
