"""Trains a policy in JAX and writes a run's folder (`bounce-mjx train`)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from bounce_mjx.config.settings import HostName, whole_number
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.interrupt import leave
from bounce_mjx.runs.config import default_preset, has_accelerator, has_plugin
from bounce_mjx.training.command import TrainingCommand, config_of, early_flag, read_training

PROG = "bounce-mjx train"
_HOST_TIMEOUT = 300


class TrainCommand(TrainingCommand):
    """Trains a policy; by default, one that keeps the ball bouncing."""

    distributed: bool = False
    """Train together with the same command on other hosts, started by Slurm, Open MPI or
    Kubernetes."""
    coordinator_address: str | None = None
    """HOST:PORT of process 0, to train on several hosts without one of these launchers."""
    num_processes: Annotated[int, Field(ge=1)] | None = None
    """Number of processes, one per host; with coordinator-address."""
    process_id: Annotated[int, Field(ge=0)] | None = None
    """Number of this process, from 0; with coordinator-address."""
    watch: bool = False
    """Serve a page during the training, with the newest policy, the curves and the results."""
    watch_host: str = "127.0.0.1"
    """Address of that page's server; 0.0.0.0 also admits other machines."""
    watch_allow_host: tuple[HostName, ...] = ()
    """Other names under which a browser may open that page, such as a proxy's."""
    watch_port: Annotated[int, Field(ge=1, lt=2**16)] = 8080
    """Port of that page's server, or the next free port."""
    host_timeout: Annotated[int, Field(ge=1, le=10**6)] = _HOST_TIMEOUT
    """Seconds that the processes wait for each other at the start."""


def main(args: Sequence[str]) -> None:
    """Runs the command line."""
    several_hosts = _hosts(args)
    with exit_on_user_error():
        command = read_command(args, default_preset(has_plugin()))
        from bounce_mjx.training.setup import find_devices, set_up_jax

        set_up_jax(command.env)
        if several_hosts is None:
            # CUDA starts during the imports.
            find_devices()
        from bounce_mjx.training import hosts
        from bounce_mjx.training.ppo_trainer import PPOTrainer
        from bounce_mjx.training.run_command import run_command

    with hosts.leave_at_once(), exit_on_user_error():
        if several_hosts is not None:
            # JAX must not be asked for its devices before.
            hosts.join(*several_hosts)
        if several_hosts is not None or has_plugin() != has_accelerator():
            command = read_command(args)
        page = None
        if command.watch and hosts.is_leader():
            # Only a training run that is watched pays for this import.
            from bounce_mjx.viewers.watch import TrainingPage

            address = command.watch_host, command.watch_port
            page = TrainingPage(config_of(command), *address, Console(), command.watch_allow_host)
        run_command(command, PPOTrainer, PROG, page)
        if page is not None:
            page.wait()
            # A thread that simulates cannot be stopped.
            leave(0)


def read_command(args: Sequence[str], machine: Path | None = None) -> TrainCommand:
    """The command line on top of the preset or of the resumed run's config (`command`)."""
    return read_training(TrainCommand, args, prog=PROG, machine=machine)


def _hosts(args: Sequence[str]) -> tuple[str | None, int | None, int | None, int] | None:
    """The address, number of processes, number of this process, and time limit of a training run on
    several hosts; None for a training run on one, and for a command line that asks for help."""
    address = early_flag(args, "--coordinator-address")
    words = [early_flag(args, f) for f in ("--num-processes", "--process-id", "--host-timeout")]
    try:
        numbers = [None if word is None else int(whole_number(word)) for word in words]
    except ValueError:
        # The parser refuses the flag by name.
        return None
    processes, process, timeout = numbers
    distributed = early_flag(args, "--distributed")
    wanted = distributed is not None and distributed.lower() != "false"
    if not wanted and all(value is None for value in (address, processes, process)):
        return None
    if not {"-h", "--help"}.isdisjoint(args):
        return None
    return address, processes, process, timeout or _HOST_TIMEOUT
