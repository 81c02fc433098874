"""Shows a trained policy: `bounce-mjx play [CHECKPOINT ...]`."""

import shlex
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bounce_mjx.commands.goals import parse_with_goals
from bounce_mjx.commands.which_policy import (
    MirrorRobot,
    OtherRandomization,
    OtherWorld,
    WhichPolicy,
    suite_conditions,
    world_of_flags,
)
from bounce_mjx.config.command_line import (
    Flag,
    all_flags,
    flag_names,
    negated,
    plain_words,
    stdout,
)
from bounce_mjx.config.settings import Count, NonNegativeInt, fields_in
from bounce_mjx.errors import UserError, suggest
from bounce_mjx.evaluation.config import (
    DEFAULT_CONDITION_EPISODES,
    DEFAULT_EPISODES,
    DEFAULT_SEED,
    EvaluationOptions,
)
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.worlds import OWN
from bounce_mjx.viewers.options import MAX_ENVS, ViewerOptions
from bounce_mjx.world.randomization import RandomizationConfig

if TYPE_CHECKING:
    from bounce_mjx.env.env import Env
    from bounce_mjx.evaluation.policy_evaluation import InEvaluation
    from bounce_mjx.learning.policy import Actor
    from bounce_mjx.viewers.simulation import Controller


class PlayCommand(WhichPolicy):
    """Shows a trained policy, or several side by side."""

    checkpoints: Annotated[
        tuple[Path, ...], Flag(metavar="[CHECKPOINT ...]", is_positional=True)
    ] = ()
    """A run's folder (its best checkpoint), a checkpoint in it, latest for the newest run, or a
    policy that comes with the package: pretrained, robust, robust_small, or the name of a task or
    an arm. Several are shown side by side. The default is the newest run, or the task's policy in
    the package if there is no run. mirror stands for the mirror law, a model-based baseline."""
    viewing: ViewerOptions = ViewerOptions()
    robot: MirrorRobot = None
    world: OtherWorld = None
    randomization: OtherRandomization = RandomizationConfig()
    episode: NonNegativeInt | None = None
    """Episode of an evaluation to show again, as it was: its number in the list of bounce-mjx eval
    --failures, from 0. --seed, --episodes, --nominal and the world are then those of eval."""
    condition: Annotated[
        str | None, Flag(needs="episode", excludes=("nominal", "randomization", "goals"))
    ] = None
    """Condition of bounce-mjx robustness of which an episode is shown, such as "action latency
    40 ms"; --world is then that which the suite changes."""
    suite: Annotated[Path, Flag(needs="condition")] = Path("robustness")
    """Suite of the condition: a file, or the name of one in configs/."""
    episodes: Annotated[Count | None, Flag(needs="episode")] = None
    """Episodes of that evaluation; by default 1,024, of a condition 64."""
    nominal: Annotated[bool, Flag(needs="episode", excludes=("world", "randomization"))] = False
    """Whether that evaluation was without domain randomisation."""


def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 2 on a mistake."""
    command, given_goals = parse_with_goals(PlayCommand, args, prog="bounce-mjx play")
    if len(command.checkpoints) > MAX_ENVS:
        raise UserError(f"{len(command.checkpoints)} policies are given; give at most {MAX_ENVS}")
    world = world_of_flags(command.world, command.randomization)
    if command.condition is not None:
        # The suite changes the named world, or that of the training.
        world = OWN
    if command.episode is not None:
        _check_episode(command)
    # Before the seconds that imports and the compilation take.
    print("starting: the simulation is compiled, which takes longer the first time", flush=True)
    from bounce_mjx.reports.tables import count_text
    from bounce_mjx.runs.checkpoints import read_actor
    from bounce_mjx.runs.folders import MIRROR_LAW
    from bounce_mjx.training.setup import set_up_jax
    from bounce_mjx.viewers.film import film_player
    from bounce_mjx.viewers.show import Shown, show

    chosen = command.choose(*command.checkpoints or (None,), robot=command.robot)
    configs = [command.config_of(checkpoint, command.robot, world) for checkpoint in chosen]
    # All are of one task, which `show` checks, and so have the same goals.
    for config in configs:
        goals = given_goals.checked(config.env)
    set_up_jax(*(config.env for config in configs))
    shown = []
    for choice, config in zip(chosen, configs, strict=True):
        checkpoint, policy, actor = read_actor(choice, config)
        print(f"checkpoint: {checkpoint.folder}")
        title = checkpoint.run.name
        if checkpoint is not MIRROR_LAW:
            title += f", {count_text(checkpoint.steps)} steps"
        film = None
        if command.episode is not None:
            title += f", episode {command.episode}"
            find = _episode_finder(command, config, goals)
            film = film_player(find, actor, policy, _evaluation_seed(command))
        shown.append(Shown(config.env, partial(_controller, actor), title, policy, film))
    show(shown, command.viewing, goals=goals, console=stdout())


def film_command(
    args: Sequence[str],
    command_class: type[WhichPolicy],
    *film: str,
    imports: Sequence[str] = (),
) -> str:
    """The command that shows an episode of the evaluation that a command line started: its words,
    without the flags that `play` lacks.

    Args:
      args: the words of the command line.
      command_class: what they were read into; each of those flags has one value, or is a switch.
      film: the flags of the episode.
      imports: those of the user's own task.
    """
    known = all_flags(fields_in(PlayCommand))
    fields = fields_in(command_class)
    switches: set[str] = set()
    with_value: set[str] = set()
    for key, flag in flag_names(fields).items():
        if flag in known:
            continue
        if fields[key].annotation is bool:
            switches |= {flag, negated(flag)}
        else:
            with_value.add(flag)
    kept = []
    words = iter(plain_words(args))
    for word in words:
        flag, equals, _ = word.partition("=")
        if flag in with_value and not equals:
            # Its value.
            next(words, None)
        elif flag not in switches | with_value:
            kept.append(word)
    return shlex.join(["bounce-mjx", "play", *kept, *film, *imports])


def _controller(make_actor: "Callable[[Env], Actor]", env: "Env") -> "Controller":
    """What moves the simulated arm of an environment."""
    from bounce_mjx.viewers.simulation import make_policy_controller

    return make_policy_controller(make_actor(env))


def _evaluation_seed(command: PlayCommand) -> int:
    """Seed of the evaluation of which an episode is shown."""
    return command.viewing.seed if "seed" in command.viewing.model_fields_set else DEFAULT_SEED


def _num_episodes(command: PlayCommand) -> int:
    """Number of episodes of that evaluation."""
    default = DEFAULT_CONDITION_EPISODES if command.condition else DEFAULT_EPISODES
    return command.episodes or default


def _episode_finder(
    command: PlayCommand, config: TrainConfig, goals: dict[str, float]
) -> "Callable[[], InEvaluation]":
    """What finds the place of the episode in that evaluation.

    Raises:
      UserError: the suite has no such condition.
    """
    from bounce_mjx.evaluation.policy_evaluation import InEvaluation, setup_of
    from bounce_mjx.evaluation.robustness import find_episode

    options = EvaluationOptions(
        episodes=_num_episodes(command),
        seed=_evaluation_seed(command),
        nominal=command.nominal,
        goals=goals,
    )
    if command.condition is None:
        return lambda: InEvaluation(
            setup_of(config.env, options), options.episodes, command.episode
        )
    suite, conditions, _ = suite_conditions(command.suite, config, command.world)
    labels = [condition.label for condition in conditions]
    if command.condition not in labels:
        advice = suggest(command.condition, labels) or f"give one such as {labels[-1]!r}"
        raise UserError(f"{suite} has no condition {command.condition!r}; {advice}")
    index = labels.index(command.condition)
    return partial(find_episode, conditions, index, options, command.episode)


def _check_episode(command: PlayCommand) -> None:
    """Raises UserError if there is no such episode of one policy."""
    if len(command.checkpoints) > 1 or command.viewing.num_envs > 1:
        raise UserError("--episode shows one episode of one policy; give one policy, one robot")
    episodes = _num_episodes(command)
    if command.episode >= episodes:
        raise UserError(
            f"--episode is {command.episode}, but the evaluation has the {episodes:,} "
            f"episodes 0 to {episodes - 1:,}; give one of them, or its --episodes"
        )
