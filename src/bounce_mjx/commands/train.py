"""Trains a policy in JAX and writes a run's folder (`bounce-mjx train`)."""

import shlex
from collections.abc import Sequence

from bounce_mjx.config.command_line import stdout
from bounce_mjx.config.files import dump_with_sources
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.interrupt import in_daemon_thread, leave
from bounce_mjx.runs.presets import default_preset, has_accelerator, has_plugin
from bounce_mjx.training.command import read_command


def main(args: Sequence[str]) -> None:
    """Runs the command line."""
    command = read_command(args, default_preset(has_plugin()))
    flags = command.flags
    if flags.print_config:
        # The preset was chosen by JAX's plugins alone.
        if has_plugin() != has_accelerator():
            command = read_command(args)
        config = command.config
        # A training's own checks, so that no config is shown that it refuses; what the devices and
        # the robot's file allow is seen only as it starts.
        config.ppo.check_rollout(config.training_episode_steps)
        config.check_eval_seed()
        remarks = dict(config.sources)
        for key, steps in config.rounded_steps.items():
            if steps != getattr(config, key):
                remarks[key] += f"; in whole blocks {steps:,}"
        print(dump_with_sources(config.model_dump(mode="json"), remarks), end="")
        return
    import jax

    from bounce_mjx.training.setup import set_up_jax

    set_up_jax(command.config.env)
    if not flags.on_several_hosts:
        # CUDA starts during the imports; JAX reports an error where it needs the devices.
        in_daemon_thread(jax.devices)
    from bounce_mjx.training import hosts
    from bounce_mjx.training.events import say
    from bounce_mjx.training.job import TrainingStopped, imports_of
    from bounce_mjx.training.run import run_training

    # Within, so that a user's error is a status before the process would wait for the others.
    with hosts.leave_without_waiting(), exit_on_user_error():
        if flags.on_several_hosts:
            # JAX must not be asked for its devices before.
            numbers = flags.num_processes, flags.process_id, flags.host_timeout
            hosts.join(flags.coordinator_address, *numbers)
        # Which preset is the default depends on the devices, of several hosts known only now.
        if flags.on_several_hosts or has_plugin() != has_accelerator():
            command = read_command(args)
        config = command.config
        console, callbacks = stdout(quiet=not hosts.is_leader()), []
        is_watched = flags.watch and hosts.is_leader()
        if is_watched:
            # Only a training run that is watched pays for this import.
            from bounce_mjx.training.watch import Address, TrainingPage

            address = Address(flags.watch_host, flags.watch_port, flags.watch_allow_host)
            callbacks.append(TrainingPage(config, address, console))
        if flags.video:
            from bounce_mjx.training.video import EvaluationVideo

            callbacks.append(EvaluationVideo())
        try:
            run = run_training(command.layers, config, console, callbacks, flags.report)
        except TrainingStopped as stop:
            say(console, str(stop))
            # Does not wait for a compilation or an evaluation in another thread.
            leave(0)
        words = shlex.join([str(run.checkpoint.run), *imports_of(config)])
        say(console, f"measure it: bounce-mjx eval {words}")
        say(console, f"watch it: bounce-mjx play {words}")
        if is_watched:
            callbacks[0].wait()
            # A thread that simulates cannot be stopped.
            leave(0)
