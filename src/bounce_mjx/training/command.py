"""What the words of `bounce-mjx train` say: its flags, and the config. `commands/train.py` acts on
them."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import Field
from pydantic.fields import FieldInfo

from bounce_mjx.config.command_line import flag_names, parse, read_flags, typed
from bounce_mjx.config.files import flat
from bounce_mjx.config.settings import Count, NonNegativeInt, fields_in
from bounce_mjx.errors import UserError
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.layers import Choice, ChoiceFlags, Layers, read_layers

PROG = "bounce-mjx train"
ABOUT = "Trains a policy; by default, one that keeps the ball bouncing."

_SHORT_HELP = (
    "start config robot world warm_start seed num_seeds total_steps stop_when_solved "
    "log_dir report watch print_config algorithm ppo.num_envs ppo.learning_rate ppo.hidden_layers"
).split()


class TrainFlags(Choice):
    """The flags that decide which layers there are, and those beside the keys of the config."""

    print_config: bool = False
    """Print the config, with the layer that sets each value, and train nothing."""
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


class TrainCommand(NamedTuple):
    """A command line that was read."""

    flags: TrainFlags
    layers: Layers
    """The layers below the flags."""
    config: TrainConfig
    """The run's config."""


def fields_of_command(layers: Layers) -> dict[str, FieldInfo]:
    """What has a flag, by dotted key: the settings of the training, but for the task, which is the
    first word; then the other flags."""
    fields = {key: field for key, field in layers.fields.items() if key != "task"}
    others = fields_in(TrainFlags)
    return fields | {key: field for key, field in others.items() if key not in fields}


def read_command(args: Sequence[str], machine: Path | None = None) -> TrainCommand:
    """Reads a command line: first the word and the flags that decide which others there are, then
    all.

    Args:
      machine: the machine's preset; None asks JAX, which starts its devices.

    Raises:
      UserError: a flag or a file is wrong, or a flag changes a key of the resumed run that must
        stay the same.
      SystemExit: the flags include --help or --help-all, which it has printed.
    """
    helps = {"-h", "--help", "--help-all"}.intersection(args)
    words = [word for word in args if word not in helps]
    _refuse_flags_of_the_word(words)
    word, after_word = _split_word(words)
    flags_of_choice = parse(ChoiceFlags, after_word, prog=PROG, is_first=True)
    # What decides which layers there are; the layers then say which other flags there are.
    choice = Choice(start=word, **dict(flags_of_choice))
    layers = read_layers(choice, machine)
    fields = fields_of_command(layers)
    if helps:
        defaults = flat(TrainFlags().model_dump()) | flat(layers.config().model_dump())
        about = "--help-all lists every flag; each key of the config is one."
        options = {} if "--help-all" in helps else {"shown": _SHORT_HELP, "epilog": about}
        # Prints, and exits.
        read_flags(fields, ["--help"], prog=PROG, description=ABOUT, defaults=defaults, **options)
    given = read_flags(fields, words, prog=PROG, description=ABOUT, defaults={})
    if given.get("start") != choice.start:
        raise UserError(
            f"{given['start']} is what the training begins with; give it first: {PROG} "
            f"{given['start']} ..."
        )
    names = flag_names(fields)
    said = {key: value for key, value in given.items() if key in layers.fields}
    flags = typed(TrainFlags, given, names, PROG)
    return TrainCommand(flags, layers, layers.config(said, names, PROG))


def _split_word(words: Sequence[str]) -> tuple[str | None, Sequence[str]]:
    """The word, if there is one, and what follows it. It stands first: after flags of which only
    some are known yet, it might be the value of one."""
    if words and not words[0].startswith("-"):
        return words[0], words[1:]
    return None, words


def _refuse_flags_of_the_word(words: Sequence[str]) -> None:
    """Refuses the flags in whose place the first word stands."""
    for word, following in itertools.zip_longest(words, words[1:]):
        flag, _, value = word.partition("=")
        if flag in ("--task", "--resume"):
            what = {"--task": "the task", "--resume": "the run to resume"}[flag]
            raise UserError(f"{what} is the first word: {PROG} {value or following or 'WORD'}")
