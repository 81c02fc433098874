"""Air on a spinning ball, and restitution that falls with the impact's speed (the drawn worlds of
`test_randomization.py` have both against MuJoCo's C engine)."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.physics import Control, PhysicsParameters, PhysicsState, edited_model, make_engine
from bounce_mjx.physics.control import drag
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.world.randomization import impact_damping, physics_parameters


def test_the_air_brakes_with_the_square_of_the_speed():
    np.testing.assert_allclose(drag(0.1, (3.0, 0.0, -4.0)), [-1.5, 0.0, 2.0], rtol=1e-6)


def test_lift_turns_a_flight_to_the_side_that_the_spin_says(mj_model):
    """Backspin lifts: spin about -y, flight along x."""
    engine = make_engine(mj_model, "fused")
    qpos = jnp.asarray(mj_model.qpos0).at[8].set(1.0)
    qvel = jnp.zeros(mj_model.nv).at[6].set(3.0).at[10].set(-100.0)
    control = Control(qpos[:6], air_lift=jnp.float32(0.005))
    step = jax.jit(lambda state: engine.step(PhysicsParameters(), state, control, 10))
    after = step(PhysicsState(qpos, qvel))
    assert float(after.qvel[8]) == pytest.approx(0.01 * (0.005 * 100.0 * 3.0 - 9.81), rel=1e-3)


def test_a_changed_world_keeps_the_slope():
    """As the sliders of a viewer change it."""
    sloped = {"restitution": (0.75, 0.95), "restitution_slope": (0.02, 0.05)}
    env = BounceBall(EnvConfig(randomization=sloped))
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    before = state.pipeline_state
    fast = before._replace(impact=jnp.float32(4.0))

    def damped(world: dict) -> float:
        return float(env.with_world(fast, world).parameters.contact_damping)

    own = damped(before.world)
    assert own == pytest.approx(
        float(impact_damping(before.world, env.mj_model, fast.impact)), rel=1e-6
    )
    flat = before.world | {"restitution_slope": jnp.float32(0.0)}
    level = physics_parameters(flat, env.mj_model).contact_damping
    assert damped(flat) == pytest.approx(float(level), rel=1e-5)
    assert own > 1.05 * damped(flat)


@pytest.mark.parametrize(
    "restitution, slope, speed",
    [(0.88, 0.03, 1.5), (0.88, 0.03, 4.5), (0.605, 0.1, 1.5), (0.605, 0.1, 3.5)],
)
def test_a_drop_bounces_with_the_restitution_of_its_speed(mj_model, speed, restitution, slope):
    """On C, in the mean over the phases of the first contact's physics step."""
    world = {"restitution": jnp.float32(restitution), "restitution_slope": jnp.float32(slope)}
    given = PhysicsParameters(contact_damping=impact_damping(world, mj_model, speed))
    model = edited_model(mj_model, given)
    rebounds = []
    for gap in speed * np.linspace(0.001, 0.002, 10, endpoint=False):
        data = mujoco.MjData(model)
        data.qpos[:6] = data.ctrl[:6] = EnvConfig().default_joint_angles
        mujoco.mj_kinematics(model, data)
        height = [0.0, 0.0, 0.0225 + gap]
        data.qpos[6:9] = data.geom_xpos[find_addresses(model).paddle_geom] + height
        data.qvel[8] = -speed
        while data.qvel[8] < 0.0 or data.ncon:
            mujoco.mj_step(model, data)
        rebounds.append(data.qvel[8] / speed)
    expected = restitution - slope * (speed - 2.45)
    assert np.mean(rebounds) == pytest.approx(expected, abs=0.015)
