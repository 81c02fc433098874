"""Measures the results of a policy in perturbed worlds: `bounce-mjx robustness [CHECKPOINT]`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from rich.progress import Progress

from bounce_mjx.commands.play import film_command
from bounce_mjx.commands.which_policy import (
    MirrorRobot,
    OnePolicy,
    WhichPolicy,
    suite_conditions,
)
from bounce_mjx.config.command_line import Flag, parse, stdout
from bounce_mjx.config.settings import Count, NonNegativeInt
from bounce_mjx.config.user_code import import_flags_of_classes
from bounce_mjx.evaluation import config as evaluation


class RobustnessCommand(WhichPolicy):
    """Measures the results of a trained policy in perturbed worlds."""

    checkpoint: OnePolicy = None
    robot: MirrorRobot = None
    world: Path | None = None
    """World that each condition changes, in place of the model's own: a YAML file, or the name of
    one in configs/worlds/ (ur5e_rtde, panda_fci, iiwa_fri or fast_servo). Twice each of its assumed
    numbers, or half where less is harder, is a condition too."""
    assumed: Annotated[bool, Flag(needs="world", excludes=("suite",))] = False
    """Only the world itself and its assumed numbers doubled or halved, without the suite."""
    suite: Path = Path("robustness")
    """YAML file of the perturbations, or the name of one in configs/: robustness is version 1, and
    robustness_v2 is version 2."""
    episodes: Count = evaluation.DEFAULT_CONDITION_EPISODES
    """Episodes in each condition."""
    seed: NonNegativeInt = evaluation.DEFAULT_SEED
    """Seed of the resets."""
    physics: evaluation.Physics = "config"
    """Engine: mujoco is MuJoCo's C engine; config is the engine used in training."""
    out: Path | None = None
    """Folder for robustness.json and the pictures. The default is the run's folder, or robustness
    for a policy that comes with the package and for the mirror law."""


def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 0 if all conditions meet all judged results, 1 if one does
    not, 2 on a mistake."""
    command = parse(RobustnessCommand, args, prog="bounce-mjx robustness")
    from bounce_mjx.evaluation.robustness import RobustnessReport, measure_conditions
    from bounce_mjx.evaluation.suite import read_suite
    from bounce_mjx.reports import robustness
    from bounce_mjx.reports.figures import image
    from bounce_mjx.reports.tables import print_table
    from bounce_mjx.runs.checkpoints import read_actor
    from bounce_mjx.runs.folders import is_users_run
    from bounce_mjx.runs.storage import to_json, writable, write_output
    from bounce_mjx.training.setup import set_up_jax

    console = stdout()
    (checkpoint,) = command.choose(command.checkpoint, robot=command.robot)
    config = command.config_of(checkpoint, command.robot)
    path, conditions, num_assumed = suite_conditions(command.suite, config, command.world)
    suite, version = str(path), read_suite(path).version
    if command.assumed:
        # The suite's own conditions follow.
        conditions = conditions[: 1 + num_assumed]
        suite, version = f"twice or half what {command.world} assumes", ""
    set_up_jax(*(evaluation.on_engine(condition.env, command.physics) for condition in conditions))
    checkpoint, policy, actor = read_actor(checkpoint, config)
    own_folder = checkpoint.run if is_users_run(checkpoint.run) else Path("robustness")
    out = command.out or own_folder
    # Fails before the measurement if its results could not be written.
    with writable(out, "choose another folder with --out"):
        out.mkdir(parents=True, exist_ok=True)
    options = evaluation.EvaluationOptions(command.episodes, command.seed, command.physics)
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("conditions", total=len(conditions))
        outcomes = measure_conditions(
            policy, actor, conditions, options, lambda done: bar.update(task, completed=done)
        )
    report = RobustnessReport(
        checkpoint=str(checkpoint.folder),
        steps=checkpoint.steps,
        suite=suite,
        version=version,
        episodes=command.episodes,
        seed=command.seed,
        measured=outcomes[0].measured,
        outcomes=outcomes,
    )
    print_table(console, robustness.robustness_table(report))
    figure = robustness.robustness_figure(report)
    files = {robustness.ROBUSTNESS_FILE: to_json(report.model_dump())}
    files |= {f"robustness.{suffix}": image(figure, suffix) for suffix in ("png", "svg")}
    for name, content in files.items():
        write_output(out / name, content)
    print(*(out / name for name in files), sep="\n")
    lost = [outcome for outcome in outcomes if outcome.lost and outcome.physics != "mujoco"]
    # A film simulates the programs of the whole suite (`find_episode`), on the config's engine.
    if lost and not command.assumed and command.physics == "config":
        worst = min(lost, key=lambda outcome: outcome.lasted)
        film = "--condition", worst.label, "--episode", str(worst.lost[0])
        imports = import_flags_of_classes(config.env.task)
        shown = film_command(args, RobustnessCommand, *film, imports=imports)
        print(f"film of one that ended: {shown}")
    sys.exit(0 if report.passed else 1)
