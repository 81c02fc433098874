"""The environment for brax, with this project's physics."""

import copy
import dataclasses
import functools
import warnings
from collections.abc import Sequence
from typing import Any

import brax.base
import brax.envs
import jax
import mujoco
import numpy as np
from brax.io import image, mjcf
from flax import struct

from bounce_mjx.adapters.randomization import randomized_env
from bounce_mjx.deploy.environments import environment, refuse_warmup
from bounce_mjx.env.env import Env, EnvState, State
from bounce_mjx.errors import UserError
from bounce_mjx.viewers.offscreen import choose_opengl
from bounce_mjx.world.config import WorldConfig

ENV_NAME = "bounce_ball"


# A dataclass without fields: TorchRL turns every field that it finds in a state into a tensor.
@dataclasses.dataclass(init=False, eq=False)
class _Model:
    """A model as a static field of a state; equal only to itself."""

    def __init__(self, mj_model: mujoco.MjModel):
        self.mj_model = mj_model


@struct.dataclass
class PipelineState:
    """The state of the physics and the task, with the names of brax's `base.State`."""

    task: EnvState
    """Everything that the next step depends on."""
    model: _Model = struct.field(pytree_node=False)

    @property
    def q(self) -> jax.Array:
        """Positions [nq]."""
        return self.task.physics.qpos

    @property
    def qd(self) -> jax.Array:
        """Velocities [nv]."""
        return self.task.physics.qvel

    @property
    def x(self) -> brax.base.Transform:
        """Positions [bodies, 3] and quaternions [bodies, 4] of the links in the world, of a state
        without a batch axis."""
        data = mujoco.MjData(self.model.mj_model)
        data.qpos[:] = np.asarray(self.q)
        mujoco.mj_kinematics(self.model.mj_model, data)
        return brax.base.Transform(pos=data.xpos[1:].copy(), rot=data.xquat[1:].copy())


class BraxTaskEnv(brax.envs.Env):
    """One environment with brax's interface; `core` is the `Env` in it."""

    def __init__(self, env: Env):
        """Wraps an environment, such as from `environment`. Its time limit has no effect: brax's
        wrappers and trainers end the episodes, after their own `episode_length`
        (`core.config.episode_steps` is the config's).

        Raises:
          UserError: it has a warm-up.
        """
        refuse_warmup(env.config.randomization, ENV_NAME)
        self.core = env
        self.dt = self.core.dt
        """Time of one control step, s."""
        self.mj_model = self.core.mj_model
        """MuJoCo's model."""
        self._model = _Model(self.mj_model)

    @functools.cached_property
    def sys(self) -> brax.base.System:
        """brax's system of the model. The fields of another system, such as `randomization_fn`
        gives, act from the next reset (`adapters/randomization.py`)."""
        return self._own_sys

    @functools.cached_property
    def _own_sys(self) -> brax.base.System:
        with warnings.catch_warnings():
            # brax warns that it is no longer maintained.
            warnings.simplefilter("ignore")
            return mjcf.load_model(_drawable(self.mj_model))

    def reset(self, rng: jax.Array) -> State:
        """Starts an episode; consumes the key `rng`."""
        env = self.core
        # Only where `sys` was read can brax have replaced it.
        if "sys" in vars(self):
            env = randomized_env(env, self._own_sys, self.sys)
        return self._to_brax(env.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step under the action [action_size]."""
        plain = state.replace(pipeline_state=_complete(state.pipeline_state.task))
        return self._to_brax(self.core.step(plain, action))

    def _to_brax(self, state: State) -> State:
        return state.replace(pipeline_state=PipelineState(state.pipeline_state, self._model))

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""
        return self.core.observation_size

    @property
    def action_size(self) -> int:
        """Length of the action vector."""
        return self.core.action_size

    @property
    def backend(self) -> str:
        """Name of the physics engine."""
        return self.core.backend

    def render(
        self,
        trajectory: list[PipelineState] | PipelineState,
        height: int = 240,
        width: int = 320,
        camera: str | None = None,
    ) -> Sequence[np.ndarray] | np.ndarray:
        """Pictures [height, width, 3] of pipeline states.

        Raises:
          UserError: no OpenGL library works here.
        """
        choose_opengl()
        return image.render_array(self.sys, trajectory, height, width, camera)


def make_env(config: WorldConfig | None = None, **settings: Any) -> BraxTaskEnv:
    """What `brax.envs.get_environment` calls: a `BraxTaskEnv` of an `environment`.

    Args:
      config: all settings, on which the others lie; None for those of the task or the policy.
      settings: the arguments of `environment` (its start is called task), such as policy="robust"
        or control_dt=0.02. Not episode_seconds, which would have no effect.

    Raises:
      UserError: a setting is wrong, or has no effect here.
    """
    if "episode_seconds" in settings:
        raise UserError(
            f"{ENV_NAME}: episode_seconds has no effect here; give brax's wrapper or trainer "
            "an episode_length in steps"
        )
    start = settings.pop("task", None)
    if config is not None:
        given = {"task": start} | {name: settings.get(name) for name in ("policy", "world")}
        for name, value in given.items():
            if value is not None:
                raise UserError(f"config and {name} both say the environment; give one of them")
        start = config
    return BraxTaskEnv(environment(start, **settings))


def _complete(state: EnvState) -> EnvState:
    """The state with the defaults of its parts that hold no arrays, which TorchRL drops; another
    state as it is."""
    defaults = {
        name: default
        for name, default in EnvState._field_defaults.items()
        if getattr(state, name) is None
    }
    return state._replace(**defaults)


def _drawable(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy with shapes that brax's viewer has: it has no ellipsoids, so they become spheres of
    the same volume."""
    model = copy.copy(mj_model)
    ellipsoids = model.geom_type == mujoco.mjtGeom.mjGEOM_ELLIPSOID
    model.geom_size[ellipsoids, 0] = np.cbrt(model.geom_size[ellipsoids].prod(axis=1))
    model.geom_type[ellipsoids] = mujoco.mjtGeom.mjGEOM_SPHERE
    return model
