"""Arms for tests: random serial chains with every feature that the fused engine computes."""

import mujoco
import numpy as np

HINGE, SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
HALF_SIZE = (0.15, 0.2, 0.004)
RADIUS = 0.02


def random_arm(num_joints: int, seed: int) -> mujoco.MjModel:
    """An arm of hinges and slides that holds a level paddle, and a ball.

    The joints have anchors, skew axes, references, springs, damping, armature and dry friction; the
    servos have gears and limits; bodies are welded to the base, to links and to the paddle,
    each with its own inertial frame and share of gravity compensation. Two joints share one body.
    MuJoCo's solver converges to rounding error.
    """
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spec.option.timestep = 1e-3
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.tolerance = 1e-15
    spec.compiler.degree = False
    body = _add_body(spec.worldbody, rng, welded=True)
    for i in range(num_joints):
        shares_body = i == 1
        if not shares_body:
            body = _add_body(body, rng)
        _add_joint(spec, body, rng, i)
        if i % 2 and not shares_body:
            _add_body(body, rng, welded=True)  # a side branch
            body = _add_body(body, rng, welded=True)
    _add_body(spec.worldbody.bodies[0].bodies[0], rng, welded=True)  # numbered after the links
    blade = _add_body(body, rng, welded=True, gravcomp=0.5)
    blade.add_geom(
        name="blocker",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=HALF_SIZE,
        pos=rng.uniform(-0.03, 0.03, 3),
        quat=_unit(rng),
        contype=0,
        conaffinity=0,
        mass=0,
    )
    ball = spec.worldbody.add_body(name="ball_link")
    ball.add_freejoint()
    ball.add_geom(
        name="ball",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=(RADIUS, 0, 0),
        mass=0.003,
        contype=0,
        conaffinity=0,
    )
    pair = spec.add_pair(geomname1="blocker", geomname2="ball", condim=1)
    pair.solref, pair.solimp = (-98696.0, -31.4), (0.95, 0.99, 0.001, 0.5, 2.0)
    model = spec.compile()

    # Turn the paddle until it is level in the reference pose.
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    inverse, body_quat = np.zeros(4), data.xquat[model.geom("blocker").bodyid[0]]
    mujoco.mju_negQuat(inverse, body_quat)
    spec.geom("blocker").quat = inverse
    return spec.compile()


def _unit(rng: np.random.Generator) -> np.ndarray:
    quaternion = rng.normal(size=4)
    return quaternion / np.linalg.norm(quaternion)


def _add_body(
    parent: mujoco.MjsBody, rng: np.random.Generator, welded: bool = False, gravcomp: float = 0.0
) -> mujoco.MjsBody:
    mass = rng.uniform(0.1, 0.4) if welded else rng.uniform(0.5, 2.0)
    principal = mass * rng.uniform(0.002, 0.004, 3)
    return parent.add_body(
        pos=rng.uniform(-0.15, 0.15, 3),
        quat=_unit(rng),
        mass=mass,
        ipos=rng.uniform(-0.08, 0.08, 3),
        iquat=_unit(rng),
        inertia=principal,
        explicitinertial=True,
        gravcomp=gravcomp or rng.choice([0.0, 1.0, 0.4]),
    )


def _add_joint(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, rng: np.random.Generator, index: int
) -> None:
    axes = [(0, 0, 1), (0, -1, 0), (1, 0, 0), tuple(rng.normal(size=3))]
    joint = body.add_joint(
        name=f"joint{index}",
        type=SLIDE if index % 3 == 2 else HINGE,
        axis=axes[index % 4],
        pos=rng.uniform(-0.05, 0.05, 3),
        ref=rng.uniform(-0.5, 0.5),
        stiffness=rng.uniform(0.0, 30.0),
        springref=rng.uniform(-0.5, 0.5),
        damping=rng.uniform(0.0, 3.0),
        armature=0.02,
        frictionloss=2.0 * (index % 2),
        limited=False,
    )
    if index % 2 == 0:
        joint.actfrclimited = True
        joint.actfrcrange = (-rng.uniform(60.0, 150.0), rng.uniform(60.0, 150.0))
    joint.actgravcomp = index % 4 == 0
    gear, kp, kv = rng.uniform(0.5, 2.0) * (-1) ** index, 4000.0, 40.0
    servo = spec.add_actuator(
        name=f"servo{index}",
        target=joint.name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gear=[gear, 0, 0, 0, 0, 0],
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
    )
    servo.gainprm[0] = kp
    servo.biasprm[:3] = (0.0, -kp, -kv)
    if index % 3 != 1:
        servo.forcelimited = True
        servo.forcerange = (-rng.uniform(60.0, 150.0), rng.uniform(60.0, 150.0))
    servo.ctrllimited = True
    servo.ctrlrange = (gear * joint.ref - 0.05, gear * joint.ref + 0.05)
