"""Kernels that are lowered on their own, and the program around them. This needs no GPU."""

import re

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
        out_type=[
            jax.ShapeDtypeStruct((SIZE,), jnp.float32),
            jax.ShapeDtypeStruct((2,), jnp.int32),
        ],
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
    monkeypatch.setattr(kernel_calls, "_kept", {})
    return kernels


def test_the_program_has_the_same_call_as_without():
    kernel = doubling()
    calls = [
        re.search(r"custom_call @mosaic_gpu.*", lowered_text(function)).group()
        for function in (kernel, lambda x: call_kernel(kernel, x))
    ]
    # Arguments and results have other names.
    plain, ours = (re.sub(r"%\w+", "", call) for call in calls)
    assert ours == plain


def test_a_kernel_is_lowered_again_unless_its_key_is_known(lowered_kernels):
    for key, factor, count in ((None, 2.0, 1), (None, 2.0, 2), ("a", 3.0, 3), ("a", 3.0, 3)):
        lowered_text(lambda x, f=factor, k=key: call_kernel(doubling(f), x, key=k))
        assert len(lowered_kernels) == count
    modules = [kernel.attributes["module"] for kernel in lowered_kernels]
    assert modules[2] not in modules[:2]


def test_a_training_on_a_gpu_starts_with_its_longest_kernel(lowered_kernels, monkeypatch):
    """The kernel of a minibatch has three results. It is lowered before the others, and leaves no
    matrix products to XLA. Every kernel is lowered once."""
    for module in (elementwise, rows, ppo):
        monkeypatch.setattr(module, "has_kernels", lambda: True)
    config = PPOConfig(
        num_envs=64, num_minibatches=2, hidden_layers=(64, 64), compute_dtype="bfloat16"
    )
    env = BounceBall()
    trainer = ppo.make_trainer(config, env, env.config.episode_steps)
    state = jax.eval_shape(trainer.init, jax.random.PRNGKey(0))
    assert not lowered_kernels
    program = jax.jit(lambda state: trainer.run(state, 1)).trace(state)
    text = program.lower(lowering_platforms=("cuda",)).as_text()
    num_results = [len(jax.tree.leaves(kernel.results)) for kernel in lowered_kernels]
    assert num_results[0] == 3
    assert len(num_results) == 6 and num_results.count(3) == 1
    # First states, policy, control step, values, gradient, and sums.
    assert text.count("custom_call @mosaic_gpu") == 6
    assert "dot_general" not in text
    assert not trainer.has_products
