"""Robustness of a policy: its five results in every condition of a suite."""

import json
import os
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from pydantic import Field

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.c_episodes import make_mujoco_evaluator
from bounce_mjx.evaluation.config import DEFAULT_CONDITION_EPISODES, DEFAULT_SEED, Physics
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import judge
from bounce_mjx.evaluation.suite import Condition, neutral_range
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy, make_networks
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import RandomizationConfig, Ranges

# Terms without a neutral value, or with a high cost in the physics: only the conditions that need
# such a term are simulated with it.
_SEPARATE_TERMS = frozenset(
    ("camera_rate", "contact_friction", "torque_limit", "joint_frictionloss")
)
# Episodes in one call: larger batches are not faster and would delay the progress report.
_CPU_BATCH, _GPU_BATCH, _MUJOCO_BATCH_PER_CORE = 1024, 16_384, 128


class Outcome(pydantic.BaseModel):
    """Five results of a policy in one condition."""

    perturbation: str
    group: str
    unit: str
    strength: float | None
    trained: bool
    """Whether the training ranges of the policy contain the condition."""
    physics: Literal["fused", "mjx", "mujoco"]
    """Name of the engine."""
    values: dict[str, float | None]
    """The five results by name; None if there was nothing to measure."""
    failed: list[str]
    """Names of results that miss their bounds."""
    mean_length_s: float
    """Mean length of the episodes, s."""

    @property
    def passed(self) -> bool:
        """Whether every judged result meets its bound."""
        return not self.failed


class RobustnessReport(pydantic.BaseModel):
    """Results of a policy in all conditions: the content of `robustness.json`."""

    checkpoint: str
    steps: int
    """Number of environment steps in the policy's training."""
    suite: str
    episodes: int
    """Number of episodes in each condition."""
    seed: int
    outcomes: Annotated[list[Outcome], Field(min_length=1, max_length=10_000)]

    @property
    def passed(self) -> bool:
        """Whether all conditions meet all judged results."""
        return all(outcome.passed for outcome in self.outcomes)

    @property
    def engines(self) -> dict[str, set[str]]:
        """Perturbations simulated by each engine."""
        return {
            engine: {o.perturbation for o in self.outcomes if o.physics == engine}
            for engine in {outcome.physics for outcome in self.outcomes}
        }

    @property
    def met(self) -> int:
        """Number of conditions that meet all judged results."""
        return sum(outcome.passed for outcome in self.outcomes)


def measure_conditions(
    policy: Policy,
    ppo_config: PPOConfig,
    conditions: Sequence[Condition],
    *,
    episodes: int = DEFAULT_CONDITION_EPISODES,
    seed: int = DEFAULT_SEED,
    physics: Physics = "config",
    progress: Callable[[int], None] = lambda done: None,
) -> list[Outcome]:
    """Measures the five results of a deterministic policy, in the order of the conditions.

    One compiled program simulates all conditions with the same structure; their ranges are its
    inputs. The episodes of all conditions start from the same keys. In place of the mjx engine,
    which refuses dry friction, MuJoCo's C engine simulates it.

    Args:
      ppo_config: config of the policy's training; it defines the networks.
      episodes: number of episodes in each condition.
      physics: engine; "mujoco" is MuJoCo's C engine, "config" the choice in the config.
      progress: callback for the number of finished conditions.

    Raises:
      UserError: the engine does not support the model.
    """
    programs = defaultdict(list)
    for index, condition in enumerate(conditions):
        key = json.dumps(condition.env.model_dump(mode="json"))
        programs[key, _SEPARATE_TERMS.intersection(condition.ranges)].append(index)
    outcomes: list[Outcome | None] = [None] * len(conditions)
    done = 0
    for (_, separate), indices in programs.items():
        members = [conditions[index] for index in indices]
        env = Env(_spanning_config(members, physics))
        dry_in_mjx = env.engine.name == "mjx" and "joint_frictionloss" in separate
        on_c = physics == "mujoco" or dry_in_mjx
        networks = make_networks(ppo_config, env.observation_size, env.action_size)
        size = _batch_size(len(members), episodes, on_c)
        make = make_mujoco_evaluator if on_c else make_evaluator
        evaluate = make(env, networks, size * episodes)
        for start in range(0, len(members), size):
            batch = members[start : start + size]
            # Padding the last call with a repeated condition avoids compiling another shape.
            padded = batch + [batch[-1]] * (size - len(batch))
            statistics = evaluate(policy, jax.random.PRNGKey(seed), _stacked_ranges(env, padded))
            for i, condition in enumerate(batch):
                own = slice(i * episodes, (i + 1) * episodes)
                episode_statistics = jax.tree.map(lambda x, own=own: x[own], statistics)
                report = judge(env, episode_statistics, condition.target_heights)
                outcomes[indices[start + i]] = Outcome(
                    perturbation=condition.perturbation.name,
                    group=condition.perturbation.group,
                    unit=condition.perturbation.unit,
                    strength=condition.strength,
                    trained=condition.trained,
                    physics="mujoco" if on_c else env.engine.name,
                    values={result.name: result.value for result in report.results},
                    failed=[r.name for r in report.results if r.passed is False],
                    mean_length_s=report.details["mean_length_s"],
                )
            done += len(batch)
            progress(done)
    return outcomes


def _spanning_config(conditions: Sequence[Condition], physics: Physics) -> WorldConfig:
    """Task with all terms of the conditions active, in ranges that contain all their ranges."""
    env = conditions[0].env
    spans = {}
    for name in sorted({name for condition in conditions for name in condition.ranges}):
        ranges = [_range(condition, name) for condition in conditions]
        spans[name] = (
            min(float(np.min(low)) for low, _ in ranges),
            max(float(np.max(high)) for _, high in ranges),
        )
    changes = {"randomization": RandomizationConfig(**spans)}
    if physics in ("fused", "mjx"):
        changes["physics"] = physics
    return env.model_copy(update=changes)


def _range(condition: Condition, term: str) -> tuple[np.ndarray, np.ndarray]:
    given = condition.ranges.get(term)
    return neutral_range(term, condition.env) if given is None else given


def _stacked_ranges(env: Env, conditions: Sequence[Condition]) -> Ranges | None:
    """Ranges of C conditions, each end [C, ...]; None if no term is active."""
    terms = env.config.randomization.terms
    return {
        name: tuple(
            jnp.asarray(np.stack(ends), jnp.float32)
            for ends in zip(*(_range(condition, name) for condition in conditions), strict=True)
        )
        for name in terms
    } or None


def _batch_size(conditions: int, episodes: int, on_c: bool) -> int:
    """Number of conditions in one call; calls have about equal sizes."""
    accelerated = jax.default_backend() != "cpu"
    batch = _GPU_BATCH if accelerated else _CPU_BATCH
    if on_c:
        batch = _MUJOCO_BATCH_PER_CORE * (os.cpu_count() or 1)
    calls = -(-conditions // max(1, batch // episodes))
    return -(-conditions // calls)
