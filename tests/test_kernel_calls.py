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
from bounce_mjx.gpu.scalars import as_scalars
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
    monkeypatch.setattr(kernel_calls, "_kept", {})
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


def test_the_program_has_the_same_call_as_without():
    kernel = doubling()
    calls = [
        re.search(r"custom_call @mosaic_gpu.*", lowered_text(function)).group()
        for function in (kernel, lambda x: call_kernel(kernel, RESULTS, x))
    ]
    # Arguments and results have other names.
    plain, ours = (re.sub(r"%\w+", "", call) for call in calls)
    assert ours == plain


def test_a_kernel_is_lowered_again_unless_its_key_is_known(lowered_kernels):
    for key, factor, count in ((None, 2.0, 1), (None, 2.0, 2), (("a",), 3.0, 3), (("a",), 3.0, 3)):
        lowered_text(lambda x, f=factor, k=key: call_kernel(doubling(f), RESULTS, x, key=k))
        assert len(lowered_kernels) == count
    modules = [attributes["module"] for attributes, _ in lowered_kernels]
    assert modules[2] not in modules[:2]


@pytest.mark.parametrize("num_seeds", [1, 2])
def test_a_training_on_a_gpu_lowers_each_kernel_once(lowered_kernels, monkeypatch, num_seeds: int):
    """The kernels of the first states and of the control step."""
    trainer, state = trainer_with_kernels(monkeypatch, num_seeds)
    assert not lowered_kernels
    text = training_text(trainer, state)
    assert len(lowered_kernels) == text.count("custom_call @mosaic_gpu") == 2


class Elsewhere:
    """Kernels that another process has lowered."""

    def __init__(self, kernels: dict[str, dict], kinds: tuple[str, ...]):
        self.kernels, self.kinds, self.wanted = kernels, kinds, []

    def lowers(self, kind: str) -> bool:
        return kind in self.kinds

    def wait_for(self, kind: str, name: str) -> dict | None:
        assert kind in self.kinds
        self.wanted.append(name)
        return self.kernels.get(name)


KINDS = ("elementwise",)


@pytest.mark.parametrize("num_seeds", [1, 2])
def test_another_process_can_lower_the_kernels_of_a_training(
    lowered_kernels, monkeypatch, num_seeds: int
):
    """What a process lowers for another one is what that one asks for. The other one lowers only
    the kernel of the first states."""
    trainer, state = trainer_with_kernels(monkeypatch, num_seeds)
    monkeypatch.setattr(kernel_calls, "_receive", None)
    given = []
    kernel_calls.lower_for_another(KINDS, given.append)
    jax.make_jaxpr(lambda state: trainer.run(state, 1))(state)
    monkeypatch.setattr(kernel_calls, "_receive", None)
    # These are two processes, so one does not know what the other one has traced.
    trainer, state = trainer_with_kernels(monkeypatch, num_seeds)
    helper = Elsewhere({kernel.name: kernel.attributes for kernel in given}, KINDS)
    assert len(helper.kernels) == len(given)
    lowered_kernels.clear()
    monkeypatch.setattr(kernel_calls, "_helper", helper)
    text = training_text(trainer, state)
    assert len(given) == 1 and sorted(helper.wanted) == sorted(helper.kernels)
    assert len(lowered_kernels) == 1
    assert text.count("custom_call @mosaic_gpu") == 2

    # Without the other process's kernels, the same program lowers all of them.
    helper.kernels = {}
    other = training_text(trainer, state)
    assert len(lowered_kernels) == 1 + 1 + 1

    def without_kernels(text: str) -> str:
        return re.sub(r'(kernel_hash|module) = "(?:[^"\\]|\\.)*"', "", text)

    assert without_kernels(other) == without_kernels(text)


NAMES = """
import jax
from bounce_mjx.gpu import kernel_calls
import pytest
import test_kernel_calls as tests
with pytest.MonkeyPatch.context() as patch:
    trainer, state = tests.trainer_with_kernels(patch)
    patch.setattr(kernel_calls, "_lower", lambda *_: ({}, None))
    kernel_calls.lower_for_another(tests.KINDS, lambda kernel: print(kernel.name))
    jax.make_jaxpr(lambda state: trainer.run(state, 1))(state)
"""


def test_a_kernel_has_the_same_name_in_every_process():
    def names(seed: str) -> list[str]:
        return subprocess.run(
            [sys.executable, "-c", NAMES],
            cwd=Path(__file__).parent,
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.splitlines()

    first = names("1")
    assert len(first) == 1 and first == names("2")


def test_functions_with_other_numbers_are_other_kernels():
    x = jax.ShapeDtypeStruct((2,), jnp.float32)

    def digest(function) -> str:
        return as_scalars(lambda x: [function(x)], [x]).digest

    def loop(x: jax.Array, count: int, step: float) -> jax.Array:
        return jax.lax.fori_loop(0, count, lambda _, x: x + step, x)

    functions = [
        lambda x: 2.0 * x,
        lambda x: 3.0 * x,
        lambda x: 2.0 + x,
        lambda x: x * jnp.array([2.0, 3.0]),
        lambda x: x * jnp.array([2.0, 4.0]),
        lambda x: x - x[::-1],
        lambda x: x[::-1] - x,
        lambda x: loop(x, 3, 1.0),
        lambda x: loop(x, 4, 1.0),
        lambda x: loop(x, 3, 2.0),
        lambda x: jnp.where(x > 0.0, x, 1.0),
        lambda x: jnp.where(x > 0.0, x, 2.0),
    ]
    digests = [digest(function) for function in functions]
    assert len(set(digests)) == len(functions)
    assert digests == [digest(function) for function in functions]
