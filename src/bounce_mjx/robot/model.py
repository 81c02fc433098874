"""The simulated robot: its MJCF file, its balls, the names in it, the addresses of its data, and
the sizes and places that tasks and controllers need."""

import hashlib
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.resources import resource_path
from bounce_mjx.robot import arm
from bounce_mjx.robot.actuators import (
    ACTING_KINDS,
    is_direct,
    is_position_servo,
    limit_torques,
    single_actuators,
    torque_ranges,
)
from bounce_mjx.robot.config import RobotConfig
from bounce_mjx.robot.contact import PAIR_SETTINGS, check_step
from bounce_mjx.robot.names import (
    BALL_BODY_NAME,
    BALL_NUMBERS,
    PADDLE_GEOM_NAME,
    joint_name,
)
from bounce_mjx.robot.numbers import check_numbers, physical_fields

MAX_BALLS = len(BALL_NUMBERS)
BALLS_APART = 0.1
"""Height of each added ball above the last one, m."""


def balls_above(place: Sequence[float], num_balls: int) -> np.ndarray:
    """Places of balls one above another [B, 3], m, the first one at a place [3]."""
    heights = BALLS_APART * np.arange(num_balls)
    return np.array(place) + heights[:, None] * [0.0, 0.0, 1.0]


class BallAddresses(NamedTuple):
    """Indices of one ball in the arrays of the model."""

    body: int
    geom: int
    qpos: tuple[int, ...]
    """Position (3) and quaternion (4) in qpos."""
    qvel: tuple[int, ...]
    """Linear (3) and angular (3) velocity in qvel."""


class Addresses(NamedTuple):
    """Indices of the named parts in the arrays of the model."""

    arm_joints: tuple[int, ...]
    """Ids of the acting joints, the joints with an actuator, in the model's order: the base comes
    first."""
    arm_qpos: tuple[int, ...]
    """Positions of the acting joints in qpos."""
    arm_qvel: tuple[int, ...]
    """Velocities of the acting joints in qvel."""
    actuators: tuple[int, ...]
    """Ids of the servos: each moves the acting joint of the same place in `arm_joints`. Each has
    one control (`check_servos`), so they are also its places in ctrl."""
    balls: tuple[BallAddresses, ...]
    paddle_geom: int


class Geometry(NamedTuple):
    """What a task needs of the ball and the paddle, which a model may have in any size."""

    ball_radius: float
    """Radius of the first ball, m."""
    rest_height: float
    """Height of a ball's centre over the paddle's while they touch, m."""
    paddle_home: tuple[float, float, float]
    """Centre of the paddle at a reset without noise, m; the function `paddle_home` rounds it."""
    ball_radii: tuple[float, ...]
    """Radius of each ball, m."""


def scene_spec(mjcf: Path | None, robot: RobotConfig) -> tuple[mujoco.MjSpec, Path]:
    """Spec of the whole scene, and the path of its MJCF file.

    Args:
      mjcf: the file, as for `locate`; None for the project's own robot.
      robot: the adoption of an arm; without a site, the file is the whole scene.

    Raises:
      UserError: the file is missing, is no MJCF, or holds no arm that can do the task.
    """
    path = resource_path("mjcf/bounce_ball.xml") if mjcf is None else arm.locate(mjcf)
    if robot.site is None:
        return arm.read_spec(path), path
    with arm.naming(path):
        return arm.build_arm(path, robot).spec, path


def load_model(
    mjcf: Path | None,
    physics_dt: float,
    visual: bool = True,
    robot: RobotConfig | None = None,
    num_balls: int = 1,
) -> mujoco.MjModel:
    """The compiled scene of an MJCF file, with the robot's settings.

    Args:
      mjcf: the file, as for `locate`; None for the project's own robot.
      physics_dt: physics time step, s.
      visual: False drops the textures and geoms that only pictures need; they take most of a
        model's memory.
      robot: the adoption of an arm; None for an MJCF file that is a whole scene.
      num_balls: 1 to 3; the balls that the file lacks are copies of its first one.

    Raises:
      UserError: the file is missing, is no MJCF, lacks a name that the task needs, has a joint with
        several actuators or with one that is no position servo at rest (`check_servos`), a range in
        degrees that MuJoCo does not convert, more balls than `num_balls`, or a number that cannot
        be simulated;
        or half a period of a contact has fewer than four physics steps.
    """
    robot = robot or RobotConfig()
    spec, path = scene_spec(mjcf, robot)
    add_balls(spec, num_balls)
    if robot.gravity_compensation > 0.0:
        _compensate_gravity(spec, robot.gravity_compensation)
    if not visual:
        _drop_pictures(spec)
    mj_model = arm.compile_spec(spec, path)
    with arm.naming(path):
        check_numbers(mj_model)
        addresses = find_addresses(mj_model)
        check_servos(mj_model, addresses)
        _check_units_of_ranges(spec, mj_model, addresses)
        _check_balls(addresses, num_balls)
    if robot.limits.torque is not None:
        # A wrong number of torques, or of joints, is refused where the config is known
        # (`WorldConfig`, `env.checks.check_joint_angles`).
        torques = robot.limits.torque[: len(addresses.actuators)]
        limit_torques(mj_model, addresses.actuators[: len(torques)], torques)
    mj_model.opt.timestep = physics_dt
    check_step(mj_model)
    return mj_model


def ball_name(index: int) -> str:
    """Name of the body of a ball, which counts from 0: ball_link, ball_link2, ball_link3."""
    return BALL_BODY_NAME + BALL_NUMBERS[index]


def add_balls(spec: mujoco.MjSpec, num_balls: int) -> None:
    """Adds balls to a scene until it has `num_balls`: copies of the first one with all that it
    consists of, such as its contact pair with the paddle, and pairs like that one between each two
    balls. A ball or a pair that the scene has stays as it is.

    MuJoCo's solver may then take its default number of iterations. With the shipped limits, a step
    with two touching balls is wrong by up to four times the largest velocity.
    """
    if num_balls == 1 or spec.body(BALL_BODY_NAME) is None:
        return
    arm.raise_solver_limits(spec.option)
    spec.copy_during_attach = True
    for i in range(1, num_balls):
        if spec.body(ball_name(i)) is None:
            # The copy brings its pairs.
            frame = spec.worldbody.add_frame(pos=[0.0, 0.0, BALLS_APART * i])
            frame.attach_body(spec.body(BALL_BODY_NAME), prefix="", suffix=BALL_NUMBERS[i])
    pairs = {frozenset((pair.geomname1, pair.geomname2)): pair for pair in spec.pairs}
    touching = []
    for i in range(num_balls):
        for geom in spec.body(ball_name(i)).geoms:
            # The one that `find_addresses` takes; a ball without a pair touches nothing.
            if frozenset((geom.name, PADDLE_GEOM_NAME)) in pairs:
                touching.append(geom.name)
                break
    for first, second in itertools.combinations(touching, 2):
        if frozenset((first, second)) not in pairs:
            with_paddle = pairs[frozenset((second, PADDLE_GEOM_NAME))]
            settings = {name: getattr(with_paddle, name) for name in PAIR_SETTINGS}
            spec.add_pair(geomname1=first, geomname2=second, **settings)


def _compensate_gravity(spec: mujoco.MjSpec, share: float) -> None:
    """Lets a controller carry a share of the weight of each body without a free joint."""
    for body in spec.bodies:
        is_free = any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints)
        if not is_free:
            body.gravcomp = share


def _drop_pictures(spec: mujoco.MjSpec) -> None:
    """Leaves out what only pictures need. Where geoms make the bodies' inertia, MuJoCo keeps them
    whatever the flag, so it is not set."""
    from_geoms = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    if spec.compiler.inertiafromgeom != from_geoms:
        spec.compiler.discardvisual = True


def _check_units_of_ranges(
    spec: mujoco.MjSpec, mj_model: mujoco.MjModel, addresses: Addresses
) -> None:
    """Refuses a range in degrees that would count as one in radians (`joint_ranges`): MuJoCo
    converts the ranges of limited joints alone."""
    if not spec.compiler.degree:
        return
    for joint in addresses.arm_joints:
        is_hinge = mj_model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        low, high = mj_model.jnt_range[joint]
        if is_hinge and low < high and not mj_model.jnt_limited[joint]:
            name = joint_name(mj_model, joint)
            raise UserError(
                f"the range {low:g} to {high:g} of {name} in degrees, which MuJoCo converts for "
                'limited joints alone; write <compiler angle="radian"/> and all angles in rad'
            )


def _check_balls(addresses: Addresses, num_balls: int) -> None:
    present = len(addresses.balls)
    if present != num_balls:
        raise UserError(f"{present} balls, but num_balls is {num_balls}; set it to {present}")


def paddle_home(
    mjcf: Path | None,
    robot: RobotConfig,
    joint_angles: Sequence[float],
    physics_dt: float,
    num_balls: int,
) -> tuple[float, float, float]:
    """Centre of the paddle at joint angles [n] (rad), m, rounded to 0.1 mm as in a config;
    `read_geometry` has the exact one of a compiled model.

    Args:
      mjcf, robot, physics_dt, num_balls: as for `load_model`.

    Raises:
      UserError: as `load_model`.
    """
    mj_model = load_model(mjcf, physics_dt, visual=False, robot=robot, num_balls=num_balls)
    addresses = find_addresses(mj_model)
    data = data_at(mj_model, addresses, joint_angles)
    x, y, z = data.geom_xpos[addresses.paddle_geom].tolist()
    return round(x, 4), round(y, 4), round(z, 4)


def read_geometry(
    mj_model: mujoco.MjModel, addresses: Addresses, joint_angles: Sequence[float]
) -> Geometry:
    """The geometry of a model whose arm starts at joint angles [n], rad."""
    ball_radii = tuple(float(mj_model.geom_size[ball.geom, 0]) for ball in addresses.balls)
    _, face_height = upper_face(mj_model, addresses, joint_angles)
    data = data_at(mj_model, addresses, joint_angles)
    paddle_home = tuple(data.geom_xpos[addresses.paddle_geom].tolist())
    rest_height = ball_radii[0] + face_height
    return Geometry(ball_radii[0], rest_height, paddle_home, ball_radii)


def upper_face(
    mj_model: mujoco.MjModel, addresses: Addresses, joint_angles: Sequence[float]
) -> tuple[np.ndarray, float]:
    """Unit normal [3] of the paddle's face that is the upper one at these joint angles (rad), in
    the frame of the paddle's body, and the face's distance from the paddle's centre, m."""
    paddle = addresses.paddle_geom
    data = data_at(mj_model, addresses, joint_angles)
    # The height of each of the geom's axes.
    upward = data.geom_xmat[paddle].reshape(3, 3)[2]
    axis = int(np.argmax(abs(upward)))
    normal_in_geom = np.sign(upward[axis]) * np.eye(3)[axis]
    normal = np.zeros(3)
    mujoco.mju_rotVecQuat(normal, normal_in_geom, mj_model.geom_quat[paddle])
    half_thickness = float(mj_model.geom_aabb[paddle, 3 + axis])
    return normal, half_thickness


def data_at(
    mj_model: mujoco.MjModel, addresses: Addresses, joint_angles: Sequence[float]
) -> mujoco.MjData:
    """The kinematics of a model with the arm at joint angles [n], rad."""
    data = mujoco.MjData(mj_model)
    data.qpos[list(addresses.arm_qpos)] = joint_angles
    mujoco.mj_kinematics(mj_model, data)
    return data


def joint_ranges(mj_model: mujoco.MjModel, addresses: Addresses) -> np.ndarray:
    """Lower and upper ends [2, n] of the acting joints' ranges, rad; infinite without a range.

    A range counts also where the joint is not limited: it acts by clipping the servo targets. Of an
    adopted arm, `arm.build_arm` has dropped the ranges that the file does not limit.
    """
    low, high = mj_model.jnt_range[list(addresses.arm_joints)].T
    has_range = low < high
    return np.stack([np.where(has_range, low, -np.inf), np.where(has_range, high, np.inf)])


def link_bodies(mj_model: mujoco.MjModel, addresses: Addresses) -> list[list[int]]:
    """Bodies of each acting joint's link: the joint's body and the bodies welded to it. A body
    with several joints belongs to the last one, and the others have no bodies."""
    last_joint_of_body = mj_model.body_jntadr + mj_model.body_jntnum - 1
    last_joint = last_joint_of_body[mj_model.body_weldid]
    return [np.flatnonzero(last_joint == joint).tolist() for joint in addresses.arm_joints]


def contact_pairs(mj_model: mujoco.MjModel, addresses: Addresses) -> list[int]:
    """Indices of the contact pairs among the balls and the paddle, that of the first ball with the
    paddle first; none if that one is missing."""
    paddle = addresses.paddle_geom
    balls = [ball.geom for ball in addresses.balls]
    first = None
    others = []
    for i in range(mj_model.npair):
        geoms = {int(mj_model.pair_geom1[i]), int(mj_model.pair_geom2[i])}
        if geoms == {paddle, balls[0]} and first is None:
            first = i
        elif geoms <= {paddle, *balls}:
            others.append(i)
    return [] if first is None else [first, *others]


def balls_of_pair(mj_model: mujoco.MjModel, addresses: Addresses, pair: int) -> tuple[int, ...]:
    """The balls of a contact pair, in order: one that touches the paddle, or two."""
    ball_of_geom = {ball.geom: i for i, ball in enumerate(addresses.balls)}
    geoms = (int(mj_model.pair_geom1[pair]), int(mj_model.pair_geom2[pair]))
    return tuple(sorted(ball_of_geom[geom] for geom in geoms if geom in ball_of_geom))


def scatter(rest: np.ndarray, places: Sequence[int], values: jax.Array) -> jax.Array:
    """The numbers `rest` [m], such as `qpos0`, with the values [n] at some places."""
    # One scalar per entry, which XLA fuses with the physics; it would not fuse an indexed update.
    entries = list(rest)
    for place, value in zip(places, values, strict=True):
        entries[place] = value
    return jnp.stack([jnp.asarray(entry, values.dtype) for entry in entries])


def check_servos(mj_model: mujoco.MjModel, addresses: Addresses) -> None:
    """Compares the acting joints' actuators with a position servo, whose control is the target
    position of its joint, times the gear, and which exerts no force there.

    Raises:
      UserError: one is another actuator; the text starts with it.
    """
    # With a <pid>, which has several controls, an actuator's index would not be its control's.
    if np.any(mj_model.actuator_ctrlnum != 1):
        raise UserError("an actuator with several controls; drive each joint by a <position>")
    for joint, actuator in zip(addresses.arm_joints, addresses.actuators, strict=True):
        if not (is_direct(mj_model, actuator) and is_position_servo(mj_model, actuator)):
            name = joint_name(mj_model, joint)
            raise UserError(
                f"an actuator on {name} that is not a position servo; drive it by "
                f'<position joint="{name}"/>, without a timeconst (env.randomization.servo_lag '
                "simulates a lag)"
            )
    torques = torque_ranges(mj_model, addresses.arm_joints, addresses.actuators)
    for joint, low, high in zip(addresses.arm_joints, *torques, strict=True):
        if not low <= 0.0 <= high:
            name = joint_name(mj_model, joint)
            raise UserError(
                f"forces of {low:g} to {high:g} on {name} (the forcerange times the gear, within "
                "the joint's actuatorfrcrange), so its servo never rests; give ranges around 0"
            )


def find_addresses(mj_model: mujoco.MjModel) -> Addresses:
    """Addresses of the task's parts.

    Raises:
      UserError: a needed name is missing; the text starts with the missing part.
    """
    paddle_geom = _find(mj_model, mujoco.mjtObj.mjOBJ_GEOM, PADDLE_GEOM_NAME)
    balls = [_find_ball(mj_model, BALL_BODY_NAME, paddle_geom)]
    for i in range(1, MAX_BALLS):
        name = ball_name(i)
        if mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_BODY, name) < 0:
            break
        balls.append(_find_ball(mj_model, name, paddle_geom))
    actuator_of = _driven_joints(mj_model)
    joints = tuple(actuator_of)
    return Addresses(
        arm_joints=joints,
        arm_qpos=tuple(mj_model.jnt_qposadr[list(joints)].tolist()),
        arm_qvel=tuple(mj_model.jnt_dofadr[list(joints)].tolist()),
        actuators=tuple(actuator_of.values()),
        balls=tuple(balls),
        paddle_geom=paddle_geom,
    )


def _find_ball(mj_model: mujoco.MjModel, name: str, paddle_geom: int) -> BallAddresses:
    body = _find(mj_model, mujoco.mjtObj.mjOBJ_BODY, name)
    joint = mj_model.body_jntadr[body]
    if joint < 0 or mj_model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise UserError(f"no free joint on the body {name}; add <freejoint/> to it")
    if mj_model.body_geomnum[body] < 1:
        raise UserError(f"no geom on the body {name}; add the ball's sphere to it")
    first_qpos = int(mj_model.jnt_qposadr[joint])
    first_dof = int(mj_model.jnt_dofadr[joint])
    # The geom in a contact pair with the paddle, as in `add_balls`; without a pair, the first one.
    geoms = int(mj_model.body_geomadr[body]) + np.arange(mj_model.body_geomnum[body])
    in_pair = np.concatenate(
        [
            mj_model.pair_geom1[mj_model.pair_geom2 == paddle_geom],
            mj_model.pair_geom2[mj_model.pair_geom1 == paddle_geom],
        ]
    )
    touching = np.isin(geoms, in_pair)
    return BallAddresses(
        body=body,
        geom=int(geoms[np.argmax(touching)]),
        qpos=tuple(range(first_qpos, first_qpos + 7)),
        qvel=tuple(range(first_dof, first_dof + 6)),
    )


def joint_names(mj_model: mujoco.MjModel, addresses: Addresses | None = None) -> tuple[str, ...]:
    """Names of the acting joints; `addresses` are the model's, if they are known."""
    if addresses is None:
        addresses = find_addresses(mj_model)
    return tuple(joint_name(mj_model, joint) for joint in addresses.arm_joints)


def _driven_joints(mj_model: mujoco.MjModel) -> dict[int, int]:
    """The actuator of each hinge and slide that has one, in the order of the joints."""
    candidates = []
    for joint in range(mj_model.njnt):
        if int(mj_model.jnt_type[joint]) in ACTING_KINDS:
            candidates.append(joint)
    actuator_of = single_actuators(mj_model, candidates)
    if not actuator_of:
        raise UserError("no actuator on a hinge or slide; give each joint of the arm a <position>")
    return actuator_of


def fingerprint(mj_model: mujoco.MjModel) -> bytes:
    """A hash of the numbers on which a simulation depends; it ignores colours and sites."""
    digest = hashlib.blake2b()
    for name in physical_fields(mj_model):
        digest.update(np.asarray(getattr(mj_model, name)).tobytes())
    for name in dir(mj_model.opt):
        if not name.startswith("_"):
            digest.update(np.asarray(getattr(mj_model.opt, name)).tobytes())
    return digest.digest()


def check_unedited(mj_model: mujoco.MjModel, built_from: bytes) -> None:
    """Compares a model with its earlier `fingerprint`.

    Raises:
      UserError: the model was edited, and the engines built from it would ignore the edit.
    """
    if fingerprint(mj_model) != built_from:
        raise UserError(
            "env.mj_model was edited after the environment had been built, and the physics would "
            "ignore the edit; edit the MJCF (env.mjcf), or pass randomize=... to Env"
        )


def _find(mj_model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    index = mujoco.mj_name2id(mj_model, kind, name)
    if index < 0:
        noun = kind.name.removeprefix("mjOBJ_").lower()
        needed = f"{BALL_BODY_NAME} and {PADDLE_GEOM_NAME}"
        raise UserError(f"no {noun} named {name}; the task needs the names {needed}")
    return index
