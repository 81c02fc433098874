"""Every number that a user may change: the task, its reward, the trainer, the run.

The models are immutable and reject unknown keys and values out of range. The comments beside a
field (its docstring) give the unit; they are also the help text of the command line.
"""

import difflib
import math
import reprlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import pydantic
import yaml
from pydantic import Field

from bounce_mjx.errors import UserError, shorten

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
ArmVector = tuple[Finite, Finite, Finite, Finite, Finite, Finite]
UnitInterval = Annotated[float, Field(ge=0.0, le=1.0)]


def _check_path(path: Path) -> Path:
    if "\0" in str(path):
        raise ValueError("a path cannot hold the character 0; leave it out")
    return path


PlainPath = Annotated[Path, pydantic.AfterValidator(_check_path)]
Count = Annotated[int, Field(ge=1, lt=2**31)]
Steps = Annotated[int, Field(ge=1, le=10**12)]


class StrictModel(pydantic.BaseModel):
    """An immutable, strict group of settings."""

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, validate_default=True
    )


class PositionReward(StrictModel):
    """Horizontal position: stay above the target point, most of all when the ball is near."""

    weight: Finite = 2.0
    """Weight of the term."""
    vertical_scale: Positive = 0.15
    """Decay of the proximity weight with the vertical distance ball-paddle, m."""
    base_scale: Positive = 0.1
    """Width of the Gaussian far from the paddle, m."""
    proximity_gain: NonNegative = 3.0
    """How much wider the Gaussian is at the paddle, as a factor."""


class OutOfPositionReward(StrictModel):
    """Out of position: a smooth penalty for a large horizontal error."""

    weight: Finite = 1.0
    """Weight of the term."""
    magnitude: NonNegative = 2.0
    """Largest penalty."""
    threshold: NonNegative = 0.05
    """Horizontal error at half the penalty, m."""
    scale: Positive = 0.03
    """Width of the sigmoid, m."""


class VelocityMatchingReward(StrictModel):
    """Velocity matching: pass the target height at the desired speed."""

    weight: Finite = 2.0
    """Weight of the term."""
    desired_velocity: Finite = 0.5
    """Vertical velocity wanted at the target height, m/s."""
    near_distance: Positive = 0.05
    """Height error under which the current velocity counts, m."""
    rising_scale: Positive = 0.2
    """Width of the sigmoid between falling and rising, m/s."""
    below_scale: Positive = 0.02
    """Width of the sigmoid between above and below the target, m."""
    near_scale: Positive = 0.01
    """Width of the Gaussian around the target height, m."""
    error_scale: Positive = 0.8
    """Width of the Gaussian of the velocity error, m/s."""


class HeightReward(StrictModel):
    """Height: be near the target height."""

    weight: Finite = 4.5
    """Weight of the term."""
    scale: Positive = 0.15
    """Width of the Gaussian of the height error, m."""


class HeightProgressReward(StrictModel):
    """Height progress: be high at all, so that hitting is found early."""

    weight: Finite = 1.0
    """Weight of the term."""
    base_height: Finite = 0.2
    """Ball height above which the term grows, m."""
    gain: NonNegative = 2.0
    """Reward for each metre above the base height, 1/m."""


class ControlledUpwardReward(StrictModel):
    """Controlled upward velocity: rise at the speed that reaches the target, in position."""

    weight: Finite = 1.5
    """Weight of the term."""
    position_scale: Positive = 0.02
    """Width of the Gaussian of the horizontal error, m."""
    min_ideal_velocity: NonNegative = 0.5
    """Lower limit of the ideal launch velocity, m/s."""
    max_ideal_velocity: NonNegative = 3.0
    """Upper limit of the ideal launch velocity, m/s."""
    velocity_scale: Positive = 0.5
    """Width of the Gaussian of the velocity error, m/s."""
    rising_scale: Positive = 0.1
    """Width of the sigmoid between falling and rising, m/s."""
    velocity_limit: Positive = 1.5
    """Upward velocity above which the term grows no more, m/s."""


class ConsecutiveBouncesReward(StrictModel):
    """Consecutive bounces: the logarithm of the count, in position."""

    weight: Finite = 0.8
    """Weight of the term."""
    gain: NonNegative = 0.5
    """Factor of the logarithm."""
    position_scale: Positive = 0.05
    """Width of the Gaussian of the horizontal error, m."""


class HighBounceCountReward(StrictModel):
    """High bounce count: proportional to the count once it passes the threshold, in position."""

    weight: Finite = 0.3
    """Weight of the term."""
    gain: NonNegative = 0.15
    """Reward per bounce."""
    position_scale: Positive = 0.05
    """Width of the Gaussian of the horizontal error, m."""
    threshold: Finite = 2.0
    """Number of bounces at half the activation."""
    scale: Positive = 0.5
    """Width of the sigmoid, bounces."""


class AlignmentReward(StrictModel):
    """Alignment: keep the paddle under the ball, most of all at the hit."""

    weight: Finite = 0.6
    """Weight of the term."""
    vertical_scale: Positive = 0.1
    """Decay of the proximity weight with the vertical distance ball-paddle, m."""
    scale: Positive = 0.03
    """Width of the Gaussian of the horizontal distance ball-paddle, m."""
    proximity_gain: NonNegative = 2.0
    """Factor of the proximity weight."""
    bounce_boost: NonNegative = 3.0
    """Factor on the step of a bounce."""
    gain: NonNegative = 0.3
    """Overall factor."""


class PaddleHomeReward(StrictModel):
    """Paddle home: return to the home height while the ball is away."""

    weight: Finite = 1.5
    """Weight of the term."""
    scale: Positive = 0.05
    """Width of the Gaussian of the paddle's height error, m."""
    distance_gain: NonNegative = 0.5
    """Extra reward while the ball is far."""
    distance_threshold: Finite = 0.15
    """Vertical distance ball-paddle at half the extra reward, m."""
    distance_scale: Positive = 0.03
    """Width of the sigmoid, m."""


class ExcessiveUpwardReward(StrictModel):
    """Excessive upward velocity: a smooth penalty for a ball hit too hard."""

    weight: Finite = 1.0
    """Weight of the term."""
    magnitude: NonNegative = 1.0
    """Largest penalty."""
    threshold: Finite = 3.5
    """Upward velocity at half the penalty, m/s."""
    scale: Positive = 0.3
    """Width of the sigmoid, m/s."""


class DownwardVelocityReward(StrictModel):
    """Downward velocity: positive for a falling ball as the seed's formula stands, though its
    text calls the term a penalty; a negative weight makes it one."""

    weight: Finite = 1.0
    """Weight of the term; its sign chooses between the seed's formula and the seed's text."""
    gain: NonNegative = 0.3
    """Slope of the clipped factor, s/m."""
    limit: NonNegative = 0.5
    """Upper limit of the clipped factor."""
    threshold: Finite = 0.2
    """Downward speed at half the activation, m/s."""
    scale: Positive = 0.2
    """Width of the sigmoid, m/s."""


class PaddleHeightViolationReward(StrictModel):
    """Paddle height violation: a linear penalty beyond the tolerance around home."""

    weight: Finite = 1.0
    """Weight of the term."""
    gain: NonNegative = 20.0
    """Penalty for each metre beyond the tolerance, 1/m."""
    tolerance: NonNegative = 0.1
    """Height error of the paddle that costs nothing, m."""


class ActionRateReward(StrictModel):
    """Action rate: minus the squared change of the action."""

    weight: Finite = 1e-4
    """Weight of the term."""


class JointVelocityReward(StrictModel):
    """Joint velocity: minus the sum of the squared joint velocities."""

    weight: Finite = 1e-4
    """Weight of the term."""


class RewardConfig(StrictModel):
    """The fifteen reward terms: each a weight and the constants of its formula."""

    position: PositionReward = PositionReward()
    out_of_position: OutOfPositionReward = OutOfPositionReward()
    velocity_matching: VelocityMatchingReward = VelocityMatchingReward()
    height: HeightReward = HeightReward()
    height_progress: HeightProgressReward = HeightProgressReward()
    controlled_upward: ControlledUpwardReward = ControlledUpwardReward()
    consecutive_bounces: ConsecutiveBouncesReward = ConsecutiveBouncesReward()
    high_bounce_count: HighBounceCountReward = HighBounceCountReward()
    alignment: AlignmentReward = AlignmentReward()
    paddle_home: PaddleHomeReward = PaddleHomeReward()
    excessive_upward: ExcessiveUpwardReward = ExcessiveUpwardReward()
    downward_velocity: DownwardVelocityReward = DownwardVelocityReward()
    paddle_height_violation: PaddleHeightViolationReward = PaddleHeightViolationReward()
    action_rate: ActionRateReward = ActionRateReward()
    joint_velocity: JointVelocityReward = JointVelocityReward()
    target_x: Finite = 0.58856
    """Target point of the ball, x, m."""
    target_y: Finite = 0.0
    """Target point of the ball, y, m."""
    paddle_home_height: Finite = 0.05
    """Home height of the paddle, m."""
    gravity: Positive = 9.81
    """Gravity in the ballistic formulas, m/s^2 (the simulated gravity is the MJCF's)."""


class EnvConfig(StrictModel):
    """The task: the model, its time steps, the resets, the bounces, the ends and the reward."""

    physics: Literal["auto", "fused", "mjx"] = "auto"
    """Physics engine: fused (straight-line, fast), mjx (any MJCF), auto (fused where it can)."""
    mjcf: PlainPath | None = None
    """MJCF file to simulate; the project's own robot where it is left out."""
    physics_dt: Positive = 0.001
    """Physics time step, s."""
    control_dt: Positive = 0.01
    """Time between two actions, s; a whole number of physics steps."""
    episode_seconds: Positive = 20.0
    """Length of an episode before it is truncated, s."""
    action_scale: Positive = 0.02
    """Change of the servo target that the action 1 asks for, rad."""
    default_joint_angles: ArmVector = tuple(math.radians(a) for a in (0, 40, 110, 0, -60, 0))
    """Joint angles of a reset before noise, rad."""
    joint_angle_noise: NonNegative = 0.1
    """Half-width of the uniform noise of the joint angles at a reset, rad."""
    joint_velocity_noise: NonNegative = 0.01
    """Half-width of the uniform noise of the joint velocities at a reset, rad/s."""
    ball_init_pos: tuple[Finite, Finite, Finite] = (0.58856, 0.0, 0.45)
    """Ball position of a reset before noise, m."""
    ball_position_noise: NonNegative = 0.01
    """Half-width of the uniform noise of each ball coordinate at a reset, m."""
    target_height_range: tuple[float, float] = (0.4, 0.6)
    """Range from which a reset draws the target height, m; equal ends fix it."""
    bounce_min_velocity: NonNegative = 0.01
    """Vertical velocity above which the ball counts as rising, m/s."""
    bounce_max_distance: Positive = 0.12
    """Vertical distance ball-paddle within which a reversal is a bounce, m."""
    apex_tolerance: NonNegative = 0.1
    """How far below the target an apex may stay and still continue the bounce count, m."""
    min_ball_height: Finite = 0.05
    """The episode ends when the ball is below this height, m."""
    max_height_above_target: Positive = 1.0
    """The episode ends when the ball is higher than this above the target height, m."""
    max_horizontal_distance: Positive = 1.5
    """The episode ends when |x| or |y| of the ball exceeds this, m."""
    max_joint_velocity: Positive = 2.0 * math.pi
    """The episode ends when a joint is faster than this, rad/s."""
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
            return None if path is None else path.expanduser().absolute()
        except RuntimeError as error:
            raise ValueError(f"{path} is in the home of an unknown user; give a path") from error

    @property
    def num_substeps(self) -> int:
        """Physics steps in one control step."""
        return round(self.control_dt / self.physics_dt)

    @property
    def episode_steps(self) -> int:
        """Control steps in one episode."""
        return round(self.episode_seconds / self.control_dt)


class PPOConfig(StrictModel):
    """Proximal policy optimisation (Schulman et al. 2017) with a KL-adaptive learning rate."""

    num_envs: Count = 4096
    """Environments that run in parallel."""
    rollout_length: Count = 32
    """Control steps of each environment in one iteration."""
    num_epochs: Count = 4
    """Passes over the data of one iteration."""
    num_minibatches: Count = 8
    """Minibatches in one epoch; must divide num_envs * rollout_length."""
    learning_rate: Positive = 3e-4
    """Learning rate at the start."""
    min_learning_rate: Positive = 1e-5
    """Lower limit of the learning rate."""
    max_learning_rate: Positive = 3e-3
    """Upper limit of the learning rate at the start of the training."""
    final_max_learning_rate: Positive = 1e-4
    """Upper limit of the learning rate at and after decay_steps."""
    decay_steps: Steps = 20_000_000
    """Environment steps over which the upper limit goes down, in equal ratios."""
    target_kl: NonNegative = 0.01
    """KL divergence of one update that the learning rate is steered to; 0 leaves it as it is."""
    discount: UnitInterval = 0.98
    """Discount factor of a control step."""
    gae_lambda: UnitInterval = 0.95
    """Lambda of the generalised advantage estimation."""
    clip_epsilon: Positive = 0.2
    """Clipping range of the probability ratio."""
    entropy_cost: NonNegative = 0.0
    """Weight of the entropy bonus."""
    value_cost: NonNegative = 0.5
    """Weight of the squared value error."""
    max_grad_norm: Positive = 1.0
    """Global norm to which a gradient is clipped."""
    reward_scale: Positive = 0.1
    """Factor of the reward that the trainer sees."""
    init_noise_std: Positive = 0.4
    """Standard deviation of the action noise at the start."""
    hidden_layers: Annotated[tuple[Count, ...], Field(min_length=1)] = (128, 128)
    """Widths of the hidden layers of the policy and of the value network."""
    compute_dtype: Literal["float32", "bfloat16"] = "float32"
    """Type in which the training computes the hidden layers. Parameters, outputs, losses and the
    optimizer are float32, and so is every evaluation. bfloat16 is faster on a GPU."""
    critic_metrics: tuple[str, ...] = ("n_bounces",)
    """Metrics of the environment that the value network sees beside the observation. The reward
    depends on the bounce count, which the observation lacks."""

    @pydantic.model_validator(mode="after")
    def _check_batch_and_learning_rates(self):
        limits = (self.final_max_learning_rate, self.max_learning_rate)
        if self.min_learning_rate > min(limits):
            raise ValueError(
                f"min_learning_rate {self.min_learning_rate} is above the upper limits "
                f"max_learning_rate {limits[1]} and final_max_learning_rate {limits[0]}; lower it"
            )
        batch = self.num_envs * self.rollout_length
        if batch % self.num_minibatches:
            raise ValueError(
                f"num_minibatches {self.num_minibatches} does not divide the batch of "
                f"{batch} samples (num_envs {self.num_envs} * rollout_length "
                f"{self.rollout_length}); choose a divisor of {batch}"
            )
        return self

    @property
    def batch_steps(self) -> int:
        """Environment steps in one iteration."""
        return self.num_envs * self.rollout_length


class TrainConfig(StrictModel):
    """A training run: the task, the trainer, and how long and how often."""

    env: EnvConfig = EnvConfig()
    """The task."""
    ppo: PPOConfig = PPOConfig()
    """The trainer."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    """Seed of the whole training."""
    num_seeds: Count = 1
    """Independent trainings in one program, from seeds `seed`, `seed` + 1, ...; a folder each."""
    num_devices: Count | None = None
    """Devices that share the environments (with several seeds: the seeds); left out, one, and on
    several hosts all. The training does not depend on it."""
    total_steps: Steps = 50_000_000
    """Environment steps to train for, rounded up to whole blocks."""
    block_steps: Steps = 1_000_000
    """Environment steps between two progress reports, rounded to whole iterations."""
    eval_every: Steps = 2_000_000
    """Environment steps between two evaluations, rounded to whole blocks."""
    eval_episodes: Count = 1024
    """Episodes of an evaluation of the five results."""
    screening_episodes: Annotated[int, Field(ge=0)] = 0
    """Episodes of a cheap first evaluation, which must pass before the full one; 0 for none."""
    eval_seed: Annotated[int, Field(ge=0, lt=2**31)] = 10_000
    """Seed of the evaluations during the training."""
    stop_when_solved: bool = False
    """End at the first evaluation that meets all five results."""
    log_dir: PlainPath = Path("runs/bounce_ball")
    """Folder in which the run makes its own, named by the time."""


ConfigT = TypeVar("ConfigT", bound=StrictModel)


def validate(config_class: type[ConfigT], values: dict[str, Any], source: str) -> ConfigT:
    """Builds a config from plain values.

    Args:
      source: where the values come from, for the error.

    Raises:
      UserError: a key is unknown or a value is out of range.
    """
    try:
        return config_class.model_validate(values)
    except pydantic.ValidationError as error:
        raise UserError(f"{shorten(source)}: {describe(error, config_class)}") from error


_MAX_CONFIG_BYTES = 2**20


def load_config(path: Path) -> TrainConfig:
    """Reads a run's config from a YAML file, missing keys at their defaults.

    Raises:
      UserError: the file is missing, is no YAML mapping, or holds an unknown key or a bad value.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_CONFIG_BYTES + 1)
        if len(data) > _MAX_CONFIG_BYTES:
            raise ValueError(f"it is longer than {_MAX_CONFIG_BYTES} bytes")
        values = yaml.safe_load(data.decode("utf-8"))
    # PyYAML raises many types where a value has the form of a number or a date but is none.
    except Exception as error:
        reason = " ".join((getattr(error, "strerror", None) or str(error) or repr(error)).split())
        raise UserError(
            f"the config file {shorten(str(path))} cannot be read ({shorten(reason, 300)}); give a "
            "YAML file such as configs/default.yaml"
        ) from error
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise UserError(
            f"the config file {shorten(str(path))} holds a {type(values).__name__}, not a mapping "
            "of keys to values; write it like configs/default.yaml"
        )
    return validate(TrainConfig, values, str(path))


def dump_config(config: TrainConfig) -> str:
    """The whole config as YAML, for `load_config`."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def differing_keys(one: StrictModel, other: StrictModel) -> set[str]:
    """Dotted names of the settings in which two configs of one type differ."""
    keys = set()
    for name in type(one).model_fields:
        a, b = getattr(one, name), getattr(other, name)
        if isinstance(a, StrictModel):
            keys |= {f"{name}.{inner}" for inner in differing_keys(a, b)}
        elif a != b:
            keys.add(name)
    return keys


def describe(
    error: pydantic.ValidationError,
    config_class: type[pydantic.BaseModel],
    spell: Callable[[str], str] = str,
) -> str:
    """The first mistake of a validation error as part of a sentence.

    Args:
      spell: how to write the dotted name of a setting.
    """
    first = error.errors()[0]
    if first["type"] in ("extra_forbidden", "invalid_key"):
        path = [shorten(str(part)) for part in first["loc"]]
        return f"unknown key {'.'.join(path)}; {_advice(config_class, path)}"
    path = [part for part in first["loc"] if isinstance(part, str)]
    if first["type"] == "value_error":
        reason = first["msg"].removeprefix("Value error, ")
        return ": ".join([*path[-1:], shorten(reason, 500)])
    return f"{spell('.'.join(path))} is {_quote(first['input'])}, but must {_wanted(error)}"


class _Repr(reprlib.Repr):
    """Python's notation, cut short: a file can describe a value without an end."""

    def __init__(self):
        super().__init__()
        self.maxstring = self.maxother = self.maxlong = 80
        self.maxlevel = 3

    def repr_int(self, x: int, level: int) -> str:
        # Python refuses to write an integer of many digits.
        return super().repr_int(x, level) if x.bit_length() < 1000 else "a very large number"


def _quote(value: Any) -> str:
    """A value of a user, as far as it fits into a sentence."""
    return shorten(_Repr().repr(value))


def _wanted(error: pydantic.ValidationError) -> str:
    """What the first mistake should have been, after "must"."""
    first = error.errors()[0]
    if first["type"] == "missing":
        beside = [e["loc"] for e in error.errors() if e["loc"][:-1] == first["loc"][:-1]]
        return f"have {beside[-1][-1] + 1} items"
    limits = first.get("ctx", {})
    special = {
        "model_type": "be a group of keys and values",
        "path_type": "be a path",
        "too_long": f"have {limits.get('max_length')} items",
        "too_short": f"have at least {limits.get('min_length')} item",
        "tuple_type": "be a list",
    }
    ordinary = first["msg"].removeprefix("Input should ").split(", unable")[0]
    return special.get(first["type"], ordinary)


def _advice(config_class: type[pydantic.BaseModel], path: list[str]) -> str:
    """What to do about an unknown key."""
    known = list(_dotted_keys(config_class))
    prefix = ".".join([*path[:-1], ""])
    beside = {key.removeprefix(prefix).split(".")[0] for key in known if key.startswith(prefix)}
    same_name = [key for key in known if key.split(".")[-1] == path[-1]]
    near = difflib.get_close_matches(path[-1], beside, n=1)
    if near or same_name:
        return f"did you mean {same_name[0] if same_name else prefix + near[0]}?"
    return f"known keys here are {', '.join(sorted(beside))}"


def _dotted_keys(config_class: type[pydantic.BaseModel], prefix: str = "") -> Iterator[str]:
    for name, field in config_class.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, StrictModel):
            yield from _dotted_keys(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name
