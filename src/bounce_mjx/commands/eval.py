"""Measures the results of a trained policy: `bounce-mjx eval [CHECKPOINT]`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from bounce_mjx.commands.task_commands import parse_with_commands
from bounce_mjx.commands.which_policy import MirrorRobot, OnePolicy, OtherWorld, WhichPolicy
from bounce_mjx.config.command_line import Flag, stdout
from bounce_mjx.config.settings import Count, NonNegativeInt
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation import config as evaluation


class EvalCommand(WhichPolicy):
    """Measures the results of a trained policy."""

    checkpoint: OnePolicy = None
    robot: MirrorRobot = None
    world: OtherWorld = None
    episodes: Count = evaluation.DEFAULT_EPISODES
    """Episodes, each from its own reset."""
    seed: NonNegativeInt = evaluation.DEFAULT_SEED
    """Seed of the resets."""
    nominal: bool = False
    """Evaluate without domain randomisation; else each episode samples a world, as in training."""
    contacts: bool = False
    """Also count contacts of the arm with itself and the floor, which the physics leaves out, in
    the first 32 episodes."""
    limits: bool = False
    """Also show how much of the arm's own limits of velocity, acceleration and jerk its commands at
    1 kHz use, in the first 32 episodes."""
    physics: evaluation.Physics = "config"
    """Physics engine: mujoco is MuJoCo's C engine; config is the engine used in training."""
    json_file: Annotated[Path | None, Flag(name="json")] = None
    """File to write the results to."""


def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 0 if all results pass, 1 if one fails, 2 on a mistake."""
    command, given_commands = parse_with_commands(EvalCommand, args, prog="bounce-mjx eval")
    from bounce_mjx.evaluation.contacts import arm_contacts, describe_contacts
    from bounce_mjx.evaluation.limits import describe_limits, limit_shares
    from bounce_mjx.evaluation.policy_evaluation import evaluate_policy
    from bounce_mjx.evaluation.statistics import RECORDED_EPISODES
    from bounce_mjx.reports.tables import details_line, results_table
    from bounce_mjx.runs.checkpoints import read_actor
    from bounce_mjx.runs.files import check_output, to_json, write_output
    from bounce_mjx.training.setup import set_up_jax

    check_output(command.json_file, "--json")
    console = stdout()
    checkpoint = command.choose(command.checkpoint, command.robot)
    if command.nominal and command.world is not None:
        raise UserError("--nominal and --world cannot be combined; omit one")
    config = command.config_of(checkpoint, command.robot, command.world)
    if command.limits and config.env.robot.limits.velocity is None:
        raise UserError("the policy's arm has no command limits (env.robot.limits); omit --limits")
    commands = given_commands.checked(config.env)
    set_up_jax(evaluation.on_engine(config.env, command.physics))
    checkpoint, policy, actor = read_actor(checkpoint, config)
    steps = f" ({checkpoint.steps:,} steps)" if checkpoint.steps else ""
    print(f"checkpoint: {checkpoint.folder}{steps}")
    options = evaluation.EvaluationOptions(
        command.episodes, command.seed, command.physics, command.nominal, commands
    )
    checks = [("contacts", arm_contacts, describe_contacts)] * command.contacts
    checks += [("limits", limit_shares, describe_limits)] * command.limits
    recorded = RECORDED_EPISODES if checks else 0
    with console.status("evaluating"):
        report, engine, warning = evaluate_policy(policy, config.env, actor, options, recorded)
    length = f"{command.episodes:,} episodes of {config.env.episode_seconds:g} s"
    print(f"physics: {engine}  {length}")
    if warning is not None:
        print(f"warning: {warning}")
    console.print(results_table(report, "the results"))
    print(details_line(report))
    found = {}
    for name, measure, describe in checks:
        entries = measure(config.env, report.recording)
        print(describe(entries, report.recording.running.shape[-1]))
        found[name] = [entry._asdict() for entry in entries]
    if command.json_file is not None:
        plain = {"checkpoint": str(checkpoint.folder), "physics": engine, **report.to_dict()}
        plain |= {"seed": command.seed, "commands": commands, "nominal": command.nominal, **found}
        write_output(command.json_file, to_json(plain))
    sys.exit(0 if report.passed else 1)
