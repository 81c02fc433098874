"""Batched environments for PyTorch: `env/vector.py` with tensors.

Tensors and arrays share their memory through DLPack, on the CPU and on CUDA. The host never waits
for the device, because DLPack makes each library's stream wait for the other's. The state is
donated to the next step, so a step returns no view of it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import torch

from bounce_mjx.adapters.torch.packing import Layout
from bounce_mjx.config.validation import checked_count
from bounce_mjx.env import vector
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.learning.metrics import matching_metrics


class StepResult(NamedTuple):
    """Result of one step of B environments, as tensors in one block of memory."""

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
    """Means over the batch [M] of the environment's metrics, named by
    `TorchVectorEnv.metric_names`."""


class TorchVectorEnv:
    """B environments in PyTorch; an ended episode is reset within the step that ends it."""

    def __init__(
        self,
        env: Env,
        num_envs: int = 4096,
        *,
        seed: int = 0,
        critic_metrics: tuple[str, ...] | None = None,
        reward_scale: float = 1.0,
    ):
        """Compiles nothing; the first calls of `reset` and `step` do.

        Args:
          env: such as from `environment`.
          seed: seed of all resets.
          critic_metrics: names of the metrics that are additional inputs of the value network;
            a pattern such as world/* names many; None for the task's own.
          reward_scale: factor of the rewards.

        Raises:
          UserError: torch cannot use JAX's device, or a metric or num_envs is wrong.
        """
        self.core = env
        self.num_envs = checked_count("num_envs", num_envs)
        self.num_observations = self.core.observation_size
        self.num_actions = self.core.action_size
        self.device = _shared_device()
        self._reward_scale = reward_scale
        self._key = _committed_key(seed)
        if critic_metrics is None:
            critic_metrics = self.core.task.critic_metrics
        metrics = jax.eval_shape(self.core.reset, self._key).metrics
        self.critic_metrics = matching_metrics(critic_metrics, metrics)
        self.metric_names = tuple(metrics)
        action = jax.ShapeDtypeStruct((num_envs, self.num_actions), jnp.float32)
        steps = jnp.int32(0) if self.core.warmup_steps else None
        carried, *_ = jax.eval_shape(self._start, self._key, steps)
        _, result = jax.eval_shape(self._step, carried, action)
        self._carried_layout = Layout(carried)
        self._result_layout = Layout(result)
        self._jit_start = jax.jit(self._packed_start)
        self._jit_step = jax.jit(self._packed_step, donate_argnums=0)
        self._block: jax.Array | None = None

    @property
    def episode_steps(self) -> int:
        """Time limit of an episode in steps: that of the environment's config."""
        return self.core.config.episode_steps

    def reset(self, seed: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Starts a new episode in every environment; a `seed` seeds all following resets. It
        samples other episodes than the same seed of Gymnasium's environments, which have a stream
        of random numbers each.

        The ranges of a randomisation with a warm-up go on growing; a `seed` begins them anew, too.

        Returns:
          The observations [B, N] and the critic metrics [B, K].
        """
        steps = jnp.int32(0) if self.core.warmup_steps else None
        if seed is not None:
            self._key = _committed_key(seed)
        elif self._block is not None:
            steps = self._carried().steps
        self._key, key = jax.random.split(self._key)
        self._block, observation, critic_metrics = self._jit_start(key, steps)
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

    @property
    def clock(self) -> torch.Tensor:
        """Steps of each episode that count towards its time limit [B], int32; a copy. Assign
        different values to spread the time-outs of episodes that began together.

        Raises:
          UserError: the values have another shape, or `reset` was never called.
        """
        # A copy, because the next step reuses the state's memory.
        return torch.from_dlpack(jnp.copy(self._carried().state.clock))

    @clock.setter
    def clock(self, value: torch.Tensor) -> None:
        if value.shape != (self.num_envs,):
            raise UserError(
                f"the clock has the shape {tuple(value.shape)}, but must have {(self.num_envs,)}, "
                "a number of steps for each environment"
            )
        clock = jax.dlpack.from_dlpack(value.to(self.device, torch.int32, copy=True).contiguous())
        carried = self._carried()
        state = carried.state._replace(clock=clock)
        self._block = self._carried_layout.pack(carried._replace(state=state))

    def _carried(self) -> "_Carried":
        if self._block is None:
            raise UserError("the clock was asked for before reset; call reset first")
        return self._carried_layout.unpack(self._block)

    def _start(
        self, key: jax.Array, steps: jax.Array | None
    ) -> tuple["_Carried", jax.Array, jax.Array]:
        key, reset_key = jax.random.split(key)
        ranges = vector.ranges_after(self.core, steps, self.num_envs)
        state = vector.reset(self.core, reset_key, self.num_envs, ranges)
        critic_metrics = self._critic_metrics(state.env.metrics)
        return _Carried(_slim(state), key, steps), vector.observe(state), critic_metrics

    def _packed_start(
        self, key: jax.Array, steps: jax.Array | None
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        carried, observation, critic_metrics = self._start(key, steps)
        return self._carried_layout.pack(carried), observation, critic_metrics

    def _packed_step(self, block: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        carried, result = self._step(self._carried_layout.unpack(block), action)
        return self._carried_layout.pack(carried), self._result_layout.pack(result)

    def _step(self, carried: "_Carried", action: jax.Array) -> tuple["_Carried", StepResult]:
        key, reset_key = jax.random.split(carried.key)
        steps = None if carried.steps is None else carried.steps + 1
        ranges = vector.ranges_after(self.core, steps, self.num_envs)
        state, result = vector.step(
            self.core, carried.state, action, reset_key, self.episode_steps, ranges
        )
        metrics = jnp.stack([result.metrics[name] for name in self.metric_names])
        arrays = StepResult(
            observation=result.observation,
            critic_metrics=self._critic_metrics(state.env.metrics),
            final_observation=result.final_observation,
            final_critic_metrics=self._critic_metrics(result.metrics),
            reward=self._reward_scale * result.reward,
            terminated=result.terminated,
            truncated=result.truncated,
            done=result.terminated | result.truncated,
            metrics=metrics.mean(axis=1),
        )
        return _Carried(_slim(state), key, steps), arrays

    def _critic_metrics(self, metrics: dict[str, jax.Array]) -> jax.Array:
        """The critic metrics [B, K]."""
        columns = [metrics[name] for name in self.critic_metrics]
        return jnp.stack(columns, axis=-1) if columns else jnp.zeros((self.num_envs, 0))


class _Carried(NamedTuple):
    """Inputs of the next step in addition to the action."""

    state: vector.VectorState
    key: jax.Array
    steps: jax.Array | None
    """Steps since the first reset, or the last with a seed [], int32; None without a warm-up."""


def _slim(state: vector.VectorState) -> vector.VectorState:
    """The state without the fields that no step reads; each array that passes takes time."""
    return state._replace(env=state.env.replace(obs=None, reward=None, done=None, metrics={}))


def _committed_key(seed: int) -> jax.Array:
    """A key that is committed to its device, as PyTorch's tensors are; otherwise the second step
    would be compiled anew for a committed state."""
    return jax.device_put(jax.random.PRNGKey(seed), jax.devices()[0])


def _shared_device() -> torch.device:
    """The torch device of JAX's default device."""
    try:
        return torch.from_dlpack(jnp.zeros(1)).device
    except Exception as error:
        raise UserError(
            f"PyTorch cannot use the memory of JAX's {jax.default_backend()} "
            f"({str(error).splitlines()[0]}); install a PyTorch for this device, or start with "
            "JAX_PLATFORMS=cpu"
        ) from error
