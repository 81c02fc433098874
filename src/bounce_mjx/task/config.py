"""Settings of the task."""

import math
from pathlib import Path
from typing import Annotated, Literal

import pydantic
from pydantic import Field

from bounce_mjx.config.settings import Finite, NonNegative, PlainPath, Positive, StrictModel
from bounce_mjx.robot.config import RobotConfig, is_packaged
from bounce_mjx.task.observation import EstimatorConfig, ObservationConfig, ObservationLayout
from bounce_mjx.task.randomization import RandomizationConfig
from bounce_mjx.task.rewards import RewardConfig


class EnvConfig(StrictModel):
    """The task: the model, its time steps, the resets, the bounces, the terminations and the
    reward."""

    physics: Literal["auto", "fused", "mjx"] = "auto"
    """Physics engine: fused (fast, for one kind of model), mjx (any MJCF), auto (fused if it
    supports the model)."""
    mjcf: PlainPath | None = None
    """MJCF file to simulate; null for the project's own robot. package:NAME/FILE is a file of an
    installed Python package, and menagerie:NAME a model of MuJoCo Menagerie."""
    robot: RobotConfig = RobotConfig()
    """Adoption of an arm."""
    physics_dt: Positive = 0.001
    """Physics time step, s."""
    control_dt: Positive = 0.01
    """Time between two actions, s; a whole number of physics steps."""
    episode_seconds: Positive = 20.0
    """Length of an episode before it is truncated, s."""
    action_scale: Positive = 0.02
    """Change of the servo target for an action of 1, rad."""
    default_joint_angles: Annotated[tuple[Finite, ...], Field(min_length=1)] = tuple(
        math.radians(a) for a in (0, 40, 110, 0, -60, 0)
    )
    """Position of each acting joint at a reset, before noise, rad."""
    joint_angle_noise: NonNegative = 0.1
    """Half-width of the uniform noise of the joint angles at a reset, rad."""
    joint_velocity_noise: NonNegative = 0.01
    """Half-width of the uniform noise of the joint velocities at a reset, rad/s."""
    ball_init_pos: tuple[Finite, Finite, Finite] = (0.58856, 0.0, 0.45)
    """Ball position at a reset, before noise, m."""
    ball_position_noise: NonNegative = 0.01
    """Half-width of the uniform noise of each ball coordinate at a reset, m."""
    target_height_range: tuple[float, float] = (0.4, 0.6)
    """Range from which a reset draws the target height, m; equal ends fix it."""
    bounce_min_velocity: NonNegative = 0.01
    """Vertical velocity above which the ball counts as rising, m/s."""
    bounce_max_distance: Positive = 0.12
    """Vertical distance between ball and paddle within which a reversal is a bounce, m."""
    apex_tolerance: NonNegative = 0.1
    """Distance below the target up to which an apex continues the bounce count, m."""
    min_ball_height: Finite = 0.05
    """The episode ends when the ball is below this height, m."""
    max_height_above_target: Positive = 1.0
    """The episode ends when the ball is higher than this above the target height, m."""
    max_horizontal_distance: Positive = 1.5
    """The episode ends when |x| or |y| of the ball exceeds this, m."""
    max_joint_velocity: Positive = 2.0 * math.pi
    """The episode ends when a joint is faster than this, rad/s."""
    observation: ObservationConfig = ObservationConfig()
    """The quantities that the policy sees."""
    estimator: EstimatorConfig = EstimatorConfig()
    """The state estimator between camera and policy."""
    randomization: RandomizationConfig = RandomizationConfig()
    """The world that each episode draws."""
    reward: RewardConfig = RewardConfig()
    """The reward terms."""

    @pydantic.model_validator(mode="after")
    def _check_times_and_ranges(self):
        substeps = self.control_dt / self.physics_dt
        if not max(substeps, self.episode_seconds / self.control_dt) < 2**31:
            raise ValueError(
                f"control_dt {self.control_dt} is too long for physics_dt {self.physics_dt} or too "
                f"short for episode_seconds {self.episode_seconds}; choose times less far apart"
            )
        if round(substeps) < 1 or not math.isclose(substeps, round(substeps), rel_tol=1e-6):
            raise ValueError(
                f"control_dt {self.control_dt} is not a whole number of physics steps of "
                f"{self.physics_dt} s; choose a multiple of physics_dt"
            )
        if self.episode_seconds < self.control_dt:
            raise ValueError(
                f"episode_seconds {self.episode_seconds} is shorter than one control step of "
                f"{self.control_dt} s; choose a longer episode"
            )
        low, high = self.target_height_range
        if not 0.0 < low <= high < math.inf:
            raise ValueError(
                f"target_height_range {self.target_height_range} is not 0 < low <= high; "
                "give two heights in metres, the lower first"
            )
        return self

    @pydantic.field_validator("mjcf")
    @classmethod
    def _make_absolute(cls, path: Path | None) -> Path | None:
        """A run's config is read from other folders too."""
        try:
            if path is None or is_packaged(path):
                return path
            return path.expanduser().absolute()
        except RuntimeError as error:
            raise ValueError(f"{path} is in the home of an unknown user; give a path") from error

    @property
    def num_joints(self) -> int:
        """Number of acting joints, which is the number of actions."""
        return len(self.default_joint_angles)

    @property
    def layout(self) -> ObservationLayout:
        """The order of the entries of the observation."""
        return self.observation.layout(self.num_joints)

    @property
    def target_heights(self) -> tuple[float, float]:
        """Range of all target heights, m."""
        return self.randomization.target_height or self.target_height_range

    @property
    def num_substeps(self) -> int:
        """Physics steps in one control step."""
        return round(self.control_dt / self.physics_dt)

    @property
    def episode_steps(self) -> int:
        """Control steps in one episode."""
        return round(self.episode_seconds / self.control_dt)
