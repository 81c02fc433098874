"""A policy in an environment of any library: the environment of this package in it, below wrappers
that change nothing of what the policy relies on (its observations, its actions, its control step),
and the library's own arrays."""

import importlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError

# By the package that defines them. Only these are known, and classes that extend them without
# another acting (`_ACTING`): the next release of a library, or a user, may write any other.
_CHANGE_NOTHING = {
    "gymnasium": {
        "Wrapper",
        "VectorWrapper",
        "RewardWrapper",
        "VectorRewardWrapper",
        "ArrayConversion",
        "Autoreset",
        "ClipAction",
        "ClipReward",
        "DictInfoToList",
        "DtypeObservation",
        "HumanRendering",
        "JaxToNumpy",
        "JaxToTorch",
        "NormalizeReward",
        "NumpyToTorch",
        "OrderEnforcing",
        "PassiveEnvChecker",
        "RecordEpisodeStatistics",
        "RecordVideo",
        "RenderCollection",
        "SyncVectorEnv",
        "TimeLimit",
    },
    "stable_baselines3": {
        "DummyVecEnv",
        "Monitor",
        "VecCheckNan",
        "VecEnvWrapper",
        "VecMonitor",
        "VecVideoRecorder",
    },
    "brax": {
        "AutoResetWrapper",
        "DomainRandomizationVmapWrapper",
        "EpisodeWrapper",
        "EvalWrapper",
        "VmapWrapper",
        "Wrapper",
    },
    "mujoco_playground": {
        "BraxAutoResetWrapper",
        "BraxDomainRandomizationVmapWrapper",
        "RSLRLBraxWrapper",
        "Wrapper",
    },
    "gymnax": {"GymnaxWrapper", "GymnaxToGymWrapper", "GymnaxToVectorGymWrapper", "LogWrapper"},
    "torchrl": {
        "BraxEnv",
        "BraxWrapper",
        "GymEnv",
        "GymWrapper",
        "MujocoPlaygroundEnv",
        "MujocoPlaygroundWrapper",
    },
}
# Attributes that say for how many control steps one of these applies an action.
_REPEATS = ("action_repeat", "frame_skip", "wrapper_frame_skip")
# What the acting of an environment consists of, in these libraries.
_ACTING = ("reset", "step", "step_async", "step_wait", "action", "actions")
_ACTING += ("observation", "observations")
_IN_OTHER_PROCESSES = {"AsyncVectorEnv", "SubprocVecEnv"}


def environments_in(env: Any) -> list[Env]:
    """The `Env` in an environment of any library, also within wrappers; of a vector of different
    ones, each.

    Raises:
      UserError: it holds none of this package, or is not known to leave the observations, the
        actions and the control step as they are.
    """
    environments: list[Env] = []
    for found in _below(env, type(env).__name__):
        if not any(found is other for other in environments):
            environments.append(found)
    return environments


def for_any_arrays(act: Callable[[jax.Array], jax.Array], size: int) -> Callable[[Any], Any]:
    """A policy for the arrays of any library.

    Args:
      act: observations [..., N] -> actions [..., A].
      size: length N of an observation.

    Returns:
      The same for arrays of NumPy, tensors of PyTorch, or arrays of JAX, of which it gives the same
      kind; UserError for observations of another length.
    """

    def policy(observation: Any) -> Any:
        if observation.shape[-1:] != (size,):
            raise UserError(
                f"the observation has the shape {list(observation.shape)}, but the last axis must "
                f"have {size} entries"
            )
        if isinstance(observation, np.ndarray):
            return np.array(act(jnp.asarray(observation, jnp.float32)))
        if isinstance(observation, jax.Array):
            return act(observation)
        # A tensor, whose library need not be installed.
        actions = act(jax.dlpack.from_dlpack(observation.detach().contiguous()))
        return importlib.import_module("torch").from_dlpack(actions)

    return policy


def _below(env: Any, outermost: str) -> Iterator[Env]:
    """The environments in this one.

    Args:
      outermost: the class of what the user gave, for errors.
    """
    name = type(env).__name__
    if name in _IN_OTHER_PROCESSES:
        raise UserError(
            f"the environments of {name} are in other processes, where a policy cannot look at "
            "them; give one that is made in the same way, or make_vec(...), which has one process"
        )
    held = _held(env)
    if not held and not isinstance(env, Env):
        raise UserError(
            f"{outermost} holds no environment of bounce_mjx; give one that its adapters made, "
            "such as gymnasium.make('bounce_mjx/Task-v0', policy=...)"
        )
    if not _changes_nothing(env):
        raise UserError(
            f"{name} may change the observations, the actions or the control step, and a policy "
            "takes the environment's own; give the environment within it"
        )
    if isinstance(env, Env):
        yield env
        return
    for inner in held:
        yield from _below(inner, outermost)


def _held(env: Any) -> list[Any]:
    """What an environment or a wrapper holds directly; empty if that is unknown."""
    if isinstance(env, Env):
        return []
    attributes = getattr(env, "__dict__", {})
    held = [attributes.get(name) for name in ("env", "venv", "_env", "envs")]
    # The adapters hold the environment as their core, some as a property.
    core = getattr(type(env), "core", attributes.get("core"))
    held.append(env.core if isinstance(core, property) else core)
    for part in held:
        if isinstance(part, list | tuple):
            return list(part)
        if part is not None:
            return [part]
    return []


def _changes_nothing(env: Any) -> bool:
    """Whether the acting of an environment is that of a class that is known to change nothing."""
    attributes = getattr(env, "__dict__", {})
    if any(attributes.get(name, 1) != 1 for name in _REPEATS):
        return False
    for kind in type(env).__mro__:
        package = kind.__module__.partition(".")[0]
        if package == "bounce_mjx" or kind.__name__ in _CHANGE_NOTHING.get(package, ()):
            return kind.__name__ != "DtypeObservation" or _keeps_float32(env)
        if any(name in vars(kind) for name in _ACTING):
            return False
    return False


def _keeps_float32(env: Any) -> bool:
    """Whether a DtypeObservation keeps float32's precision."""
    dtype = np.dtype(env.observation_space.dtype)
    return dtype.kind == "f" and dtype.itemsize >= 4
