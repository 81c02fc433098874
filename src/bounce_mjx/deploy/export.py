"""A trained policy as one ONNX graph.

It has a separate input for each part of the observation. The runtime checks the names and shapes of
the inputs; a single vector would hide a wrong order.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.deploy.graph import onnx_graph
from bounce_mjx.deploy.interface import robot_name
from bounce_mjx.deploy.metadata import (
    FORMAT,
    IS_FIRST,
    NEWEST,
    NEXT,
    UNITS,
    BallBounds,
    CommandLimits,
    GoalRange,
    Hinge,
    Input,
    Metadata,
    to_entries,
)
from bounce_mjx.env.env import Env, State
from bounce_mjx.errors import UserError, needed
from bounce_mjx.evaluation.episodes import reset_episodes
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.robot.actuators import largest_torques
from bounce_mjx.robot.arm import joint_name
from bounce_mjx.robot.config import is_packaged
from bounce_mjx.robot.model import (
    Addresses,
    data_at,
    find_addresses,
    joint_names,
    upper_face,
)
from bounce_mjx.runs.checkpoints import read_actor
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.folders import Checkpoint
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import world_model
from bounce_mjx.world.observation import ObservationConfig
from bounce_mjx.world.randomization import RandomizationConfig, entries

# Versions of 2022, which onnxruntime reads from 1.14 on.
_OPSET = 17
_IR_VERSION = 8

# An input and the output cannot share a name.
_INPUT_NAMES = {"action": "past_actions"}

# Episodes and control steps of a policy's own play, and the margin of its largest step.
_OWN_EPISODES = 64
_OWN_STEPS = 300
_MARGIN = 1.25

_ACTION = (
    "servo target of joint i in rad = clip(base[i] + action_scale * action[i], joint_ranges[i]), "
    "at most largest_step[i] from the last one, where base is the joint angles of the same "
    "observation; with max_lead, it is the last servo target within max_lead of them"
)
_LIMITED = "; the command moves toward it within limits"


def export_onnx(checkpoint: Checkpoint) -> bytes:
    """Exports a checkpoint's policy as an ONNX file: normaliser, network, clipping, what the task
    remembers of the measurements, and metadata.

    The inputs are float32 [N, history, size], named after the quantities (`past_actions` for
    action); the output is `action`, float32 [N, n]. If the policy sees quantities of the task's
    own, their inputs are the histories before the step, and each output `next/<name>` is the input
    `<name>` of the next step (`deploy.network`).

    Raises:
      UserError: the checkpoint is damaged, its arm or its task cannot be exported, or onnx is not
        installed.
    """
    with needed("onnx", "bounce_mjx[deploy]"):
        import onnx
    config = load_run_config(checkpoint.run)
    checkpoint, policy, _ = read_actor(checkpoint, config)
    networks = make_networks(config.ppo, config.env.layout.size, config.env.num_joints)
    metadata = policy_metadata(config, checkpoint.steps)
    if config.env.action.base == "measured":
        angle = largest_step(config.env, functools.partial(networks.act, policy))
        metadata = metadata._replace(largest_step=(angle,) * len(metadata.joint_names))
    names = [part.name for part in _inputs(config.env)]

    def act(histories: dict[str, jax.Array]) -> jax.Array:
        return networks.act(policy, jnp.concatenate([histories[name].ravel() for name in names]))

    with jax.enable_x64(False):
        function, inputs = _control_step(config.env, act)
        graph = onnx_graph(function, inputs, f"the task {config.env.task.__name__}")
    model = onnx.helper.make_model(
        graph,
        producer_name="bounce_mjx",
        opset_imports=[onnx.helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
    )
    onnx.helper.set_model_props(model, to_entries(metadata))
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


def policy_metadata(config: TrainConfig, steps: int) -> Metadata:
    """Metadata of a run's policy. Its `largest_step` is that of actions that add to the last
    target; where they add to the measured angles, `export_onnx` replaces it by that of the policy's
    own play.

    Args:
      steps: environment steps of the training.

    Raises:
      UserError: the MJCF file is missing, its paddle hangs on a joint that is not a hinge with a
        servo, or a goal has the name of a measurement.
    """
    env = config.env
    arm_limits = env.robot.limits
    if arm_limits.velocity is None:
        limits = None
        largest_steps = [env.action_scale] * env.num_joints
    else:
        limits = CommandLimits(arm_limits.velocity, arm_limits.acceleration, arm_limits.jerk)
        largest_steps = [speed * env.control_dt for speed in arm_limits.velocity]
    displacement = env.randomization.joint_start or (0.0, 0.0)
    if taken := env.goals.keys() & UNITS.keys():
        raise UserError(
            f"the goal {min(taken)} has the name of a measurement; give it another name in "
            f"the task {env.task.__name__}"
        )
    m = world_model(env, visual=False)
    addresses = find_addresses(m)
    chain, paddle, normal = _hinges(m, env.default_joint_angles)
    servos = list(addresses.actuators)
    gear = m.actuator_gear[servos, 0]
    torques = largest_torques(m, addresses.arm_joints, addresses.actuators)
    joint_ranges = []
    for low, high in m.jnt_range[list(addresses.arm_joints)].tolist():
        joint_ranges.append((low, high) if low < high else None)
    goals = {}
    for name, goal in env.goals.items():
        goals[name] = GoalRange((goal.low, goal.high), goal.unit)
    return Metadata(
        format=FORMAT,
        task=config.task,
        steps=steps,
        robot=robot_name(env.mjcf),
        joint_names=joint_names(m),
        num_balls=env.num_balls,
        ball=BallBounds(*env.ball_bounds),
        observation=_inputs(env),
        velocity=env.observation.velocity,
        control_dt=env.control_dt,
        action=_ACTION if limits is None else _ACTION + _LIMITED,
        action_base=env.action.base,
        action_scale=env.action_scale,
        max_lead=env.action.max_lead if env.action.base == "target" else None,
        largest_step=tuple(largest_steps),
        max_joint_velocity=env.max_joint_velocity,
        limits=limits,
        joint_ranges=tuple(joint_ranges),
        servo_stiffness=tuple((m.actuator_gainprm[servos, 0] * gear**2).tolist()),
        servo_damping=tuple((-m.actuator_biasprm[servos, 2] * gear**2).tolist()),
        torque_limits=tuple(np.where(np.isfinite(torques), torques, None).tolist()),
        default_joint_angles=env.default_joint_angles,
        start_noise=env.reset.joint_angles + float(np.max(np.abs(displacement))),
        goals=goals,
        randomization=_ranges(env.randomization),
        chain=chain,
        paddle=paddle,
        paddle_normal=normal,
        environment=_environment(env),
        joint_damping=tuple(m.dof_damping[list(addresses.arm_qvel)].tolist()),
        sag=_sag(m, addresses, env.default_joint_angles),
        ball_rests=env.task.ball_rests,
        ball_thrown=env.task.ball_thrown,
    )


def _sag(
    m: mujoco.MjModel, addresses: Addresses, joint_angles: Sequence[float]
) -> tuple[float, ...]:
    """How far the arm's weight takes each joint off its command at rest at these angles, rad."""
    data = data_at(m, addresses, joint_angles)
    mujoco.mj_forward(m, data)
    dofs = list(addresses.arm_qvel)
    torques = (data.qfrc_bias - data.qfrc_passive)[dofs]
    # What the servos carry beside their stiffness.
    is_carried = m.jnt_actgravcomp[list(addresses.arm_joints)] != 0
    torques = torques - np.where(is_carried, data.qfrc_gravcomp[dofs], 0.0)
    servos = list(addresses.actuators)
    stiffness = m.actuator_gainprm[servos, 0] * m.actuator_gear[servos, 0] ** 2
    # Rounded, as it differs in its last digits from one machine to another.
    return tuple(round(angle, 6) for angle in np.abs(torques / stiffness).tolist())


def _environment(env: WorldConfig) -> dict[str, Any]:
    """The settings as plain values; of an own arm's file only the name, as it stays behind."""
    values = env.model_dump()
    if env.mjcf is not None:
        values["mjcf"] = str(env.mjcf) if is_packaged(env.mjcf) else env.mjcf.name
    return values


def _ranges(randomization: RandomizationConfig) -> dict[str, tuple[float, float]]:
    """The ranges of the active terms, each axis or joint with its own under `name[i]`."""
    ranges = {}
    for name in randomization.terms:
        entry_ranges = entries(getattr(randomization, name))
        if len(entry_ranges) == 1:
            ranges[name] = entry_ranges[0]
        else:
            ranges |= {f"{name}[{i}]": ends for i, ends in enumerate(entry_ranges)}
    return ranges


def largest_step(config: WorldConfig, act: Callable[[jax.Array], jax.Array]) -> float:
    """Largest change of a joint's command from one control step to the next in the policy's own
    play, with a margin, rad; at least the `action_scale`.

    Where an action adds to the measured angle, the arm's own motion adds to the step.

    Args:
      act: observations [B, observation_size] -> actions [B, n].
    """
    env = Env(config)
    servos = jnp.array(env.addresses.actuators)
    gears = jnp.array(env.mj_model.actuator_gear[servos, 0])[:, None]

    def advance(carry: tuple[State, jax.Array, jax.Array], _: None) -> tuple:
        states, last, running = carry
        actions = act(states.obs.T).T
        now = states.pipeline_state
        control, _ = jax.vmap(env.control, in_axes=-1, out_axes=-1)(now, actions)
        commands = control.ctrl[servos] / gears
        steps = jnp.where(running, jnp.max(jnp.abs(commands - last), axis=0), 0.0)
        states = jax.vmap(env.step, in_axes=-1, out_axes=-1)(states, actions)
        return (states, commands, running & (states.done == 0.0)), jnp.max(steps)

    @jax.jit
    def play(key: jax.Array) -> jax.Array:
        states = reset_episodes(env, key, _OWN_EPISODES)
        angles = states.pipeline_state.physics.qpos[jnp.array(env.addresses.arm_qpos)]
        start = states, angles, jnp.ones(_OWN_EPISODES, bool)
        length = min(_OWN_STEPS, config.episode_steps)
        return jnp.max(jax.lax.scan(advance, start, None, length)[1])

    largest = _MARGIN * float(play(jax.random.key(0))) / config.action_scale
    # In quarters of the scale, which do not differ from one machine to another.
    return 0.25 * config.action_scale * max(4, math.ceil(4.0 * largest - 1e-3))


def _inputs(env: WorldConfig) -> tuple[Input, ...]:
    inputs = []
    for part in env.layout.parts:
        name = _INPUT_NAMES.get(part.name, part.name)
        inputs.append(Input(name, part.count, part.size, part.unit))
    return tuple(inputs)


def _hinges(
    m: mujoco.MjModel, default_joint_angles: Sequence[float]
) -> tuple[tuple[Hinge, ...], tuple[float, ...], tuple[float, ...]]:
    """Hinges from the world to the paddle, and in the last hinge's frame the paddle's centre and
    the normal of the face that is the upper one at the default joint angles.

    With the joints at their references, every hinge's frame has the axes of the world.
    """
    addresses = find_addresses(m)
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    body = m.geom_bodyid[addresses.paddle_geom]
    moving = m.body_weldid[body]
    joints = []
    dof = m.body_dofadr[moving] + m.body_dofnum[moving] - 1
    while dof >= 0:
        joints.append(int(m.dof_jntid[dof]))
        dof = m.dof_parentid[dof]
    links = []
    anchor = np.zeros(3)
    for joint in reversed(joints):
        name = joint_name(m, joint)
        if joint not in addresses.arm_joints:
            raise UserError(
                f"the paddle hangs on the joint {name!r}, which has no servo, and a policy can be "
                "exported for hinges with servos only; fix the joint, by removing it from the MJCF"
            )
        if m.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            raise UserError(
                f"the acting joint {name!r} is a slide, and a policy can be exported for hinges "
                "only; use it in JAX, where bounce_mjx.Run(FOLDER).policy acts on observations"
            )
        links.append(
            Hinge(
                joint=addresses.arm_joints.index(joint),
                position=tuple((data.xanchor[joint] - anchor).tolist()),
                quaternion=(1.0, 0.0, 0.0, 0.0),
                axis=tuple(data.xaxis[joint].tolist()),
                reference=float(m.qpos0[m.jnt_qposadr[joint]]),
            )
        )
        anchor = data.xanchor[joint]
    centre = data.geom_xpos[addresses.paddle_geom] - anchor
    normal_in_body, _ = upper_face(m, addresses, default_joint_angles)
    normal = data.xmat[body].reshape(3, 3) @ normal_in_body
    return tuple(links), tuple(centre.tolist()), tuple(normal.tolist())


def _floats(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def _control_step(
    env: WorldConfig, network: Callable[[dict[str, jax.Array]], jax.Array]
) -> tuple[Callable[[dict], dict], dict[str, jax.ShapeDtypeStruct]]:
    """A control step as a function of named arrays, and their shapes: the action, and what the task
    remembers of the measurements, as the environment computes it."""
    task = env.task(env)
    of_task = env.observation.counts("task")
    inputs = {part.name: _floats(part.history, part.size) for part in _inputs(env)}
    if not of_task:
        return lambda histories: {"action": network(histories)}, inputs

    measured = _measured_shapes(env)
    memory_shapes, _ = jax.eval_shape(task.first_quantities, measured)
    leaves, structure = jax.tree.flatten_with_path(memory_shapes)
    memory = {}
    for path, leaf in leaves:
        place = jax.tree_util.keystr(path, simple=True, separator="/")
        memory[f"memory/{place}"] = leaf

    def control_step(arrays: dict[str, jax.Array]) -> dict[str, jax.Array]:
        values = {}
        for name, shaped in measured.items():
            values[name] = arrays[NEWEST + name].reshape(shaped.shape)
        past = {name: arrays[name] for name in of_task}
        before = structure.unflatten([arrays[name] for name in memory])

        # At the first control step, a history is full of the first value.
        memory_at_first, first = task.first_quantities(values)
        memory_later, later = task.next_quantities(before, past, values)
        at_first = {name: jnp.broadcast_to(first[name], past[name].shape) for name in of_task}
        remembered, seen = jax.tree.map(
            lambda at_first, later: jnp.where(arrays[IS_FIRST], at_first, later),
            (memory_at_first, at_first),
            (memory_later, {name: later[name] for name in of_task}),
        )
        outputs = {"action": network(arrays | seen)}
        for name, history in seen.items():
            outputs[NEXT + name] = history
        for name, leaf in zip(memory, jax.tree.leaves(remembered), strict=True):
            outputs[NEXT + name] = leaf
        return outputs

    for name, shaped in measured.items():
        inputs[NEWEST + name] = _floats(shaped.size)
    return control_step, inputs | memory | {IS_FIRST: jax.ShapeDtypeStruct((), bool)}


def _measured_shapes(env: WorldConfig) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes of what a task may compute its quantities from: the measurements and the goals."""
    measured = {}
    for name, quantity in ObservationConfig.quantities().items():
        size = quantity.entries(env.num_joints, 1)
        has_rows = quantity.per_ball and env.num_balls > 1
        measured[name] = _floats(env.num_balls, size) if has_rows else _floats(size)
    for name in env.goals:
        measured[name] = _floats(1)
    measured["ball_picture"] = measured["ball_position"]
    return measured
