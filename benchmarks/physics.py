"""Physics steps per second of each engine at several batch sizes.

    python benchmarks/physics.py --batch-sizes 512 4096 --engines fused mjx c

One measurement is a program of `--control-steps` control steps (2 of the slower engines, 10 physics
steps each) under random actions. The engines take turns. Those of JAX draw the actions in it; the C
engine's are drawn before. The fastest repeat counts, because other work on the machine can only
slow a repeat down.
"""

import itertools
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import mujoco
import numpy as np
from mujoco import rollout
from pydantic import Field
from tables import device_name, markdown_table, write

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.env.env import Env
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.physics import Control, PhysicsParameters
from bounce_mjx.task.registry import task_config

EngineName = Literal["fused", "mjx", "c"]


class Command(StrictModel):
    """The command line."""

    batch_sizes: tuple[Annotated[int, Field(ge=1)], ...] = (512, 4096, 32768)
    """Numbers of environments."""
    engines: tuple[EngineName, ...] = ("fused", "mjx", "c")
    """Engines; c is MuJoCo's C engine on all processor cores."""
    tasks: tuple[str, ...] = ("bounce",)
    """Tasks whose worlds are measured, alternating; juggle has two balls."""
    control_steps: Annotated[int, Field(ge=1)] = 50
    """Control steps in one measurement of the fused engine; the slower engines take only 2."""
    repeats: Annotated[int, Field(ge=1)] = 5
    """Measurements of each engine."""
    out: Path = Path("benchmarks/results")
    """Folder for physics.json and physics.md."""


class Program(NamedTuple):
    """What is measured."""

    task: str
    engine: EngineName
    run: Callable[[], Any]
    physics_steps: int
    """In a run, of all environments."""
    compile_seconds: float


def jax_program(task: str, engine: EngineName, batch: int, control_steps: int) -> Program:
    """The compiled program of a JAX engine."""
    env = Env(task_config(task)(physics=engine))
    batch_last = {"in_axes": -1, "out_axes": -1}

    def control_step(now, key):
        actions = jax.random.uniform(key, (env.action_size, batch), minval=-1.0, maxval=1.0)
        control, _ = jax.vmap(env.control, **batch_last)(now, actions)
        advance = jax.vmap(
            lambda state, ctrl: env.engine.step(
                PhysicsParameters(), state, Control(ctrl), env.config.num_substeps
            ),
            **batch_last,
        )
        return now._replace(physics=advance(now.physics, control.ctrl)), None

    def run(now, key):
        return jax.lax.scan(control_step, now, jax.random.split(key, control_steps))[0]

    keys = jax.random.split(jax.random.PRNGKey(0), batch)
    now = jax.jit(jax.vmap(env.reset, out_axes=-1))(keys).pipeline_state
    started = time.perf_counter()
    program = jax.jit(run).lower(now, keys[0]).compile()
    compile_seconds = time.perf_counter() - started
    return Program(
        task=task,
        engine=engine,
        run=lambda: jax.block_until_ready(program(now, keys[0])),
        physics_steps=batch * control_steps * env.config.num_substeps,
        compile_seconds=compile_seconds,
    )


def c_program(task: str, batch: int, control_steps: int) -> Program:
    """The C engine on all cores; nothing is compiled."""
    env = Env(task_config(task)())
    model = env.mj_model
    threads = os.cpu_count() or 1
    rng = np.random.default_rng(0)
    state = np.zeros((batch, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    physics = jax.jit(env.reset)(jax.random.PRNGKey(0)).pipeline_state.physics
    state[:, 1:] = np.concatenate([physics.qpos, physics.qvel])
    steps = control_steps * env.config.num_substeps
    actions = rng.uniform(-1.0, 1.0, (batch, control_steps, env.action_size))
    noise = actions.repeat(env.config.num_substeps, axis=1)
    control = np.asarray(env.config.default_joint_angles) + env.config.action_scale * noise
    assert control.shape == (batch, steps, model.nu)
    data = [mujoco.MjData(model) for _ in range(threads)]
    pool = rollout.Rollout(nthread=threads)
    return Program(
        task=task,
        engine="c",
        run=lambda: pool.rollout(model, data, state, control),
        physics_steps=batch * steps,
        compile_seconds=0.0,
    )


def measure(command: Command) -> list[dict]:
    """One record for each batch size, task and engine."""
    records = []
    for batch in command.batch_sizes:
        programs = []
        for task, engine in itertools.product(command.tasks, command.engines):
            steps = command.control_steps if engine == "fused" else min(2, command.control_steps)
            if engine == "c":
                programs.append(c_program(task, batch, steps))
            else:
                programs.append(jax_program(task, engine, batch, steps))
        times: list[list[float]] = [[] for _ in programs]
        for repeat in range(command.repeats + 1):
            for program, seconds in zip(programs, times, strict=True):
                started = time.perf_counter()
                program.run()
                # The first turn warms up.
                if repeat:
                    seconds.append(time.perf_counter() - started)
        for program, seconds in zip(programs, times, strict=True):
            records.append(
                {
                    "batch": batch,
                    "task": program.task,
                    "engine": program.engine,
                    "steps_per_second": program.physics_steps / min(seconds),
                    "median_steps_per_second": program.physics_steps / float(np.median(seconds)),
                    "compile_seconds": program.compile_seconds,
                }
            )
    return records


def table(records: list[dict]) -> str:
    """Steps per second by batch size, task and engine, and the speedup of fused over each engine
    in the same world."""
    fused = {
        (record["batch"], record["task"]): record["steps_per_second"]
        for record in records
        if record["engine"] == "fused"
    }
    has_tasks = len({record["task"] for record in records}) > 1
    rows = []
    for record in records:
        place = record["batch"], record["task"]
        ratio = ""
        if place in fused and record["engine"] != "fused":
            ratio = f"{fused[place] / record['steps_per_second']:.3g}"
        engine = record["engine"]
        rows.append(
            [
                f"{record['batch']:,}",
                f"{engine}, {record['task']}" if has_tasks else engine,
                f"{record['steps_per_second'] / 1e6:,.3f}",
                f"{record['median_steps_per_second'] / 1e6:,.3f}",
                f"{record['compile_seconds']:.1f}",
                ratio,
            ]
        )
    header = [
        "environments",
        "engine",
        "M steps/s (best)",
        "(median)",
        "compile s",
        "fused is x faster",
    ]
    return markdown_table(header, rows)


def main() -> None:
    """Runs the command line."""
    with exit_on_user_error():
        command = parse(
            Command, sys.argv[1:], prog="benchmarks/physics.py", description=__doc__.split("\n")[0]
        )
        records = measure(command)
        device = device_name()
        record = {"device": device, "jax": jax.__version__, "records": records}
        write(command.out, "physics", record, f"Device: {device}\n\n{table(records)}")


if __name__ == "__main__":
    main()
