"""Evaluation on MuJoCo's C engine: the same task and policy, with the physics in threads."""

import functools
import os
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from bounce_mjx.env.env import Env, world_model
from bounce_mjx.evaluation.episodes import reset_episodes
from bounce_mjx.evaluation.recording import empty_recording, record
from bounce_mjx.evaluation.statistics import Statistics, accumulate, empty_statistics
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.physics import (
    PhysicsParameters,
    PhysicsState,
    edited_model,
    servo_targets,
)
from bounce_mjx.physics.edited import contact_pairs
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.task.shown import Recording
from bounce_mjx.world.randomization import Ranges

_FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CTRL = mujoco.mjtState.mjSTATE_CTRL
_CTRL_AND_FORCE = _CTRL | mujoco.mjtState.mjSTATE_XFRC_APPLIED


def make_mujoco_evaluator(
    env: Env,
    actor: Actor,
    episodes: int,
    progress: Callable[[float], None] | None = None,
) -> Callable[..., Statistics]:
    """Like `evaluation.make_evaluator`, with `mj_step` (float64) in place of the env's engine.

    Each episode is simulated in the world that its reset drew.

    Args:
      progress: called every 100 control steps with the share of the time limit that is simulated.
    """
    measure = make_recording_mujoco_evaluator(env, actor, episodes, 0, progress)
    return lambda policy, key, ranges=None: measure(policy, key, ranges)[0]


def make_recording_mujoco_evaluator(
    env: Env,
    actor: Actor,
    episodes: int,
    recorded: int,
    progress: Callable[[float], None] | None = None,
) -> Callable[..., tuple[Statistics, Recording]]:
    """Like `make_mujoco_evaluator`, but also returns a recording of the first `recorded`
    episodes."""
    num_threads = os.cpu_count() or 1

    @jax.jit
    def start(key, ranges):
        return reset_episodes(env, key, episodes, ranges)

    @jax.jit
    def decide(policy, states):
        now, actions = states.pipeline_state, actor.act(policy, states.obs.T).T
        control, actuation = jax.vmap(env.control, in_axes=-1, out_axes=-1)(now, actions)
        targets = jax.vmap(servo_targets, in_axes=(-1, None))(control, env.config.num_substeps)
        damping = None if now.impact is None else now.parameters.contact_damping
        air = control.air_drag, control.air_lift
        return actions, actuation, targets, control.ball_push, damping, air

    @functools.partial(jax.jit, donate_argnames="recording")
    def finish(states, actions, actuation, physics, statistics, step, recording):
        halves = states, actions, actuation, physics
        states = jax.vmap(env.finish_step, in_axes=-1, out_axes=-1)(*halves)
        recording = record(env, recording, states, statistics.running, step)
        return states, accumulate(env, statistics, states, step), recording

    def evaluate(
        policy: Policy, key: jax.Array, ranges: Ranges | None = None
    ) -> tuple[Statistics, Recording]:
        states = start(key, ranges)
        simulated = full_states(env.mj_model, states.pipeline_state.physics)
        ball_velocity = _ball_velocity(env.mj_model)
        models = episode_models(env, states.pipeline_state.parameters)
        data = [mujoco.MjData(models[0]) for _ in range(num_threads)]
        statistics = empty_statistics(env, states)
        recording = empty_recording(env, states, min(recorded, episodes))
        with rollout.Rollout(nthread=num_threads) as pool:
            for step in range(env.config.episode_steps):
                actions, actuation, *inputs = decide(policy, states)
                targets, push, damping, air = jax.tree.map(
                    lambda x: np.asarray(x, np.float64), inputs
                )
                if damping is not None:
                    _set_damping(models, damping)
                if push is not None:
                    simulated[:, ball_velocity] += push.reshape(-1, episodes).T
                simulated = _next_states(pool, models, data, simulated, targets, *air)
                physics = physics_states(env.mj_model, simulated)
                states, statistics, recording = finish(
                    states, actions, actuation, physics, statistics, step, recording
                )
                if step % 100 < 99:
                    continue
                if not np.any(statistics.running):
                    break
                if progress is not None:
                    progress((step + 1) / env.config.episode_steps)
        return statistics, recording

    return evaluate


def _next_states(
    pool: rollout.Rollout,
    models: list[mujoco.MjModel],
    data: list[mujoco.MjData],
    states: np.ndarray,
    targets: np.ndarray,
    air_drag: np.ndarray | None = None,
    air_lift: np.ndarray | None = None,
) -> np.ndarray:
    """States [N, size] after one control step. The forces of the air need the velocity in each
    physics step.

    Args:
      targets: servo targets [N, substeps, nu].
      air_drag: that of `Control` for each state [N].
      air_lift: likewise.
    """
    if air_drag is None and air_lift is None:
        trajectory, _ = pool.rollout(models, data, states, targets, control_spec=_CTRL)
        return trajectory[:, -1]
    balls = find_addresses(models[0]).balls
    bodies, first_velocity = [ball.body for ball in balls], 1 + models[0].nq
    mass = np.array([model.body_mass[bodies] for model in models])
    drag, lift = (0.0 if x is None else x[:, None] * mass for x in (air_drag, air_lift))
    forces = np.zeros((len(states), models[0].nbody, 6))

    def of_balls(start: int, entries: list[tuple[int, ...]]) -> np.ndarray:
        return states[:, start + np.array(entries)]

    for target in np.moveaxis(targets, 1, 0):
        velocity = of_balls(first_velocity, [ball.qvel[:3] for ball in balls])
        speed = np.linalg.norm(velocity, axis=2)
        forces[:, bodies, :3] = -(drag * speed)[:, :, None] * velocity
        if air_lift is not None:
            spin = _turned(
                of_balls(1, [ball.qpos[3:] for ball in balls]),
                of_balls(first_velocity, [ball.qvel[3:] for ball in balls]),
            )
            forces[:, bodies, :3] += lift[:, :, None] * np.cross(spin, velocity)
        control = np.concatenate([target, forces.reshape(len(states), -1)], axis=1)[:, None]
        trajectory, _ = pool.rollout(models, data, states, control, control_spec=_CTRL_AND_FORCE)
        states = trajectory[:, 0]
    return states


def _turned(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] of a body's frame in the world, at its orientation [..., 4]."""
    unit = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    w, axis = unit[..., :1], unit[..., 1:]
    across = 2.0 * np.cross(axis, vector)
    return vector + w * across + np.cross(axis, across)


def _set_damping(models: list[mujoco.MjModel], damping: np.ndarray) -> None:
    """Sets the damping [N] of each model's contacts, 1/s."""
    pairs = contact_pairs(models[0])
    for model, value in zip(models, damping, strict=True):
        model.pair_solref[pairs, 1] = -value


def _ball_velocity(mj_model: mujoco.MjModel) -> np.ndarray:
    """Indices [3 B] of the balls' velocities in a state of mjSTATE_FULLPHYSICS."""
    velocities = [ball.qvel[:3] for ball in find_addresses(mj_model).balls]
    return np.concatenate(velocities) + 1 + mj_model.nq


def episode_models(env: Env, parameters: PhysicsParameters) -> list[mujoco.MjModel]:
    """One model for all episodes, or one model per episode where parameters [..., N] are given."""
    parameters = jax.tree.map(np.asarray, parameters)
    given = jax.tree.leaves(parameters)
    if not given:
        return [env.mj_model]
    plain = world_model(env.config, visual=False)
    return [
        edited_model(plain, jax.tree.map(lambda array, i=i: array[..., i], parameters))
        for i in range(given[0].shape[-1])
    ]


def full_states(mj_model: mujoco.MjModel, physics: PhysicsState) -> np.ndarray:
    """States [N, size] of MuJoCo's mjSTATE_FULLPHYSICS at time 0 from a `PhysicsState` [..., N]."""
    fresh = np.zeros(mujoco.mj_stateSize(mj_model, _FULL_PHYSICS))
    mujoco.mj_getState(mj_model, mujoco.MjData(mj_model), fresh, _FULL_PHYSICS)
    coordinates = np.concatenate(jax.tree.leaves(physics)).T
    states = np.tile(fresh, (len(coordinates), 1))
    # The order: time, positions, velocities, activations, histories of sensors.
    states[:, 1 : 1 + coordinates.shape[1]] = coordinates
    return states


def physics_states(mj_model: mujoco.MjModel, states: np.ndarray) -> PhysicsState:
    """The `PhysicsState` [..., N], in float32, of states [N, size] of mjSTATE_FULLPHYSICS."""
    ends = 1 + np.cumsum([mj_model.nq, mj_model.nv, mj_model.na])
    qpos, qvel, activations = np.split(states[:, 1 : ends[-1]], ends[:-1] - 1, axis=1)
    return PhysicsState(
        qpos=jnp.asarray(qpos.T, jnp.float32),
        qvel=jnp.asarray(qvel.T, jnp.float32),
        act=jnp.asarray(activations.T, jnp.float32) if mj_model.na else None,
    )
