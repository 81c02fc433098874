"""A log's run next to the simulation of its servo targets in a known world."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from bounce_mjx.errors import UserError, shorten
from bounce_mjx.identify.fit import Fit, Problem, minimise
from bounce_mjx.identify.log import Log, least_age
from bounce_mjx.identify.simulation import make_run, make_simulator
from bounce_mjx.identify.stages import BEFORE_BOUNCE, sensor_noise
from bounce_mjx.identify.unknowns import Layout, Unknown, make_layout
from bounce_mjx.identify.windows import MAX_DELAY, Windows, cut
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import TERMS

# Pictures farther apart leave the ball unseen, s.
_UNSEEN = 0.1
# Time that a window is simulated, s: the ball flies on until the next bounce's window begins.
_SECONDS = 1.2
_ITERATIONS = 3


class Replay(NamedTuple):
    """The measured run and the simulated one, in this order, as the sensors show them."""

    angles: np.ndarray
    """Joint angles [T, 2, n] at each control step, rad."""
    balls: np.ndarray
    """The ball [T, 2, 3], m; NaN where it is not shown."""

    @property
    def distances(self) -> tuple[float, float]:
        """Root mean square of what the simulated angles (rad) and ball (m; NaN if it is never
        shown) are off, for each joint and coordinate."""
        off = (self.angles[:, 1] - self.angles[:, 0], self.balls[:, 1] - self.balls[:, 0])
        shown = [x[~np.isnan(x)] for x in off]
        return tuple(float(np.sqrt(np.mean(x**2))) if x.size else np.nan for x in shown)


def replay_log(
    config: WorldConfig,
    log: Log,
    estimates: Mapping[str, float | tuple[float, ...]] = MappingProxyType({}),
    seconds: float | None = None,
) -> Replay:
    """Simulates a log's servo targets in a world with the estimates, and the middle of each other
    range of a config's randomisation.

    The ball's path is chaotic over many bounces. The simulation therefore starts again in each
    window of the identification, from the state that best explains what was measured: the ball's,
    up to the bounce. Where no window is, the simulated arm is the measured one, and its ball is not
    shown; nor is it where no picture shows the measured one.

    Args:
      estimates: values of the world's terms, as in `NamedWorld`.
      seconds: length of the replay, s; by default, that of the log.

    Raises:
      UserError: the log has no window, or an estimate has the wrong size.
    """
    windows = cut(log, config.physics_dt, max_windows=len(log.times))
    layout, vector = _known(config, log, estimates)
    run = make_run(config, config.num_joints)
    simulate = make_simulator(run, layout, log, windows)
    fit = _started(Problem(simulate, windows, layout, sensor_noise(log)), vector)
    length = log.seconds if seconds is None else min(seconds, log.seconds)
    times = log.times[0] + config.control_dt * np.arange(int(length / config.control_dt) + 1)
    measured, seen = _measured(log, times)
    angles, balls = measured.copy(), np.full_like(seen, np.nan)
    at, since = _steps_of(windows, times[0], config)
    dense = windows._replace(
        steps=round(_SECONDS / config.physics_dt),
        angle_times=since,
        angles=np.zeros((*since.shape, config.num_joints)),
        picture_times=since,
        balls=np.zeros((*since.shape, 3)),
        picture_weights=np.zeros_like(since),
    )
    simulate = make_simulator(run, layout, log, dense)
    every = np.ones((1, len(since)), bool)
    shown = simulate(vector[None], fit.starts[None], every)
    # A later window replaces an earlier one from its begin; one of the arm alone leaves the ball.
    for s, has_ball in enumerate(windows.has_ball):
        used = (since[s] >= MAX_DELAY) & (at[s] < len(times))
        angles[at[s, used]] = shown.angles[0, s, used]
        if has_ball:
            balls[at[s, used]] = shown.balls[0, s, used]
    balls[np.isnan(seen)] = np.nan
    return Replay(np.stack([measured, angles], 1), np.stack([seen, balls], 1))


def _known(
    config: WorldConfig, log: Log, estimates: Mapping[str, float | tuple[float, ...]]
) -> tuple[Layout, np.ndarray]:
    """The layout with all terms of the world, and their values [P]; a term with neither an estimate
    nor a range is nominal."""
    middles = {n: np.mean(ends, 0, float) for n, ends in config.randomization.ranges().items()}
    layout = make_layout(config.num_joints, True, config.physics_dt)
    others = {
        name: Unknown(0.0, 1.0, 1.0, "", "", None if size is None else sum(size))
        for name, (size, _, _) in TERMS.items()
        if name in middles.keys() - layout.unknowns.keys()
    }
    layout = layout._replace(unknowns=layout.unknowns | others)
    for name, value in estimates.items():
        place = layout.slices().get(name, slice(0, 0))
        if np.size(value) != place.stop - place.start:
            raise UserError(
                f"the world's estimates have {np.size(value)} numbers for {shorten(name)}, and the "
                f"robot has {place.stop - place.start}; identify it again"
            )
    nominal = {name: term.nominal for name, term in TERMS.items() if term.nominal is not None}
    world = nominal | middles | estimates
    if "ball_latency" in middles.keys() | estimates.keys():
        # That of a world is from the exposure to the arrival; the log's stamps may be earlier.
        world["ball_latency"] -= least_age(log)
    return layout, layout.vector(world)


def _started(problem: Problem, vector: np.ndarray) -> Fit:
    """The fit in which only the states at the windows' starts are searched. The ball's is that of
    the pictures before the bounce, so that those after it show how the world differs."""
    windows, nothing = problem.windows, np.zeros(len(vector), bool)
    flying = windows.picture_times < windows.bounces[:, None] - BEFORE_BOUNCE
    weights = problem.weights(pictures=flying * 1.0)
    return minimise(problem, vector, windows.starts, nothing, weights, _ITERATIONS)


def _measured(log: Log, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measured angles [T, n] and ball [T, 3] at times [T], interpolated."""
    angles, balls = (
        np.stack([np.interp(times, at, column) for column in values.T], axis=1)
        for at, values in (
            (log.times, log.joint_angles),
            # Of a log without a picture, all are unseen.
            (np.append(log.picture_times, np.inf), np.vstack([log.ball_positions, np.zeros(3)])),
        )
    )
    after = np.searchsorted(log.picture_times, times)
    edges = np.concatenate([[-np.inf], log.picture_times, [np.inf]])
    balls[edges[after + 1] - edges[after] > _UNSEEN] = np.nan
    return angles, balls


def _steps_of(windows: Windows, begin: float, config: WorldConfig) -> tuple[np.ndarray, np.ndarray]:
    """Index [S, K] of the control steps in each window, and their times since its start, s."""
    zero = windows.origin + config.physics_dt * windows.first - begin
    first = np.ceil(zero / config.control_dt).astype(int).clip(0)
    at = first[:, None] + np.arange(int(_SECONDS / config.control_dt))
    return at, at * config.control_dt - zero[:, None]
