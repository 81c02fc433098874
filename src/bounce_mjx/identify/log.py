"""A log of a robot's run, its checks and its clocks."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from scipy.stats import theilslopes

from bounce_mjx.errors import UserError

# A joint angle this far beyond the joint's range is not a measurement of it, rad.
_BEYOND_RANGE = 0.5
_LARGEST_ANGLE = 4.0 * np.pi
_TURN = 2.0 * np.pi
_FARTHEST_BALL = 20.0
_LONGEST_STEP = 0.2
# A control step, s, by which the unit of longer ones is guessed.
_USUAL_STEP = 0.005
_MIN_ROWS = 100
# Share of a measurement's rows from which their times, or balls far away, are no slips.
_WRONG_ROWS = 0.05
# Times that go back so often are those of several recordings in one file.
_MOST_RESTARTS = 30
# Share of the rows whose time goes back from which the log runs backwards.
_BACKWARDS = 0.9
# Time without a row, s and in typical steps, on whose other side are times of another clock.
_FAR_IN_TIME = 3600.0
_FAR_STEPS = 100.0
# Step of stamps from which a 32-bit number has made them useless, and how exactly they keep to it
# in a file of decimals, s.
_COARSE_STAMP = 2e-3
_ROUNDED = 2e-4
# Rows whose median an angle is compared with; distance from it beyond which it is a spike, rad, and
# in multiples of what is usual about it; and time for which a step of the command explains one, s.
_SPIKE_ROWS = 7
_SPIKE = 0.03
_SPIKE_FACTOR = 10.0
_AFTER_STEP = 0.3
# Two pictures closer than this are one, s.
_SAME_PICTURE = 1e-4
# Stretches of a log in which the youngest picture is looked for; drift (s) over the log below which
# the clocks count as one, and age of a picture (s) beyond which they do not.
_STRETCHES = 12
_DRIFT = 1e-3
_LARGEST_AGE = 1.0
# Speed of the stamps, s each second, from which they may have another unit.
_OTHER_UNIT = 30.0
# Two quartz clocks drift by less; a stamp that drifts by more, s over the log, has another unit.
_FASTEST_DRIFT = 2e-4
_NO_CLOCK = 0.1
# Change of the youngest pictures' age over a log that is worth a note, s.
_GROWING_AGE = 0.01

# Rows of an even log that may be lost one after another and are filled.
_MOST_LOST = 4
# Share of the steps of an even log that are near whole multiples of the typical one, and how near.
_EVEN = 0.95
_NEAR_WHOLE = 0.3
# Time between two rows, s and in typical steps, beyond which a log whose steps are uneven has a
# gap.
_GAP = 0.1
_GAP_STEPS = 5.0
# Rows that show whether a joint's angle is held; share of repeated angles, while its command moves
# by more than two counts of its encoder a row, from which it may be; and share of the times between
# two new angles that are then alike.
_FEWEST_MOVING = 50
_HELD = 0.4
_ALIKE = 0.8


# Standard deviation of stamps about regular steps below which the steps count as regular, s.
_JITTER = 5e-4
# Time between two logs that are joined, s: a gap, also where steps are as long as a log may have.
_APART = 1.5


class Log(NamedTuple):
    """What a robot measured and was sent; all times (s) are of one clock, but for a constant."""

    source: str
    """Its file, for messages."""
    times: np.ndarray
    """Times [T] of the measured joint angles."""
    joint_angles: np.ndarray
    """Measured joint angles [T, n], rad."""
    target_times: np.ndarray
    """Times [U] at which servo targets were sent."""
    servo_targets: np.ndarray
    """Servo targets [U, n], rad."""
    picture_times: np.ndarray
    """Time stamps [P] of the pictures of the ball."""
    ball_positions: np.ndarray
    """The ball in each picture [P, 3], m."""
    arrivals: np.ndarray
    """Time [P] of the row in which each picture arrived."""
    notes: tuple[str, ...] = ()
    """What was left out or corrected in reading, a sentence each."""


class Rows(NamedTuple):
    """Rows of one measurement, in the order of the file."""

    name: str
    """What they are and where they are from, for messages."""
    place: str
    """Place of a row in the file, with {} for its number."""
    numbers: np.ndarray
    """[R]."""
    times: np.ndarray
    """When each was measured [R], s."""
    arrivals: np.ndarray
    """When each arrived [R], s."""
    values: np.ndarray
    """[R, k]; NaN for what was not measured."""

    def chosen(self, index: np.ndarray) -> "Rows":
        """Some of the rows, or all in another order."""
        return self._replace(
            numbers=self.numbers[index],
            times=self.times[index],
            arrivals=self.arrivals[index],
            values=self.values[index],
        )

    def without(
        self, wrong: np.ndarray, why: str, notes: list[str], refused: float = np.inf, advice=""
    ) -> "Rows":
        """The rows outside a mask [R], whose number goes to the notes.

        Args:
          why: what is wrong with them.
          refused: share of the rows from which the log is refused, if at least two are wrong.
          advice: what to do then.

        Raises:
          UserError: the log is refused.
        """
        if not (count := int(np.sum(wrong))):
            return self
        sentence = (
            f"{count} of the {len(wrong)} {self.name} do not count: "
            f"{self.place.format(self.numbers[np.argmax(wrong)])} {why}"
        )
        if count >= max(refused * len(wrong), 2.0):
            raise UserError(sentence + advice)
        notes.append(sentence)
        return self.chosen(~wrong)


_ONE_CLOCK = "; give each its own time, of one clock"


def make_log(source: str, angles: Rows, targets: Rows, balls: Rows) -> Log:
    """The log of three measurements, without the rows that lack a number, repeat others or have
    wrong times, which its notes count.

    Raises:
      UserError: no joint angle or target is left, their times are no seconds, or a twentieth of the
        times or of the balls cannot be.
    """
    notes: list[str] = []
    angles = _in_order(angles, notes)
    targets = _in_order(targets, notes)
    angles = angles.without(
        _find_spikes(angles, targets), "is a spike: the joint is elsewhere before and after", notes
    )
    angles = angles.without(
        _find_held(angles, targets),
        "holds the angle before it while the joint moves: a slower sensor in rows of the control "
        "step",
        notes,
    )
    targets = _fill_lost(targets, notes)
    # An arm may have been recorded alone, with a tracker that saw no ball. Trackers, and logs of
    # control steps, hold the last picture until the next, at times under a new stamp, which may be
    # later than that of the next.
    balls = _clean(balls, notes, lambda rows: rows.values)
    balls = balls.chosen(np.argsort(balls.times, kind="stable"))
    balls = balls.without(
        np.any(np.abs(balls.values) > _FARTHEST_BALL, axis=1),
        f"is farther away than {_FARTHEST_BALL:g} m",
        notes,
        _WRONG_ROWS,
        "; if these are millimetres, write ball_position.x [mm]",
    )
    again = np.diff(balls.times, prepend=-np.inf) < _SAME_PICTURE
    balls = balls.without(again, "has the time stamp of another", notes)
    return Log(
        source=source,
        times=angles.times,
        joint_angles=angles.values,
        target_times=targets.times,
        servo_targets=targets.values,
        picture_times=balls.times,
        ball_positions=balls.values,
        arrivals=balls.arrivals,
        notes=tuple(notes),
    )


def _clean(
    rows: Rows, notes: list[str], told: Callable[[Rows], np.ndarray], refused: float = np.inf
) -> Rows:
    """The rows in which every number is finite, that do not tell the same as the one before, and
    whose times are near those of most others.

    Args:
      told: what rows tell [R, k].
      refused: share of rows with gaps from which the log is refused.
    """
    numbers = np.column_stack([rows.times, rows.arrivals, rows.values])
    empty = np.all(np.isnan(rows.values), axis=0)
    if np.any(empty) and len(rows.values) and not np.all(empty):
        raise UserError(
            f"number {np.argmax(empty) + 1} of each row of the {rows.name} is missing everywhere, "
            "as of a joint without an encoder; identify needs the angle and the target of every "
            "joint: log what the controller reports, or measure that robot by hand"
        )
    wrong = ~np.isfinite(numbers).all(axis=1)
    lack = f"lacks its time or one of its {rows.values.shape[1]} numbers"
    rows = rows.without(wrong, lack, notes, refused)
    same = np.all(np.diff(told(rows), axis=0, prepend=np.nan) == 0.0, axis=1)
    rows = rows.without(same, "repeats the one before", notes)
    far = _find_far(rows.times)
    return rows.without(far, "has a time far from the others", notes, _WRONG_ROWS, _ONE_CLOCK)


def _find_far(times: np.ndarray) -> np.ndarray:
    """Which times [R] are on the other side of a long stretch without any from most others."""
    if len(times) < 2:
        return np.zeros(len(times), bool)
    ordered = np.sort(times)
    longest = max(_FAR_IN_TIME, _FAR_STEPS * float(np.median(np.abs(np.diff(times)))))
    groups = np.split(ordered, np.flatnonzero(np.diff(ordered) > longest) + 1)
    most = max(groups, key=len)
    return (times < most[0]) | (times > most[-1])


def _in_order(rows: Rows, notes: list[str]) -> Rows:
    """The rows of a measurement of every control step: whole, once each, with increasing times."""
    _check_steps(rows)
    _check_digits(rows)
    rows = _clean(rows, notes, lambda rows: np.column_stack([rows.times, rows.values]), 1.0)
    early = np.diff(np.maximum.accumulate(rows.times), prepend=-np.inf) <= 0.0
    # The earliest time of each row and those after it.
    earliest = np.minimum.accumulate(rows.times[::-1])[::-1]
    late = np.zeros(len(rows.times), bool)
    late[:-1] = rows.times[:-1] >= earliest[1:]
    # A time that is too late makes all that follow early, and one too early all before it late.
    wrong = min(early, late, key=np.sum)
    restarts = np.flatnonzero(np.diff(rows.times) < 0.0)
    if len(restarts) > _BACKWARDS * len(rows.times):
        raise UserError(
            f"the times of the {rows.name} go back in nearly every row, at "
            f"{rows.place.format(rows.numbers[restarts[0] + 1])} first; sort the log by its time"
        )
    if np.sum(wrong) >= max(_WRONG_ROWS * len(wrong), 2.0) and len(restarts) <= _MOST_RESTARTS:
        place = rows.place.format(rows.numbers[restarts[0] + 1])
        more = f" and {len(restarts) - 1} more times" if len(restarts) > 1 else ""
        raise UserError(
            f"the times of the {rows.name} go back at {place}{more}: split the log there, and give "
            "the parts as logs of their own"
        )
    return rows.without(wrong, "has a time out of order", notes, _WRONG_ROWS, _ONE_CLOCK)


def _check_steps(rows: Rows) -> None:
    """Refuses times of another unit.

    Raises:
      UserError: control steps would be too long.
    """
    times = rows.times[np.isfinite(rows.times)]
    if len(times) < 2:
        return
    typical = float(np.median(np.abs(np.diff(times))))
    if typical > _LONGEST_STEP:
        raise UserError(
            f"the {rows.name} are {typical:.3g} s apart, and at most {_LONGEST_STEP:g} s is "
            f"expected; if the times are {_name_unit(typical / _USUAL_STEP)}"
        )


def _name_unit(factor: float, column: str = "time") -> str:
    """A unit of which a second has about `factor`, and how to write it in a column's title."""
    units = {"milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns"}
    power = int(np.clip(round(np.log10(factor) / 3.0), 1, 3))
    name = list(units)[power - 1]
    return f"{name}, write {column} [{units[name]}]"


def _check_digits(rows: Rows) -> None:
    """Refuses times that a 32-bit number has rounded.

    Raises:
      UserError: they are.
    """
    times = rows.times[np.isfinite(rows.times)]
    if len(times) < _MIN_ROWS:
        return
    grid = float(np.spacing(np.float32(np.median(np.abs(times)))))
    off = np.abs(times - grid * np.round(times / grid))
    typical = float(np.median(np.abs(np.diff(times))))
    # Simulated steps may be whole numbers of such a grid by themselves.
    is_coarse = grid > _COARSE_STAMP and 0.1 * typical < grid
    if is_coarse and np.all(off < _ROUNDED):
        raise UserError(
            f"the times of the {rows.name} are multiples of {grid:.3g} s, as a 32-bit number "
            "rounds them; write seconds as 64-bit numbers, or since the start"
        )


def _find_spikes(angles: Rows, targets: Rows) -> np.ndarray:
    """Which rows [R] of joint angles no joint can have: far from the median of the rows about them,
    although those agree with theirs, and beyond the rows before and after.

    A quick servo that answers a step of its command is as far from that median, between two rests,
    or beyond the second one by less than the step.
    """
    values = angles.values
    spikes = np.zeros(len(values), bool)
    if len(values) < _SPIKE_ROWS:
        return spikes
    off = values - median_filter(values, (_SPIKE_ROWS, 1), mode="nearest")
    around = median_filter(np.abs(off), (2 * _SPIKE_ROWS + 1, 1), mode="nearest")
    limits = np.maximum(_SPIKE, _SPIKE_FACTOR * around)
    for joint in np.flatnonzero(np.any(np.abs(off) > limits, axis=0)):
        far = np.flatnonzero(np.abs(off[:, joint]) > limits[:, joint])
        is_next = (np.diff(far) == 1) & (np.diff(np.sign(off[far, joint])) == 0.0)
        for rows in np.split(far, np.flatnonzero(~is_next) + 1):
            height = _height_beyond_neighbours(values[:, joint], rows)
            step = _largest_step(targets, joint, angles.times[rows[0]])
            if height > max(np.max(limits[rows, joint]), step):
                spikes[rows] = True
    return spikes


def _find_held(angles: Rows, targets: Rows) -> np.ndarray:
    """Which rows [R] hold an earlier angle of a joint whose sensor is slower than the rows: as a
    measurement of its own time, each would count as later than it is.

    A joint is held if it repeats its angle to the last digit again and again, for as many rows each
    time, while its command moves by more than its encoder's counts.
    """
    values = angles.values
    held = np.zeros(len(values), bool)
    if len(values) < _MIN_ROWS:
        return held
    for joint, column in enumerate(values.T):
        steps = np.abs(np.diff(column))
        if not np.any(steps > 0.0):
            continue
        sent = np.abs(np.diff(np.interp(angles.times, targets.times, targets.values[:, joint])))
        moving = sent > 2.0 * np.min(steps[steps > 0.0])
        if np.sum(moving) < _FEWEST_MOVING or np.mean(steps[moving] == 0.0) < _HELD:
            continue
        new = np.flatnonzero(np.append(True, steps > 0.0))
        between = np.diff(new)
        both = moving[new[1:] - 1]
        length = int(np.median(between[both])) if np.any(both) else 1
        if length > 1 and np.mean(np.abs(between[both] - length) <= 1) > _ALIKE:
            # At rest, each angle is the same as the one before it.
            since = (
                np.arange(len(column))
                - new[np.searchsorted(new, np.arange(len(column)), "right") - 1]
            )
            held |= since % length != 0
    return held


def _fill_lost(targets: Rows, notes: list[str]) -> Rows:
    """The targets of an even log with those of up to `_MOST_LOST` lost rows in a row, on the line
    between their neighbours: the one before them was not held in their place."""
    steps = np.diff(targets.times)
    if not _is_even(targets.times):
        return targets
    counts = np.round(steps / np.median(steps)).astype(int) - 1
    lost = np.flatnonzero((counts > 0) & (counts <= _MOST_LOST))
    if not len(lost):
        return targets
    added = [np.linspace(targets.times[i], targets.times[i + 1], counts[i] + 2)[1:-1] for i in lost]
    times = np.sort(np.concatenate([targets.times, *added]))
    source = np.searchsorted(targets.times, times, side="right") - 1
    values = [np.interp(times, targets.times, column) for column in targets.values.T]
    notes.append(
        f"{np.sum(counts[lost])} of the {targets.name} were lost, up to {np.max(counts[lost])} in "
        "a row: they count as on the line between their neighbours"
    )
    return targets.chosen(source)._replace(times=times, values=np.stack(values, axis=1))


def _is_even(times: np.ndarray) -> bool:
    """Whether rows come at even times, of which some may be lost: steps are whole multiples of the
    typical one."""
    steps = np.diff(times)
    if not len(steps):
        return False
    share = steps / max(float(np.median(steps)), 1e-9)
    near = np.abs(share - np.maximum(np.round(share), 1.0)) < _NEAR_WHOLE
    return bool(np.mean(near) > _EVEN)


def _height_beyond_neighbours(values: np.ndarray, rows: np.ndarray) -> float:
    """The least distance by which all of successive rows of values [R] lie above, or below, both
    the row before and the row after them; negative if some lies between."""
    neighbours = values[[max(rows[0] - 1, 0), min(rows[-1] + 1, len(values) - 1)]]
    above = np.min(values[rows]) - np.max(neighbours)
    below = np.min(neighbours) - np.max(values[rows])
    return float(max(above, below))


def _largest_step(targets: Rows, joint: int, time: float) -> float:
    """The largest change from one command of a joint to the next, rad, of those that it may still
    be answering at a time (s)."""
    first, last = np.searchsorted(targets.times, [time - _AFTER_STEP, time], side="right")
    sent = targets.values[max(first - 1, 0) : last, joint]
    return float(np.max(np.abs(np.diff(sent)), initial=0.0))


def align_clocks(log: Log) -> Log:
    """The log with the pictures' time stamps in the clock of their arrivals.

    A camera with its own clock is off by a constant and drifts by some parts in 1e5. The drift is
    the slope of a line (Theil 1950 and Sen 1968, which no fourth of its points can bend) through
    the ages of the youngest picture in each stretch of the log. One of less than a millisecond, and
    an offset of less than a second, count as none. A drift faster than any clock's is not
    corrected: pictures that wait longer and longer look like it, and a note says so. Fewer than 240
    pictures stay as they are stamped.

    Raises:
      UserError: the stamps are no seconds.
    """
    if len(log.picture_times) < _STRETCHES * 20:
        return log
    ages = log.arrivals - log.picture_times
    since = log.arrivals - log.arrivals[0]
    parts = np.array_split(np.arange(len(ages)), _STRETCHES)
    youngest = [part[np.argmin(ages[part])] for part in parts]
    slope = float(theilslopes(ages[youngest], since[youngest])[0])
    offset = float(np.median(ages[youngest] - slope * since[youngest]))
    total = abs(slope) * float(np.max(since))
    notes = list(log.notes)
    if drifts := total >= _DRIFT and abs(slope) <= _FASTEST_DRIFT:
        notes.append(
            f"the camera's clock drifts by {1e6 * slope:.0f} parts in 1e6 in {log.source}, "
            f"{1e3 * total:.1f} ms over the log; the pictures' time stamps are corrected"
        )
    elif total > _NO_CLOCK:
        speed = 1.0 - slope
        hint = "stamp them with one clock, in seconds"
        if abs(speed) > _OTHER_UNIT:
            hint = f"if they are {_name_unit(abs(speed), 'ball_time')}"
        raise UserError(
            f"the time stamps of the pictures in {log.source} advance by {speed:.4g} s each "
            f"second, and 1 s is expected; {hint}"
        )
    elif total > _GROWING_AGE:
        notes.append(
            f"the age of the youngest pictures in {log.source} changes by {1e3 * total:.0f} ms in "
            "it, faster than clocks drift; look for pictures that wait, and at their stamps"
        )
    offset *= abs(offset) > _LARGEST_AGE
    if offset:
        notes.append(
            f"the camera's clock is {offset:.6g} s behind the robot's in {log.source}; the "
            "pictures' time stamps are corrected, and the youngest counts as of no age"
        )
    stamps = log.picture_times + drifts * slope * since + offset
    return log._replace(picture_times=stamps, notes=tuple(notes))


def find_gaps(times: np.ndarray) -> list[tuple[float, float]]:
    """The last time before each gap of a measurement's times [T], and the first one after it, s.

    Of an even log, a gap is more lost rows than are filled: the arm had targets in it that the log
    lacks.
    """
    steps = np.diff(times)
    typical = float(np.median(steps))
    if _is_even(times):
        longest = (_MOST_LOST + 1.5) * typical
    else:
        longest = max(_GAP, _GAP_STEPS * typical)
    return [(float(times[i]), float(times[i + 1])) for i in np.flatnonzero(steps > longest)]


def least_age(log: Log) -> float:
    """Time from a picture's stamp to its arrival, s: 0 if the stamp is that of the arrival. Of the
    youngest pictures, as the others wait for the next control step."""
    if not len(log.arrivals):
        return 0.0
    return max(0.0, float(np.quantile(log.arrivals - log.picture_times, 0.02)))


def turns_off(turns: int, column: str) -> str:
    """By how many whole turns a column is off, and what to do, for a reader."""
    count = "a whole turn" if abs(turns) == 1 else f"{abs(turns)} whole turns"
    change = f"{abs(turns) * _TURN:.6g} rad"
    if turns > 0:
        return f"{count}: subtract {change} from {column}"
    return f"{count}: add {change} to {column}"


def _whole_turns(values: np.ndarray, middle: float, within: tuple[float, float]) -> int:
    """By how many whole turns a joint's values [T] are off; 0 if it is no turn that takes them out
    of their limits, rad.

    Args:
      middle: of the joint's range, rad.
      within: limits, rad.
    """
    turns = round((float(np.median(values)) - middle) / _TURN)
    turned = values - turns * _TURN
    return turns if np.all((turned > within[0]) & (turned < within[1])) else 0


def check(log: Log, joint_names: Sequence[str], joint_ranges: np.ndarray) -> None:
    """Checks that a log can be the robot's.

    Args:
      joint_ranges: lower and upper limit [n, 2] of each joint, rad; both 0 for none.

    Raises:
      UserError: it is too short, its times are of two clocks, or a joint is far outside its range.
    """
    limited = joint_ranges[:, :1] < joint_ranges[:, 1:]
    ends = np.array([-1.0, 1.0])
    low, high = np.where(limited, joint_ranges + _BEYOND_RANGE * ends, _LARGEST_ANGLE * ends).T
    columns = {"joint_angles": log.joint_angles, "servo_targets": log.servo_targets}
    for name, times, values in (
        ("joint angles", log.times, log.joint_angles),
        ("servo targets", log.target_times, log.servo_targets),
    ):
        if len(times) < _MIN_ROWS:
            raise UserError(
                f"{log.source} has {len(times)} {name}; record at least {_MIN_ROWS} control steps"
            )
        if np.any(outside := (values < low) | (values > high)):
            row, joint = np.argwhere(outside)[0]
            column = f"{name.replace(' ', '_')}.{joint_names[joint]}"
            remedy = f"if these are degrees, write {column} [deg]"
            if limited[joint]:
                middle = float(np.mean(joint_ranges[joint]))
                within = low[joint], high[joint]
                turns = _whole_turns(values[:, joint], middle, within)
                turned = [
                    f"{title}.{joint_names[joint]}"
                    for title, each in columns.items()
                    if turns and _whole_turns(each[:, joint], middle, within) == turns
                ]
                if turned:
                    remedy = f"it is off by {turns_off(turns, ' and '.join(turned))}"
            raise UserError(
                f"{column} in {log.source} is {values[row, joint]:.4g} rad at the time "
                f"{times[row]:.6g} s, and {low[joint]:.3g} to {high[joint]:.3g} rad is expected; "
                f"{remedy}"
            )
    begins = log.times[0], log.target_times[0]
    ends = log.times[-1], log.target_times[-1]
    if max(begins) > min(ends):
        raise UserError(
            f"the joint angles in {log.source} begin at {begins[0]:.6g} s and end at {ends[0]:.6g} "
            f"s, and the servo targets at {begins[1]:.6g} and {ends[1]:.6g} s; give stamps of one "
            "clock, simulated time or the computer's"
        )


def join(logs: Sequence[Log]) -> Log:
    """Several logs, one after another, without the pictures of times at which the arm was not
    recorded; no window spans two of them."""
    shifted = []
    start = 0.0
    for log in logs:
        first = min(log.times[0], log.target_times[0])
        last = max(log.times[-1], log.target_times[-1])
        is_within = (log.picture_times >= first) & (log.picture_times <= last + 0.5 * _APART)
        shift = start - first
        shifted.append(
            log._replace(
                times=log.times + shift,
                target_times=log.target_times + shift,
                picture_times=log.picture_times[is_within] + shift,
                ball_positions=log.ball_positions[is_within],
                arrivals=log.arrivals[is_within] + shift,
            )
        )
        start = float(last + shift) + _APART

    def joined(field: str) -> np.ndarray:
        return np.concatenate([getattr(log, field) for log in shifted])

    return Log(
        source=", ".join(log.source for log in logs),
        times=joined("times"),
        joint_angles=joined("joint_angles"),
        target_times=joined("target_times"),
        servo_targets=joined("servo_targets"),
        picture_times=joined("picture_times"),
        ball_positions=joined("ball_positions"),
        arrivals=joined("arrivals"),
        notes=tuple(note for log in logs for note in log.notes),
    )


def straighten(times: np.ndarray) -> np.ndarray:
    """Stamps [T] of control steps at regular times, in each stretch in which they only jitter about
    a line: what a stamp is off by is an error of the stamp, not of the step."""
    steps = np.diff(times)
    typical = float(np.median(steps))
    stretches = []
    for part in np.split(times, np.flatnonzero(steps > 1.5 * typical) + 1):
        index = np.arange(len(part)) - 0.5 * (len(part) - 1)
        slope = typical if len(part) < 50 else float(index @ part / (index @ index))
        line = np.mean(part) + slope * index
        stretches.append(line if np.std(part - line) < _JITTER else part)
    # Where jitter alone parts two stretches, their lines may overlap by less than it.
    return np.sort(np.concatenate(stretches))
