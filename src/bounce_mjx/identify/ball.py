"""The ball of a robot's world: its flights, then its bounces."""

from collections.abc import Callable, Mapping

import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.identify.fit import (
    AIR_LIFT,
    NO_FLIGHT,
    Fit,
    Noise,
    Problem,
    differentiate,
    flight_errors,
    minimise,
    minimise_each,
    picture_weights,
    sample,
    seen_windows,
)
from bounce_mjx.identify.flight import Flight, acceleration, fit_flight
from bounce_mjx.identify.following import error_size
from bounce_mjx.identify.simulation import Simulate, Simulated
from bounce_mjx.identify.unknowns import ARM, BALL
from bounce_mjx.identify.windows import BEFORE_BOUNCE, GUESSED_DRAG, Windows, is_seen
from bounce_mjx.physics import edited_model
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import world_model
from bounce_mjx.world.sampling import physics_parameters

# Latencies of the ball, s, and its frictions, of the first candidates.
_LATENCIES = np.arange(-0.004, 0.05, 0.008)
_FRICTIONS = (0.01, 0.2)
# Decrease of the cost from which the ball counts as one that leaves the paddle at once.
_SHORT_CONTACT = 10.0
# Prior deviations of the bounces' height beyond which it is another frame.
_ANOTHER_FRAME = 3.0


def check_frame(windows: Windows, config: WorldConfig, source: str) -> None:
    """Refuses a ball that bounces where no world of the prior has it: farther from the paddle's
    height than three deviations of what the camera's offset, the paddle's, and the encoders' zeros
    make together, or beside its face.

    Raises:
      UserError: it does.
    """
    model = world_model(config, visual=False)
    half_size = model.geom_size[find_addresses(model).paddle_geom]
    tops = touching(model, windows)
    farthest = _ANOTHER_FRAME * _height_deviation(model, windows, tops)
    offsets = []
    for s, top in tops.items():
        since = np.abs(windows.picture_times[s] - windows.bounces[s])
        offsets.append(windows.balls[s, np.argmin(since)] - top)
    offset = np.median(offsets, axis=0) if offsets else np.zeros(3)
    if np.hypot(*offset[:2]) > np.max(half_size[:2]) or abs(offset[2]) > farthest:
        x, y, z = offset
        raise UserError(
            f"the ball in {source} bounces {x:.3f}, {y:.3f}, {z:.3f} m (x, y, z) beside the "
            "paddle; give its position in the frame of the robot's base, in metres, z up, and the "
            "robot with the paddle as it is mounted"
        )


def _height_deviation(
    model: mujoco.MjModel, windows: Windows, tops: dict[int, np.ndarray]
) -> float:
    """Prior standard deviation of the bounces' height beside the model's paddle, m.

    Args:
      tops: of the model, as `touching` returns them.
    """
    variance = BALL["ball_position_bias"].deviation ** 2 + BALL["paddle_offset"].deviation ** 2
    for zero in ARM["encoder_bias"].deviation * np.eye(windows.angles.shape[2]):
        moved = touching(model, windows, zero)
        shifts = [moved[s][2] - top[2] for s, top in tops.items()]
        variance += np.mean(np.square(shifts)) if shifts else 0.0
    return float(np.sqrt(variance))


def touching(
    model: mujoco.MjModel, windows: Windows, encoder_bias: np.ndarray | float = 0.0
) -> dict[int, np.ndarray]:
    """Where the ball's centre is when it lies on the middle of the paddle [3], m, at the stamp of
    each window's bounce.

    Args:
      encoder_bias: measured less true angles [n], rad.
    """
    addresses = find_addresses(model)
    data = mujoco.MjData(model)
    paddle = addresses.paddle_geom
    above = model.geom_size[paddle, 2] + model.geom_size[addresses.balls[0].geom, 0]
    places = {}
    for s in np.flatnonzero(windows.has_ball & np.any(windows.angle_weights > 0.0, axis=1)):
        since = np.abs(windows.angle_times[s] - windows.bounces[s])
        near = np.argmin(np.where(windows.angle_weights[s] > 0.0, since, np.inf))
        data.qpos[list(addresses.arm_qpos)] = windows.angles[s, near] - encoder_bias
        mujoco.mj_kinematics(model, data)
        normal = data.geom_xmat[paddle].reshape(3, 3)[:, 2]
        places[int(s)] = data.geom_xpos[paddle] + above * normal
    return places


def touch_height(config: WorldConfig, windows: Windows, world: Mapping[str, np.ndarray]) -> float:
    """By how much higher than on the model's paddle the measured ball touches it, m, in a world:
    what the height of the ball's frame, the paddle's and the encoders' zeros make together, which
    bounces show however they are shared. 0 without a bounce."""
    plain = world_model(config, visual=False)
    of_paddle = {x: np.asarray(world[x], np.float32) for x in ("paddle_offset", "paddle_tilt")}
    model = edited_model(plain, physics_parameters(of_paddle, plain))
    before = touching(plain, windows)
    after = touching(model, windows, world["encoder_bias"])
    if not before:
        return 0.0
    higher = np.median([after[s][2] - before[s][2] for s in before])
    return float(higher + world["ball_position_bias"][2])


def fit_ball(
    problem: Problem, fit: Fit, make: Callable[[Simulated], Simulate]
) -> tuple[Problem, Fit, np.ndarray]:
    """The ball's flights, then its bounces; and the weights of the pictures [S, B].

    Args:
      make: what is simulated -> the simulation of it.
    """
    windows = problem.windows
    states = ~problem.windows.arm_state
    seen = seen_windows(problem)
    problem.progress("flight")
    flying = windows.picture_times < windows.bounces[:, None] - BEFORE_BOUNCE
    plain = minimise(problem, fit, ["flight"], problem.weights(flying, seen), 4, states)
    if _flies(problem, plain, flying):
        fit = plain
    else:
        # A ball with spin is a real one.
        real = problem.simulated._replace(lift=AIR_LIFT, leaves_at_once=True)
        spinning = problem._replace(simulate=make(real), simulated=real)
        guess = _guess_spins(spinning, fit)
        spinning = spinning._replace(noise=_flight_noise(spinning, guess, flying))
        turned = minimise(spinning, guess, ["flight"], problem.weights(flying, seen), 8, states)
        if _flies(spinning, turned, flying):
            problem = spinning
            fit = turned
            problem.progress("the flights show lift by spin")
    problem.progress("bounce")
    stages = ["flight", "bounce"]
    few = problem.weights(1.0, sample(problem, windows.has_ball))
    flights = fit
    # A ball that slips and one that sticks are two valleys, and each latency may be one.
    tried = []
    slopes = []
    for friction in _FRICTIONS:
        begins = [_shift_flights(problem, fit, latency, friction) for latency in _LATENCIES]
        tried += begins
        # Bounces at the same places have nearly the same derivatives.
        middle = begins[len(begins) // 2]
        slopes += [differentiate(problem, middle, stages, few, states)] * len(begins)
    for kept, iterations in ((2, 1), (1, 2)):
        found = minimise_each(problem, tried, stages, few, iterations, states, slopes)
        tried = sorted(found, key=lambda fit: fit.cost)[:kept]
        slopes = []
    fit = _shift_others(problem, tried[0], flights, few)
    if not problem.simulated.leaves_at_once:
        problem, fit = _choose_contact(problem, fit, make, few)
    of_seen = problem.weights(1.0, seen)
    fit = minimise(problem, fit, stages, of_seen, 5, states)
    fit = _shift_others(problem, fit, flights, of_seen)
    fit = minimise(problem, fit, [], problem.weights(1.0, 1.0 - seen), 3, states)
    pictures = picture_weights(problem, problem.predict(fit.vector, fit.starts))
    fit = minimise(problem, fit, stages, problem.weights(pictures, seen), 6, states)
    return problem, fit, pictures


def _choose_contact(
    problem: Problem, fit: Fit, make: Callable[[Simulated], Simulate], few: np.ndarray
) -> tuple[Problem, Fit]:
    """Whether the ball leaves the paddle at once, as a real one does, or later, as the model's: the
    log decides, by the costs of both fits to `few` windows (their weights [S, M])."""
    stages = ["flight", "bounce"]
    states = ~problem.windows.arm_state
    at_once = problem.simulated._replace(leaves_at_once=True)
    real = problem._replace(simulate=make(at_once), simulated=at_once)
    of_model, of_real = (minimise(x, fit, stages, few, 3, states) for x in (problem, real))
    if of_model.cost - of_real.cost < _SHORT_CONTACT:
        return problem, of_model
    problem.progress("the ball leaves the paddle at once")
    return real, of_real


def _guess_spins(problem: Problem, fit: Fit) -> Fit:
    """The fit with the spin and the drag of each flight before a bounce, by a direct fit of it."""
    windows = problem.windows
    starts = fit.starts.copy()
    vector = fit.vector.copy()
    deviations, _, _ = problem.scale_starts()
    lift_deviation = AIR_LIFT * deviations[-2]
    drag_deviation = deviations[-1]
    with_ball = np.flatnonzero(windows.has_ball)
    latency = vector[problem.layout.slices["ball_latency"]]

    def fit_window(s: int, drag: float, drag_deviation: float) -> Flight:
        before = windows.picture_times[s] < windows.bounces[s] - BEFORE_BOUNCE
        counts = before & (windows.picture_weights[s] > 0.0)
        return fit_flight(
            windows.picture_times[s, counts] - latency,
            windows.balls[s, counts],
            problem.noise.balls,
            drag,
            lift_deviation,
            drag_deviation,
        )

    # At first, each flight may have any drag; their median is then that of the ball.
    seen = with_ball[is_seen(windows)[with_ball]]
    free = [fit_window(s, GUESSED_DRAG, 1.0).drag_deviation for s in seen]
    drag = GUESSED_DRAG * (1.0 + float(np.median(free)))
    vector[problem.layout.slices["air_drag"]] = drag
    for s in with_ball:
        flight = fit_window(s, drag, drag_deviation)
        spin = flight.lift / AIR_LIFT
        starts[s, -10:] = [*flight.position, *flight.velocity, *spin, flight.drag_deviation]
    return fit._replace(vector=vector, starts=starts)


def _flight_noise(problem: Problem, fit: Fit, flying: np.ndarray) -> Noise:
    """The sensors' noise, or what the flights [S, B] of the search leave where it is larger: a
    camera's errors that change slowly are not in the differences of neighbouring pictures."""
    windows = problem.windows
    residuals = windows.split(problem.predict(fit.vector, fit.starts))[1] - windows.balls
    counts = flying & (windows.picture_weights > 0.0) & (seen_windows(problem) > 0.0)
    errors = error_size(residuals[counts])
    return problem.noise._replace(balls=np.maximum(problem.sensors.balls, errors))


def _flies(problem: Problem, fit: Fit, flying: np.ndarray) -> bool:
    """Whether most flights [S, B] before a bounce, of those in the search, are explained."""
    counts = problem.windows.has_ball & (seen_windows(problem)[:, 0] > 0.0)
    pictures = problem.windows.picture_weights * flying
    errors = flight_errors(problem, problem.predict(fit.vector, fit.starts), pictures)
    return bool(np.mean(errors[counts] < NO_FLIGHT) > 0.5)


def _shift_others(problem: Problem, fit: Fit, flights: Fit, some: np.ndarray) -> Fit:
    """The fit to some windows (their weights [S, M]), in which the flights of all others explain
    their pictures before the bounce with its latency too."""
    places = problem.layout.slices
    latency, friction = (
        float(fit.vector[places[x]][0]) for x in ("ball_latency", "contact_friction")
    )
    shifted = _shift_flights(problem, flights, latency, friction)
    fitted = np.any(some > 0.0, axis=1)[:, None]
    return fit._replace(starts=np.where(fitted, fit.starts, shifted.starts))


def _shift_flights(problem: Problem, fit: Fit, latency: float, friction: float) -> Fit:
    """The fit with another latency of the ball and friction on the paddle, and flights that explain
    the pictures before the bounces equally well."""
    places = problem.layout.slices
    n = problem.layout.num_joints
    vector = fit.vector.copy()
    starts = fit.starts.copy()
    later = latency - vector[places["ball_latency"].start]
    vector[places["ball_latency"]] = latency
    vector[places["contact_friction"]] = friction
    position = slice(2 * n, 2 * n + 3)
    velocity = slice(2 * n + 3, 2 * n + 6)
    spin = slice(2 * n + 6, 2 * n + 9)
    lift = problem.simulated.lift * starts[:, spin]
    drag = vector[places["air_drag"]] * (1.0 + starts[:, -1])
    pull = acceleration(starts[:, velocity], drag, lift)
    starts[:, position] += later * starts[:, velocity] + 0.5 * later**2 * pull
    starts[:, velocity] += later * pull
    return fit._replace(vector=vector, starts=starts)
