"""The five expected results: how they are measured, judged and shown."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.evaluation.recording import Recording
from bounce_mjx.task.env import BounceBall
from bounce_mjx.task.state import State

DEFAULT_EPISODES = 1024


DEFAULT_SEED = 20_000


SETTLING_SECONDS = 2.0


MIN_CONSECUTIVE_BOUNCES = 3


MAX_X_ERROR = 0.05


MAX_APEX_ERROR = 0.1


MIN_EPISODE_SHARE = 0.99


MIN_STEP_SHARE = 0.95


UPWARD_SPEED_RANGE = (0.1, 1.5)


UPWARD_SPEED_TARGETS = (0.4, 0.6)


class Statistics(NamedTuple):
    """Sums over the steps of E episodes, each up to its end."""

    running: jax.Array
    """Whether the episode has not ended [E], bool."""
    steps: jax.Array
    """Steps of the episode [E]."""
    episode_return: jax.Array
    """[E]."""
    max_bounces: jax.Array
    """Largest bounce count of the episode [E]."""
    settled_steps: jax.Array
    """Steps after the settling time [E]."""
    centred_steps: jax.Array
    """Those of them with the ball's x near the target point [E]."""
    settled_bounces: jax.Array
    """Bounces after the settling time [E]."""
    accurate_bounces: jax.Array
    """Those of them whose apex was near the target height [E]."""
    apex_error: jax.Array
    """Sum of |apex - target height| over the settled bounces [E], m."""
    rising_steps: jax.Array
    """Steps on which the ball rose [E]."""
    rising_speed: jax.Array
    """Sum of the vertical velocity over them [E], m/s."""


class Result(NamedTuple):
    """One expected result."""

    name: str
    measured: str
    """What was measured, with its unit."""
    value: float | None
    """None where there was nothing to measure, such as the height without a bounce."""
    bound: str
    passed: bool | None
    """None where the bound does not apply."""


class Report(NamedTuple):
    """An evaluation."""

    results: tuple[Result, ...]
    details: dict[str, float | None]
    """Further figures: episodes, mean_consecutive_bounces, mean_apex_error_m, mean_return and
    mean_length_s; None where there was nothing to measure."""
    recording: Recording | None = None
    """Some of the episodes, where they were recorded."""

    @property
    def passed(self) -> bool:
        """Whether no result failed."""
        return all(result.passed is not False for result in self.results)

    @property
    def score(self) -> tuple[int, float]:
        """Order of quality: the number of results met, then the mean return."""
        met = sum(result.passed is not False for result in self.results)
        return met, self.details["mean_return"]

    @classmethod
    def from_dict(cls, plain: dict) -> "Report":
        """The report of `to_dict`."""
        return cls(tuple(Result(**result) for result in plain["results"]), plain["details"])

    def to_dict(self) -> dict:
        """The report as plain data, for JSON."""
        return {
            "passed": self.passed,
            "results": [result._asdict() for result in self.results],
            "details": self.details,
        }


def empty_statistics(episodes: int) -> Statistics:
    """Statistics before the first step."""
    zeros = jnp.zeros(episodes)
    return Statistics(jnp.ones(episodes, bool), *[zeros] * (len(Statistics._fields) - 1))


def accumulate(
    env: BounceBall, statistics: Statistics, states: State, step: jax.Array
) -> Statistics:
    """Adds one control step of E environments (batch last) to their statistics.

    It reads the true state and not the observation, which may be noisy.

    Args:
      states: after the step.
      step: its index [], from 0.
    """
    s, metrics = statistics, states.metrics
    running = s.running
    settled = running & (step >= round(SETTLING_SECONDS / env.dt))
    kinematics = jax.vmap(env.kinematics, in_axes=-1, out_axes=-1)(states.pipeline_state)
    x, vz = kinematics.ball_position[0], kinematics.ball_velocity[2]
    centred = jnp.abs(x - env.config.reward.target_x) <= MAX_X_ERROR
    bounced = settled & (metrics["bounced"] > 0)
    accurate = metrics["apex_error"] <= MAX_APEX_ERROR
    rising = running & (vz > 0.0)
    return Statistics(
        running=running & (states.done == 0),
        steps=s.steps + running,
        episode_return=s.episode_return + jnp.where(running, states.reward, 0.0),
        max_bounces=jnp.maximum(s.max_bounces, jnp.where(running, metrics["n_bounces"], 0.0)),
        settled_steps=s.settled_steps + settled,
        centred_steps=s.centred_steps + (settled & centred),
        settled_bounces=s.settled_bounces + bounced,
        accurate_bounces=s.accurate_bounces + (bounced & accurate),
        apex_error=s.apex_error + jnp.where(bounced, metrics["apex_error"], 0.0),
        rising_steps=s.rising_steps + rising,
        rising_speed=s.rising_speed + jnp.where(rising, vz, 0.0),
    )


def judge(env: BounceBall, statistics: Statistics) -> Report:
    """The five expected results of SPEC.md from the statistics of the episodes."""
    s = jax.tree.map(lambda x: jax.device_get(x).astype(float), statistics)
    episodes = len(s.running)
    enough_bounces = float((s.max_bounces >= MIN_CONSECUTIVE_BOUNCES).mean())
    centred = _ratio(s.centred_steps.sum(), s.settled_steps.sum())
    accurate = _ratio(s.accurate_bounces.sum(), s.settled_bounces.sum())
    stable = float(s.running.mean())
    results = (
        _share_result(
            "consecutive bounces",
            f"episodes with at least {MIN_CONSECUTIVE_BOUNCES} in a row",
            enough_bounces,
            MIN_EPISODE_SHARE,
        ),
        _share_result(
            "horizontal position",
            f"steps with |x error| <= {MAX_X_ERROR} m",
            centred,
            MIN_STEP_SHARE,
        ),
        _share_result(
            "height", f"bounces with |apex error| <= {MAX_APEX_ERROR} m", accurate, MIN_STEP_SHARE
        ),
        _speed_result(
            _ratio(s.rising_speed.sum(), s.rising_steps.sum()), env.config.target_height_range
        ),
        _share_result(
            "stable",
            f"episodes of {env.config.episode_seconds:g} s without an end",
            stable,
            MIN_EPISODE_SHARE,
        ),
    )
    details = {
        "episodes": float(episodes),
        "mean_consecutive_bounces": float(s.max_bounces.mean()),
        "mean_apex_error_m": _ratio(s.apex_error.sum(), s.settled_bounces.sum()),
        "mean_return": float(s.episode_return.mean()),
        "mean_length_s": float(s.steps.mean() * env.dt),
    }
    return Report(results, details)


def _share_result(name: str, measured: str, share: float | None, minimum: float) -> Result:
    """A share of all episodes, steps or bounces; a share of none fails."""
    return Result(
        name,
        f"{measured}, %",
        None if share is None else 100.0 * share,
        f">= {100 * minimum:g}",
        share is not None and share >= minimum,
    )


def _speed_result(speed: float | None, target_height_range: tuple[float, float]) -> Result:
    """The upward speed, which is judged only for targets between `UPWARD_SPEED_TARGETS`."""
    low, high = UPWARD_SPEED_RANGE
    bound = f"{low} to {high}"
    lowest, highest = UPWARD_SPEED_TARGETS
    judged = lowest <= target_height_range[0] and target_height_range[1] <= highest
    passed = speed is not None and low <= speed <= high
    return Result(
        "upward speed",
        "mean velocity of the rising ball, m/s",
        speed,
        bound if judged else f"{bound} (targets {lowest} to {highest} only)",
        passed if judged else None,
    )


def _ratio(total: float, count: float) -> float | None:
    """A mean or a share; None of nothing."""
    return float(total / count) if count else None
