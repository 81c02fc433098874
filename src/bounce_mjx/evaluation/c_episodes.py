"""Evaluation on MuJoCo's C engine: the same task and policy, with the physics in threads."""

import os
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from bounce_mjx.env.env import Env, EnvState, State, world_model
from bounce_mjx.evaluation.episodes import Batch, add_step, begin, reset_episodes
from bounce_mjx.evaluation.statistics import Statistics
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.physics import (
    Control,
    PhysicsParameters,
    PhysicsState,
    edited_model,
    servo_targets,
)
from bounce_mjx.physics.edited import contact_pairs
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.task.shown import Recording
from bounce_mjx.world.actuation import Actuation
from bounce_mjx.world.randomization import Ranges

_FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CTRL = mujoco.mjtState.mjSTATE_CTRL
_CTRL_AND_FORCE = _CTRL | mujoco.mjtState.mjSTATE_XFRC_APPLIED
_NUM_THREADS = os.cpu_count() or 1


def make_mujoco_evaluator(env: Env, actor: Actor, episodes: int) -> Callable[..., Statistics]:
    """Like `evaluation.make_evaluator`, with `mj_step` (float64) in place of the env's engine.

    Each episode is simulated in the world that its reset drew.
    """
    measure = make_recording_mujoco_evaluator(env, actor, episodes, recorded=0)
    return lambda policy, key, ranges=None: measure(policy, key, ranges)[0]


def make_recording_mujoco_evaluator(
    env: Env, actor: Actor, episodes: int, recorded: int
) -> Callable[..., tuple[Statistics, Recording]]:
    """Like `make_mujoco_evaluator`, but also returns a recording of the first `recorded`
    episodes."""

    @jax.jit
    def start(key: jax.Array, ranges: Ranges | None) -> Batch:
        return begin(env, reset_episodes(env, key, episodes, ranges), recorded)

    @jax.jit
    def decide(policy: Policy, states: State) -> tuple[jax.Array, Actuation, Control, jax.Array]:
        now, actions = states.pipeline_state, actor.act(policy, states.obs.T).T
        control, actuation = jax.vmap(env.control, in_axes=-1, out_axes=-1)(now, actions)
        targets = jax.vmap(servo_targets, in_axes=(-1, None))(control, env.config.num_substeps)
        return actions, actuation, control, targets

    @jax.jit
    def finish(
        now: Batch, actions: jax.Array, actuation: Actuation, physics: PhysicsState
    ) -> Batch:
        halves = now.states, actions, actuation, physics
        return add_step(env, now, jax.vmap(env.finish_step, in_axes=-1, out_axes=-1)(*halves))

    def evaluate(
        policy: Policy, key: jax.Array, ranges: Ranges | None = None
    ) -> tuple[Statistics, Recording]:
        now = start(key, ranges)
        with rollout.Rollout(nthread=_NUM_THREADS) as pool:
            physics = _Physics(env, now.states, pool)
            for step in range(env.config.episode_steps):
                actions, actuation, control, targets = decide(policy, now.states)
                after = physics.step(control, targets, now.states.pipeline_state)
                now = finish(now, actions, actuation, after)
                if step % 100 == 99 and not np.any(now.statistics.running):
                    break
        return now.statistics, now.recording

    return evaluate


class _Physics:
    """The physics of N episodes on MuJoCo's C engine, in threads."""

    def __init__(self, env: Env, states: State, pool: rollout.Rollout):
        """
        Args:
          states: the episodes' first states, batch last.
        """
        now = states.pipeline_state
        self._mj_model, self._pool = env.mj_model, pool
        self._models = episode_models(env, now.parameters)
        self._data = [mujoco.MjData(self._models[0]) for _ in range(_NUM_THREADS)]
        self._states = full_states(env.mj_model, now.physics)

    def step(self, control: Control, targets: jax.Array, now: EnvState) -> PhysicsState:
        """The physics [..., N] after one more control step.

        Args:
          control: that of the step [..., N].
          targets: its servo targets [N, substeps, nu].
          now: the states before it; an impact may have changed the contact's damping.
        """
        push, drag, lift, targets, damping = (
            None if x is None else np.asarray(x, np.float64)
            for x in (
                control.ball_push, control.air_drag, control.air_lift, targets,
                None if now.impact is None else now.parameters.contact_damping,
            )
        )  # fmt: skip
        if damping is not None:
            pairs = contact_pairs(self._mj_model)
            for model, value in zip(self._models, damping, strict=True):
                model.pair_solref[pairs, 1] = -value
        if push is not None:
            push = push.reshape(-1, len(self._states)).T
            self._states[:, _ball_velocity(self._mj_model)] += push
        self._states = _next_states(
            self._pool, self._models, self._data, self._states, targets, drag, lift
        )
        return physics_states(self._mj_model, self._states)


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

    def ball_entries(start: int, entries: list[tuple[int, ...]]) -> np.ndarray:
        return states[:, start + np.array(entries)]

    for target in np.moveaxis(targets, 1, 0):
        velocity = ball_entries(first_velocity, [ball.qvel[:3] for ball in balls])
        speed = np.linalg.norm(velocity, axis=2)
        forces[:, bodies, :3] = -(drag * speed)[:, :, None] * velocity
        if air_lift is not None:
            spin = _rotate(
                ball_entries(1, [ball.qpos[3:] for ball in balls]),
                ball_entries(first_velocity, [ball.qvel[3:] for ball in balls]),
            )
            forces[:, bodies, :3] += lift[:, :, None] * np.cross(spin, velocity)
        control = np.concatenate([target, forces.reshape(len(states), -1)], axis=1)[:, None]
        trajectory, _ = pool.rollout(models, data, states, control, control_spec=_CTRL_AND_FORCE)
        states = trajectory[:, 0]
    return states


def _rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] of a body's frame in the world, at its orientation [..., 4]."""
    unit = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    w, axis = unit[..., :1], unit[..., 1:]
    across = 2.0 * np.cross(axis, vector)
    return vector + w * across + np.cross(axis, across)


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
