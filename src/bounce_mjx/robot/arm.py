"""Adoption of an arm: from any MJCF with a serial arm in it to the task's scene, with MjSpec.

Every change to the user's model is collected as one sentence.
"""

import contextlib
import importlib.util
import warnings
from collections.abc import Container, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.errors import UserError, install_command, needed, reason_of, shorten
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.config import PaddleConfig, RobotConfig
from bounce_mjx.robot.numbers import check_numbers

BALL_BODY_NAME = "ball_link"
PADDLE_GEOM_NAME = "blocker"
# Lifting and tilting the paddle about two axes takes three joints.
MIN_JOINTS = 3

PADDLE_BODY_NAME = "paddle"
# Ends of the names of a scene's balls.
_BALL_NUMBERS = ("", "2", "3")
BODY_FIELDS = ("body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia")
JOINT_FIELDS = ("jnt_pos", "jnt_axis")
# Viewers show the groups 0 to 2.
HIDDEN_GROUP = 3
_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
# Smallest change of a joint's range that is reported, rad or m.
_NARROWER = 1e-3
_HANDLE_RADIUS = 0.011
# Without what only its simulations need; a later version may move its files.
_INSTALLED_AS = {"robosuite": ("--no-deps", "robosuite==1.5.2")}
_JOINT_TRANSMISSIONS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


class ServoSettings(NamedTuple):
    """A position servo of one joint, or another actuator, which has a force limit alone."""

    stiffness: float | None
    """N m/rad, or N/m."""
    damping: float | None
    """N m s/rad, or N s/m."""
    force_limit: float | None
    """N m, or N; None for no limit."""


class Arm(NamedTuple):
    """An arm in the task's scene."""

    spec: mujoco.MjSpec
    joint_names: tuple[str, ...]
    """The acting joints, from the base to the paddle."""
    servos: tuple[ServoSettings, ...]
    """The MJCF's own actuator of each acting joint."""
    changes: tuple[str, ...]
    """Changes to the user's model, one sentence each."""
    narrowed: tuple[str, ...]
    """The ranges that the servos' own are narrower than, in words."""
    alone: dict[str, np.ndarray]
    """`BODY_FIELDS` and `JOINT_FIELDS` of the model that is the user's file compiled alone: of the
    bodies that the scene has too, and of the acting joints."""


def locate(mjcf: Path) -> Path:
    """Path of an MJCF file, which may be named by a Python package.

    `package:NAME/FILE` is a file of an installed package, and `menagerie:NAME` or
    `menagerie:NAME/ENTRY` a model of the package mujoco-menagerie, which downloads it on first use.

    Raises:
      UserError: the package, the model or the file is missing.
    """
    scheme, colon, name = str(mjcf).partition(":")
    if colon and scheme == "package":
        path = _in_package(name)
    elif colon and scheme == "menagerie":
        path = _in_menagerie(name)
    else:
        path = mjcf
    if not path.is_file():
        wrong = "is not a file" if path.exists() else "does not exist"
        raise UserError(f"the MJCF file {path} {wrong}; give the path of an MJCF file")
    return path


def _in_package(name: str) -> Path:
    package, _, file = name.partition("/")
    found = importlib.util.find_spec(package) if package.isidentifier() else None
    if found is None or not found.submodule_search_locations:
        words = _INSTALLED_AS.get(package) or (shorten(package.replace("_", "-")),)
        raise UserError(
            f"the package {shorten(package)!r} is not installed, which package:{shorten(name)} "
            f"names; install it with: {install_command(*words)}"
        )
    return Path(found.submodule_search_locations[0]) / file


def _in_menagerie(name: str) -> Path:
    with needed("mujoco-menagerie", "bounce_mjx[robots]"):
        import mujoco_menagerie
    robot, _, entry = name.partition("/")
    try:
        found = mujoco_menagerie.get(robot)
        return Path(found.xml(entry or found.default_model))
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        reason = reason_of(error)
        raise UserError(
            f"menagerie:{shorten(name)} cannot be loaded ({shorten(reason, 300)}); give a model of "
            "MuJoCo Menagerie, and connect to the network for its first use"
        ) from error


def build_arm(path: Path, config: RobotConfig) -> Arm:
    """Puts the arm of an MJCF file into the task's scene, with a paddle at its site.

    Raises:
      UserError: the file does not compile, or holds no arm that can do the task.
    """
    arm = read_spec(path)
    model = compile_spec(arm, path)
    check_numbers(model)
    with _compiling(path):
        return _Builder(arm, model, config).build()


def read_spec(path: Path) -> mujoco.MjSpec:
    """The spec of an MJCF file.

    Raises:
      UserError: the file is no MJCF.
    """
    with _compiling(path):
        spec = mujoco.MjSpec.from_file(str(path))
    # MuJoCo chooses the memory: with too little of it, a step ends the process.
    spec.memory = -1
    return spec


def compile_spec(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    """The compiled model of a spec that was read from a file.

    Raises:
      UserError: the file does not compile.
    """
    with _compiling(path):
        return spec.compile()


@contextlib.contextmanager
def _compiling(path: Path) -> Iterator[None]:
    """Names the file in MuJoCo's errors; without MuJoCo's warnings, which it also writes to a file:
    of the empty prefix of an attached arm, and of meshes."""
    earlier = mujoco.get_mju_user_warning()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mujoco.set_mju_user_warning(lambda text: None)
            yield
    except (ValueError, mujoco.FatalError) as error:
        reason = reason_of(error)
        raise UserError(f"the MJCF file {path} does not compile ({reason}); correct it") from error
    finally:
        mujoco.set_mju_user_warning(earlier)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Names an MJCF file in a `UserError` about its content, if the name is missing."""
    try:
        yield
    except UserError as error:
        named = str(path) in str(error)
        raise error if named else UserError(f"the MJCF file {path} has {error}") from error


def find_site(model: mujoco.MjModel, config: RobotConfig) -> tuple[int, np.ndarray, np.ndarray]:
    """The body that holds the paddle, and the site's position [3] and quaternion [4] in it.

    Raises:
      UserError: there is no such site or body.
    """
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, config.site)
    if site >= 0:
        return int(model.site_bodyid[site]), model.site_pos[site], model.site_quat[site]
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, config.site)
    if body > 0:
        return body, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    raise UserError(f"no site or body named {shorten(config.site)}; {_other_sites(model)}")


def _other_sites(model: mujoco.MjModel) -> str:
    """The remedy for a wrong site: the sites and bodies of the arm."""
    names = [model.site(i).name for i in range(model.nsite)]
    names += [model.body(i).name for i in range(1, model.nbody)]
    return f"give --site a site or body beyond {MIN_JOINTS} joints, of {_list(names, 80)}"


class _Builder:
    """The steps of one adoption; `_model` is the user's compiled model, whose ids are those of the
    spec's elements."""

    def __init__(self, arm: mujoco.MjSpec, model: mujoco.MjModel, config: RobotConfig):
        self._arm, self._model, self._config = arm, model, config
        self._changes: list[str] = []
        self._narrowed: list[str] = []

    def build(self) -> Arm:
        model = self._model
        end, position, quaternion = find_site(model, self._config)
        chain = [end]
        while parent := int(model.body_parentid[chain[0]]):
            chain.insert(0, parent)
        joints = self._acting_joints(chain)
        actuators = self._actuators(joints)
        servos = tuple(_servo(model, joint, actuators[joint]) for joint in joints)
        loose = self._loose_bodies(chain, joints, actuators)
        scene = read_spec(resource_path("mjcf/scene.xml"))
        holder, joint_names = self._rename(scene, end, joints, actuators)
        self._freeze_bodies()
        self._freeze_joints(joints, actuators)
        self._strip(joints, loose)
        self._disable_contacts_and_limits(joints)
        self._attach(scene, holder, position, quaternion)
        self._replace_servos(scene, joint_names)
        kept = [body for body in range(1, model.nbody) if not is_below(model, body, loose)]
        alone = {name: getattr(model, name)[kept] for name in BODY_FIELDS}
        alone |= {name: getattr(model, name)[joints] for name in JOINT_FIELDS}
        return Arm(
            spec=scene,
            joint_names=joint_names,
            servos=servos,
            changes=tuple(self._changes),
            narrowed=tuple(self._narrowed),
            alone=alone,
        )

    def _acting_joints(self, chain: list[int]) -> list[int]:
        model, given = self._model, self._config.joints
        on_chain = [j for j in range(model.njnt) if model.jnt_bodyid[j] in chain]
        balls = [j for j in on_chain if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_BALL]
        if balls:
            raise UserError(
                f"the ball joint {joint_name(model, balls[0])} in the arm; give an arm of hinges "
                "and slides"
            )
        names = {
            joint_name(model, j): j for j in on_chain if int(model.jnt_type[j]) in (_HINGE, _SLIDE)
        }
        site = shorten(self._config.site)
        for name in given or ():
            if name not in names:
                raise UserError(
                    f"no joint {shorten(name)} on the way to {site}; the joints there are "
                    f"{_list(names)}"
                )
        acting = [j for name, j in names.items() if given is None or name in given]
        if len(acting) < MIN_JOINTS:
            have = _list(joint_name(model, j) for j in acting)
            remedy = _other_sites(model) if given is None else "name more with --joints"
            raise UserError(
                f"too few joints to hold the paddle level and lift it: {len(acting)} ({have}) on "
                f"the way to {site}, where at least {MIN_JOINTS} must act; {remedy}"
            )
        return acting

    def _actuators(self, joints: list[int]) -> dict[int, int]:
        """The actuator of each joint that has one, and so of each acting joint."""
        model = self._model
        drives = joint_actuators(model)
        for joint in joints:
            name = joint_name(model, joint)
            if len(drives.get(joint, ())) > 1:
                raise UserError(f"several actuators on {name}; give it one")
        idle = [joint_name(model, joint) for joint in joints if joint not in drives]
        if idle:
            raise UserError(
                f"no actuator on {_list(idle)}; add a <position> or <motor> with a force limit, or "
                "name the acting joints with --joints"
            )
        return {joint: actuators[-1] for joint, actuators in drives.items()}

    def _loose_bodies(
        self, chain: list[int], joints: list[int], actuators: dict[int, int]
    ) -> list[int]:
        """The bodies to remove, each with all below it: a gripper's, which move on the links beyond
        the last acting joint, and objects that move in the world.

        Raises:
          UserError: the model has driven joints in addition to the arm.
        """
        model = self._model
        holders = [0, *chain[chain.index(model.jnt_bodyid[joints[-1]]) :]]
        moving = {*model.jnt_bodyid.tolist(), *np.flatnonzero(model.body_mocapid >= 0).tolist()}
        loose = [
            b
            for b in range(1, model.nbody)
            if b not in chain
            and model.body_parentid[b] in holders
            and any(is_below(model, body, [b]) for body in moving)
        ]
        gripper, owners = [b for b in loose if model.body_parentid[b]], model.jnt_bodyid.tolist()
        beside = [
            joint_name(model, j)
            for j in sorted(actuators)
            if owners[j] not in chain and not is_below(model, owners[j], gripper)
        ]
        if beside:
            raise UserError(
                f"{len(beside)} driven joints ({_list(beside)}) in addition to the arm "
                f"{_list(joint_name(model, j) for j in joints)}; give an MJCF with nothing but "
                "one arm on a fixed base"
            )
        return loose

    def _rename(
        self, scene: mujoco.MjSpec, end: int, joints: list[int], actuators: dict[int, int]
    ) -> tuple[str, tuple[str, ...]]:
        """Gives the arm's parts names that the task's scene does not use.

        Returns:
          The names of the body that holds the paddle, and of the acting joints.
        """
        arm = self._arm
        # Each access to a list of a spec walks through the whole spec.
        bodies, parts, drives = list(arm.bodies), list(arm.joints), list(arm.actuators)
        bodies[end].name = bodies[end].name or _free_name("end_effector", bodies)
        renamed = []
        for elements, others, added in (
            (bodies[1:], scene.bodies, {PADDLE_BODY_NAME}),
            (parts, scene.joints, set()),
            (list(arm.geoms), scene.geoms, {PADDLE_GEOM_NAME}),
        ):
            names = [other.name for other in others if other.name]
            reserved = added | {name + number for name in names for number in _BALL_NUMBERS}
            for element in elements:
                if element.name in reserved:
                    free_name = _free_name(element.name, elements, reserved)
                    renamed.append(f"{element.name} to {free_name}")
                    element.name = free_name
        if renamed:
            self._changes.append(f"renamed what the scene has too: {_list(renamed, most=20)}")
        for joint in joints:
            # An actuator finds its joint by the name.
            drives[actuators[joint]].target = parts[joint].name
        return bodies[end].name, tuple(parts[joint].name for joint in joints)

    def _freeze_bodies(self) -> None:
        """Gives the bodies of the spec the numbers of the compiled model.

        MuJoCo's compiler computes them from the whole file, with its units and settings. Compiled
        again in another scene, without its limits and with fewer parts, they would be others.
        """
        arm, model = self._arm, self._model
        for i, body in enumerate(list(arm.bodies)[1:], start=1):
            body.explicitinertial = True
            for field in BODY_FIELDS:
                setattr(body, field.removeprefix("body_"), getattr(model, field)[i])
            body.fullinertia[0] = np.nan
            # A body that the scene fuses would be turned by its angles in the scene's units.
            body.alt.type = body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
            if body.frame is not None:
                body.set_frame(body.parent.add_frame())
        arm.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
        arm.compiler.boundmass = arm.compiler.boundinertia = 0.0

    def _freeze_joints(self, joints: list[int], actuators: dict[int, int]) -> None:
        """Gives the acting joints and their actuators the numbers of the compiled model, as
        `_freeze_bodies`, and the joints the ranges that their servos reach."""
        model = self._model
        parts, drives = list(self._arm.joints), list(self._arm.actuators)
        for i in joints:
            actuator = actuators[i]
            dof = model.jnt_dofadr[i]
            gear = model.actuator_gear[actuator, 0]
            joint, drive = parts[i], drives[actuator]
            if np.any(joint.range) and not model.jnt_limited[i]:
                name = joint_name(model, i)
                self._changes.append(f"ignored the range of {name}, which is not limited")
            joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
            joint.range = self._reached_range(i, actuator)
            joint.springdamper = np.zeros(2)
            joint.stiffness[0] = model.jnt_stiffness[i]
            # The rotor moves with the joint, also where another servo replaces the actuator.
            joint.damping[0] = model.dof_damping[dof] + gear**2 * model.actuator_damping[actuator]
            joint.armature = model.dof_armature[dof] + gear**2 * model.actuator_armature[actuator]
            drive.damping[0] = 0.0
            drive.armature = 0.0
            drive.gainprm = model.actuator_gainprm[actuator]
            drive.biasprm = model.actuator_biasprm[actuator]
            drive.inheritrange = 0.0
            drive.ctrlrange = model.actuator_ctrlrange[model.actuator_ctrladr[actuator]]
        if self._narrowed:
            words = ", ".join(self._narrowed)
            self._changes.append(f"narrowed the ranges to what the servos reach: {words}")

    def _reached_range(self, joint: int, actuator: int) -> tuple[float, float]:
        """The joint's range, as far as its servo reaches; 0 and 0 without a range.

        Raises:
          UserError: the servo reaches nothing of it.
        """
        model, name = self._model, joint_name(self._model, joint)
        low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.inf, np.inf)
        least, greatest = _servo_range(model, actuator)
        reached_low, reached_high = max(low, least), min(high, greatest)
        if not reached_low < reached_high:
            raise UserError(
                f"the range {low:g} to {high:g} of {name}, but a servo that reaches {least:g} to "
                f"{greatest:g}; correct its ctrlrange"
            )
        if reached_low - low > _NARROWER or high - reached_high > _NARROWER:
            self._narrowed.append(
                f"{name} from {low:.4g} to {high:.4g} to {reached_low:.4g} to {reached_high:.4g}"
            )
        if np.isinf(reached_high):
            return 0.0, 0.0
        return reached_low, reached_high

    def _strip(self, joints: list[int], loose: list[int]) -> None:
        """Removes all but the arm, and fixes its base.

        Raises:
          UserError: an equality constraint or a tendon acts on the arm.
        """
        arm, model = self._arm, self._model
        bodies, parts = list(arm.bodies), list(arm.joints)
        acting = [parts[joint].name for joint in joints]
        still = (j for j in range(model.njnt) if not is_below(model, model.jnt_bodyid[j], loose))
        fixed = [parts[j] for j in still if j not in joints]
        tendons = [_tendon_words(model, i) for i in range(model.ntendon)]
        # With what acts on them, such as a gripper's tendons.
        self._remove("removed the grippers and loose objects", [bodies[b] for b in loose])
        self._remove("fixed the joints that do not act", fixed)
        couplings = [
            _constraint_words(equality)
            for equality in arm.equalities
            if _moves_with(model, equality.id, joints)
        ]
        couplings += [tendons[tendon.id] for tendon in arm.tendons]
        if couplings:
            raise UserError(
                f"the {couplings[0]} on the arm, so it is not a serial chain; remove it, or give a "
                "serial arm"
            )
        floors = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        elements = (
            *(*arm.keys, *arm.sensors, *arm.pairs, *arm.excludes, *arm.lights, *arm.cameras),
            *arm.equalities,
            *(actuator for actuator in arm.actuators if actuator.target not in acting),
            *(geom for geom in arm.geoms if geom.type in floors),
        )
        self._remove("removed what is not the arm", elements)

    def _remove(self, words: str, elements: Iterable) -> None:
        elements = list(elements)
        names = [element.name for element in elements]
        for element in elements:
            self._arm.delete(element)
        if elements:
            named = f": {_list(names)}" if any(names) else ""
            self._changes.append(f"{words} ({len(elements)}{named})")

    def _disable_contacts_and_limits(self, joints: list[int]) -> None:
        model = self._model
        if np.any((model.geom_contype != 0) & (model.geom_conaffinity != 0)):
            self._changes.append("turned off the arm's own contacts: only ball and paddle touch")
        for i, body in enumerate(self._arm.bodies):
            touching = [bool(geom.contype or geom.conaffinity) for geom in body.geoms]
            for geom, touches in zip(body.geoms, touching, strict=True):
                # Where a link has both kinds of shapes, the others are its picture. What stands in
                # the world, such as a table, is shown as it is.
                if touches and i > 0 and not all(touching):
                    geom.group = HIDDEN_GROUP
                geom.contype = geom.conaffinity = 0
        if np.any(model.jnt_limited[joints]):
            self._changes.append("made the joint limits act by clipping the servo targets")

    def _attach(
        self, scene: mujoco.MjSpec, holder: str, position: np.ndarray, quaternion: np.ndarray
    ) -> None:
        """Puts the arm into the scene, and the paddle on the body `holder`."""
        config, arm = self._config, self._arm
        differing = _differing_options(self._model.opt, scene.option)
        if differing:
            self._changes.append(f"replaced the physics options with the task's: {differing}")
        if np.any(self._model.dof_frictionloss):
            raise_solver_limits(scene.option)
        arm.option = scene.option
        scene.attach(arm, frame=scene.worldbody.add_frame(), prefix="")
        paddle = scene.body(holder).add_body(name=PADDLE_BODY_NAME, pos=position, quat=quaternion)
        _add_paddle(paddle, config, scene.default)
        ball = scene.geom("ball")
        ball.size[0], ball.mass = config.ball.radius, config.ball.mass
        size = " x ".join(f"{200 * h:.3g}" for h in config.paddle.half_size)
        self._changes.append(
            f"added a paddle of {size} cm and {config.paddle.mass:g} kg at {config.site}, and a "
            "ball"
        )

    def _replace_servos(self, scene: mujoco.MjSpec, names: tuple[str, ...]) -> None:
        """Replaces the actuators if the config has servos."""
        config = self._config
        settings = (config.servo_stiffness, config.servo_damping, config.servo_force_limit)
        if not any(settings):
            return
        counts = [len(numbers or ()) for numbers in settings]
        if set(counts) != {len(names)}:
            raise UserError(
                f"{len(names)} acting joints ({_list(names)}), but servo_stiffness, servo_damping "
                f"and servo_force_limit have {counts} numbers; give one of each for each joint"
            )
        for actuator in list(scene.actuators):
            scene.delete(actuator)
        for name, stiffness, damping, limit in zip(names, *settings, strict=True):
            joint = mujoco.mjtTrn.mjTRN_JOINT
            actuator = scene.add_actuator(name=f"servo/{name}", target=name, trntype=joint)
            actuator.set_to_position(kp=stiffness, kv=damping)
            if limit is not None:
                actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
                actuator.forcerange = [-limit, limit]
        self._changes.append("replaced the actuators with position servos")


def _add_paddle(paddle: mujoco.MjsBody, config: RobotConfig, default: mujoco.MjsDefault) -> None:
    """Adds the blade, with all the mass, and a handle for pictures to the paddle's body."""
    blade = config.paddle
    common = {"contype": 0, "conaffinity": 0, "friction": [0, 0, 0], "default": default}
    paddle.add_geom(
        name=PADDLE_GEOM_NAME,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=blade.half_size,
        pos=blade.position,
        quat=blade.quaternion,
        mass=blade.mass,
        rgba=[0.72, 0.05, 0.07, 1.0],
        **common,
    )
    length = _handle_length(blade)
    if length > 0.0:
        end = length * np.array(blade.position) / np.linalg.norm(blade.position)
        paddle.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0.0, 0.0, 0.0, *end],
            size=[_HANDLE_RADIUS, 0.0, 0.0],
            mass=0.0,
            group=2,
            rgba=[0.76, 0.57, 0.36, 1.0],
            **common,
        )


def _handle_length(blade: PaddleConfig) -> float:
    """Distance from the site to the centre of the handle's round end, which enters the blade by
    a quarter of its thickness, m."""
    distance = np.linalg.norm(blade.position)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.array(blade.quaternion))
    along = np.abs(np.array(blade.position) @ rotation.reshape(3, 3)) / max(distance, 1e-9)
    inside = np.min(blade.half_size / np.maximum(along, 1e-9))
    return float(distance - inside - _HANDLE_RADIUS + 0.5 * min(blade.half_size))


def _servo(model: mujoco.MjModel, joint: int, actuator: int) -> ServoSettings:
    """The actuator that drives a joint."""
    limit = _force_limit(model, joint, actuator)
    plain = model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
    if not (plain and is_position_servo(model, actuator)):
        return ServoSettings(None, None, limit)
    gear = float(model.actuator_gear[actuator, 0])
    return ServoSettings(
        float(model.actuator_gainprm[actuator, 0] * gear**2),
        float(-model.actuator_biasprm[actuator, 2] * gear**2) + 0.0,
        limit,
    )


def is_position_servo(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator's control, or its filtered or integrated one, is a target position."""
    gain, (offset, factor) = (
        model.actuator_gainprm[actuator, 0],
        model.actuator_biasprm[actuator, :2],
    )
    return bool(
        model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
        and gain > 0.0
        and offset == 0.0
        # Otherwise the joint would rest at another position than the control.
        and np.isclose(factor, -gain)
    )


def _servo_range(model: mujoco.MjModel, actuator: int) -> tuple[float, float]:
    """Joint positions that the targets of a position servo reach."""
    control = model.actuator_ctrladr[actuator]
    # The control of an integrator is a velocity.
    direct = model.actuator_dyntype[actuator] != mujoco.mjtDyn.mjDYN_INTEGRATOR
    if not (direct and is_position_servo(model, actuator) and model.actuator_ctrllimited[control]):
        return -np.inf, np.inf
    low, high = sorted(model.actuator_ctrlrange[control] / model.actuator_gear[actuator, 0])
    return float(low), float(high)


def _force_limit(model: mujoco.MjModel, joint: int, actuator: int) -> float | None:
    """Largest force of a joint's actuator, None for no limit: by the force range, by the control
    range of a plain motor, or by the joint's own limit."""
    m, a = model, actuator
    gear, gain = m.actuator_gear[a, 0], m.actuator_gainprm[a, 0]
    # A <pid> has several controls; the other arrays have one row for each actuator.
    control = m.actuator_ctrladr[a]
    is_motor = m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
    clipped = is_motor and m.actuator_ctrllimited[control]
    limit = np.inf
    for limited, name, span, factor in (
        (m.actuator_forcelimited[a], "forcerange", m.actuator_forcerange[a], gear),
        (clipped, "ctrlrange", m.actuator_ctrlrange[control], gear * gain),
        (m.jnt_actfrclimited[joint], "actuatorfrcrange", m.jnt_actfrcrange[joint], 1.0),
    ):
        low, high = map(float, span)
        if limited and not low < 0.0 < high:
            most = max(-low, high)
            raise UserError(
                f"the {name} {low:g} to {high:g} on {joint_name(model, joint)}, so its actuator "
                f"pushes one way only; give a range around 0, such as {-most:g} to {most:g}"
            )
        if limited:
            limit = min(limit, float(min(-low, high) * abs(factor)))
    return limit if np.isfinite(limit) else None


def joint_actuators(model: mujoco.MjModel) -> dict[int, list[int]]:
    """The actuators of each joint that has some, the joints in the model's order."""
    drives: dict[int, list[int]] = {}
    for actuator in range(model.nactuator):
        # For a hinge or a slide, both kinds of transmission are the same.
        if int(model.actuator_trntype[actuator]) in _JOINT_TRANSMISSIONS:
            joint = int(model.actuator_trnid[actuator, 0])
            drives.setdefault(joint, []).append(actuator)
    return dict(sorted(drives.items()))


def _free_name(name: str, elements: Iterable, reserved: Container[str] = ()) -> str:
    """A name of an arm's part that no other element has, and that is not reserved."""
    taken = {element.name for element in elements}
    while name in taken or name in reserved:
        name += "_of_arm"
    return name


def _constraint_words(equality: mujoco.MjsEquality) -> str:
    """An equality constraint in words: its name; without one, its kind and what it connects."""
    if equality.name:
        return f"equality constraint {equality.name}"
    kind = mujoco.mjtEq(equality.type).name.removeprefix("mjEQ_").lower()
    connected = _list((equality.name1, equality.name2))
    return f"unnamed equality constraint ({kind}: {connected})"


def _moves_with(model: mujoco.MjModel, constraint: int, joints: list[int]) -> bool:
    """Whether an equality constraint is one of the acting joints, or of a body that they move."""
    kinds = mujoco.mjtEq
    ends = [int(model.eq_obj1id[constraint]), int(model.eq_obj2id[constraint])]
    kind = kinds(model.eq_type[constraint])
    if kind == kinds.mjEQ_JOINT:
        return not set(joints).isdisjoint(ends)
    if kind not in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
        return True
    if model.eq_objtype[constraint] == mujoco.mjtObj.mjOBJ_SITE:
        ends = [int(model.site_bodyid[site]) for site in ends]
    moved = [int(model.jnt_bodyid[joint]) for joint in joints]
    return any(is_below(model, body, moved) for body in ends)


def _tendon_words(model: mujoco.MjModel, tendon: int) -> str:
    """A tendon in words: its name; without one, the joints that it couples."""
    name = model.tendon(tendon).name
    if name:
        return f"tendon {name}"
    wraps = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    joints = [
        joint_name(model, model.wrap_objid[i])
        for i in wraps
        if model.wrap_type[i] == mujoco.mjtWrap.mjWRAP_JOINT
    ]
    return f"unnamed tendon ({_list(joints) if joints else 'spatial'})"


def _differing_options(option: mujoco.MjOption, task: mujoco.MjOption) -> str:
    """The options of a file that change where an arm moves and that differ from the task's."""
    differing = []
    if option.integrator != task.integrator:
        integrator = mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_")
        differing.append(f"the integrator {integrator.lower()}")
    for name in ("gravity", "wind", "density", "viscosity"):
        value = np.asarray(getattr(option, name))
        if not np.allclose(value, getattr(task, name), atol=1e-2 if name == "gravity" else 0.0):
            differing.append(f"{name} {np.round(value, 6).tolist()}")
    return ", ".join(differing)


def is_below(model: mujoco.MjModel, body: int, ancestors: list[int]) -> bool:
    while body and body not in ancestors:
        body = int(model.body_parentid[body])
    return body in ancestors


def raise_solver_limits(option: mujoco.MjOption) -> None:
    """Raises the limits of MuJoCo's solver to MuJoCo's defaults, in place.

    The shipped limits suffice for one frictionless contact. With dry friction or several contacts,
    the solver would stop before it converges.
    """
    default = mujoco.MjOption()
    option.iterations = max(option.iterations, default.iterations)
    option.ls_iterations = max(option.ls_iterations, default.ls_iterations)


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Name of a joint; an unnamed joint has its index for a name."""
    return model.joint(joint).name or f"joint{joint}"


def _list(names: Iterable[str], most: int = 8) -> str:
    """Names with commas; a long list is cut."""
    names = [name for name in names if name]
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(shorten(name, 40) for name in names[:most]) or "none") + more
