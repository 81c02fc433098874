"""Identification of hidden robots, which MuJoCo's C engine simulates: errors, and coverage of the
intervals.

`python benchmarks/identify.py --seeds 1000-1004 --robot-step 5e-4 --spike --out FILE.json`. Seeds
below 20 are for the final report alone; tune on seeds from 1000.
"""

import argparse
import csv
import json
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.recorder import Recorder
from bounce_mjx.identify import Topics
from bounce_mjx.identify.estimates import estimates
from bounce_mjx.identify.excitation import excite
from bounce_mjx.identify.identification import Identified, identify
from bounce_mjx.identify.reading import read_log
from bounce_mjx.identify.world_file import to_yaml
from bounce_mjx.physics import CEngine, edited_model
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.model import find_addresses, joint_names
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.training.setup import set_up_jax
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import model_nominals, world_model
from bounce_mjx.world.randomization import RandomizationConfig
from bounce_mjx.world.sampling import physics_parameters, sample_world

# Error of the one angle of a log with a spike, rad.
_SPIKE = 0.5
# Terms of the sensors, which are the same for all robots, and disturbances.
_FIXED = (
    "camera_rate frame_drop ball_position_noise joint_velocity_noise push_speed push_interval "
    "goal_interval ball_start"
).split()
_CAMERA_RATE = 120.0
_LOST = 0.05
_BALL_NOISE = 0.002
_ANGLE_NOISE = 1e-3
_VELOCITY_NOISE = 0.02
_JITTER = 3e-4
# Target heights, m, and control steps of each: bounces at several speeds tell the ball's latency
# from the camera's height.
_HEIGHTS = (0.3, 0.8)
_HEIGHT_STEPS = 300
_BACKLASH = np.deg2rad(0.1)
_ASYMMETRY = 0.3
# What a hobby servo measures and holds, rad, and its stiffness and damping beside the model's.
_RESOLUTION = 2.0 * np.pi / 4096
_SOFT = 0.3
_UNDAMPED = 0.5
# A camera's own clock beside the robot's: its zero, s, and its drift.
_CLOCK_ZERO = 1000.0
_CLOCK_DRIFT = 4e-5
_FLAWS = (
    "nothing",
    "backlash",
    "hobby servos",
    "own camera clock",
    "asymmetric friction",
)
# Those that the model can be.
_RIGHT = ("nothing", "own camera clock")


class Hidden(NamedTuple):
    """A robot whose world nobody knows."""

    world: dict[str, np.ndarray]
    flaw: str
    """What is special about it, one of `_FLAWS`."""


def hidden_robot(seed: int, flawless: bool = False) -> Hidden:
    """Draws a robot: about 30% of the terms of configs/transfer.yaml, and all that a servo differs
    in, and the ball's latency.

    Args:
      flawless: whether the model lacks nothing of it.
    """
    wide = read_preset(resource_path("configs/transfer.yaml")).env
    ranges = {k: v for k, v in wide.randomization.ranges().items() if k not in _FIXED}
    _, rare, always = jax.random.split(jax.random.PRNGKey(seed), 3)
    nominals = model_nominals(wide)
    world = sample_world(ranges, rare, np.dtype("float32"), 6, nominals, share=0.3)
    servos = RandomizationConfig(
        action_latency=(0.0, 0.04),
        ball_latency=(0.0, 0.02),
        servo_gain=(0.8, 1.2),
        servo_damping=(0.8, 1.2),
        joint_frictionloss=(0.0, 5.0),
    )
    world |= sample_world(servos.ranges(), always, np.dtype("float32"), 6)
    world = {name: np.asarray(value, np.float32) for name, value in world.items()}
    flaw = "nothing" if flawless else _FLAWS[seed % len(_FLAWS)]
    if flaw == "hobby servos":
        world["servo_gain"] = _SOFT * world["servo_gain"]
        world["servo_damping"] = _UNDAMPED * world["servo_damping"]
    return Hidden(world, flaw)


def sensor_terms() -> dict[str, float]:
    """What is the same for all robots, as terms of the randomisation."""
    return {
        "camera_rate": _CAMERA_RATE,
        "frame_drop": _LOST,
        "ball_position_noise": _BALL_NOISE,
        "joint_angle_noise": _ANGLE_NOISE,
        "joint_velocity_noise": _VELOCITY_NOISE,
    }


class _Robot:
    """The robot with its clocks, servos and camera, on MuJoCo's C engine at the config's step."""

    def __init__(self, config: WorldConfig, hidden: Hidden, seed: int):
        plain = world_model(config, visual=False)
        self.engine = CEngine(edited_model(plain, physics_parameters(hidden.world, plain)))
        self.model = self.engine.model
        world = {name: np.asarray(value, float) for name, value in hidden.world.items()}
        self.data = mujoco.MjData(self.model)
        self.addresses = find_addresses(self.model)
        self.world = world
        self.flaw = hidden.flaw
        self.random = np.random.default_rng(seed)
        self.qpos = list(self.addresses.arm_qpos)
        self.qvel = list(self.addresses.arm_qvel)
        self.home = np.array(config.default_joint_angles)
        self.data.qpos[self.qpos] = self.home
        self.bias = world.get("encoder_bias", np.zeros(6))
        self.sent = [(-1.0, self.home + self.bias)]
        self.filtered = self.home + self.bias
        self.play = np.zeros(6)
        self.due = self.random.uniform(0.0, 1.0 / _CAMERA_RATE)
        self.pictures: list[tuple[float, np.ndarray]] = []
        """Times of arrival and positions of the ball [3] that the program has not yet."""
        self.hold_ball()

    def hold_ball(self) -> None:
        """Takes the ball out of the camera's sight."""
        ball = self.addresses.balls[0]
        self.has_ball = False
        self.data.qpos[list(ball.qpos)] = [0.5, 0.8, 0.1, 1.0, 0.0, 0.0, 0.0]
        self.data.qvel[list(ball.qvel)] = 0.0

    def drop_ball(self, position) -> None:
        ball = self.addresses.balls[0]
        start = position + self.random.uniform(-0.01, 0.01, 3)
        self.data.qpos[list(ball.qpos)] = [*start, 1.0, 0.0, 0.0, 0.0]
        self.data.qvel[list(ball.qvel)] = 0.0
        self.has_ball = True

    def ball(self) -> np.ndarray:
        return self.data.qpos[list(self.addresses.balls[0].qpos[:3])].copy()

    def angles(self) -> np.ndarray:
        true = self.data.qpos[self.qpos] + self.bias + self.play
        if self.flaw == "hobby servos":
            return _RESOLUTION * np.round(true / _RESOLUTION)
        return true + _ANGLE_NOISE * self.random.standard_normal(6)

    def velocities(self) -> np.ndarray:
        return self.data.qvel[self.qvel] + _VELOCITY_NOISE * self.random.standard_normal(6)

    def step(self) -> None:
        """One physics step."""
        m = self.model
        d = self.data
        world = self.world
        dt = m.opt.timestep
        late = world["action_latency"]
        # The mean target of the step, as targets change within it.
        ends = np.array([t + late for t, _ in self.sent[1:]] + [np.inf])
        shares = np.clip((np.minimum(ends, d.time + dt) - d.time) / dt, 0.0, 1.0)
        shares = np.diff(np.concatenate([[0.0], shares]))
        target = shares @ np.stack([u for _, u in self.sent])
        while len(self.sent) > 1 and self.sent[1][0] + late < d.time:
            self.sent.pop(0)
        lag = world.get("servo_lag", 0.0)
        share = 1.0 if lag < 1e-6 else -np.expm1(-dt / lag)
        if self.flaw == "hobby servos":
            target = _RESOLUTION * np.round(target / _RESOLUTION)
        self.filtered = self.filtered + share * (target - self.filtered)
        if self.flaw == "backlash":
            # The motor, with the encoder, goes to its target freely as far as the play lets it.
            free = self.filtered - self.bias - d.qpos[self.qpos]
            self.play = np.clip(free, -0.5 * _BACKLASH, 0.5 * _BACKLASH)
        d.ctrl[list(self.addresses.actuators)] = self.filtered - self.bias - self.play
        if self.flaw == "asymmetric friction":
            friction = world["joint_frictionloss"] * _ASYMMETRY
            d.qfrc_applied[self.qvel] = -friction * np.tanh(np.abs(d.qvel[self.qvel]) / 0.02)
        body = self.addresses.balls[0].body
        speed = d.qvel[list(self.addresses.balls[0].qvel[:3])]
        force = -world.get("air_drag", 0.0) * np.linalg.norm(speed) * speed
        d.xfrc_applied[body, :3] = m.body_mass[body] * force
        before = self.ball()
        self.engine.step(d)
        if not self.has_ball:
            self.hold_ball()
        elif d.time >= self.due:
            share = (self.due - (d.time - dt)) / dt
            shown = before + share * (self.ball() - before)
            if self.random.uniform() > _LOST:
                shown = shown + world.get("ball_position_bias", np.zeros(3))
                noisy = shown + _BALL_NOISE * self.random.standard_normal(3)
                arrival = self.due + world["ball_latency"]
                self.pictures.append((arrival, noisy))
        while d.time >= self.due:
            self.due += 1.0 / _CAMERA_RATE


def record(
    config: WorldConfig, hidden: Hidden, seed: int, path: Path, excited=20.0, played=40.0
) -> None:
    """Writes the log of a hidden robot: an excitation, then the robust policy with the ball, at
    several heights; the ball is dropped again after each loss."""
    robot = _Robot(config, hidden, seed)
    policy = load_policy("robust")
    motion = excite(config, excited, 1.5)
    steps = round(config.control_dt / config.physics_dt)
    random = np.random.default_rng([seed, 1])
    drop_at = excited + 1.0
    playing = False
    height = 0.5
    with Recorder(path, policy.metadata.joint_names, {"target_height": "m"}) as recorder:
        last_picture = None
        last_time = 0.0
        for k in range(round((excited + played) / config.control_dt)):
            now = robot.data.time
            if k % _HEIGHT_STEPS == 0:
                height = float(random.uniform(*_HEIGHTS))
            stamp = now + _JITTER * float(np.clip(random.standard_normal(), -3.0, 3.0))
            measured = {
                "joint_angles": robot.angles(),
                "joint_velocities": robot.velocities(),
                "target_height": height,
                "time": stamp,
            }
            arrived = [p for p in robot.pictures if p[0] <= now]
            robot.pictures = robot.pictures[len(arrived) :]
            for arrival, ball in arrived:
                picture_stamp = arrival + _JITTER * random.standard_normal()
                # The rows of a log do not go back.
                last_time = float(np.clip(picture_stamp, last_time, stamp))
                if hidden.flaw == "own camera clock":
                    picture_stamp = _CLOCK_ZERO + (1.0 + _CLOCK_DRIFT) * picture_stamp
                recorder.picture(last_time, ball, picture_stamp)
            if arrived:
                last_picture = arrived[-1]
            if robot.has_ball and robot.ball()[2] < 0.02:
                robot.hold_ball()
                playing = False
                last_picture = None
                drop_at = now + 1.5
            if k < len(motion.targets):
                target = motion.targets[k]
            elif playing and last_picture is not None:
                arrival, ball = last_picture
                # The age since the arrival plus a latency that somebody guessed.
                age = now - arrival + 0.01
                action = policy.step(
                    measured
                    | {"ball_position": ball, "ball_age": age, "ball_velocity": np.zeros(3)}
                )
                target = policy.servo_targets(action)
            else:
                target = robot.home
                if not robot.has_ball and now >= drop_at:
                    robot.drop_ball(np.array(config.ball_init_pos))
                    policy.reset()
                    playing = True
            recorder.step(measured, target)
            last_time = stamp
            robot.sent.append((now, np.array(target)))
            for _ in range(steps):
                robot.step()


def log_in(folder: Path, config: WorldConfig, hidden: Hidden, seed: int) -> Path:
    """The log of a hidden robot in a folder, recorded unless it is there. Its name says all that
    the robots of a seed differ in."""
    flaw = hidden.flaw.replace(" ", "_")
    path = folder / f"{seed}_{flaw}_{1e3 * config.physics_dt:g}ms.csv"
    if not path.exists():
        # One that was interrupted is no log.
        unfinished = path.with_suffix(".unfinished")
        unfinished.unlink(missing_ok=True)
        record(config, hidden, seed, unfinished)
        unfinished.rename(path)
    return path


def errors(found: Identified, hidden: Hidden, model: mujoco.MjModel, home) -> dict[str, float]:
    """Absolute errors of what a log can show, by name and unit."""
    estimated = found.layout.world(found.fit.vector)
    true = hidden.world
    normals = [_paddle_normal(model, world, home) for world in (estimated, true)]
    cosine = float(np.clip(normals[0] @ normals[1], -1.0, 1.0))
    damping = [world["servo_damping"] / world["servo_gain"] for world in (estimated, true)]
    tilt = estimated["gravity_tilt"] - true.get("gravity_tilt", 0.0)
    result = {
        "paddle's normal [deg]": float(np.degrees(np.arccos(cosine))),
        "gravity tilt [deg]": float(np.degrees(np.linalg.norm(tilt))),
        "damping / gain of a joint [%]": float(np.max(np.abs(damping[0] / damping[1] - 1.0))) * 100,
    }
    for name, unit, factor in (
        ("action_latency", "ms", 1e3),
        ("ball_latency", "ms", 1e3),
        ("servo_lag", "ms", 1e3),
        ("restitution", "", 1.0),
        ("air_drag", "1/m", 1.0),
    ):
        error = abs(float(estimated[name]) - float(true.get(name, 0.0))) * factor
        result[f"{name} [{unit}]" if unit else name] = error
    return result


def intervals(found: Identified, hidden: Hidden) -> dict[str, dict[str, float]]:
    """Of each unknown that the log shows: whether its 95% interval holds the truth, half the width
    of that, and the error."""
    zero = ("servo_lag", "air_drag", "contact_friction", "joint_frictionloss")
    nominal = dict.fromkeys(zero, 0.0) | hidden.world
    known = {name: nominal[name] for name in found.layout.terms if name in nominal}
    world = found.layout.world(found.layout.vector(known))
    truth = np.concatenate([np.ravel(world[name]) for name in found.layout.terms])
    listed = estimates(found, [f"Joint{i}" for i in range(1, 7)])
    return {
        entry.label: {
            "holds": bool(entry.low <= true <= entry.high),
            "half-width": 0.5 * (entry.high - entry.low),
            "error": abs(entry.value - float(true)),
        }
        for entry, true in zip(listed, truth, strict=True)
        if entry.seen
    }


def _paddle_normal(model: mujoco.MjModel, world, home) -> np.ndarray:
    """Direction of the paddle's upper face in the frame of the base while the encoders show the
    start pose."""
    given = {"paddle_tilt": np.asarray(world.get("paddle_tilt", np.zeros(2)), np.float32)}
    edited = edited_model(model, physics_parameters(given, model))
    addresses = find_addresses(edited)
    data = mujoco.MjData(edited)
    data.qpos[list(addresses.arm_qpos)] = home - world.get("encoder_bias", np.zeros(6))
    mujoco.mj_kinematics(edited, data)
    return data.geom_xmat[addresses.paddle_geom].reshape(3, 3)[:, 2]


def add_spike(path: Path, spiked: Path, seed: int) -> None:
    """Copies a log with one wrong number: an angle in the middle half is off by `_SPIKE`."""
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    columns = [i for i, name in enumerate(header) if name.startswith("joint_angles.")]
    random = np.random.default_rng([seed, 2])
    column = int(random.choice(columns))
    # Rows of pictures have no angles.
    measured = [row for row in rows if row[column]]
    row = measured[int(random.uniform(0.25, 0.75) * len(measured))]
    row[column] = repr(float(row[column]) + _SPIKE)
    with spiked.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


def measure(config: WorldConfig, hidden: Hidden, path: Path) -> dict[str, Any]:
    """The identification of one log: its errors, and whether the intervals hold the truth."""
    model = world_model(config, visual=False)
    names = joint_names(model)
    home = np.array(config.default_joint_angles)
    begin = time.perf_counter()
    begin_processor = time.process_time()
    log = read_log(path, model, Topics())
    found = identify(config, log)
    seconds = time.perf_counter() - begin
    processor = time.process_time() - begin_processor
    path.with_suffix(".yaml").write_text(to_yaml(found, log, names, None))
    shown = intervals(found, hidden)
    outside = [label for label, entry in shown.items() if not entry["holds"]]
    return {
        "log": path.stem,
        "flaw": hidden.flaw,
        "seconds": seconds,
        "processor seconds": processor,
        "errors": errors(found, hidden, model, home),
        "held out": found.held_out,
        "covered": len(shown) - len(outside),
        "shown": len(shown),
        "outside": outside,
        "intervals": shown,
        "dropped": found.dropped,
        "arm": found.choice.chosen.name,
        "leaves at once": found.simulated.leaves_at_once,
        "notes": list(log.notes),
    }


def print_summary(rows: list[dict[str, Any]]) -> None:
    """Medians of the errors of all robots, and the share of the intervals that hold the truth of
    those whose model is right."""
    print(f"{'error':32}{'median':>10}{'worst':>10}")
    for name in rows[0]["errors"]:
        values = [row["errors"][name] for row in rows]
        print(f"{name:32}{np.median(values):10.4f}{max(values):10.4f}")
    right = [row for row in rows if row["flaw"] in _RIGHT]
    for kind, some in (("where the model is right", right), ("all robots", rows)):
        if some:
            share = sum(r["covered"] for r in some) / sum(r["shown"] for r in some)
            print(f"95% intervals that hold the truth, {kind}: {100 * share:.0f}%")
    print_coverage(rows)


def print_coverage(rows: list[dict[str, Any]]) -> None:
    """Of each quantity: how many intervals hold the truth, their median half-width, and the 95%
    quantile of the errors."""
    by_quantity: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        for label, shown in row["intervals"].items():
            by_quantity.setdefault(label.split(" ")[0], []).append(shown)
    print(f"{'quantity':22}{'hold':>12}{'half-width':>12}{'95% of errors':>15}")
    for name, shown in by_quantity.items():
        holds = sum(entry["holds"] for entry in shown)
        width = np.median([entry["half-width"] for entry in shown])
        error = np.quantile([entry["error"] for entry in shown], 0.95)
        print(f"{name:22}{f'{holds} of {len(shown)}':>12}{width:12.4g}{error:15.4g}")


def _seeds(text: str) -> list[int]:
    first, _, last = text.partition("-")
    return list(range(int(first), int(last or first) + 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=_seeds, default=_seeds("1000-1003"))
    parser.add_argument("--robot-step", type=float, default=1e-3, help="physics step of a robot, s")
    parser.add_argument("--flawless", action="store_true", help="robots that the model can be")
    parser.add_argument("--spike", action="store_true", help="each log also with a wrong angle")
    parser.add_argument("--logs", type=Path, default=None, help="folder for the logs and worlds")
    parser.add_argument("--out", type=Path, default=None, help="JSON file")
    given = parser.parse_args()
    folder = given.logs or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    config = read_preset(resource_path("configs/default.yaml")).env
    finer = config.model_copy(update={"physics_dt": given.robot_step})
    set_up_jax(config)
    rows = []
    for seed in given.seeds:
        hidden = hidden_robot(seed, given.flawless)
        path = log_in(folder, finer, hidden, seed)
        paths = [path]
        if given.spike:
            spiked = path.with_name(f"{path.stem}_spike.csv")
            add_spike(path, spiked, seed)
            paths.append(spiked)
        for log in paths:
            rows.append(measure(config, hidden, log))
            print(json.dumps(rows[-1]), flush=True)
            if given.out is not None:
                given.out.write_text(json.dumps(rows, indent=1))
    print_summary([row for row in rows if not row["log"].endswith("_spike")])
    if given.spike:
        print("with one angle that is off by 0.5 rad:")
        print_summary([row for row in rows if row["log"].endswith("_spike")])


if __name__ == "__main__":
    main()
