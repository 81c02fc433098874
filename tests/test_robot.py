"""An unsuitable arm is refused in one sentence; another one becomes the scene, with its motion."""

import copy
import re
from pathlib import Path
from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import pytest
import yaml

from against_c import (
    States,
    assert_same_step,
    c_models,
    c_steps,
    fused_steps,
    num_contacts,
    paddle_frame,
)
from arms import ARM, ARM_JOINTS, arm, hinge, link, mjcf, motors, ur5e
from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.commands import adopt as adopt_command
from bounce_mjx.config.user_code import import_code
from bounce_mjx.deploy.export import policy_metadata
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.contacts import ContactChecker
from bounce_mjx.physics import make_engine
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.actuators import ServoSettings, servo_settings
from bounce_mjx.robot.adopt import adopt, check_as_alone
from bounce_mjx.robot.arm import build_arm, compile_spec, locate, naming, read_spec
from bounce_mjx.robot.config import PaddleConfig, RobotConfig
from bounce_mjx.robot.model import data_at, find_addresses, joint_names, load_model
from bounce_mjx.robot.pose import clearance, mounts, place_paddle
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.layers import read_preset
from random_worlds import random_parameters

FINGERS = "".join(
    f'<body pos="0 {y} 0.05"><joint name="{n}" type="slide" axis="0 1 0" range="0 0.04"/>'
    f'<geom size=".01" mass=".05"/></body>'
    for n, y in (("left", 0.02), ("right", -0.02))
)

SLIDE = '<joint name="{}" type="slide" axis="{}" range="0 0.3"/>'


TWO_JOINTS = mjcf(
    link(hinge("a", "0 0 1"), "0 0 .1", link(hinge("b", "0 1 0"), "0 0 .3", '<site name="tool"/>')),
    motors("a b"),
)


# A gripper's fingers move together; in the file this comes before what is wrong.
HAND = f'<body pos="0 0 0.05"><geom size=".02" mass=".1"/>{FINGERS}</body>'
MIMIC = '<joint joint1="left" joint2="right"/>'
GRIP = '<fixed name="grip"><joint joint="left" coef="1"/><joint joint="right" coef="1"/></fixed>'
BELT = '<fixed name="{}"><joint joint="j2" coef="1"/><joint joint="j3" coef="-1"/></fixed>'

# A rod beside the arm, and what holds its forearm to it.
ROD = '<body name="rod" pos="0.5 0 0.2">{}<geom size=".02" mass=".1"/></body>'
FOREARM = arm().replace(
    'pos="0 0 0.3"><joint name="j4"', 'name="forearm" pos="0 0 0.3"><joint name="j4"'
)
HOLD = '<equality><connect body1="rod" body2="forearm" anchor="0 0 0"/></equality>'

BROKEN = {
    "two joints": (TWO_JOINTS, "tool", "too few joints", "2 (a, b)"),
    "two arms": (
        mjcf(arm() + arm("r_", base="0 1 .2"), motors(f"{ARM_JOINTS} r_j1 r_j2")),
        "tool",
        "2 driven joints (r_j1, r_j2) in addition to the arm",
    ),
    "no actuators": (mjcf(arm(), ""), "tool", "no actuator on j1, j2", "<position>"),
    "idle joint": (mjcf(arm(), motors("j1 j2 j3 j5 j6")), "tool", "on j4", "--joints"),
    "weak motors": (mjcf(arm(), motors(ARM_JOINTS, 2.0)), "tool", "no servo strong enough"),
    "servos beyond the joints": (
        mjcf(
            arm(),
            "".join(
                f'<position joint="{name}" kp="500" ctrlrange="90 180"/>'
                for name in ARM_JOINTS.split()
            ),
        ),
        "tool",
        "the range -3 to 3 of j1",
        "reaches 90 to 180",
        "ctrlrange",
    ),
    "a muscle": (
        mjcf(arm(), '<muscle joint="j1" lengthrange="0 1"/>' + motors("j2 j3 j4 j5 j6")),
        "tool",
        "a muscle on j1",
        "both ways",
    ),
    "a damper": (
        mjcf(arm(), '<damper joint="j1" kv="3" ctrlrange="0 1"/>' + motors("j2 j3 j4 j5 j6")),
        "tool",
        "a damper on j1",
        "both ways",
    ),
    "a gain that is not fixed": (
        mjcf(
            arm(),
            '<general joint="j1" gaintype="affine" gainprm="5 1"/>' + motors("j2 j3 j4 j5 j6"),
        ),
        "tool",
        "an actuator on j1 whose strength follows from more than its control",
        "forcerange",
    ),
    "missing mesh": (
        mjcf(
            arm(tip='<geom type="mesh" mesh="m"/>'),
            motors(ARM_JOINTS),
            assets='<asset><mesh name="m" file="gone.stl"/></asset>',
        ),
        "tool",
        "does not compile",
        "gone.stl",
    ),
    "no such site": (ARM, "flange", "no site or body named flange", "tool"),
    "ball joint": (
        ARM.replace('<joint name="j4" axis="0 0 1" range="-3 3" ', '<joint name="j4" type="ball" '),
        "tool",
        "ball joint j4",
    ),
    "a joint without a name, and one with its stand-in": (
        mjcf(arm().replace('name="j3" ', "").replace('"j2"', '"joint2"'), motors("joint2")),
        "tool",
        "an unnamed joint that would be called joint2, as another one is",
    ),
    "loop": (
        mjcf(arm(), motors(ARM_JOINTS), '<equality><joint joint1="j2" joint2="j3"/></equality>'),
        "tool",
        "unnamed equality constraint (joint: j2, j3) on the arm",
        "serial",
    ),
    "joints coupled by an unnamed tendon": (
        mjcf(
            arm(),
            motors(ARM_JOINTS),
            '<tendon><fixed><joint joint="j2" coef="1"/><joint joint="j3" coef="-1"/></fixed>'
            "</tendon>",
        ),
        "tool",
        "the unnamed tendon (j2, j3) on the arm",
    ),
    "a rod from the world to the arm": (
        mjcf(ROD.format('<joint axis="0 1 0"/>') + FOREARM, motors(ARM_JOINTS), HOLD),
        "tool",
        "unnamed equality constraint (connect: rod, forearm) on the arm",
    ),
    "loop after a gripper's constraint": (
        mjcf(
            arm(tip=HAND),
            motors(ARM_JOINTS),
            f'<equality>{MIMIC}<joint name="loop" joint1="j2" joint2="j3"/></equality>',
        ),
        "tool",
        "the equality constraint loop on the arm",
    ),
    "tendon after a gripper's": (
        mjcf(
            arm(tip=HAND),
            motors(ARM_JOINTS),
            f"<tendon>{GRIP}{BELT.format('belt')}</tendon>",
        ),
        "tool",
        "the tendon belt on the arm",
    ),
    "motors of a ship": (
        mjcf(arm(), motors(ARM_JOINTS, 1e6)),
        "tool",
        "servo_force_limit is 1000000.0, but must be less than or equal to 100000",
        "units",
    ),
    "servos that reach no pose": (
        mjcf(
            arm(),
            "".join(
                f'<position joint="{name}" kp="500" kv="20" ctrlrange="2.9 3.5"/>'
                for name in ARM_JOINTS.split()
            ),
        ),
        "tool",
        "no reachable pose",
        "widen the ctrlrange of the servos, which narrows j1 from -3 to 3 to 2.9 to 3, j2",
    ),
    "joints coupled by a tendon": (
        mjcf(
            arm(),
            motors(ARM_JOINTS),
            '<tendon><fixed name="belt" stiffness="900"><joint joint="j2" coef="1"/>'
            '<joint joint="j3" coef="-1"/></fixed></tendon>',
        ),
        "tool",
        "the tendon belt on the arm",
        "serial",
    ),
    "a site that is never level": (
        mjcf(
            arm(limits="-0.1 0.1", tip='<site name="tilted" euler="0.8 0 0"/>'), motors(ARM_JOINTS)
        ),
        "tilted",
        "no reachable pose",
        "j1, j2",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_an_unsuitable_model_is_refused(name, refused) -> None:
    text, site, *words = BROKEN[name]
    assert text != ARM or name == "no such site"
    Path("robot.xml").write_text(text)
    refused(f"adopt robot.xml --site {site}", "robot.xml", *words)


def test_a_file_of_a_package_is_found_by_name() -> None:
    import bounce_mjx

    folder = Path(bounce_mjx.__file__).parent
    assert locate(Path("package:bounce_mjx/errors.py")) == folder / "errors.py"
    with pytest.raises(UserError, match="no_such_arm.* is not installed"):
        locate(Path("package:no_such_arm/arm.xml"))
    with pytest.raises(UserError, match="gone.xml does not exist"):
        locate(Path("package:bounce_mjx/gone.xml"))
    with pytest.raises(UserError, match=f"{folder} is not a file; give the path"):
        locate(folder)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict[str, Path]:
    """Configs of a small arm with motors and a gripper, and of the UR5e."""
    folder = tmp_path_factory.mktemp("adopted")
    small = folder / "small.xml"
    table = '<geom type="plane" size="1 1 1"/><body><freejoint/><geom size=".1"/></body>'
    # A shape of the world that touches.
    table += '<geom type="box" size=".4 .4 .02" pos="0 0 -.02"/>'
    table += '<site name="here"/><site name="there" pos="1 0 0"/>'
    more = '<keyframe><key qpos="1 0 0 1 0 0 0 0 0 0 0 0 0 0 0"/></keyframe>'
    more += f"<equality>{MIMIC}</equality><tendon>{GRIP}"
    more += '<spatial><site site="here"/><site site="there"/></spatial></tendon>'
    # A suction cup, at a site with the name of a joint.
    drives = motors(f"{ARM_JOINTS} left") + '<general site="j2" gear="0 0 1 0 0 0"/>'
    small.write_text(
        mjcf(table + arm(tip=f'{HAND}<site name="j2"/>'), drives, more)
        .replace("<worldbody>", '<option timestep="0.005" gravity="0 0 -1.6"/><worldbody>')
        .replace('<motor joint="j2"', '<motor jointinparent="j2"')
    )
    configs = {}
    for name, path, site in (("small", small, "tool"), ("ur5e", ur5e(), "attachment_site")):
        configs[name] = folder / f"{name}.yaml"
        adopt_command.main([str(path), "--site", site, "--out", str(configs[name])])
    return configs


@pytest.fixture(params=["small", "ur5e"])
def env(request, written) -> BounceBall:
    return BounceBall(read_preset(written[request.param]).env)


def test_the_start_pose_holds_the_paddle_level_at_the_target_point(env) -> None:
    config, data = env.config, mujoco.MjData(env.mj_model)
    data.qpos[list(env.addresses.arm_qpos)] = config.default_joint_angles
    mujoco.mj_forward(env.mj_model, data)
    paddle = data.geom("blocker")
    np.testing.assert_allclose(paddle.xmat.reshape(3, 3)[:, 2], [0.0, 0.0, 1.0], atol=1e-4)
    reward = config.reward
    point = reward.target_x, reward.target_y, reward.paddle_home_height
    np.testing.assert_allclose(paddle.xpos, point, atol=1e-3)
    assert config.ball_init_pos[:2] == point[:2] and paddle.xpos[0] > 0.15
    # The paddle, which belongs to the last link, touches no other; the small arm's shapes overlap.
    if config.mjcf == ur5e():
        last = int(env.mj_model.body_weldid[env.mj_model.geom("blocker").bodyid[0]])
        checker = ContactChecker(config, margin=0.0)
        touching = checker.touching(np.array(config.default_joint_angles))
        assert not any(last in pair for pair in touching)
    # The task keeps its heights above the paddle.
    assert np.isclose(config.ball_init_pos[2] - paddle.xpos[2], 0.4, atol=1e-3)
    assert np.allclose(
        np.array(config.target_height_range) - paddle.xpos[2], [0.35, 0.55], atol=1e-3
    )
    # A motor became a servo with critical damping at 1 / control_dt: kp / kv = 1 / (2 control_dt),
    # where kv contains the joint's own damping.
    servos, model = list(env.addresses.actuators), env.mj_model
    if env.config.robot.servo_force_limit:
        np.testing.assert_allclose(model.actuator_forcerange[servos, 1], 100.0)
        damping = model.dof_damping[list(env.addresses.arm_qvel)]
        damping = damping - model.actuator_biasprm[servos, 2]
        np.testing.assert_allclose(model.actuator_gainprm[servos, 0] / damping, 50.0, rtol=1e-3)
    low, high = env.mj_model.jnt_range[list(env.addresses.arm_joints)].T
    assert np.all(low < config.default_joint_angles) and np.all(config.default_joint_angles < high)


def test_only_the_arm_is_left(env) -> None:
    """The arm's own links, the ball; and all the mass of the arm with the paddle's."""
    model = env.mj_model
    assert (env.observation_size, env.action_size) == (29, 6)
    assert env.backend == "fused" and len(joint_names(model)) == 6
    assert (model.njnt, model.nkey, model.neq, model.ntendon) == (7, 0, 0, 0)
    assert model.nu == 6
    assert not np.any(model.geom_contype) and not np.any(model.jnt_limited)
    assert model.opt.gravity[2] == -9.81 and model.npair == 1


def test_one_step_in_random_worlds_is_mujocos(float64, env) -> None:
    model, at = env.mj_model, env.addresses
    count, rng = 32, np.random.default_rng(1)
    qpos = np.tile(model.qpos0, (count, 1))
    angles = env.config.default_joint_angles + rng.uniform(-0.5, 0.5, (count, 6))
    qpos[:, at.arm_qpos] = angles
    qvel = rng.uniform(-2.0, 2.0, (count, model.nv))
    for row in qpos:
        centre, axes = paddle_frame(model, row[at.arm_qpos,])
        local = rng.uniform(-1.0, 1.0, 3) * (0.04, 0.05, 0.012)
        row[at.balls[0].qpos[:3],] = centre + axes @ local
    ctrl = np.zeros((count, model.nu))
    ctrl[:, at.actuators] = angles + rng.uniform(-0.1, 0.1, (count, 6))
    states, parameters = States(qpos, qvel, ctrl), random_parameters(model, count, seed=2)
    expected, forces = c_steps(c_models(model, parameters, count), states)
    assert num_contacts(forces) >= count // 2
    assert_same_step(fused_steps(model, parameters, states), expected)


@pytest.mark.parametrize("dt", [0.001, 0.002])
def test_servos_step_without_overshoot_and_hold_the_arm(env, dt) -> None:
    """A step of every target overshoots little, and ends at rest, at physics steps up to 2 ms; the
    UR5e's own servos sag a little under gravity."""
    config, model = env.config, env.mj_model
    model.opt.timestep = dt
    addresses = find_addresses(model)
    data, arm_qpos = mujoco.MjData(model), list(addresses.arm_qpos)
    start = np.array(config.default_joint_angles)
    data.qpos[arm_qpos] = start
    data.ctrl[list(addresses.actuators)] = start + 0.02
    travelled = []
    for _ in range(round(1.0 / dt)):
        mujoco.mj_step(model, data)
        travelled.append(data.qpos[arm_qpos] - start)
    model.opt.timestep = config.physics_dt
    end = travelled[-1]
    assert np.all(np.abs(data.qvel[list(addresses.arm_qvel)]) < 0.02)
    assert np.all(np.max(travelled, axis=0) < np.maximum(end, 0.02) + 0.006)
    assert np.all(np.abs(end - 0.02) < 0.025) and np.median(end) > 0.018


def styled(compiler: str = "", servo: str = 'kv="20"', names: str = "abcde") -> str:
    """An arm in degrees with classes; each link has a shape that touches and one for pictures, and
    the last joint has a range, but no limit."""
    body = '<site name="tool" pos="0 0 0.1"/>'
    axes = "0 0 1", "0 1 0", "0 1 0", "0 1 0", "1 0 0"
    for name, axis in reversed([*zip(names, axes, strict=True)]):
        own = 'range="-90 120" ref="10" springref="20" stiffness="3"' if name == "b" else ""
        own = 'limited="false"' if name == "e" else own
        body = (
            f'<body pos="0 0 {0.2 if name == "a" else 0.3}" euler="0 0 {5 if name == "d" else 0}">'
            f'<joint name="{name}" axis="{axis}" {own}/><geom class="touching"/>'
            f'<geom class="pictured"/>{body}</body>'
        )
    servos = "".join(f'<position name="{name}" joint="{name}"/>' for name in names)
    return (
        f'<mujoco><compiler {compiler}/><default><joint limited="true" range="-170 170" '
        'damping="0.1" armature="0.01"/><default class="touching"><geom type="capsule" '
        'fromto="0 0 0 0 0 0.3" size="0.03" group="1"/></default><default class="pictured"><geom '
        'type="box" size="0.03 0.04 0.05" pos="0.01 0 0.1" contype="0" conaffinity="0" group="2"/>'
        f'</default><position kp="300" {servo} forcelimited="true" forcerange="-90 90"/></default>'
        f'<worldbody><body childclass="main">{body}</body></worldbody><actuator>{servos}'
        "</actuator></mujoco>"
    ).replace(' childclass="main"', "")


STYLES = {
    "degrees": styled(),
    "radians": styled('angle="radian"').replace("-170 170", "-3 3").replace("-90 120", "-1.6 2"),
    "autolimits false": styled('autolimits="false"'),
    "total mass": styled('settotalmass="7" boundmass="0.1" boundinertia="0.01"'),
    "shapes that touch": styled('inertiagrouprange="1 1"'),
    "inertia from geoms": styled('inertiafromgeom="true"'),
    "welded bodies fused": styled('fusestatic="true"'),
    "damping ratio": styled(servo='dampratio="1"'),
    "rotor": styled(servo='kv="20" armature="0.2" damping="0.3"'),
    "inherited range": styled(servo='kv="20" inheritrange="1"').replace('limited="false"', ""),
    "turned stand in a frame": styled()
    .replace("<worldbody><body>", '<worldbody><frame euler="0 30 0"><body axisangle="1 0 0 40">')
    .replace("</worldbody>", "</frame></worldbody>"),
    "turned flange": styled()
    .replace('<site name="tool"', '<body euler="0 40 20"><geom class="touching"/><site name="tool"')
    .replace('pos="0 0 0.1"/>', 'pos="0 0 0.1"/></body>', 1),
    "spring and damper": styled().replace('stiffness="3"', 'springdamper="0.5 1"'),
}


@pytest.mark.parametrize("style", STYLES)
def test_an_adopted_arm_moves_as_its_file(style, tmp_path) -> None:
    """Limits, inertia, springs, servos and the site are those of the file compiled as it is, to the
    limit of a paddle without mass; also without the geoms that only pictures need."""
    path, names = tmp_path / "arm.xml", "abcde"
    path.write_text(STYLES[style])
    config = RobotConfig.model_validate({"site": "tool", "paddle": {"mass": 1e-12}})
    found = build_arm(path, config)
    found.spec.compiler.discardvisual = True
    model, plain = compile_spec(found.spec, path), compile_spec(read_spec(path), path)
    limits, expected = (np.array([m.joint(n).range for n in names]) for m in (model, plain))
    limited = plain.jnt_limited.astype(bool)
    np.testing.assert_allclose(limits[limited], expected[limited])
    assert not np.any(limits[~limited]) and not np.any(model.jnt_limited)

    rng = np.random.default_rng(0)
    place = mujoco.MjData(plain)
    mujoco.mj_kinematics(plain, place)
    blade = mujoco.MjData(model)
    mujoco.mj_kinematics(model, blade)
    tool = place.site("tool").xpos + place.site("tool").xmat.reshape(3, 3) @ config.paddle.position
    np.testing.assert_allclose(blade.geom("blocker").xpos, tool, atol=1e-9)
    states = rng.uniform(-0.8, 0.8, (3, 5)), rng.uniform(-1.0, 1.0, (3, 5))
    for qpos, qvel in zip(*states, strict=True):
        accelerations = []
        for m in (model, plain):
            data = mujoco.MjData(m)
            for i, name in enumerate(names):
                data.joint(name).qpos[0], data.joint(name).qvel[0] = qpos[i], qvel[i]
                data.actuator(name).ctrl[0] = qpos[i] + 0.01
            m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
            mujoco.mj_forward(m, data)
            accelerations.append([data.joint(name).qacc[0] for name in names])
        np.testing.assert_allclose(*accelerations, rtol=1e-7)


@pytest.mark.parametrize(
    "rod", [ROD.format("<freejoint/>"), ROD.format("").replace("pos", 'mocap="true" pos')]
)
def test_what_held_the_arm_to_a_loose_object_is_named(rod, tmp_path) -> None:
    """It goes with the object, and the arm moves otherwise."""
    (tmp_path / "arm.xml").write_text(mjcf(rod + FOREARM, motors(ARM_JOINTS), HOLD))
    changes = build_arm(tmp_path / "arm.xml", RobotConfig(site="tool")).changes
    held = "couples the arm with these: unnamed equality constraint (connect: rod, forearm)"
    assert any(held in change for change in changes)


def test_what_holds_the_arm_by_its_gripper_is_named(tmp_path) -> None:
    hand = HAND.replace("<body ", '<body name="hand" ', 1)
    equalities = f'<equality>{MIMIC}<weld name="bench" body1="hand"/></equality>'
    (tmp_path / "arm.xml").write_text(mjcf(arm(tip=hand), motors(ARM_JOINTS), equalities))
    changes = build_arm(tmp_path / "arm.xml", RobotConfig(site="tool")).changes
    assert any(
        change.endswith("couples the arm with these: equality constraint bench")
        for change in changes
    )


def test_each_shape_that_touches_counts_whatever_its_group(tmp_path) -> None:
    """A link has a picture where some of its shapes touch and others do not. A file that hides a
    shape itself (group 3) makes no pictures of the others."""
    clearances = []
    for group in (0, 3):
        hidden = f'<geom size=".01" group="{group}" pos="0 0 .1"/>'
        wall = f'<geom type="box" size=".5 .5 .1" pos="0 0 1.8"/>{hidden}'
        (tmp_path / "arm.xml").write_text(mjcf(wall + arm(tip=hidden), motors(ARM_JOINTS)))
        config = RobotConfig.model_validate({"site": "tool", "paddle": {"position": (0, 0, 0.6)}})
        model = compile_spec(build_arm(tmp_path / "arm.xml", config).spec, tmp_path)
        pose = SimpleNamespace(angles=[0.0] * 6, mount=config.paddle)
        clearances.append(clearance(model, find_addresses(model), pose))
    assert clearances[0] == clearances[1] < 0.2


MOTORS = {
    "motor": ('gear="10"', True),
    "bias of 0": ('gear="10" biastype="affine"', True),
    "delayed": ('gear="10" dyntype="filter" dynprm="0.01"', True),
    "integrator": ('gear="10" dyntype="integrator"', False),
    "integrator of a range": ('gear="10" dyntype="integrator" actrange="-2 4"', True),
}


@pytest.mark.parametrize("motor", MOTORS)
def test_the_force_limit_of_a_motor_is_what_it_exerts(motor) -> None:
    """In both directions; an integrator adds up its control, so the control's range is no limit."""
    attributes, has_limit = MOTORS[motor]
    general = f'<general joint="j1" gainprm="5" ctrlrange="-2 4" {attributes}/>'
    hub = f'<body>{hinge("j1", "0 0 1")}<geom size="1" mass="1e6"/></body>'
    model = mujoco.MjModel.from_xml_string(mjcf(hub, general))
    exerted = []
    for control in (-2.0, 4.0):
        data = mujoco.MjData(model)
        data.ctrl[0] = control
        mujoco.mj_step(model, data, 2000)
        exerted.append(abs(data.qfrc_actuator[0]))
    limit = servo_settings(model, 0, 0).force_limit
    if has_limit:
        np.testing.assert_allclose(limit, min(exerted), rtol=1e-6)
    else:
        assert limit is None
        assert min(exerted) > 3.0 * 5.0 * 10.0


def test_names_of_the_scene_may_be_those_of_the_arm(tmp_path) -> None:
    """Of bodies, joints and geoms; also of the further balls, and of an unnamed holder."""
    text = styled().replace("<body ", '<body name="ball_link2" ', 1)
    text = text.replace('name="b"', 'name="ball_link"').replace('joint="b"', 'joint="ball_link"')
    for name in ("blocker", "ball", "scene/floor", "paddle"):
        text = text.replace(
            '<geom class="touching"/>', f'<geom name="{name}" class="pictured"/>', 1
        )
    for name in ("ball_link", "paddle", "end_effector"):
        text = text.replace("<body pos", f'<body name="{name}" pos', 1)
    (tmp_path / "arm.xml").write_text(text)
    config = RobotConfig(site="tool")
    model = load_model(tmp_path / "arm.xml", 0.001, robot=config, num_balls=3)
    at = find_addresses(model)
    # The ball and the paddle are the scene's, and each joint keeps its servo.
    assert [ball.body for ball in at.balls] == [
        model.body(name).id for name in ("ball_link", "ball_link2", "ball_link3")
    ]
    assert model.geom_type[at.paddle_geom] == mujoco.mjtGeom.mjGEOM_BOX
    assert joint_names(model) == ("a", "ball_link_of_arm", "c", "d", "e")
    changes = build_arm(tmp_path / "arm.xml", config).changes
    assert any("paddle to paddle_of_arm" in change for change in changes)


def test_an_arm_in_degrees_has_the_start_pose_of_the_same_arm_in_radians(tmp_path) -> None:
    """Though the last joint turns a flat paddle in its plane, where every angle scores alike; and
    far above the floor at any height of the base."""
    flat = {"position": (0.0, 0.0, 0.03), "quaternion": (1.0, 0.0, 0.0, 0.0)}
    config = RobotConfig.model_validate({"site": "tool", "paddle": flat})
    radians = mjcf(arm(limits="-2.9 2.9", base="0 0 1"), motors(ARM_JOINTS))
    degrees = mjcf(arm(limits="-166.1578 166.1578", base="0 0 2"), motors(ARM_JOINTS))
    poses = []
    for text in (radians, degrees.replace("radian", "degree")):
        (tmp_path / "arm.xml").write_text(text)
        poses.append(adopt(tmp_path / "arm.xml", config, 0.01, is_mount_given=True).pose)
    np.testing.assert_allclose(poses[0].angles, poses[1].angles, atol=1e-3)
    # In front of the arm, in its plane.
    np.testing.assert_allclose(poses[0].paddle[1], 0.0, atol=1e-6)


def test_adopt_prints_each_servo_and_each_change_of_the_world(tmp_path, capsys) -> None:
    option = '<option gravity="0 0 -1.6" density="1.2" wind="1 0 0" actuatorgroupdisable="3">'
    option += '<flag damper="disable" contact="disable"/></option>'
    flat = "--paddle.position 0 0 0.03 --paddle.quaternion 1 0 0 0"
    text = mjcf(arm(), motors(ARM_JOINTS)).replace("<worldbody>", f"{option}<worldbody>")
    # What does not move with the arm may be constrained, and a path have a line break.
    post = '<body name="post"><geom size=".1"/></body></worldbody>'
    joined = '<equality><connect body1="world" body2="post" anchor="0 0 0"/></equality></mujoco>'
    text = text.replace("</worldbody>", post).replace("</mujoco>", joined)
    (tmp_path / "my\narm.xml").write_text(text)
    line = f"--site tool --out {tmp_path}/arm.yaml {flat}"
    adopt_command.main([f"{tmp_path}/my\narm.xml", *line.split()])
    said = capsys.readouterr().out
    head, _ = (tmp_path / "arm.yaml").read_text().split("\n", 1)
    assert head.endswith(f"arm.xml' {line}") and "bounce-mjx adopt '" in head
    robot = read_preset(tmp_path / "arm.yaml").env.robot
    for name, stiffness, damping in zip(
        ARM_JOINTS.split(), robot.servo_stiffness, robot.servo_damping, strict=True
    ):
        numbers = f"kp {stiffness:.4g} N m/rad, kv {damping:.4g} N m s/rad, force limit 100 N m"
        assert re.search(rf"  {name}: .* rad, inertia .* kg m², {re.escape(numbers)}\n", said)
    assert "gravity [0.0, 0.0, -1.6], wind [1.0, 0.0, 0.0], density 1.2" in said
    assert "the disabled damper, the disabled actuator groups" in said


def test_adopted_servos_follow_within_the_control_steps_of_the_task(tmp_path) -> None:
    (tmp_path / "arm.xml").write_text(mjcf(arm(), motors(ARM_JOINTS)))
    (tmp_path / "slow.py").write_text(
        "from bounce_mjx.task.bounce import Bounce\n"
        "class Config(Bounce.Config):\n    control_dt: float = 0.02\n"
        "class Slow(Bounce):\n    Config = Config\n"
    )
    flat = "--paddle.position 0 0 0.03 --paddle.quaternion 1 0 0 0"
    line = f"{tmp_path}/arm.xml --site tool --out {tmp_path}/arm.yaml {flat}"
    import_code(tmp_path / "slow.py")
    adopt_command.main([*line.split(), "--task", "slow"])
    written = yaml.safe_load((tmp_path / "arm.yaml").read_text())["env"]["robot"]
    robot = RobotConfig.model_validate(
        {"site": "tool", "paddle": {"position": (0, 0, 0.03), "quaternion": (1, 0, 0, 0)}}
    )
    expected = adopt(tmp_path / "arm.xml", robot, 0.02, is_mount_given=True).config
    np.testing.assert_allclose(written["servo_stiffness"], expected.servo_stiffness)
    quick = adopt(tmp_path / "arm.xml", robot, 0.01, is_mount_given=True).config
    assert np.all(np.array(expected.servo_stiffness) < 0.5 * np.array(quick.servo_stiffness))


def test_no_printed_number_is_minus_0() -> None:
    pose = SimpleNamespace(
        paddle=np.array([0.5, -4e-4, 0.2]),
        angles=np.array([-4e-4, 1.0]),
        acceleration=9.0,
        reach=1.0,
        manipulability=0.1,
        inertia=(1.0, 1.0),
    )
    adoption = SimpleNamespace(
        pose=pose,
        clearance=0.1,
        config=RobotConfig(),
        action_scale=0.05,
        servos=[ServoSettings(100.0, 1.0, None)] * 2,
        arm=SimpleNamespace(
            joint_names=("a", "b"), changes=(), spec=mujoco.MjSpec.from_string(TWO_JOINTS)
        ),
    )
    lines = adopt_command.describe(adoption)
    assert lines[0].startswith("paddle: level at x 0.500, y 0.000, z 0.200 m")
    assert lines[5].startswith("  a: +0.000 rad") and lines[6].startswith("  b: +1.000 rad")


def test_contacts_are_turned_off_where_the_arm_has_some(tmp_path) -> None:
    """Not on the floor or the gripper, which are removed; a shape may have half of the two bits."""
    untouched = arm().replace("<geom ", '<geom contype="0" conaffinity="0" ')
    floor = '<geom type="plane" size="1 1 1"/>'
    cases = {
        arm(): True,
        arm().replace("<geom ", '<geom conaffinity="0" '): True,
        untouched: False,
        floor + untouched.replace("<site", f"{HAND}<site"): False,
    }
    for world, touches in cases.items():
        (tmp_path / "arm.xml").write_text(mjcf(world, motors(ARM_JOINTS)))
        changes = build_arm(tmp_path / "arm.xml", RobotConfig(site="tool")).changes
        assert any("contacts" in change for change in changes) == touches


@pytest.mark.parametrize("mount", mounts(PaddleConfig()))
def test_a_moved_paddle_weighs_as_one_that_is_built_there(mount, tmp_path) -> None:
    """The search moves the paddle of a compiled scene: its mass must move with it."""
    (tmp_path / "arm.xml").write_text(ARM)
    matrices = []
    for built_at in (PaddleConfig(), mount):
        config = RobotConfig(site="tool", paddle=built_at)
        spec = build_arm(tmp_path / "arm.xml", config).spec
        spec.compiler.fusestatic = False
        model = compile_spec(spec, tmp_path)
        addresses = find_addresses(model)
        place_paddle(model, addresses.paddle_geom, mount)
        data = data_at(model, addresses, [0.1, 0.6, 1.1, -0.4, 0.9, 0.3])
        mujoco.mj_forward(model, data)
        matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, matrix)
        matrices.append(matrix)
    np.testing.assert_allclose(*matrices, rtol=1e-9, atol=1e-12)


def test_an_error_keeps_its_cause() -> None:
    """Also one that has the file's name already."""
    with pytest.raises(UserError) as caught, naming(Path("arm.xml")), naming(Path("arm.xml")):
        try:
            raise ValueError("the cause")
        except ValueError as cause:
            raise UserError("no joint") from cause
    assert str(caught.value) == "the MJCF file arm.xml has no joint"
    assert str(caught.value.__cause__) == "no joint"
    assert str(caught.value.__cause__.__cause__) == "the cause"


@pytest.mark.slow
def test_a_start_pose_lies_inside_the_limits(tmp_path) -> None:
    """By the noise of a reset at least; of an arm in degrees, and of one that turns one way."""
    (tmp_path / "degrees.xml").write_text(styled())
    (tmp_path / "one_way.xml").write_text(mjcf(arm(limits="0 3"), motors(ARM_JOINTS)))
    for name in ("degrees", "one_way"):
        path = tmp_path / f"{name}.xml"
        pose = adopt(path, RobotConfig(site="tool"), 0.01, is_mount_given=False).pose
        plain = mujoco.MjModel.from_xml_path(str(path))
        low, high = plain.jnt_range[plain.jnt_limited == 1].T
        angles = np.array(pose.angles)[plain.jnt_limited == 1]
        noise = EnvConfig().reset.joint_angles - 1e-9
        assert np.all(angles >= low + noise) and np.all(angles <= high - noise)


LIFT = link(
    SLIDE.format("lift", "0 0 1"),
    "0 0 0.3",
    link(
        hinge("roll", "1 0 0"),
        "0.3 0 0",
        link(hinge("pitch", "0 1 0"), "0 0 0", '<site name="tool" quat="0.7071 0 0.7071 0"/>'),
    ),
)


@pytest.mark.slow
def test_three_joints_suffice_to_lift_and_tilt(tmp_path, capsys) -> None:
    """Also on a base with a free joint, which is fixed; the observation has 2n + 17 numbers."""
    pitch = hinge("pitch", "0 1 0")
    damped = LIFT.replace(pitch, pitch.replace('damping="0.1"', 'damping="20"'))
    base = f'<body><freejoint/><geom size="0.1"/>{damped}</body>'
    (tmp_path / "arm.xml").write_text(mjcf(base, motors("lift roll pitch", 60.0)))
    for task in ("juggle", "bounce"):
        line = f"{tmp_path}/arm.xml --site tool --out {tmp_path}/arm.yaml --task {task}"
        adopt_command.main(line.split())
    said = capsys.readouterr().out
    for line in ("view --task juggle --robot ", "train juggle --robot "):
        assert f": bounce-mjx {line}" in said
    env = BounceBall(read_preset(tmp_path / "arm.yaml").env)
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((3,), np.float32))
    assert after.obs.shape == (env.observation_size,) == (23,)
    assert env.layout["joint_velocities"] == slice(10, 13)
    assert joint_names(env.mj_model) == ("lift", "roll", "pitch")
    # A slide is slower: its action of 1 commands 0.6 m/s, that of a hinge 2 rad/s, where no force
    # is left; also where the joint itself is damped more than its servo would be.
    model = copy.copy(env.mj_model)
    model.actuator_forcelimited[:] = False
    data = mujoco.MjData(model)
    data.qpos[list(env.addresses.arm_qpos)] = env.config.default_joint_angles
    data.qvel[list(env.addresses.arm_qvel)] = [0.6, 2.0, 2.0]
    servos = list(env.addresses.actuators)
    data.ctrl[servos] = np.array(env.config.default_joint_angles) + env.config.action_scale
    mujoco.mj_forward(model, data)
    left = (data.qfrc_actuator + data.qfrc_passive)[list(env.addresses.arm_qvel)]
    np.testing.assert_allclose(left, 0.0, atol=1e-3 * np.max(data.ctrl))
    assert model.actuator_biasprm[servos, 2].tolist()[2] == 0.0


def test_what_is_said_of_a_slide_is_true(tmp_path) -> None:
    """Its position is in metres, and its policy acts in JAX alone."""
    (tmp_path / "lift.xml").write_text(mjcf(LIFT, motors("lift roll pitch", 60.0)))
    robot = RobotConfig(site="tool")
    pose = SimpleNamespace(
        angles=np.array([0.2, 0.1, 0.0]),
        paddle=np.array([0.5, 0.0, 0.2]),
        acceleration=9.0,
        reach=1.0,
        manipulability=0.1,
        inertia=(1.0, 1.0, 1.0),
    )
    adoption = SimpleNamespace(
        pose=pose,
        clearance=0.1,
        config=robot,
        action_scale=0.01,
        servos=[ServoSettings(100.0, 1.0, None)] * 3,
        arm=build_arm(tmp_path / "lift.xml", robot),
    )
    said = "\n".join(adopt_command.describe(adoption))
    assert "  lift: +0.200 m, " in said and "  roll: +0.100 rad, " in said
    assert "action scale 0.01 rad (a slide: m)" in said
    assert "a slide (lift) runs in JAX alone" in said
    servos = {
        "servo_stiffness": (100.0,) * 3,
        "servo_damping": (1.0,) * 3,
        "servo_force_limit": (60.0,) * 3,
    }
    arm_config = robot.model_copy(update=servos)
    settings = {"mjcf": tmp_path / "lift.xml", "robot": arm_config.model_dump()}
    settings |= {"default_joint_angles": (0.2, 0.0, 0.0)}
    with pytest.raises(UserError, match="the acting joint 'lift' is a slide") as refusal:
        policy_metadata(TrainConfig(env=settings), 0)
    assert "remov" not in str(refusal.value) and "Run(FOLDER).policy" in str(refusal.value)


def test_the_config_of_the_packages_arm_has_the_defaults() -> None:
    assert read_preset(resource_path("configs/robots/peitian.yaml")).env == EnvConfig()


def test_a_robot_is_read_on_top_of_a_preset(written, tmp_path) -> None:
    preset = tmp_path / "preset.yaml"
    preset.write_text("env: {action_scale: 0.5, episode_seconds: 3.0}\nseed: 4\n")
    config = read_preset(preset, written["small"])
    own = read_preset(written["small"]).env
    assert config.env == own.model_copy(update={"episode_seconds": 3.0}) and config.seed == 4
    assert own.action_scale != 0.5


@pytest.mark.parametrize("field", ["body_quat", "body_ipos", "body_mass", "jnt_axis"])
def test_an_arm_that_changes_in_the_scene_is_refused(field, tmp_path) -> None:
    """As an angle that is read in other units would change it."""
    (tmp_path / "arm.xml").write_text(STYLES["turned flange"])
    found = build_arm(tmp_path / "arm.xml", RobotConfig(site="tool"))
    found.spec.compiler.fusestatic = False
    model = compile_spec(found.spec, tmp_path)
    check_as_alone(found, model)
    joint = find_addresses(model).arm_joints[2]
    index = model.jnt_bodyid[joint] if field.startswith("body") else joint
    getattr(model, field)[index] += 1e-4
    with pytest.raises(UserError, match=f"where its {field} differs by"):
        check_as_alone(found, model)


IDLE = {
    "a geom": ('size="0.04" ', 'size="0.04" solimp="1 1 0" solref="0.02 -100" '),
    "a joint's limit": ('damping="0.1"', 'damping="0.1" solimplimit="1 1 0" solreflimit="1 -1"'),
    "dry friction": ('damping="0.1"', 'damping="0.1" solimpfriction="1 1 0"'),
}


@pytest.mark.parametrize("setting", IDLE)
def test_a_setting_that_cannot_act_is_reset_with_a_line(setting: str, tmp_path) -> None:
    """MuJoCo takes each with a warning, and no engine has it where it acts."""
    (tmp_path / "arm.xml").write_text(ARM.replace(*IDLE[setting]))
    built = build_arm(tmp_path / "arm.xml", RobotConfig(site="tool"))
    assert any(re.search(r"^reset the sol.+, where it cannot act$", x) for x in built.changes)
    model = load_model(tmp_path / "arm.xml", 0.001, robot=RobotConfig(site="tool", **SERVOS))
    assert make_engine(model, "auto").name == "fused"


SERVOS = {"servo_stiffness": [1e3] * 6, "servo_damping": [20.0] * 6, "servo_force_limit": [1e2] * 6}


def test_a_setting_that_acts_is_refused_by_its_name_in_the_file(tmp_path) -> None:
    text = ARM.replace('damping="0.1"', 'damping="0.1" frictionloss="1" solimpfriction="1 1 0"')
    (tmp_path / "arm.xml").write_text(text)
    model = load_model(tmp_path / "arm.xml", 0.001, robot=RobotConfig(site="tool", **SERVOS))
    with pytest.raises(UserError, match="support a joint's solimpfriction without a width"):
        make_engine(model, "auto")


def test_a_constraint_that_is_off_couples_nothing(tmp_path) -> None:
    off = '<equality><joint joint1="j2" joint2="j3" active="false"/></equality>'
    (tmp_path / "arm.xml").write_text(mjcf(arm(), motors(ARM_JOINTS), off))
    assert build_arm(tmp_path / "arm.xml", RobotConfig(site="tool")).joint_names[1:3] == (
        "j2",
        "j3",
    )


def test_a_urdf_is_called_one_and_a_missing_mesh_is_to_be_put_there(tmp_path) -> None:
    (tmp_path / "arm.urdf").write_text("no robot")
    with pytest.raises(UserError, match=r"the URDF file \S+arm\.urdf does not compile"):
        read_spec(tmp_path / "arm.urdf")
    mesh = mjcf(arm(tip='<geom type="mesh" mesh="m"/>'), motors(ARM_JOINTS))
    mesh = mesh.replace("<worldbody>", '<asset><mesh name="m" file="gone.stl"/></asset><worldbody>')
    (tmp_path / "arm.xml").write_text(mesh)
    with pytest.raises(UserError, match=r"opening file .+; put the file there"):
        build_arm(tmp_path / "arm.xml", RobotConfig(site="tool"))


def urdf(effort: float = 80.0) -> str:
    """An arm as its manufacturer describes it in ROS: six links, and a flange that is fixed to the
    last one; no actuators, as the format has none."""
    axes = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
    text = '<robot name="six"><link name="base"/>'
    parent = "base"
    for i, axis in enumerate(axes, start=1):
        at = "0.3 0 0" if i in (3, 4) else "0 0 0.1"
        text += (
            f'<link name="l{i}"><inertial><origin xyz="0.1 0 0"/><mass value="{4.0 / i}"/>'
            '<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="l{i}"/>'
            f'<origin xyz="{at}"/><axis xyz="{axis}"/>'
            f'<limit lower="-2.9" upper="2.9" velocity="{i}.5" effort="{effort / i}"/></joint>'
        )
        parent = f"l{i}"
    return text + (
        '<link name="flange"/><joint name="fixed" type="fixed"><parent link="l6"/>'
        '<child link="flange"/><origin xyz="0.05 0 0" rpy="0 1.5708 0"/></joint></robot>'
    )


def test_a_urdf_is_adopted_with_its_efforts_and_its_velocities_are_said(tmp_path, capsys) -> None:
    (tmp_path / "arm.urdf").write_text(urdf())
    words = [str(tmp_path / "arm.urdf"), "--site", "flange", "--out", str(tmp_path / "arm.yaml")]
    adopt_command.main(words)
    printed = capsys.readouterr().out
    assert "gave each joint an actuator within its own force limit, as the file has none" in printed
    assert "the file's limits of velocity, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5 rad/s, do not" in printed
    settings = yaml.safe_load((tmp_path / "arm.yaml").read_text())["env"]["robot"]
    assert settings["servo_force_limit"] == pytest.approx([80.0 / i for i in range(1, 7)])
    # Where MuJoCo places the flange, 0.05 m from the last joint.
    robot = RobotConfig(site="flange", paddle=PaddleConfig(position=(0.0, 0.0, 0.0)))
    built = compile_spec(build_arm(tmp_path / "arm.urdf", robot).spec, tmp_path)
    data = mujoco.MjData(built)
    mujoco.mj_kinematics(built, data)
    np.testing.assert_allclose(data.geom("blocker").xpos, [0.65, 0.0, 0.4], atol=1e-9)
    # Without an effort, nothing tells how strong its motors are.
    (tmp_path / "arm.urdf").write_text(urdf(effort=0.0))
    with pytest.raises(UserError, match=r"no actuator on j1, j2, .* \(to a URDF, an effort\)"):
        build_arm(tmp_path / "arm.urdf", robot)


def test_adopt_knows_an_arm_by_its_lengths_and_warns_of_slow_servos(tmp_path, capsys) -> None:
    adopt_command.main([str(ur5e()), "--out", str(tmp_path / "ur5e.yaml")])
    printed = capsys.readouterr().out
    assert "warning: this is a ur5e: --robot ur5e has its manufacturer's limits" in printed
    # kp 2000 and kv 400, of the file.
    assert "servos follow slowly" in printed and "time constant of 0.2 s, which are 20" in printed
    assert "warning: the file says no limits of velocity and acceleration" in printed
    # Another arm with as many joints is none of them.
    (tmp_path / "arm.xml").write_text(ARM)
    adopt_command.main(
        [str(tmp_path / "arm.xml"), "--site", "tool", "--out", str(tmp_path / "arm.yaml")]
    )
    printed = capsys.readouterr().out
    assert "this is a" not in printed and "follow slowly" not in printed
