"""A robot's world from its log: the arm alone, the ball's flights, its bounces, all together."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.identify.arm import Given, explain_arm
from bounce_mjx.identify.ball import check_frame, fit_ball, touch_height
from bounce_mjx.identify.fit import (
    Fit,
    Linearisation,
    Noise,
    Problem,
    angle_weights,
    differentiate,
    joint_errors,
    minimise,
    seen_windows,
)
from bounce_mjx.identify.following import (
    command_delay,
    does_move,
    find_settled,
    follow,
    set_points,
    shows_set_points,
)
from bounce_mjx.identify.hypotheses import STILL, Choice
from bounce_mjx.identify.intervals import Certainty, certainty
from bounce_mjx.identify.log import Log, least_age, straighten
from bounce_mjx.identify.response import measure_response
from bounce_mjx.identify.sensors import sensor_noise
from bounce_mjx.identify.servos import servos_of
from bounce_mjx.identify.simulation import Simulate, Simulated, make_simulator
from bounce_mjx.identify.unknowns import OF_SERVOS, Layout
from bounce_mjx.identify.windows import Windows, cut_enough, held_out_rows
from bounce_mjx.robot.model import joint_names
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import model_nominals, world_model

# Successive angles that count as one below which what is left is the noise of the sensors: then an
# error of the simulation's step shows.
_FEW_ALIKE = 3.0


class Identified(NamedTuple):
    """What a log says about a robot's world."""

    layout: Layout
    windows: Windows
    noise: Noise
    fit: Fit
    certainty: Certainty
    before: dict[str, float]
    """Root of the mean squared residual of each sensor, in units of its noise: in the model's own
    world, from the starts of the identified one."""
    after: dict[str, float]
    """In the identified world."""
    held_out: dict[str, float]
    """On the windows that the search had not seen, with their outliers weighted; without a sensor
    that none of them shows."""
    dropped: int
    """Windows whose ball was not in free flight."""
    choice: Choice
    """The hypotheses of the arm, compared in windows that none has seen."""
    counted: Noise | None = None
    """What the fit counted as noise: the sensors', or the model's own errors where they are
    larger."""
    joint_errors: np.ndarray = np.zeros(0)
    """Those of the identified world in unseen windows [n], rad."""
    simulated: Simulated = Simulated()
    """What the world is beyond the unknowns."""
    has_set_points: bool = False
    """Whether the log's targets are a controller's own set points."""
    stamp_age: float = 0.0
    """Time from a picture's stamp to its arrival, s: `ball_latency` in the fit is without it."""

    touch_height: float = 0.0
    """By how much higher than on the model's paddle the measured ball touches it, m."""

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations [P] of the unknowns."""
        return self.certainty.deviation

    @property
    def is_still(self) -> bool:
        """Whether no command of the log changes: it shows no delay, and no servos but their
        offsets."""
        return self.choice.chosen == STILL

    @property
    def is_follower(self) -> bool:
        """Whether the arm is where its commands were: its servos were chosen, and not measured."""
        return not (self.is_still or self.choice.chosen.has_servos)


def identify(
    config: WorldConfig,
    log: Log,
    camera_rotation: float = 0.0,
    progress: Callable[[str], None] = lambda line: None,
) -> Identified:
    """Estimates the world of a robot from its log.

    Args:
      config: settings of the robot's environment.
      camera_rotation: prior standard deviation of the camera's rotation, rad; 0 for a camera that
        is calibrated.
      progress: called with a line about each step.

    Raises:
      UserError: the log has fewer than five windows, the ball bounces beside the paddle, or the
        simulation diverges.
    """
    times = {name: straighten(getattr(log, name)) for name in ("times", "target_times")}
    log = log._replace(**times)
    windows = cut_enough(log, config.physics_dt)
    bounces = int(np.sum(windows.has_ball))
    with_ball = bounces > 0
    progress(f"{len(windows.first)} windows, {bounces} with a bounce")
    if with_ball:
        check_frame(windows, config, log.source)
    layout = Layout(config.num_joints, with_ball, config.physics_dt, camera_rotation)
    model = world_model(config, visual=False)
    sensors = sensor_noise(log)
    settled = find_settled(log)
    fitted = settled & ~held_out_rows(log, windows)
    following = follow(log, fitted)
    given = Given(
        # Before it has a command in each physics step.
        log=log,
        response=measure_response(log, np.flatnonzero(fitted), joint_names(model)),
        following=following,
        delay=command_delay(log, following),
        is_still=not does_move(log),
        has_set_points=shows_set_points(log, following),
    )
    log = set_points(log, following, config.physics_dt)
    make = partial(make_simulator, config, layout, log, windows)
    own = Problem(
        simulate=make(Simulated()),
        windows=windows,
        layout=layout,
        sensors=sensors,
        noise=sensors,
        progress=progress,
    )
    problem, fit, choice = explain_arm(own, servos_of(model), given, make)
    # The unknowns and the entries of the starts that the last searches vary.
    is_shown = choice.chosen.has_servos or choice.chosen == STILL
    stages = ["arm"] if is_shown else []
    free_states = windows.arm_state
    pictures = np.ones_like(windows.picture_weights)
    if with_ball:
        problem, fit, pictures = fit_ball(problem, fit, make)
        stages = [*stages, "flight", "bounce"]
        free_states = None
    progress("all")
    in_steps = problem
    finer = None
    if choice.chosen.has_servos and np.max(problem.correlation) < _FEW_ALIKE:
        finer = _finer_steps(problem, config, camera_rotation, log)
        problem = _correct(in_steps, fit, finer)
    fit, unseen, slopes = _fit_all(problem, fit, pictures, stages, free_states)
    if finer is not None:
        problem = _correct(in_steps, fit, finer)
        fit = minimise(problem, fit, stages, fit.weights, 1, free_states, slopes)
    if not fit.cost < np.inf:
        raise UserError(
            f"the simulation of {log.source} diverges with {config.physics_dt:g} s steps; take a "
            "smaller physics_dt in the robot's config"
        )
    nominals = model_nominals(config)
    nominal = {name: nominals[name] for name in layout.terms if name in nominals}
    nominal_vector = own.layout.vector(nominal)
    before = fit._replace(predicted=own.predict(nominal_vector, fit.starts))
    is_estimated = layout.free(stages)
    is_chosen = np.zeros_like(is_estimated)
    if not is_shown:
        # By `follow`; its servos were chosen.
        is_estimated[layout.slices["delay"]] = True
        is_estimated[layout.slices["servo_offset"]] = True
        for name in OF_SERVOS:
            is_chosen[layout.terms[name]] = True
    counts = np.any(windows.split(fit.weights)[1] > 0.0, axis=(1, 2))
    by_sensor = problem._replace(noise=sensors, correlation=1.0)
    world = layout.world(fit.vector)
    stiffness = servos_of(model).stiffness * world["servo_gain"]
    dead_band = world["joint_frictionloss"] / stiffness if is_shown else 0.0
    known = certainty(problem, fit, is_estimated, is_chosen, dead_band)
    if finer is not None:
        # Latency and lag are the same; their delay and its variance depend on the lag's steps.
        fit = fit._replace(vector=finer.layout.vector(layout.world(fit.vector)))
        layout = finer.layout
    return Identified(
        layout=layout,
        windows=windows,
        noise=sensors,
        fit=fit,
        certainty=known,
        before=_measure_errors(by_sensor, before),
        after=_measure_errors(by_sensor, fit),
        held_out=_measure_errors(by_sensor, unseen),
        dropped=int(np.sum(windows.has_ball & ~counts)),
        choice=choice,
        counted=problem.noise,
        joint_errors=joint_errors(windows, unseen),
        simulated=problem.simulated,
        has_set_points=given.has_set_points,
        stamp_age=least_age(log),
        touch_height=touch_height(config, windows, layout.world(fit.vector)) if with_ball else 0.0,
    )


class _Finer(NamedTuple):
    """A problem's windows, simulated in steps of half the length."""

    simulate: Simulate
    layout: Layout


def _finer_steps(problem: Problem, config: WorldConfig, camera_rotation: float, log: Log) -> _Finer:
    """The finer steps of a problem.

    A real robot has no steps. With those of a training, gains and frictions would make good for the
    length of a step, by up to four standard deviations of what a minute's log shows.
    """
    finer = config.model_copy(update={"physics_dt": 0.5 * config.physics_dt})
    with_ball = "restitution" in problem.layout.unknowns
    layout = Layout(config.num_joints, with_ball, finer.physics_dt, camera_rotation)
    windows = problem.windows.finer()
    simulate = make_simulator(finer, layout, log, windows, problem.simulated, runs_once=True)
    return _Finer(simulate, layout)


def _correct(problem: Problem, fit: Fit, finer: _Finer) -> Problem:
    """The problem with what finer steps change at a fit added to what is simulated: the principle
    of defect correction (Stetter 1978). The search itself stays in the steps of a training."""
    vector = finer.layout.vector(problem.layout.world(fit.vector))
    every = np.ones((1, len(fit.starts)), bool)
    in_finer = finer.simulate(vector[None], fit.starts[None], every)[0]
    change = in_finer - problem.predict(fit.vector, fit.starts)
    change = np.where(np.isfinite(change), change, 0.0)

    def simulate(vectors: np.ndarray, starts: np.ndarray, used: np.ndarray) -> np.ndarray:
        return problem.simulate(vectors, starts, used) + change

    return problem._replace(simulate=simulate)


def _fit_all(
    problem: Problem,
    fit: Fit,
    pictures: np.ndarray,
    stages: Sequence[str],
    free_states: np.ndarray | None,
) -> tuple[Fit, Fit, Linearisation]:
    """The fit to all windows; the one before it, of the windows that the search sees, with the best
    starts of the others; and the derivatives of all.

    Args:
      pictures: weights of the pictures [S, B].
      stages, free_states: what is searched, as for `minimise`.
    """
    seen = seen_windows(problem)
    angles = angle_weights(problem, problem.predict(fit.vector, fit.starts))
    of_seen = problem.weights(pictures, seen, angles)
    of_unseen = problem.weights(pictures, 1.0 - seen, angles)
    of_all = problem.weights(pictures, 1.0, angles)
    slopes = differentiate(problem, fit, stages, of_all, free_states)
    fit = minimise(problem, fit, stages, of_seen, 2, free_states, slopes)
    unseen = minimise(problem, fit, [], of_unseen, 3, free_states, slopes)
    fit = minimise(problem, unseen, stages, of_all, 1, free_states, slopes)
    return fit, unseen, slopes


def _measure_errors(problem: Problem, fit: Fit) -> dict[str, float]:
    """Root mean square of each sensor's residuals in units of its noise; the entries of the starts
    that were searched count as degrees of freedom. The unknowns, dozens beside thousands of
    residuals, do not."""
    windows = problem.windows
    white = problem.whiten(fit.predicted, fit.weights)
    parts = zip(windows.split(white), windows.split(fit.weights), strict=True)
    searched = problem.scale_starts()[2]
    num_searched = [np.sum(searched[which]) for which in (windows.arm_state, ~windows.arm_state)]
    errors = {}
    for name, (residuals, weights), num_states in zip(
        ("joint_angles", "ball_position"), parts, num_searched, strict=True
    ):
        used = np.sum(weights > 0.0, axis=(1, 2))
        free = float(np.sum(np.maximum(used - num_states, 0)))
        if free > 0.0:
            errors[name] = float(np.sqrt(np.sum(residuals**2) / free))
    return errors
