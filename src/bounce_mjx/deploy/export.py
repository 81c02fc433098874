"""A trained policy as one ONNX graph, or as a compiled JAX function.

Both have a separate input for each part of the observation. The runtime checks the names and shapes
of the inputs; a single vector would hide a wrong order.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.deploy import metadata as metadata_module
from bounce_mjx.deploy.metadata import FORMAT, Link, Metadata, Part
from bounce_mjx.errors import UserError, needed
from bounce_mjx.learning.policy import Policy, act, make_networks
from bounce_mjx.learning.statistics import MAX_NORMALIZED, MIN_STD
from bounce_mjx.robot.model import find_addresses, joint_name, joint_names, load_model
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.folders import Checkpoint
from bounce_mjx.runs.reading import load_policy
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.estimator import filter_constants, paddle_normal
from bounce_mjx.world.observation import parts

# Versions of 2022, which onnxruntime reads from 1.14 on.
_OPSET, _IR_VERSION = 17, 8

_EXTRA = "'bounce_mjx[export]'"

# An input and the output cannot share a name.
_INPUT_NAMES = {"action": "past_actions"}

_ACTION = (
    "servo target of joint i in rad = clip(joint_angles[i] + action_scale * action[i], "
    "joint_ranges[i]), from the joint angles of the same observation"
)


def export_onnx(checkpoint: Checkpoint) -> bytes:
    """Exports a checkpoint's policy as an ONNX file: normaliser, network, clipping and metadata.

    The inputs are float32 [N, history, size], named after the quantities (`past_actions` for
    action); the output is `action`, float32 [N, n].

    Raises:
      UserError: the checkpoint is damaged, its arm cannot be exported, or onnx is not installed.
    """
    config = load_run_config(checkpoint.run)
    policy = load_policy(checkpoint, config)
    metadata = describe(config, checkpoint.steps)
    return _onnx_model(policy, metadata, len(config.ppo.hidden_layers)).SerializeToString(
        deterministic=True
    )


def export_jax(checkpoint: Checkpoint) -> bytes:
    """Exports a checkpoint's policy as a `jax.export` artefact for the CPU and CUDA.

    `jax.export.deserialize(artefact).call(inputs)` gives the actions [N, n] for any N; `inputs` is
    a dict with the names and shapes of `export_onnx`.

    Raises:
      UserError: the checkpoint is damaged, or flatbuffers is not installed.
    """
    with needed("flatbuffers", _EXTRA):
        # JAX serialises with it.
        import flatbuffers  # noqa: F401
    config = load_run_config(checkpoint.run)
    policy = load_policy(checkpoint, config)
    parts = _parts(config.env)
    networks = make_networks(config.ppo, config.env.layout.size, config.env.num_joints)

    def call(inputs: dict[str, jax.Array]) -> jax.Array:
        flat = [inputs[p.name].reshape(-1, p.history * p.size) for p in parts]
        return act(networks, policy, jnp.concatenate(flat, axis=-1))

    (n,) = jax.export.symbolic_shape("n")
    shapes = {p.name: jax.ShapeDtypeStruct((n, p.history, p.size), jnp.float32) for p in parts}
    return jax.export.export(jax.jit(call), platforms=("cpu", "cuda"))(shapes).serialize()


def describe(config: TrainConfig, steps: int) -> Metadata:
    """Metadata of a run's policy.

    Args:
      steps: environment steps of the training.

    Raises:
      UserError: the MJCF file is missing, or its paddle hangs on a joint that is no hinge
        with a servo.
    """
    env = config.env
    m = load_model(env.mjcf, env.physics_dt, visual=False, robot=env.robot)
    addresses = find_addresses(m)
    chain, paddle, normal = _chain(m, env.default_joint_angles)
    filtered = env.observation.is_filtered
    servos = list(addresses.actuators)
    gear = m.actuator_gear[servos, 0]
    limited = m.actuator_forcelimited[servos]
    return Metadata(
        format=FORMAT,
        steps=steps,
        joint_names=joint_names(m),
        observation=_parts(env),
        position=env.observation.position,
        velocity=env.observation.velocity,
        estimator=filter_constants(env, m) if filtered else None,
        control_dt=env.control_dt,
        action=_ACTION,
        action_scale=env.action_scale,
        joint_ranges=tuple(
            (low, high) if low < high else None
            for low, high in m.jnt_range[list(addresses.arm_joints)].tolist()
        ),
        servo_stiffness=_plain(m.actuator_gainprm[servos, 0] * gear**2),
        servo_damping=_plain(-m.actuator_biasprm[servos, 2] * gear**2),
        torque_limits=tuple(
            float(high * g) if is_limited else None
            for high, g, is_limited in zip(
                m.actuator_forcerange[servos, 1], gear, limited, strict=True
            )
        ),
        default_joint_angles=env.default_joint_angles,
        target_height_range=env.target_heights,
        randomization={name: getattr(env.randomization, name) for name in env.randomization.terms},
        bounce_max_distance=env.bounce_max_distance,
        chain=chain,
        paddle=paddle,
        paddle_normal=normal,
    )


def _parts(env: WorldConfig) -> tuple[Part, ...]:
    return tuple(
        Part(_INPUT_NAMES.get(q.name, q.name), history, q.size, q.unit)
        for q in parts(env.num_joints)
        if (history := getattr(env.observation, q.name))
    )


def _plain(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _chain(
    m: mujoco.MjModel, default_joint_angles: Sequence[float]
) -> tuple[tuple[Link, ...], tuple[float, ...], tuple[float, ...]]:
    """Hinges from the world to the paddle, and in the last hinge's frame the paddle's centre and
    the normal of the face that is the upper one at the default joint angles."""
    addresses = find_addresses(m)
    body = m.geom_bodyid[addresses.paddle_geom]
    bodies = [body]
    while body := m.body_parentid[body]:
        bodies.append(body)
    position, quaternion, links = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), []
    for body in reversed(bodies):
        position = position + _rotated(m.body_pos[body], quaternion)
        quaternion = _product(quaternion, m.body_quat[body])
        first = m.body_jntadr[body]
        for joint in range(first, first + m.body_jntnum[body]):
            is_hinge = m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
            if joint not in addresses.arm_joints or not is_hinge:
                raise UserError(
                    f"the paddle hangs on the joint {joint_name(m, joint)!r}, and a policy can be "
                    "exported for hinges with servos only; remove the joint from the MJCF"
                )
            anchor = m.jnt_pos[joint]
            links.append(
                Link(
                    joint=addresses.arm_joints.index(joint),
                    position=_plain(position + _rotated(anchor, quaternion)),
                    quaternion=_plain(quaternion),
                    axis=_plain(m.jnt_axis[joint]),
                    reference=float(m.qpos0[m.jnt_qposadr[joint]]),
                )
            )
            position, quaternion = -anchor, np.array([1.0, 0.0, 0.0, 0.0])
    centre = position + _rotated(m.geom_pos[addresses.paddle_geom], quaternion)
    normal = _rotated(paddle_normal(m, default_joint_angles), quaternion)
    return tuple(links), _plain(centre), _plain(normal)


def _rotated(vector: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    result = np.zeros(3)
    mujoco.mju_rotVecQuat(result, vector, quaternion)
    return result


def _product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    result = np.zeros(4)
    mujoco.mju_mulQuat(result, p, q)
    return result


def _onnx_model(policy: Policy, metadata: Metadata, num_hidden_layers: int) -> Any:
    """ONNX model of a policy network; flax names the layers MLP_0/hidden_i and Dense_0."""
    with needed("onnx", _EXTRA):
        import onnx
        from onnx import helper, numpy_helper

    nodes, constants = [], []

    def constant(name: str, value: Any, dtype: type = np.float32) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def node(kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, inputs, [output], name=output, **attributes))
        return output

    parts = metadata.observation
    flat = [node("Flatten", [p.name], f"{p.name}/flat", axis=1) for p in parts]
    x = node("Concat", flat, "observation", axis=1)
    mean, std = (np.asarray(a) for a in policy.normalizer)
    x = node("Sub", [x, constant("normalizer/mean", mean)], "normalizer/centred")
    x = node("Div", [x, constant("normalizer/std", std)], "normalizer/scaled")
    limits = [
        constant("normalizer/least", -MAX_NORMALIZED),
        constant("normalizer/most", MAX_NORMALIZED),
    ]
    x = node("Clip", [x, *limits], "normalizer/clipped")
    varied = constant("normalizer/varied", std > MIN_STD, bool)
    x = node("Where", [varied, x, constant("normalizer/zero", 0.0)], "normalizer/output")

    params = policy.params["params"]
    hidden = params["MLP_0"]
    for i in range(num_hidden_layers):
        name = f"hidden_{i}"
        weights = [constant(f"{name}/{k}", hidden[name][k]) for k in ("kernel", "bias")]
        x = node("Gemm", [x, *weights], f"{name}/linear")
        x = node("Mul", [x, node("Sigmoid", [x], f"{name}/sigmoid")], f"{name}/silu")
    weights = [constant(f"mean/{k}", params["Dense_0"][k]) for k in ("kernel", "bias")]
    x = node("Gemm", [x, *weights], "mean")
    limits = [constant("action/least", -1.0), constant("action/most", 1.0)]
    node("Clip", [x, *limits], "action")

    def tensor(name: str, shape: list, text: str) -> Any:
        return helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape, text)

    inputs = [
        tensor(p.name, ["N", p.history, p.size], f"the newest first; {p.unit or 'no unit'}")
        for p in parts
    ]
    outputs = [tensor("action", ["N", len(metadata.joint_names)], metadata.action)]
    graph = helper.make_graph(nodes, "policy", inputs, outputs, constants)
    model = helper.make_model(
        graph,
        producer_name="bounce_mjx",
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
    )
    helper.set_model_props(model, metadata_module.to_entries(metadata))
    onnx.checker.check_model(model, full_check=True)
    return model
