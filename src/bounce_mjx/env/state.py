"""The state and the interface of one environment; both match brax's by structure."""

import dataclasses
from typing import Any, Protocol

import jax

from bounce_mjx.task import Task


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """A pytree with the fields of brax's `State`, so that brax's wrappers work on it."""

    pipeline_state: Any
    """Everything that the next step depends on."""
    obs: jax.Array
    """Observation [observation_size]."""
    reward: jax.Array
    """Reward of the last step []."""
    done: jax.Array
    """1 where the last step ended the episode, else 0 []."""
    metrics: dict[str, jax.Array] = dataclasses.field(default_factory=dict)
    """Named numbers of the last step, each []."""
    info: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Data of wrappers, which the environment passes on unchanged."""

    def replace(self, **changes: Any) -> "State":
        """A copy with other values of the named fields."""
        return dataclasses.replace(self, **changes)


class AnyEnv(Protocol):
    """One environment, unbatched and pure: the part of brax's `Env` that training needs, and the
    task, which names what to log."""

    task: Task | type[Task]
    """The task, of which a training run reads `curves` and `critic_metrics`."""

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""

    @property
    def action_size(self) -> int:
        """Length of the action vector."""

    def reset(self, rng: jax.Array) -> State:
        """Starts an episode; consumes the key `rng`."""

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step under the action [action_size]."""
