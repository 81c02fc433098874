"""Simulation of a log's windows in many candidate worlds side by side, on the engine of the
training."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.signal import lfilter

from bounce_mjx.identify.log import Log
from bounce_mjx.identify.unknowns import CAMERA_ROTATION, Layout
from bounce_mjx.identify.windows import Windows
from bounce_mjx.physics import Control, PhysicsState, make_engine
from bounce_mjx.physics.scalars import quaternion_matrix
from bounce_mjx.robot.contact import stiffness_and_damping
from bounce_mjx.robot.model import contact_pairs, find_addresses, link_bodies, scatter
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import world_model
from bounce_mjx.world.sampling import physics_parameters

_LANES = 128
"""Windows that one thread simulates at a time; more would not fit the processor's cache."""
# Time about a bounce over which the paddle's speed is measured, s.
_ABOUT_BOUNCE = 0.03
# Time after which the longest lag of the search has forgotten a target, s.
_FORGOTTEN = 2.0


Simulate = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""(vectors of unknowns [C, P], states at the starts [C, S, 2 n + 10], which windows count [C, S])
-> what the sensors would have measured [C, S, A n + 3 B], as `Windows.measured`; a window that does
not count has the numbers of the first candidate, or 0 if that has none."""


class Simulated(NamedTuple):
    """What is simulated beyond the unknowns."""

    gravity_compensation: float = 0.0
    """Share of the links' weight that the controller carries, if it is more than the model's
    own."""
    lift: float = 0.0
    """Acceleration of the ball across its flight, per spin and speed."""
    leaves_at_once: bool = False
    """Whether the ball leaves the paddle as soon as it touches it. A real ball stays for 1 ms. The
    model's stays for 10 ms and has not fallen in this time: with it, a real ball of 2 m/s would
    pass for one of 0.05 more restitution."""


NOTHING_ELSE = Simulated()


def make_simulator(
    config: WorldConfig,
    layout: Layout,
    log: Log,
    windows: Windows,
    simulated: Simulated = NOTHING_ELSE,
    runs_once: bool = False,
) -> Simulate:
    """Builds the simulation of a log's windows in candidate worlds.

    Measured angles are the true ones plus `encoder_bias`, which the servos share. A measured ball
    is the true one, `ball_latency` before its time stamp, turned by the camera's rotation about
    the middle of all measured ones, plus `ball_position_bias`.

    Args:
      runs_once: whether it simulates each window once or twice, so that compiling takes longer than
        running.
    """
    run = _compile(config, layout.num_joints, runs_once)
    contact_time = _contact_time(config) if simulated.leaves_at_once else 0.0
    # By how much the paddle has moved in the time for which the ball does not stay on it.
    paddle_rise = contact_time * _paddle_speeds(config, windows)
    n = layout.num_joints
    send, first_rows = window_targets(log, windows)
    shown = windows.balls[windows.picture_weights > 0.0]
    middle = np.mean(shown, axis=0) if len(shown) else np.zeros(3)
    target_rows = first_rows + np.arange(windows.steps)[:, None]
    angle_times = windows.angle_times.T.astype(np.float32)
    picture_times = windows.picture_times.T.astype(np.float32)
    has_left = windows.picture_times > windows.bounces[:, None]
    # A log without a ball lacks these terms; the compiled simulation has them.
    absent = {name: np.zeros(_LANES) for name in ("air_drag", "ball_latency")}
    absent |= {name: np.zeros((_LANES, 3)) for name in ("ball_position_bias", CAMERA_ROTATION)}
    absent["encoder_bias"] = np.zeros((_LANES, n))

    def simulate_block(
        vectors: np.ndarray, starts: np.ndarray, c: np.ndarray, s: np.ndarray
    ) -> np.ndarray:
        """What is measured [L, A n + 3 B] in the windows s [L] of the candidates c [L]."""
        count = len(c)
        fill = np.minimum(np.arange(_LANES), len(c) - 1)
        # Another size would be compiled again.
        c = c[fill]
        s = s[fill]
        world = absent | layout.world(vectors[c])
        targets = np.empty((windows.steps, n, _LANES), np.float32)
        for i in np.unique(c):
            lanes = c == i
            late = send(*(float(world[x][lanes][0]) for x in ("action_latency", "servo_lag")))
            targets[:, :, lanes] = np.moveaxis(late[target_rows[:, s[lanes]]], 2, 1)
        given = {k: np.moveaxis(v, 0, -1).astype(np.float32) for k, v in world.items()}
        first = starts[c, s].T.astype(np.float32)
        out = run(
            given,
            first,
            targets,
            angle_times[:, s],
            picture_times[:, s],
            (contact_time * has_left[s]).T.astype(np.float32),
            (paddle_rise[:, None] * has_left)[s].T.astype(np.float32),
            middle.astype(np.float32),
            np.float32(simulated.gravity_compensation),
            np.float32(simulated.lift),
        )
        rows = [np.moveaxis(np.asarray(x), 2, 0).reshape(_LANES, -1) for x in out]
        return np.concatenate(rows, axis=1)[:count].astype(float)

    def simulate(vectors: np.ndarray, starts: np.ndarray, used: np.ndarray) -> np.ndarray:
        result = np.zeros((*used.shape, windows.measured.shape[1]))
        if not np.any(used):
            return result
        c, s = np.nonzero(used)
        blocks = [slice(i, i + _LANES) for i in range(0, len(c), _LANES)]
        with ThreadPoolExecutor() as pool:
            rows = pool.map(lambda b: simulate_block(vectors, starts, c[b], s[b]), blocks)
            measured = np.concatenate(list(rows))
        # Where a candidate does not count, it has the numbers of the first.
        result[:, s[c == 0]] = measured[c == 0]
        result[c, s] = measured
        return result

    return simulate


def _contact_time(config: WorldConfig) -> float:
    """Time for which the model's ball stays on the paddle in a bounce, s: half a period."""
    model = world_model(config, visual=False)
    pair = contact_pairs(model, find_addresses(model))[0]
    stiffness, _ = stiffness_and_damping(model.pair_solref[pair], model.opt.timestep)
    return np.pi / np.sqrt(stiffness)


def _paddle_speeds(config: WorldConfig, windows: Windows) -> np.ndarray:
    """Upward speed of the paddle at the stamp of each window's bounce [S], m/s, from the measured
    angles: the pictures' latency after the bounce itself, as the search does not know it yet; 0
    without a bounce."""
    model = world_model(config, visual=False)
    data = mujoco.MjData(model)
    addresses = find_addresses(model)
    speeds = np.zeros(len(windows.first))
    for s in np.flatnonzero(windows.has_ball & np.any(windows.angle_weights > 0.0, axis=1)):
        used = windows.angle_weights[s] > 0.0
        heights = []
        for time in windows.bounces[s] + 0.5 * _ABOUT_BOUNCE * np.array([-1.0, 1.0]):
            angles = [
                np.interp(time, windows.angle_times[s, used], x) for x in windows.angles[s, used].T
            ]
            data.qpos[list(addresses.arm_qpos)] = angles
            mujoco.mj_kinematics(model, data)
            heights.append(data.geom_xpos[addresses.paddle_geom][2])
        speeds[s] = (heights[1] - heights[0]) / _ABOUT_BOUNCE
    return speeds


def compensated(config: WorldConfig) -> WorldConfig:
    """The robot with a controller that carries the arm's whole weight."""
    robot = config.robot.model_copy(update={"gravity_compensation": 1.0})
    return config.model_copy(update={"robot": robot})


@lru_cache(8)
def _compile(
    config: WorldConfig, n: int, runs_once: bool = False
) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """The part of a simulation that is compiled, which is the same for all logs: angles
    [A, n, L], rad, and balls [B, 3, L], m."""
    own = world_model(config, visual=False)
    model = world_model(compensated(config), visual=False)
    engine = make_engine(model, config.physics)
    addresses = find_addresses(model)
    links = sum(link_bodies(model, addresses), [])
    ball = addresses.balls[0]
    dt = config.physics_dt
    gears = model.actuator_gear[list(addresses.actuators), 0]
    shown_q = (*addresses.arm_qpos, *ball.qpos[:3])
    shown_v = (*addresses.arm_qvel, *ball.qvel[:3])

    def first_state(start: jax.Array) -> PhysicsState:
        ends = [n, 2 * n, 2 * n + 3, 2 * n + 9]
        angles, velocities, position, ball_speeds, _ = jnp.split(start, ends)
        qpos = scatter(model.qpos0, shown_q, jnp.concatenate([angles, position]))
        moving = (*addresses.arm_qvel, *ball.qvel)
        speeds = jnp.concatenate([velocities, ball_speeds])
        return PhysicsState(qpos, scatter(np.zeros(model.nv), moving, speeds))

    def advance(parameters, state, target, drag, lift):
        ctrl = scatter(np.zeros(model.nu), addresses.actuators, gears * target)
        after = engine.step(parameters, state, Control(ctrl, air_drag=drag), 1)
        speed = jnp.stack([after.qvel[i] for i in ball.qvel[:3]])
        spin = jnp.stack([after.qvel[i] for i in ball.qvel[3:]])
        turned = quaternion_matrix([after.qpos[i] for i in ball.qpos[3:]])
        across = jnp.cross(jnp.stack(turned @ tuple(spin)), speed)
        pushed = after.qvel.at[np.array(ball.qvel[:3])].add(dt * lift * across)
        return after._replace(qvel=pushed)

    def at(path: jax.Array, speeds: jax.Array, times: jax.Array) -> jax.Array:
        """A path [T, k, L] at times [M, L], by the nearest step and its velocity."""
        step = jnp.clip(jnp.round(times / dt), 0, len(path) - 1).astype(jnp.int32)
        near = jnp.take_along_axis(path, step[:, None], axis=0)
        speed = jnp.take_along_axis(speeds, step[:, None], axis=0)
        return near + speed * (times - step * dt)[:, None]

    # On a CPU, LLVM takes most of the time to compile it.
    is_quick = runs_once and jax.default_backend() == "cpu"
    options = {"xla_backend_optimization_level": 0} if is_quick else {}

    @partial(jax.jit, compiler_options=options)
    def run(
        world,
        starts,
        targets,
        angle_times,
        picture_times,
        contact_time,
        paddle_rise,
        middle,
        carried,
        lift,
    ):
        shares = {f"body_gravcomp[{b}]": jnp.maximum(carried, own.body_gravcomp[b]) for b in links}

        def parameters_of(world):
            return physics_parameters(world, model)._replace(entries=shares)

        parameters = jax.vmap(parameters_of, -1, -1)(
            {k: v for k, v in world.items() if k != "encoder_bias"}
        )
        bias = world["encoder_bias"]
        held = world["servo_offset"] - bias
        # Spin also brakes a ball.
        drag = world["air_drag"] * (1.0 + starts[2 * n + 9])

        def body(state, target):
            after = jax.vmap(advance, (-1, -1, -1, -1, None), -1)(
                parameters, state, target + held, drag, lift
            )
            positions = jnp.stack([state.qpos[i] for i in shown_q])
            return after, (positions, jnp.stack([state.qvel[i] for i in shown_v]))

        # The starts are those that the encoders show: their first guess then suits every bias.
        state = jax.vmap(first_state, -1, -1)(starts.at[:n].add(-bias))
        _, (path, speed) = jax.lax.scan(body, state, targets)
        angles = at(path[:, :n], speed[:, :n], angle_times) + bias
        shown_times = picture_times - world["ball_latency"]
        aside = at(path[:, n : n + 2], speed[:, n : n + 2], shown_times)
        # What happens across the paddle, which is nearly level, happens earlier.
        height = at(path[:, n + 2 :], speed[:, n + 2 :], shown_times + contact_time)
        balls = jnp.concatenate([aside, height - paddle_rise[:, None]], axis=1)
        turned = jnp.cross(world[CAMERA_ROTATION][None], balls - middle[:, None], axis=1)
        return angles, balls + turned + world["ball_position_bias"]

    return run


def window_targets(
    log: Log, windows: Windows
) -> tuple[Callable[[float, float], np.ndarray], np.ndarray]:
    """(latency, lag) -> the servo targets [T, n], rad, in the physics steps of all windows and in
    those before them that a lag still shows; and the row [S] of each window's first step.

    A log of hours has windows in a few percent of its time.
    """
    before = round(_FORGOTTEN / windows.dt)
    stretches: list[list[int]] = []
    for first in np.sort(windows.first).tolist():
        begin = max(first - before, 0)
        if not stretches or begin > stretches[-1][1]:
            stretches.append([begin, begin])
        stretches[-1][1] = first + windows.steps
    begins, ends = np.array(stretches).T
    edges = [
        windows.origin + windows.dt * np.arange(a, b) for a, b in zip(begins, ends + 1, strict=True)
    ]
    rows = np.cumsum(ends - begins) - (ends - begins)
    stretch = np.searchsorted(begins, windows.first, side="right") - 1
    return make_targets(log, *edges), windows.first - begins[stretch] + rows[stretch]


def make_targets(log: Log, *stretches: np.ndarray) -> Callable[[float, float], np.ndarray]:
    """(latency, lag) -> the servo targets [T, n], rad, in each physics step, in float32.

    Args:
      stretches: of each stretch of steps, one after another in the result, the times at which they
        begin, and the last one ends, s. Before a stretch, the target was constant.
    """
    dt = float(stretches[0][1] - stretches[0][0])
    # The integral of the targets, each held until the next: its difference over a step is the
    # step's mean target, whatever the latency's share of a step.
    times = np.minimum(np.append(log.target_times, np.inf), stretches[-1][-1] + 1.0)
    held = np.cumsum(np.diff(times)[:, None] * log.servo_targets, axis=0)
    integrals = np.concatenate([np.zeros((1, held.shape[1])), held])

    def delay_stretch(edges: np.ndarray, latency: float, lag: float) -> np.ndarray:
        at = edges - latency
        too_early = np.minimum(at - times[0], 0.0)
        row = max(int(np.searchsorted(log.target_times, at[0], side="right")) - 1, 0)
        columns = []
        for integral, earliest, before in zip(
            integrals.T, log.servo_targets[0], log.servo_targets[row], strict=True
        ):
            mean = np.diff(np.interp(at, times, integral) + too_early * earliest) / dt
            if lag > 1e-6:
                share = -np.expm1(-dt / lag)
                mean, _ = lfilter([share], [1.0, share - 1.0], mean, zi=[(1.0 - share) * before])
            columns.append(mean)
        return np.stack(columns, axis=1).astype(np.float32)

    @lru_cache(64)
    def delay(latency: float, lag: float) -> np.ndarray:
        return np.concatenate([delay_stretch(edges, latency, lag) for edges in stretches])

    return delay
