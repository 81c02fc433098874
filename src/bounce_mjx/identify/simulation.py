"""Simulation of a log's windows in many candidate worlds side by side, on the engine of the
training."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

from bounce_mjx.env.env import world_model
from bounce_mjx.identify.log import Log
from bounce_mjx.identify.unknowns import CAMERA_ROTATION, Layout
from bounce_mjx.identify.windows import Windows
from bounce_mjx.physics import Control, PhysicsState, make_engine
from bounce_mjx.robot.model import find_addresses, resting_activations
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import physics_parameters

CHUNK = 8
"""Candidates that are simulated at a time; more would not fit the processor's cache."""


class Predicted(NamedTuple):
    """What the sensors of C candidates would have measured in S windows."""

    angles: np.ndarray
    """Joint angles [C, S, A, n], rad."""
    balls: np.ndarray
    """The ball in each picture [C, S, B, 3], m."""


Simulate = Callable[[np.ndarray, np.ndarray], Predicted]
"""(vectors of unknowns [C, P], states at the starts [C, S, 2 n + 9]) -> what they would measure."""


Run = Callable[..., tuple[jax.Array, jax.Array]]
"""The compiled part of a `Simulate`, which is the same for all logs."""


def make_run(config: WorldConfig, num_joints: int) -> Run:
    """Builds the simulation of windows in candidate worlds.

    Measured angles are the true ones plus `encoder_bias`, which the servos share. A measured ball
    is the true one, `ball_latency` before its time stamp, turned by the camera's rotation about
    the middle of all measured ones, plus `ball_position_bias`.
    """
    model = world_model(config, visual=False)
    engine, addresses = make_engine(model, config.physics), find_addresses(model)
    n, ball, dt = num_joints, addresses.balls[0], config.physics_dt
    gear = model.actuator_gear[:, 0]
    shown_q = (*addresses.arm_qpos, *ball.qpos[:3])
    shown_v = (*addresses.arm_qvel, *ball.qvel[:3])
    rest = jnp.asarray(model.qpos0, jnp.float32)

    def first_state(start: jax.Array) -> PhysicsState:
        angles, velocities, position, ball_speeds = jnp.split(start, [n, 2 * n, 2 * n + 3])
        qpos = rest.at[np.array(shown_q)].set(jnp.concatenate([angles, position]))
        moving = np.array((*addresses.arm_qvel, *ball.qvel))
        qvel = jnp.zeros(model.nv, start.dtype)
        qvel = qvel.at[moving].set(jnp.concatenate([velocities, ball_speeds]))
        return PhysicsState(qpos, qvel, resting_activations(model, list(qpos)))

    def advance(parameters, state, target, drag):
        # One scalar per joint, which XLA fuses with the physics.
        ctrl = [jnp.zeros_like(drag)] * model.nu
        for i, actuator in enumerate(addresses.actuators):
            ctrl[actuator] = float(gear[actuator]) * target[i]
        return engine.step(parameters, state, Control(jnp.stack(ctrl), air_drag=drag), 1)

    def at(path: jax.Array, speeds: jax.Array, times: jax.Array) -> jax.Array:
        """A path [T, k, C, S] at times [M, C, S], by the nearest step and its velocity."""
        step = jnp.clip(jnp.round(times / dt), 0, len(path) - 1).astype(jnp.int32)
        near, speed = (jnp.take_along_axis(x, step[:, None], axis=0) for x in (path, speeds))
        return near + speed * (times - step * dt)[:, None]

    @jax.jit
    def run(world, starts, targets, angle_times, picture_times, middle):
        num_steps, _, count, num_windows = targets.shape
        spread = lambda x: jnp.repeat(jnp.moveaxis(x, 0, -1), num_windows, axis=-1)  # noqa: E731
        each = {name: spread(value) for name, value in world.items()}
        parameters = jax.vmap(lambda w: physics_parameters(w, model), -1, -1)(
            {k: v for k, v in each.items() if k != "encoder_bias"}
        )
        flat = jnp.moveaxis(starts, -1, 0).reshape(starts.shape[-1], -1)
        state = jax.vmap(first_state, -1, -1)(flat)
        bias = each["encoder_bias"]
        ctrl = targets.reshape(num_steps, n, -1) - bias

        def body(state, target):
            after = jax.vmap(advance, -1, -1)(parameters, state, target, each["air_drag"])
            positions = jnp.stack([state.qpos[i] for i in shown_q])
            return after, (positions, jnp.stack([state.qvel[i] for i in shown_v]))

        _, paths = jax.lax.scan(body, state, ctrl)
        path, speed = (x.reshape(num_steps, n + 3, count, num_windows) for x in paths)
        sampled = angle_times.T[:, None]
        sampled = jnp.broadcast_to(sampled, (len(sampled), count, num_windows))
        angles = at(path[:, :n], speed[:, :n], sampled) + bias.reshape(n, count, num_windows)
        latency = world["ball_latency"][:, None]
        balls = at(path[:, n:], speed[:, n:], picture_times.T[:, None] - latency)
        turned = jnp.cross(
            world[CAMERA_ROTATION].T[None, :, :, None], balls - middle[:, None, None], axis=1
        )
        balls = balls + turned + world["ball_position_bias"].T[:, :, None]
        return jnp.transpose(angles, (2, 3, 0, 1)), jnp.transpose(balls, (2, 3, 0, 1))

    return run


def make_simulator(run: Run, layout: Layout, log: Log, windows: Windows, dt: float) -> Simulate:
    """Binds a log and its windows to a simulation.

    Args:
      dt: physics time step, s.
    """
    sent, n = _Targets(log, windows, dt), layout.num_joints
    shown = windows.balls[windows.picture_weights > 0.0]
    middle = np.mean(shown, axis=0) if len(shown) else np.zeros(3)
    of_log = windows.angle_times, windows.picture_times, middle
    fixed = [jnp.asarray(array, jnp.float32) for array in of_log]
    steps = windows.first + np.arange(windows.steps)[:, None]

    def simulate(vectors: np.ndarray, starts: np.ndarray) -> Predicted:
        parts = []
        for i in range(0, len(vectors), CHUNK):
            # The last chunk is filled up, as another size would be compiled again.
            index = np.minimum(np.arange(i, i + CHUNK), len(vectors) - 1)
            world = _whole_world(layout.world(vectors[index]), n)
            pairs = zip(world["action_latency"], world["servo_lag"], strict=True)
            # [T, n, C, S] from the targets [T, S, n] of each candidate.
            targets = np.stack([sent(float(a), float(b))[steps] for a, b in pairs])
            targets = np.ascontiguousarray(np.transpose(targets, (1, 3, 0, 2)))
            given = {k: jnp.asarray(v, jnp.float32) for k, v in world.items()}
            first = jnp.asarray(starts[index], jnp.float32)
            out = run(given, first, jnp.asarray(targets), *fixed)
            parts.append([np.asarray(x)[: len(vectors) - i] for x in out])
        angles, balls = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        return Predicted(angles.astype(float), balls.astype(float))

    return simulate


def _whole_world(world: Mapping[str, np.ndarray], num_joints: int) -> dict[str, np.ndarray]:
    """The world of candidates with the terms that a log without a ball lacks."""
    count = len(world["action_latency"])
    absent = {
        "encoder_bias": np.zeros((count, num_joints)),
        "air_drag": np.zeros(count),
        "ball_latency": np.zeros(count),
        "ball_position_bias": np.zeros((count, 3)),
        CAMERA_ROTATION: np.zeros((count, 3)),
    }
    return absent | dict(world)


class _Targets:
    """Servo targets in each physics step, after latency and lag."""

    def __init__(self, log: Log, windows: Windows, dt: float):
        steps = int(windows.first.max()) + windows.steps
        self._edges = windows.origin + dt * np.arange(steps + 1)
        self._dt = dt
        # The integral of the targets, each held until the next: its difference over a step is the
        # step's mean target, whatever the latency's share of a step.
        times = np.append(log.target_times, np.inf)
        held = np.diff(np.minimum(times, self._edges[-1] + 1.0))[:, None] * log.servo_targets
        self._times = np.minimum(times, self._edges[-1] + 1.0)
        self._integral = np.concatenate([np.zeros((1, held.shape[1])), np.cumsum(held, axis=0)])
        self._first = log.servo_targets[0]
        self._kept: dict[tuple[float, float], np.ndarray] = {}

    def __call__(self, latency: float, lag: float) -> np.ndarray:
        """Targets [T, n], rad, in float32."""
        key = latency, lag
        if key not in self._kept:
            if len(self._kept) > 64:
                self._kept.clear()
            self._kept[key] = self._computed(latency, lag)
        return self._kept[key]

    def _computed(self, latency: float, lag: float) -> np.ndarray:
        at, times = self._edges - latency, self._times
        early = np.minimum(at - times[0], 0.0)
        columns = []
        for integral, first in zip(self._integral.T, self._first, strict=True):
            total = np.interp(at, times, integral) + early * first
            mean = np.diff(total) / self._dt
            if lag > 1e-6:
                share = -np.expm1(-self._dt / lag)
                mean, _ = lfilter([share], [1.0, share - 1.0], mean, zi=[(1.0 - share) * first])
            columns.append(mean)
        return np.stack(columns, axis=1).astype(np.float32)
