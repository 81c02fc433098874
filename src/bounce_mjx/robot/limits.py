"""Limits of a model file, checked before MuJoCo opens it: MuJoCo waits for a pipe forever, and adds
any number of parts."""

import math
import os
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco

from bounce_mjx.errors import UserError

MAX_PARTS = 3000
"""Bodies and geoms; MuJoCo takes seconds to read more."""
_MAX_FILE_SIZE = 128 * 2**20
_COPYING = ("replicate", "composite", "flexcomp")


def check_files(mjcf: Path) -> None:
    """Checks an MJCF file and every file that it names.

    Raises:
      UserError: a file is a pipe or a device, or too large; or there are too many parts.
    """
    parts, read, unread = 0, set(), [mjcf]
    while unread:
        path = unread.pop()
        _check_file(path, mjcf)
        if path in read:
            continue
        read.add(path)
        try:
            root = ElementTree.parse(path).getroot()
        except (OSError, ValueError, ElementTree.ParseError):
            continue  # MuJoCo tells what is wrong with it.
        parts += _count_parts(root)
        nested = [element for element in root.iter() if element.tag in ("include", "model")]
        unread += [mjcf.parent / element.get("file", "") for element in nested]
    if parts > MAX_PARTS:
        raise UserError(
            f"the MJCF file {mjcf} has {parts} bodies and geoms; give a model with at most "
            f"{MAX_PARTS}"
        )
    try:
        files = mujoco.mju_getXMLDependencies(str(mjcf))
    except mujoco.FatalError:
        return
    for file in files:
        _check_file(Path(file), mjcf)


def _check_file(path: Path, mjcf: Path) -> None:
    # Unlike Path.exists, os.path.exists raises no error for a name that is too long.
    if not os.path.exists(path) or os.path.isdir(path):
        return
    if not os.path.isfile(path) or os.path.getsize(path) > _MAX_FILE_SIZE:
        raise UserError(
            f"the MJCF file {mjcf} names {path}, which is a pipe, a device, or larger than "
            f"{_MAX_FILE_SIZE // 2**20} MiB; give a smaller, regular file"
        )


def _count_parts(root: ElementTree.Element) -> int:
    """Bodies and geoms, with the copies that MuJoCo makes."""
    count, unread = 0, [(root, 1)]
    while unread:
        element, copies = unread.pop()
        if element.tag in _COPYING:
            copies *= math.prod(int(n) for n in re.findall(r"\d{1,9}", element.get("count", "1")))
        count += copies * (element.tag in ("body", "geom"))
        unread += [(child, copies) for child in element]
    return count
