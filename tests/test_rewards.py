"""The reward terms are those of the specification's transcription, and have its gradients."""

import math
from functools import partial

import jax
import numpy as np
import pytest

from bounce_mjx import EnvConfig
from bounce_mjx.task import term_names, weighted_terms
from bounce_mjx.task.bounce_rewards import RewardInputs, Rewards
from reward_reference import REFERENCE_WEIGHTS, reference_terms

SPEC_NAMES = tuple(REFERENCE_WEIGHTS)
N_STATES = 10_000
X_TARGET = 0.58856


def terms_of(config: Rewards, inputs: dict[str, jax.Array]) -> dict[str, jax.Array]:
    return weighted_terms(config, RewardInputs(**inputs, reward=config))


def evaluate(config: Rewards, states: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the package's weighted terms `[N]` of a batch of states, in float64."""
    with jax.enable_x64(True):
        terms = jax.jit(jax.vmap(partial(terms_of, config)))(states)
        return {name: np.asarray(term) for name, term in terms.items()}


def state(
    *, dx=0.0, dy=0.0, z=0.5, vz=0.0, target=0.5, paddle_z=0.05, paddle_dx=0.0, paddle_dy=0.0,
    n_bounces=0, bounced=False, action=0.0, last_action=0.0, joint_velocity=0.0,
) -> dict[str, np.ndarray]:  # fmt: skip
    """One state as a batch of one; `dx`, `dy` and `paddle_dx`, `paddle_dy` are offsets from the
    target."""
    return {
        "ball_position": np.array([[X_TARGET + dx, dy, z]]),
        "ball_velocity": np.array([[0.3, -0.2, vz]]),
        "paddle_position": np.array([[X_TARGET + paddle_dx, paddle_dy, paddle_z]]),
        "target_height": np.array([target]),
        "n_bounces": np.array([n_bounces]),
        "bounced": np.array([bounced]),
        "action": np.broadcast_to(np.float64(action), (1, 6)),
        "last_action": np.broadcast_to(np.float64(last_action), (1, 6)),
        "joint_velocity": np.broadcast_to(np.float64(joint_velocity), (1, 6)),
    }


def stack(states: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([s[name] for s in states]) for name in states[0]}


def random_states(seed: int) -> dict[str, np.ndarray]:
    """Draw `N_STATES` states on both sides of every condition and clip of the formulas."""
    rng = np.random.default_rng(seed)

    def offsets(low: float, high: float) -> np.ndarray:
        # Log-uniform radii: the terms' widths run from 0.02 m to 0.4 m.
        radius = np.exp(rng.uniform(np.log(low), np.log(high), N_STATES))
        angle = rng.uniform(-np.pi, np.pi, N_STATES)
        return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    target = rng.uniform(0.3, 0.8, N_STATES)
    kind = rng.random(N_STATES)
    near_target, launched = kind < 0.4, kind > 0.8
    z = np.select(
        [near_target, launched],
        [target + rng.uniform(-0.08, 0.08, N_STATES), rng.uniform(0.02, 0.2, N_STATES)],
        rng.uniform(0.02, 1.6, N_STATES),
    )
    slow = rng.random(N_STATES) < 0.4
    vz = np.select(
        [launched, slow],
        [rng.uniform(0.0, 5.0, N_STATES), rng.uniform(-1.0, 1.0, N_STATES)],
        rng.uniform(-5.0, 5.0, N_STATES),
    )
    ball_xy = np.array([X_TARGET, 0.0]) + offsets(1e-3, 1.5)
    paddle_xy = ball_xy + offsets(1e-3, 0.5)
    paddle_z = rng.uniform(-0.15, 0.35, N_STATES)
    return {
        "ball_position": np.column_stack([ball_xy, z]),
        "ball_velocity": np.column_stack([rng.normal(size=(N_STATES, 2)), vz]),
        "paddle_position": np.column_stack([paddle_xy, paddle_z]),
        "target_height": target,
        "n_bounces": np.where(
            rng.random(N_STATES) < 0.5, rng.integers(0, 5, N_STATES), rng.integers(0, 61, N_STATES)
        ),
        "bounced": rng.random(N_STATES) < 0.5,
        "action": rng.uniform(-1.0, 1.0, (N_STATES, 6)),
        "last_action": rng.uniform(-1.0, 1.0, (N_STATES, 6)),
        "joint_velocity": rng.uniform(-2 * np.pi, 2 * np.pi, (N_STATES, 6)),
    }


def test_terms_equal_the_reference():
    states = random_states(seed=0)
    package, reference = evaluate(EnvConfig().reward, states), reference_terms(**states)
    assert reference.keys() == set(SPEC_NAMES)
    # Further terms may follow those of the specification.
    assert term_names(Rewards)[: len(SPEC_NAMES)] == SPEC_NAMES
    for name, term in reference.items():
        assert package[name].dtype == np.float64
        # atol only excuses Gaussian tails, 1e-12 and less of a term of order one.
        expected = REFERENCE_WEIGHTS[name] * term
        np.testing.assert_allclose(package[name], expected, rtol=1e-6, atol=1e-12, err_msg=name)


E = math.exp
HALF = math.exp(-0.5)  # a Gaussian one width from its centre


# Each row: term, state, weight * term worked out from the specification's formula.
PINNED = [
    # d_vert = 0: w = 1, sigma = 0.1 * (1 + 3) = 0.4 = err_xy
    ("position", state(dx=0.4, z=0.05), 2.0 * HALF),
    # err_xy = hypot(0.06, 0.08) = 0.1; d_vert = 0.15: w = 1/e, sigma = 0.1 (1 + 3/e)
    ("position", state(dx=0.06, dy=-0.08, z=0.2), 2.0 * E(-0.5 / (1 + 3 * E(-1)) ** 2)),
    # the sigmoid's midpoint: err_xy = 0.05, -2 / 2
    ("out_of_position", state(dx=0.03, dy=0.04), -1.0),
    # err_xy = 0.08: (0.08 - 0.05) / 0.03 = 1
    ("out_of_position", state(dy=-0.08), -2.0 / (1 + E(-1))),
    # case 1: dh = 0.1, v^2 = 4 - 1.962 = 2.038; sigmoids at 2 / 0.2 = 10 and 0.1 / 0.02 = 5
    (
        "velocity_matching",
        state(z=0.4, vz=2.0),
        2.0 * E(-((math.sqrt(2.038) / (1 + E(-10)) / (1 + E(-5)) - 0.5) ** 2) / 1.28),
    ),
    # case 1 short of the target: dh = 0.3, 1 - 5.886 < 0, so v = 0, err = 0.5
    ("velocity_matching", state(z=0.2, vz=1.0), 2.0 * E(-0.25 / 1.28)),
    # case 2: dh = -0.1, v = -sqrt(1 + 1.962); 1 - sigmoid(-5) = sigmoid(5), twice
    (
        "velocity_matching",
        state(z=0.6, vz=-1.0),
        2.0 * E(-((-math.sqrt(2.962) / (1 + E(-5)) ** 2 - 0.5) ** 2) / 1.28),
    ),
    # no case: falling at dh = 0.2, or rising at dh = -0.2: v = 0, err = 0.5
    ("velocity_matching", state(z=0.3, vz=-1.0), 2.0 * E(-0.25 / 1.28)),
    # cases 1 and 3 at dh = 0.01: sqrt(1 - 0.1962) sigmoid(5) sigmoid(0.5) + 1 * exp(-1/2)
    (
        "velocity_matching",
        state(z=0.49, vz=1.0),
        2.0 * E(-((math.sqrt(0.8038) / (1 + E(-5)) / (1 + E(-0.5)) + HALF - 0.5) ** 2) / 1.28),
    ),
    # case 3 alone, falling at dh = 0.02: v = -0.4 * exp(-0.0004 / 0.0002) = -0.4 / e^2
    ("velocity_matching", state(z=0.48, vz=-0.4), 2.0 * E(-((0.4 * E(-2) + 0.5) ** 2) / 1.28)),
    ("height", state(z=0.35), 4.5 * HALF),
    # (0.5 - 0.2) * 2; nothing below 0.2
    ("height_progress", state(), 0.6),
    # q_pos = HALF (err_xy = 0.02); dh = 0.2, v_ideal = sqrt(3.924); v_z = 1.2; sigmoid(12)
    (
        "controlled_upward",
        state(dx=0.02, z=0.3, vz=1.2),
        1.5 * HALF * E(-((1.2 - math.sqrt(3.924)) ** 2) / 0.5) / (1 + E(-12)) * 1.2,
    ),
    # dh = 0.5: v_ideal = sqrt(9.81) cut to 3; v_z = 2.5 is 0.5 off and cut to 1.5; sigmoid(25)
    ("controlled_upward", state(z=0.1, target=0.6, vz=2.5), 1.5 * HALF / (1 + E(-25)) * 1.5),
    # 0.8 * 0.5 * ln 2
    ("consecutive_bounces", state(n_bounces=1), 0.4 * math.log(2)),
    # 0.8 * 0.5 * ln 10, err_xy = 0.05
    ("consecutive_bounces", state(dx=-0.03, dy=0.04, n_bounces=9), 0.4 * math.log(10) * HALF),
    # the sigmoid's midpoint: 0.3 * 2 * 0.15 / 2
    ("high_bounce_count", state(n_bounces=2), 0.045),
    # 0.3 * 5 * 0.15 = 0.225, err_xy = 0.05, (5 - 2) / 0.5 = 6
    ("high_bounce_count", state(dy=0.05, n_bounces=5), 0.225 * HALF / (1 + E(-6))),
    ("alignment", state(z=0.05, bounced=True), 1.62),
    # ball and paddle 0.03 apart in x (0.1 - 0.07), d_vert = 0.1: 0.18 * (1 + 2/e)
    ("alignment", state(dx=0.1, paddle_dx=0.07, z=0.15), 0.18 * HALF * (1 + 2 * E(-1))),
    # 0.03 apart in y, from below the paddle
    ("alignment", state(paddle_dy=0.03, z=0.05, paddle_z=0.15), 0.18 * HALF * (1 + 2 * E(-1))),
    # at home, the distance factor's midpoint d_vert = 0.15: 1.5 * 1.25
    ("paddle_home", state(z=0.2), 1.875),
    # err_home = 0.05, d_vert = 0.18: (0.18 - 0.15) / 0.03 = 1
    ("paddle_home", state(z=0.28, paddle_z=0.1), 1.5 * HALF * (1 + 0.5 / (1 + E(-1)))),
    ("excessive_upward", state(vz=3.8), -1.0 / (1 + E(-1))),
    # 1 * 0.3, sigmoid(0.8 / 0.2)
    ("downward_velocity", state(vz=-1.0), 0.3 / (1 + E(-4))),
    # 2 * 0.6 cut to 2 * 0.5, sigmoid(1.8 / 0.2)
    ("downward_velocity", state(vz=-2.0), 1.0 / (1 + E(-9))),
    ("paddle_height_violation", state(paddle_z=0.14), 0.0),
    ("paddle_height_violation", state(paddle_z=0.25), -2.0),
    ("paddle_height_violation", state(paddle_z=-0.15), -2.0),
    (
        "action_rate",
        state(action=[0.5, 0.1, 0.2, 0, 0, -1], last_action=[0, 0, 0.2, 0, 0, 0]),
        -1.26e-4,
    ),
    # 1 + 4 + 9 + 16 + 25 + 36 = 91
    ("joint_velocity", state(joint_velocity=[1, -2, 3, -4, 5, -6]), -91e-4),
]


def test_terms_and_reference_equal_values_by_hand():
    assert {name for name, _, _ in PINNED} == set(SPEC_NAMES)
    terms = evaluate(Rewards(), stack([inputs for _, inputs, _ in PINNED]))
    for row, (name, inputs, expected) in enumerate(PINNED):
        reference = REFERENCE_WEIGHTS[name] * reference_terms(**inputs)[name][0]
        assert reference == pytest.approx(expected, rel=1e-9, abs=1e-12), (name, row)
        assert terms[name][row] == pytest.approx(expected, rel=1e-9, abs=1e-12), (name, row)


def reward(config: Rewards, inputs: dict[str, jax.Array]):
    return sum(terms_of(config, inputs).values())


VARIED = ("ball_position", "ball_velocity", "paddle_position", "action", "joint_velocity")


def directional_derivatives(inputs: dict[str, jax.Array], direction: dict[str, jax.Array]):
    """Derivatives [N] of the reward along a direction, by JAX and by central differences of the
    fourth order."""
    step = 3e-6
    evaluate = jax.jit(jax.vmap(partial(reward, Rewards())))

    def reward_after(steps: float):
        moved = {n: inputs[n] + steps * step * direction[n] for n in VARIED}
        return evaluate(inputs | moved)

    by_difference = (
        8.0 * (reward_after(1.0) - reward_after(-1.0)) - (reward_after(2.0) - reward_after(-2.0))
    ) / (12.0 * step)

    def along(inputs, direction):
        gradient = jax.grad(lambda varied: reward(Rewards(), inputs | varied))(
            {name: inputs[name] for name in VARIED}
        )
        return sum(jax.numpy.vdot(gradient[name], direction[name]) for name in VARIED)

    return jax.jit(jax.vmap(along))(inputs, direction), by_difference


def test_gradient_equals_finite_differences():
    """Compared at states on both sides of every condition, except for the few states that a
    difference step moves across one."""
    states = random_states(11)
    rng = np.random.default_rng(12)
    states = states | {"n_bounces": states["n_bounces"].astype(np.float64)}
    direction = {name: rng.normal(size=states[name].shape) for name in VARIED}
    with jax.enable_x64(True):
        inputs = {name: jax.numpy.asarray(x) for name, x in states.items()}
        actual, expected = directional_derivatives(inputs, inputs | direction)
        actual, expected = np.asarray(actual), np.asarray(expected)
    assert np.isfinite(actual).all()
    error = np.abs(actual - expected) / (1.0 + np.abs(expected))
    assert np.quantile(error, 0.999) < 1e-7


def test_gradient_is_finite_everywhere():
    """At the target height and the apex, above and below, over and in the paddle's centre."""
    places = [state(vz=1.0), state(vz=0.0), state(z=0.4, vz=1.0), state(z=0.6, vz=-1.0)]
    places += [state(z=0.6, vz=1.0), state(dx=0.0, dy=0.0, z=0.3, vz=-1.0)]
    places += [state(z=0.05, paddle_z=0.05)]
    with jax.enable_x64(True):
        inputs = {name: jax.numpy.asarray(x, float) for name, x in stack(places).items()}
        gradient = jax.vmap(jax.grad(lambda inputs: reward(Rewards(), inputs)))(inputs)
    for name, value in gradient.items():
        assert np.isfinite(value).all(), name
