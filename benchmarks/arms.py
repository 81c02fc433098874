"""Adopts public arms, and compares one step and 2,000 steps of each with MuJoCo's C engine.

    pip install --no-deps robosuite==1.5.2
    git clone https://github.com/OWNER/NAME FOLDER/OWNER/NAME     # each of `ARMS`
    python benchmarks/arms.py FOLDER [ARM ...]                    # docs/other-robots.md

In float64. Meshes are left out where a clone lacks them: every link has its inertia in the file.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ["JAX_ENABLE_X64"] = "1"

import argparse
import tempfile
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.physics import Control, PhysicsParameters, PhysicsState, make_engine
from bounce_mjx.robot.adopt import Adoption, adopt
from bounce_mjx.robot.config import RobotConfig
from bounce_mjx.robot.model import find_addresses, load_model

STATES = 32
"""Random states of the comparison of one step."""
PATHS = 8
"""Arms that move for `STEPS`."""
STEPS = 2000
HELD = 20
"""Steps for which a random target is held."""


class PublicArm(NamedTuple):
    """An arm of a public file."""

    name: str
    file: str
    """In a package, or in the folder of the clones."""
    site: str
    motors: tuple[float, ...] = ()
    """Torques (N m) of the motors that are added to the joints of a file without any."""


ROBOSUITE = "package:robosuite/models/assets/robots"
MENAGERIE = "google-deepmind/mujoco_menagerie"
TENNIS = "ALRhub/fancy_gym/fancy_gym/envs/mujoco/table_tennis/assets/xml/table_tennis_env.xml"
WAM_TORQUES = (150.0, 125.0, 40.0, 60.0, 5.0, 5.0, 2.0)
ARMS = (
    PublicArm("SO-101", "TheRobotStudio/SO-ARM100/Simulation/SO101/so101_new_calib.xml", "gripper"),
    PublicArm("OpenArm", "enactic/openarm_mujoco/v1/openarm.xml", "openarm_link7"),
    PublicArm("xArm 7", f"{ROBOSUITE}/xarm7/robot.xml", "right_hand"),
    PublicArm("Sawyer", f"{ROBOSUITE}/sawyer/robot.xml", "right_hand"),
    PublicArm("Kinova Gen3", f"{ROBOSUITE}/kinova3/robot.xml", "right_hand"),
    PublicArm("Kinova Jaco", f"{ROBOSUITE}/jaco/robot.xml", "right_hand"),
    PublicArm("Panda", f"{ROBOSUITE}/panda/robot.xml", "right_hand"),
    PublicArm("iiwa", f"{ROBOSUITE}/iiwa/robot.xml", "right_hand"),
    PublicArm("UR5e", f"{ROBOSUITE}/ur5e/robot.xml", "right_hand"),
    PublicArm(
        "Piper", "google-deepmind/mujoco_menagerie/agilex_piper/piper.xml", "attachment_site"
    ),
    PublicArm(
        "Rizon 4", "google-deepmind/mujoco_menagerie/flexiv_rizon4/flexiv_rizon4.xml", "link7"
    ),
    PublicArm("WAM with its bat", TENNIS, "wam/paddle_center"),
    PublicArm("YAM", "i2rt-robotics/i2rt/i2rt/robot_models/arm/yam/yam.xml", "link6"),
    PublicArm(
        "WAM",
        "kploeger/mujoco_robots/robot_description/wam7/wam_7dof.xml",
        "wam/links/wrist_palm",
        WAM_TORQUES,
    ),
)


class Comparison(NamedTuple):
    """An adopted arm against MuJoCo's C engine."""

    joints: int
    one_step: float
    """Largest difference of a velocity after one step, as a share of the largest speed."""
    many_steps: float
    """Largest difference of a joint's angle in `STEPS` steps, rad."""


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the clones")
    parser.add_argument("names", nargs="*", help="arms; all by default")
    given = parser.parse_args()
    print("| arm | joints | one step | 2,000 steps |")
    print("|---|---|---|---|")
    for arm in ARMS:
        if given.names and arm.name not in given.names:
            continue
        try:
            found = compare(arm, given.folder)
        except UserError as error:
            print(f"| {arm.name} | {error} | | |", flush=True)
            continue
        print(
            f"| {arm.name} | {found.joints} | {found.one_step:.0e} | {found.many_steps:.0e} |",
            flush=True,
        )


def compare(arm: PublicArm, folder: Path) -> Comparison:
    """Adopts an arm, and compares its engine with C.

    Raises:
      UserError: it is refused, or its file is missing.
    """
    file = Path(arm.file) if arm.file.startswith("package:") else folder / arm.file
    with tempfile.TemporaryDirectory() as copies:
        if arm.motors or _lacks_meshes(file):
            file = _prepared(file, arm.motors, Path(copies))
        adoption = adopt(file, RobotConfig(site=arm.site), 0.01, is_mount_given=False)
        model = load_model(file, 0.001, robot=adoption.config, visual=False)
    # So that C's solver converges to rounding error where joints have dry friction.
    model.opt.tolerance = 0.0
    model.opt.iterations = 100
    model.opt.ls_iterations = 50
    return Comparison(len(adoption.servos), _one_step(model, adoption), _path(model, adoption))


def _lacks_meshes(file: Path) -> bool:
    """Whether MuJoCo does not find a mesh of a file that is there."""
    if str(file).startswith("package:") or not file.is_file():
        return False
    try:
        mujoco.MjSpec.from_file(str(file)).compile()
    except ValueError as error:
        return "opening file" in str(error)
    return False


def _prepared(file: Path, torques: tuple[float, ...], folder: Path) -> Path:
    """A copy of an MJCF file without its meshes, and with motors of its first joints."""
    if not file.is_file():
        raise UserError(f"{file} does not exist; clone its repository into the folder")
    tree = ElementTree.parse(file)
    root = tree.getroot()
    meshes = {"mesh": None, "geom": "mesh"}
    for parent in list(root.iter()):
        for child in list(parent):
            attribute = meshes.get(child.tag, "")
            if attribute is None or (attribute and child.get(attribute) is not None):
                parent.remove(child)
    if torques:
        actuators = ElementTree.SubElement(root, "actuator")
        joints = [joint for joint in root.find("worldbody").iter("joint") if joint.get("name")]
        for joint, torque in zip(joints, torques, strict=False):
            motor = {"joint": joint.get("name"), "ctrlrange": f"-{torque} {torque}"}
            ElementTree.SubElement(actuators, "motor", motor)
    copy = folder / file.name
    tree.write(copy)
    return copy


def _one_step(model: mujoco.MjModel, adoption: Adoption) -> float:
    """`Comparison.one_step`, of random states about the start pose."""
    rng = np.random.default_rng(0)
    at = find_addresses(model)
    joints = len(at.arm_qpos)
    qpos = np.tile(model.qpos0, (STATES, 1))
    qpos[:, list(at.arm_qpos)] = adoption.pose.angles + rng.uniform(-0.5, 0.5, (STATES, joints))
    qvel = rng.uniform(-2.0, 2.0, (STATES, model.nv))
    targets = qpos[:, list(at.arm_qpos)] + rng.uniform(-0.05, 0.05, (STATES, joints))
    ctrl = np.zeros((STATES, model.nu))
    ctrl[:, list(at.actuators)] = targets * model.actuator_gear[list(at.actuators), 0]
    after = _stepper(model)(PhysicsState(qpos.T, qvel.T), ctrl.T)
    worst = 0.0
    for i in range(STATES):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos[i]
        data.qvel[:] = qvel[i]
        data.ctrl[:] = ctrl[i]
        mujoco.mj_step(model, data)
        difference = np.max(np.abs(np.asarray(after.qvel)[:, i] - data.qvel))
        worst = max(worst, difference / np.max(np.abs(data.qvel)))
    return worst


def _path(model: mujoco.MjModel, adoption: Adoption) -> float:
    """`Comparison.many_steps`, from rest in the start pose, under random targets within 0.06 rad of
    it; the ball is out of reach, as its bounces would double every rounding error."""
    rng = np.random.default_rng(1)
    at = find_addresses(model)
    angles = list(at.arm_qpos)
    start = model.qpos0.copy()
    start[angles] = adoption.pose.angles
    start[list(at.balls[0].qpos[:3])] = [0.0, 0.0, 50.0]
    shape = (STEPS // HELD, len(angles), PATHS)
    targets = adoption.pose.angles[:, None] + rng.uniform(-0.06, 0.06, shape)
    ctrl = np.zeros((len(targets), model.nu, PATHS))
    gears = model.actuator_gear[list(at.actuators), 0]
    ctrl[:, list(at.actuators)] = targets * gears[:, None]
    step = _stepper(model)

    def hold(state: PhysicsState, held: jax.Array) -> tuple[PhysicsState, jax.Array]:
        state, _ = jax.lax.scan(lambda s, _: (step(s, held), None), state, length=HELD)
        return state, state.qpos

    rest = PhysicsState(np.tile(start[:, None], PATHS), np.zeros((model.nv, PATHS)))
    _, path = jax.jit(lambda ctrl: jax.lax.scan(hold, rest, ctrl))(jnp.array(ctrl))
    worst = 0.0
    for i in range(PATHS):
        data = mujoco.MjData(model)
        data.qpos[:] = start
        for row, held in enumerate(ctrl[..., i]):
            data.ctrl[:] = held
            mujoco.mj_step(model, data, HELD)
            difference = np.abs(np.asarray(path)[row, angles, i] - data.qpos[angles])
            worst = max(worst, float(np.max(difference)))
    return worst


def _stepper(model: mujoco.MjModel):
    """(states, ctrl [nu, N]) -> the states after a step."""
    engine = make_engine(model, "auto")

    def step(state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        return engine.step(PhysicsParameters(), state, Control(ctrl), 1)

    return jax.jit(jax.vmap(step, in_axes=-1, out_axes=-1))


if __name__ == "__main__":
    main()
