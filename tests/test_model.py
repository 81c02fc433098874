"""The robot's model: which MJCF files are refused, and which edits are noticed."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from against_c import XML
from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.env.env import EnvState
from bounce_mjx.errors import UserError
from bounce_mjx.physics import PhysicsState
from bounce_mjx.robot.model import contact_pairs, find_addresses, load_model

SERVO_2 = '<position name="act2" joint="Joint2"/>'
REFUSED = {
    # edit, text that the message must contain
    "velocity servo": (SERVO_2, '<velocity name="act2" joint="Joint2" kv="200"/>', "Joint2"),
    "motor": (SERVO_2, '<motor name="act2" joint="Joint2"/>', "Joint2"),
    "integrated velocity": (
        SERVO_2,
        '<intvelocity name="act2" joint="Joint2" kp="20000" actrange="-2 2"/>',
        "Joint2",
    ),
    "pid servo": (SERVO_2, '<pid name="act2" joint="Joint2" kp="20000"/>', "several controls"),
    "servo that holds half its target": (
        SERVO_2,
        '<general name="act2" joint="Joint2" biastype="affine" gainprm="10000" '
        'biasprm="0 -20000 -200"/>',
        "Joint2",
    ),
    "servo that never rests": (
        SERVO_2,
        '<position name="act2" joint="Joint2" forcerange="2 10"/>',
        "forces of 2 to 10 on Joint2",
    ),
    # A compiler's default, and MuJoCo converts the ranges of limited joints alone.
    "range in degrees": (' angle="radian"', "", "of Joint1 in degrees"),
    "position nan": ('name="Link1" pos="0 0 0.1"', 'name="Link1" pos="0 0 nan"', "nan in body_pos"),
    "mass inf": ('mass="0.0027"', 'mass="inf"', "inf in body_mass"),
    "gravity nan": ('gravity="0 0 -9.81"', 'gravity="0 0 nan"', "nan in gravity"),
    "armature inf": ('armature="0.02"', 'armature="inf"', "inf in dof_armature"),
    "damping negative": ('armature="0.02"', 'damping="-1"', "-1 in dof_damping"),
    "dry friction negative": ('armature="0.02"', 'frictionloss="-1"', "-1 in dof_frictionloss"),
    "armature negative": ('armature="0.02"', 'armature="-0.1"', "-0.1 in dof_armature"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_models_that_cannot_be_simulated_are_refused(tmp_path, name):
    old, new, text = REFUSED[name]
    assert old in XML
    mjcf = tmp_path / "robot.xml"
    mjcf.write_text(XML.replace(old, new, 1))
    with pytest.raises(UserError, match=text) as error:
        load_model(mjcf, 0.001)
    assert "\n" not in str(error.value)
    assert str(mjcf) in str(error.value)


def test_a_ball_is_its_geom_in_a_pair_with_the_paddle(tmp_path):
    """Also of the balls that are added, whatever the names and the other pairs are."""
    shell = '<geom name="ball" type="sphere" size="0.019" mass="0.0027"'
    core = shell.replace('"ball"', '"core"').replace("0.0027", "1e-9")
    assert shell in XML
    text = XML.replace(shell, f"{core}/>{core.replace('core', 'a_core')}/>{shell}", 1)
    pair = '<pair geom1="blocker" geom2="ball" condim="1" solref="-98696 -31.4" '
    pair += 'solimp="0.95 0.99 0.001"/>'
    assert pair in text
    other = pair.replace('"blocker"', '"floor"').replace('"ball"', '"core"')
    text = text.replace(pair, other + pair, 1)
    (tmp_path / "robot.xml").write_text(text)
    model = load_model(tmp_path / "robot.xml", 0.001, num_balls=2)
    addresses = find_addresses(model)
    touching = [ball.geom for ball in addresses.balls]
    assert touching == [model.geom(name).id for name in ("ball", "ball2")]
    # The paddle with each ball, and the balls with each other.
    assert len(contact_pairs(model, addresses)) == 3


@pytest.mark.parametrize("memory", ["1K", "900T"])
def test_the_memory_that_a_file_asks_for_is_ignored(memory, tmp_path):
    """Too little of it ends a step, and too much the process."""
    path = tmp_path / "robot.xml"
    path.write_text(XML.replace("<worldbody>", f'<size memory="{memory}"/><worldbody>', 1))
    model = load_model(path, 0.001)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert data.time == 0.001


@pytest.mark.parametrize(
    ("solref", "longest"),
    [("-98696 -31.4", 0.0025), ("-1e6 -60", 0.0031416 / 4), ("0.02 0.1", 0.0062832 / 4)],
    # MuJoCo raises a time constant to two steps, so that a long step has a softer contact.
)
def test_a_step_that_is_long_for_the_contact_is_refused(solref, longest, tmp_path):
    """Half a period has four steps or more; with fewer, a ball can gain energy."""
    path = tmp_path / "robot.xml"
    path.write_text(XML.replace('solref="-98696 -31.4"', f'solref="{solref}"'))
    assert load_model(path, longest).opt.timestep == longest
    for too_long in (1.1 * longest, 0.02):
        with pytest.raises(UserError, match=rf"physics_dt {too_long:g} s .* to {longest:.3g}"):
            load_model(path, too_long)


def test_an_edited_model_is_an_error():
    """The error comes when a program that would ignore the edit is traced; colours may be
    edited."""
    env = BounceBall()
    key, action = jax.random.PRNGKey(0), jnp.zeros(6)
    state = jax.eval_shape(env.reset, key)
    env.mj_model.geom("ball").rgba[:] = 0.5
    env.mj_model.site_pos[:] += 1.0
    jax.eval_shape(env.reset, key)
    jax.eval_shape(env.step, state, action)
    env.mj_model.body("ball_link").mass[:] *= 2.0
    for program, args in ((env.reset, (key,)), (env.step, (state, action))):
        with pytest.raises(UserError, match="env.mj_model was edited"):
            jax.eval_shape(program, *args)
    env = BounceBall()
    env.mj_model.opt.gravity[2] = -1.0
    with pytest.raises(UserError, match="env.mj_model was edited"):
        jax.eval_shape(env.reset, key)


def targets(env: BounceBall, angle: float, action: float) -> np.ndarray:
    qpos = jnp.full(env.mj_model.nq, angle)
    physics = PhysicsState(qpos, jnp.zeros(env.mj_model.nv))
    state = EnvState(physics, {}, jnp.zeros(6))
    return np.asarray(env.control(state, jnp.full(6, action))[0].ctrl)


def test_with_a_gear_the_target_is_the_actuators_length(tmp_path):
    """A servo whose length is a multiple of the angle holds its joint like a servo without gear."""
    path, servos = tmp_path / "robot.xml", '<position kp="20000" kv="200"'
    path.write_text(XML.replace(servos, '<position gear="-2" kp="5000" kv="50"'))
    geared, plain = BounceBall(EnvConfig(mjcf=path)), BounceBall()
    np.testing.assert_allclose(targets(geared, 0.2, 0.5), -2.0 * targets(plain, 0.2, 0.5))
    after = []
    for env in (geared, plain):
        data = mujoco.MjData(env.mj_model)
        data.qpos[:6], data.ctrl[:] = 0.2, targets(env, 0.2, 0.5)
        mujoco.mj_step(env.mj_model, data, nstep=10)
        after.append(data.qpos[:6].copy())
    np.testing.assert_allclose(*after, atol=1e-7)
