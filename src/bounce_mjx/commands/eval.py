"""Measures the results of a trained policy: `bounce-mjx eval [CHECKPOINT]`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console

from bounce_mjx.commands.goals import parse_with_goals
from bounce_mjx.commands.play import film_command
from bounce_mjx.commands.which_policy import (
    MirrorRobot,
    OnePolicy,
    OtherRandomization,
    OtherWorld,
    WhichPolicy,
    world_of_flags,
)
from bounce_mjx.config.command_line import Flag, stdout
from bounce_mjx.config.settings import Count, NonNegativeInt
from bounce_mjx.config.user_code import import_flags_of_classes
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation import config as evaluation
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import RandomizationConfig

if TYPE_CHECKING:
    from bounce_mjx.evaluation.failures import Failure
    from bounce_mjx.evaluation.statistics import Statistics


class EvalCommand(WhichPolicy):
    """Measures the results of a trained policy."""

    checkpoint: OnePolicy = None
    robot: MirrorRobot = None
    world: OtherWorld = None
    randomization: OtherRandomization = RandomizationConfig()
    episodes: Count = evaluation.DEFAULT_EPISODES
    """Episodes, each from its own reset."""
    seed: NonNegativeInt = evaluation.DEFAULT_SEED
    """Seed of the resets."""
    nominal: Annotated[bool, Flag(excludes=("world", "randomization"))] = False
    """Evaluate without domain randomisation, and with the task's default goals where the policy
    was trained with them. Without this flag, each episode samples its world and goals, as in
    training."""
    contacts: bool = False
    """Also count contacts of the arm with itself and the floor, which the physics leaves out, in
    the first 32 episodes."""
    limits: bool = False
    """Also show how much of the arm's own limits of velocity, acceleration and jerk its commands at
    1 kHz use, in the first 32 episodes."""
    failures: bool = False
    """Also list the failed episodes with their worlds, and the terms of the world that go with
    failure, with a picture, failures.png, in the run's folder or, for a policy that comes with the
    package and for the mirror law, here."""
    physics: evaluation.Physics = "config"
    """Physics engine: mujoco is MuJoCo's C engine; config is the engine used in training."""
    json_file: Annotated[Path | None, Flag(name="json", instead_of=("--out",))] = None
    """File to write the results to."""


_STILL = (
    "note: the goals do not change within an episode here, as randomization.goal_interval of the "
    "training is not the task's default"
)


def _stands_still(measured_in: WorldConfig, trained: WorldConfig) -> bool:
    """Whether the goals change within an episode of the training and not in another world."""
    intervals = [config.randomization.goal_interval for config in (measured_in, trained)]
    return intervals[0] is None and intervals[1] is not None


def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 0 if no result fails, 1 if one does, 2 on a mistake."""
    command, given_goals = parse_with_goals(EvalCommand, args, prog="bounce-mjx eval")
    from bounce_mjx.evaluation.contacts import arm_contacts, describe_contacts
    from bounce_mjx.evaluation.failures import failures_of
    from bounce_mjx.evaluation.limits import describe_limits, limit_shares
    from bounce_mjx.evaluation.policy_evaluation import evaluate_policy
    from bounce_mjx.evaluation.statistics import RECORDED_EPISODES
    from bounce_mjx.reports.tables import details_line, print_table, results_table
    from bounce_mjx.runs.checkpoints import read_actor
    from bounce_mjx.runs.storage import check_output, to_json, write_output
    from bounce_mjx.training.setup import set_up_jax

    check_output(command.json_file, "--json")
    console = stdout()
    world = world_of_flags(command.world, command.randomization)
    (checkpoint,) = command.choose(command.checkpoint, robot=command.robot)
    # `evaluate_policy` changes it once more, by `options`: the engine, the goals and --nominal.
    config = command.config_of(checkpoint, command.robot, world)
    if command.limits and config.env.robot.limits.velocity is None:
        raise UserError("the policy's arm has no command limits (env.robot.limits); omit --limits")
    # In its own world, to say what does not change in another one.
    trained = command.config_of(checkpoint, command.robot)
    goals = given_goals.checked(config.env)
    set_up_jax(evaluation.on_engine(config.env, command.physics))
    checkpoint, policy, actor = read_actor(checkpoint, config)
    steps = f" ({checkpoint.steps:,} steps)" if checkpoint.steps else ""
    print(f"checkpoint: {checkpoint.folder}{steps}")
    options = evaluation.EvaluationOptions(
        episodes=command.episodes,
        seed=command.seed,
        physics=command.physics,
        nominal=command.nominal,
        goals=goals,
    )
    checks = []
    if command.contacts:
        checks.append(("contacts", arm_contacts, describe_contacts))
    if command.limits:
        checks.append(("limits", limit_shares, describe_limits))
    recorded = RECORDED_EPISODES if checks else 0
    with console.status("evaluating"):
        evaluated = evaluate_policy(policy, config.env, actor, options, recorded)
    report = evaluated.report
    length = f"{command.episodes:,} episodes of {config.env.episode_seconds:g} s"
    print(f"physics: {evaluated.engine}  {length}")
    if evaluated.warning is not None:
        print(f"warning: {evaluated.warning}")
    measured_in = evaluated.setup.env.config
    if goals.keys() < measured_in.goals.keys() and _stands_still(measured_in, trained.env):
        print(_STILL)
    print_table(console, results_table(report, "the results"))
    print(details_line(report))
    findings = {}
    for name, measure, describe in checks:
        entries = measure(config.env, report.recording)
        print(describe(entries, report.recording.running.shape[-1]))
        findings[name] = [entry._asdict() for entry in entries]
    failures = []
    if command.failures:
        failures = failures_of(evaluated.setup, evaluated.statistics)
        findings["failures"] = [failure._asdict() for failure in failures]
    if command.json_file is not None:
        content = {
            "checkpoint": str(checkpoint.folder),
            "physics": evaluated.engine,
            **report.to_dict(),
            "seed": command.seed,
            "goals": goals,
            "nominal": command.nominal,
            "world": None if command.world is None else str(command.world),
            "randomization": {
                name: getattr(command.randomization, name) for name in command.randomization.terms
            },
            **findings,
        }
        write_output(command.json_file, to_json(content))
    if failures:
        _show_failures(failures, evaluated.statistics, checkpoint.run, command.episodes, console)
        # A film is on the config's engine.
        if command.physics == "config":
            first_to_end = min(failures, key=lambda failure: failure.seconds)
            film = "--episode", str(first_to_end.episode)
            imports = import_flags_of_classes(config.env.task)
            print(f"film of one: {film_command(args, EvalCommand, *film, imports=imports)}")
    elif command.failures:
        print(f"no episode of {command.episodes:,} failed")
    sys.exit(0 if report.passed else 1)


def _show_failures(
    failures: "list[Failure]",
    statistics: "Statistics",
    run: Path,
    episodes: int,
    console: Console,
) -> None:
    """Prints the failed episodes and the terms of the world that go with failure, and draws these,
    if any, in the user's run or, for a policy of the package and the mirror law, here."""
    from bounce_mjx.evaluation.failures import associations
    from bounce_mjx.reports.failures import association_lines, failures_figure, failures_table
    from bounce_mjx.reports.figures import image
    from bounce_mjx.reports.tables import print_table
    from bounce_mjx.runs.folders import is_users_run
    from bounce_mjx.runs.storage import write_output

    terms = associations(statistics, failures)
    print_table(console, failures_table(failures, terms, episodes))
    print(*association_lines(terms), sep="\n")
    if terms:
        picture = (run if is_users_run(run) else Path()) / "failures.png"
        write_output(picture, image(failures_figure(terms), "png"))
        print(f"picture: {picture}")
