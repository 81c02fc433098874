"""Which policy a command is about, and the flags that several commands share."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from bounce_mjx.config.command_line import Flag
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import UserError, suggest
from bounce_mjx.resources import policy_folder
from bounce_mjx.runs.config import TrainConfig, load_run_config, runs_folder
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.runs.presets import named_file
from bounce_mjx.runs.worlds import OWN, World, read_named_world, settings_in_world
from bounce_mjx.task.registry import DEFAULT, find_task
from bounce_mjx.world.randomization import RandomizationConfig

if TYPE_CHECKING:
    from bounce_mjx.evaluation.suite import Condition
    from bounce_mjx.runs.folders import Checkpoint

MIRROR = "mirror"
"""Name of the mirror law in place of a checkpoint."""

OnePolicy = Annotated[
    Path | None,
    Flag(metavar="[CHECKPOINT]", is_positional=True),
    Field(
        description="A run's folder (its best checkpoint), a checkpoint in it, latest for the "
        "newest run, a policy that comes with the package (pretrained, robust, robust_small, or "
        "the name of a task or an arm), or mirror for the mirror law, a model-based baseline. The "
        "default is the newest run, or the task's policy in the package if there is no run."
    ),
]
"""Type of the flag for one policy or the mirror law."""

MirrorRobot = Annotated[
    Path | None,
    Field(description="Robot of the mirror law; a policy has that of its training."),
]
"""Type of the flag for the robot of the mirror law."""

OtherWorld = Annotated[
    Path | None,
    Flag(excludes=("randomization",)),
    Field(
        description="World in place of that of the training: a YAML file, or the name of one in "
        "configs/worlds/ (ur5e_rtde, panda_fci, iiwa_fri or fast_servo)."
    ),
]
"""Type of the flag for the world of the episodes."""


OtherRandomization = Annotated[
    RandomizationConfig,
    Field(description="World of the episodes if a term is given, in place of the training's."),
]
"""Type of the flags for a what-if world."""


def world_of_flags(world: Path | None, randomization: RandomizationConfig) -> World:
    """The world that a command's flags ask for; `OWN` without one. --nominal is an option of
    the evaluation, `EvaluationOptions.nominal`, which fixes the goals too.

    Raises:
      UserError: what is given of --randomization has no term to act on.
    """
    if randomization.terms:
        return randomization
    if randomization != RandomizationConfig():
        raise UserError(
            "--randomization is given without a term of the world, such as "
            "--randomization.air-drag 0 0.2; give one, or omit it"
        )
    return OWN if world is None else world


def suite_conditions(
    suite: Path, config: TrainConfig, world: Path | None
) -> tuple[Path, list["Condition"], int]:
    """The file of a suite, its conditions for a policy, and how many of them, after the nominal
    one, double or halve what the world assumes.

    Args:
      suite: a file, or the name of one in configs/.
      config: of the policy's training.
      world: that each condition changes; by default, the model's own.

    Raises:
      UserError: suite or world is missing or wrong.
    """
    from bounce_mjx.evaluation.suite import load_suite
    from bounce_mjx.world.model import model_nominals

    path = named_file(suite, "configs")
    if world is None:
        return path, load_suite(path, config.env), 0
    there = settings_in_world(config.env, world)
    _, named = read_named_world(world)
    assumed = named.double_assumed(model_nominals(there))
    return path, load_suite(path, config.env, there, assumed), len(assumed)


class WhichPolicy(StrictModel):
    """Where a command looks for its policy: a task's runs, or a folder. A command adds the flags
    for its paths, and for the robot and the world if it simulates."""

    task: str | None = None
    """Task whose newest run it is, by default bounce."""
    log_dir: Path | None = None
    """Folder in which to look for the newest run; by default, that of the task's runs."""

    def choose(self, *paths: Path | None, robot: Path | None = None) -> list["Checkpoint"]:
        """The checkpoint of each path: `choose_checkpoint`, or `MIRROR_LAW` for the word mirror.

        Args:
          robot: of the mirror law.

        Raises:
          UserError: there is none, a robot is given for a policy, or --log-dir beside named ones.
        """
        folder = self.folder_for(*paths)
        return [self._choose(path, folder, robot) for path in paths]

    def choose_places(self, *paths: Path | None) -> list[Path]:
        """The place of each path, in a run with a log: `place_or_newest`.

        Raises:
          UserError: there is none, it is a policy of the package, which has no log, or --log-dir is
            given beside named ones.
        """
        from bounce_mjx.runs.folders import place_or_newest

        folder = self.folder_for(*paths)
        for path in paths:
            if policy_folder(path) is not None:
                raise UserError(
                    f"the policy {path} comes with the package, without the log of its training; "
                    "give a run's folder"
                )
        return [place_or_newest(path, folder) for path in paths]

    def folder_for(self, *paths: Path | None) -> Path:
        """Where the newest run is looked for: `log_dir`, or the folder of the task's runs.

        Raises:
          UserError: --log-dir is given, and each path is that of a run or a policy.
        """
        if self.log_dir is None:
            return runs_folder(find_task(self.task or DEFAULT))
        from bounce_mjx.runs.folders import check_log_dir

        check_log_dir(paths)
        return self.log_dir

    @staticmethod
    def _choose(path: Path | None, folder: Path, robot: Path | None) -> "Checkpoint":
        from bounce_mjx.runs.folders import MIRROR_LAW, choose_checkpoint

        is_folder = path is not None and os.path.isdir(path)
        if str(path) == MIRROR and not is_folder:
            return MIRROR_LAW
        if path is not None and not is_folder and (near := suggest(str(path), [MIRROR])):
            raise UserError(f"there is no run and no policy {path}; {near}")
        if robot is not None:
            raise UserError("--robot is for the mirror law; omit it, or give mirror as checkpoint")
        return choose_checkpoint(path, folder)

    def config_of(
        self, checkpoint: "Checkpoint", robot: Path | None = None, world: World = OWN
    ) -> TrainConfig:
        """The config of a checkpoint's run, or that of the mirror law, the task's preset; with its
        environment in the world of the episodes.

        Args:
          robot: of the mirror law.

        Raises:
          UserError: as `load_run_config`, `read_preset` and `settings_in_world`.
        """
        from bounce_mjx.baselines.mirror import observing
        from bounce_mjx.runs.folders import MIRROR_LAW

        if checkpoint is MIRROR_LAW:
            config = read_preset(Path("default"), robot, self.task)
            env = observing(config.env)
        else:
            config = load_run_config(checkpoint.run)
            env = config.env
        return config.model_copy(update={"env": settings_in_world(env, world)})
