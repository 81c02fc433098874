"""The settings of a training run, typed, and the reading of a run's own."""

from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
import yaml
from pydantic import Field
from pydantic.fields import FieldInfo

from bounce_mjx.config.settings import Count, NonNegativeInt, Steps, StrictModel, fields_in
from bounce_mjx.config.user_code import code_file_of, import_flags, not_imported
from bounce_mjx.config.validation import ConfigT, unknown_key, validate
from bounce_mjx.errors import UserError, warn_once
from bounce_mjx.evaluation.config import DEFAULT_SEED
from bounce_mjx.learning.config import PPO_NAME, PPOConfig
from bounce_mjx.learning.registry import own_algorithm
from bounce_mjx.robot.config import is_packaged
from bounce_mjx.runs.presets import BASE, SOURCES, read_config_file
from bounce_mjx.runs.storage import check_integrity
from bounce_mjx.task.registry import DEFAULT, find_task, is_task, task_name
from bounce_mjx.task.task import Task
from bounce_mjx.world.config import WorldConfig

CONFIG_FILE = "config.yaml"
ROBOT = "robot"
"""Folder of a run with a copy of its robot."""
RESUMABLE_KEYS = frozenset(
    "total_steps eval_every save_every keep_checkpoints eval_episodes screening_episodes eval_seed "
    "stop_when_solved log_dir num_devices".split()
)
"""Keys that do not affect what a training learns in a number of steps: they may differ between a
checkpoint and the training that resumes from it. All others must be the same."""
DEFAULT_SOURCE = "default"
"""Source of a setting that no layer set."""


def runs_folder(task: type[Task]) -> Path:
    """Default folder of a task's runs."""
    # A task that extends another one has its own folder.
    return Path("runs") / (vars(task).get("folder") or task.__name__.lower())


def _default_env(known: dict[str, Any]) -> WorldConfig:
    return find_task(known.get("task", DEFAULT)).Config()


def _default_log_dir(known: dict[str, Any]) -> Path:
    # Without a valid env, there is another error.
    return runs_folder(known["env"].task) if "env" in known else Path("runs")


def _check_eval_seed(seed: int) -> int:
    if seed == DEFAULT_SEED:
        raise ValueError(
            f"{seed} is the seed of bounce-mjx eval, whose results would be of the episodes by "
            "which the training chose its best checkpoint; give another"
        )
    return seed


EvalSeed = Annotated[NonNegativeInt, pydantic.AfterValidator(_check_eval_seed)]


class TrainConfig(StrictModel):
    """A training run: the task, the algorithm, the length and the evaluations. `task` is the task's
    name, and `env.task` its class."""

    task: str = DEFAULT
    """Name of the task."""
    env: pydantic.SerializeAsAny[WorldConfig] = Field(default_factory=_default_env)
    """The settings of the task's `Config`: those that every task has, such as friction
    (`WorldConfig`), and its own."""
    algorithm: str = PPO_NAME
    """ppo, or the name of an imported subclass of `bounce_mjx.learning.ppo.PPO` or
    `bounce_mjx.learning.algorithm.Algorithm`."""
    ppo: pydantic.SerializeAsAny[PPOConfig] = PPOConfig()
    """The settings of the algorithm, those of its `Config`, also of one that is no PPO: the presets
    have this key, and every policy has the network that PPO's settings describe."""
    seed: NonNegativeInt = 0
    """Seed of the run."""
    num_seeds: Count = 1
    """Independent training runs in one program, with the seeds `seed`, `seed` + 1, ... and a folder
    for each."""
    num_devices: Count | None = None
    """Devices that share the environments (with several seeds: the seeds); null for one, or all on
    several hosts."""
    total_steps: Steps = 50_000_000
    """Environment steps to train for, rounded to whole blocks, at least one."""
    block_steps: Steps = 1_000_000
    """Environment steps between two progress reports, rounded to whole iterations."""
    eval_every: Steps = 2_000_000
    """Environment steps between two evaluations, rounded to whole blocks."""
    save_every: Steps | None = None
    """Environment steps between two saved states, rounded to whole blocks, in addition to those
    after each evaluation; null for these alone."""
    keep_checkpoints: Count | Literal["all"] = 1
    """Newest checkpoints that stay, or all, in addition to the one of the best evaluation. Of
    several seeds these are the run's, which hold the state of all seeds; a seed's own folder has
    its best one. Of a run that is resumed from an older checkpoint, the next save removes the later
    ones."""
    eval_episodes: Count = 1024
    """Episodes of an evaluation of the results."""
    screening_episodes: NonNegativeInt = 0
    """Episodes with which an evaluation begins; they double as long as the policy may become the
    best. 0 for all at once."""
    eval_seed: EvalSeed = 10_000
    """Seed of the evaluations during training; not that of `bounce-mjx eval`."""
    # The end is `Progress.may_end`; how far inside each bound a margin is, `task/results.py` says.
    stop_when_solved: bool = False
    """End once an evaluation meets all results with a margin, so clearly that 64 other episodes
    should meet them too (they are not run). Where no margin comes, end with the evaluation after
    1.5 times the steps of the first trained policy that met all."""
    warm_start: Path | None = None
    """Run, or policy of the package, from whose networks and environment the training starts."""
    log_dir: Path = Field(default_factory=_default_log_dir)
    """Folder in which the run creates its own, named by the time (UTC)."""

    _sources: dict[str, str] = pydantic.PrivateAttr(default_factory=dict)

    @property
    def sources(self) -> dict[str, str]:
        """What set each value, by its dotted key, such as configs/cpu.yaml for ppo.num_envs; a
        setting that nothing set has its default."""
        sources = dict.fromkeys(fields_of_training(type(self.env), type(self.ppo)), DEFAULT_SOURCE)
        for key, source in self._sources.items():
            # Of a mapping, such as `shares`, each entry has a source.
            while key and key not in sources:
                key = key.rpartition(".")[0]
            if key:
                sources[key] = source
        return sources

    @property
    def training_episode_steps(self) -> int:
        """Control steps after which the training truncates an episode."""
        limit = self.ppo.training_episode_seconds or self.env.episode_seconds
        return min(self.env.episode_steps, max(1, round(limit / self.env.control_dt)))

    @property
    def iterations_per_block(self) -> int:
        """Iterations of the algorithm in one block."""
        return max(1, round(self.block_steps / self.ppo.batch_steps))

    @property
    def steps_per_block(self) -> int:
        """Environment steps of a block, which is never divided."""
        return self.iterations_per_block * self.ppo.batch_steps

    def in_whole_blocks(self, steps: int) -> int:
        """The number of steps, of whole blocks, that is nearest to a number; at least one block."""
        return self.steps_per_block * max(1, round(steps / self.steps_per_block))

    @property
    def rounded_steps(self) -> dict[str, int]:
        """The settings that are numbers of steps, by key, in the whole blocks that are trained."""
        numbers = {}
        for key in ("total_steps", "block_steps", "eval_every", "save_every"):
            steps = getattr(self, key)
            if steps is not None:
                numbers[key] = self.in_whole_blocks(steps)
        return numbers

    @property
    def adapts_learning_rate(self) -> bool:
        """Whether `target_kl` adapts the learning rate after each minibatch, so that
        `ppo.learning_rate` is only the first one; an algorithm of the user's may have a schedule of
        its own."""
        return self.algorithm == PPO_NAME and self.ppo.target_kl > 0.0

    def set_sources(self, sources: dict[str, str]) -> None:
        """Notes what set the values, by their dotted keys."""
        self._sources = sources

    def __eq__(self, other: object) -> bool:
        """Equal settings are equal, whatever set them."""
        return isinstance(other, TrainConfig) and dict(self) == dict(other)

    @pydantic.model_validator(mode="before")
    @classmethod
    def _name_task(cls, values: Any) -> Any:
        """The settings of a task determine its name."""
        env = values.get("env") if isinstance(values, dict) else None
        if isinstance(env, WorldConfig) and env.task is not None and "task" not in values:
            return values | {"task": task_name(env.task)}
        return values

    @pydantic.field_validator("env", mode="before")
    @classmethod
    def _read_env(cls, env: Any, info: pydantic.ValidationInfo) -> Any:
        """Plain settings as those of the named task; `runs.layers` gives settings that are
        typed."""
        if "task" not in info.data:
            return env
        if isinstance(env, WorldConfig):
            _check_task(env, info.data["task"])
            return env
        return find_task(info.data["task"]).Config.model_validate(env)


def _check_task(env: WorldConfig, name: str) -> None:
    """Checks the settings of a task against its name.

    Raises:
      ValueError: they are those of another task.
    """
    if env.task is None or task_name(env.task) == name:
        return
    raise ValueError(
        f"these are the settings of {env.task.__qualname__}, and task is {name}; leave task out"
    )


def fields_of_training(
    task_config: type[WorldConfig], algorithm_config: type[PPOConfig] = PPOConfig
) -> dict[str, FieldInfo]:
    """The settings of a training by their dotted keys, such as env.reward.height.weight.

    Args:
      task_config: the type of the task's settings.
      algorithm_config: that of the algorithm's.

    Raises:
      UserError: a setting of the task has the name of one of the algorithm.
    """
    _check_names(task_config, algorithm_config)
    groups = {"env": task_config, "ppo": algorithm_config}
    fields = {}
    for name, field in TrainConfig.model_fields.items():
        if name in groups:
            fields |= fields_in(groups[name], f"{name}.")
        else:
            fields[name] = field
    return fields


def _check_names(task_config: type[WorldConfig], algorithm_config: type[PPOConfig]) -> None:
    """Checks that no setting of a task has the name of one of the algorithm: of both, the flag and
    the key that stands alone would be one, as in --num-envs.

    Raises:
      UserError: one has.
    """
    for name in fields_in(task_config):
        if name in algorithm_config.model_fields:
            raise UserError(
                f"env.{name} and ppo.{name} have the same name; give the setting of the task, or "
                "of the algorithm, another one"
            )


def load_run_config(run: Path) -> TrainConfig:
    """Reads the resolved config of a run. Without the code of the user's own algorithm, it lacks
    the settings of that, of which whatever acts with the policy needs none.

    Raises:
      UserError: the file is missing, damaged or of another version, the run's copy of its robot was
        edited, or its task is code that was not imported.
    """
    path = run / CONFIG_FILE
    values = {"task": DEFAULT} | read_config_file(path)
    values.pop(BASE, None)
    sources = _sources_in(values.pop(SOURCES, None))
    its_task = task_named_by(f"the run {run}", values["task"], copied_code(run, "task"))
    if not is_as_copied(its_task, run, "task"):
        now = code_file_of(its_task)
        warn_once(
            f"{now.path if now else its_task.__module__} differs from the task that {run} was "
            f"trained with, {copied_code(run, 'task')}"
        )
    env = _validate_stored(its_task.Config, values.get("env", {}), path, "env")
    values = values | {"env": env}
    algorithm = own_algorithm(values.get("algorithm", PPO_NAME))
    if algorithm is not None and is_as_copied(algorithm, run, "algorithm"):
        ppo = _validate_stored(algorithm.Config, values.get("ppo", {}), path, "ppo")
        values |= {"ppo": ppo}
    else:
        values = without_own_settings(values)
    config = _validate_stored(TrainConfig, values, path)
    config.set_sources(sources)
    if config.env.mjcf is not None and not is_packaged(config.env.mjcf):
        try:
            check_integrity(run / ROBOT)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(
                f"{run / ROBOT} is not the robot of the training ({reason}); restore that folder"
            ) from error
    return config


def _validate_stored(
    kind: type[ConfigT], values: dict[str, Any], path: Path, group: str = ""
) -> ConfigT:
    """`validate` of what a training wrote, in which an unknown key is no slip of the user's."""
    try:
        return validate(kind, values, str(path), group)
    except UserError as error:
        key = unknown_key(error, group)
        if key is None:
            raise
        raise UserError(
            f"{path} has the setting {key}, which is unknown here, as another version of the "
            "package or of the task wrote it; train again"
        ) from error


def without_own_settings(stored: dict[str, Any]) -> dict[str, Any]:
    """A run's plain config without the settings of the user's own algorithm, if it has one: its
    code does not run, and whatever acts with its policy needs none of them."""
    ppo = stored.get("ppo")
    if not isinstance(ppo, dict) or stored.get("algorithm", PPO_NAME) == PPO_NAME:
        return stored
    known = {key: value for key, value in ppo.items() if key in PPOConfig.model_fields}
    return stored | {"ppo": known}


def dump_sources(config: TrainConfig) -> str:
    """What set the values of a config, as YAML: the dotted keys of each source."""
    keys: dict[str, list[str]] = {}
    for key, source in config.sources.items():
        keys.setdefault(source, []).append(key)
    keys.pop(DEFAULT_SOURCE, None)
    plain = {SOURCES: keys} if keys else {}
    return yaml.safe_dump(plain, default_flow_style=None, width=100) if plain else ""


def _sources_in(stored: Any) -> dict[str, str]:
    """The source of each key, from the keys of each source; none from a run without them."""
    if not isinstance(stored, dict):
        return {}
    sources = {}
    for source, keys in stored.items():
        if isinstance(keys, list):
            sources |= dict.fromkeys(map(str, keys), str(source))
    return sources


def copied_code(run: Path, key: str) -> Path | None:
    """The file in a run with a copy of the code of its own task or algorithm; None where a package
    has it.

    Args:
      key: task or algorithm.
    """
    files = sorted((run / key).glob("*.py"))
    return files[0] if files else None


def import_flags_of_run(run: Path, *, to_train: bool = False) -> list[str]:
    """The flags with which a later command about a run imports the user's own code: the run's
    copies, which are what it was trained with, wherever it is moved to and whatever became of the
    user's own file since.

    Args:
      to_train: whether the command trains, for which it also needs the run's own algorithm;
        whatever acts with the policy needs the task alone.
    """
    keys = ["task", "algorithm"] if to_train else ["task"]
    # One file may hold both, and is imported once.
    copies: dict[bytes, Path] = {}
    for key in keys:
        copy = copied_code(run, key)
        if copy is not None:
            copies.setdefault(copy.read_bytes(), copy)
    return import_flags(copies.values())


def is_as_copied(kind: type, run: Path, key: str) -> bool:
    """Whether the code of a task or an algorithm is as the run has copied it (`copied_code`); True
    where it has no copy, and for a class without a file.

    Args:
      kind: the class of the task or algorithm, as it was imported now.
    """
    copy = copied_code(run, key)
    now = code_file_of(kind)
    return copy is None or now is None or copy.read_bytes() == now.content


def task_named_by(source: str, name: str, code: Path | None = None) -> type[Task]:
    """The task that a file or a run names.

    Args:
      code: its code, where it is known.

    Raises:
      UserError: there is none, or it is code that was not imported.
    """
    if code is not None and not is_task(name):
        raise not_imported(source, "task", name, code)
    return find_task(name)
