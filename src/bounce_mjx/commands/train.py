"""Trains a policy in JAX and writes a run's folder (`bounce-mjx train`)."""

import shlex
from collections.abc import Sequence

from bounce_mjx.config.command_line import stdout
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.interrupt import in_daemon_thread, leave
from bounce_mjx.runs import config as run_configs
from bounce_mjx.training.command import read_command


def main(args: Sequence[str]) -> None:
    """Runs the command line."""
    machine = run_configs.default_preset(run_configs.has_plugin())
    command = read_command(args, machine)
    import jax

    from bounce_mjx.training.setup import set_up_jax

    set_up_jax(command.env)
    if not command.on_several_hosts:
        # CUDA starts during the imports; JAX reports an error where it needs the devices.
        in_daemon_thread(jax.devices)
    from bounce_mjx.training import hosts
    from bounce_mjx.training.events import say
    from bounce_mjx.training.job import TrainingStopped, named_task
    from bounce_mjx.training.run import train

    with hosts.leave_at_once(), exit_on_user_error():
        if command.on_several_hosts:
            # JAX must not be asked for its devices before.
            numbers = command.num_processes, command.process_id, command.host_timeout
            hosts.join(command.coordinator_address, *numbers)
        if command.on_several_hosts or run_configs.has_plugin() != run_configs.has_accelerator():
            machine = None
            command = read_command(args)
        console, callbacks = stdout(quiet=not hosts.is_leader()), []
        is_watched = command.watch and hosts.is_leader()
        if is_watched:
            # Only a training run that is watched pays for this import.
            from bounce_mjx.training.watch import Address, TrainingPage

            address = Address(command.watch_host, command.watch_port, command.watch_allow_host)
            callbacks.append(TrainingPage(command.training, address, console))
        if command.resume is None:
            files = run_configs.preset_files(command.config, command.task, machine)
            say(console, f"config: {' on '.join(map(run_configs.shown_file, reversed(files)))}")
            if command.warm_start is not None:
                say(console, f"warm start: {command.warm_start}")
        if command.video:
            from bounce_mjx.training.video import EvaluationVideo

            callbacks.append(EvaluationVideo())
        try:
            given = {"resume": command.resume, "callbacks": callbacks, "report": command.report}
            run = train(config=command.training, **given)
        except TrainingStopped as stop:
            say(console, str(stop))
            # Does not wait for a compilation or an evaluation in another thread.
            leave(0)
        words = shlex.join([str(run.checkpoint.run), *named_task(command.training)])
        say(console, f"measure it: bounce-mjx eval {words}")
        say(console, f"watch it: bounce-mjx play {words}")
        if is_watched:
            callbacks[0].wait()
            # A thread that simulates cannot be stopped.
            leave(0)
