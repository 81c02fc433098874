"""What a training begins with, which fixes the classes of its settings: the first word, and the
flags --algorithm and --warm-start beside it."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic.fields import FieldInfo

from bounce_mjx.config.command_line import Flag
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.config.user_code import not_imported, own_name, own_names
from bounce_mjx.errors import UserError, shorten, suggest
from bounce_mjx.learning.config import PPO_NAME, PPOConfig
from bounce_mjx.learning.registry import find_algorithm, own_algorithm
from bounce_mjx.resources import POLICIES, policy_folder
from bounce_mjx.runs.config import (
    TrainConfig,
    copied_code,
    fields_of_training,
    is_as_copied,
    load_run_config,
    runs_folder,
)
from bounce_mjx.task.registry import DEFAULT, find_task, is_task, registered_tasks, task_name
from bounce_mjx.task.task import Task


class StartFlags(StrictModel):
    """The flags that decide, with the first word, what a training begins with. They are keys of the
    config, too: the algorithm's class, the policy of a warm start, and the folder in which a new
    run is made and latest is looked for."""

    algorithm: str | None = None
    warm_start: Path | None = None
    log_dir: Path | None = None


class FileFlags(StrictModel):
    """The files whose values lie on the start."""

    config: Annotated[tuple[Path, ...], Flag(metavar="NAME|FILE", is_repeated=True)] = ()
    """Preset, such as cpu or finetune (a YAML file in configs/), or a YAML file of yours. A task's
    own preset of that name, such as configs/track/cpu.yaml, takes its place. The default is default
    on an accelerator, and cpu on a CPU. A file of yours lies on that default, or on the preset that
    its key base names. Given again, each file lies on those before it."""
    robot: Annotated[Path | None, Flag(metavar="NAME|FILE")] = None
    """Config of a robot on top of the preset: the file that bounce-mjx adopt wrote, or the name of
    one in configs/robots/ (ur5e, panda or iiwa)."""
    world: Annotated[Path | None, Flag(metavar="NAME|FILE")] = None
    """Named world in place of the preset's: a YAML file, or the name of one in configs/worlds/
    (ur5e_rtde, panda_fci, iiwa_fri or fast_servo). It may have a robot."""


class Choice(StartFlags, FileFlags):
    """The first word and these flags: all that decides which layers there are."""

    word: Annotated[
        str | None,
        Flag(metavar="[TASK|POLICY|RUN]", is_positional=True, instead_of=("--task", "--resume")),
    ] = None
    """First word: a task (bounce by default, balance, catch, juggle, track, or one of yours, which
    --import FILE.py names), trained from the start; a policy that comes with the package, such as
    robust_small, from whose networks a training starts, in its environment; or a run's folder, a
    checkpoint in one, or latest for the newest run of bounce or of --log-dir, which continues in
    place. A word that is a task and a policy, such as catch, is the task. Of a resumed run, flags
    may change only total-steps, eval-every, save-every, keep-checkpoints, eval-episodes,
    screening-episodes, eval-seed, stop-when-solved and num-devices."""


class Start(NamedTuple):
    """What a training begins with, which fixes the classes of its settings."""

    task: type[Task]
    task_name: str
    algorithm_config: type[PPOConfig]
    """Type of the settings of the algorithm."""
    algorithm_name: str
    named: dict[str, Any]
    """What the user names of it, by the keys of the config: the task, the algorithm, the policy of
    a warm start. It wins over every layer."""
    warm_start: Path | None = None
    """The policy of a warm start: its name, or its checkpoint's folder."""
    warm_config: TrainConfig | None = None
    """Config of the training of that policy."""
    whole: TrainConfig | None = None
    """A whole config, of Python, whose task and algorithm these are; no preset lies below it."""
    place: Path | None = None
    """Folder of the run that is resumed, or a checkpoint in it."""
    resumed_config: TrainConfig | None = None
    """Config of that run."""
    notes: tuple[str, ...] = ()
    """Which run latest stands for."""

    @property
    def fields(self) -> dict[str, FieldInfo]:
        """The settings that a training from here has, by dotted key."""
        return fields_of_training(self.task.Config, self.algorithm_config)


def find_start(word: str | None, flags: StartFlags, whole: TrainConfig | None = None) -> Start:
    """What the first word means: a task, a policy or a run; and what the flags beside it name. A
    task wins over a policy or a folder of its name; a folder over a policy of the package
    (`resources.policy_folder`).

    Args:
      word: None for the default task, or that of a whole config or a warm start.
      whole: see `Start`.

    Raises:
      UserError: there is no such thing, or two of these exclude each other.
    """
    if word is None or is_task(word):
        return _new_start(word, flags.warm_start, flags, whole)
    # None where a folder of the user's has the name.
    if policy_folder(word):
        if flags.warm_start is not None:
            raise UserError(
                f"{word} and the warm start {flags.warm_start} are two policies; leave one out"
            )
        return _new_start(None, Path(word), flags, whole)
    # Imports JAX, which a task's help does not need.
    from bounce_mjx.runs.folders import LATEST, means_newest

    # The word latest, or a folder.
    if means_newest(Path(word)) or os.path.isdir(word):
        return _start_of_run(Path(word), flags, whole)
    if os.path.isfile(word):
        flag = "--import" if word.endswith(".py") else "--config"
        raise UserError(f"{word} is a file, and no task, policy or run; give {flag} {word}")
    known = list(dict.fromkeys((*registered_tasks(), *own_names(Task), *POLICIES)))
    own = "a run's folder, or --import FILE.py for a task of your own"
    advice = suggest(word, [*known, LATEST]) or f"give {', '.join(known)}, {own}"
    raise UserError(f"there is no task, policy or run {shorten(word)}; {advice}")


def _new_start(
    word: str | None, named_policy: Path | None, flags: StartFlags, whole: TrainConfig | None
) -> Start:
    """The start of a new run.

    Args:
      word: the task, if the user names it.
      named_policy: the policy of a warm start, if the user names it. The training is of its task,
        unless the word is another one, and of its environment and networks, but not of its
        algorithm: without --algorithm that is PPO.
    """
    named: dict[str, Any] = {}
    warm_start = named_policy
    if named_policy is None and whole is not None:
        warm_start = whole.warm_start
    warm_config: TrainConfig | None = None
    notes: tuple[str, ...] = ()
    if warm_start is not None:
        folder = _folder_of_runs(flags.log_dir, word, whole)
        warm_start, warm_config, notes = _policy_of(warm_start, folder)
    if named_policy is not None:
        named["warm_start"] = warm_start
    task = _task_of(word, whole, warm_config)
    if word is not None:
        named["task"] = task_name(task)
    algorithm_name, algorithm_config = _algorithm(flags.algorithm, whole)
    if flags.algorithm is not None:
        named["algorithm"] = algorithm_name
    return Start(
        task=task,
        task_name=task_name(task),
        algorithm_config=algorithm_config,
        algorithm_name=algorithm_name,
        named=named,
        warm_start=warm_start,
        warm_config=warm_config,
        whole=whole,
        notes=notes,
    )


def _task_of(
    word: str | None, whole: TrainConfig | None, warm_config: TrainConfig | None
) -> type[Task]:
    """The task that the word names; without one, that of a whole config, of the policy of a warm
    start, or the default.

    Args:
      warm_config: of the policy of a warm start.

    Raises:
      UserError: the word names another task than a whole config, or one that neither extends the
        policy's nor is extended by it.
    """
    if word is None:
        config = whole or warm_config
        return find_task(DEFAULT) if config is None else config.env.task
    task = find_task(word)
    if whole is not None and whole.env.task is not task:
        raise UserError(
            f"the config is of the task {whole.task}, and the first argument is {word}; leave it "
            "out"
        )
    if warm_config is not None:
        its_task = warm_config.env.task
        if not (issubclass(task, its_task) or issubclass(its_task, task)):
            raise UserError(
                f"the warm start is a policy of the task {warm_config.task}, and this training of "
                f"{word}; leave {word} out, or give a policy of it"
            )
    return task


def check_not_given(run: Path, given: Mapping[str, Any]) -> None:
    """Checks that nothing is given of what a run has already, with which it is resumed.

    Raises:
      UserError: something is.
    """
    for name, value in given.items():
        if value:
            raise UserError(
                f"the run {run} has its {name}, with which it is resumed; leave {name} out, or "
                f"start a new run from its networks: --warm-start {run}"
            )


def _start_of_run(word: Path, flags: StartFlags, whole: TrainConfig | None) -> Start:
    """The start of a run that is resumed."""
    from bounce_mjx.runs.folders import check_log_dir, place_or_newest, run_of

    if flags.log_dir is not None:
        check_log_dir([word])
    given = {"algorithm": flags.algorithm, "warm_start": flags.warm_start, "config": whole}
    check_not_given(word, given)
    # Without a folder, latest is the newest run of the default task.
    place = place_or_newest(word, flags.log_dir or runs_folder(find_task(DEFAULT)))
    run = run_of(place)
    config = load_run_config(run)
    classes: dict[str, type] = {"task": config.env.task}
    if config.algorithm != PPO_NAME:
        algorithm = own_algorithm(config.algorithm)
        if algorithm is None:
            code = copied_code(run, "algorithm")
            raise not_imported(f"the run {run}", "algorithm", config.algorithm, code)
        classes["algorithm"] = algorithm
    # Its settings are no settings of other code.
    for key, kind in classes.items():
        if not is_as_copied(kind, run, key):
            raise UserError(
                f"{run} cannot be resumed with another {key} than it was trained with; import "
                f"{copied_code(run, key)}, or start a new run"
            )
    return Start(
        task=config.env.task,
        task_name=config.task,
        algorithm_config=type(config.ppo),
        algorithm_name=config.algorithm,
        named={},
        place=place,
        resumed_config=config,
    )


def _policy_of(path: Path, log_dir: Path) -> tuple[Path, TrainConfig, tuple[str, ...]]:
    """The policy of a warm start: its name or its checkpoint's folder, the config of its run, and
    which run latest stands for."""
    from bounce_mjx.runs.folders import choose_checkpoint

    notes: list[str] = []
    checkpoint = choose_checkpoint(path, log_dir, notes.append)
    place = path if policy_folder(path) else checkpoint.folder
    return place, load_run_config(checkpoint.run), tuple(notes)


def _folder_of_runs(log_dir: Path | None, task: str | None, whole: TrainConfig | None) -> Path:
    """Where the newest run is looked for: beside the new one, or among those of the task."""
    from bounce_mjx.runs.folders import runs_in

    # A new folder has no run yet that latest could stand for.
    if log_dir is not None and runs_in(log_dir):
        return log_dir
    return runs_folder(find_task(task or DEFAULT) if whole is None else whole.env.task)


def _algorithm(name: str | None, whole: TrainConfig | None) -> tuple[str, type[PPOConfig]]:
    """Name of the algorithm, and the type of its settings.

    Raises:
      UserError: there is none, or the whole config disagrees with itself.
    """
    if whole is not None and name is None:
        algorithm_config = _config_of(whole.algorithm)
        if algorithm_config is not type(whole.ppo):
            raise UserError(
                f"the config's ppo is {type(whole.ppo).__qualname__}, and its algorithm "
                f"{whole.algorithm} has {algorithm_config.__qualname__}; name the algorithm that "
                "has them"
            )
        return whole.algorithm, algorithm_config
    if name in (None, PPO_NAME):
        return PPO_NAME, PPOConfig
    algorithm = find_algorithm(name)
    return own_name(algorithm), algorithm.Config


def _config_of(algorithm: str) -> type[PPOConfig]:
    """Type of the settings of an algorithm, by its name; PPO's without the import of JAX."""
    return PPOConfig if algorithm == PPO_NAME else find_algorithm(algorithm).Config
