"""Kernels that are lowered on their own, and the program around them. This needs no GPU."""

import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax.experimental import pallas as pl
from jax.experimental.pallas import mosaic_gpu as plgpu

from bounce_mjx import BounceBall
from bounce_mjx.gpu import elementwise, kernel_calls, rows
from bounce_mjx.gpu.kernel_calls import call_kernel
from bounce_mjx.learning import ppo
from bounce_mjx.learning.config import PPOConfig

SIZE = 256
RESULTS = [jax.ShapeDtypeStruct((SIZE,), jnp.float32), jax.ShapeDtypeStruct((2,), jnp.int32)]
CONFIG = PPOConfig(num_envs=64, num_minibatches=2, hidden_layers=(8,))


def doubling(factor: float = 2.0):
    """A kernel of two blocks that multiplies [256] and counts the blocks [2]."""
    layout = plgpu.Layout.WG_STRIDED((128,), 1)

    def kernel(source, target, block_numbers):
        block = jax.lax.axis_index("block")
        part = pl.ds(block * 128, 128)
        target[part] = factor * plgpu.load(source.at[part], (), layout=layout, optimized=False)
        block_numbers[block] = block

    return plgpu.kernel(
        kernel,
        out_type=RESULTS,
        grid=(2,),
        grid_names=("block",),
        compiler_params=plgpu.CompilerParams(lowering_semantics=plgpu.LoweringSemantics.Lane),
    )


def lowered_text(function) -> str:
    traced = jax.jit(function).trace(jax.ShapeDtypeStruct((SIZE,), jnp.float32))
    return traced.lower(lowering_platforms=("cuda",)).as_text()


@pytest.fixture
def lowered_kernels(monkeypatch) -> list:
    """The kernels that `call_kernel` lowers, in order."""
    kernels = []

    def lower(*args, plain=kernel_calls._lower):
        kernels.append(plain(*args))
        return kernels[-1]

    monkeypatch.setattr(kernel_calls, "_lower", lower)
    return kernels


def trainer_with_kernels(monkeypatch, num_seeds: int = 1):
    """A trainer as on a GPU, and the shapes of its state."""
    for module in (elementwise, rows):
        monkeypatch.setattr(module, "has_kernels", lambda: True)
    env = BounceBall()
    trainer = ppo.make_trainer(CONFIG, env, env.config.episode_steps)
    key = jax.random.PRNGKey(0)
    if num_seeds > 1:
        trainer, key = ppo.population(trainer), jax.random.split(key, num_seeds)
    return trainer, jax.eval_shape(trainer.init, key)


def training_text(trainer, state) -> str:
    program = jax.jit(lambda state: trainer.run(state, 1)).trace(state)
    return program.lower(lowering_platforms=("cuda",)).as_text()


@pytest.fixture
def no_locations():
    """Programs without the lines of Python that they come from."""
    limit = jax.config.jax_traceback_in_locations_limit
    jax.config.update("jax_traceback_in_locations_limit", 0)
    yield
    jax.config.update("jax_traceback_in_locations_limit", limit)


def test_the_program_has_the_same_call_as_without(no_locations):
    kernel = doubling()
    calls = [
        re.search(r"custom_call @mosaic_gpu.*", lowered_text(function)).group()
        for function in (kernel, lambda x: call_kernel(kernel, RESULTS, x))
    ]
    # Arguments and results have other names.
    plain, ours = (re.sub(r"%\w+", "", call) for call in calls)
    assert ours == plain


ON_DEVICES = """
import jax, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from bounce_mjx.gpu import kernel_calls
import test_kernel_calls as tests
lowered, lower = [], kernel_calls._lower
kernel_calls._lower = lambda *args: lowered.append(args) or lower(*args)
x = jax.ShapeDtypeStruct((tests.SIZE,), "float32")
for n in (2, 1):
    sharding = NamedSharding(Mesh(np.array(jax.devices()[:n]), "d"), PartitionSpec())
    call = lambda x: kernel_calls.call_kernel(tests.doubling(), tests.RESULTS, x)
    program = jax.jit(call, in_shardings=sharding).trace(x).lower(lowering_platforms=("cuda",))
    print(program.as_text().count("custom_call @mosaic_gpu"), len(lowered))
"""


@pytest.mark.slow
def test_a_kernel_is_lowered_on_its_own_for_one_of_several_devices():
    """XLA lowers those of a program for several devices."""
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", ON_DEVICES],
        cwd=Path(__file__).parent,
        env=os.environ | flags,
        capture_output=True,
        text=True,
    )
    assert done.stdout.splitlines() == ["1 0", "1 1"], done.stderr


@pytest.mark.parametrize("num_seeds", [1, 2])
@pytest.mark.slow
def test_a_training_on_a_gpu_lowers_each_kernel_once(lowered_kernels, monkeypatch, num_seeds: int):
    """The kernels of the first states and of the control step."""
    trainer, state = trainer_with_kernels(monkeypatch, num_seeds)
    assert not lowered_kernels
    text = training_text(trainer, state)
    assert len(lowered_kernels) == text.count("custom_call @mosaic_gpu") == 2
