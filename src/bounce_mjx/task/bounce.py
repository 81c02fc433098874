"""Bouncing: the arm keeps a ball bouncing on the paddle at a chosen height.

It is the task of the original specification: its settings, bounces, reward, ends and observation.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import pydantic
from pydantic import Field

from bounce_mjx import task
from bounce_mjx.config import settings
from bounce_mjx.errors import UserError
from bounce_mjx.lazy import jax, jnp, np
from bounce_mjx.task.bounce_rewards import RewardInputs, Rewards

SETTLING_SECONDS = 2.0
"""Time at the start of an episode that does not count for the horizontal position and the height,
s. For the height, the same time after a change of the target does not count either."""

MAX_X_ERROR = 0.05
"""Largest distance of a centred ball from the target point along x, m."""

MAX_APEX_ERROR = 0.1
"""Largest distance of an accurate apex from the target height, m."""

MIN_CONSECUTIVE_BOUNCES = 3
"""Least number of bounces in a row, once in an episode."""

MIN_EPISODE_SHARE = 0.99
"""Minimum share of episodes with enough consecutive bounces, and of stable episodes."""

MIN_STEP_SHARE = 0.95
"""Minimum share of centred steps, and of accurate bounces."""

UPWARD_SPEED_RANGE = (0.1, 1.5)
"""Bounds of the mean upward speed, m/s."""

UPWARD_SPEED_TARGETS = (0.4, 0.6)
"""Target heights at which the upward speed is judged, m, for a paddle with the home height
`HOME_HEIGHT`; another home height shifts them."""

OFFERED_TARGETS = (0.3, 0.8)
"""Target heights that a viewer offers, m, for a paddle with the home height `HOME_HEIGHT`."""

MIN_TARGET_HEIGHT = 1e-3
"""Least target height, m."""

HOME_HEIGHT = 0.05
"""Home height of the original specification, m."""


class Observation(task.ObservationConfig):
    """The quantities that the policy sees, and how many values of each: 0 for none, 1 for the
    newest, N for the last N, the newest first."""

    target_height: Annotated[task.History, task.Quantity(1, "m", "goal")] = 1
    """Target height."""
    apex_error: Annotated[task.History, task.Quantity(1, "m")] = 0
    """Highest measured ball position minus the target height, of the flights before the last
    bounces: with its sign, unlike the metric of this name."""
    bounce_position: Annotated[task.History, task.Quantity(2, "m")] = 0
    """Measured horizontal position of the ball at the lowest point of the last bounces."""
    bounce_interval: Annotated[task.History, task.Quantity(1, "s")] = 0
    """Time between the last bounces; of the first one, since the reset."""
    bounce_joint_angles: Annotated[task.History, task.Quantity(None, "rad")] = 0
    """Measured joint angles at the lowest points of the last bounces."""
    bounce_joint_velocities: Annotated[task.History, task.Quantity(None, "rad/s")] = 0
    """Measured joint velocities at the lowest points of the last bounces."""


class Config(task.WorldConfig):
    """The world, and the task of bouncing: target heights, bounces, ends and reward."""

    target_height_range: settings.Range[settings.Length] = (0.4, 0.6)
    """Range of the target height, m; equal ends fix it."""
    bounce_min_velocity: Annotated[settings.NonNegative, Field(le=10.0)] = 0.01
    """Vertical velocity above which the ball counts as rising, m/s."""
    bounce_max_distance: Annotated[settings.Positive, Field(le=1.0)] = 0.12
    """Vertical distance between ball and paddle within which a reversal is a bounce, m."""
    apex_tolerance: settings.Distance = 0.1
    """Distance below the target up to which an apex continues the bounce count, m."""
    min_ball_height: settings.Coordinate = 0.05
    """The episode ends when the ball is below this height, m."""
    max_height_above_target: settings.Length = 1.0
    """The episode ends when the ball is higher than this above the target height, m."""
    max_horizontal_distance: Annotated[settings.Positive, Field(le=20.0)] = 1.5
    """The episode ends when |x| or |y| of the ball exceeds this, m."""
    observation: Observation = Observation()
    """The quantities that the policy sees."""
    reward: Rewards = Rewards()
    """The reward terms."""

    @pydantic.model_validator(mode="after")
    def _check_start(self):
        """An episode does not end where it starts."""
        try:
            task.check_within(self.limits, [self.ball_init_pos], self.targets, "ball_init_pos")
        except UserError as error:
            raise ValueError(str(error)) from error
        return self

    @classmethod
    def settings_at(cls, paddle: tuple[float, float, float]) -> dict[str, Any]:
        """The heights follow the paddle; the reach stays what it is beyond the paddle's home."""
        default = cls()
        x, y, z = paddle
        reward = default.reward
        lift = z - reward.paddle_home_height
        lowest_target, highest_target = default.target_height_range
        beyond = default.max_horizontal_distance - reward.target_x
        base_height = reward.height_progress.base_height + lift
        return super().settings_at(paddle) | {
            "target_height_range": [
                round(lowest_target + lift, 4),
                round(highest_target + lift, 4),
            ],
            "min_ball_height": round(default.min_ball_height + lift, 4),
            "max_horizontal_distance": round(max(abs(x), abs(y)) + beyond, 4),
            "reward": {
                "target_x": x,
                "target_y": y,
                "paddle_home_height": z,
                "height_progress": {"base_height": round(base_height, 4)},
            },
        }

    @property
    def heights(self) -> dict[str, float]:
        return super().heights | {"target_height_range": self.target_height_range[0]}

    @property
    def limits(self) -> task.Limits:
        return (
            task.Limit("min_ball_height", "lowest", self.min_ball_height),
            task.Limit("max_height_above_target", "above", self.max_height_above_target),
            task.Limit("max_horizontal_distance", "aside", self.max_horizontal_distance),
        )

    @property
    def targets(self) -> tuple[tuple[float, float, float], ...]:
        x, y, _ = self.ball_init_pos
        lowest, highest = self.target_height_range
        return (x, y, lowest), (x, y, highest)

    @property
    def ball_bounds(self) -> tuple[float, float]:
        """What an exported policy takes for possible: where an episode ends, and twice the speed of
        a fall from its greatest height."""
        top = self.target_height_range[1] + self.max_height_above_target
        aside = self.max_horizontal_distance
        farthest = math.hypot(aside, aside, top)
        fall_speed = math.sqrt(2.0 * task.GRAVITY * top)
        return farthest, 2.0 * fall_speed

    @property
    def goals(self) -> dict[str, task.Goal]:
        """The target height."""
        lowest, highest = self.target_height_range
        lowest_offered, highest_offered = OFFERED_TARGETS
        heights = task.target_heights(self.limits, start=self.ball_init_pos[2])
        return {
            "target_height": task.Goal(
                lowest,
                highest,
                "m",
                least=max(MIN_TARGET_HEIGHT, heights.least),
                span=(
                    round(lowest_offered + self.home_lift, 4),
                    round(highest_offered + self.home_lift, 4),
                ),
                setting="target_height_range",
                reason=heights.reason,
            )
        }

    @property
    def home_lift(self) -> float:
        """Height of the paddle's home over that of the specification, m."""
        return self.reward.paddle_home_height - HOME_HEIGHT


class State(NamedTuple):
    """What the task keeps of an episode."""

    rising: jax.Array
    """Whether the ball moved upward after the last step [], bool."""
    n_bounces: jax.Array
    """Consecutive bounces [], float."""
    apex: jax.Array
    """Highest ball position since the last bounce [], m."""


class MeasuredFlight(NamedTuple):
    """What the measurements tell of the present flight."""

    apex: jax.Array
    """Highest measured position since the ball was last near the paddle [], m."""
    is_low: jax.Array
    """Whether the ball was measured near the paddle [], bool."""
    lowest: jax.Array
    """Lowest measured position while the ball is near the paddle [], m."""
    time: jax.Array
    """Time since the last bounce began, with a first measurement near the paddle [], s."""


class Bounce(task.Task):
    """The ball bounces on the paddle at the target height."""

    Config = Config
    config: Config
    folder = "bounce_ball"
    ball_rests = False
    ball_thrown = False
    curves = (
        task.Curve(
            "episode/bounces_at_end", "n_bounces", "episodes", "bounces in a row at its end"
        ),
        task.Curve(
            "task/apex_error", "apex_error", "bounced", "|apex − target height|", 100.0, "cm"
        ),
        task.Curve(
            "task/apex_offset", "apex_offset", "bounced", "apex − target height", 100.0, "cm"
        ),
        task.Curve("task/ball_xy_error", "ball_xy_error", scale=100.0, unit="cm"),
        task.Curve("task/bounces_so_far", "n_bounces"),
    )
    critic_metrics = ("n_bounces",)

    # The start, and a control step: bounce, reward, ends, metrics.

    def reset(self, start: task.Start) -> State:
        """No bounce yet; the first apex is the height at which the ball starts."""
        height = start.truth.ball_position[2]
        return State(
            rising=jnp.zeros((), bool),
            n_bounces=jnp.zeros_like(height),
            apex=height,
        )

    def step(self, state: State, step: task.Step) -> task.TaskStep:
        """A bounce or none, the specification's reward, and whether the ball fell, flew too high or
        too far."""
        config = self.config
        truth = step.truth
        ball = truth.ball_position
        target = step.goal["target_height"]
        after, bounced = self.detect(state, step)
        inputs = RewardInputs(
            ball_position=ball,
            ball_velocity=truth.ball_velocity,
            paddle_position=truth.paddle_position,
            target_height=target,
            n_bounces=after.n_bounces,
            bounced=bounced,
            action=step.action,
            last_action=step.last_action,
            joint_velocity=truth.joint_velocities,
            reward=config.reward,
            goal=step.goal,
        )
        apex_offset = state.apex - target
        target_point = jnp.stack([ball[0], ball[1], target])
        return task.TaskStep(
            state=after,
            reward=task.weighted_terms(config.reward, inputs),
            ended=task.is_beyond(config.limits, ball, target_point),
            metrics={
                "bounced": bounced,
                "n_bounces": after.n_bounces,
                "ball_xy_error": inputs.err_xy,
                # Without a sign; the offset has one.
                "apex_error": jnp.where(bounced, jnp.abs(apex_offset), 0.0),
                "apex_offset": jnp.where(bounced, apex_offset, 0.0),
            },
        )

    def detect(self, state: State, step: task.Step) -> tuple[State, jax.Array]:
        """Detects a bounce and counts it.

        A bounce is the first step on which the ball rises, near the paddle. It adds to the count if
        the apex before it was above the target height minus the tolerance; otherwise the count
        restarts at 1, which is also the count after the first bounce of an episode.

        Returns:
          The new state, and whether this step is a bounce [] (bool).
        """
        config = self.config
        truth = step.truth
        height = truth.ball_position[2]
        rising = truth.ball_velocity[2] > config.bounce_min_velocity
        near = jnp.abs(height - truth.paddle_position[2]) < config.bounce_max_distance
        bounced = rising & ~state.rising & near
        continues = state.apex > step.goal["target_height"] - config.apex_tolerance
        counted = jnp.where(continues, state.n_bounces + 1.0, 1.0)
        after = State(
            rising=rising,
            n_bounces=jnp.where(bounced, counted, state.n_bounces),
            apex=jnp.where(bounced, height, jnp.maximum(state.apex, height)),
        )
        return after, bounced

    # The observation: the last bounces, from the measurements.

    def first_quantities(self, measured: task.Values) -> tuple[MeasuredFlight, task.Values]:
        """Before the first bounce, its quantities are those of the start. Here all are returned,
        also those that the policy does not see."""
        ball = measured["ball_position"]
        height = ball[2]
        zero = jnp.zeros_like(height)
        flight = MeasuredFlight(
            apex=height,
            is_low=jnp.zeros((), bool),
            lowest=height,
            time=zero,
        )
        of_no_flight = {"apex_error": zero[None], "bounce_interval": zero[None]}
        return flight, _at_bounce(measured, ball) | of_no_flight

    def next_quantities(
        self, memory: MeasuredFlight, histories: task.Values, measured: task.Values
    ) -> tuple[MeasuredFlight, task.Values]:
        """A measured bounce starts when the ball is first measured near the paddle, or under it.
        Its position and joints are taken at the ball's lowest measured point.

        `ball_picture` is the measured `ball_position`, by the name of that input of an exported
        policy: read as `ball_position`, it would change the input's name.
        """
        height = measured["ball_picture"][2]
        is_low = height < measured["paddle_position"][2] + self.config.bounce_max_distance
        starts = is_low & ~memory.is_low
        at_lowest = starts | (is_low & (height < memory.lowest))
        time = memory.time + self.config.control_dt
        flight = MeasuredFlight(
            apex=jnp.where(is_low, height, jnp.maximum(memory.apex, height)),
            is_low=is_low,
            lowest=jnp.where(at_lowest, height, memory.lowest),
            time=jnp.where(starts, 0.0, time),
        )
        of_last_flight = {
            "apex_error": memory.apex - measured["target_height"],
            "bounce_interval": time[None],
        }
        of_bounce = _at_bounce(measured, measured["ball_picture"])
        new_histories = {}
        for name, history in histories.items():
            if name in of_last_flight:
                newest = of_last_flight[name]
                changes = starts
            else:
                newest = of_bounce[name]
                changes = at_lowest
            new_histories[name] = task.latest(history, newest, is_new=starts, changes=changes)
        return flight, new_histories

    # The results.

    def tally(self, moment: task.Moment) -> task.Tally:
        """Bounces, centred steps, apexes and the speed of the rising ball."""
        metrics = moment.metrics
        bounced = metrics["bounced"] > 0
        x = moment.truth.ball_position[0]
        vz = moment.truth.ball_velocity[2]
        # Between two steps, so that rounding does not decide.
        settling = SETTLING_SECONDS + 0.5 * self.config.control_dt
        settled = moment.seconds > settling
        judged = bounced & (moment.goal_seconds > settling)
        centred = jnp.abs(x - self.config.reward.target_x) <= MAX_X_ERROR
        accurate = metrics["apex_error"] <= MAX_APEX_ERROR
        return task.Tally(
            sums={
                "settled_steps": settled,
                "centred_steps": settled & centred,
                "settled_bounces": judged,
                "accurate_bounces": judged & accurate,
                "apex_error": jnp.where(judged, metrics["apex_error"], 0.0),
                # For comparisons of policies (benchmarks/rank.py), as are the hits.
                "apex_error^2": jnp.where(judged, jnp.square(metrics["apex_error"]), 0.0),
                "apex_offset": jnp.where(judged, metrics["apex_offset"], 0.0),
                "hits": bounced,
                "rising_steps": vz > 0.0,
                "rising_speed": jnp.maximum(vz, 0.0),
            },
            maxima={"n_bounces": metrics["n_bounces"]},
        )

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        """The five results of the specification."""
        sums = episodes.sums
        in_row = episodes.maxima["n_bounces"] >= MIN_CONSECUTIVE_BOUNCES
        return (
            task.share_of_episodes(
                "consecutive bounces",
                f"episodes with at least {MIN_CONSECUTIVE_BOUNCES} in a row",
                in_row,
                MIN_EPISODE_SHARE,
            ),
            task.share_of_events(
                "horizontal position",
                f"steps with |x error| <= {MAX_X_ERROR} m",
                sums["centred_steps"],
                sums["settled_steps"],
                MIN_STEP_SHARE,
            ),
            task.share_of_events(
                "height",
                f"bounces with |apex error| <= {MAX_APEX_ERROR} m",
                sums["accurate_bounces"],
                sums["settled_bounces"],
                MIN_STEP_SHARE,
            ),
            task.mean_of_events(
                "upward speed",
                "mean velocity of the rising ball, m/s",
                sums["rising_speed"],
                sums["rising_steps"],
                UPWARD_SPEED_RANGE,
                self._upward_speed_condition(episodes),
            ),
            task.share_of_episodes(
                "stable",
                f"episodes that last the full {self.config.episode_seconds:g} s",
                episodes.lasted,
                MIN_EPISODE_SHARE,
            ),
        )

    def _upward_speed_condition(self, episodes: task.Episodes) -> str:
        """The condition of the upward speed's bounds, in words, if the episodes do not meet it."""
        # Rounded, as a config has the heights of another arm with four digits.
        lift = self.config.home_lift
        lowest = round(UPWARD_SPEED_TARGETS[0] + lift, 4)
        highest = round(UPWARD_SPEED_TARGETS[1] + lift, 4)
        lowest_target, highest_target = episodes.goals["target_height"]
        if lowest <= lowest_target and highest_target <= highest:
            return ""
        return f"targets {lowest} to {highest} only"

    def details(self, episodes: task.Episodes) -> dict[str, task.Figure]:
        """The mean bounce count and apex error."""
        sums = episodes.sums
        error, _ = task.mean_and_margin(sums["apex_error"], sums["settled_bounces"])
        return {
            "mean_consecutive_bounces": float(episodes.maxima["n_bounces"].mean()),
            "mean_apex_error_m": error,
        }

    # What is shown.

    def plots(self, recording: task.Recording) -> tuple[task.Histogram | task.Hits, ...]:
        """Apex errors, and where the ball hits the paddle, of the bounces that the result `height`
        judges."""
        bounced = (recording.metrics["bounced"] > 0) & recording.running
        bounces = bounced & self._has_settled(recording.goal["target_height"])
        errors = 100.0 * recording.metrics["apex_offset"][bounces]
        return (
            task.Histogram(
                "apex minus target height, cm", "bounces", errors, bound=100.0 * MAX_APEX_ERROR
            ),
            task.Hits("hits on the paddle, cm", bounces),
        )

    def _has_settled(self, target_heights: np.ndarray) -> np.ndarray:
        """Whether more than `SETTLING_SECONDS` have passed since the reset and since each change of
        the target height [T, K], bool.

        Args:
          target_heights: after each step of K episodes [T, K], m.
        """
        steps = np.arange(len(target_heights))[:, None]
        is_new = np.diff(target_heights, axis=0, prepend=target_heights[:1]) != 0.0
        # The reset is before the first step.
        last_change = np.maximum.accumulate(np.where(is_new, steps, -1), axis=0)
        return steps - last_change > round(SETTLING_SECONDS / self.config.control_dt)

    def markers(self, goal: dict[str, float], metrics: Any) -> tuple[task.Marker, ...]:
        """A disc at the target height, and the outline of the paddle's home."""
        home = self.focus()
        x, y, _ = home
        return (
            task.Marker(
                "target_height",
                position=(x, y, goal["target_height"]),
                size=(0.05, 0.001, 0.0),
                rgba=(0.15, 0.9, 0.3, 0.4),
                shape="cylinder",
            ),
            task.Marker(
                "paddle_home",
                position=home,
                size=(0.05, 0.065, 0.001),
                rgba=(0.15, 0.45, 1.0, 0.9),
                shape="frame",
            ),
        )

    def readings(self, goal: dict[str, float], metrics: dict[str, float]) -> dict[str, str]:
        """Bounces in a row, and the target height."""
        return {
            "bounces": f"{metrics['n_bounces']:.0f}",
            "target": f"{goal['target_height']:.2f} m",
        }

    def focus(self) -> tuple[float, float, float]:
        """The paddle's home."""
        reward = self.config.reward
        return reward.target_x, reward.target_y, reward.paddle_home_height


def _at_bounce(measured: task.Values, ball: jax.Array) -> task.Values:
    """The measured quantities of a bounce at a ball's position [3], m."""
    return {
        "bounce_position": ball[:2],
        "bounce_joint_angles": measured["joint_angles"],
        "bounce_joint_velocities": measured["joint_velocities"],
    }
