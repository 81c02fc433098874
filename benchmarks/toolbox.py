"""MuJoCo's own identification toolbox (`mujoco[sysid]`) on an arm's log, for
benchmarks/real_logs.py --toolbox.

It has the unknowns of `bounce-mjx identify` that a model file can express: gain, damping, offset
and dry friction of each servo, and one delay. The toolbox delays sensors; for an arm alone this
equals a delay of the targets. The whole log is one rollout on MuJoCo's C engine.
"""

from typing import Literal

import mujoco
import numpy as np
from mujoco import sysid

from bounce_mjx.identify.following import SETTLING
from bounce_mjx.identify.log import Log
from bounce_mjx.identify.simulation import make_targets
from bounce_mjx.robot.model import find_addresses, joint_names, scene_spec
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import world_model

# First value, and bounds, of each joint's unknowns.
_OF_JOINTS = {
    "servo_gain": (1.0, 0.1, 100.0),
    "servo_damping": (1.0, 0.05, 20.0),
    "servo_offset": (0.0, -0.1, 0.1),
    "joint_frictionloss": (1.0, 0.0, 20.0),
}
_DELAY = (0.02, 0.0, 0.08)
Optimizer = Literal["mujoco", "scipy"]
"""MuJoCo's own least squares, or SciPy's `least_squares(method="trf")`."""


def fit_with_toolbox(config: WorldConfig, log: Log, optimizer: Optimizer) -> dict[str, np.ndarray]:
    """The world of an arm, from the toolbox's fit of a log."""
    names = joint_names(world_model(config, visual=False))
    spec = _arm_alone(config, names)
    model = spec.compile()
    addresses = find_addresses(model)
    actuators = list(addresses.actuators)
    params = sysid.ParameterDict()
    for term, (first, low, high) in _OF_JOINTS.items():
        for joint in range(len(names)):
            params.add(sysid.Parameter(f"{term} {joint}", first, low, high))
    params.add(sysid.Parameter("delay", *_DELAY))

    def terms_of(values: sysid.ParameterDict) -> dict[str, np.ndarray]:
        return {
            term: np.array([float(values[f"{term} {j}"].value[0]) for j in range(len(names))])
            for term in _OF_JOINTS
        }

    def build(values: sysid.ParameterDict, arm: mujoco.MjSpec) -> mujoco.MjModel:
        built = arm.compile()
        terms = terms_of(values)
        stiffness = terms["servo_gain"] * model.actuator_gainprm[actuators, 0]
        damping = terms["servo_damping"] * model.actuator_biasprm[actuators, 2]
        built.actuator_gainprm[actuators, 0] = stiffness
        built.actuator_biasprm[actuators, 0] = stiffness * terms["servo_offset"]
        built.actuator_biasprm[actuators, 1] = -stiffness
        built.actuator_biasprm[actuators, 2] = damping
        built.dof_frictionloss[list(addresses.arm_qvel)] = terms["joint_frictionloss"]
        return built

    transform = sysid.SignalTransform()
    transform.delay("*_angle", params["delay"])
    residual = sysid.build_residual_fn(
        models_sequences=[_rollout(model, spec, log, names)],
        build_model=build,
        modify_residual=transform.apply,
    )
    options = {"x_scale": "jac"} if optimizer == "scipy" else {}
    found, _ = sysid.optimize(params, residual, optimizer=optimizer, verbose=False, **options)
    # The toolbox stamps a sensor with the end of the step at whose start it was computed.
    delay = found["delay"].value[0] + config.physics_dt
    return terms_of(found) | {"action_latency": np.array(delay)}


def _arm_alone(config: WorldConfig, names: tuple[str, ...]) -> mujoco.MjSpec:
    """The model without contacts, with a sensor of each joint's angle."""
    spec, _ = scene_spec(config.mjcf, config.robot)
    for pair in list(spec.pairs):
        spec.delete(pair)
    spec.option.timestep = config.physics_dt
    for name in names:
        spec.add_sensor(
            name=f"{name}_angle",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=name,
        )
    return spec


def _rollout(
    model: mujoco.MjModel, spec: mujoco.MjSpec, log: Log, names: tuple[str, ...]
) -> sysid.ModelSequences:
    """The log as one rollout from its first row, which need not rest: its first angles do not
    count."""
    addresses = find_addresses(model)
    dt = model.opt.timestep
    start = log.times[0]
    count = int((log.times[-1] - start) / dt) + 1
    # Targets are held between two control steps; the toolbox would interpolate them. There is one
    # target between each two of these times.
    targets_after = make_targets(log, start + dt * np.arange(count + 1))
    ctrl = np.zeros((count, model.nu))
    latency = 0.0
    lag = 0.0
    ctrl[:, list(addresses.actuators)] = targets_after(latency, lag)
    data = mujoco.MjData(model)
    data.qpos[list(addresses.arm_qpos)] = log.joint_angles[0]
    is_settled = log.times - start > SETTLING
    return sysid.ModelSequences(
        "arm",
        spec,
        "log",
        sysid.create_initial_state(model, data.qpos),
        sysid.TimeSeries.from_control_names(dt * np.arange(count), ctrl, model),
        sysid.TimeSeries.from_names(
            log.times[is_settled] - start,
            log.joint_angles[is_settled],
            model,
            [f"{name}_angle" for name in names],
        ),
    )
