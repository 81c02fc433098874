"""The simulated robot: its MJCF file, the names in it, and the addresses of its data."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from bounce_mjx.errors import UserError
from bounce_mjx.lazy import jax, jnp, mujoco, np
from bounce_mjx.resources import resource_path

JOINT_NAMES = tuple(f"Joint{i}" for i in range(1, 7))
BALL_BODY_NAME = "ball_link"
PADDLE_GEOM_NAME = "blocker"

# Fields that MuJoCo's compiler can compute from others.
_DERIVED_FIELDS = frozenset(
    (
        "actuator_acc0",
        "actuator_length0",
        "body_inertia",
        "body_invweight0",
        "body_subtreemass",
        "dof_M0",
        "dof_invweight0",
        "dof_length",
        "geom_aabb",
        "geom_rbound",
    )
)


class Addresses(NamedTuple):
    """Indices of the named parts in the arrays of the model."""

    arm_joints: tuple[int, ...]
    """Ids of Joint1..Joint6."""
    arm_qpos: tuple[int, ...]
    """Joint angles in qpos."""
    arm_qvel: tuple[int, ...]
    """Joint velocities in qvel."""
    actuators: tuple[int, ...]
    """Servos of Joint1..Joint6 in ctrl."""
    ball_body: int
    ball_geom: int
    ball_qpos: tuple[int, ...]
    """The ball's position (3) and quaternion (4) in qpos."""
    ball_qvel: tuple[int, ...]
    """The ball's linear (3) and angular (3) velocity in qvel."""
    paddle_geom: int


def load_model(mjcf: Path | None, physics_dt: float, visual: bool = True) -> mujoco.MjModel:
    """Compiles an MJCF file.

    Args:
      mjcf: the file; None for the project's own robot.
      physics_dt: physics time step, s.
      visual: False drops the textures and geoms that only pictures need; they take most of a
        model's memory.

    Raises:
      UserError: the file is missing, is no MJCF, lacks a name that the task needs, has a joint
        without a position servo, or has a number that cannot be simulated.
    """
    path = mjcf or resource_path("mjcf/bounce_ball.xml")
    if not os.path.isfile(path):
        raise UserError(f"the MJCF file {path} does not exist; give the path of an MJCF file")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.discardvisual = spec.compiler.discardvisual or not visual
        mj_model = spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise UserError(f"the MJCF file {path} does not compile ({reason}); correct it") from error
    try:
        _check_numbers(mj_model)
        _check_servos(mj_model, find_addresses(mj_model))
    except UserError as error:
        raise UserError(f"the MJCF file {path} has {error}") from error
    mj_model.opt.timestep = physics_dt
    return mj_model


def _check_numbers(mj_model: mujoco.MjModel) -> None:
    """Refuses a time step that is not positive, and numbers that are not finite."""
    step = mj_model.opt.timestep
    if not 0.0 < step < np.inf:
        raise UserError(f"the timestep {step}; give a positive number of seconds")
    fields = [(mj_model, name) for name in _physical_fields(mj_model)]
    fields += [(mj_model.opt, name) for name in ("gravity", "wind", "density", "viscosity")]
    # Derived fields come last: the message must name a number that is in the file.
    for owner, name in sorted(fields, key=lambda field: field[1] in _DERIVED_FIELDS):
        values = np.asarray(getattr(owner, name))
        if np.issubdtype(values.dtype, np.floating) and not np.all(np.isfinite(values)):
            value = values[~np.isfinite(values)][0]
            raise UserError(f"the number {value} in {name}; give finite numbers")


def _check_servos(mj_model: mujoco.MjModel, addresses: Addresses) -> None:
    """Refuses actuators whose control is not a target position of their joint."""
    plain_or_filtered = (
        mujoco.mjtDyn.mjDYN_NONE,
        mujoco.mjtDyn.mjDYN_FILTER,
        mujoco.mjtDyn.mjDYN_FILTEREXACT,
    )
    for name, actuator in zip(JOINT_NAMES, addresses.actuators, strict=True):
        is_position_servo = (
            mj_model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
            and mj_model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
            and mujoco.mjtDyn(mj_model.actuator_dyntype[actuator]) in plain_or_filtered
            and mj_model.actuator_gainprm[actuator, 0] > 0.0
            and mj_model.actuator_biasprm[actuator, 1] < 0.0
        )
        if not is_position_servo:
            raise UserError(
                f"an actuator on {name} that is no position servo; drive it by "
                f'<position joint="{name}"/>'
            )


def find_addresses(mj_model: mujoco.MjModel) -> Addresses:
    """Addresses of the task's parts.

    Raises:
      UserError: a needed name is missing; the text starts with the missing part.
    """
    joints = tuple(_find(mj_model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in JOINT_NAMES)
    ball_body = _find(mj_model, mujoco.mjtObj.mjOBJ_BODY, BALL_BODY_NAME)
    paddle_geom = _find(mj_model, mujoco.mjtObj.mjOBJ_GEOM, PADDLE_GEOM_NAME)

    ball_joint = mj_model.body_jntadr[ball_body]
    if ball_joint < 0 or mj_model.jnt_type[ball_joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise UserError(f"no free joint on the body {BALL_BODY_NAME}; add <freejoint/> to it")
    if mj_model.body_geomnum[ball_body] < 1:
        raise UserError(f"no geom on the body {BALL_BODY_NAME}; add the ball's sphere to it")
    actuators = []
    for joint, name in zip(joints, JOINT_NAMES, strict=True):
        driving = [
            i
            for i in range(len(mj_model.actuator_trntype))
            if mj_model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
            and mj_model.actuator_trnid[i, 0] == joint
        ]
        if len(driving) != 1:
            raise UserError(
                f"{len(driving)} actuators on {name}; give it exactly one position servo"
            )
        actuators.append(driving[0])
    ball_qpos, ball_qvel = mj_model.jnt_qposadr[ball_joint], mj_model.jnt_dofadr[ball_joint]
    return Addresses(
        arm_joints=joints,
        arm_qpos=tuple(int(mj_model.jnt_qposadr[joint]) for joint in joints),
        arm_qvel=tuple(int(mj_model.jnt_dofadr[joint]) for joint in joints),
        actuators=tuple(actuators),
        ball_body=ball_body,
        ball_geom=_ball_geom(mj_model, ball_body),
        ball_qpos=tuple(range(ball_qpos, ball_qpos + 7)),
        ball_qvel=tuple(range(ball_qvel, ball_qvel + 6)),
        paddle_geom=paddle_geom,
    )


def resting_activations(mj_model: mujoco.MjModel, qpos: Sequence[jax.Array]) -> jax.Array | None:
    """Activations [na] at which the servos hold the joint positions qpos [nq] (a servo with a
    `timeconst` filters its target); None where the model has none."""
    if mj_model.na == 0:
        return None
    activations = [jnp.zeros_like(qpos[0])] * mj_model.na
    for actuator in range(mj_model.nu):
        if mj_model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT:
            joint = mj_model.actuator_trnid[actuator, 0]
            length = mj_model.actuator_gear[actuator, 0] * qpos[mj_model.jnt_qposadr[joint]]
            first = mj_model.actuator_actadr[actuator]
            for i in range(first, first + mj_model.actuator_actnum[actuator]):
                activations[i] = length
    return jnp.stack(activations)


def fingerprint(mj_model: mujoco.MjModel) -> bytes:
    """A hash of the numbers on which a simulation depends; it ignores colours and markers."""
    digest = hashlib.blake2b()
    for owner, names in (
        (mj_model, _physical_fields(mj_model)),
        (mj_model.opt, [name for name in dir(mj_model.opt) if not name.startswith("_")]),
    ):
        for name in names:
            digest.update(np.asarray(getattr(owner, name)).tobytes())
    return digest.digest()


def check_unedited(mj_model: mujoco.MjModel, built_from: bytes) -> None:
    """Compares a model with its earlier `fingerprint`.

    Raises:
      UserError: the model was edited, and the engines built from it would ignore the edit.
    """
    if fingerprint(mj_model) != built_from:
        raise UserError(
            "env.mj_model was edited after the environment had been built, and the physics would "
            "ignore the edit; edit the MJCF (env.mjcf), or pass randomize=... to BounceBall"
        )


def _physical_fields(mj_model: mujoco.MjModel) -> list[str]:
    kinds = ("body_", "jnt_", "dof_", "geom_", "pair_", "actuator_", "eq_", "tendon_", "qpos")
    pictured = ("geom_rgba", "geom_matid", "geom_group")
    return [name for name in dir(mj_model) if name.startswith(kinds) and name not in pictured]


def _ball_geom(mj_model: mujoco.MjModel, ball_body: int) -> int:
    """The ball's geom in the contact pair; without a pair, its first geom."""
    ball_geoms = {
        int(geom)
        for pair in range(mj_model.npair)
        for geom in (mj_model.pair_geom1[pair], mj_model.pair_geom2[pair])
        if mj_model.geom_bodyid[geom] == ball_body
    }
    return min(ball_geoms, default=int(mj_model.body_geomadr[ball_body]))


def _find(mj_model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    index = mujoco.mj_name2id(mj_model, kind, name)
    if index < 0:
        noun = kind.name.removeprefix("mjOBJ_").lower()
        needed = ", ".join((*JOINT_NAMES, BALL_BODY_NAME, PADDLE_GEOM_NAME))
        raise UserError(f"no {noun} named {name}; the task needs the names {needed}")
    return index
