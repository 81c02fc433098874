"""The config of a training: that of its start, and what the user changes in it by flags or in
Python."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from bounce_mjx.config.command_line import Flag, parse
from bounce_mjx.config.files import differing_keys
from bounce_mjx.config.settings import Count, NonNegativeInt, Steps, StrictModel, merged, nested
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError
from bounce_mjx.resources import POLICIES
from bounce_mjx.runs import config as run_configs
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.tasks.registry import DEFAULT, find_task, is_file, is_same_code

PROG = "bounce-mjx train"

_SHORT_HELP = (
    "task config robot world warm_start resume seed num_seeds total_steps stop_when_solved "
    "log_dir report watch algorithm ppo.num_envs ppo.learning_rate ppo.hidden_layers"
).split()


class Start(StrictModel):
    """What a training starts from: flags of the command, and arguments of `train`."""

    config: Annotated[tuple[Path, ...], Flag(metavar="NAME|FILE", is_repeated=True)] = ()
    """Preset, such as cpu or finetune (a YAML file in configs/), or a YAML file of yours. A task's
    own preset of that name, such as configs/track/cpu.yaml, has priority. The default is default on
    an accelerator, and cpu on a CPU. A file of yours lies on that default, or on the preset that
    its key base names. Given again, each file lies on those before it."""
    robot: Annotated[Path | None, Flag(metavar="NAME|FILE")] = None
    """Config of a robot on top of the preset: the file that bounce-mjx adopt wrote, or the name of
    one in configs/robots/ (ur5e, panda or iiwa)."""
    world: Annotated[Path | None, Flag(metavar="NAME|FILE")] = None
    """Named world in place of the preset's: a YAML file, or the name of one in configs/worlds/
    (ur5e_rtde, panda_fci, iiwa_fri or fast_servo). It may have a robot."""
    resume: Path | None = None
    """Folder of a run, or latest for the newest run, to continue in place from its newest
    checkpoint; or a checkpoint in it, which then counts as the newest. The other flags may then
    change only total-steps, eval-every, eval-episodes, screening-episodes, eval-seed,
    stop-when-solved, num-devices and log-dir. With total-steps, a run that has met all results
    continues."""

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
        if self.warm_start:
            return self._warm(machine)
        start = self.config, self.robot, self.task, self.world, machine, self.algorithm
        return run_configs.read_preset(*start)

    def _warm(self, machine: Path | None) -> TrainConfig:
        """The environment and the networks of a policy, and the other settings of a preset."""
        if self.robot:
            raise UserError("--warm-start and --robot cannot be combined; leave --robot out")
        from bounce_mjx.runs.checkpoints import NETWORK_KEYS
        from bounce_mjx.runs.folders import choose_checkpoint

        folder = run_configs.runs_folder(find_task(self.task or DEFAULT))
        checkpoint = choose_checkpoint(self.warm_start, folder)
        own = run_configs.load_run_config(checkpoint.run, self.task)
        base = run_configs.read_preset(self.config, None, own.task, None, machine, self.algorithm)
        networks = {key: getattr(own.ppo, key) for key in (*NETWORK_KEYS, "critic_metrics")}
        ppo = base.ppo.model_copy(update=networks)
        start = self.warm_start if str(self.warm_start) in POLICIES else checkpoint.folder
        config = base.model_copy(update={"env": own.env, "ppo": ppo, "warm_start": start})
        return config if self.world is None else run_configs.in_world(config, self.world)[0]

    def _resumed(self) -> TrainConfig:
        for flag in ("config", "robot", "world"):
            if getattr(self, flag):
                raise UserError(f"--{flag} and --resume cannot be combined; leave one out")
        from bounce_mjx.runs.folders import find_run

        run = find_run(self.resumed)
        base = run_configs.load_run_config(run, self.task, self.algorithm)
        for key in ("task", "algorithm"):
            given, own = getattr(self, key), getattr(base, key)
            if given is not None and not is_same_code(own, given):
                raise UserError(
                    f"--resume cannot change the {key}, and {given} differs from {own}; restore "
                    "it, name the run's copy, or start a new run"
                )
        if is_file(base.algorithm) and self.algorithm is None:
            raise run_configs.unnamed_code(f"the run {run}", "algorithm", base.algorithm)
        if self.total_steps is None:
            return base
        from bounce_mjx.runs.folders import latest_checkpoint
        from bounce_mjx.runs.progress import Progress
        from bounce_mjx.runs.records import verify

        # `stop_when_solved` has ended it, and more steps are asked for.
        progress = verify(latest_checkpoint(run, self.resumed)).progress
        seeds = [Progress.model_validate(seed) for seed in progress.get("seeds", [progress])]
        solved = all(seed.solved for seed in seeds)
        return base.model_copy(update={"stop_when_solved": False}) if solved else base

    @property
    def resumed(self) -> Path | None:
        """The resumed run's folder, or a path in it.

        Raises:
          UserError: there is none.
        """
        if self.resume is None:
            return None
        from bounce_mjx.runs.folders import named_run

        log_dir = self.log_dir or run_configs.runs_folder(find_task(self.task or DEFAULT))
        return named_run(self.resume, log_dir)

    def settle(self, config: TrainConfig, base: TrainConfig) -> TrainConfig:
        """The user's config with what the start alone decides: the file of the task, and the run of
        a warm start by its own name, if it was the latest.

        Raises:
          UserError: it changes a key of the resumed run that must stay the same.
        """
        config = config.model_copy(update={"task": base.task, "algorithm": base.algorithm})
        if not self.resume:
            return config.model_copy(update={"warm_start": base.warm_start})
        from bounce_mjx.runs.checkpoints import RESUMABLE_KEYS

        if changed := differing_keys(base, config) - RESUMABLE_KEYS:
            raise UserError(
                f"--resume cannot change {', '.join(sorted(changed))}; leave those flags out, or "
                "start a new run"
            )
        return config


def changed(base: TrainConfig, settings: dict[str, Any]) -> TrainConfig:
    """A config in which settings are changed. A setting of `env` or `ppo` may stand alone, like
    the command's flags: num_envs for ppo.num_envs.

    Raises:
      UserError: a key is unknown or a value is out of range.
    """
    values = base.model_dump()
    for key, value in settings.items():
        groups = [group for group in ("ppo", "env") if key in values[group] and key not in values]
        place = f"{groups[0]}.{key}" if groups else key
        values = merged(values, nested(place, value))
    return validate(type(base), values, "train")


class TrainCommand(TrainConfig, Start):
    """Trains a policy; by default, one that keeps the ball bouncing."""

    report: bool = True
    """Write report.html into the run's folder after the results are printed."""
    video: bool = False
    """Show each evaluated policy as a video in TensorBoard, under Images; the training waits."""
    distributed: bool = False
    """Train together with the same command on other hosts, started by Slurm, Open MPI or
    Kubernetes."""
    coordinator_address: str | None = None
    """HOST:PORT of process 0, to train on several hosts without one of these launchers."""
    num_processes: Count | None = None
    """Number of processes, one per host; with coordinator-address."""
    process_id: NonNegativeInt | None = None
    """Number of this process, from 0; with coordinator-address."""
    watch: bool = False
    """Serve a page during the training, with the newest policy and the results."""
    watch_host: str = "127.0.0.1"
    """Address of that page's server; 0.0.0.0 also admits other machines."""
    watch_allow_host: tuple[str, ...] = ()
    """Other names under which a browser may open that page, such as a proxy's."""
    watch_port: Annotated[int, Field(ge=1, lt=2**16)] = 8080
    """Port of that page's server, or the next free port."""
    host_timeout: Annotated[Count, Field(le=10**6)] = 300
    """Seconds that the processes wait for each other at the start."""

    @property
    def on_several_hosts(self) -> bool:
        """Whether other processes train too."""
        joins = (self.coordinator_address, self.num_processes, self.process_id)
        return self.distributed or any(value is not None for value in joins)

    @property
    def training(self) -> TrainConfig:
        """The run's config."""
        return TrainConfig(**{key: getattr(self, key) for key in TrainConfig.model_fields})


def read_command(args: Sequence[str], machine: Path | None = None) -> TrainCommand:
    """Reads a command line on top of the preset, or of the resumed run's config.

    Args:
      machine: name of the preset for this machine, where JAX's devices may not start yet.

    Raises:
      UserError: a flag or the preset is wrong, or a flag changes a key of the resumed run that must
        stay the same.
      SystemExit: the flags include --help or --help-all, which it has printed.
    """
    helps = {"-h", "--help", "--help-all"}.intersection(args)
    start = parse(Start, [word for word in args if word not in helps], prog=PROG, is_first=True)
    base = start.base(machine)
    own_class = run_configs.train_config(base.env.task, TrainCommand, type(base.ppo))
    default = own_class(**dict(base))
    if helps:
        keys, epilog = _SHORT_HELP, "--help-all lists every flag; each key of the config is one."
        options = {} if "--help-all" in helps else {"shown": keys, "epilog": epilog}
        parse(own_class, ["--help"], prog=PROG, default=default, **options)
    command = parse(own_class, args, prog=PROG, default=default)
    settled = start.settle(command.training, base)
    return command.model_copy(update=dict(settled) | {"resume": start.resumed})
