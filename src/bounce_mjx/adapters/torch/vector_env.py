"""Batched environments for PyTorch: `env/vector.py` with tensors.

Tensors and arrays share their memory through DLPack, on the CPU and on CUDA. The host never waits
for the device, because DLPack makes each library's stream wait for the other's. The state is
donated to the next step, so a step returns no view of it.
"""

import copy
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import torch

from bounce_mjx.adapters.torch.packing import Layout
from bounce_mjx.env import vector
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.learning.metrics import matching_metrics, step_metrics
from bounce_mjx.tasks.registry import DEFAULT, task_config


class StepResult(NamedTuple):
    """Result of one step of B environments, as tensors that share one block of memory with JAX's
    array."""

    observation: torch.Tensor
    """Observation for the next action [B, N]; after the end of an episode, the first observation of
    the new one."""
    critic_metrics: torch.Tensor
    """The value network's additional inputs at the same instant [B, K]."""
    final_observation: torch.Tensor
    """Observation after the step, before any reset [B, N]; at the end of an episode, its last
    observation."""
    final_critic_metrics: torch.Tensor
    """The critic's metrics of `final_observation` [B, K]."""
    reward: torch.Tensor
    """Scaled reward [B]."""
    terminated: torch.Tensor
    """Whether the task ended the episode [B], bool."""
    truncated: torch.Tensor
    """Whether only the time limit ended the episode [B], bool."""
    done: torch.Tensor
    """Whether the episode ended [B], bool."""
    metrics: torch.Tensor
    """Means and sums over the batch [M], named by `TorchVectorEnv.metric_names`."""


class TorchVectorEnv:
    """B environments; an ended episode is reset within the step that ends it."""

    def __init__(
        self,
        env: Env | None = None,
        num_envs: int = 4096,
        *,
        seed: int = 0,
        critic_metrics: tuple[str, ...] | None = None,
        reward_scale: float = 1.0,
    ):
        """Compiles nothing; the first calls of `reset` and `step` do.

        Args:
          env: the task; None for the default one.
          seed: seed of all resets.
          critic_metrics: names of the metrics that are additional inputs of the value network;
            a pattern such as world/* names many; None for the task's own.
          reward_scale: factor of the rewards.

        Raises:
          UserError: torch cannot use JAX's device, or a metric is unknown.
        """
        self.env = env or Env(task_config(DEFAULT)())
        self.num_envs = num_envs
        self.num_observations = self.env.observation_size
        self.num_actions = self.env.action_size
        self.episode_steps = self.env.config.episode_steps
        self.device = _shared_device()
        self._reward_scale = reward_scale
        self._key = jax.random.PRNGKey(seed)
        if critic_metrics is None:
            critic_metrics = self.env.task.critic_metrics
        metrics = jax.eval_shape(self.env.reset, self._key).metrics
        self.critic_metrics = matching_metrics(critic_metrics, metrics)
        action = jax.ShapeDtypeStruct((num_envs, self.num_actions), jnp.float32)
        carried = jax.eval_shape(self._start, self._key)[0]
        _, result = jax.eval_shape(self._advance, carried, action)
        self.metric_names = tuple(result.metrics)
        metrics = jax.ShapeDtypeStruct((len(self.metric_names),), jnp.float32)
        self._carried_layout = Layout(carried)
        self._result_layout = Layout(result._replace(metrics=metrics))
        self._jit_start = jax.jit(self._packed_start)
        self._jit_step = jax.jit(self._packed_step, donate_argnums=0)
        self._block: jax.Array | None = None

    def reset(self, seed: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Starts a new episode in every environment; a `seed` seeds all following resets. It draws
        other episodes than the same seed of Gymnasium's environments, which have a stream of random
        numbers each.

        Returns:
          The observations [B, N] and the critic metrics [B, K].
        """
        if seed is not None:
            self._key = jax.random.PRNGKey(seed)
        self._key, key = jax.random.split(self._key)
        self._block, observation, critic_metrics = self._jit_start(key)
        return torch.from_dlpack(observation), torch.from_dlpack(critic_metrics)

    def step(self, action: torch.Tensor) -> StepResult:
        """Advances every environment.

        Args:
          action: [B, A], float32, on the environments' device; clipped to [-1, 1]. Do not change
            it in place before the first use of this step's observation.

        Raises:
          UserError: the action has another shape, type or device, or `reset` was never called.
        """
        if (
            action.dtype is not torch.float32
            or action.device != self.device
            or action.shape != (self.num_envs, self.num_actions)
        ):
            raise UserError(
                f"the action is {action.dtype} {tuple(action.shape)} on {action.device}, but must "
                f"be torch.float32 {(self.num_envs, self.num_actions)} on {self.device}; convert it"
            )
        if self._block is None:
            raise UserError("step was called before reset; call reset first")
        shared = jax.dlpack.from_dlpack(action.detach().contiguous())
        self._block, result = self._jit_step(self._block, shared)
        return self._result_layout.views(torch.from_dlpack(result))

    def sibling(self, seed: int) -> "TorchVectorEnv":
        """The same number of other environments, which share the compiled programs.

        Args:
          seed: seed of the resets.
        """
        other = copy.copy(self)
        other._key, other._block = jax.random.PRNGKey(seed), None
        return other

    @property
    def state(self) -> np.ndarray:
        """Everything that the next step needs, as one block [W], int32. Reading it gives a copy; it
        can be assigned."""
        if self._block is None:
            self.reset()
        return np.array(self._block)

    @state.setter
    def state(self, value: np.ndarray) -> None:
        self._block = jnp.array(value)

    @property
    def clock(self) -> torch.Tensor:
        """Steps of each episode that count towards its time limit [B], int32; a copy. Assign
        different values to spread the time-outs of episodes that began together."""
        # A copy, because the next step reuses the state's memory.
        return torch.from_dlpack(jnp.copy(self._carried().vector.clock))

    @clock.setter
    def clock(self, value: torch.Tensor) -> None:
        clock = jax.dlpack.from_dlpack(value.to(self.device, torch.int32).contiguous())
        carried = self._carried()
        self._block = self._carried_layout.pack(
            carried._replace(vector=carried.vector._replace(clock=clock))
        )

    def _carried(self) -> "_Carried":
        if self._block is None:
            self.reset()
        return self._carried_layout.unpack(self._block)

    def _start(self, key: jax.Array) -> tuple["_Carried", jax.Array, jax.Array]:
        key, reset_key = jax.random.split(key)
        steps = jnp.int32(0) if self.env.warmup_steps else None
        ranges = vector.ranges_after(self.env, steps, self.num_envs)
        state = vector.reset(self.env, reset_key, self.num_envs, ranges)
        return (
            _Carried(_slim(state), key, steps),
            vector.observe(state),
            self._critic_metrics(state.env.metrics),
        )

    def _packed_start(self, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        carried, observation, critic_metrics = self._start(key)
        return self._carried_layout.pack(carried), observation, critic_metrics

    def _packed_step(self, block: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        carried, result = self._advance(self._carried_layout.unpack(block), action)
        metrics = jnp.concatenate([result.metrics[name] for name in self.metric_names])
        result = result._replace(metrics=metrics)
        return self._carried_layout.pack(carried), self._result_layout.pack(result)

    def _advance(self, carried: "_Carried", action: jax.Array) -> tuple["_Carried", StepResult]:
        """The next inputs, and the result as JAX's arrays; its metrics are a dictionary."""
        key, reset_key = jax.random.split(carried.key)
        steps = None if carried.steps is None else carried.steps + 1
        ranges = vector.ranges_after(self.env, steps, self.num_envs)
        state, result = vector.step(
            self.env, carried.vector, action, reset_key, self.episode_steps, ranges
        )
        arrays = StepResult(
            observation=result.observation,
            critic_metrics=self._critic_metrics(state.env.metrics),
            final_observation=result.final_observation,
            final_critic_metrics=self._critic_metrics(result.metrics),
            reward=self._reward_scale * result.reward,
            terminated=result.terminated,
            truncated=result.truncated,
            done=result.terminated | result.truncated,
            metrics=step_metrics(result, 1, self.env.task.curves),
        )
        return _Carried(_slim(state), key, steps), arrays

    def _critic_metrics(self, metrics: dict[str, jax.Array]) -> jax.Array:
        """The critic metrics [B, K]."""
        columns = [metrics[name] for name in self.critic_metrics]
        return jnp.stack(columns, axis=-1) if columns else jnp.zeros((self.num_envs, 0))


class _Carried(NamedTuple):
    """Inputs of the next step in addition to the action."""

    vector: vector.VectorState
    key: jax.Array
    steps: jax.Array | None
    """Steps since the last reset of all environments [], int32; None without a warm-up."""


def _slim(state: vector.VectorState) -> vector.VectorState:
    """The state without the fields that no step reads."""
    return state._replace(env=state.env.replace(obs=None, reward=None, done=None, metrics={}))


def _shared_device() -> torch.device:
    """The torch device of JAX's default device."""
    device = jax.devices()[0]
    if device.platform == "gpu" and not torch.cuda.is_available():
        raise UserError(
            f"JAX computes on {device.device_kind}, but this PyTorch has no CUDA; install a "
            "PyTorch with CUDA, or start with JAX_PLATFORMS=cpu"
        )
    try:
        return torch.from_dlpack(jnp.zeros(1)).device
    except Exception as error:
        raise UserError(
            f"PyTorch cannot use the memory of JAX's {device.platform} device "
            f"({str(error).splitlines()[0]}); start with JAX_PLATFORMS=cpu"
        ) from error
