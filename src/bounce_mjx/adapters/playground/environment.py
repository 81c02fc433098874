"""The environment for MuJoCo Playground's trainers and wrappers, with this project's physics."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import mujoco
import numpy as np
from ml_collections import config_dict
from mujoco import mjx

from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError
from bounce_mjx.resources import resource_path
from bounce_mjx.task import state as core
from bounce_mjx.task.config import EnvConfig
from bounce_mjx.task.env import BounceBall

try:
    from mujoco_playground import MjxEnv, State, manipulation, render_array
except ImportError as error:
    raise UserError(
        f"MuJoCo Playground cannot be imported ({error}); install it with pip install playground"
    ) from error

ENV_NAME = "BounceBall"
_NO_RANDOMIZATION = (
    "Playground's randomization_fn changes an MJX model, which this environment does not use, "
    "so it would have no effect; train without it"
)


def default_config() -> config_dict.ConfigDict:
    """The settings of `EnvConfig`, some under Playground's own names."""
    config = EnvConfig()
    return config_dict.create(
        ctrl_dt=config.control_dt,
        sim_dt=config.physics_dt,
        episode_length=config.episode_steps,
        action_repeat=1,
        task=config_dict.ConfigDict(
            config.model_dump(
                mode="json", exclude={"control_dt", "physics_dt", "episode_seconds", "mjcf"}
            )
        ),
    )


class PlaygroundBounceBall(MjxEnv):
    """One environment with Playground's interface."""

    def __init__(
        self,
        config: config_dict.ConfigDict | None = None,
        config_overrides: dict[str, Any] | None = None,
    ):
        """Makes the environment.

        Raises:
          UserError: a setting is wrong.
        """
        super().__init__(config or default_config(), config_overrides)
        settings = self._config.task.to_dict() | {
            "control_dt": self._config.ctrl_dt,
            "physics_dt": self._config.sim_dt,
            "episode_seconds": self._config.episode_length * self._config.ctrl_dt,
        }
        self.task = BounceBall(validate(EnvConfig, settings, ENV_NAME))

    def reset(self, rng: jax.Array) -> State:
        """Starts an episode; consumes the key `rng`."""
        return _to_playground(self.task.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step under the action [n]."""
        return _to_playground(self.task.step(_from_playground(state), action))

    @property
    def xml_path(self) -> str:
        """The MJCF file."""
        return str(self.task.config.mjcf or resource_path("mjcf/bounce_ball.xml"))

    @property
    def action_size(self) -> int:
        """Length of the action vector."""
        return self.task.action_size

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The model."""
        return self.task.mj_model

    @property
    def mjx_model(self) -> mjx.Model:
        """The model in MJX, for reading only; the environment does not step it."""
        return self._mjx_model

    @functools.cached_property
    def _mjx_model(self) -> mjx.Model:
        return mjx.put_model(self.mj_model)

    def __setattr__(self, name: str, value: Any) -> None:
        """Playground's domain randomisation assigns a model here, which no step would use."""
        if name == "_mjx_model":
            raise UserError(_NO_RANDOMIZATION)
        super().__setattr__(name, value)

    def render(self, trajectory: list[State] | State, *args: Any, **kwargs: Any) -> Sequence[Any]:
        """Renders one state or a list of states with Playground's renderer."""
        states = trajectory if isinstance(trajectory, list) else [trajectory]
        with_data = [state.replace(data=self._mj_data(state)) for state in states]
        drawable = with_data if isinstance(trajectory, list) else with_data[0]
        return render_array(self.mj_model, drawable, *args, **kwargs)

    def _mj_data(self, state: State) -> mujoco.MjData:
        data = mujoco.MjData(self.mj_model)
        data.qpos[:] = np.asarray(state.data.physics.qpos)
        data.qvel[:] = np.asarray(state.data.physics.qvel)
        return data


def _to_playground(state: core.State) -> State:
    """Converts a state; its field `data` holds a `BounceState`, not MJX's data."""
    return State(
        data=state.pipeline_state,
        obs=state.obs,
        reward=state.reward,
        done=state.done,
        metrics=state.metrics,
        info=state.info,
    )


def _from_playground(state: State) -> core.State:
    return core.State(
        pipeline_state=state.data,
        obs=state.obs,
        reward=state.reward,
        done=state.done,
        metrics=state.metrics,
        info=state.info,
    )


manipulation.register_environment(ENV_NAME, PlaygroundBounceBall, default_config)
