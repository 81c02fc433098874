"""Evaluation on MuJoCo's C engine: the same task and policy, with the physics in threads."""

import os
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from bounce_mjx.env.env import Env, world_model
from bounce_mjx.evaluation.episodes import reset_episodes
from bounce_mjx.evaluation.statistics import Statistics, accumulate, empty_statistics
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.physics import (
    PhysicsParameters,
    PhysicsState,
    edited_model,
    servo_targets,
)
from bounce_mjx.robot.model import find_addresses
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
    num_threads = os.cpu_count() or 1

    @jax.jit
    def start(key, ranges):
        return reset_episodes(env, key, episodes, ranges)

    @jax.jit
    def decide(policy, states):
        actions = actor.act(policy, states.obs.T).T
        states, control = jax.vmap(env.begin_step, in_axes=-1, out_axes=-1)(states, actions)
        targets = jax.vmap(servo_targets, in_axes=(-1, None))(control, env.config.num_substeps)
        return actions, states, targets, control.ball_push, control.air_drag

    @jax.jit
    def finish(states, actions, physics, statistics, step):
        states = jax.vmap(env.finish_step, in_axes=-1, out_axes=-1)(states, actions, physics)
        return states, accumulate(env, statistics, states, step)

    def evaluate(policy: Policy, key: jax.Array, ranges: Ranges | None = None) -> Statistics:
        states = start(key, ranges)
        simulated = full_states(env.mj_model, states.pipeline_state.physics)
        ball_velocity = _ball_velocity(env.mj_model)
        models = episode_models(env, states.pipeline_state.parameters)
        data = [mujoco.MjData(models[0]) for _ in range(num_threads)]
        statistics = empty_statistics(env, states)
        with rollout.Rollout(nthread=num_threads) as pool:
            for step in range(env.config.episode_steps):
                actions, states, *inputs = decide(policy, states)
                targets, push, air_drag = jax.tree.map(lambda x: np.asarray(x, np.float64), inputs)
                if push is not None:
                    simulated[:, ball_velocity] += push.reshape(-1, episodes).T
                simulated = _next_states(pool, models, data, simulated, targets, air_drag)
                physics = physics_states(env.mj_model, simulated)
                states, statistics = finish(states, actions, physics, statistics, step)
                if step % 100 < 99:
                    continue
                if not np.any(statistics.running):
                    break
                if progress is not None:
                    progress((step + 1) / env.config.episode_steps)
        return statistics

    return evaluate


def _next_states(
    pool: rollout.Rollout,
    models: list[mujoco.MjModel],
    data: list[mujoco.MjData],
    states: np.ndarray,
    targets: np.ndarray,
    air_drag: np.ndarray | None,
) -> np.ndarray:
    """States [N, size] after one control step. The drag needs the velocity in each physics step.

    Args:
      targets: servo targets [N, substeps, nu].
      air_drag: deceleration [N] of the balls by the air divided by their squared speed, 1/m.
    """
    if air_drag is None:
        trajectory, _ = pool.rollout(models, data, states, targets, control_spec=_CTRL)
        return trajectory[:, -1]
    balls = [ball.body for ball in find_addresses(models[0]).balls]
    ball_velocity = _ball_velocity(models[0])
    drag = air_drag[:, None] * [model.body_mass[balls] for model in models]
    forces = np.zeros((len(states), models[0].nbody, 6))
    for target in np.moveaxis(targets, 1, 0):
        velocity = states[:, ball_velocity].reshape(len(states), -1, 3)
        speed = np.linalg.norm(velocity, axis=2)
        forces[:, balls, :3] = -(drag * speed)[:, :, None] * velocity
        control = np.concatenate([target, forces.reshape(len(states), -1)], axis=1)[:, None]
        trajectory, _ = pool.rollout(models, data, states, control, control_spec=_CTRL_AND_FORCE)
        states = trajectory[:, 0]
    return states


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
