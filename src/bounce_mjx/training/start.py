"""The config of a training: that of its start, and what the user changes in it."""

from pathlib import Path
from typing import Annotated, Any

from bounce_mjx.config.command_line import Flag
from bounce_mjx.config.files import differing_keys
from bounce_mjx.config.settings import Steps, StrictModel, merged
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError, suggest
from bounce_mjx.runs.config import TrainConfig, load_run_config, read_preset, runs_folder
from bounce_mjx.runs.task import is_same_task
from bounce_mjx.tasks.registry import DEFAULT, find_task, is_file


class Start(StrictModel):
    """What a training starts from: flags of the command, and arguments of `train`."""

    config: Annotated[tuple[Path, ...], Flag(metavar="PATH", is_repeated=True)] = ()
    """Preset: the name of a YAML file in configs/, such as cpu or finetune; a task's own preset of
    that name, such as configs/track/cpu.yaml, has priority. The default is default on an
    accelerator, and cpu on a CPU. A YAML file of yours lies on that default, or on the preset that
    its key base names. Given again, each file lies on those before it."""
    robot: Path | None = None
    """Config of a robot on top of the preset: the file that bounce-mjx adopt wrote, or the name of
    one in configs/robots/ (ur5e, panda or iiwa)."""
    world: Path | None = None
    """Named world in place of the preset's: a YAML file, or the name of one in configs/worlds/
    (ur5e_rtde, panda_fci, iiwa_fri or fast_servo). It may have a robot."""
    resume: Path | None = None
    """Folder of a run, or latest for the newest run, to continue in place from its latest
    checkpoint. The other flags may then change only total-steps, eval-every, eval-episodes,
    screening-episodes, eval-seed, stop-when-solved, num-devices and log-dir. With total-steps, a
    run that has met all results continues."""

    task: str | None = None
    algorithm: str | None = None
    warm_start: Path | None = None
    log_dir: Path | None = None
    total_steps: Steps | None = None

    def base(self, machine: Path | None = None) -> TrainConfig:
        """The config on which the user's settings lie.

        Args:
          machine: name of the preset for this machine, where JAX's devices may not start yet.

        Raises:
          UserError: a file or a run is missing or wrong, or two of the settings exclude each other.
        """
        if self.resume:
            return self._resumed()
        if not self.warm_start:
            start = self.config, self.robot, self.task, self.world, machine, self.algorithm
            return read_preset(*start)
        if self.robot:
            raise UserError(
                "--warm-start and --robot cannot be combined; the policy's own robot is trained on"
            )
        from bounce_mjx.training.warm_start import warm_config

        start = self.config, self.task, self.world, machine, self.algorithm
        return warm_config(self.warm_start, *start)

    def _resumed(self) -> TrainConfig:
        for flag in ("config", "robot", "world"):
            if getattr(self, flag):
                raise UserError(
                    f"--{flag} and --resume cannot be combined; a resumed run has its config"
                )
        run = self.run
        base = load_run_config(run, self.task, self.algorithm)
        for key in ("task", "algorithm"):
            given, own = getattr(self, key), getattr(base, key)
            if given is not None and not is_same_task(own, given):
                raise UserError(
                    f"--resume cannot change the {key}, and {given} differs from {own}; restore "
                    "it, name the run's copy, or start a new run"
                )
        if is_file(base.algorithm) and self.algorithm is None:
            raise UserError(
                f"the run {run} was trained with an algorithm in a file, which is code; name it to "
                f"run it: --algorithm {base.algorithm}"
            )
        longer = self.total_steps is not None and _is_solved(run)
        return base.model_copy(update={"stop_when_solved": False}) if longer else base

    @property
    def run(self) -> Path | None:
        """Folder of the resumed run.

        Raises:
          UserError: there is none.
        """
        from bounce_mjx.runs.folders import find_run, named_run

        log_dir = self.log_dir or runs_folder(find_task(self.task or DEFAULT))
        return self.resume and find_run(named_run(self.resume, log_dir))

    def settle(self, config: TrainConfig, base: TrainConfig) -> TrainConfig:
        """The user's config with what the start alone decides: the file of the task, and the run of
        a warm start by its own name, if it was the latest.

        Raises:
          UserError: it changes a key of the resumed run that must stay the same.
        """
        config = config.model_copy(update={"task": base.task, "algorithm": base.algorithm})
        if not self.resume:
            return config.model_copy(update={"warm_start": base.warm_start})
        from bounce_mjx.runs.reading import RESUMABLE_KEYS

        if changed := differing_keys(base, config) - RESUMABLE_KEYS:
            raise UserError(
                f"--resume cannot change {', '.join(sorted(changed))}; leave those flags out, or "
                "start a new run"
            )
        return config


def _is_solved(run: Path) -> bool:
    """Whether `stop_when_solved` has ended a run."""
    from bounce_mjx.runs.folders import runs_of_seeds
    from bounce_mjx.runs.progress import load_results

    results = [load_results(seed) for seed in runs_of_seeds(run)]
    return all(found is not None and found.solved for found in results)


def changed(base: TrainConfig, settings: dict[str, Any]) -> TrainConfig:
    """A config in which settings are changed. A setting of `env` or `ppo` may stand alone, like
    the command's flags: num_envs for ppo.num_envs.

    Raises:
      UserError: a key is unknown or a value is out of range.
    """
    values = base.model_dump()
    known = [*values, *values["ppo"], *values["env"]]
    for key, value in settings.items():
        if key not in known:
            advice = suggest(key, known) or "see docs/config.md"
            raise UserError(f"train: unknown setting {key}; {advice}")
        groups = [group for group in ("ppo", "env") if key in values[group]]
        nested = {groups[0]: {key: value}} if groups and key not in values else {key: value}
        values = merged(values, nested)
    return validate(type(base), values, "train")
