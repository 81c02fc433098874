"""Adoption of an arm: from any MJCF with a serial arm in it to the task's scene, with MjSpec.

Every change to the user's model is collected as one sentence.
"""

import contextlib
import importlib.util
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.errors import UserError, install_command, needed, reason_of, shorten
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.config import PaddleConfig, RobotConfig

BALL_BODY_NAME = "ball_link"
PADDLE_GEOM_NAME = "blocker"
# Lifting and tilting the paddle about two axes takes three joints.
MIN_JOINTS = 3

PADDLE_BODY_NAME = "paddle"
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
    with _compiling(path):
        return _Builder(arm, model, config).build()


def read_spec(path: Path) -> mujoco.MjSpec:
    """The spec of an MJCF file.

    Raises:
      UserError: the file is no MJCF.
    """
    with _compiling(path):
        return mujoco.MjSpec.from_file(str(path))


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

    def build(self) -> Arm:
        model = self._model
        end, position, quaternion = find_site(model, self._config)
        chain = [end]
        while parent := int(model.body_parentid[chain[0]]):
            chain.insert(0, parent)
        joints = self._acting_joints(chain)
        actuators = self._actuators(joints)
        servos = tuple(_servo(model, j, actuators[j]) for j in joints)
        names = tuple(joint_name(model, j) for j in joints)
        holder = self._arm.bodies[end]
        holder.name = holder.name or "end_effector"
        loose = self._loose_bodies(chain, joints, actuators)
        self._freeze(joints, actuators)
        self._strip(joints, loose)
        self._disable_contacts_and_limits(joints)
        scene = self._attach(holder.name, position, quaternion)
        self._replace_servos(scene, names)
        kept = [b for b in range(1, model.nbody) if not is_below(model, b, loose)]
        alone = {name: getattr(model, name)[kept] for name in BODY_FIELDS}
        alone |= {name: getattr(model, name)[joints] for name in JOINT_FIELDS}
        return Arm(scene, names, servos, tuple(self._changes), alone)

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
        model, actuators = self._model, {}
        for a in range(model.nactuator):
            joint = int(model.actuator_trnid[a, 0])
            if int(model.actuator_trntype[a]) in _JOINT_TRANSMISSIONS:
                if joint in joints and joint in actuators:
                    raise UserError(f"several actuators on {joint_name(model, joint)}; give it one")
                actuators[joint] = a
        idle = [joint_name(model, joint) for joint in joints if joint not in actuators]
        if idle:
            raise UserError(
                f"no actuator on {_list(idle)}; add a <position> or <motor> with a force limit, or "
                "name the acting joints with --joints"
            )
        return actuators

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

    def _freeze(self, joints: list[int], actuators: dict[int, int]) -> None:
        """Gives the spec the numbers of the compiled model.

        MuJoCo's compiler computes them from the whole file, with its units and settings. Compiled
        again in another scene, without its limits and with fewer parts, they would be others.
        """
        arm, model = self._arm, self._model
        # Each access to a list of a spec walks through the whole spec.
        bodies, parts, drives = list(arm.bodies), list(arm.joints), list(arm.actuators)
        for i, body in enumerate(bodies[1:], start=1):
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
        narrowed: list[str] = []
        for i in joints:
            a, joint, dof = actuators[i], parts[i], model.jnt_dofadr[i]
            own = model.jnt_range[i] if model.jnt_limited[i] else (-np.inf, np.inf)
            least, greatest = _servo_range(model, a)
            low, high = max(own[0], least), min(own[1], greatest)
            if not low < high:
                raise UserError(
                    f"the range {own[0]:g} to {own[1]:g} of {joint_name(model, i)}, but a servo "
                    f"that reaches {least:g} to {greatest:g}; correct its ctrlrange"
                )
            if low - own[0] > _NARROWER or own[1] - high > _NARROWER:
                narrowed.append(joint_name(model, i))
            joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
            joint.range = (low, high) if high < np.inf else np.zeros(2)
            joint.springdamper = np.zeros(2)
            # The rotor moves with the joint, also where another servo replaces the actuator.
            gear, drive = model.actuator_gear[a, 0], drives[a]
            joint.stiffness[0] = model.jnt_stiffness[i]
            joint.damping[0] = model.dof_damping[dof] + gear**2 * model.actuator_damping[a]
            joint.armature = model.dof_armature[dof] + gear**2 * model.actuator_armature[a]
            drive.armature, drive.damping[0] = 0.0, 0.0
            drive.gainprm, drive.biasprm = model.actuator_gainprm[a], model.actuator_biasprm[a]
            drive.inheritrange = 0.0
            drive.ctrlrange = model.actuator_ctrlrange[model.actuator_ctrladr[a]]
        if narrowed:
            self._changes.append(f"narrowed the ranges to what the servos reach: {_list(narrowed)}")

    def _strip(self, joints: list[int], loose: list[int]) -> None:
        """Removes all but the arm, and fixes its base.

        Raises:
          UserError: an equality constraint or a tendon acts on the arm.
        """
        arm, model = self._arm, self._model
        bodies, parts = list(arm.bodies), list(arm.joints)
        names = [parts[j].name for j in joints]
        still = (j for j in range(model.njnt) if not is_below(model, model.jnt_bodyid[j], loose))
        fixed = [parts[j] for j in still if j not in joints]
        # With what acts on them, such as a gripper's tendons.
        self._remove("removed the grippers and loose objects", [bodies[b] for b in loose])
        self._remove("fixed the joints that do not act", fixed)
        for noun, found in (("equality constraint", arm.equalities), ("tendon", arm.tendons)):
            if found:
                raise UserError(
                    f"the {noun} {found[0].name} on the arm, so it is not a serial chain; remove "
                    "it, or give a serial arm"
                )
        floors = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        elements = (
            *(*arm.keys, *arm.sensors, *arm.pairs, *arm.excludes, *arm.lights, *arm.cameras),
            *(actuator for actuator in arm.actuators if actuator.target not in names),
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
        for body in self._arm.bodies[1:]:
            touching = [bool(geom.contype or geom.conaffinity) for geom in body.geoms]
            for geom, touches in zip(body.geoms, touching, strict=True):
                # Where a link has both kinds of shapes, the others are its picture.
                if touches and not all(touching):
                    geom.group = HIDDEN_GROUP
                geom.contype = geom.conaffinity = 0
        if np.any(model.jnt_limited[joints]):
            self._changes.append("made the joint limits act by clipping the servo targets")

    def _attach(self, holder: str, position: np.ndarray, quaternion: np.ndarray) -> mujoco.MjSpec:
        """The scene with the arm, and the paddle on the body `holder`."""
        config, arm = self._config, self._arm
        scene = read_spec(resource_path("mjcf/scene.xml"))
        self._changes.append("replaced the physics options with the task's")
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
        return scene

    def _replace_servos(self, scene: mujoco.MjSpec, names: tuple[str, ...]) -> None:
        """Replaces the actuators if the config has servos."""
        config = self._config
        settings = config.servo_stiffness, config.servo_damping, config.servo_force_limit
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
