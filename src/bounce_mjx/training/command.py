"""The flags of the command that trains."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import pydantic
from pydantic import Field

from bounce_mjx.config.command_line import Flag, parse, parse_first
from bounce_mjx.config.settings import Count, NonNegativeInt
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.runs.config import TrainConfig, train_config
from bounce_mjx.training.start import Start
from bounce_mjx.world.config import WorldConfig

PROG = "bounce-mjx train"

_SHORT_HELP = (
    "task config robot world warm_start resume seed num_seeds total_steps stop_when_solved "
    "log_dir report watch wandb algorithm ppo.num_envs ppo.learning_rate ppo.hidden_layers"
).split()


class TrainCommand(TrainConfig, Start):
    """Trains a policy; by default, one that keeps the ball bouncing."""

    env: Annotated[pydantic.SerializeAsAny[WorldConfig], Flag(name="")]
    ppo: Annotated[pydantic.SerializeAsAny[PPOConfig], Flag(name="")] = PPOConfig()
    report: bool = True
    """Write report.html into the run's folder after the results are printed."""
    wandb: str | None = None
    """Project of Weights & Biases to log to, in addition to TensorBoard; needs the extra wandb."""
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
    """Serve a page during the training, with the newest policy, the curves and the results."""
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
    start = parse_first(Start, [word for word in args if word not in helps], prog=PROG)
    base = start.base(machine)
    own_class = train_config(base.env.task, TrainCommand, type(base.ppo))
    default = own_class(**dict(base))
    if helps:
        keys, epilog = _SHORT_HELP, "--help-all lists every flag; each key of the config is one."
        options = {} if "--help-all" in helps else {"shown": keys, "epilog": epilog}
        parse(own_class, ["--help"], prog=PROG, default=default, **options)
    command = parse(own_class, args, prog=PROG, default=default)
    settled = start.settle(command.training, base)
    return command.model_copy(update=dict(settled) | {"resume": start.run})
