"""Trains a policy in JAX and writes a run's folder (`bounce-mjx train`).

The words are read in one place (`read_command`): what the training begins with, the flags, and the
values that are said. `TrainCommand.settings` puts these on a machine's preset and the user's files.
"""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn

from pydantic import Field
from pydantic.fields import FieldInfo

from bounce_mjx.config.command_line import flag_names, parse, read_flags, stdout, typed
from bounce_mjx.config.files import dump_with_sources, flat
from bounce_mjx.config.settings import Count, NonNegativeInt, fields_in
from bounce_mjx.errors import UserError
from bounce_mjx.interrupt import in_daemon_thread, leave
from bounce_mjx.learning.registry import own_algorithm
from bounce_mjx.runs.config import TrainConfig, import_flags_of_run
from bounce_mjx.runs.layers import CommandLine, Layers, layers_on
from bounce_mjx.runs.presets import default_preset, has_accelerator, has_plugin
from bounce_mjx.runs.start import Choice, FileFlags, Start, StartFlags, find_start

PROG = "bounce-mjx train"
ABOUT = "Trains a policy; by default, one that keeps the ball bouncing."

_SHORT_HELP = (
    "word config robot world warm_start seed num_seeds total_steps stop_when_solved "
    "log_dir report watch print_config algorithm ppo.num_envs ppo.learning_rate ppo.hidden_layers"
).split()


class TrainFlags(Choice):
    """The flags that are no keys of the config, beside those of `Choice`, which decide what layers
    there are. Each key of the config has a flag, too (`fields_of_command`)."""

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


class Settings(NamedTuple):
    """What is trained."""

    layers: Layers
    """The layers below the flags."""
    config: TrainConfig
    """All layers, merged."""


class TrainCommand(NamedTuple):
    """A command line that was read; of files, only what it begins with, such as a run's config."""

    start: Start
    """What the first word, --warm-start and --algorithm mean."""
    flags: TrainFlags
    said: Mapping[str, Any]
    """The values that are said of keys of the config, by dotted key."""

    def settings(self, machine: Path) -> Settings:
        """The settings of the training.

        Args:
          machine: the machine's preset.

        Raises:
          UserError: a file or a value is wrong, or a flag changes a key of the resumed run that
            must stay the same.
        """
        layers = layers_on(self.start, self.flags, machine)
        command = CommandLine(PROG, flag_names(fields_of_command(self.start)))
        return Settings(layers, layers.config(self.said, command))


def fields_of_command(start: Start) -> dict[str, FieldInfo]:
    """What has a flag, by dotted key: the settings of the training, but for the task, which is the
    first word; then the other flags."""
    settings = {key: field for key, field in start.fields.items() if key != "task"}
    others = fields_in(TrainFlags)
    return settings | {key: field for key, field in others.items() if key not in settings}


def read_command(args: Sequence[str]) -> TrainCommand:
    """Reads a command line: first the word and the flags that decide, with it, which others there
    are; then all.

    Raises:
      UserError: a flag is wrong, or there is no such task, policy, run or algorithm.
      SystemExit: the flags include --help or --help-all, which it has printed.
    """
    helps = {"-h", "--help", "--help-all"}.intersection(args)
    words = [word for word in args if word not in helps]
    word, after_word = _split_word(words)
    start_flags = parse(StartFlags, after_word, prog=PROG, is_first=True)
    start = find_start(word, start_flags)
    fields = fields_of_command(start)
    if helps:
        files = parse(FileFlags, after_word, prog=PROG, is_first=True)
        usual = layers_on(start, files, default_preset(has_plugin())).config()
        _print_help(fields, usual, is_short="--help-all" not in helps)
    given = read_flags(fields, words, prog=PROG, description=ABOUT, defaults={})
    if given.get("word") != word:
        _refuse_late_word(given["word"], start_flags)
    flags = typed(TrainFlags, given, flag_names(fields), PROG)
    said = {key: value for key, value in given.items() if key in start.fields}
    return TrainCommand(start, flags, said)


def _split_word(words: Sequence[str]) -> tuple[str | None, Sequence[str]]:
    """The word, if there is one, and what follows it. It stands first: after flags of which only
    some are known yet, it might be the value of one."""
    if words and not words[0].startswith("-"):
        return words[0], words[1:]
    return None, words


def _refuse_late_word(late_word: str, start_flags: StartFlags) -> NoReturn:
    """Refuses a word behind flags.

    Raises:
      UserError: always; of a word that nothing begins with, such as a second value of a flag,
        `find_start` says so.
    """
    find_start(late_word, start_flags)
    raise UserError(
        f"{late_word} is what the training begins with; give it first: {PROG} {late_word} ..."
    )


def _print_help(fields: Mapping[str, FieldInfo], config: TrainConfig, is_short: bool) -> NoReturn:
    """Prints the help, with the values of a config as the defaults."""
    defaults = flat(TrainFlags().model_dump()) | flat(config.model_dump())
    options = {}
    if is_short:
        epilog = "--help-all lists every flag: each key of the config is one, without env. and ppo."
        options = {"shown": _SHORT_HELP, "epilog": epilog}
    # Prints, and exits.
    read_flags(fields, ["--help"], prog=PROG, description=ABOUT, defaults=defaults, **options)


def main(args: Sequence[str]) -> None:
    """Runs the command line."""
    command = read_command(args)
    # The presence of a plugin tells the machine's preset without a start of JAX's devices.
    settings = command.settings(default_preset(has_plugin()))
    if command.flags.print_config:
        print_config(_for_devices(command, settings).config)
    else:
        train(command, settings)


def _for_devices(command: TrainCommand, settings: Settings) -> Settings:
    """The settings with the preset for JAX's devices, which this starts: read again where a plugin
    is installed and JAX finds no device for it."""
    expected = default_preset(has_plugin())
    found = default_preset(has_accelerator())
    return settings if found == expected else command.settings(found)


def print_config(config: TrainConfig) -> None:
    """Prints a config, with the layer that set each value.

    Raises:
      UserError: a training refuses it. What the devices and the robot's file allow is seen only as
        it starts.
    """
    if _is_ppo(config):
        config.ppo.check_rollout(config.training_episode_steps)
    remarks = dict(config.sources)
    for key, steps in config.rounded_steps.items():
        if steps != getattr(config, key):
            remarks[key] += f"; in whole blocks {steps:,}"
    print(dump_with_sources(config.model_dump(mode="json"), remarks), end="")


def _is_ppo(config: TrainConfig) -> bool:
    """Whether the algorithm is PPO, or a subclass of it."""
    own = own_algorithm(config.algorithm)
    if own is None:
        return True
    # The user's own algorithm has imported JAX.
    from bounce_mjx.learning.ppo import PPO

    return issubclass(own, PPO)


def train(command: TrainCommand, settings: Settings) -> None:
    """Trains, and says how to measure and watch the policy."""
    import jax

    from bounce_mjx.training.setup import set_up_jax

    flags = command.flags
    set_up_jax(settings.config.env)
    if not flags.on_several_hosts:
        # CUDA starts during the imports; JAX reports an error where it needs the devices.
        in_daemon_thread(jax.devices)
    from bounce_mjx.training import hosts
    from bounce_mjx.training.events import say
    from bounce_mjx.training.job import TrainingStopped
    from bounce_mjx.training.run import run_training

    with hosts.leave_on_user_error():
        if flags.on_several_hosts:
            # JAX must not be asked for its devices before.
            hosts.join(
                flags.coordinator_address,
                flags.num_processes,
                flags.process_id,
                limit=flags.host_timeout,
            )
        layers, config = _for_devices(command, settings)
        console = stdout(quiet=not hosts.is_leader())
        callbacks = []
        page = None
        if flags.watch and hosts.is_leader():
            # Only a training run that is watched pays for this import.
            from bounce_mjx.training.watch import Address, TrainingPage

            address = Address(flags.watch_host, flags.watch_port, flags.watch_allow_host)
            page = TrainingPage(config, address, console)
            callbacks.append(page)
        if flags.video:
            from bounce_mjx.training.video import EvaluationVideo

            callbacks.append(EvaluationVideo())
        try:
            run = run_training(layers, config, console, callbacks, flags.report)
        except TrainingStopped as stop:
            say(console, str(stop))
            # The stop was asked for, and the state is saved. Does not wait for a compilation or an
            # evaluation in another thread.
            leave(0)
        best = run.checkpoint.run
        words = shlex.join([str(best), *import_flags_of_run(best)])
        say(console, f"measure it: bounce-mjx eval {words}")
        say(console, f"watch it: bounce-mjx play {words}")
        if page is not None:
            page.wait()
            # A thread that simulates cannot be stopped.
            leave(0)
