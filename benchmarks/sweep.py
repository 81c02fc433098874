"""A search over hyperparameters; each trial trains a population of seeds in one program.

    python benchmarks/sweep.py --trials 20 --seeds 8 --storage runs/sweep.db

A trial's value is the share of results met over all evaluations and seeds. It rewards both early
learning and lasting success. The storage file holds the study. The same command continues an
interrupted search and repeats its interrupted trials, so run only one process at a time. Needs
optuna (the extra `sweep`).

Evaluations use the training's evaluation seed, and never the seed of `bounce-mjx eval`. The best
trials are chosen on the very episodes of their figures, which are therefore too good: train with
their settings and other seeds.
"""

import sys
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
from pydantic import Field
from tables import device_name, markdown_table, write

from bounce_mjx import BounceBall
from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import Report, judge
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.learning.ppo import PPO, policy_of, population
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.training.setup import set_up_jax

try:
    import optuna
except ImportError:
    optuna = None

# Range of each hyperparameter, and whether its scale is logarithmic.
SPACE = {
    "max_learning_rate": (1e-3, 1e-2, True),
    "decay_steps": (5e6, 5e7, True),
    "discount": (0.96, 0.995, False),
    "gae_lambda": (0.9, 0.98, False),
    "target_kl": (0.004, 0.03, True),
    "init_noise_std": (0.2, 0.8, True),
}


class Command(StrictModel):
    """The command line."""

    config: Path | None = None
    """YAML file with the fixed settings. The default is the device's preset."""
    trials: Annotated[int, Field(ge=1)] = 20
    """Total number of trials, including those of earlier calls."""
    seeds: Annotated[int, Field(ge=1)] = 8
    """Seeds of each trial."""
    steps: Annotated[int, Field(ge=1)] = 20_000_000
    """Environment steps of each seed."""
    episodes: Annotated[int, Field(ge=1)] = 256
    """Episodes of an evaluation."""
    storage: Path = Path("runs/sweep.db")
    """SQLite file of the study."""
    out: Path = Path("benchmarks/results")
    """Folder for sweep.json and sweep.md."""


def search(command: Command, base: TrainConfig) -> "optuna.Study":
    """Continues the study until it has all its trials.

    Raises:
      UserError: the storage cannot be used.
    """
    try:
        command.storage.parent.mkdir(parents=True, exist_ok=True)
        study = optuna.create_study(
            study_name="bounce_mjx",
            storage=f"sqlite:///{command.storage}",
            direction="maximize",
            load_if_exists=True,
        )
    except Exception as error:
        reason = str(error).splitlines()[0]
        raise UserError(
            f"--storage {command.storage} cannot be used ({reason}); give another file"
        ) from error
    finished = (optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.PRUNED)
    done = len(study.get_trials(deepcopy=False, states=finished))
    study.sampler = optuna.samplers.TPESampler(seed=done)
    study.pruner = optuna.pruners.MedianPruner(n_startup_trials=5)
    if not study.trials:
        # The search starts from the preset.
        study.enqueue_trial({name: getattr(base.ppo, name) for name in SPACE})
    repeat_interrupted(study)

    def count(study: "optuna.Study", _) -> None:
        if len(study.get_trials(deepcopy=False, states=finished)) >= command.trials:
            study.stop()

    if done < command.trials:
        study.optimize(lambda trial: run_trial(trial, command, base), callbacks=[count])
    return study


def repeat_interrupted(study: "optuna.Study") -> None:
    """Enqueues the trials again that a kill or Ctrl-C ended, each once."""
    # A killed process leaves its trial as running.
    for trial in study.get_trials(states=(optuna.trial.TrialState.RUNNING,)):
        study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
    repeated = {trial.user_attrs.get("repeats") for trial in study.trials}
    for trial in study.get_trials(states=(optuna.trial.TrialState.FAIL,)):
        if trial.params and trial.number not in repeated:
            study.enqueue_trial(trial.params, user_attrs={"repeats": trial.number})


def run_trial(trial: "optuna.Trial", command: Command, base: TrainConfig) -> float:
    """Trains the population of one trial; returns the trial's value."""
    chosen = {
        name: trial.suggest_float(name, low, high, log=log)
        for name, (low, high, log) in SPACE.items()
    }
    chosen["decay_steps"] = round(chosen["decay_steps"])
    config = validate(PPOConfig, dict(base.ppo) | chosen, f"trial {trial.number}")
    env = BounceBall(base.env)
    init, train = population(PPO(config, env, base.training_episode_steps))
    networks = make_networks(config, env.observation_size, env.action_size)
    evaluate = jax.jit(jax.vmap(make_evaluator(env, networks, command.episodes), in_axes=(0, None)))
    iterations = max(1, round(base.eval_every / config.batch_steps))
    run = jax.jit(lambda state: train(state, iterations), donate_argnums=0)
    policies = jax.jit(jax.vmap(lambda state: policy_of(state, env.observation_size)))

    state = jax.jit(init)(jax.vmap(jax.random.PRNGKey)(base.seed + np.arange(command.seeds)))
    eval_key = jax.random.PRNGKey(base.eval_seed)
    met = []
    steps = 0
    while steps < command.steps:
        state, _ = run(state)
        steps += iterations * config.batch_steps
        statistics = jax.device_get(evaluate(policies(state), eval_key)[0])
        reports = [
            judge(env, jax.tree.map(lambda x, i=i: x[i], statistics)) for i in range(command.seeds)
        ]
        met.append([share_met(report) for report in reports])
        trial.report(float(np.mean(met)), steps)
        if trial.should_prune():
            raise optuna.TrialPruned
    trial.set_user_attr("solved_at_the_end", int(sum(r.passed for r in reports)))
    trial.set_user_attr("spread_over_seeds", float(np.mean(met, axis=0).std()))
    return float(np.mean(met))


def share_met(report: Report) -> float:
    """Share of the judged results that were met."""
    judged = [result.passed for result in report.results if result.passed is not None]
    return sum(judged) / len(judged)


def table(study: "optuna.Study", seeds: int) -> str:
    """The completed trials, best first."""
    complete = study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.COMPLETE,))
    complete.sort(key=lambda trial: -trial.value)
    rows = [
        [
            str(trial.number),
            f"{100 * trial.value:.1f}",
            f"{100 * trial.user_attrs['spread_over_seeds']:.1f}",
            f"{trial.user_attrs['solved_at_the_end']} of {seeds}",
            *[f"{trial.params[name]:.4g}" for name in SPACE],
        ]
        for trial in complete
    ]
    return markdown_table(["trial", "results met %", "+-", "solved at the end", *SPACE], rows)


def main() -> None:
    """Runs the command line."""
    with exit_on_user_error():
        command = parse(
            Command, sys.argv[1:], prog="benchmarks/sweep.py", description=__doc__.split("\n")[0]
        )
        if optuna is None:
            raise UserError(
                "benchmarks/sweep.py needs optuna, which is not installed; run "
                "pip install 'bounce_mjx[sweep]'"
            )
        base = read_preset(command.config)
        set_up_jax(base.env)
        study = search(command, base)
        device = device_name()
        record = {
            "device": device,
            "seeds": command.seeds,
            "steps": command.steps,
            "trials": [
                {"state": t.state.name, "value": t.value, "params": t.params} for t in study.trials
            ],
        }
        write(command.out, "sweep", record, f"Device: {device}\n\n{table(study, command.seeds)}")


if __name__ == "__main__":
    main()
