"""The benchmark's figures of a policy, which still rank policies that meet all expected results."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pydantic

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.config import EvaluationOptions
from bounce_mjx.evaluation.episodes import begin, reset_episodes, run_until
from bounce_mjx.evaluation.results import episodes_of
from bounce_mjx.evaluation.robustness import ConditionOutcome, measure_conditions
from bounce_mjx.evaluation.statistics import Statistics
from bounce_mjx.evaluation.suite import load_suite, neutral_commands
from bounce_mjx.interrupt import in_daemon_thread
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.resources import resource_path
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import RandomizationConfig

MOST_HITS = 10_000
"""Hits after which an episode without a time limit ends."""
MOST_SECONDS = 20_000.0
"""Longest episode without a time limit, s."""
HIT_EPISODES, TIMED_EPISODES = 16, 256
"""Episodes without a time limit, and those of a task that counts no hits."""
MIN_STABLE = 0.99
"""Share of the episodes that last within a policy's limits."""
LIMITS = {"latency_ms": "action latency", "push_m_s": "push every 2 s"}
"""The figures that are limits, and their perturbations in configs/robustness_limits.yaml."""


class Figures(pydantic.BaseModel):
    """Figures of one policy; None for one that its task does not have."""

    suite_met: int
    """Conditions of the robustness suite that meet all judged results."""
    suite_conditions: int
    """Conditions of the suite that are for the policy."""
    latency_ms: float
    """Largest latency of the actions up to which `MIN_STABLE` of the episodes last, ms."""
    push_m_s: float
    """Largest push every 2 s up to which `MIN_STABLE` of the episodes last, m/s."""
    hits: float | None = None
    """Median of the hits until the ball is lost, at most `MOST_HITS`."""
    ranking: dict[str, float | None] = {}
    """The task's own figures (`Task.ranking`)."""


def measure(
    policy: Policy | None,
    actor: Callable[[Env], Actor],
    trained: WorldConfig,
    options: EvaluationOptions,
    progress: Callable[[float], None] = lambda share: None,
) -> Figures:
    """The figures of a policy, in the nominal world where no condition changes it.

    Args:
      actor: what acts with the policy, such as the networks of its training (`networks_of`).
      trained: config of the policy's training.
      options: episodes in each condition, their seed and the engine.
      progress: called with the share of the work that is done, from 0 to 1.
    """
    suite, limits = (
        load_suite(resource_path(f"configs/{name}.yaml"), trained)
        for name in ("robustness", "robustness_limits")
    )
    conditions = [*suite, *limits]
    share = 0.8 / len(conditions)
    # The few long episodes leave most of a CPU idle.
    nominal = in_daemon_thread(lambda: measure_nominal(policy, actor, trained, options.seed))
    outcomes = measure_conditions(
        policy, actor, conditions, options, lambda done: progress(share * done)
    )
    hits, ranking = nominal.result()
    of_suite, of_limits = outcomes[: len(suite)], outcomes[len(suite) :]
    figures = {
        "suite_met": sum(outcome.passed for outcome in of_suite),
        "suite_conditions": len(suite),
        **{key: largest_stable(of_limits, name) for key, name in LIMITS.items()},
    }
    progress(1.0)
    return Figures(**figures, hits=hits, ranking=ranking)


def largest_stable(outcomes: Sequence[ConditionOutcome], perturbation: str) -> float:
    """The largest strength of a perturbation up to which the episodes last; 0 if there is none."""
    largest = 0.0
    for outcome in outcomes:
        if outcome.perturbation == perturbation:
            if outcome.lasted < MIN_STABLE:
                break
            largest = outcome.strength
    return largest


def measure_nominal(
    policy: Policy | None, actor: Callable[[Env], Actor], trained: WorldConfig, seed: int
) -> tuple[float | None, dict[str, float | None]]:
    """The median of the hits of a task that counts them, and the task's ranking, in the nominal
    world: in episodes without a time limit, or in episodes of the usual length without hits."""
    env = Env(trained.model_copy(update={"randomization": RandomizationConfig()}))
    acting, commands, hits = actor(env), neutral_commands(trained), env.task.hits
    ranges = {name: (jnp.array([low]), jnp.array([high])) for name, (low, high) in commands.items()}
    # A ball that rests on the paddle is never lost.
    most_steps = int(MOST_SECONDS / env.dt) if hits else env.config.episode_steps

    def lasts(statistics: Statistics) -> jax.Array | bool:
        return statistics.tally.sums[hits] < MOST_HITS if hits else True

    @jax.jit
    def run(policy: Policy | None, key: jax.Array) -> Statistics:
        states = reset_episodes(env, key, HIT_EPISODES if hits else TIMED_EPISODES, ranges or None)

        begun = begin(env, states, recorded=0)
        return run_until(env, acting, policy, begun, most_steps, lasts).statistics

    statistics = run(policy, jax.random.PRNGKey(seed))
    statistics = jax.tree.map(lambda x: jax.device_get(x).astype(float), statistics)
    counted = float(np.median(statistics.tally.sums[hits])) if hits else None
    return counted, env.task.ranking(episodes_of(env, statistics, commands))
