"""The environment for MuJoCo Playground's trainers and wrappers, with this project's physics."""

import functools
import os
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from bounce_mjx.adapters.randomization import randomized_env
from bounce_mjx.deploy.environments import (
    EnvironmentOf,
    environment,
    environment_config,
    refuse_warmup,
)
from bounce_mjx.env.env import Env, EnvState
from bounce_mjx.env.env import State as CoreState
from bounce_mjx.errors import UserError, needed
from bounce_mjx.lazy import import_mjx
from bounce_mjx.physics import PhysicsState
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.arm import locate
from bounce_mjx.viewers.offscreen import choose_opengl
from bounce_mjx.world.config import WorldConfig

with needed("MuJoCo Playground", "playground<1"):
    mjx = import_mjx()
    from ml_collections import config_dict
    from mujoco_playground import MjxEnv, State

ENV_NAME = "BounceBall"


def default_config(task: EnvironmentOf | None = None, **settings: Any) -> config_dict.ConfigDict:
    """The settings of an environment, some under Playground's own names.

    Args:
      task: a task, a policy, a run or a config (`EnvironmentOf`).
      settings: the other arguments of `environment`.
    """
    return config_of(environment_config(task, **settings))


def config_of(config: WorldConfig) -> config_dict.ConfigDict:
    """The settings of an environment in Playground's form."""
    return config_dict.create(
        ctrl_dt=config.control_dt,
        sim_dt=config.physics_dt,
        episode_length=config.episode_steps,
        action_repeat=1,
        # Of `mjx_model` alone; Playground's scripts set it.
        impl="jax",
        task=config_dict.ConfigDict(
            config.model_dump(
                mode="json", exclude={"control_dt", "physics_dt", "episode_seconds", "mjcf"}
            )
        ),
    )


@struct.dataclass
class TaskData:
    """The state of the physics and the task, with those names of MJX's data that wrappers and
    renderers read."""

    qpos: jax.Array
    """Positions [nq]."""
    qvel: jax.Array
    """Velocities [nv]."""
    time: jax.Array
    """Time since the reset [], s."""
    ctrl: jax.Array
    """Servo targets [nu] of the last step, as late as the world makes them; moving ones at its
    start."""
    mocap_pos: jax.Array
    mocap_quat: jax.Array
    xfrc_applied: jax.Array
    """Zero [nbody, 6]; the physics reads neither these forces nor the mocap bodies."""
    task: EnvState
    """Everything else that the next step depends on."""


class PlaygroundTaskEnv(MjxEnv):
    """One environment with Playground's interface; `core` is the `Env` in it."""

    def __init__(self, env: Env, config: config_dict.ConfigDict | None = None):
        """Wraps an environment, such as from `environment`.

        Args:
          config: its settings in Playground's form, of which `impl` is that of `mjx_model`;
            `episode_length` and `action_repeat` end and repeat nothing: as for Playground's own
            environments, those of the wrapper or the trainer do.

        Raises:
          UserError: it has a warm-up.
        """
        refuse_warmup(env.config.randomization, ENV_NAME)
        super().__init__(config_of(env.config) if config is None else config)
        self.core = env

    def reset(self, rng: jax.Array) -> State:
        """Starts an episode; consumes the key `rng`."""
        env = self.core
        if "_mjx_model" in vars(self):
            env = randomized_env(env, self._own_mjx_model, self._mjx_model)
        state = env.reset(rng)
        physics = state.pipeline_state.physics
        dtype = physics.qpos.dtype
        still = jnp.zeros(self.action_size, dtype)
        data = TaskData(
            **physics._asdict(),
            time=jnp.zeros((), dtype),
            ctrl=self.core.control(state.pipeline_state, still)[0].ctrl,
            mocap_pos=jnp.zeros((self.mj_model.nmocap, 3), dtype),
            mocap_quat=jnp.zeros((self.mj_model.nmocap, 4), dtype),
            xfrc_applied=jnp.zeros((self.mj_model.nbody, 6), dtype),
            task=state.pipeline_state._replace(physics=None),
        )
        return State(data=data, **_common(state))

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step under the action [action_size]."""
        data = state.data
        physics = PhysicsState(data.qpos, data.qvel)
        before = CoreState(data.task._replace(physics=physics), **_common(state))
        after = self.core.step(before, action)
        control, _ = self.core.control(before.pipeline_state, action)
        data = data.replace(
            **after.pipeline_state.physics._asdict(),
            time=data.time + self.core.dt,
            ctrl=control.ctrl,
            task=after.pipeline_state._replace(physics=None),
        )
        return state.replace(data=data, **_common(after))

    @property
    def xml_path(self) -> str:
        """The MJCF file."""
        mjcf = self.core.config.mjcf
        return str(resource_path("mjcf/bounce_ball.xml") if mjcf is None else locate(mjcf))

    @property
    def action_size(self) -> int:
        """Length of the action vector."""
        return self.core.action_size

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The model."""
        return self.core.mj_model

    @property
    def mjx_model(self) -> mjx.Model:
        """The model in MJX; the environment reads the fields that a `randomization_fn` changes."""
        return self._mjx_model

    @functools.cached_property
    def _mjx_model(self) -> mjx.Model:
        """Playground's domain randomisation assigns one environment's model here; its fields act
        from the next reset (`adapters/randomization.py`)."""
        return self._own_mjx_model

    @functools.cached_property
    def _own_mjx_model(self) -> mjx.Model:
        return mjx.put_model(self.mj_model, impl=self._config.impl)

    def render(
        self, trajectory: list[State] | State, *args: Any, **kwargs: Any
    ) -> Sequence[np.ndarray] | np.ndarray:
        """Pictures of one state or a list of states, with Playground's renderer.

        Raises:
          UserError: no OpenGL library works here.
        """
        choose_opengl()
        return super().render(trajectory, *args, **kwargs)


def make_env(
    config: config_dict.ConfigDict | None = None,
    config_overrides: dict[str, Any] | None = None,
    task: EnvironmentOf | None = None,
    policy: str | os.PathLike | None = None,
    world: str | os.PathLike | None = None,
) -> PlaygroundTaskEnv:
    """What Playground's `registry.load` calls: a `PlaygroundTaskEnv` of an `environment`.

    Args:
      config: must be the one of the task or the policy (`default_config`), whose values it may
        change; None for that.
      config_overrides: values on top, by dotted key.
      task: a task, a policy, a run or a config (`EnvironmentOf`).
      policy, world: as in `environment`.

    Raises:
      UserError: a setting is wrong, or the policy's environment has another value.
    """
    if config is None:
        config = default_config(task, policy=policy, world=world)
    elif world is not None and config.task != default_config(task, policy=policy, world=world).task:
        raise UserError(
            f"config and world both say the world, and {world} is another one; give the world "
            "to default_config alone"
        )
    # As Playground's own environments do.
    config = config.lock()
    if config_overrides:
        config.update_from_flattened_dict(config_overrides)
    settings = config.task.to_dict() | {
        "control_dt": config.ctrl_dt,
        "physics_dt": config.sim_dt,
        "episode_seconds": config.episode_length * config.ctrl_dt,
    }
    env = environment(task, world, policy=policy, **settings)
    return PlaygroundTaskEnv(env, config)


def _common(state: State | CoreState) -> dict[str, Any]:
    """The fields that Playground's states and this project's have in common."""
    return {name: getattr(state, name) for name in ("obs", "reward", "done", "metrics", "info")}
