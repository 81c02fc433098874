"""Trains with a PyTorch library's PPO, and leaves a run's folder (`python train_torch.py`)."""

import contextlib
import importlib
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal, Protocol

import jax
import numpy as np
import tyro
from rich.console import Console

from bounce_mjx.commands.train import config_of, path_flag, show
from bounce_mjx.config.command_line import parse
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import Report, judge
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy, make_networks
from bounce_mjx.learning.ppo import rollout_metrics
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.folders import create_run
from bounce_mjx.runs.presets import read_preset
from bounce_mjx.runs.progress import Progress
from bounce_mjx.runs.writing import CheckpointWriter
from bounce_mjx.task.config import EnvConfig
from bounce_mjx.task.env import BounceBall
from bounce_mjx.training.console import Reporter
from bounce_mjx.training.job import Clock, Outcome
from bounce_mjx.training.log import open_log
from bounce_mjx.training.setup import set_up_jax
from bounce_mjx.training.signals import StopRequest

Library = Literal["rsl_rl", "skrl"]


class Learner(Protocol):
    """A library's PPO on the environment."""

    def __init__(self, config: PPOConfig, env: BounceBall, seed: int): ...

    def learn(self, iterations: int) -> dict[str, np.ndarray]:
        """Trains; metrics of the environment [iterations, T] and of the learner [iterations]."""

    def policy(self) -> Policy:
        """The policy as it acts now, without its noise."""


class TorchTrainCommand(TrainConfig):
    """The command line: the config's keys as flags, and the library."""

    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = EnvConfig()
    ppo: Annotated[PPOConfig, tyro.conf.arg(name="")] = PPOConfig()
    config: Path | None = None
    """Preset: a YAML file such as configs/seed.yaml. Left out: configs/default.yaml where there is
    an accelerator, else configs/cpu.yaml."""
    library: Library = "rsl_rl"
    """Library whose PPO trains."""


def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        args = sys.argv[1:] if args is None else args
        set_up_jax()
        base = read_preset(path_flag(args, "--config"))
        command = parse(
            TorchTrainCommand,
            args,
            prog="train_torch.py",
            description="Trains a policy that keeps the ball bouncing, with PyTorch.",
            default=TorchTrainCommand(**dict(base)),
        )
        console = Console()
        show([train(command, console)], console)


def make_learner(library: Library, config: PPOConfig, env: BounceBall, seed: int) -> Learner:
    """The PPO of a library.

    Raises:
      UserError: the library is not installed.
    """
    learners = {"rsl_rl": "RslRlLearner", "skrl": "SkrlLearner"}
    module = importlib.import_module(f"bounce_mjx.adapters.torch.{library}_ppo")
    return getattr(module, learners[library])(config, env, seed)


def train(command: TorchTrainCommand, console: Console) -> Outcome:
    """Trains as the command says. SIGINT or SIGTERM ends it after the block that is going on, with
    a last evaluation.

    Raises:
      UserError: the library, the run's folder or the model is not usable, or the run could not be
        saved.
    """
    clock = Clock()
    config = config_of(command)
    if config.num_seeds > 1 or (config.num_devices or 1) > 1:
        raise UserError(
            f"num_seeds is {config.num_seeds} and num_devices {config.num_devices}, but PyTorch "
            "trains one seed on one device here; leave them out, or take train_jax.py"
        )
    env = BounceBall(config.env)
    learner = make_learner(command.library, config.ppo, env, config.seed)
    evaluate = make_evaluation(config, env)
    iterations = max(1, round(config.block_steps / config.ppo.batch_steps))
    block_steps = iterations * config.ppo.batch_steps
    eval_steps = block_steps * max(1, round(config.eval_every / block_steps))
    run, progress = create_run(config), Progress()
    console.print(f"physics: {env.engine.name} ({env.engine.reason})", highlight=False)
    for warning in env.engine.warnings:
        console.print(f"warning: {warning}", highlight=False, markup=False)
    device = jax.devices()[0].device_kind
    console.print(
        f"device: {device}  library: {command.library}  run: {run}",
        highlight=False,
        soft_wrap=True,
    )
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(StopRequest())
        writer = CheckpointWriter(run, config)
        stack.callback(writer.close)
        reporter = stack.enter_context(Reporter([open_log(run, config=config)], console, config, 0))
        clock.lap("setup")
        steps, over = 0, False
        while not over:
            started = time.perf_counter()
            metrics = summarize(learner.learn(iterations))
            seconds = time.perf_counter() - started
            steps += block_steps
            metrics["speed/steps_per_second"] = np.array([block_steps / seconds])
            of_seeds = {name: values[None] for name, values in metrics.items()}
            reporter.block(steps, seconds, of_seeds)
            clock.lap("train")
            over = stop.requested or steps >= config.total_steps
            if over or steps % eval_steps == 0:
                policy = learner.policy()
                report = evaluate(policy)
                clock.lap("evaluate")
                reporter.evaluation(steps, [report])
                names = ["latest", *(["best"] if progress.improves(report, steps) else [])]
                results = {
                    "library": command.library,
                    **progress.results(steps, clock.seconds, device),
                }
                writer.save(names, steps, policy, None, progress.model_dump(), results)
                reporter.saving_problem(writer.problem(wait=False))
                clock.lap("save")
                over |= report.passed and config.stop_when_solved
        problem = writer.problem()
    clock.lap("save")
    if problem is not None:
        raise UserError(f"{problem}, so the end of the training is lost; make room and train again")
    return Outcome(
        run=run,
        seed=config.seed,
        report=progress.best,
        best_steps=progress.best_steps,
        solved_steps=progress.solved_steps,
        fault=None,
        seconds=clock.seconds,
    )


def make_evaluation(config: TrainConfig, env: BounceBall) -> Callable[[Policy], Report]:
    """The evaluation that `train_jax.py` does: the screening episodes, and if they pass all."""
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    evaluate = make_evaluator(env, networks, config.eval_episodes)
    screen = (
        make_evaluator(env, networks, config.screening_episodes)
        if config.screening_episodes
        else None
    )
    eval_key, screening_key = jax.random.split(jax.random.PRNGKey(config.eval_seed))

    def evaluate_policy(policy: Policy) -> Report:
        if screen is not None:
            screened = judge(env, screen(policy, screening_key))
            if not screened.passed:
                return screened
        return judge(env, evaluate(policy, eval_key))

    return evaluate_policy


def summarize(metrics: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Metrics of each iteration [I] from those of a learner: the environment's [I, T], as the
    trainer in JAX reports them, and the learner's own [I]."""
    own = {name: values for name, values in metrics.items() if values.ndim == 1}
    steps = {name: values for name, values in metrics.items() if values.ndim == 2}
    return own | {
        name: np.asarray(value) for name, value in jax.vmap(rollout_metrics)(steps).items()
    }


if __name__ == "__main__":
    main()
