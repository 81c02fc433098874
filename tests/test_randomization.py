"""Randomised worlds are drawn as their ranges say and act on C as on the fused engine."""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from against_c import XML, Coulomb, converged, differences, push_by_air
from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.config.validation import validate
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.c_episodes import episode_models
from bounce_mjx.learning.ppo import PPO
from bounce_mjx.physics import Control, PhysicsParameters, PhysicsState, edited_model, servo_targets
from bounce_mjx.physics.control import drag
from bounce_mjx.robot.actuators import largest_torques, torque_ranges
from bounce_mjx.robot.config import RobotConfig
from bounce_mjx.robot.contact import damping_of_restitution, restitution_of_damping
from bounce_mjx.robot.model import load_model
from bounce_mjx.task.registry import find_task
from bounce_mjx.world.actuation import add_delay, start_actuation
from bounce_mjx.world.model import model_nominals
from bounce_mjx.world.randomization import TERMS, RandomizationConfig
from bounce_mjx.world.sampling import nominal_values, physics_parameters, sample_world
from test_ppo import TwoStates, two_state_config

NOMINALS = model_nominals(EnvConfig())
HIGH = {name: min(term.bounds[1], 0.9) for name, term in TERMS.items()}
RANGES = {name: (max(TERMS[name].bounds[0], high - 0.1), high) for name, high in HIGH.items()}
RANGES |= {"camera_rate": (60.0, 240.0), "ball_start": (-0.2, -0.1)}


draw = functools.partial(sample_world, dtype=jnp.dtype("float32"), num_joints=6, nominals=NOMINALS)


def draws(config: RandomizationConfig, seed: int, **shares) -> dict[str, np.ndarray]:
    """2,000 worlds."""
    keys = jax.random.split(jax.random.PRNGKey(seed), 2000)
    of_key = functools.partial(draw, config.ranges(), **shares)
    return jax.device_get(jax.jit(jax.vmap(lambda key: of_key(key=key)))(keys))


def test_draws_are_uniform_in_their_ranges() -> None:
    config = RandomizationConfig(**RANGES)
    worlds = draws(config, 0)
    assert tuple(worlds) == tuple(sorted(TERMS)) and set(config.terms) == set(TERMS)
    shares = []
    for name, values in worlds.items():
        low, high = RANGES[name]
        assert values.shape == (2000, *TERMS[name].shape(6))
        shares += list((np.asarray(values, float).reshape(2000, -1).T - low) / (high - low))
    shares = np.array(shares)
    assert shares.min() > -1e-4 and shares.max() < 1 + 1e-4
    # Each entry of each term is drawn independently.
    p_values = [stats.kstest(entry, "uniform").pvalue for entry in shares]
    assert min(p_values) > 1e-3 / len(shares)
    correlation = np.corrcoef(shares) - np.eye(len(shares))
    assert np.abs(correlation).max() < 6 / np.sqrt(2000)


GAINS = tuple(0.7 + 0.05 * i for i in range(6)), tuple(0.72 + 0.05 * i for i in range(6))
OWN = {"paddle_tilt": ((-0.08, 0.01), (-0.07, 0.03)), "servo_gain": GAINS}


def test_each_entry_is_drawn_in_its_own_range() -> None:
    worlds = draws(RandomizationConfig(**OWN, armature=(0.9, 1.1)), 0)
    for name, (low, high) in OWN.items():
        shares = (np.asarray(worlds[name], float) - low) / np.subtract(high, low)
        assert shares.min() > -1e-4 and shares.max() < 1 + 1e-4
        assert min(stats.kstest(entry, "uniform").pvalue for entry in shares.T) > 1e-3 / 8
    # Ranges that are all the same are one range, drawn from the same numbers.
    same = RandomizationConfig(servo_gain=((0.8,) * 6, (1.2,) * 6)).ranges()
    one = RandomizationConfig(servo_gain=(0.8, 1.2)).ranges()
    np.testing.assert_array_equal(
        *(draw(r, key=jax.random.PRNGKey(0))["servo_gain"] for r in (same, one))
    )


def test_draws_do_not_depend_on_the_order_of_the_ranges() -> None:
    """JAX sorts the keys of a traced dictionary."""
    ranges = RandomizationConfig(restitution=(0.7, 0.9), air_drag=(0.0, 0.2)).ranges()
    of_key = functools.partial(draw, key=jax.random.PRNGKey(1))
    expected = of_key(ranges)
    for world in (jax.jit(of_key)(ranges), of_key(dict(reversed(ranges.items())))):
        assert world.keys() == expected.keys()
        for name, value in expected.items():
            np.testing.assert_allclose(world[name], value, rtol=1e-6)


def test_the_air_brakes_with_the_square_of_the_speed() -> None:
    np.testing.assert_allclose(drag(0.1, (3.0, 0.0, -4.0)), [-1.5, 0.0, 2.0], rtol=1e-6)


def test_ranges_grow_from_the_nominal_values() -> None:
    config = RandomizationConfig(
        restitution=(0.75, 0.95), action_latency=(0.0, 0.04), camera_rate=(60, 120)
    )

    def ends(progress: float) -> dict:
        ranges = config.ranges(progress, NOMINALS)
        return {name: [float(e) for e in r] for name, r in ranges.items()}

    assert ends(0.0)["restitution"] == pytest.approx([0.85, 0.85], abs=1e-3)
    assert ends(0.5)["restitution"] == pytest.approx([0.80, 0.90], abs=1e-3)
    assert ends(1.0)["restitution"] == pytest.approx([0.75, 0.95])
    assert ends(0.25)["action_latency"] == pytest.approx([0.0, 0.01])
    # A camera has no nominal rate from which to grow.
    assert ends(0.0)["camera_rate"] == ends(1.0)["camera_rate"] == [60.0, 120.0]


@pytest.mark.parametrize(
    "names, words",
    [
        (("air_drag",), "a reset lacks the range action_latency; there are: action_latency, air_"),
        (("air_drag", "action_latency", "drag"), "a range that there is not, drag; there are:"),
    ],
)
def test_a_reset_takes_ranges_of_all_terms_alone(names: tuple[str, ...], words: str) -> None:
    terms = {"action_latency": (0.0, 0.02), "air_drag": (0.0, 0.2)}
    env = BounceBall(EnvConfig(randomization=terms))
    ranges = {name: (jnp.zeros(()), jnp.zeros(())) for name in names}
    with pytest.raises(UserError, match=words):
        jax.eval_shape(lambda key: env.reset(key, ranges), jax.random.key(0))


def test_the_range_of_a_goal_grows_about_its_middle() -> None:
    grows = {"first_goal_range": 0.2, "warmup_steps": 1000}
    env = BounceBall(EnvConfig(target_height_range=(0.3, 0.8), randomization=grows))

    def ends(progress: float) -> list[float]:
        return [float(end) for end in env.ranges(progress)["target_height"]]

    assert ends(0.0) == pytest.approx([0.5, 0.6])
    assert ends(0.5) == pytest.approx([0.4, 0.7])
    assert ends(1.0) == pytest.approx([0.3, 0.8])
    heights = [
        env.reset(jax.random.key(i), env.ranges(0.0)).pipeline_state.goal["target_height"]
        for i in range(8)
    ]
    assert 0.5 <= min(heights) < max(heights) <= 0.6
    with pytest.raises(ValueError, match="first_goal_range is given without warmup_steps"):
        EnvConfig(randomization={"first_goal_range": 0.2})


@pytest.mark.slow
def test_a_training_draws_from_the_grown_ranges() -> None:
    """At each iteration, of a task whose whole state is the end of the range at its reset."""

    class Growing(TwoStates):
        warmup_steps = 320

        def ranges(self, progress: jax.Array) -> jax.Array:
            return progress

        def reset(self, rng: jax.Array, ranges: jax.Array | float = 1.0):
            return super().reset(rng).replace(pipeline_state=jnp.asarray(ranges, jnp.float32))

        def step(self, state, action):
            stepped = super().step(state, action)
            return stepped.replace(pipeline_state=state.pipeline_state)

    config = two_state_config(hidden_layers=(4,), num_minibatches=1, num_epochs=1)
    trainer = PPO(config, Growing(1.0), episode_steps=2)
    state, step = jax.jit(trainer.init)(jax.random.key(0)), jax.jit(lambda s: trainer.run(s, 1)[0])
    np.testing.assert_array_equal(state.env.env.pipeline_state, np.zeros(16))
    for iteration in range(12):  # of 32 steps each, in which all episodes are reset
        state = step(state)
        drawn_from = np.full(16, min(1.0, iteration / 10))
        np.testing.assert_allclose(state.env.env.pipeline_state, drawn_from, rtol=1e-6)


def test_a_share_of_the_terms_is_drawn() -> None:
    """Each on its own, some with a share of their own; a term without a nominal value is always
    drawn."""
    own = {"action_latency": 0.8, "air_drag": 0.0}
    worlds = draws(RandomizationConfig(**RANGES), 2, share=0.3, shares=own)
    drawn, expected = [], []
    for name, values in worlds.items():
        (low, high), nominal = RANGES[name], NOMINALS.get(name)
        entries = np.asarray(values, float).reshape(2000, -1)
        inside = (entries >= low - 1e-6) & (entries <= high + 1e-6)
        if nominal is None:
            assert np.all(inside)
            continue
        is_nominal = np.abs(entries - nominal) < 1e-7
        assert np.all(is_nominal | inside)
        assert np.all(is_nominal.all(axis=1) == is_nominal.any(axis=1)), name
        if name in own:
            assert abs(1.0 - is_nominal[:, 0].mean() - own[name]) <= 5 * np.sqrt(0.16 / 2000)
        if own.get(name) != 0.0:
            drawn.append(~is_nominal[:, 0])
            expected.append(own.get(name, 0.3))
    shares = np.mean(drawn, axis=1)
    assert np.abs(shares - expected).max() < 5 * np.sqrt(0.21 / 2000)
    correlation = np.corrcoef(drawn) - np.eye(len(drawn))
    assert np.abs(correlation).max() < 6 / np.sqrt(2000)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"push_interval": (1, 2)}, "push_interval is given without push_speed; give both"),
        ({"air_drag": (0.2, 0.1)}, "air_drag (0.2, 0.1) is not a range within 0 to 10"),
        ({"restitution": (0.3, 0.9)}, "restitution (0.3, 0.9) is not a range within 0.4 to 0.98"),
        ({"frame_drop": (0.0, 1.0)}, "within 0 to 0.99; give the lower end"),
        ({"drag": (0.0, 0.1)}, "drag; did you mean randomization.air_drag?"),
        ({"shares": {"drag": 0.1}}, "shares has a probability for drag, which is not a term"),
        ({"shares": {"ball_mass": 0.1}}, "for ball_mass, a term that is off; remove it"),
        (
            {"camera_rate": (60, 90), "shares": {"camera_rate": 0.1}},
            "for camera_rate, a term that is sampled in every episode; remove it",
        ),
        ({"warmup_steps": 1000}, "warmup_steps is given without a term whose range grows"),
        ({"camera_rate": (60, 90), "share": 0.5}, "share is given without a term that it is of"),
        ({"restitution": [[0.7], [0.8]]}, "is not a range; give two numbers"),
        ({"ball_mass": [[], []]}, "ball_mass ((), ()) is not a range; give two numbers"),
        ({"ball_mass": [1.0, []]}, "ball_mass (1.0, ()) is not a range; give two numbers"),
        ({"servo_gain": [[], []]}, "servo_gain ((), ()) is not a range; give two numbers, or two"),
        ({"joint_damping": (0, 501)}, "is not a range within 0 to 500 N m s/rad; give the lower"),
        ({"joint_frictionloss": (0, 501)}, "is not a range within 0 to 500 N m; give the lower"),
        ({"paddle_tilt": [[0.0] * 3, [0.1] * 3]}, "two lists with one for each of 2 axes"),
        ({"paddle_tilt": [[0.0, 0.2], [0.1, 0.1]]}, "paddle_tilt (0.2, 0.1) is not a range"),
        ({"servo_gain": [[0.9] * 6, [1.1] * 5]}, "two numbers, or two lists with one for each"),
        # A range of each joint, where the lower and the upper ends are due.
        ({"servo_gain": [[0.9, 1.1]] * 6}, "two numbers, or two lists with one for each joint"),
        ({"restitution": [0.7, 0.8, 0.9]}, "[0.7, 0.8, 0.9] is not a range; give two numbers"),
        (
            {"servo_gain": [[0.9] * 5, [1.1] * 5]},
            "servo_gain has 5 numbers, but default_joint_angles",
        ),
        ({"servo_gain": [[0.9] * 6, [math.inf] * 6]}, "servo_gain is inf, but must be a finite"),
    ],
)
def test_a_wrong_range_is_one_sentence(values: dict, words: str) -> None:
    with pytest.raises(UserError) as error:
        validate(EnvConfig, {"randomization": values}, "here")
    assert words in str(error.value) and "\n" not in str(error.value)


class Drops(NamedTuple):
    """Impacts on the held paddle without gravity, on MuJoCo's C engine."""

    restitution: float
    """Mean ratio of the speeds after and before."""
    duration: float
    """Mean time in which the ball is pressed, s."""


def drops(mj_model: mujoco.MjModel, terms: dict[str, float]) -> Drops:
    """Means over speeds and phases of the time step, with some terms of the randomisation."""
    drawn = {name: jnp.asarray(value) for name, value in terms.items()}
    parameters = physics_parameters(drawn, mj_model)
    model = edited_model(mj_model, jax.tree.map(np.asarray, parameters))
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[:6] = data.ctrl[:6] = EnvConfig().default_joint_angles
    mujoco.mj_forward(model, data)
    paddle, ball = data.geom("blocker"), model.geom("ball").size[0]
    home, normal = paddle.xpos.copy(), paddle.xmat.reshape(3, 3)[:, 2].copy()
    gap = model.geom("blocker").size[2] + ball
    restitutions, durations = [], []
    for speed in (1.0, 2.0, 3.0, 4.0):
        for phase in np.linspace(0.0, 1.0, 8, endpoint=False):
            mujoco.mj_resetData(model, data)
            data.qpos[:6] = data.ctrl[:6] = EnvConfig().default_joint_angles
            data.qpos[6:9] = home + (gap + 1e-3 * (1.0 + phase * speed)) * normal
            data.qvel[6:9] = -speed * normal
            pressed = 0
            for _ in range(60):
                mujoco.mj_step(model, data)
                pressed += bool(np.any(data.efc_force > 0.0))
            assert np.dot(data.qpos[6:9] - home, normal) > gap, "it has left the paddle"
            restitutions.append(np.dot(data.qvel[6:9], normal) / speed)
            durations.append(pressed * model.opt.timestep)
    return Drops(float(np.mean(restitutions)), float(np.mean(durations)))


@pytest.mark.parametrize("restitution", [None, 0.08, 0.2, 0.4, 0.6, 0.72, 0.9, 0.96])
def test_drops_bounce_as_asked(mj_model, restitution: float | None) -> None:
    """The model's own restitution is 0.85."""
    terms = {} if restitution is None else {"restitution": restitution}
    expected, error = (restitution, 0.015) if restitution else (0.85, 0.01)
    assert drops(mj_model, terms).restitution == pytest.approx(expected, abs=error)


@pytest.mark.parametrize("restitution", [None, 0.7, 0.93])
@pytest.mark.parametrize("duration", [0.004, 0.006, 0.01, 0.015])
def test_a_contact_lasts_as_asked(mj_model, duration: float, restitution: float | None) -> None:
    """With the restitution of the model, or a sampled one. The damping ends it a little before half
    a period of the spring."""
    terms = {"contact_duration": duration}
    terms |= {} if restitution is None else {"restitution": restitution}
    measured = drops(mj_model, terms)
    assert 0.9 * duration - 0.0005 < measured.duration < duration + 0.0005
    assert measured.restitution == pytest.approx(restitution or 0.85, abs=0.015)


def test_a_contact_shorter_than_four_steps_is_refused() -> None:
    with pytest.raises(UserError) as error:
        validate(EnvConfig, {"randomization": {"contact_duration": (0.003, 0.01)}}, "my.yaml")
    words = "contact_duration begins at 0.003 s, but a contact needs four physics steps, which are "
    assert words + "0.004 s with physics_dt 0.001" in str(error.value)
    assert "\n" not in str(error.value)
    fine = EnvConfig(physics_dt=0.0005, randomization={"contact_duration": (0.002, 0.01)})
    assert BounceBall(fine).config.randomization.contact_duration == (0.002, 0.01)


JOINTS = np.linspace(0.8, 1.3, 6)


@pytest.fixture
def drawn_model(float64):
    """Function (values of terms) -> the model of C, and the undrawn model: both with damping of the
    joints, a gravity along no axis, and a force limit of two servos."""
    model = mujoco.MjModel.from_xml_string(
        XML.replace("<joint armature", '<joint damping="3" armature')
    )
    model.opt.gravity[:] = [0.5, -1.0, -9.0]
    model.actuator_forcelimited[:2] = True
    model.actuator_forcerange[:2] = [(-6.0, 90.0), (-90.0, 90.0)]

    def draw(**world) -> tuple[mujoco.MjModel, mujoco.MjModel]:
        arrays = {name: jnp.asarray(value, float) for name, value in world.items()}
        return edited_model(model, physics_parameters(arrays, model)), model

    return draw


def test_terms_are_factors_sums_and_values_of_the_model(drawn_model) -> None:
    drawn, model = drawn_model(
        ball_mass=1.2, ball_radius=0.9, ball_inertia=0.6, contact_friction=0.4, servo_gain=JOINTS,
        servo_damping=JOINTS[::-1], torque_limit=10.0 * JOINTS, joint_damping=JOINTS,
        joint_frictionloss=5.0 * JOINTS, armature=2.0 * JOINTS, link_mass=JOINTS,
    )  # fmt: skip
    # A weak servo does not get stronger, in either direction.
    least = -np.minimum(10.0 * JOINTS, [6.0, 90.0, *[np.inf] * 4])
    greatest = np.minimum(10.0 * JOINTS, [90.0, 90.0, *[np.inf] * 4])
    ball, links = model.body("ball_link").id, [model.body(f"Link{i}").id for i in range(1, 7)]
    for new, old in (
        (drawn.body_mass[ball], 1.2 * model.body_mass[ball]),
        (drawn.geom("ball").size[0], 0.9 * model.geom("ball").size[0]),
        (drawn.body_inertia[ball], 0.6 / 0.4 * 1.2 * 0.9**2 * model.body_inertia[ball]),
        (drawn.pair_friction[0, :2], [0.4, 0.4]),
        (drawn.pair_dim, [3]),
        (drawn.actuator_gainprm[:, 0], JOINTS * model.actuator_gainprm[:, 0]),
        (drawn.actuator_biasprm[:, 1], JOINTS * model.actuator_biasprm[:, 1]),
        (drawn.actuator_biasprm[:, 2], JOINTS[::-1] * model.actuator_biasprm[:, 2]),
        (drawn.actuator_forcerange, np.stack([least, greatest], axis=1)),
        (drawn.dof_damping[:6].ravel(), 3.0 + JOINTS),
        (drawn.dof_frictionloss[:6], 5.0 * JOINTS),
        (drawn.dof_armature[:6], 2.0 * JOINTS * model.dof_armature[:6]),
        (drawn.body_mass[links], JOINTS * model.body_mass[links]),
    ):
        np.testing.assert_allclose(new, old, rtol=1e-12)


def test_the_nominal_of_a_term_is_the_models(float64) -> None:
    """Of each term that has one: in a model that differs in all that a term replaces, the edited
    model is the model itself."""
    model = mujoco.MjModel.from_xml_string(
        XML.replace("<joint armature", '<joint frictionloss="0.3" armature').replace(
            'condim="1"', 'condim="3" friction="0.3 0.3 0.005 0.0001 0.0001"'
        )
    )
    model.pair_solref[0, 1] *= 2.0
    nominals = nominal_values(model, TERMS)
    # The drop test's inverse: twice the damping is a lower restitution.
    assert nominals["restitution"] == pytest.approx(0.736, abs=0.005)
    np.testing.assert_allclose(nominals["contact_friction"], 0.3)
    np.testing.assert_allclose(nominals["contact_duration"], 0.01, rtol=1e-4)
    np.testing.assert_allclose(nominals["ball_inertia"], 0.4)
    np.testing.assert_allclose(nominals["joint_frictionloss"], [0.3] * 6)
    world = {name: jnp.asarray(value) for name, value in nominals.items()}
    same = edited_model(model, physics_parameters(world, model))
    for field in (
        "pair_solref pair_friction pair_dim dof_frictionloss dof_damping dof_armature body_mass "
        "body_inertia "
        "geom_size geom_pos geom_quat actuator_gainprm actuator_biasprm actuator_forcerange"
    ).split():
        np.testing.assert_allclose(getattr(same, field), getattr(model, field), rtol=1e-12)


def test_every_contact_has_its_damping_again_from_its_restitution(float64) -> None:
    """Also MuJoCo's default contact, whose damping ratio is 1, and beyond the drops."""
    stiffness = 2500.0
    for ratio in (0.0, 0.01, 0.2, 0.34, 0.7, 1.0, 1.5, 3.0, 20.0):
        damping = 2.0 * ratio * math.sqrt(stiffness)
        restitution = restitution_of_damping(damping, stiffness)
        again = damping_of_restitution(jnp.asarray(restitution), stiffness)
        assert float(again) == pytest.approx(damping, rel=1e-9), ratio


def test_episodes_without_a_term_have_the_models_value() -> None:
    """With a share, and at the start of a warm-up."""
    drawn = {"contact_friction": (0.4, 0.5), "share": 0.5, "warmup_steps": 1000}
    env = BounceBall(EnvConfig(friction=0.3, randomization=drawn))
    reset = jax.jit(jax.vmap(lambda key, progress: env.reset(key, env.ranges(progress))))
    for progress in (0.0, 1.0):
        states = reset(jax.random.split(jax.random.key(0), 64), jnp.full(64, progress))
        friction = np.asarray(states.pipeline_state.parameters.contact_friction)
        is_own = np.isclose(friction, 0.3)
        assert np.all(is_own | ((friction >= 0.4) & (friction <= 0.5)))
        assert 0.3 < is_own.mean() < 0.7 if progress else is_own.all()


@pytest.mark.parametrize("gear", [10.0, -10.0])
def test_torques_are_limited_at_the_joint(gear: float, float64, tmp_path) -> None:
    """By a randomised limit and by the robot's own, of servos with a gear and another limit in each
    direction."""
    spec = mujoco.MjSpec.from_string(XML)
    for actuator in spec.actuators:
        actuator.gear[0] = gear
        actuator.gainprm[0] /= gear**2
        actuator.biasprm[1:3] /= gear**2
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = [-5.0, 10.0]
    (tmp_path / "geared.xml").write_text(spec.to_xml())
    model = load_model(tmp_path / "geared.xml", 0.001)

    def torques(model: mujoco.MjModel) -> np.ndarray:
        return torque_ranges(model, range(6), range(6))

    own = (-50.0, 100.0) if gear > 0 else (-100.0, 50.0)
    np.testing.assert_allclose(torques(model).T, [own] * 6)
    for limit in (1000.0, 80.0, 5.0):
        expected = [(max(own[0], -limit), min(own[1], limit))] * 6
        limits = jnp.full(6, limit)
        drawn = edited_model(model, physics_parameters({"torque_limit": limits}, model))
        robot = RobotConfig(limits={"torque": (limit,) * 6})
        for limited in (drawn, load_model(tmp_path / "geared.xml", 0.001, robot=robot)):
            np.testing.assert_allclose(torques(limited).T, expected)
            both_ways = largest_torques(limited, range(6), range(6))
            np.testing.assert_allclose(both_ways, min(50.0, limit))


def test_paddle_and_gravity_are_moved_and_turned_as_described(drawn_model) -> None:
    """The offset is along the axes of the last link; the tilts are about x, then about the new y:
    of the paddle about its own axes, of gravity about the world's."""
    offset, tilt, gravity_tilt = [0.01, -0.02, 0.03], [0.2, -0.1], [0.3, 0.15]
    drawn, model = drawn_model(paddle_offset=offset, paddle_tilt=tilt, gravity_tilt=gravity_tilt)
    new, old = (mujoco.MjData(m) for m in (drawn, model))
    for m, data in ((drawn, new), (model, old)):
        data.qpos[:6] = [0.1, 0.7, 1.9, 0.3, -1.0, 0.2]
        mujoco.mj_kinematics(m, data)
    last_link, paddle = old.body("Link6").xmat.reshape(3, 3), old.geom("blocker")
    np.testing.assert_allclose(new.geom("blocker").xpos, paddle.xpos + last_link @ offset)
    turned = paddle.xmat.reshape(3, 3) @ Rotation.from_euler("XY", tilt).as_matrix()
    np.testing.assert_allclose(new.geom("blocker").xmat.reshape(3, 3), turned, atol=1e-12)
    gravity = Rotation.from_euler("XY", gravity_tilt).apply(model.opt.gravity)
    np.testing.assert_allclose(drawn.opt.gravity, gravity, rtol=1e-12)


def simulated_targets(asked: np.ndarray, delay: int, lag: float | None, n: int) -> np.ndarray:
    """Servo targets of each physics step by brute force: the targets [T] of control steps with n
    physics steps arrive `delay` physics steps late and pass a filter with the time constant `lag`,
    in physics steps."""
    inputs = np.concatenate([np.full(delay, asked[0]), np.repeat(asked[1:], n)])
    outputs, y = [], asked[0]
    for x in inputs[: n * (len(asked) - 1)]:
        y = x + (y - x) * np.exp(-1.0 / lag) if lag else x
        outputs.append(y)
    return np.array(outputs)


@pytest.mark.parametrize("lag", [None, 0.0, 7.3])
def test_late_and_lagging_targets_are_those_of_a_simulation(lag: float | None, float64) -> None:
    """Delays of any number of physics steps, up to three control steps."""
    n, dt = 10, 0.01
    lags = {} if lag is None else {"servo_lag": (0.0, 0.01)}
    config = RandomizationConfig(action_latency=(0.0, 0.031), **lags)
    asked = np.random.default_rng(0).uniform(-1, 1, 20)

    @jax.jit
    @jax.vmap
    def run(latency):
        world = {"action_latency": latency} | {x: jnp.asarray(lag * dt / n) for x in lags}

        def step(memory, target):
            control, memory = add_delay(world, memory, Control(target[None]), dt, n)
            return memory, servo_targets(control, n)[:, 0]

        memory = start_actuation(config, dt, Control(jnp.asarray(asked[:1])))
        return jax.lax.scan(step, memory, jnp.asarray(asked[1:]))[1].ravel()

    delays = np.arange(32)
    for delay, ours in zip(delays, run(jnp.asarray(delays * dt / n)), strict=True):
        np.testing.assert_allclose(ours, simulated_targets(asked, delay, lag, n), atol=1e-12)


class Run(NamedTuple):
    """Free run of the fused engine in many worlds: arrays [T + 1 or T, ..., N]."""

    env: BounceBall
    starts: object
    actions: np.ndarray
    physics: PhysicsState
    control: Control
    target_height: np.ndarray
    target_age: np.ndarray
    rewarded_height: np.ndarray
    """The target height that the reward used."""


WORLDS, CONTROL_STEPS = 64, 200


@functools.cache
def run(moves: bool) -> Run:
    """64 worlds with draws of all terms of the task; if bodies move, also of the physics and the
    actuation. The balls start low and the actions are small, so that the balls bounce and keep
    bouncing."""
    terms = {
        "push_speed": (0.02, 0.05), "push_interval": (0.3, 0.6), "goal_interval": (0.4, 0.7),
        "ball_start": (-0.02, 0.02), "joint_start": (-0.02, 0.02),
    }  # fmt: skip
    terms |= {} if not moves else {
        "restitution": (0.75, 0.95), "contact_duration": (0.006, 0.012),
        "contact_friction": (0.1, 0.4), "ball_inertia": (0.4, 0.667),
        "ball_mass": (0.7, 1.3), "ball_radius": (0.9, 1.1), "air_drag": (0.0, 0.3),
        "servo_gain": (0.8, 1.2), "servo_damping": (0.8, 1.2), "servo_lag": (0.0, 0.02),
        "joint_damping": (0.0, 5.0), "armature": (0.7, 1.3),
        "joint_frictionloss": (0.0, 10.0), "link_mass": (0.7, 1.3), "torque_limit": (20.0, 100.0),
        "paddle_offset": (-0.01, 0.01), "paddle_tilt": (-0.02, 0.02),
        "gravity_tilt": (-0.02, 0.02), "action_latency": (0.0, 0.035),
    }  # fmt: skip
    with jax.enable_x64(True):
        config = EnvConfig(
            randomization=terms,
            target_height_range=(0.3, 0.8),
            reset={"joint_angles": 0.0},
            ball_init_pos=(0.59, 0, 0.2),
        )
        env = BounceBall(config)
        task_step = env.task.step

        def telling_step(state, step):
            done = task_step(state, step)
            return done._replace(metrics=done.metrics | {"height": step.goal["target_height"]})

        env.task.step = telling_step
        keys = jax.random.split(jax.random.PRNGKey(3), WORLDS)
        actions = np.random.default_rng(1).uniform(-0.15, 0.15, (CONTROL_STEPS, 6, WORLDS))

        @jax.jit
        def steps(keys, actions):
            starts = jax.vmap(env.reset, out_axes=-1)(keys)

            def step(state, action):
                pipeline = state.pipeline_state
                control, actuation = env.control(pipeline, action)
                physics = pipeline.physics
                if moves:
                    physics = env.engine.step(pipeline.parameters, physics, control, 10)
                after = env.finish_step(state, action, actuation, physics)
                pipeline = after.pipeline_state
                target = pipeline.goal["target_height"]
                seen = (physics, control, target, pipeline.redraw.age, after.metrics["height"])
                return after, seen

            of_all = jax.vmap(step, in_axes=-1, out_axes=-1)
            return starts, jax.lax.scan(of_all, starts, actions)[1]

        starts, seen = jax.device_get(steps(keys, actions))
    return Run(env, starts, actions, *seen)


@pytest.fixture
def free_run() -> Run:
    return run(moves=True)


@pytest.fixture
def at_rest() -> Run:
    return run(moves=False)


def c_run(free_run: Run, w: int, shift: float = 0.0) -> tuple[PhysicsState, int]:
    """States [T, ...] of world w on MuJoCo's C engine, and the number of steps with a contact. This
    function simulates latency, lag, air and pushes itself. The ball starts higher by `shift`."""
    start = free_run.starts.pipeline_state
    world = {name: np.asarray(value)[..., w] for name, value in start.world.items()}
    of_world = jax.tree.map(lambda x: np.asarray(x)[..., w : w + 1], start.parameters)
    (model,) = episode_models(free_run.env, of_world)
    law = Coulomb(converged(model, 20))
    data = mujoco.MjData(law.model)
    data.qpos[:], data.qvel[:] = (x[..., w] for x in start.physics[:2])
    data.qpos[8] += shift
    low, high = model.jnt_range[:6].T
    delay, lag = round(float(world["action_latency"]) / 1e-3), float(world["servo_lag"]) / 1e-3
    asked, filtered = [data.qpos[:6].copy()], data.qpos[:6].copy()
    after, contacts = [], 0
    for t in range(CONTROL_STEPS):
        asked.append(np.clip(data.qpos[:6] + 0.02 * free_run.actions[t, :, w], low, high))
        data.qvel[6:9] += free_run.control.ball_push[t, :, w]
        for i in range(10):
            arrived = asked[max(0, (10 * t + i - delay) // 10 + 1)]
            filtered = arrived + (filtered - arrived) * np.exp(-1.0 / max(lag, 1e-3))
            data.ctrl[:] = filtered
            push_by_air(model, data, world["air_drag"])
            law.step(data)
            contacts += data.ncon
        after.append((data.qpos.copy(), data.qvel.copy()))
    return PhysicsState(*(np.array(x) for x in zip(*after, strict=True))), contacts


@pytest.mark.slow
def test_drawn_worlds_are_mujocos_over_2000_steps(free_run: Run, float64) -> None:
    """Each engine runs freely. Contacts amplify differences, in a few worlds by a factor of a
    million; in these worlds the engines are as close as two runs of C with balls that start a
    picometre apart."""
    errors, apart, contacts = np.zeros((3, WORLDS)), np.zeros((3, WORLDS)), 0
    for w in range(WORLDS):
        ours = PhysicsState(*(x[..., w] for x in free_run.physics[:2]))
        reference, touching = c_run(free_run, w)
        shifted, _ = c_run(free_run, w, shift=1e-12)
        contacts += touching
        for i, steps in enumerate((slice(0, 50), slice(0, 100), slice(0, 200))):
            until = [PhysicsState(*(x[steps] for x in s[:2])) for s in (reference, ours, shifted)]
            errors[i, w] = np.max(differences(until[1], until[0]))
            apart[i, w] = np.max(differences(until[2], until[0]))
    assert contacts > 20 * WORLDS and errors[0].max() < 1e-9
    assert np.all((errors < 1e-9) | (errors < apart))
    # The hardest contacts and the spin that friction gives magnify most.
    assert np.mean(errors[2] < 1e-9) > 0.7


def test_starts_are_displaced(at_rest: Run) -> None:
    start = at_rest.starts.pipeline_state
    config, qpos = at_rest.env.config, np.asarray(start.physics.qpos)
    displaced = qpos[:6] - np.array(config.default_joint_angles)[:, None]
    np.testing.assert_allclose(displaced, start.world["joint_start"], atol=1e-9)
    ball = qpos[6:9] - np.array(config.ball_init_pos)[:, None] - start.world["ball_start"]
    noise = config.reset.ball_position
    assert 0.9 * noise < np.abs(ball).max() <= noise


def test_pushes_have_their_size_and_interval(at_rest: Run) -> None:
    world, pushes = at_rest.starts.pipeline_state.world, at_rest.control.ball_push
    size = np.linalg.norm(pushes, axis=1)
    assert np.all(pushes[:, 2] == 0.0)
    angles, first = [], []
    for w in range(WORLDS):
        times = np.flatnonzero(size[:, w])
        np.testing.assert_allclose(size[times, w], world["push_speed"][w])
        interval = float(world["push_interval"][w]) / 0.01
        # They recur at exact intervals, rounded to control steps.
        grid = times[0] + interval * np.arange(len(times))
        assert np.abs(times - grid).max() <= 1.0 + 1e-6
        assert len(times) >= int(CONTROL_STEPS / interval) - 1
        angles += list(np.arctan2(pushes[times, 1, w], pushes[times, 0, w]))
        first.append(times[0] / interval)
    assert stats.kstest((np.array(angles) + np.pi) / (2 * np.pi), "uniform").pvalue > 1e-3
    # The reset is at a random time within an interval.
    assert stats.kstest(first, "uniform").pvalue > 1e-3


def test_targets_change_at_their_interval(at_rest: Run) -> None:
    world = at_rest.starts.pipeline_state.world
    start = at_rest.starts.pipeline_state.goal["target_height"]
    heights = np.concatenate([start[None], at_rest.target_height])
    assert 0.3 <= heights.min() < 0.35 and 0.75 < heights.max() <= 0.8
    for w in range(WORLDS):
        changed = np.flatnonzero(np.diff(heights[:, w]))
        interval = float(world["goal_interval"][w]) / 0.01
        grid = changed[0] + interval * np.arange(len(changed))
        assert np.abs(changed - grid).max() <= 1.0 + 1e-6
        assert len(changed) >= int(CONTROL_STEPS / interval) - 1
        since = np.arange(CONTROL_STEPS) - changed[:, None]
        age = np.where(since >= 0, since, np.arange(CONTROL_STEPS) + 1).min(axis=0)
        np.testing.assert_allclose(at_rest.target_age[:, w], 0.01 * age, atol=1e-9)
    # The policy sees a new target before a reward depends on it.
    np.testing.assert_array_equal(at_rest.rewarded_height, heights[:-1])


@pytest.mark.parametrize(
    ("terms", "given", "words"),
    [
        ({"ball_mass": (2.0, 2.0)}, {"ball_mass": 0.01}, "returns ball_mass, which is sampled"),
        # The damping of a restitution is that of the model's own stiffness.
        (
            {"restitution": (0.8, 0.9)},
            {"contact_stiffness": 1e5},
            "returns contact_stiffness, which is sampled by randomization.restitution",
        ),
        (
            {"joint_damping": (0.0, 1.0)},
            {"entries": {"dof_damping[2]": 1.0}},
            r"returns dof_damping\[2\], which is sampled by randomization.joint_damping",
        ),
        ({}, None, "randomize returns None; return a physics.PhysicsParameters"),
    ],
)
def test_what_a_term_samples_no_randomize_gives(terms: dict, given: dict, words: str) -> None:
    """The world, the metric and a critic would say one value, and the physics have the other."""
    parameters = None
    if given is not None:
        arrays = jax.tree.map(jnp.asarray, given)
        parameters = PhysicsParameters(**arrays)
    with pytest.raises(UserError, match=words):
        Env(EnvConfig(randomization=terms), randomize=lambda key: parameters)


def test_a_randomize_beside_other_terms_is_taken() -> None:
    config = EnvConfig(randomization={"ball_mass": (2.0, 2.0), "armature": (1.0, 2.0)})
    given = PhysicsParameters(entries={"dof_damping[2]": jnp.ones(())}, ball_radius=jnp.ones(()))
    assert Env(config, randomize=lambda key: given).config is config


DELAYED = {"action_latency": (0.0, 0.03), "ball_latency": (0.0, 0.02), "camera_rate": (60, 120)}


@pytest.fixture(scope="module")
def delayed() -> Env:
    terms = DELAYED | {"joint_start": (-0.1, 0.1), "ball_start": (-0.1, 0.1)}
    return Env(EnvConfig(randomization=terms))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"action_latency": (0.1, 0.1)}, "action_latency goes up to 0.1, but the queue of late ac"),
        ({"ball_latency": (0.0, 0.03)}, "ball_latency goes up to 0.03, but the queue of late pic"),
        ({"camera_rate": (30.0, 60.0)}, "camera_rate goes down to 30, but the queue of late pict"),
        ({"action_latency": (0.02, 0.01)}, r"action_latency \(0.02, 0.01\) is not a range within"),
        ({"action_latency": (-1.0, 0.01)}, r"action_latency \(-1.0, 0.01\) is not a range within"),
        ({"joint_start": (jnp.zeros(3), jnp.ones(3))}, r"\(3,\) and \(3,\); give two .* \(6,\)"),
        ({"joint_start": (-1.0, 1.0)}, "joint_start .* starts Joint3 from 0.8199 to 3.02 with the"),
        ({"ball_start": (-0.5, 0.0)}, "ball_start .* up to 0.72. m beside the paddle"),
        ({"ball_latency": 0.02}, "ball_latency has ends of the shapes a float; give two numbers"),
        ({"target_height": (0.6, 0.4)}, "target_height is from 0.6 to 0.4; exchange the two"),
        ({"target_height": (-1.0, 0.4)}, "target_height is -1.0, but must be a finite number >="),
    ],
)
def test_a_reset_refuses_ranges_on_which_it_cannot_act(
    changes: dict, words: str, delayed: Env
) -> None:
    """The world said 100 ms, and the action arrived after 30."""
    with pytest.raises(UserError, match=words):
        jax.eval_shape(
            lambda key: delayed.reset(key, delayed.ranges() | changes), jax.random.key(0)
        )


def test_traced_ranges_beyond_the_queues_are_cut_in_the_world_too(delayed: Env) -> None:
    """Also those that are set within an episode."""
    late = {"action_latency": 0.2, "ball_latency": 0.2, "camera_rate": 2.0}

    def worlds(key: jax.Array, late: dict) -> tuple[dict, dict]:
        ends = {name: (value, value) for name, value in late.items()}
        state = delayed.reset(key, delayed.ranges() | ends).pipeline_state
        return state.world, delayed.with_world(state, state.world | late).world

    for world in jax.jit(worlds)(jax.random.key(0), jax.tree.map(jnp.float32, late)):
        assert float(world["action_latency"]) == pytest.approx(0.03)
        assert float(world["ball_latency"]) == pytest.approx(0.02)
        assert float(world["camera_rate"]) == pytest.approx(60.0)


@pytest.mark.parametrize(
    ("task", "terms", "words"),
    [
        (
            "bounce",
            {"joint_start": (-1.0, 1.0)},
            "starts Joint3 from 0.8199 to 3.02 with the noise",
        ),
        ("bounce", {"ball_start": ((0, 0, -0.9), (0, 0, -0.8))}, "an episode ends where it"),
        ("bounce", {"ball_start": (0.0, 0.3)}, "up to 0.435 m beside the paddle, where none is"),
        ("balance", {"ball_start": (-0.03, 0.03)}, "rests on the paddle at 0.0723 m; give a high"),
        ("catch", {"ball_start": ((0, 0, -0.2), (0, 0, 0))}, "rests on the floor at 0.019 m"),
    ],
)
def test_a_start_that_no_arm_or_ball_can_have_is_refused(
    task: str, terms: dict, words: str
) -> None:
    with pytest.raises(UserError, match=words):
        Env(find_task(task).Config(randomization=terms))


def test_a_noise_that_no_ball_can_have_is_refused() -> None:
    with pytest.raises(UserError, match="env.reset.ball_position 0.5 starts a ball up to 0.71. m"):
        Env(EnvConfig(reset={"ball_position": 0.5}))
    with pytest.raises(UserError, match="min_ball_height is .* with env.reset.ball_position 0.1"):
        Env(EnvConfig(reset={"ball_position": 0.1}, ball_init_pos=(0.59, 0.0, 0.12)))


def test_displaced_throws_are_taken() -> None:
    for task in ("catch", "juggle"):
        Env(find_task(task).Config(randomization={"ball_start": (-0.03, 0.03)}))
