"""Identification of real robots and real balls from public logs: an arm's errors on unseen data,
and a flight's errors of the fit itself, beside the simplest models.

`python benchmarks/real_logs.py FOLDER... [--toolbox] [--out FILE.json]`. A folder is a clone of

- github.com/marcocognetti/FrankaEmikaPandaDynModel (a Franka Panda, 20 s at 1 kHz);
- github.com/swiatecki/ProjectMoose (a UR5, 125 Hz);
- github.com/cogsys-tuebingen/tt3d (139 table-tennis flights with one bounce each).

or a CSV file, a log of the project's own arm, of which the arm's part counts.

An arm's log is cut into halves: each is fitted alone, and the world is tested on the other on
MuJoCo's C engine, open loop from its first angles, at rest, with nothing refitted; the first
moments, in which the arm gets into its motion, do not count. With --toolbox, so is MuJoCo's own
identification. All flights are fitted at once, moved over the paddle of the project's arm, which
rests, and compared with a direct fit of the same air to each side of each flight.
"""

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import mujoco.sysid
import numpy as np
from numpy.polynomial.polynomial import polyfit
from scipy.optimize import brentq, least_squares

from bounce_mjx.errors import UserError
from bounce_mjx.identify.estimates import total_delay
from bounce_mjx.identify.following import (
    SETTLING,
    Following,
    find_settled,
    follow,
    set_points,
)
from bounce_mjx.identify.hypotheses import describe_choice
from bounce_mjx.identify.identification import identify
from bounce_mjx.identify.inspection import examine
from bounce_mjx.identify.log import Log
from bounce_mjx.identify.reading import read_csv
from bounce_mjx.identify.response import commanded
from bounce_mjx.identify.sentences import describe_doubts
from bounce_mjx.identify.simulation import compensated, make_targets
from bounce_mjx.physics import CEngine, edited_model
from bounce_mjx.robot.model import find_addresses, joint_names
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.training.setup import set_up_jax
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import world_model
from bounce_mjx.world.sampling import physics_parameters

# Largest error of a flight that counts as explained, root mean square of an axis, m.
_EXPLAINED = 3e-3
# Pictures this close to a bounce do not count, s.
_AT_BOUNCE = 0.012
# m/s^2.
_GRAVITY = np.array([0.0, 0.0, -9.81])
# The command is the position.
_AT_ONCE = Following(0.0, np.zeros(1), np.zeros(1))
# Of the flights' integration, s.
_STEP = 4e-3
# Height of a table's bounce below which a minimum of the height is one, m.
_LOW = 0.06
# The paddle's upper face of the project's arm at its start pose, m, where the flights are moved.
_PADDLE = np.array([0.59356, 0.0, 0.0523])


class ArmLog(NamedTuple):
    """A real arm's log."""

    name: str
    robot: str | None
    """None for the project's own."""
    log: Log


def panda_logs(folder: Path) -> Iterator[ArmLog]:
    """The exciting trajectory of Gaz et al. (2019). The command is the integral of the commanded
    velocity."""
    for start in folder.rglob("gen_q0.txt"):
        files = {path.stem: path for path in start.parent.rglob("*.txt")}
        times = np.loadtxt(files["exciting_traj_time"])
        angles = np.loadtxt(files["exciting_traj_positions"]).reshape(-1, 7)
        sent = np.loadtxt(files["gen_time"])
        speeds = np.loadtxt(files["gen_dq"]).reshape(-1, 7)
        means = 0.5 * (speeds[1:] + speeds[:-1]) * np.diff(sent)[:, None]
        path = np.loadtxt(start) + np.vstack([np.zeros(7), np.cumsum(means, axis=0)])
        targets = np.stack([np.interp(times, sent, column) for column in path.T], axis=1)
        yield ArmLog("Franka Panda, 1 kHz", "panda", _arm_log(start, times, angles, targets))


def ur5_logs(folder: Path) -> Iterator[ArmLog]:
    """Columns: the robot's time, the computer's, actual angles and velocities, target
    accelerations, velocities and angles."""
    for name in ("96-trackDelayNetwork/delayLog", "125-OLTest/hah", "125-OLTest/oltest"):
        for path in folder.rglob(f"{name}.txt"):
            rows = np.loadtxt(path, delimiter=",", usecols=range(32))
            _, first = np.unique(rows[:, 0], return_index=True)
            rows = rows[first]
            log = _arm_log(path, rows[:, 0] - rows[0, 0], rows[:, 2:8], rows[:, 26:32])
            yield ArmLog(f"UR5, 125 Hz: {path.stem}", "ur5e", log)


def own_log(path: Path) -> ArmLog:
    """The arm's part of a CSV log of the project's own arm."""
    names = joint_names(world_model(read_preset(Path("default")).env, visual=False))
    nothing = np.zeros(0)
    log = read_csv(path, names)._replace(
        picture_times=nothing, ball_positions=np.zeros((0, 3)), arrivals=nothing
    )
    return ArmLog(f"project's own arm: {path.stem}", None, log)


def _arm_log(path: Path, times: np.ndarray, angles: np.ndarray, targets: np.ndarray) -> Log:
    nothing = np.zeros(0)
    return Log(str(path), times, angles, times, targets, nothing, np.zeros((0, 3)), nothing)


def halves(log: Log) -> tuple[Log, Log]:
    """The first and the second half of an arm's log, by time."""
    middle = 0.5 * (log.times[0] + log.times[-1])

    def part(which: np.ndarray, sent: np.ndarray) -> Log:
        return log._replace(
            times=log.times[which],
            joint_angles=log.joint_angles[which],
            target_times=log.target_times[sent],
            servo_targets=log.servo_targets[sent],
        )

    early = log.times < middle
    early_sent = log.target_times < middle
    return part(early, early_sent), part(~early, ~early_sent)


def open_loop(config: WorldConfig, world: dict[str, np.ndarray], log: Log) -> np.ndarray:
    """Errors [n] of an arm's world on a log, root mean square, rad: one simulation on MuJoCo's C
    engine from the log's first angles, at rest, of which the first `SETTLING` seconds do not
    count."""
    plain = world_model(config, visual=False)
    dt = config.physics_dt
    model = edited_model(plain, physics_parameters(world, plain))
    data = mujoco.MjData(model)
    addresses = find_addresses(model)
    qpos = list(addresses.arm_qpos)
    servos = list(addresses.actuators)
    count = int((log.times[-1] - log.times[0]) / dt) + 1
    send = make_targets(log, log.times[0] + dt * np.arange(count + 1))
    targets = send(float(world["action_latency"]), float(world.get("servo_lag", 0.0)))
    held = world.get("servo_offset", 0.0) - world.get("encoder_bias", 0.0)
    data.qpos[qpos] = log.joint_angles[0] - world.get("encoder_bias", 0.0)
    # The ball would fall through the floor.
    ball = addresses.balls[0]
    path = np.zeros((count, len(qpos)))
    for i, target in enumerate(targets):
        path[i] = data.qpos[qpos]
        data.qpos[list(ball.qpos[:3])] = (0.0, 0.0, 50.0)
        data.qvel[list(ball.qvel)] = 0.0
        data.ctrl[servos] = target + held
        mujoco.mj_step(model, data)
    expected = np.stack(
        [np.interp(log.times, log.times[0] + dt * np.arange(count), x) for x in path.T], 1
    )
    errors = expected + world.get("encoder_bias", 0.0) - log.joint_angles
    return np.sqrt(np.mean(errors[log.times - log.times[0] > SETTLING] ** 2, axis=0))


def late_errors(simple: Following, log: Log) -> np.ndarray:
    """Errors [n] of a delay and offsets on a log, root mean square, rad."""
    rows = log.times - log.times[0] > SETTLING
    expected = commanded(log, log.times[rows] - simple.delay) + simple.offsets
    return np.sqrt(np.mean((log.joint_angles[rows] - expected) ** 2, axis=0))


def measure_arm(arm: ArmLog, toolbox: bool) -> list[dict[str, Any]]:
    """A row for each way round.

    Args:
      toolbox: whether MuJoCo's own identification is measured too.
    """
    robot = None if arm.robot is None else Path(arm.robot)
    config = read_preset(Path("default"), robot).env
    model = world_model(config, visual=False)
    names = joint_names(model)
    rows = []
    parts = halves(arm.log)
    for which, (fitted, tested) in enumerate((parts, parts[::-1])):
        simple = follow(fitted, find_settled(fitted))
        row = {"log": arm.name, "fitted": ("first half", "second half")[which]}
        row["command, mrad"] = (1e3 * late_errors(_AT_ONCE, tested)).tolist()
        row["delay and offset, ms"] = 1e3 * simple.delay
        row["delay and offset, mrad"] = (1e3 * late_errors(simple, tested)).tolist()
        checkup = examine([fitted], names)[0]
        row["findings"] = [str(finding) for finding in checkup.findings]
        if checkup.faults:
            rows.append(row | {"refused": checkup.faults[0].text})
            continue
        begin = time.perf_counter()
        begin_processor = time.process_time()
        try:
            found = identify(config, fitted)
        except UserError as error:
            rows.append(row | {"refused": str(error)})
            continue
        row["seconds"] = time.perf_counter() - begin
        row["processor seconds"] = time.process_time() - begin_processor
        is_carried = found.simulated.gravity_compensation > 0.0
        of_arm = compensated(config) if is_carried else config
        # As `identify` reads them: a follower may go on between its commands.
        fitted_points = set_points(fitted, simple, config.physics_dt)
        tested_points = set_points(tested, simple, config.physics_dt)
        world = found.layout.world(found.fit.vector)
        row["identified, mrad"] = (1e3 * open_loop(of_arm, world, tested_points)).tolist()
        row["total delay"] = total_delay(found, model)
        row["gravity compensation"] = found.simulated.gravity_compensation
        row["hypotheses"] = describe_choice(found.choice)
        row["doubts"] = describe_doubts(found, names)
        if toolbox:
            row |= measure_toolbox(of_arm, fitted_points, tested_points)
        rows.append(row)
    return rows


def measure_toolbox(config: WorldConfig, fitted: Log, tested: Log) -> dict[str, Any]:
    """Errors and time of MuJoCo's own identification, with its own and with SciPy's search."""
    # Only here, as it needs an extra.
    from toolbox import fit_with_toolbox

    row: dict[str, Any] = {}
    for optimizer, name in (("mujoco", "mujoco.sysid"), ("scipy", "least_squares(trf)")):
        begin = time.perf_counter()
        begin_processor = time.process_time()
        world = fit_with_toolbox(config, fitted, optimizer)
        row[f"{name}, seconds"] = time.perf_counter() - begin
        row[f"{name}, processor seconds"] = time.process_time() - begin_processor
        row[f"{name}, mrad"] = (1e3 * open_loop(config, world, tested)).tolist()
        row[f"{name}, world"] = {term: value.tolist() for term, value in world.items()}
    return row


class Flight(NamedTuple):
    """A real flight with one bounce."""

    times: np.ndarray
    """[T], s."""
    places: np.ndarray
    """[T, 3], m."""
    lowest: int
    """Index of the lowest picture."""


def flights(folder: Path) -> list[Flight]:
    """The flights of TT3D with one bounce and without a gap."""
    found = []
    for path in sorted(folder.rglob("3D_gt/*.csv")):
        rows = np.genfromtxt(path, delimiter=",", skip_header=1)
        if rows.ndim != 2 or len(rows) < 16 or not np.isfinite(rows).all():
            continue
        times = rows[:, 0] - rows[0, 0]
        places = rows[:, 1:4]
        height = places[:, 2]
        lowest = [
            i
            for i in range(6, len(height) - 6)
            if height[i] == height[i - 4 : i + 5].min() and height[i] < _LOW
        ]
        if len(lowest) == 1 and np.max(np.diff(times)) < 0.055:
            found.append(Flight(times, places, lowest[0]))
    return found


def flights_log(config: WorldConfig, folder: Path, given: list[Flight]) -> Log:
    """The flights, one after another, over the paddle of an arm at rest."""
    stamps = []
    balls = []
    begin = 1.0
    for i, flight in enumerate(given):
        place = flight.places - flight.places[flight.lowest] * [1.0, 1.0, 0.0]
        # Every flight went one way. The table is level: turned about the vertical, a flight is one
        # that goes another way, and tells a tilt of the table from its restitution.
        place = place * (1.0 if i % 2 else [-1.0, -1.0, 1.0])
        stamps.append(begin + flight.times)
        balls.append(place + _PADDLE)
        begin += flight.times[-1] + 0.3
    times = np.arange(0.0, begin + 0.5, 0.005)
    home = np.tile(config.default_joint_angles, (len(times), 1))
    angles = home + 1e-4 * np.random.default_rng(0).normal(size=home.shape)
    stamps = np.concatenate(stamps)
    arrivals = times[np.minimum(np.searchsorted(times, stamps), len(times) - 1)]
    return Log(str(folder), times, angles, times, home, stamps, np.concatenate(balls), arrivals)


def _fly(start: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places [T, 3] and velocities [T, 3] under gravity, drag and lift by a constant spin, by
    Runge and Kutta's method.

    Args:
      start: at times[0]: place, velocity, spin times the coefficient of lift, drag.
    """
    place = start[:3]
    speed = start[3:6]
    lift = start[6:9]
    drag = start[9]

    def pull(v: np.ndarray) -> np.ndarray:
        return _GRAVITY - drag * np.linalg.norm(v) * v + np.cross(lift, v)

    places = [place]
    speeds = [speed]
    for gap in np.diff(times):
        count = max(int(np.ceil(abs(gap) / _STEP)), 1)
        h = gap / count
        for _ in range(count):
            k1 = pull(speed)
            k2 = pull(speed + 0.5 * h * k1)
            k3 = pull(speed + 0.5 * h * k2)
            k4 = pull(speed + h * k3)
            place = place + h * speed + h * h / 6.0 * (k1 + k2 + k3)
            speed = speed + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        places.append(place)
        speeds.append(speed)
    return np.array(places), np.array(speeds)


def fit_side(times: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, float]:
    """A direct fit of one side of a bounce: its start, and the error of an axis."""
    line = polyfit(times - times[0], places, 2)
    guess = np.concatenate([line[0], line[1], np.zeros(3), [0.14]])

    def residuals(start: np.ndarray) -> np.ndarray:
        off = (_fly(start, times)[0] - places) / 2e-3
        return np.concatenate([off.ravel(), start[6:9] / 5.0, [(start[9] - 0.14) / 0.1]])

    start = least_squares(residuals, guess, x_scale="jac", max_nfev=50).x
    return start, float(np.sqrt(np.mean((_fly(start, times)[0] - places) ** 2)))


def reference(given: list[Flight]) -> dict[str, float]:
    """Restitution (the ratio of the speeds), drag and share explained, by direct fits of each
    side.

    On flights with TT3D's times and a known ratio of 0.90 and 0.94, with noise of the fits' errors,
    it finds 0.901 and 0.943, and 0.897 and 0.937 where neighbouring errors are alike by 0.9.
    """
    rows = []
    for flight in given:
        bounce = flight.times[flight.lowest]
        sides = [flight.times < bounce - _AT_BOUNCE, flight.times > bounce + _AT_BOUNCE]
        starts, errors = zip(
            *(fit_side(flight.times[x], flight.places[x]) for x in sides), strict=True
        )
        begins = [flight.times[x][0] for x in sides]

        def states(at: float, starts=starts, begins=begins) -> list[tuple[np.ndarray, np.ndarray]]:
            ends = [_fly(s, np.array([b, at])) for s, b in zip(starts, begins, strict=True)]
            return [(places[-1], speeds[-1]) for places, speeds in ends]

        def gap(at: float) -> float:
            before, after = states(at)
            return before[0][2] - after[0][2]

        low = bounce - 0.02
        high = bounce + 0.02
        at = brentq(gap, low, high) if gap(low) * gap(high) < 0.0 else bounce
        before, after = states(at)
        speed = -before[1][2]
        rows.append((after[1][2] / speed, speed, starts[0][9], starts[1][9], *errors))
    restitution, speed, before, after, error_before, error_after = np.array(rows).T
    return {
        "restitution": float(np.median(restitution)),
        "speed, m/s": float(np.median(speed)),
        "drag before, 1/m": float(np.median(before)),
        "drag after, 1/m": float(np.median(after)),
        "explained before": float(np.mean(error_before < _EXPLAINED)),
        "explained after": float(np.mean(error_after < _EXPLAINED)),
    }


def speed_ratio(config: WorldConfig, world: dict[str, np.ndarray], speed: float) -> float:
    """Vertical speed after by that before a bounce on the resting paddle, on MuJoCo's C engine.

    The term `restitution` sets the damping of a contact that takes 10 ms, through which the ball
    also falls. A direct fit measures the speeds where the ball touches the paddle. The mean is over
    where in a physics step a bounce begins.

    Args:
      speed: at which the ball comes down, m/s.
    """
    plain = world_model(config, visual=False)
    engine = CEngine(edited_model(plain, physics_parameters(world, plain)))
    model = engine.model
    addresses = find_addresses(model)
    ball = addresses.balls[0]
    paddle = addresses.paddle_geom
    servos = list(addresses.actuators)
    arm = list(addresses.arm_qpos)
    place = list(ball.qpos[:3])
    motion = list(ball.qvel[:3])
    ratios = []
    for share in np.linspace(0.0, 1.0, 8, endpoint=False):
        data = mujoco.MjData(model)
        data.qpos[arm] = data.ctrl[servos] = config.default_joint_angles
        mujoco.mj_kinematics(model, data)
        top = data.geom_xpos[paddle][2] + model.geom_size[paddle, 2] + model.geom_size[ball.geom, 0]
        fall = 0.01 + share * speed * config.physics_dt
        data.qpos[place] = [*data.geom_xpos[paddle][:2], top + fall]
        data.qvel[motion] = [0.0, 0.0, -np.sqrt(speed**2 - 2.0 * 9.81 * fall)]
        while data.qvel[motion][2] <= 0.0 or data.qpos[place][2] < top:
            engine.step(data)
        rise = data.qpos[place][2] - top
        ratios.append(np.sqrt(data.qvel[motion][2] ** 2 + 2.0 * 9.81 * rise) / speed)
    return float(np.mean(ratios))


def measure_flights(folder: Path, most: int) -> dict[str, Any]:
    """The flights of TT3D, identified and by a direct fit."""
    config = read_preset(Path("default")).env
    given = flights(folder)[:most]
    row: dict[str, Any] = {"flights": len(given), "reference": reference(given)}
    begin = time.perf_counter()
    found = identify(config, flights_log(config, folder, given))
    row["seconds"] = time.perf_counter() - begin
    world = found.layout.world(found.fit.vector)
    windows = found.windows
    row |= {"restitution": float(world["restitution"]), "drag, 1/m": float(world["air_drag"])}
    row["ratio of speeds"] = speed_ratio(config, world, row["reference"]["speed, m/s"])
    row |= {"bounces": int(np.sum(windows.has_ball)), "dropped": found.dropped}
    residuals = windows.split(found.fit.predicted)[1] - windows.balls
    errors = {"before": [], "after": []}
    for s in np.flatnonzero(windows.has_ball):
        since = windows.picture_times[s] - windows.bounces[s]
        counts = windows.picture_weights[s] > 0.0
        early, late = (counts & (side * since > _AT_BOUNCE) for side in (-1.0, 1.0))
        errors["before"].append(np.sqrt(np.mean(residuals[s, early] ** 2)))
        # A bounce deviates from the mean one, in place, speed and spin.
        design = np.vander(since[late], 3)
        own = np.linalg.lstsq(design, residuals[s, late], rcond=None)[0]
        errors["after"].append(np.sqrt(np.mean((residuals[s, late] - design @ own) ** 2)))
    for side, sizes in errors.items():
        row[f"explained {side}"] = float(np.mean(np.array(sizes) < _EXPLAINED))
    row["doubts"] = describe_doubts(found, [f"Joint{i}" for i in range(1, 7)])
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--toolbox", action="store_true", help="also MuJoCo's identification")
    parser.add_argument("--flights", type=int, default=1000, help="most flights")
    parser.add_argument("--out", type=Path, default=None, help="JSON file")
    given = parser.parse_args()
    # Without its extra, the module is there and empty.
    if given.toolbox and not hasattr(mujoco.sysid, "optimize"):
        parser.error("--toolbox needs MuJoCo's identification; pip install 'mujoco[sysid]'")
    set_up_jax(read_preset(Path("default")).env)
    rows: list[dict[str, Any]] = []
    for folder in given.folders:
        own = [own_log(folder)] if folder.suffix == ".csv" else []
        arms = [*own, *panda_logs(folder), *ur5_logs(folder)]
        has_flights = any(folder.rglob("3D_gt/*.csv"))
        if not arms and not has_flights:
            parser.error(f"{folder} has none of the logs that --help lists")
        for arm in arms:
            rows += measure_arm(arm, given.toolbox)
            print(json.dumps(rows[-2:], indent=1), flush=True)
        if has_flights:
            rows.append(measure_flights(folder, given.flights))
            print(json.dumps(rows[-1], indent=1), flush=True)
        if given.out is not None:
            given.out.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
