"""The package's version, and its data files: `mjcf/`, `configs/` and `pretrained/`."""

import os
from pathlib import Path

VERSION = "0.1.0"

PRETRAINED = "pretrained"
"""The policy of the default task, bounce, and the folder with all policies."""
ROBUST_POLICIES = ("robust", "robust_small")
"""Policies of the default task for many worlds."""
TASK_POLICIES = ("balance", "catch", "juggle", "track")
"""Tasks with a policy of their name, in addition to the default task's, `PRETRAINED`."""
ARM_POLICIES = ("ur5e", "panda", "iiwa")
"""Arms of configs/robots/ with a policy of their name, of the default task."""
POLICIES = {PRETRAINED: PRETRAINED} | {
    name: f"{PRETRAINED}/{name}" for name in (*ROBUST_POLICIES, *TASK_POLICIES, *ARM_POLICIES)
}
"""The policies that come with the package, and their folders."""

_PACKAGE = Path(__file__).resolve().parent


def resource_path(name: str) -> Path:
    """Path of a data file such as "mjcf/bounce_ball.xml".

    The folders are inside the package in a wheel, and at the top of a source checkout.
    """
    inside = _PACKAGE / name
    # Unlike os.path.exists, Path.exists raises an error for a name that is too long.
    return inside if os.path.exists(inside) else _PACKAGE.parent.parent / name


def policy_folder(name: str | os.PathLike | None) -> Path | None:
    """Folder of a policy of `POLICIES`; None for another name, and where another folder of the
    user has the name."""
    if str(name) not in POLICIES:
        return None
    folder = resource_path(POLICIES[str(name)])
    # In a checkout, `pretrained` is a folder of that name, and the policy's own.
    if os.path.isdir(name) and not os.path.samefile(name, folder):
        return None
    return folder


def policy_path(policy: str | os.PathLike) -> Path:
    """The path of a policy that a user names: that of one of the package, unless there is a folder
    of its name."""
    return policy_folder(policy) or Path(policy)
