"""Trains a policy in JAX and writes a run's folder (`bounce-mjx train`)."""

from collections.abc import Sequence

from rich.console import Console

from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.interrupt import leave
from bounce_mjx.runs.config import default_preset, has_accelerator, has_plugin
from bounce_mjx.training.command import config_of, read_command


def main(args: Sequence[str]) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        command = read_command(args, default_preset(has_plugin()))
        from bounce_mjx.training.setup import find_devices, set_up_jax

        set_up_jax(command.env)
        if not command.on_several_hosts:
            # CUDA starts during the imports.
            find_devices()
        from bounce_mjx.training import hosts
        from bounce_mjx.training.ppo_trainer import PPOTrainer
        from bounce_mjx.training.run_command import run_command

    with hosts.leave_at_once(), exit_on_user_error():
        if command.on_several_hosts:
            # JAX must not be asked for its devices before.
            numbers = command.num_processes, command.process_id, command.host_timeout
            hosts.join(command.coordinator_address, *numbers)
        if command.on_several_hosts or has_plugin() != has_accelerator():
            command = read_command(args)
        page = None
        if command.watch and hosts.is_leader():
            # Only a training run that is watched pays for this import.
            from bounce_mjx.viewers.watch import TrainingPage

            address = command.watch_host, command.watch_port
            page = TrainingPage(config_of(command), *address, Console(), command.watch_allow_host)
        run_command(command, PPOTrainer, page)
        if page is not None:
            page.wait()
            # A thread that simulates cannot be stopped.
            leave(0)
