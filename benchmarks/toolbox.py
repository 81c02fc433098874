"""MuJoCo's own identification toolbox (`mujoco[sysid]`) on the log of a hidden robot, next to
benchmarks/identify.py: time and error for the parameters that it has.

`python benchmarks/toolbox.py LOG.csv --seed SEED`. It fits the arm during the excitation, from one
rollout of 20 s on MuJoCo's C engine: gain, damping and dry friction of each joint, and one delay.
The toolbox delays sensors; without a ball this equals a delay of the targets.
"""

import argparse
import time
from pathlib import Path

import mujoco
import numpy as np
from identify import hidden_robot
from mujoco import sysid

from bounce_mjx.identify.reading import read_csv
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.model import find_addresses, joint_names, load_model, scene_spec
from bounce_mjx.runs.settings import read_preset

_STARTS = {"servo_gain": 1.0, "servo_damping": 1.0, "joint_frictionloss": 1.0}
_LIMITS = {
    "servo_gain": (0.5, 2.0),
    "servo_damping": (0.5, 2.0),
    "joint_frictionloss": (0.0, 20.0),
}
_DELAY = (0.02, 0.0, 0.08)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--seconds", type=float, default=20.0)
    given = parser.parse_args()
    config = read_preset(resource_path("configs/default.yaml")).env
    spec, _ = scene_spec(config.mjcf, config.robot)
    for pair in list(spec.pairs):
        spec.delete(pair)
    spec.option.timestep = config.physics_dt
    names = joint_names(load_model(config.mjcf, config.physics_dt, visual=False))
    for name in names:
        spec.add_sensor(
            name=f"{name}_angle",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=name,
        )
    model = spec.compile()
    addresses, log = find_addresses(model), read_csv(given.log, names)
    # Targets are held between two control steps; the toolbox would interpolate them.
    times = np.arange(0.0, given.seconds, config.physics_dt)
    index = np.searchsorted(log.target_times, times + 1e-3, side="right") - 1
    ctrl = np.zeros((len(times), model.nu))
    ctrl[:, list(addresses.actuators)] = log.servo_targets[np.maximum(index, 0)]
    measured = log.times < given.seconds
    data = mujoco.MjData(model)
    data.qpos[list(addresses.arm_qpos)] = config.default_joint_angles
    sequences = sysid.ModelSequences(
        "arm",
        spec,
        "excitation",
        sysid.create_initial_state(model, data.qpos),
        sysid.TimeSeries.from_control_names(times, ctrl, model),
        sysid.TimeSeries.from_names(
            np.maximum(log.times[measured], 0.0),
            log.joint_angles[measured],
            model,
            [f"{name}_angle" for name in names],
        ),
    )
    params = sysid.ParameterDict()
    for term, start in _STARTS.items():
        for j in range(len(names)):
            params.add(sysid.Parameter(f"{term} {j}", start, *_LIMITS[term]))
    params.add(sysid.Parameter("delay", *_DELAY))

    def build(params: sysid.ParameterDict, spec: mujoco.MjSpec) -> mujoco.MjModel:
        built = spec.compile()
        for j, actuator in enumerate(addresses.actuators):
            gain, damping, friction = (float(params[f"{t} {j}"].value[0]) for t in _STARTS)
            built.actuator_gainprm[actuator, 0] = gain * model.actuator_gainprm[actuator, 0]
            built.actuator_biasprm[actuator, 1] = gain * model.actuator_biasprm[actuator, 1]
            built.actuator_biasprm[actuator, 2] = damping * model.actuator_biasprm[actuator, 2]
            built.dof_frictionloss[addresses.arm_qvel[j]] = friction
        return built

    transform = sysid.SignalTransform()
    transform.delay("*_angle", params["delay"])
    residual = sysid.build_residual_fn(
        models_sequences=[sequences], build_model=build, modify_residual=transform.apply
    )
    begin, begin_processor = time.perf_counter(), time.process_time()
    found, _ = sysid.optimize(params, residual, optimizer="mujoco", verbose=False)
    seconds, processor = time.perf_counter() - begin, time.process_time() - begin_processor
    true = hidden_robot(given.seed).world
    ratio = np.array(
        [
            float(found[f"servo_damping {j}"].value[0] / found[f"servo_gain {j}"].value[0])
            for j in range(len(names))
        ]
    )
    worst = np.max(np.abs(ratio / (true["servo_damping"] / true["servo_gain"]) - 1.0))
    delay = float(found["delay"].value[0])
    print(f"{seconds:.0f} s, {processor:.0f} s of a processor")
    print(
        f"delay {1e3 * delay:.2f} ms, action_latency {1e3 * float(true['action_latency']):.2f} ms"
    )
    print(
        f"servo_lag of the robot, which the toolbox lacks: {1e3 * float(true['servo_lag']):.2f} ms"
    )
    print(f"damping / gain of a joint: off by {100.0 * worst:.1f}% at most")


if __name__ == "__main__":
    main()
