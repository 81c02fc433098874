"""The data files that come with the package: `mjcf/`, `configs/` and `pretrained/`."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def resource_path(name: str) -> Path:
    """Path of a data file such as "mjcf/bounce_ball.xml".

    A wheel carries the folders inside the package; in a source checkout they stand at its top.
    """
    inside = _PACKAGE / name
    return inside if inside.exists() else _PACKAGE.parent.parent / name
