"""Functions of small arrays as functions of scalars, and the control step as one kernel."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.env import vector
from bounce_mjx.gpu import elementwise, rows
from bounce_mjx.gpu.rows import Rows
from bounce_mjx.gpu.scalars import UnsupportedOperation, as_scalars

# Not a multiple of the block size.
BATCH = 70
EPISODE_STEPS = 2000


def evaluate(function, *args):
    """Evaluates a function of arrays, which returns a list of arrays, through its scalar form."""
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args]
    scalar_function = as_scalars(function, shapes)
    scalars = [x[index] for x in args for index in np.ndindex(*x.shape)]
    results = scalar_function.call(*scalars)
    return [
        np.array([results[i] for i in p.flat]).reshape(p.shape) for p in scalar_function.positions
    ]


def shapes_and_sums(x, y):
    stacked = jnp.stack([x[0], x[1:].sum(axis=0), jnp.flip(y)])
    return [stacked.T, jnp.concatenate([x, y[None]]).max(axis=1), (x > 0.0).any()]


def calls_and_loops(x, y):
    looped = jax.lax.fori_loop(0, 5, lambda _, c: (c[0] * 0.5 + c[1][0], c[1] - 0.1), (x[0, 0], y))
    return [looped[1], jax.jit(jnp.tanh)(looped[0]), jax.nn.relu(x)]


def rewritten_operations(x, y):
    return [
        jax.nn.sigmoid(x),
        jnp.sqrt(jnp.abs(y)),
        jnp.log1p(jnp.abs(x)),
        jnp.floor(3.7 * x),
        jnp.clip(y, -0.2, 0.3),
        jnp.isfinite(x / jnp.where(y[0] > 100.0, 0.0, 1.0)),
        jnp.linalg.norm(x, axis=1),
        jnp.abs(y) ** 1.5,
    ]


def products(x, y):
    return [x @ y, x.T @ x, jnp.vdot(y, y), jnp.outer(y, y), jnp.einsum("bi,bi->b", x, x)]


def updates(x, y):
    sliced = [y.at[2].set(5.0), y.at[1:3].set(x[0, :2]), x.at[1, 2].set(7.0), x.at[:, 1].set(0.0)]
    return [*sliced, y.at[-1].add(y[0]), x.at[jnp.array([0, 0]), 1].add(1.0)]


def indices(x, y):
    taken = [y[jnp.array([2, 0])], x[jnp.array([1, 2]), jnp.array([0, 3])]]
    return [*taken, jax.lax.dynamic_slice(y, (1,), (2,)), jnp.argmax(x), jnp.argmin(x, axis=1)]


def orders(x, y):
    sums = [jnp.cumsum(y), jnp.cumprod(x, axis=0), jax.lax.cummax(y, reverse=True)]
    return [*sums, jnp.sort(y), jnp.argsort(x, axis=1), jnp.sort(x, axis=0, descending=True)]


def branches(x, y):
    cases = [lambda: y, lambda: 2.0 * y, lambda: 3.0 * y]
    chosen = [jax.lax.switch(i, cases) for i in (-1, jnp.int32(y[3]), jnp.int32(9.0 * y[3]))]
    return [jax.lax.cond(y[1] > 0.0, lambda: x, lambda: -x), *chosen]


FUNCTIONS = (
    shapes_and_sums, calls_and_loops, rewritten_operations, products, updates, indices, orders,
    branches,
)  # fmt: skip


@pytest.mark.parametrize("function", FUNCTIONS)
def test_scalars_give_the_arrays(function):
    x, y = jax.random.normal(jax.random.PRNGKey(0), (3, 4)), jnp.array([0.5, -1.5, 0.0, 2.0])
    for ours, theirs in zip(evaluate(function, x, y), function(x, y), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6)


def test_rewritten_operations_are_jax_numpys_at_special_numbers():
    """In one kernel, run by the interpreter, over all pairs of numbers."""

    def function(x, y):
        return {
            "acos": jnp.arccos(x),
            "asin": jnp.arcsin(x),
            "atan": jnp.arctan(x),
            "atan2": jnp.arctan2(x, y),
            "ceil": jnp.ceil(x),
            "clamp": jax.lax.clamp(y, x, 1.5),
            "copy": jnp.copy(x),
            "cosh": jnp.cosh(x),
            "expm1": jnp.expm1(x),
            "floor": jnp.floor(x),
            "is_finite": jnp.isfinite(x),
            "log1p": jnp.log1p(x),
            "logistic": jax.lax.logistic(x),
            "pow": jnp.power(x, y),
            "pow of a whole number": jax.lax.pow(x, jax.lax.convert_element_type(y, jnp.int32)),
            "rem": jax.lax.rem(jnp.clip(x, -9.0, 9.0), jnp.float32(0.7)),
            "rem of any pair": jax.lax.rem(x, jnp.where(jnp.abs(x) < 1e4 * jnp.abs(y), y, jnp.inf)),
            "rem of whole numbers": jax.lax.rem(jnp.int32(7), jnp.int32(-3)) + 0 * x,
            "sinh": jnp.sinh(x),
            "sqrt": jnp.sqrt(x),
            "tan": jnp.tan(jnp.clip(x, -3.0, 3.0)),
            "stop_gradient": jax.lax.stop_gradient(x),
        }

    positive = jnp.array([0.0, 1e-9, 1e-4, 0.3, 0.5, 1.0, 1.5, 2.0, 3.0, 1e9, jnp.inf])
    numbers = jnp.concatenate([positive, -positive, jnp.array([jnp.nan])])
    pairs = [grid.ravel() for grid in jnp.meshgrid(numbers, numbers)]
    in_kernel = jax.jit(jax.vmap(elementwise.in_one_kernel(function, interpret=True)))
    assert "pallas_call" in str(in_kernel.trace(*pairs).jaxpr)
    expected = jax.vmap(function)(*pairs)
    for name, found in in_kernel(*pairs).items():
        np.testing.assert_allclose(found, expected[name], rtol=1e-5, err_msg=name)
        if found.dtype == jnp.float32:
            number = ~np.isnan(expected[name])
            signs = (np.signbit(x)[number] for x in (found, expected[name]))
            np.testing.assert_array_equal(*signs, err_msg=name)


def test_equal_entries_are_one_scalar_and_unused_ones_are_marked():
    shape = jax.ShapeDtypeStruct((3,), jnp.float32)
    scalar_function = as_scalars(lambda x, y: [x, jnp.stack([x[2], x[0]]), x[0] + 1.0], [shape] * 2)
    assert len(scalar_function.dtypes) == 4
    assert scalar_function.used == [True] * 3 + [False] * 3
    assert scalar_function.positions[1].tolist() == [2, 0]


@pytest.mark.parametrize(
    "function", [lambda x: [jnp.lexsort((x, x))], lambda x: [x[jnp.argmax(x)]]]
)
def test_operations_without_a_scalar_form_are_refused(function):
    with pytest.raises(UnsupportedOperation):
        as_scalars(function, [jax.ShapeDtypeStruct((3,), jnp.float32)])


def test_functions_without_a_scalar_form_are_unchanged_which_is_said_once(capsys):
    elementwise._say_once.cache_clear()
    x = jax.random.normal(jax.random.PRNGKey(0), (BATCH, 3))
    program = jax.vmap(elementwise.in_one_kernel(jnp.median, interpret=True))
    assert "pallas_call" not in str(jax.make_jaxpr(program)(x))
    np.testing.assert_array_equal(program(x), jnp.median(x, axis=1))
    (line,) = capsys.readouterr().err.splitlines()
    assert "the operation gather at an index that is computed, so XLA" in line


def test_entries_of_every_type_enter_a_kernel_and_leave_it_in_any_order():
    """A batch of batches; the function leaves out entries of its arguments, and mixes and repeats
    those of its results."""

    def function(x, count, flag):
        mixed = jnp.stack([x[1, 2], x[0, 0], x[0, 1], x[1, 2] * flag[1]])
        return {
            "mixed": mixed,
            "count": count - 2**30,
            "flag": ~flag,
            "again": x[0],
            "sum": x.sum(),
        }

    x_key, count_key, flag_key = jax.random.split(jax.random.PRNGKey(0), 3)
    x = jax.random.normal(x_key, (4, 2, 3, BATCH))
    count = jax.random.randint(count_key, (BATCH, 4), -(2**31), 2**31 - 1)
    flag = jax.random.bernoulli(flag_key, shape=(3, BATCH))

    def batched(function):
        inner = jax.vmap(function, in_axes=(-1, 0, -1), out_axes=-1)
        return jax.vmap(inner, in_axes=(0, 1, None), out_axes=0)

    program = jax.jit(batched(elementwise.in_one_kernel(function, interpret=True)))
    traced = program.trace(x, count, flag)
    assert "pallas_call" in str(traced.jaxpr)
    found, expected = traced.lower().compile()(x, count, flag), batched(function)(x, count, flag)
    for name, array in expected.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_allclose(found[name], array, rtol=1e-6, atol=1e-6, err_msg=name)


def test_a_function_of_integers_has_a_gradient_in_a_kernel():
    def function(x, count):
        return x**2 * count, count + 1

    in_kernel = elementwise.in_one_kernel(function, interpret=True)
    x, count = jnp.linspace(0.5, 2.0, BATCH), jnp.arange(BATCH)
    gradient = jax.grad(lambda x: jax.vmap(in_kernel)(x, count)[0].sum())(x)
    np.testing.assert_allclose(gradient, 2.0 * x * count, rtol=1e-6)


def test_rows_hold_every_type():
    tree = {
        "float": jax.random.normal(jax.random.PRNGKey(0), (2, 3, 5)),
        "int": jnp.array([0, 1, -7, 2**31 - 1, -(2**31)], jnp.int32),
        "bool": jnp.array([[True, False, True, True, False]]),
        "single": jnp.arange(5.0),
    }
    numbers = {"float": jnp.float32(0.5), "int": jnp.int32(-7)}
    assert Rows.of(numbers).tree() == numbers
    packed = Rows.of(tree)
    assert packed.rows.shape == (9, 5) and packed.rows.dtype == jnp.float32
    _, stacked = jax.lax.scan(lambda carry, _: (carry, carry), packed, length=2)
    twice = stacked.tree()
    for name, expected in tree.items():
        assert twice[name].dtype == expected.dtype
        np.testing.assert_array_equal(twice[name][1], expected)


def test_a_loop_unpacks_the_rows_of_its_steps(monkeypatch):
    tree = {
        "float": jax.random.normal(jax.random.PRNGKey(0), (3, 2, 5)),
        "int": jnp.arange(15, dtype=jnp.int32).reshape(3, 5),
        "bool": jnp.arange(15).reshape(3, 5) % 4 == 0,
    }
    assert rows.pack_steps(tree, 1) is tree
    monkeypatch.setattr(rows, "has_kernels", lambda: True)
    assert rows.pack_steps(tree, 2) is tree
    packed = rows.pack_steps(tree, 1)
    assert packed.rows.shape == (3, 20)
    _, steps = jax.lax.scan(lambda carry, step: (carry, rows.unpack(step)), 0, packed)
    for name, expected in tree.items():
        assert steps[name].dtype == expected.dtype
        np.testing.assert_array_equal(steps[name], expected)


SPIN = {
    "restitution": (0.7, 0.95),
    "restitution_slope": (0.01, 0.05),
    "contact_friction": (0.1, 0.3),
    "air_lift": (0.0, 0.006),
}


@pytest.mark.slow
@pytest.mark.parametrize("terms", ({}, SPIN), ids=("plain", "spin"))
def test_the_control_step_is_one_kernel(monkeypatch, terms):
    """Physics, task, reward, terminations, time-outs and resets, against the program without a
    kernel."""
    env = BounceBall(EnvConfig(randomization=terms))
    reset_key, action_key, fresh_key = jax.random.split(jax.random.PRNGKey(0), 3)
    state = jax.jit(lambda key: vector.reset(env, key, BATCH))(reset_key)
    # Some time out at this step, and some lose the ball.
    state = state._replace(clock=EPISODE_STEPS - 1 - jnp.arange(BATCH, dtype=jnp.int32) % 3)
    physics = state.env.pipeline_state.physics
    height = env._addresses.ball_qpos[2]
    qpos = physics.qpos.at[height, ::5].set(0.04)
    pipeline_state = state.env.pipeline_state._replace(physics=physics._replace(qpos=qpos))
    state = state._replace(env=state.env.replace(pipeline_state=pipeline_state))
    action = jax.random.uniform(action_key, (BATCH, 6), minval=-1.5, maxval=1.5)
    action = action.at[1, 2].set(jnp.nan)
    fresh = jax.jit(lambda key: vector.first_states(env, key, BATCH))(fresh_key)

    def step(state, action, fresh):
        return vector.step_with(env, state, action, fresh, EPISODE_STEPS)

    expected = jax.jit(step)(state, action, fresh)
    assert expected[1].truncated.any() and expected[1].terminated.any()
    assert expected[1].metrics["non_finite"].sum() == 1 and expected[1].terminated[1]
    in_one_kernel = functools.partial(elementwise.in_one_kernel, interpret=True)
    monkeypatch.setattr(vector, "in_one_kernel", in_one_kernel)
    program = jax.jit(lambda *args: step(*args)).trace(state, action, fresh)
    assert str(program.jaxpr).count("pallas_call") == 1
    found = program.lower().compile()(state, action, fresh)
    for (path, ours), theirs in zip(
        jax.tree_util.tree_leaves_with_path(found), jax.tree.leaves(expected), strict=True
    ):
        name = jax.tree_util.keystr(path)
        assert ours.dtype == theirs.dtype, name
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5, err_msg=name)
