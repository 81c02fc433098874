"""Batched environments with time limits; an ended episode is reset within the step that ends it.

Internally the batch is the last axis of every array, so that the physics works on contiguous
coordinates. Observations [B, N] and actions [B, A] have the batch first.
"""

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from bounce_mjx.env.env import State
from bounce_mjx.task import Task


class AnyEnv(Protocol):
    """One environment, unbatched and pure: the part of brax's `Env` that training needs, and the
    task, which names what to log. One with a randomisation has `warmup_steps`, `ranges` and the
    `ranges` of a reset too, as `Env`."""

    task: Task | type[Task]
    """The task, of which training reads `curves` and `critic_metrics`; both may be empty."""

    observation_size: int
    """Length of the observation vector."""
    action_size: int
    """Length of the action vector."""

    def reset(self, rng: jax.Array) -> State:
        """Starts an episode; consumes the key `rng`."""

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step under the action [action_size]."""


class VectorState(NamedTuple):
    """State of a batch of B environments."""

    env: State
    """Environment states, the batch last in every array."""
    clock: jax.Array
    """Steps that count towards the time limit [B], int: from 0 at a reset, or from any number, so
    that the episodes of a training do not all end at once. It is not a `noise.Clock`."""
    length: jax.Array
    """Steps since the reset [B], int."""
    episode_return: jax.Array
    """Sum of the rewards since the reset [B]."""


class VectorStep(NamedTuple):
    """Result of one step of B environments."""

    observation: jax.Array
    """Observation for the next action [B, N]; after the end of an episode, the first observation of
    the new one."""
    final_observation: jax.Array
    """Observation after the step, before any reset [B, N]; at the end of an episode, its last
    observation."""
    reward: jax.Array
    """Reward of the step [B]."""
    terminated: jax.Array
    """Whether the episode ended otherwise than by the time limit [B], bool."""
    truncated: jax.Array
    """Whether only the time limit ended the episode [B], bool."""
    metrics: dict[str, jax.Array]
    """The environment's metrics of the step, each [B]."""
    episode_return: jax.Array
    """Return of the episode up to this step [B]."""
    episode_length: jax.Array
    """Length of the episode up to this step [B], int."""


def reset(env: AnyEnv, key: jax.Array, num_envs: int, ranges: Any = None) -> VectorState:
    """Starts episodes.

    Args:
      env: the environment.
      key: consumed.
      num_envs: number of episodes, B.
      ranges: ranges of the randomisation; None for the environment's own.
    """
    states = first_states(env, key, num_envs, ranges)
    return VectorState(
        env=states,
        clock=jnp.zeros(num_envs, jnp.int32),
        length=jnp.zeros(num_envs, jnp.int32),
        episode_return=jnp.zeros_like(states.reward),
    )


def first_states(env: AnyEnv, key: jax.Array, num_envs: int, ranges: Any = None) -> State:
    """Environment states at the start of episodes, the batch last.

    Args:
      env: the environment.
      key: consumed.
      num_envs: number of episodes, B.
      ranges: ranges of the randomisation; None for the environment's own.
    """

    def first_state(key: jax.Array) -> State:
        # Other environments have no ranges.
        return env.reset(key) if ranges is None else env.reset(key, ranges)

    return jax.vmap(first_state, out_axes=-1)(jax.random.split(key, num_envs))


def ranges_after(env: AnyEnv, count: jax.Array | None, steps_each: int) -> Any:
    """Ranges of the randomisation after `count` [] times `steps_each` environment steps, which grow
    over its warm-up; None, the environment's own, for one without a warm-up, where `count` may be
    None too."""
    warmup_steps = getattr(env, "warmup_steps", 0)
    if not warmup_steps:
        return None
    return env.ranges(jnp.minimum(1.0, count * (steps_each / warmup_steps)))


def observe(state: VectorState) -> jax.Array:
    """Observations [B, N]."""
    return state.env.obs.T


def step(
    env: AnyEnv,
    state: VectorState,
    action: jax.Array,
    key: jax.Array | None,
    episode_steps: int,
    ranges: Any = None,
    fresh: State | None = None,
) -> tuple[VectorState, VectorStep]:
    """Advances every environment, and resets every ended episode with a new sample.

    Args:
      env: the environment.
      state: before the step.
      action: [B, A].
      key: consumed by the resets; None with `fresh`.
      episode_steps: time limit of an episode in steps.
      ranges: ranges of the randomisation; None for the environment's own.
      fresh: result of `first_states`, which replaces the states of ended episodes, instead of a
        sample with `key`; one sample for many steps costs less. An environment that ends twice with
        the same `fresh` starts twice alike.
    """
    if fresh is None:
        fresh = first_states(env, key, state.clock.shape[0], ranges)
    stepped = jax.vmap(env.step, in_axes=-1, out_axes=-1)(state.env, action.T)
    clock = state.clock + 1
    length = state.length + 1
    episode_return = state.episode_return + stepped.reward
    terminated = stepped.done > 0
    truncated = (clock >= episode_steps) & ~terminated
    ended = terminated | truncated

    env_state = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, stepped)
    next_state = VectorState(
        env=env_state,
        clock=jnp.where(ended, 0, clock),
        length=jnp.where(ended, 0, length),
        episode_return=jnp.where(ended, 0.0, episode_return),
    )
    return next_state, VectorStep(
        observation=env_state.obs.T,
        final_observation=stepped.obs.T,
        reward=stepped.reward,
        terminated=terminated,
        truncated=truncated,
        metrics=stepped.metrics,
        episode_return=episode_return,
        episode_length=length,
    )
