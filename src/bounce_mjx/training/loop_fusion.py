"""Joined loops on a CPU, an option of XLA.

On a CPU, XLA emits one loop for each result by default, and repeats the intermediate values that
results share. With its option for multi-output fusion, one loop computes several results: the
programs compile in about half the time, and the physics runs several times as fast (figures in
benchmarks/notes.md). XLA aborts the process on a few programs with it, such as MJX's step.
"""

import os

from bounce_mjx.world.config import WorldConfig

NAME = "--xla_backend_extra_options"
OPTION = f"{NAME}=xla_cpu_use_multi_output_fusion"


def join_loops(*configs: WorldConfig) -> None:
    """Switches the option on for this process if all these environments have the fused physics.
    XLA reads it when JAX starts its devices. It is added to the user's `XLA_FLAGS`, unless these
    are empty or name it.

    Raises:
      UserError: an MJCF file does not fit the task.
    """
    from bounce_mjx.physics.engine import is_fused
    from bounce_mjx.robot.model import load_model

    flags = os.environ.get("XLA_FLAGS")
    # Without a dash, it is empty on purpose or the name of a file with flags.
    if flags is not None and (NAME in flags or "--" not in flags):
        return
    models = {(c.physics, c.mjcf, c.physics_dt, c.robot, c.num_balls) for c in configs}
    if all(
        is_fused(load_model(mjcf, dt, robot=robot, num_balls=balls), choice)
        for choice, mjcf, dt, robot, balls in models
    ):
        os.environ["XLA_FLAGS"] = OPTION if flags is None else f"{flags} {OPTION}"
