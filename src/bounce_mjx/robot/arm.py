"""An arm's MJCF in the task's scene, with MjSpec; `adopt.py` searches its settings.

Every change by which the arm moves otherwise than in the user's file is collected (`Arm.changes`),
which `commands.adopt` prints. A gripper goes whole: what couples its own parts is not named.
"""

import contextlib
import importlib.util
import warnings
from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import mujoco
import numpy as np

from bounce_mjx.errors import UserError, install_command, needed, reason_of, shorten
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.actuators import (
    ACTING_KINDS,
    JOINT_TRANSMISSIONS,
    ServoSettings,
    joint_actuators,
    servo_range,
    servo_settings,
    single_actuators,
)
from bounce_mjx.robot.config import PaddleConfig, RobotConfig
from bounce_mjx.robot.names import (
    BALL_NUMBERS,
    PADDLE_BODY_NAME,
    PADDLE_GEOM_NAME,
    joint_name,
    listed,
)
from bounce_mjx.robot.numbers import WORLD_OPTIONS, check_numbers

# Lifting and tilting the paddle about two axes takes three joints.
MIN_JOINTS = 3

BODY_FIELDS = ("body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia")
JOINT_FIELDS = ("jnt_pos", "jnt_axis")
# Viewers show the groups 0 to 2. Where a link has a picture, this is the group of the shapes that
# touch, and of no other shape of an adopted arm.
HIDDEN_GROUP = 3
_ALSO_HIDDEN_GROUP = 5
# Smallest change of a joint's range that is reported, rad or m.
_NARROWER = 1e-3
_HANDLE_RADIUS = 0.011
# Flags that change how an arm moves where a file disables them; contacts are turned off anyway.
_FLAGS = "constraint frictionloss limit spring damper gravity clampctrl actuation".split()
_URDF = ".urdf"
# How pip installs a package that brings MJCF files, where its name alone is not enough: robosuite
# without what only its simulations need, at the version whose files have the paths of our configs.
_INSTALLED_AS = {"robosuite": ("--no-deps", "robosuite==1.5.2")}


class _End(NamedTuple):
    """A part on which an equality constraint or a tendon acts."""

    kind: mujoco.mjtObj
    index: int


# The parts along a tendon.
_WRAPPED = {
    mujoco.mjtWrap.mjWRAP_JOINT: mujoco.mjtObj.mjOBJ_JOINT,
    mujoco.mjtWrap.mjWRAP_SITE: mujoco.mjtObj.mjOBJ_SITE,
    mujoco.mjtWrap.mjWRAP_SPHERE: mujoco.mjtObj.mjOBJ_GEOM,
    mujoco.mjtWrap.mjWRAP_CYLINDER: mujoco.mjtObj.mjOBJ_GEOM,
}


class Arm(NamedTuple):
    """An arm in the task's scene."""

    spec: mujoco.MjSpec
    joint_names: tuple[str, ...]
    """The acting joints, from the base to the paddle."""
    actuators: tuple[ServoSettings, ...]
    """The file's own actuator of each acting joint, a servo or another one."""
    changes: tuple[str, ...]
    """Changes to the user's model, a phrase each."""
    narrowed: tuple[str, ...]
    """The joints whose range a servo's ctrlrange narrows, in words."""
    file_numbers: dict[str, np.ndarray]
    """`BODY_FIELDS` and `JOINT_FIELDS` of the user's file compiled alone: of the bodies that the
    scene has too, and of the acting joints."""
    velocities: tuple[float, ...] | None
    """Limit of each acting joint's velocity that a URDF states, rad/s or m/s, which MuJoCo does not
    read; None of another file, or if a joint has none."""


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
        raise UserError(f"{title(path)} {wrong}; give the path of an MJCF file")
    return path


def _in_package(name: str) -> Path:
    package, _, file = name.partition("/")
    spec = importlib.util.find_spec(package) if package.isidentifier() else None
    if spec is None or not spec.submodule_search_locations:
        words = _INSTALLED_AS.get(package) or (shorten(package.replace("_", "-")),)
        raise UserError(
            f"the package {shorten(package)!r} is not installed as a folder, which package:"
            f"{shorten(name)} names; install it with: {install_command(*words)}"
        )
    return Path(spec.submodule_search_locations[0]) / file


def _in_menagerie(name: str) -> Path:
    with needed("mujoco-menagerie", "bounce_mjx[robots]"):
        import mujoco_menagerie
    robot, _, entry = name.partition("/")
    try:
        model = mujoco_menagerie.get(robot)
        return Path(model.xml(entry or model.default_model))
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
    spec = read_spec(path)
    if path.suffix.lower() == _URDF:
        # A flange is a link that is fixed to the last one, which MuJoCo would take out.
        spec.compiler.fusestatic = False
    model = compile_spec(spec, path)
    changes = []
    if model.nu == 0 and (driven := _drive(spec, model)):
        changes.append(
            "gave each joint an actuator within its own force limit, as the file has none "
            f"({len(driven)}: {listed(driven)})"
        )
        model = compile_spec(spec, path)
    check_numbers(model)
    with _compiling(path):
        arm = _Builder(spec, model, config, changes).build()
    return arm._replace(velocities=_stated_velocities(path, arm.joint_names))


def _stated_velocities(path: Path, joint_names: Sequence[str]) -> tuple[float, ...] | None:
    """`Arm.velocities` of a file."""
    if path.suffix.lower() != _URDF:
        return None
    stated = {}
    for joint in ElementTree.parse(path).getroot().iter("joint"):
        limit = joint.find("limit")
        if limit is not None:
            stated[joint.get("name")] = float(limit.get("velocity", 0.0))
    velocities = tuple(stated.get(name, 0.0) for name in joint_names)
    return velocities if all(velocities) else None


def _drive(spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[str]:
    """Adds a motor to each hinge and slide with a force limit of its own, such as a URDF's effort;
    their names."""
    driven = []
    for joint in range(model.njnt):
        name = model.joint(joint).name
        is_acting = int(model.jnt_type[joint]) in ACTING_KINDS
        if name and is_acting and model.jnt_actfrclimited[joint]:
            motor = spec.add_actuator(target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.set_to_motor()
            driven.append(name)
    return driven


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
        is_missing = "opening file" in reason
        remedy = "put the file there" if is_missing else "correct it"
        raise UserError(f"{title(path)} does not compile ({reason}); {remedy}") from error
    finally:
        mujoco.set_mju_user_warning(earlier)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Names an MJCF file in a `UserError` about its content, if the name is missing."""
    try:
        yield
    except UserError as error:
        if str(path) in str(error):
            raise
        raise UserError(f"{title(path)} has {error}") from error


def title(path: Path) -> str:
    """A file by its kind."""
    return f"the {'URDF' if path.suffix.lower() == _URDF else 'MJCF'} file {path}"


def find_site(model: mujoco.MjModel, config: RobotConfig) -> tuple[int, np.ndarray, np.ndarray]:
    """The body that holds the paddle, and the site's position [3] and quaternion [4] in it. Of a
    site and a body with the name, it is the site.

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
    return f"give --site a site or body beyond {MIN_JOINTS} joints, of {listed(names, 80)}"


class _Builder:
    """The steps of one adoption.

    `_spec` is the user's file, and `_model` as MuJoCo compiles it. The model's ids are places in
    the lists of the spec until the first element is deleted, in `_strip`, as compiling also takes
    the bodies that it fuses out of the spec.
    """

    def __init__(
        self,
        spec: mujoco.MjSpec,
        model: mujoco.MjModel,
        config: RobotConfig,
        changes: Iterable[str],
    ):
        """Begins with the changes that were made to the spec before it was compiled."""
        self._spec = spec
        self._model = model
        self._config = config
        self._changes = list(changes)
        self._narrowed: list[str] = []

    def build(self) -> Arm:
        model = self._model
        holder, position, quaternion = find_site(model, self._config)
        chain = _chain_to(model, holder)
        joints = self._acting_joints(chain)
        actuators = self._actuators(joints)
        settings = tuple(servo_settings(model, joint, actuators[joint]) for joint in joints)
        loose = self._loose_bodies(chain, joints)
        couplings = self._couplings_with_loose(joints, loose)
        file_numbers = self._numbers_in_file(joints, loose)
        scene = read_spec(resource_path("mjcf/scene.xml"))
        self._rename(scene, holder)
        holder_name, joint_names = self._bind_names(holder, joints, actuators)
        self._freeze_bodies()
        self._freeze_joints(joints, actuators)
        self._strip(joints, loose, couplings)
        self._disable_contacts(joints)
        self._reset_idle_settings()
        self._attach(scene, holder_name, position, quaternion)
        self._replace_servos(scene, joint_names)
        return Arm(
            spec=scene,
            joint_names=joint_names,
            actuators=settings,
            changes=tuple(self._changes),
            narrowed=tuple(self._narrowed),
            file_numbers=file_numbers,
            velocities=None,
        )

    def _acting_joints(self, chain: list[int]) -> list[int]:
        """The joints that act: those of the config, or each hinge and slide on the chain.

        Raises:
          UserError: they are too few or not on the chain, or a ball joint is on it.
        """
        joints_by_name = self._joints_on(chain)
        chosen = self._config.joints
        site = shorten(self._config.site)
        for name in chosen or ():
            if name not in joints_by_name:
                raise UserError(
                    f"no joint {shorten(name)} on the way to {site}; the joints there are "
                    f"{listed(joints_by_name)}"
                )
        acting = {}
        for name, joint in joints_by_name.items():
            if chosen is None or name in chosen:
                acting[name] = joint
        if len(acting) < MIN_JOINTS:
            remedy = "name more with --joints"
            if chosen is None:
                remedy = _other_sites(self._model)
            raise UserError(
                f"too few joints to hold the paddle level and lift it: {len(acting)} "
                f"({listed(acting)}) on the way to {site}, where at least {MIN_JOINTS} must act; "
                f"{remedy}"
            )
        return list(acting.values())

    def _joints_on(self, chain: list[int]) -> dict[str, int]:
        """The hinges and slides of a chain of bodies, by their names.

        Raises:
          UserError: it has a ball joint, or an unnamed joint whose stand-in name another joint has.
        """
        model = self._model
        joints = {}
        for joint in range(model.njnt):
            if model.jnt_bodyid[joint] not in chain:
                continue
            name = joint_name(model, joint)
            kind = int(model.jnt_type[joint])
            if kind == mujoco.mjtJoint.mjJNT_BALL:
                raise UserError(
                    f"the ball joint {name} in the arm; give an arm of hinges and slides"
                )
            if name in joints:
                raise UserError(
                    f"an unnamed joint that would be called {name}, as another one is; name all "
                    "joints of the arm"
                )
            if kind in ACTING_KINDS:
                joints[name] = joint
        return joints

    def _actuators(self, joints: list[int]) -> dict[int, int]:
        """The actuator of each acting joint.

        Raises:
          UserError: a joint has none, or several.
        """
        actuators = single_actuators(self._model, joints)
        idle = [joint_name(self._model, joint) for joint in joints if joint not in actuators]
        if idle:
            raise UserError(
                f"no actuator on {listed(idle)}; add a <position> or <motor> with a force limit "
                "(to a URDF, an effort), or name the acting joints with --joints"
            )
        return actuators

    def _loose_bodies(self, chain: list[int], joints: list[int]) -> list[int]:
        """The bodies to remove, each with all below it: a gripper's, which move on the links beyond
        the last acting joint, and objects that move in the world.

        Raises:
          UserError: the model has driven joints in addition to the arm.
        """
        model = self._model
        last_link = chain.index(model.jnt_bodyid[joints[-1]])
        holders = [0, *chain[last_link:]]
        jointed = set(model.jnt_bodyid.tolist())
        mocap = set(np.flatnonzero(model.body_mocapid >= 0).tolist())
        moving = jointed | mocap
        loose = []
        for body in range(1, model.nbody):
            is_held = model.body_parentid[body] in holders and body not in chain
            if is_held and any(is_below(model, other, [body]) for other in moving):
                loose.append(body)
        gripper = [body for body in loose if model.body_parentid[body]]
        self._check_driven(chain, joints, gripper)
        return loose

    def _check_driven(self, chain: list[int], joints: list[int], gripper: list[int]) -> None:
        """Refuses driven joints that are neither the arm's nor a gripper's."""
        model = self._model
        beside = []
        for joint in joint_actuators(model):
            body = int(model.jnt_bodyid[joint])
            if body not in chain and not is_below(model, body, gripper):
                beside.append(joint_name(model, joint))
        if beside:
            arm_joints = listed(joint_name(model, joint) for joint in joints)
            raise UserError(
                f"{len(beside)} driven joints ({listed(beside)}) in addition to the arm "
                f"{arm_joints}; give an MJCF with nothing but one arm on a fixed base"
            )

    def _couplings_with_loose(self, joints: list[int], loose: list[int]) -> list[str]:
        """The equality constraints and tendons between the arm and a loose body, in words: they go
        with that body, such as a gripper's tendon or a mocap body's weld.

        Raises:
          UserError: one couples the arm otherwise: with itself, or with the world, from which a rod
            of a linkage hangs.
        """
        model = self._model
        couplings = []
        for constraint, equality in enumerate(self._spec.equalities):
            # One that is off couples nothing, and goes with what is not the arm.
            if not model.eq_active0[constraint]:
                continue
            couplings.append((_constraint_words(equality), _ends_of_constraint(model, constraint)))
        for tendon in range(model.ntendon):
            couplings.append((_tendon_words(model, tendon), _ends_of_tendon(model, tendon)))
        with_loose = []
        for words, ends in couplings:
            if ends is not None and not _acts_on_arm(model, ends, joints, loose):
                continue
            if ends is None or not _lets_go(model, ends, joints, loose):
                raise UserError(
                    f"the {words} on the arm, so it is not a serial chain; remove it, or give a "
                    "serial arm"
                )
            with_loose.append(words)
        return with_loose

    def _numbers_in_file(self, joints: list[int], loose: list[int]) -> dict[str, np.ndarray]:
        """`Arm.file_numbers`."""
        model = self._model
        kept = [body for body in range(1, model.nbody) if not is_below(model, body, loose)]
        numbers = {field: getattr(model, field)[kept] for field in BODY_FIELDS}
        for field in JOINT_FIELDS:
            numbers[field] = getattr(model, field)[joints]
        return numbers

    def _rename(self, scene: mujoco.MjSpec, holder: int) -> None:
        """Gives the arm's parts names that the task's scene does not use, and the body that holds
        the paddle a name."""
        spec = self._spec
        # Each access to a list of a spec walks through the whole spec.
        bodies = list(spec.bodies)
        if not bodies[holder].name:
            bodies[holder].name = _free_name("end_effector", bodies)
        renamed = _rename_beside(bodies[1:], scene.bodies, PADDLE_BODY_NAME)
        renamed += _rename_beside(list(spec.joints), scene.joints)
        renamed += _rename_beside(list(spec.geoms), scene.geoms, PADDLE_GEOM_NAME)
        if renamed:
            self._changes.append(f"renamed what the scene has too: {listed(renamed, most=20)}")

    def _bind_names(
        self, holder: int, joints: list[int], actuators: dict[int, int]
    ) -> tuple[str, tuple[str, ...]]:
        """Binds the actuators to the joints' new names; returns the names of the body that holds
        the paddle, and of the acting joints."""
        spec_joints = list(self._spec.joints)
        spec_actuators = list(self._spec.actuators)
        for joint in joints:
            spec_actuators[actuators[joint]].target = spec_joints[joint].name
        names = tuple(spec_joints[joint].name for joint in joints)
        return list(self._spec.bodies)[holder].name, names

    def _freeze_bodies(self) -> None:
        """Gives the bodies of the spec the numbers of the compiled model.

        MuJoCo's compiler computes them from the whole file, with its units and settings. Compiled
        again in another scene, without its limits and with fewer parts, they would be others.
        """
        compiler = self._spec.compiler
        for i, body in enumerate(list(self._spec.bodies)[1:], start=1):
            body.explicitinertial = True
            for field in BODY_FIELDS:
                setattr(body, field.removeprefix("body_"), getattr(self._model, field)[i])
            # The sign of a body without a fullinertia: MuJoCo refuses one beside an inertia.
            body.fullinertia[0] = np.nan
            # A body that the scene fuses would be turned by its angles in the scene's units.
            body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
            body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
            # The compiled pose has the frame's in it.
            if body.frame is not None:
                body.set_frame(body.parent.add_frame())
        compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
        compiler.boundmass = 0.0
        compiler.boundinertia = 0.0

    def _freeze_joints(self, joints: list[int], actuators: dict[int, int]) -> None:
        """Gives the acting joints and their actuators those numbers of the compiled model that
        would change in the scene, as `_freeze_bodies`, and the joints the ranges that the file's
        servos reach: also where other servos replace these, as the robot's controller has that
        range. MuJoCo computes the others (pos, axis, ref, springref) as in the file."""
        spec_joints = list(self._spec.joints)
        spec_actuators = list(self._spec.actuators)
        for joint in joints:
            actuator = actuators[joint]
            self._freeze_joint(spec_joints[joint], joint, actuator)
            self._freeze_actuator(spec_actuators[actuator], actuator)
        if self._narrowed:
            ranges = ", ".join(self._narrowed)
            self._changes.append(f"narrowed the ranges to what the servos reach: {ranges}")

    def _freeze_joint(self, spec_joint: mujoco.MjsJoint, joint: int, actuator: int) -> None:
        model = self._model
        if np.any(spec_joint.range) and not model.jnt_limited[joint]:
            name = joint_name(model, joint)
            self._changes.append(f"ignored the range of {name}, which is not limited")
        spec_joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        # In radians, also in a file in degrees: MuJoCo converts a limited joint's range alone.
        spec_joint.range = self._reached_range(joint, actuator)
        spec_joint.springdamper = np.zeros(2)
        spec_joint.stiffness[0] = model.jnt_stiffness[joint]
        dof = model.jnt_dofadr[joint]
        # The rotor moves with the joint, also where another servo replaces the actuator.
        squared_gear = model.actuator_gear[actuator, 0] ** 2
        rotor_damping = squared_gear * model.actuator_damping[actuator]
        rotor_inertia = squared_gear * model.actuator_armature[actuator]
        spec_joint.damping[0] = model.dof_damping[dof] + rotor_damping
        spec_joint.armature = model.dof_armature[dof] + rotor_inertia

    def _freeze_actuator(self, spec_actuator: mujoco.MjsActuator, actuator: int) -> None:
        model = self._model
        # The joint has them.
        spec_actuator.damping[0] = 0.0
        spec_actuator.armature = 0.0
        spec_actuator.gainprm = model.actuator_gainprm[actuator]
        spec_actuator.biasprm = model.actuator_biasprm[actuator]
        spec_actuator.inheritrange = 0.0
        spec_actuator.ctrlrange = model.actuator_ctrlrange[model.actuator_ctrladr[actuator]]

    def _reached_range(self, joint: int, actuator: int) -> tuple[float, float]:
        """The joint's range, as far as its servo reaches; 0 and 0 without a range.

        Raises:
          UserError: the servo reaches nothing of it.
        """
        model = self._model
        name = joint_name(model, joint)
        low, high = -np.inf, np.inf
        if model.jnt_limited[joint]:
            low, high = model.jnt_range[joint]
        least, greatest = servo_range(model, actuator)
        reached_low = max(low, least)
        reached_high = min(high, greatest)
        if not reached_low < reached_high:
            raise UserError(
                f"the range {low:g} to {high:g} of {name}, but a servo that reaches {least:g} to "
                f"{greatest:g}; correct its ctrlrange"
            )
        if reached_low - low > _NARROWER or high - reached_high > _NARROWER:
            self._narrowed.append(
                f"{name} from {low:.4g} to {high:.4g} to {reached_low:.4g} to {reached_high:.4g}"
            )
        # Both ends are infinite, or none.
        if np.isinf(reached_high):
            return 0.0, 0.0
        return reached_low, reached_high

    def _strip(self, joints: list[int], loose: list[int], couplings: list[str]) -> None:
        """Removes all but the arm; without its free joint, a base is fixed."""
        spec = self._spec
        model = self._model
        # The model's ids are places in the spec's lists until the first deletion.
        bodies = list(spec.bodies)
        spec_joints = list(spec.joints)
        acting_names = [spec_joints[joint].name for joint in joints]
        idle = []
        for joint, spec_joint in enumerate(spec_joints):
            is_loose = is_below(model, model.jnt_bodyid[joint], loose)
            if joint not in joints and not is_loose:
                idle.append(spec_joint)
        # MuJoCo deletes a body with what refers to it, such as a gripper's tendons.
        self._remove("removed the grippers and loose objects", [bodies[body] for body in loose])
        if couplings:
            self._changes.append(f"removed what couples the arm with these: {', '.join(couplings)}")
        self._remove("fixed the joints that do not act", idle)
        others = list(spec.keys)
        for elements in (spec.sensors, spec.pairs, spec.excludes, spec.lights, spec.cameras):
            others += elements
        others += spec.equalities
        for actuator in spec.actuators:
            drives_joint = int(actuator.trntype) in JOINT_TRANSMISSIONS
            if not (drives_joint and actuator.target in acting_names):
                others.append(actuator)
        others += spec.tendons
        floors = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        others += [geom for geom in spec.geoms if geom.type in floors]
        self._remove("removed what is not the arm", others)

    def _remove(self, words: str, elements: Iterable) -> None:
        elements = list(elements)
        names = [element.name for element in elements]
        for element in elements:
            self._spec.delete(element)
        if elements:
            named = f": {listed(names)}" if any(names) else ""
            self._changes.append(f"{words} ({len(elements)}{named})")

    def _disable_contacts(self, joints: list[int]) -> None:
        arm_touches = False
        for i, body in enumerate(self._spec.bodies):
            touching = [bool(geom.contype or geom.conaffinity) for geom in body.geoms]
            arm_touches = arm_touches or any(touching)
            for geom, touches in zip(body.geoms, touching, strict=True):
                # Where a link has both kinds of shapes, the others are its picture. What stands in
                # the world, such as a table, is shown as it is.
                if touches and i > 0 and not all(touching):
                    geom.group = HIDDEN_GROUP
                elif geom.group == HIDDEN_GROUP:
                    geom.group = _ALSO_HIDDEN_GROUP
                geom.contype = 0
                geom.conaffinity = 0
        if arm_touches:
            self._changes.append("turned off the arm's own contacts: only ball and paddle touch")
        if np.any(self._model.jnt_limited[joints]):
            self._changes.append("made the joint limits act by clipping the servo targets")

    def _reset_idle_settings(self) -> None:
        """Gives settings of what cannot act in the scene MuJoCo's defaults, so that none of them
        can be what an engine lacks: of contacts and limits, and of dry friction where there is
        none."""
        kinds = {
            "geoms": (list(self._spec.geoms), ("solref", "solimp")),
            "joints": (list(self._spec.joints), ("solref_limit", "solimp_limit")),
            "joints without dry friction": (
                [joint for joint in self._spec.joints if not joint.frictionloss],
                ("solref_friction", "solimp_friction"),
            ),
        }
        default = mujoco.MjSpec().worldbody.add_body()
        plain_geom = default.add_geom()
        plain_joint = default.add_joint()
        for words, (elements, names) in kinds.items():
            plain = plain_geom if words == "geoms" else plain_joint
            for name in names:
                own = np.array(getattr(plain, name))
                changed = [x for x in elements if not np.array_equal(getattr(x, name), own)]
                for element in changed:
                    setattr(element, name, own)
                if changed:
                    attribute = name.replace("_", "")
                    self._changes.append(
                        f"reset the {attribute} of {words} ({len(changed)}), where it cannot act"
                    )

    def _attach(
        self, scene: mujoco.MjSpec, holder: str, position: np.ndarray, quaternion: np.ndarray
    ) -> None:
        """Puts the arm into the scene, and the paddle on its body `holder`.

        Args:
          scene: to which the arm is attached, with the task's options in place of the file's.
          holder: name of the body.
          position: of the site in the body [3], m.
          quaternion: of the site in the body [4].
        """
        config = self._config
        differing = _differing_options(self._model.opt, scene.option)
        if differing:
            self._changes.append(f"replaced the physics options with the task's: {differing}")
        if np.any(self._model.dof_frictionloss):
            raise_solver_limits(scene.option)
        self._spec.option = scene.option
        scene.attach(self._spec, frame=scene.worldbody.add_frame(), prefix="")
        paddle = scene.body(holder).add_body(name=PADDLE_BODY_NAME, pos=position, quat=quaternion)
        _add_paddle(paddle, config.paddle, scene.default)
        ball = scene.geom("ball")
        ball.size[0] = config.ball.radius
        ball.mass = config.ball.mass
        size = " x ".join(f"{200 * half_size:.3g}" for half_size in config.paddle.half_size)
        self._changes.append(
            f"added a paddle of {size} cm and {config.paddle.mass:g} kg at {config.site}, and a "
            "ball"
        )

    def _replace_servos(self, scene: mujoco.MjSpec, names: tuple[str, ...]) -> None:
        """Replaces the actuators of the joints with these names if the config has servos."""
        config = self._config
        settings = (config.servo_stiffness, config.servo_damping, config.servo_force_limit)
        if not any(settings):
            return
        counts = [len(numbers or ()) for numbers in settings]
        if set(counts) != {len(names)}:
            raise UserError(
                f"{len(names)} acting joints ({listed(names)}), but servo_stiffness, servo_damping "
                f"and servo_force_limit have {counts} numbers; give one of each for each joint"
            )
        for actuator in list(scene.actuators):
            scene.delete(actuator)
        for name, stiffness, damping, limit in zip(names, *settings, strict=True):
            _add_servo(scene, name, ServoSettings(stiffness, damping, limit))
        self._changes.append("replaced the actuators with position servos")


def _chain_to(model: mujoco.MjModel, body: int) -> list[int]:
    """The bodies from the base to a body."""
    chain = []
    while body:
        chain.insert(0, body)
        body = int(model.body_parentid[body])
    return chain


def _rename_beside(elements: Iterable, others: Iterable, added: str = "") -> list[str]:
    """Renames elements of the arm that have a name of the scene, or one that it gets.

    Args:
      elements: of one kind, such as the arm's bodies.
      others: the scene's of that kind.
      added: name of the one that the paddle brings.

    Returns:
      The changes in words.
    """
    reserved = {added}
    for other in others:
        if other.name:
            reserved.update(other.name + number for number in BALL_NUMBERS)
    renamed = []
    for element in elements:
        if element.name and element.name in reserved:
            free_name = _free_name(element.name, elements, reserved)
            renamed.append(f"{element.name} to {free_name}")
            element.name = free_name
    return renamed


def _add_servo(scene: mujoco.MjSpec, joint: str, servo: ServoSettings) -> None:
    """Adds a position servo of a joint to the scene."""
    transmission = mujoco.mjtTrn.mjTRN_JOINT
    actuator = scene.add_actuator(name=f"servo/{joint}", target=joint, trntype=transmission)
    actuator.set_to_position(kp=servo.stiffness, kv=servo.damping)
    if servo.force_limit is not None:
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = [-servo.force_limit, servo.force_limit]


def _add_paddle(paddle: mujoco.MjsBody, blade: PaddleConfig, default: mujoco.MjsDefault) -> None:
    """Adds the blade, with all the mass, and a handle for pictures to the paddle's body."""
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
    connected = listed((equality.name1, equality.name2))
    return f"unnamed equality constraint ({kind}: {connected})"


def _ends_of_constraint(model: mujoco.MjModel, constraint: int) -> list[_End] | None:
    """The parts that an equality constraint joins; None of a flex, whose parts are not looked
    for."""
    kinds = mujoco.mjtEq
    kind = kinds(model.eq_type[constraint])
    ends = []
    for index in (int(model.eq_obj1id[constraint]), int(model.eq_obj2id[constraint])):
        # The missing second part of a constraint that holds its first one still.
        if index < 0:
            continue
        if kind == kinds.mjEQ_JOINT:
            ends.append(_End(mujoco.mjtObj.mjOBJ_JOINT, index))
        elif kind == kinds.mjEQ_TENDON:
            ends += _ends_of_tendon(model, index)
        elif kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            # Two bodies, or two sites.
            ends.append(_End(mujoco.mjtObj(model.eq_objtype[constraint]), index))
        else:
            return None
    return ends


def _ends_of_tendon(model: mujoco.MjModel, tendon: int) -> list[_End]:
    """The joints that a tendon couples, or the sites and geoms on its path."""
    first_wrap = model.tendon_adr[tendon]
    ends = []
    for wrap in range(first_wrap, first_wrap + model.tendon_num[tendon]):
        kind = _WRAPPED.get(mujoco.mjtWrap(model.wrap_type[wrap]))
        if kind is not None:
            ends.append(_End(kind, int(model.wrap_objid[wrap])))
    return ends


def _acts_on_arm(
    model: mujoco.MjModel, ends: list[_End], joints: list[int], loose: list[int]
) -> bool:
    """Whether what has these ends acts on an acting joint, or on a body of the arm that one moves;
    also by its gripper, which it holds to something beside the arm."""
    moved = model.jnt_bodyid[joints].tolist()
    moves = [is_below(model, _body_of(model, end), moved) for end in ends]
    if any(moves) and not all(moves):
        return True
    for end in ends:
        body = _body_of(model, end)
        if end.kind == mujoco.mjtObj.mjOBJ_JOINT:
            acts = end.index in joints
        else:
            acts = is_below(model, body, moved) and not is_below(model, body, loose)
        if acts:
            return True
    return False


def _lets_go(model: mujoco.MjModel, ends: list[_End], joints: list[int], loose: list[int]) -> bool:
    """Whether what has these ends goes with the loose bodies of them: some are loose, and each of
    those is a gripper's, a mocap body, or free in the world."""
    moved = model.jnt_bodyid[joints].tolist()
    bodies = [_body_of(model, end) for end in ends]
    loose_ends = [body for body in bodies if is_below(model, body, loose)]
    for body in loose_ends:
        is_of_gripper = is_below(model, body, moved)
        if not is_of_gripper and _hangs(model, body):
            return False
    return bool(loose_ends)


def _hangs(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body is held by the world: it is below no free and no mocap body."""
    root = model.body_rootid[body]
    joint = model.body_jntadr[root]
    is_free = joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
    is_mocap = model.body_mocapid[root] >= 0
    return not is_free and not is_mocap


def _body_of(model: mujoco.MjModel, end: _End) -> int:
    """The body of a joint, a site or a geom; of a body, itself."""
    bodies = {
        mujoco.mjtObj.mjOBJ_JOINT: model.jnt_bodyid,
        mujoco.mjtObj.mjOBJ_SITE: model.site_bodyid,
        mujoco.mjtObj.mjOBJ_GEOM: model.geom_bodyid,
    }
    return int(bodies[end.kind][end.index]) if end.kind in bodies else end.index


def _tendon_words(model: mujoco.MjModel, tendon: int) -> str:
    """A tendon in words: its name; without one, the joints that it couples."""
    name = model.tendon(tendon).name
    if name:
        return f"tendon {name}"
    joints = []
    for end in _ends_of_tendon(model, tendon):
        if end.kind == mujoco.mjtObj.mjOBJ_JOINT:
            joints.append(joint_name(model, end.index))
    path = listed(joints) if joints else "spatial"
    return f"unnamed tendon ({path})"


def _differing_options(option: mujoco.MjOption, task: mujoco.MjOption) -> str:
    """The options of a file that change where an arm moves and that differ from the task's."""
    differing = []
    if option.integrator != task.integrator:
        integrator = mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_")
        differing.append(f"the integrator {integrator.lower()}")
    for name in WORLD_OPTIONS:
        value = np.asarray(getattr(option, name))
        # 9.8 and 9.81 m/s^2 are the same gravity.
        tolerance = 1e-2 if name == "gravity" else 0.0
        if not np.allclose(value, getattr(task, name), atol=tolerance):
            differing.append(f"{name} {np.round(value, 6).tolist()}")
    for flag in _FLAGS:
        if option.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag.upper()}"):
            differing.append(f"the disabled {flag}")
    if option.disableactuator:
        differing.append("the disabled actuator groups")
    return ", ".join(differing)


def is_below(model: mujoco.MjModel, body: int, ancestors: list[int]) -> bool:
    """Whether a body is one of some bodies, or below one of them in the tree."""
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
