"""The benchmark's figures of a policy, which still rank policies that meet all expected results."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pydantic

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.config import EvaluationOptions
from bounce_mjx.evaluation.episodes import reset_episodes
from bounce_mjx.evaluation.policy_evaluation import evaluate_policy
from bounce_mjx.evaluation.robustness import ConditionOutcome, measure_conditions
from bounce_mjx.evaluation.suite import load_suite, neutral_commands
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.resources import resource_path
from bounce_mjx.tasks.bounce import SETTLING_SECONDS, Bounce
from bounce_mjx.tasks.track import Track
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import RandomizationConfig

MOST_HITS = 10_000
"""Hits after which an episode of `measure_hits` ends."""
HIT_EPISODES = 16
"""Episodes of `measure_hits`."""
MIN_STABLE = 0.99
"""Share of the episodes that last within a policy's limits."""
LIMITS = {"latency_ms": "action latency", "push_m_s": "push every 2 s"}
"""The figures that are limits, and their perturbations in configs/benchmark.yaml."""


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
    apex_rms_cm: float | None = None
    """Root mean square of apex minus target height, cm."""
    apex_bias_cm: float | None = None
    """Mean of apex minus target height, cm."""
    moving_cm: float | None = None
    """RMS distance of apex and moving point at 0.25 to 0.3 m/s, cm."""


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
        for name in ("robustness", "benchmark")
    )
    conditions = [*suite, *limits]
    share = 0.8 / len(conditions)
    outcomes = measure_conditions(
        policy, actor, conditions, options, lambda done: progress(share * done)
    )
    of_suite, of_limits = outcomes[: len(suite)], outcomes[len(suite) :]
    figures = {
        "suite_met": sum(outcome.passed for outcome in of_suite),
        "suite_conditions": len(suite),
        **{key: largest_stable(of_limits, name) for key, name in LIMITS.items()},
    }
    world = trained.model_copy(update={"randomization": RandomizationConfig()})
    if issubclass(trained.task, Bounce):
        figures |= measure_hits(policy, actor, world, options.seed)
    if issubclass(trained.task, Track):
        report = evaluate_policy(policy, trained, actor, options._replace(nominal=True)).report
        (figures["moving_cm"],) = (r.value for r in report.results if r.name == "fast error")
    progress(1.0)
    return Figures(**figures)


def largest_stable(outcomes: Sequence[ConditionOutcome], perturbation: str) -> float:
    """The largest strength of a perturbation up to which the episodes last; 0 if there is none."""
    largest = 0.0
    for outcome in outcomes:
        if outcome.perturbation == perturbation:
            if outcome.lasted < MIN_STABLE:
                break
            largest = outcome.strength
    return largest


def measure_hits(
    policy: Policy | None, actor: Callable[[Env], Actor], world: WorldConfig, seed: int
) -> dict[str, float | None]:
    """The figures of bouncing without a time limit: hits, and apexes after the first seconds."""
    env = Env(world)
    acting = actor(env)
    settled = round(SETTLING_SECONDS / env.dt)
    ranges = {
        name: (jnp.array([low]), jnp.array([high]))
        for name, (low, high) in neutral_commands(world).items()
    }

    @jax.jit
    def run(policy: Policy | None, key: jax.Array) -> tuple[jax.Array, ...]:
        def advance(carry):
            states, alive, hits, sums, step = carry
            actions = acting.act(policy, states.obs.T).T
            before, states = states, jax.vmap(env.step, in_axes=-1, out_axes=-1)(states, actions)
            hit = alive & (states.metrics["bounced"] > 0)
            now = before.pipeline_state
            error = jnp.where(
                hit & (step >= settled), now.task.apex - now.command["target_height"], 0.0
            )
            sums += jnp.stack([hit & (step >= settled), error, jnp.square(error)])
            hits += hit
            return states, alive & (states.done == 0) & (hits < MOST_HITS), hits, sums, step + 1

        states = reset_episodes(env, key, HIT_EPISODES, ranges)
        start = jnp.ones(HIT_EPISODES, bool), jnp.zeros(HIT_EPISODES), jnp.zeros((3, HIT_EPISODES))
        # A ball that rests on the paddle is never lost.
        most = jnp.int32(2 * MOST_HITS / env.dt)
        carry = states, *start, jnp.int32(0)
        end = jax.lax.while_loop(lambda c: jnp.any(c[1]) & (c[4] < most), advance, carry)
        return end[2], end[3]

    hits, sums = jax.device_get(run(policy, jax.random.PRNGKey(seed)))
    count, error, square = sums.astype(float).sum(axis=1)
    return {
        "hits": float(np.median(hits)),
        "apex_rms_cm": 100.0 * float(np.sqrt(square / count)) if count else None,
        "apex_bias_cm": 100.0 * float(error / count) if count else None,
    }
