"""Shipped policies in simulators that share no code with MuJoCo: PyBullet, SAPIEN (PhysX), DART.

    pip install -e '.[simulators]'
    python benchmarks/simulators.py robust pretrained --jobs 2
    python benchmarks/simulators.py track juggle ur5e --worlds nominal
    python benchmarks/simulators.py robust --simulators bullet --worlds "20 + 10 ms" --logs logs

The last line records the logs from which `bounce-mjx identify` finds that simulator's world.

The arm is rebuilt, link by link, from the environment's compiled model, as a URDF file: masses,
inertias, hinges, torques and the paddle's box, but not the joints' own limits, damping and
friction, nor a gravity compensation. The balls have the model's mass, radius, inertia and friction.
Two numbers of a simulator are set before any policy acts, and printed: the coefficient of
restitution, such that a ball that drops onto the paddle of the arm at rest rebounds with the
world's restitution; and the time constant of the motors, such that a step of 0.05 rad takes as long
to 63% as MuJoCo's servos take. (`physx` has servos of the same stiffness and damping, and needs
none.) The policy acts through `load_policy`, as on a robot: it sees the joints and the newest
picture of the ball. The environment's own functions measure the results, and the supervisor's
alarms but lost balls are counted. `mujoco` is the C engine, as a comparison.
"""

import argparse
import concurrent.futures
import functools
import itertools
import math
import multiprocessing
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.faults import Fault, Watch, check_balls, picture_age
from bounce_mjx.deploy.policy import DeployedPolicy
from bounce_mjx.deploy.recorder import Recorder
from bounce_mjx.deploy.samples import ImpossibleMeasurement, Seen
from bounce_mjx.env.env import Env, State
from bounce_mjx.evaluation.episodes import reset_episodes
from bounce_mjx.evaluation.results import Report, judge
from bounce_mjx.evaluation.statistics import Statistics, accumulate, empty_statistics
from bounce_mjx.identify.excitation import excite
from bounce_mjx.physics import CEngine
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import choose_checkpoint
from bounce_mjx.world.config import RandomizationConfig

DROP = 0.3
"""Height of a drop, m."""
STEP = 0.05
"""Step of a servo's target, rad."""
ENCODER_NOISE = 1e-4
"""Standard deviation of the joint angles in a log, rad."""
CAMERA_NOISE = 0.002
"""Standard deviation of the ball's position in a log, m."""
BALL_SECONDS = 40.0
"""Length of a log with the ball, s."""
LOGS = ("arm.csv", "ball.csv")
"""Files of the logs: of the arm's motion, and of the policy with the ball."""
RATE = 1000.0
"""Rate of the policy's commands, Hz."""


class World(NamedTuple):
    """What a simulation differs in; the rest is the environment's model."""

    restitution: float = 0.85
    """Of the ball on the paddle; the default is that of `mjcf/bounce_ball.xml`."""
    friction: float | None = None
    """None for that of the environment's model."""
    action_latency: float = 0.0
    """From a command to the servos, s."""
    ball_latency: float = 0.0
    """Of the pictures, rounded to control steps, s."""
    timestep: float = 0.001
    """Of the physics, s."""


WORLDS = {
    "nominal": World(),
    "20 + 10 ms": World(action_latency=0.020, ball_latency=0.010),
    "60 + 30 ms": World(action_latency=0.060, ball_latency=0.030),
    "friction 0.3": World(friction=0.3),
    "restitution 0.75": World(restitution=0.75),
    "240 Hz": World(timestep=1.0 / 240.0),
}


class Simulator(NamedTuple):
    """An arm with a paddle and B balls in one simulator."""

    reset: Callable[[np.ndarray, np.ndarray, np.ndarray], None]
    """Puts the joints at angles [J] (rad), at rest, and the balls at positions [B, 3] (m) with
    velocities [B, 3] (m/s)."""
    joint_state: Callable[[], tuple[np.ndarray, np.ndarray]]
    """Angles [J] (rad) and velocities [J] (rad/s)."""
    ball_state: Callable[[], np.ndarray]
    """Positions, velocities and angular velocities [B, 9] (m, m/s, rad/s; world's axes)."""
    servo_targets: Callable[[np.ndarray], None]
    """Sets the angles [J] that the servos go to."""
    step: Callable[[], None]
    """One time step."""
    close: Callable[[], None]
    """Frees what the simulator holds."""


class Tuning(NamedTuple):
    """What a simulator needs to show the world's restitution and the arm's servos."""

    restitution: float
    """Coefficient of restitution of ball and paddle."""
    lag: float
    """Time constant of the motors, s."""


class Parts(NamedTuple):
    """What simulators are built from."""

    urdf: str
    """The arm with the paddle's box; link i has joint i - 1."""
    links: list[str]
    """Names of the links, in the order of the joints [J]."""
    stiffness: np.ndarray
    """Of the servos [J], N m / rad."""
    damping: np.ndarray
    """Of the servos [J], N m s / rad."""
    torque: np.ndarray
    """Largest torque of the servos [J], N m."""
    armature: np.ndarray
    """Inertia of the rotors [J], kg m^2."""
    radius: float
    """Of the balls, m."""
    mass: float
    """Of a ball, kg."""
    inertia: float
    """Of a ball, kg m^2."""
    balls: int


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Matrix [3, 3] of a unit quaternion (w, x, y, z)."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, float))
    return matrix.reshape(3, 3)


def _origin(parent: ET.Element, position: np.ndarray, quaternion: np.ndarray) -> None:
    """Adds a URDF origin: position, and roll, pitch and yaw about fixed axes."""
    r = _rotation(quaternion)
    pitch = -np.arcsin(np.clip(r[2, 0], -1.0, 1.0))
    if abs(r[2, 0]) < 1.0 - 1e-9:
        roll, yaw = np.arctan2(r[2, 1], r[2, 2]), np.arctan2(r[1, 0], r[0, 0])
    else:
        # Roll and yaw turn about the same axis.
        roll, yaw = 0.0, np.arctan2(-r[0, 1], r[1, 1])
    angles = (roll, pitch, yaw)
    words = (" ".join(f"{x:.9g}" for x in values) for values in (position, angles))
    ET.SubElement(parent, "origin", dict(zip(("xyz", "rpy"), words, strict=True)))


def _add_link(robot: ET.Element, model: mujoco.MjModel, body: int, paddle: int) -> None:
    """Adds a body's link: its inertia, and the paddle's box."""
    link = ET.SubElement(robot, "link", name=f"link{body}")
    joint = model.body_jntadr[body]
    anchor = model.jnt_pos[joint] if model.body_jntnum[body] else np.zeros(3)
    inertial = ET.SubElement(link, "inertial")
    _origin(inertial, model.body_ipos[body] - anchor, model.body_iquat[body])
    ET.SubElement(inertial, "mass", value=f"{model.body_mass[body]:.9g}")
    moments = {f"i{a}{b}": "0" for a, b in ("xy", "xz", "yz")}
    moments |= {
        f"i{a}{a}": f"{x:.9g}" for a, x in zip("xyz", model.body_inertia[body], strict=True)
    }
    ET.SubElement(inertial, "inertia", moments)
    if model.geom_bodyid[paddle] == body:
        collision = ET.SubElement(link, "collision")
        _origin(collision, model.geom_pos[paddle] - anchor, model.geom_quat[paddle])
        size = " ".join(f"{2.0 * x:.9g}" for x in model.geom_size[paddle])
        ET.SubElement(ET.SubElement(collision, "geometry"), "box", size=size)


def make_parts(model: mujoco.MjModel) -> Parts:
    """The arm and the balls of a compiled model, whose arm's bodies have one hinge or none.

    Raises:
      ValueError: the model has what is not rebuilt in the other simulators.
    """
    addresses = find_addresses(model)
    balls = [ball.body for ball in addresses.balls]
    paddle = addresses.paddle_geom
    if model.geom_type[paddle] != mujoco.mjtGeom.mjGEOM_BOX:
        raise ValueError("the paddle is no box")
    if model.body_jntnum[model.geom_bodyid[paddle]] != 1:
        raise ValueError("the paddle's body has no hinge")
    if np.any(model.actuator_gear[:, 0] != 1.0):
        raise ValueError(f"the servos have gears, {model.actuator_gear[:, 0]}; only 1 is rebuilt")
    robot = ET.Element("robot", name="arm")
    ET.SubElement(robot, "link", name="world")
    links = []
    for body in range(1, model.nbody):
        if body in balls:
            continue
        _add_link(robot, model, body, paddle)
        parent, hinged = model.body_parentid[body], model.body_jntnum[body] == 1
        joint = ET.SubElement(
            robot, "joint", name=f"joint{body}", type="continuous" if hinged else "fixed"
        )
        ET.SubElement(joint, "parent", link=f"link{parent}" if parent else "world")
        ET.SubElement(joint, "child", link=f"link{body}")
        anchor = model.jnt_pos[model.body_jntadr[body]] if hinged else np.zeros(3)
        before = model.jnt_pos[model.body_jntadr[parent]] if model.body_jntnum[parent] else 0.0
        position = model.body_pos[body] + _rotation(model.body_quat[body]) @ anchor - before
        _origin(joint, position, model.body_quat[body])
        if hinged:
            axis = model.jnt_axis[model.body_jntadr[body]]
            ET.SubElement(joint, "axis", xyz=" ".join(f"{x:.9g}" for x in axis))
            ET.SubElement(joint, "limit", effort="1e6", velocity="1e3")
            links.append(body)
    joints = model.body_jntadr[links]
    dofs = model.jnt_dofadr[joints]
    limits = np.abs(model.actuator_forcerange).max(axis=1)
    return Parts(
        urdf=ET.tostring(robot, encoding="unicode"),
        links=[f"link{body}" for body in links],
        stiffness=model.actuator_gainprm[:, 0],
        damping=-model.actuator_biasprm[:, 2],
        torque=np.where(model.actuator_forcelimited > 0, limits, 1e4),
        armature=model.dof_armature[dofs],
        radius=float(model.geom_size[model.body_geomadr[balls[0]], 0]),
        mass=float(model.body_mass[balls[0]]),
        inertia=float(model.body_inertia[balls[0], 0]),
        balls=len(balls),
    )


def bullet(parts: Parts, world: World, tuning: Tuning) -> Simulator:
    """Bullet's multibodies: impulses between contacts, velocity motors."""
    import pybullet as p

    client = p.connect(p.DIRECT)
    p.setPhysicsEngineParameter(
        fixedTimeStep=world.timestep, restitutionVelocityThreshold=0.01, physicsClientId=client
    )
    p.setGravity(0, 0, -9.81, physicsClientId=client)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "arm.urdf")
        path.write_text(parts.urdf, encoding="utf-8")
        arm = p.loadURDF(
            str(path),
            useFixedBase=True,
            flags=p.URDF_USE_INERTIA_FROM_FILE | p.URDF_MAINTAIN_LINK_ORDER,
            physicsClientId=client,
        )
    names = {
        p.getJointInfo(arm, i, physicsClientId=client)[12].decode(): i
        for i in range(p.getNumJoints(arm, physicsClientId=client))
    }
    joints = [names[name] for name in parts.links]
    shape = p.createCollisionShape(p.GEOM_SPHERE, radius=parts.radius, physicsClientId=client)
    balls = [
        p.createMultiBody(parts.mass, shape, basePosition=(0, i, 5), physicsClientId=client)
        for i in range(parts.balls)
    ]
    # Bullet multiplies the two bodies' coefficients.
    touching = {
        "restitution": np.sqrt(tuning.restitution),
        "lateralFriction": np.sqrt(world.friction),
    }
    free = {"linearDamping": 0.0, "angularDamping": 0.0, "rollingFriction": 0.0}
    for body, link in [(arm, i) for i in joints] + [(ball, -1) for ball in balls]:
        p.changeDynamics(body, link, jointDamping=0.0, **touching, **free, physicsClientId=client)
    for ball in balls:
        # Bullet's own inertia is that of a solid ball.
        p.changeDynamics(ball, -1, localInertiaDiagonal=[parts.inertia] * 3, physicsClientId=client)
    targets = np.zeros(len(joints))

    def reset(angles, positions, velocities):
        for joint, angle in zip(joints, angles, strict=True):
            p.resetJointState(arm, joint, angle, 0.0, physicsClientId=client)
        targets[:] = angles
        for ball, position, velocity in zip(balls, positions, velocities, strict=True):
            p.resetBasePositionAndOrientation(ball, position, (0, 0, 0, 1), physicsClientId=client)
            p.resetBaseVelocity(ball, velocity, (0, 0, 0), physicsClientId=client)

    def joint_state():
        states = p.getJointStates(arm, joints, physicsClientId=client)
        return tuple(np.array([state[i] for state in states]) for i in range(2))

    def ball_state():
        rows = []
        for ball in balls:
            position, _ = p.getBasePositionAndOrientation(ball, physicsClientId=client)
            rows.append(
                np.concatenate([position, *p.getBaseVelocity(ball, physicsClientId=client)])
            )
        return np.array(rows)

    def step():
        speeds = (targets - joint_state()[0]) / tuning.lag
        p.setJointMotorControlArray(
            arm,
            joints,
            p.VELOCITY_CONTROL,
            targetVelocities=speeds,
            forces=parts.torque,
            physicsClientId=client,
        )
        p.stepSimulation(physicsClientId=client)

    return Simulator(
        reset,
        joint_state,
        ball_state,
        functools.partial(np.copyto, targets),
        step,
        lambda: p.disconnect(client),
    )


def physx(parts: Parts, world: World, tuning: Tuning) -> Simulator:
    """SAPIEN: PhysX' reduced coordinates, implicit springs and dampers as servos."""
    import sapien

    config = sapien.physx.PhysxSceneConfig()
    config.bounce_threshold = 0.01
    config.gravity = np.array([0.0, 0.0, -9.81])
    sapien.physx.set_scene_config(config)
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.set_timestep(world.timestep)
    material = sapien.physx.PhysxMaterial(world.friction, world.friction, tuning.restitution)
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    loader.set_material(world.friction, world.friction, tuning.restitution)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "arm.urdf")
        path.write_text(parts.urdf, encoding="utf-8")
        arm = loader.load(str(path))
    joints = {joint.child_link.name: joint for joint in arm.get_active_joints()}
    order = [arm.get_active_joints().index(joints[name]) for name in parts.links]
    drives = [joints[name] for name in parts.links]
    numbers = zip(parts.stiffness, parts.damping, parts.torque, parts.armature, strict=True)
    for joint, (stiffness, damping, torque, armature) in zip(drives, numbers, strict=True):
        joint.set_drive_properties(stiffness, damping, force_limit=torque, mode="force")
        joint.set_armature(np.array([armature], np.float32))
        joint.set_friction(0.0)
    balls = []
    for i in range(parts.balls):
        builder = scene.create_actor_builder()
        volume = 4.0 / 3.0 * np.pi * parts.radius**3
        builder.add_sphere_collision(
            radius=parts.radius, material=material, density=parts.mass / volume
        )
        builder.set_initial_pose(sapien.Pose([0, i, 5]))
        ball = builder.build().find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)
        ball.set_linear_damping(0.0)
        ball.set_angular_damping(0.0)
        # The builder's own inertia is that of a solid ball.
        ball.set_inertia(np.full(3, parts.inertia))
        balls.append(ball)

    def reset(angles, positions, velocities):
        values = np.zeros(len(order), np.float32)
        values[order] = angles
        arm.set_qpos(values)
        arm.set_qvel(np.zeros_like(values))
        servo_targets(angles)
        for ball, position, velocity in zip(balls, positions, velocities, strict=True):
            ball.set_pose(sapien.Pose(position))
            ball.set_linear_velocity(velocity)
            ball.set_angular_velocity(np.zeros(3))

    def joint_state():
        return arm.get_qpos()[order].astype(float), arm.get_qvel()[order].astype(float)

    def ball_state():
        rows = [(b.get_pose().p, b.get_linear_velocity(), b.get_angular_velocity()) for b in balls]
        return np.array(rows, float).reshape(len(balls), 9)

    def servo_targets(angles):
        for joint, angle in zip(drives, angles, strict=True):
            joint.set_drive_target(float(angle))

    return Simulator(reset, joint_state, ball_state, servo_targets, scene.step, scene.clear)


def dart(parts: Parts, world: World, tuning: Tuning) -> Simulator:
    """DART: contacts and motors as one linear complementarity problem."""
    import dartpy

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "arm.urdf")
        path.write_text(parts.urdf, encoding="utf-8")
        arm = dartpy.utils.DartLoader().parseSkeleton(str(path))
    scene = dartpy.simulation.World()
    scene.setTimeStep(world.timestep)
    scene.setGravity([0, 0, -9.81])
    joints = [arm.getBodyNode(name).getParentJoint() for name in parts.links]
    for joint, torque in zip(joints, parts.torque, strict=True):
        joint.setActuatorType(dartpy.dynamics.ActuatorType.SERVO)
        joint.setForceLowerLimit(0, -torque)
        joint.setForceUpperLimit(0, torque)
    balls = []
    for i in range(parts.balls):
        ball = dartpy.dynamics.Skeleton(f"ball{i}")
        _, body = ball.createFreeJointAndBodyNodePair()
        node = body.createShapeNode(dartpy.dynamics.SphereShape(parts.radius))
        node.createCollisionAspect()
        node.createDynamicsAspect()
        moments = np.diag([parts.inertia] * 3)
        body.setInertia(dartpy.dynamics.Inertia(parts.mass, np.zeros(3), moments))
        balls.append(ball)
    for skeleton in (arm, *balls):
        for k in range(skeleton.getNumBodyNodes()):
            for node in skeleton.getBodyNode(k).getShapeNodes():
                if node.hasDynamicsAspect():
                    # DART multiplies the two bodies' restitutions, and takes the lesser friction.
                    node.getDynamicsAspect().setRestitutionCoeff(np.sqrt(tuning.restitution))
                    node.getDynamicsAspect().setFrictionCoeff(world.friction)
        scene.addSkeleton(skeleton)
    targets = np.zeros(len(joints))

    def reset(angles, positions, velocities):
        for joint, angle in zip(joints, angles, strict=True):
            joint.setPosition(0, angle)
            joint.setVelocity(0, 0.0)
        targets[:] = angles
        for ball, position, velocity in zip(balls, positions, velocities, strict=True):
            ball.setPositions(np.concatenate([np.zeros(3), position]))
            ball.setVelocities(np.concatenate([np.zeros(3), velocity]))

    def joint_state():
        angles = np.array([joint.getPosition(0) for joint in joints])
        return angles, np.array([joint.getVelocity(0) for joint in joints])

    def ball_state():
        bodies = [ball.getBodyNode(0) for ball in balls]
        rows = [
            (b.getTransform().translation(), b.getLinearVelocity(), b.getAngularVelocity())
            for b in bodies
        ]
        return np.array(rows, float).reshape(len(balls), 9)

    def step():
        for joint, target in zip(joints, targets, strict=True):
            joint.setCommand(0, (target - joint.getPosition(0)) / tuning.lag)
        scene.step()

    return Simulator(
        reset, joint_state, ball_state, functools.partial(np.copyto, targets), step, lambda: None
    )


def own_engine(model: mujoco.MjModel) -> Simulator:
    """MuJoCo itself, in whose servos' time a step is measured for the others."""
    engine = CEngine(model)
    model = engine.model
    addresses = find_addresses(model)
    data = mujoco.MjData(model)
    qpos = list(addresses.arm_qpos)
    qvel = list(addresses.arm_qvel)

    def reset(angles, positions, velocities):
        mujoco.mj_resetData(model, data)
        data.qpos[qpos] = angles
        servo_targets(angles)
        for ball, position, velocity in zip(addresses.balls, positions, velocities, strict=True):
            data.qpos[list(ball.qpos[:3])] = position
            data.qvel[list(ball.qvel[:3])] = velocity

    def ball_state():
        rows = []
        spin_and_velocity = np.zeros(6)
        for ball in addresses.balls:
            kind = mujoco.mjtObj.mjOBJ_BODY
            mujoco.mj_objectVelocity(model, data, kind, ball.body, spin_and_velocity, 0)
            spin, velocity = np.split(spin_and_velocity, 2)
            rows.append(np.concatenate([data.qpos[list(ball.qpos[:3])], velocity, spin]))
        return np.array(rows)

    def servo_targets(angles):
        data.ctrl[list(addresses.actuators)] = angles

    return Simulator(
        reset,
        lambda: (data.qpos[qpos], data.qvel[qvel]),
        ball_state,
        servo_targets,
        functools.partial(engine.step, data),
        lambda: None,
    )


SIMULATORS = {"bullet": bullet, "physx": physx, "dart": dart}


def maker(
    name: str, model: mujoco.MjModel, world: World, angles: np.ndarray
) -> Callable[[], Simulator]:
    """Makes tuned simulators of a model.

    Args:
      angles: of the joints [J], where the paddle is level.
    """
    if name != "mujoco":
        if world.friction is None:
            world = world._replace(friction=model_friction(model))
        tuning = tune(name, model, world, angles)
        return functools.partial(SIMULATORS[name], make_parts(model), world, tuning)
    delays = {"action_latency": world.action_latency, "ball_latency": world.ball_latency}
    if world != World(**delays):
        raise ValueError("mujoco simulates delays alone; bounce-mjx robustness has other worlds")
    return functools.partial(own_engine, model)


def model_friction(model: mujoco.MjModel) -> float:
    """Coefficient of sliding friction between ball and paddle in a compiled model."""
    has_friction = model.pair_dim[0] > 1
    return float(model.pair_friction[0, 0]) if has_friction else 0.0


def drop(simulator: Simulator, parts: Parts, angles: np.ndarray, above: np.ndarray) -> float:
    """Restitution of a ball that drops 0.3 m onto the paddle of the arm at rest.

    Args:
      angles: of the joints [J], where the paddle is level.
      above: position [3] of the ball's centre when it touches the middle of the paddle.
    """
    far = np.array([[0.0, 10.0 + i, 10.0] for i in range(parts.balls)])
    far[0] = above + (0.0, 0.0, DROP)
    simulator.reset(angles, far, np.zeros_like(far))
    speeds = []
    for _ in range(2000):
        simulator.step()
        speeds.append(simulator.ball_state()[0, 5])
        if speeds[-1] > 0.0 and len(speeds) > 5:
            break
    return speeds[-1] / -min(speeds)


def lag(simulator: Simulator, parts: Parts, angles: np.ndarray, timestep: float) -> float:
    """Mean time of a step of 0.05 rad to 63%, s; each joint moves alone."""
    far = np.array([[0.0, 10.0 + i, 10.0] for i in range(parts.balls)])
    times = []
    for j in range(len(angles)):
        simulator.reset(angles, far, np.zeros_like(far))
        goal = angles + STEP * (np.arange(len(angles)) == j)
        simulator.servo_targets(goal)
        level = (1.0 - np.exp(-1.0)) * STEP
        before = 0.0
        for step in range(1000):
            simulator.step()
            moved = simulator.joint_state()[0][j] - angles[j]
            if moved >= level:
                times.append(timestep * (step + (level - before) / (moved - before)))
                break
            before = moved
        else:
            raise ValueError(f"joint {j + 1} does not follow a step of {STEP} rad")
    return float(np.mean(times))


def tune(name: str, model: mujoco.MjModel, world: World, angles: np.ndarray) -> Tuning:
    """The coefficient and the time constant with which a simulator shows the world's restitution
    and MuJoCo's time of a step, by bisection."""
    parts = make_parts(model)
    wanted = lag(own_engine(model), parts, angles, model.opt.timestep)
    addresses = find_addresses(model)
    data = mujoco.MjData(model)
    data.qpos[list(addresses.arm_qpos)] = angles
    mujoco.mj_forward(model, data)
    thickness = np.min(model.geom_size[addresses.paddle_geom])
    above = data.geom_xpos[addresses.paddle_geom] + (0.0, 0.0, thickness + parts.radius)

    def bisect(low: float, high: float, goal: float, measure: Callable[[float], float]) -> float:
        for _ in range(12):
            middle = 0.5 * (low + high)
            if measure(middle) < goal:
                low = middle
            else:
                high = middle
        return 0.5 * (low + high)

    def with_tuning(measure: Callable[[Simulator], float], tuning: Tuning) -> float:
        simulator = SIMULATORS[name](parts, world, tuning)
        try:
            return measure(simulator)
        finally:
            simulator.close()

    steps = functools.partial(lag, parts=parts, angles=angles, timestep=world.timestep)
    drops = functools.partial(drop, parts=parts, angles=angles, above=above)
    constant = wanted
    # PhysX has the servos' own stiffness and damping.
    has_motors = name != "physx"
    if has_motors:
        constant = bisect(
            world.timestep, 4.0 * wanted, wanted, lambda x: with_tuning(steps, Tuning(0.85, x))
        )
    coefficient = bisect(
        0.5, 1.0, world.restitution, lambda x: with_tuning(drops, Tuning(x, constant))
    )
    tuning = Tuning(coefficient, constant)
    of_motors = f" with the constant {1e3 * constant:.1f} ms" if has_motors else ""
    print(
        f"{name}: restitution {with_tuning(drops, tuning):.3f} with the coefficient "
        f"{coefficient:.3f}; a step takes {1e3 * with_tuning(steps, tuning):.1f} ms "
        f"({1e3 * wanted:.1f} in MuJoCo){of_motors}",
        flush=True,
    )
    return tuning


class Episode:
    """One policy in one simulator: what it sees, and its late commands."""

    def __init__(self, policy: DeployedPolicy, simulator: Simulator, world: World):
        self.policy = policy
        self.simulator = simulator
        self.world = world
        self.alarm = ""
        """Code of the first fault that a supervisor would stop for, but a lost ball's."""
        self._watch = Watch(policy.metadata)
        self._max_age = picture_age(policy.metadata)
        self._steps = 0
        """Time steps of the physics."""
        self._targets: list[np.ndarray] = []
        """Commanded angles [J] at the start, and of each interval of `RATE`."""
        self._balls: list[np.ndarray] = []
        """States [B, 9] at the start, and after each control step."""

    @property
    def balls(self) -> np.ndarray:
        """The newest state of the balls [B, 9]."""
        return self._balls[-1]

    def reset(self, angles: np.ndarray, positions: np.ndarray, velocities: np.ndarray) -> None:
        """Starts with the arm at angles [J], at rest, and the balls as `Simulator.reset`."""
        self.simulator.reset(angles, positions, velocities)
        # What was done before the start is no sample.
        controller = self.policy.controller
        seen = controller.samples.rest(Seen(), angles)
        self._memory = controller.episode(seen, None)
        self._followed = self._watch.rest(angles, angles)
        self._steps = 0
        self._targets = [angles]
        self._balls = [self.simulator.ball_state()]

    def measure(self) -> dict[str, np.ndarray | float]:
        """What the robot measures: its joints, and the newest picture of the ball."""
        dt = self.policy.metadata.control_dt
        number = len(self._balls) - 1
        angles, velocities = self.simulator.joint_state()
        age = min(round(self.world.ball_latency / dt), number)
        position, velocity, spin = np.split(self._balls[number - age], 3, axis=1)
        seen = {"position": position, "velocity": velocity, "angular_velocity": spin}
        measured = {"joint_angles": angles, "joint_velocities": velocities, "ball_age": age * dt}
        return measured | {f"ball_{name}": x for name, x in seen.items()}

    def control_step(self, goal: dict[str, np.ndarray]) -> None:
        """The policy acts on what it knows, and the physics runs until its next step."""
        controller = self.policy.controller
        measured = self.policy.driver.check(self.measure() | goal)
        try:
            memory, measured, steps = controller.take(self._memory, measured)
        except ImpossibleMeasurement as error:
            self.alarm = self.alarm or error.fault
        else:
            seen = memory.seen
            age = seen.clock.now - seen.picture.taken
            paddle = seen.paddle[-1][1]
            angles = measured["joint_angles"]
            try:
                check_balls(seen.picture.balls, age, self._max_age, paddle)
                self._followed = self._watch.follow(
                    self._followed, angles, self._targets[-1], steps, seen.is_arm_bridged
                )
            except Fault as fault:
                if fault.fault != "ball_lost":
                    self.alarm = self.alarm or fault.fault
            self._memory = controller.act(memory, measured, steps)
        count = self.policy.commands_per_step(RATE)
        times = np.arange(1, count + 1) / RATE
        self.run(controller.motion.at(self._memory.course, times))

    def run(self, targets: np.ndarray) -> None:
        """The physics runs until the next control step, with targets [n, J] at `RATE`."""
        dt = self.policy.metadata.control_dt
        number = len(self._balls) - 1
        self._targets.extend(targets)
        # A time step may be longer or shorter than the interval of the commands.
        timestep = self.world.timestep
        while (self._steps + 0.5) * timestep < (number + 1) * dt:
            time = self._steps * timestep - self.world.action_latency
            self.simulator.servo_targets(self._targets[max(0, math.floor(time * RATE + 1e-6) + 1)])
            self.simulator.step()
            self._steps += 1
        self._balls.append(self.simulator.ball_state())


def nominal_env(policy: str) -> Env:
    """The environment of a shipped policy, with nothing randomised."""
    config = load_run_config(choose_checkpoint(Path(policy), Path()).run).env
    return Env(config.in_world(RandomizationConfig()))


@functools.partial(jax.jit, static_argnums=0)
def judge_step(
    env: Env,
    states: State,
    qpos: jax.Array,
    qvel: jax.Array,
    statistics: Statistics,
    step: jax.Array,
) -> tuple[State, Statistics]:
    """The environment's account of a control step whose physics ran elsewhere.

    Args:
      states: of E environments before the step, batch last.
      qpos: positions [nq, E] after it.
      qvel: velocities [nv, E] after it.
      step: its index [].
    """
    now = states.pipeline_state
    no_action = jax.numpy.zeros((env.action_size, qpos.shape[-1]))
    _, actuation = jax.vmap(env.control, in_axes=-1, out_axes=-1)(now, no_action)
    physics = now.physics._replace(
        qpos=qpos.astype(now.physics.qpos.dtype), qvel=qvel.astype(now.physics.qvel.dtype)
    )
    finish_step = jax.vmap(env.finish_step, in_axes=-1, out_axes=-1)
    states = finish_step(states, no_action, actuation, physics)
    return states, accumulate(env, statistics, states, step)


def evaluate(
    policy: str, name: str, world: World, episodes: int, seed: int
) -> tuple[Report, np.ndarray, list[str]]:
    """Results of a shipped policy in a simulator, over episodes of the task's time limit, the
    positions [T, nq] of the first episode, and the supervisor's alarms."""
    env = nominal_env(policy)
    addresses = env.addresses
    arm_qpos = list(addresses.arm_qpos)
    arm_qvel = list(addresses.arm_qvel)
    ball_qpos = np.array([ball.qpos[:3] for ball in addresses.balls])
    ball_qvel = np.array([ball.qvel[:3] for ball in addresses.balls])
    home = np.array(load_policy(policy).metadata.default_joint_angles)
    make = maker(name, env.mj_model, world, home)
    played = [Episode(load_policy(policy), make(), world) for _ in range(episodes)]
    states = jax.jit(reset_episodes, static_argnums=(0, 2))(env, jax.random.key(seed), episodes)
    qpos, qvel = (np.array(x, float) for x in states.pipeline_state.physics[:2])

    for i, episode in enumerate(played):
        episode.reset(qpos[arm_qpos, i], qpos[ball_qpos, i], qvel[ball_qvel, i])
    statistics = empty_statistics(env, states)
    path = [qpos[:, 0].copy()]
    for step in range(env.config.episode_steps):
        goals = jax.tree.map(np.asarray, states.pipeline_state.goal)
        for i in np.flatnonzero(statistics.running):
            episode = played[i]
            episode.control_step({key: value[..., i] for key, value in goals.items()})
            qpos[arm_qpos, i], qvel[arm_qvel, i] = episode.simulator.joint_state()
            qpos[ball_qpos, i], qvel[ball_qvel, i] = np.split(episode.balls[:, :6], 2, axis=1)
        path.append(qpos[:, 0].copy())
        states, statistics = judge_step(env, states, qpos, qvel, statistics, step)
        if not np.any(statistics.running):
            break
    for episode in played:
        episode.simulator.close()
    alarms = [episode.alarm for episode in played if episode.alarm]
    return judge(env, statistics), np.array(path), alarms


def record_logs(policy: str, name: str, world: World, folder: Path) -> None:
    """Writes the logs for `bounce-mjx identify`: the arm in the motion of `bounce-mjx excite`
    (arm.csv), and the policy, with a new target height every 3 s (ball.csv).

    Raises:
      UserError: one of the files exists, or cannot be made.
    """
    config = load_run_config(choose_checkpoint(Path(policy), Path()).run).env
    env = Env(config)
    acting = load_policy(policy)
    joints = acting.metadata.joint_names
    home = np.array(acting.metadata.default_joint_angles)
    dt = acting.metadata.control_dt
    simulator = maker(name, env.mj_model, world, home)()
    episode = Episode(acting, simulator, world)
    random = np.random.default_rng(0)

    def measure() -> dict[str, np.ndarray | float]:
        measured = episode.measure()
        for quantity, noise in (("joint_angles", ENCODER_NOISE), ("ball_position", CAMERA_NOISE)):
            value = measured[quantity]
            measured[quantity] = value + noise * random.standard_normal(np.shape(value))
        return measured

    arm_file, ball_file = LOGS
    folder.mkdir(parents=True, exist_ok=True)
    motion = excite(config, seconds=20.0, max_velocity=1.0)
    episode.reset(home, np.array([[0.0, 10.0, 10.0]]), np.zeros((1, 3)))
    with Recorder(folder / arm_file, joints) as log:
        for time, target in zip(motion.times, motion.targets, strict=True):
            measured = {k: x for k, x in measure().items() if k.startswith("joint")}
            log.step(measured | {"time": time}, target)
            episode.run(np.tile(target, (round(dt * RATE), 1)))
    episode.reset(home, np.array([config.ball_init_pos]), np.zeros((1, 3)))
    with Recorder(folder / ball_file, joints, {"target_height": "m"}) as log:
        for step in range(round(BALL_SECONDS / dt)):
            heights = {"target_height": (0.4, 0.5, 0.6)[int(step * dt / 3.0) % 3]}
            measured = measure() | heights
            acting.step(measured)
            commands = acting.commands(RATE)
            episode.run(commands)
            log.step(measured | {"time": step * dt}, commands[-1])
    simulator.close()


def row_of(policy: str, name: str, world: str, given: argparse.Namespace) -> str:
    """One row of the table; stores the first episode if asked to."""
    if given.logs:
        record_logs(policy, name, WORLDS[world], given.logs)
        return f"written: {', '.join(str(given.logs / file) for file in LOGS)}"
    report, path, alarms = evaluate(policy, name, WORLDS[world], given.episodes, given.seed)
    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
        file = f"{policy}_{name}_{world}.npy".replace(" ", "_")
        np.save(given.out / file, path.astype(np.float32))

    def cell(value: float | None, passed: bool | None) -> str:
        return ("-" if value is None else f"{value:.3g}") + (" (fails)" if passed is False else "")

    values = [cell(result.value, result.passed) for result in report.results]
    length = report.details["mean_length_s"]
    error = report.details.get("mean_apex_error_m")
    apex = "" if error is None else f"{100.0 * error:.1f} cm"
    stopped = f"{len(alarms)} alarms {' '.join(sorted(set(alarms)))}".strip()
    cells = ["", policy, name, world, *values, apex, f"{length:.1f} s", stopped, ""]
    return " | ".join(cells).strip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("policies", nargs="*", default=["robust", "pretrained"])
    parser.add_argument(
        "--simulators", nargs="+", default=list(SIMULATORS), choices=[*SIMULATORS, "mujoco"]
    )
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=WORLDS)
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    parser.add_argument("--out", type=Path, help="folder for the positions of first episodes")
    parser.add_argument("--logs", type=Path, help="folder for logs, instead of results")
    given = parser.parse_args()
    cases = list(itertools.product(given.policies, given.simulators, given.worlds))
    if given.logs is not None:
        if len(cases) > 1:
            parser.error("--logs records one policy in one simulator and world; give one of each")
        for name in LOGS:
            if (given.logs / name).exists():
                parser.error(f"{given.logs / name} exists; give --logs another folder")
    # A simulator keeps settings for its process.
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(given.jobs, spawn, max_tasks_per_child=1) as pool:
        rows = [pool.submit(row_of, *case, given) for case in cases]
        for row in rows:
            print(row.result(), flush=True)


if __name__ == "__main__":
    main()
