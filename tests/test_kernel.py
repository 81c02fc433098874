"""The GPU kernel of the physics computes what XLA's own program computes; rows keep every bit."""

from collections.abc import Callable
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx import BounceBall
from bounce_mjx.gpu import elementwise as kernel
from bounce_mjx.gpu import rows
from bounce_mjx.learning import ppo
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.physics import Control, PhysicsParameters, PhysicsState
from bounce_mjx.physics.fused import dynamics
from random_worlds import random_parameters

# Not a multiple of the block size.
BATCH = 70
NUM_SUBSTEPS = 10
MODEL = PhysicsParameters()
# In the interpreter both programs are compiled from the same operations.
ROUNDING = 1e-6

Step = Callable[[PhysicsState, jax.Array], PhysicsState]


@pytest.fixture
def in_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fused physics of the test runs in the kernel."""
    monkeypatch.setattr(dynamics, "elementwise", partial(kernel.elementwise, interpret=True))


@cache
def moving(env: BounceBall, batch: int) -> tuple[PhysicsState, jax.Array]:
    """States that move, the batch last, and servo targets; in some the ball is in the paddle."""
    keys = jax.random.split(jax.random.PRNGKey(0), batch)
    physics = jax.vmap(env.reset, out_axes=-1)(keys).pipeline_state.physics
    at = env.addresses
    paddle = jax.vmap(partial(env.engine.paddle_position, MODEL), in_axes=-1, out_axes=-1)(
        physics.qpos
    )
    height = jnp.where(
        jnp.arange(batch) % 2 == 0, paddle[2] + 0.02, physics.qpos[at.balls[0].qpos[2]]
    )
    qpos = physics.qpos.at[jnp.array(at.balls[0].qpos[:2])].set(paddle[:2])
    qpos = qpos.at[at.balls[0].qpos[2]].set(height)
    qvel = physics.qvel + jax.random.normal(jax.random.PRNGKey(1), physics.qvel.shape)
    return PhysicsState(qpos, qvel), qpos[jnp.array(at.arm_qpos)] + 0.05


def step(
    env: BounceBall, physics: PhysicsState, ctrl: jax.Array, parameters: PhysicsParameters = MODEL
) -> PhysicsState:
    return dynamics.step(
        dynamics.read_model(env.mj_model), parameters, physics, Control(ctrl), NUM_SUBSTEPS
    )


def batched(env: BounceBall) -> Step:
    return jax.vmap(partial(step, env), in_axes=-1, out_axes=-1)


def random_worlds(env: BounceBall, batch: int) -> PhysicsParameters:
    """All physics parameters, the batch last; all environments share the gravity."""
    drawn = random_parameters(env.mj_model, batch, seed=0)
    drawn = jax.tree.map(lambda array: jnp.moveaxis(jnp.asarray(array), 0, -1), drawn)
    return drawn._replace(
        gravity=jnp.array([0.5, -0.5, -9.0]),
        contact_friction=jnp.linspace(0.0, 1.0, batch),
        frictionloss=jnp.linspace(jnp.zeros(6), jnp.arange(6.0), batch).T,
    )


def in_worlds(env: BounceBall) -> Callable[..., PhysicsState]:
    axes = PhysicsParameters(*(-1 for _ in MODEL))._replace(gravity=None)
    return jax.vmap(partial(step, env), in_axes=(-1, -1, axes), out_axes=-1)


@pytest.fixture(scope="module")
def by_xla(env: BounceBall) -> PhysicsState:
    return jax.jit(batched(env))(*moving(env, BATCH))


@pytest.mark.slow
def test_parameters_enter_the_kernel(env, by_xla, in_kernel, monkeypatch):
    """The kernel takes more inputs than coordinates and targets: all physics parameters of each
    environment."""
    args = (*moving(env, BATCH), random_worlds(env, BATCH))
    program = jax.jit(in_worlds(env)).trace(*args)
    assert "pallas_call" in str(program.jaxpr)
    after = program.lower().compile()(*args)
    monkeypatch.setattr(dynamics, "elementwise", kernel.elementwise)
    expected = jax.jit(in_worlds(env))(*args)
    np.testing.assert_allclose(after.qpos, expected.qpos, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(after.qvel, expected.qvel, rtol=ROUNDING, atol=100 * ROUNDING)
    assert np.all(np.abs(after.qvel - by_xla.qvel).max(axis=0) > 1e-3)


def test_the_kernel_has_the_derivative_of_the_function():
    """A kernel itself has no derivative, so the derivative is the plain function's."""

    def function(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.lax.fori_loop(0, 3, lambda i, z: z * y, x), jnp.sin(x)

    in_kernel = kernel.elementwise(function, 2, interpret=True)
    x, y = jnp.linspace(0.5, 2.0, BATCH), jnp.linspace(-1.0, 1.0, BATCH)
    for gradient in (
        jax.grad(lambda x, y: sum(jax.vmap(in_kernel)(x, y)).sum(), argnums=(0, 1)),
        jax.vmap(jax.grad(lambda x, y: sum(in_kernel(x, y)), argnums=(0, 1))),
    ):
        given = gradient(x, y)
        np.testing.assert_allclose(given[0], y**3 + np.cos(x), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(given[1], 3.0 * x * y**2, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_one_environment_and_float64_are_compiled_by_xla(env, in_kernel):
    physics, ctrl = moving(env, 2)
    one = jax.tree.map(lambda x: x[:, 0], physics)
    single = jax.jit(partial(step, env)).trace(one, ctrl[:, 0]).lower().as_text()
    assert "mosaic" not in single and "pallas" not in single
    with jax.enable_x64(True):
        doubled = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), (physics, ctrl))
        assert "pallas_call" not in str(jax.jit(batched(env)).trace(*doubled).jaxpr)


@pytest.mark.slow
def test_the_kernel_is_lowered_for_a_gpu(env, monkeypatch):
    """This needs no GPU: the program for a GPU contains a kernel, the program for a CPU none."""
    monkeypatch.setattr(kernel, "has_kernels", lambda: True)
    traced = jax.jit(in_worlds(env)).trace(*moving(env, BATCH), random_worlds(env, BATCH))
    on_gpu = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert on_gpu.count("custom_call @mosaic_gpu") == 1
    assert "mosaic" not in traced.lower(lowering_platforms=("cpu",)).as_text()


@pytest.mark.slow
def test_a_training_is_lowered_for_a_gpu(monkeypatch):
    """Of two seeds, with kernels of the physics in it, and with rows, here of one iteration."""
    for module in (kernel, rows):
        monkeypatch.setattr(module, "has_kernels", lambda: True)
    config = PPOConfig(num_envs=64, num_minibatches=2, hidden_layers=(8,))
    env = BounceBall()
    init, run = ppo.population(ppo.PPO(config, env, env.config.episode_steps))
    state = jax.eval_shape(init, jax.random.split(jax.random.PRNGKey(0), 2))
    traced = jax.jit(lambda state: run(state, 1)).trace(state)
    assert "custom_call @mosaic_gpu" in traced.lower(lowering_platforms=("cuda",)).as_text()
    assert jax.tree.structure(traced.out_info[0]) == jax.tree.structure(state)


def test_rows_hold_every_type(monkeypatch):
    tree = {
        "float": jax.random.normal(jax.random.PRNGKey(0), (2, 3, 5)),
        "int": jnp.array([0, 1, -7, 2**31 - 1, -(2**31)], jnp.int32),
        "uint": jnp.array([0, 1, 7, 2**31, 2**32 - 1], jnp.uint32),
        "bool": jnp.array([[True, False, True, True, False]]),
        "single": jnp.arange(5.0),
    }
    numbers = {"float": jnp.float32(0.5), "int": jnp.int32(-7)}
    assert rows.pack(tree) is tree and rows.unpack(tree) is tree
    monkeypatch.setattr(rows, "has_kernels", lambda: True)
    assert rows.unpack(rows.pack(numbers)) == numbers
    packed = rows.pack(tree)
    assert packed.rows.shape == (10, 5) and packed.rows.dtype == jnp.float32
    _, stacked = jax.jit(lambda packed: jax.lax.scan(lambda c, _: (c, c), packed, length=2))(packed)
    twice = rows.unpack(stacked)
    for name, expected in tree.items():
        assert twice[name].dtype == expected.dtype
        np.testing.assert_array_equal(twice[name][1], expected)


def test_only_supported_gpus_use_kernels_unless_they_are_off(monkeypatch):
    assert not kernel.has_kernels()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    for capability, expected in (("9.0", True), ("10.0", True), ("8.6", False), ("gfx90a", False)):
        device = type("Device", (), {"compute_capability": capability})
        monkeypatch.setattr(jax, "local_devices", lambda backend=None, device=device: [device])
        assert kernel.has_kernels() is expected
    monkeypatch.setenv("BOUNCE_MJX_GPU_KERNEL", "off")
    assert not kernel.has_kernels()
