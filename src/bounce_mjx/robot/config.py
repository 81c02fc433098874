"""Settings of the robot: the adoption of an arm, whose MJCF lacks the paddle and the ball, and the
limits of any robot."""

import math
from pathlib import Path
from typing import Annotated

import pydantic
from pydantic import Field

from bounce_mjx.config import settings

Vector = tuple[settings.Coordinate, settings.Coordinate, settings.Coordinate]
HalfSize = Annotated[settings.Positive, Field(le=1.0)]
# Of a watch's motor to a gantry's drives, in N m and rad or in N and m.
Stiffness = Annotated[settings.Positive, Field(ge=0.1, le=1e7)]
Damping = Annotated[settings.NonNegative, Field(le=1e6)]
Force = Annotated[settings.Positive, Field(ge=0.01, le=1e5)]
Quaternion = tuple[settings.Finite, settings.Finite, settings.Finite, settings.Finite]


class PaddleConfig(settings.StrictModel):
    """The paddle: a box on a handle."""

    half_size: tuple[HalfSize, HalfSize, HalfSize] = (0.05, 0.065, 0.0035)
    """Half-sizes of the blade along its own x, y and z, m; z is the direction that must point
    up."""
    position: Vector = (0.0, 0.0, 0.19)
    """Centre of the blade in the frame of the site, m; the handle runs to it from the site."""
    quaternion: Quaternion = (0.7071067811865476, 0.0, -0.7071067811865476, 0.0)
    """Orientation of the blade in the frame of the site: w, x, y, z."""
    mass: Annotated[settings.Positive, Field(le=20.0)] = 0.1
    """Mass of the blade, kg; the handle has none."""

    @pydantic.model_validator(mode="after")
    def _check_quaternion(self):
        if not any(self.quaternion):
            raise ValueError("the quaternion is 0, which is no orientation; give w, x, y, z")
        return self


class BallConfig(settings.StrictModel):
    """The ball."""

    radius: Annotated[settings.Positive, Field(le=1.0)] = 0.019
    """Radius, m."""
    mass: settings.Positive = 0.0027
    """Mass, kg."""

    @pydantic.model_validator(mode="after")
    def _check_density(self):
        density = self.mass / (4.0 / 3.0 * math.pi * self.radius**3)
        if not 0.5 <= density <= 25_000.0:
            raise ValueError(
                f"a mass of {self.mass:g} kg in a radius of {self.radius:g} m is "
                f"{density:.3g} kg/m^3, but no ball is lighter than 0.5 or heavier than 25,000; "
                "check both units"
            )
        return self


class LimitsConfig(settings.StrictModel):
    """The arm's own limits, one number for each acting joint; those of a slide are in m in place of
    rad. Between two actions the servo targets then move within velocity, acceleration and jerk
    (`robot.setpoints`); without them they jump."""

    velocity: tuple[settings.Speed, ...] | None = None
    """Largest velocity of a joint's command, rad/s; null for no limits of the command."""
    acceleration: tuple[Annotated[settings.Positive, Field(le=1e4)], ...] | None = None
    """Largest acceleration of a joint's command, rad/s^2; needed with velocity."""
    jerk: tuple[Annotated[settings.Positive, Field(le=1e6)], ...] | None = None
    """Largest jerk of a joint's command, rad/s^3; null for none."""
    torque: tuple[Annotated[settings.Positive, Field(ge=0.01, le=1e4)], ...] | None = None
    """Largest torque of each servo, N m, which narrows the MJCF's `forcerange`; null for those of
    the servos. `randomization.torque_limit` narrows it further."""

    @pydantic.model_validator(mode="after")
    def _check_together(self):
        has_velocity = self.velocity is not None
        has_acceleration = self.acceleration is not None
        jerk_alone = self.jerk is not None and not has_acceleration
        if has_velocity != has_acceleration or jerk_alone:
            raise ValueError("velocity or acceleration is missing; give both, or none of the three")
        return self


class RobotConfig(settings.StrictModel):
    """Adoption of an arm whose MJCF has no paddle and no ball; `limits` and
    `gravity_compensation` are of any robot."""

    site: str | None = None
    """Site or body of the arm that holds the paddle; null for an MJCF that is a whole scene."""
    joints: tuple[str, ...] | None = None
    """Acting joints; null for all hinges and slides from the world to the site."""
    paddle: PaddleConfig = PaddleConfig()
    """The paddle of an adopted arm."""
    ball: BallConfig = BallConfig()
    """The ball of an adopted arm."""
    servo_stiffness: tuple[Stiffness, ...] | None = None
    """Stiffness of the position servo that replaces the actuator of each acting joint, N m/rad or
    N/m; null keeps the MJCF's servos. All three settings of the servos are given, or none."""
    servo_damping: tuple[Damping, ...] | None = None
    """Damping of each replaced servo, N m s/rad or N s/m."""
    servo_force_limit: tuple[Force | None, ...] | None = None
    """Force limit of each replaced servo, N m or N; null in a servo's place for no limit."""

    limits: LimitsConfig = LimitsConfig()
    """The arm's own limits, as its manufacturer states them."""

    gravity_compensation: settings.UnitInterval = 0.0
    """Share of each link's weight that the arm's controller carries, so that the servos do not sag
    under it; 0 leaves the MJCF's `gravcomp`."""


NEED_SITE = RobotConfig.model_fields.keys() - {"site", "limits", "gravity_compensation"}
"""Settings that change nothing without a site."""


def is_packaged(mjcf: Path) -> bool:
    """Whether `locate` finds the file by the name of a package."""
    return str(mjcf).startswith(("package:", "menagerie:"))
