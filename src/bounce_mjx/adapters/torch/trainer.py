"""PyTorch's PPO implementations as trainers for the job, with one learner per seed."""

import concurrent.futures
import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from bounce_mjx.adapters.torch.learner import CHECKED, Learner
from bounce_mjx.adapters.torch.vector_env import TorchVectorEnv
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.metrics import rollout_metrics
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.task import Curve
from bounce_mjx.training.devices import make_mesh
from bounce_mjx.training.trainer import Metrics, Snapshot

MODEL_FILE = "model.pt"
_LEARNERS = {"rsl_rl": "RslRlLearner", "skrl": "SkrlLearner"}


class TorchTrainer:
    """A library's PPO, which trains the seeds in turn, an iteration each; see
    `training.trainer.Trainer`."""

    checked = CHECKED

    def __init__(self, library: str, config: TrainConfig, env: Env):
        """
        Raises:
          UserError: the library is not installed, or the config does not fit it or the environment.
        """
        if (config.num_devices or 1) > 1:
            raise UserError(
                f"num_devices is {config.num_devices}, but PyTorch trains on one device here; "
                "leave it out, or train with bounce-mjx train"
            )
        if config.warm_start is not None:
            raise UserError(
                f"warm_start is {config.warm_start}, but PyTorch's trainings start untrained; "
                "leave it out, or train with bounce-mjx train"
            )
        self.library = library
        self._curves = env.task.curves
        self.mesh: Mesh = make_mesh(1, config.ppo)
        first = make_vector_env(config.ppo, env, config.seed)
        self.learners: list[Learner] = []
        for seed in range(config.seed, config.seed + config.num_seeds):
            vector = first.sibling(seed) if self.learners else first
            self.learners.append(make_learner(library, config.ppo, vector, seed))

    def state_template(self) -> Any:
        one = jax.tree.map(np.asarray, self.learners[0].state())
        seeds = (len(self.learners),) if len(self.learners) > 1 else ()
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct((*seeds, *x.shape), x.dtype), one)

    def compile(self, pool: concurrent.futures.Executor) -> concurrent.futures.Future:
        # The step of the environments is compiled at its first call.
        done = concurrent.futures.Future()
        done.set_result(None)
        return done

    def start(self, state: Any | None = None) -> None:
        if state is None:
            return
        for i, learner in enumerate(self.learners):
            one = state
            if len(self.learners) > 1:
                one = jax.tree.map(lambda x, i=i: np.asarray(x)[i], state)
            learner.restore(one)

    def run(self, iterations: int, stopping: Callable[[], bool]) -> Metrics:
        parts = []
        for _ in range(iterations):
            parts.append([learner.learn() for learner in self.learners])
            if stopping():
                break
        blocks = [summarize(metrics, self._curves) for metrics in zip(*parts, strict=True)]
        return {name: np.stack([block[name] for block in blocks]) for name in blocks[0]}

    def snapshot(self) -> Snapshot:
        snapshots = [
            Snapshot(jax.tree.map(np.asarray, learner.policy()), learner.state())
            for learner in self.learners
        ]
        if len(snapshots) == 1:
            return snapshots[0]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *snapshots)

    def save_models(self, runs: Sequence[Path]) -> None:
        """Writes the last networks of each seed as `model.pt` into its run."""
        for learner, run in zip(self.learners, runs, strict=True):
            learner.save_model(run / MODEL_FILE)


def make_learner(library: str, config: PPOConfig, vector: TorchVectorEnv, seed: int) -> Learner:
    """The PPO of a library.

    Raises:
      UserError: the library is not installed.
    """
    module = importlib.import_module(f"bounce_mjx.adapters.torch.{library}_ppo")
    return getattr(module, _LEARNERS[library])(config, vector, seed)


def make_vector_env(config: PPOConfig, env: Env, seed: int) -> TorchVectorEnv:
    """The environments of a learner."""
    return TorchVectorEnv(
        env,
        config.num_envs,
        seed=seed,
        critic_metrics=config.critic_metrics,
        reward_scale=config.reward_scale,
    )


def summarize(iterations: Sequence[Metrics], curves: Sequence[Curve]) -> Metrics:
    """Metrics [I] from those of I iterations of a learner. The environment's metrics [T] are
    summarised as in the JAX trainer, with the curves of the task; the learner's own [] stay."""
    metrics = {name: np.stack([one[name] for one in iterations]) for name in iterations[0]}
    own = {name: values for name, values in metrics.items() if values.ndim == 1}
    steps = {name: values for name, values in metrics.items() if values.ndim == 2}
    summary = jax.vmap(lambda steps: rollout_metrics(steps, curves))(steps)
    return own | {name: np.asarray(value) for name, value in summary.items()}
