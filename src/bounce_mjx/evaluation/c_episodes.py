"""Evaluation on MuJoCo's C engine: the same task and policy, with the physics in threads."""

import os
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.episodes import reset_episodes
from bounce_mjx.evaluation.statistics import Statistics, accumulate, empty_statistics
from bounce_mjx.learning.policy import Networks, Policy, act
from bounce_mjx.physics import (
    Control,
    PhysicsParameters,
    PhysicsState,
    edited_model,
    servo_targets,
)
from bounce_mjx.robot.model import find_addresses, load_model
from bounce_mjx.world.randomization import Ranges

_FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CTRL = mujoco.mjtState.mjSTATE_CTRL
_CTRL_AND_FORCE = _CTRL | mujoco.mjtState.mjSTATE_XFRC_APPLIED


def make_mujoco_evaluator(
    env: Env,
    networks: Networks,
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
        actions = act(networks, policy, states.obs.T).T
        states, control = jax.vmap(env.begin_step, in_axes=-1, out_axes=-1)(states, actions)
        return actions, states, _control_inputs(env, control)

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
                actions, states, inputs = decide(policy, states)
                inputs = jax.tree.map(lambda x: np.asarray(x, np.float64), inputs)
                simulated[:, ball_velocity] += inputs.ball_push
                simulated = _next_states(pool, models, data, simulated, inputs)
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


class _Inputs(NamedTuple):
    """Inputs of MuJoCo over one control step of N episodes."""

    targets: np.ndarray
    """Servo targets [N, substeps, nu]."""
    ball_push: np.ndarray
    """Velocities [N, 3 B] that pushes add to the balls, m/s."""
    air_drag: np.ndarray | None
    """Deceleration [N] of the balls by the air divided by their squared speed, 1/m."""


def _control_inputs(env: Env, control: Control) -> _Inputs:
    """Inputs from controls whose batch is last."""
    targets = jax.vmap(servo_targets, in_axes=(-1, None))(control, env.config.num_substeps)
    push = control.ball_push
    if push is None:
        push = jnp.zeros((3 * env.config.num_balls, len(targets)))
    return _Inputs(targets, push.reshape(-1, len(targets)).T, control.air_drag)


def _next_states(
    pool: rollout.Rollout,
    models: list[mujoco.MjModel],
    data: list[mujoco.MjData],
    states: np.ndarray,
    inputs: _Inputs,
) -> np.ndarray:
    """States [N, size] after one control step. The drag needs the velocity in each physics step."""
    if inputs.air_drag is None:
        trajectory, _ = pool.rollout(models, data, states, inputs.targets, control_spec=_CTRL)
        return trajectory[:, -1]
    balls = [ball.body for ball in find_addresses(models[0]).balls]
    ball_velocity = _ball_velocity(models[0])
    drag = inputs.air_drag[:, None] * [model.body_mass[balls] for model in models]
    forces = np.zeros((len(states), models[0].nbody, 6))
    for targets in np.moveaxis(inputs.targets, 1, 0):
        velocity = states[:, ball_velocity].reshape(len(states), -1, 3)
        speed = np.linalg.norm(velocity, axis=2)
        forces[:, balls, :3] = -(drag * speed)[:, :, None] * velocity
        control = np.concatenate([targets, forces.reshape(len(states), -1)], axis=1)[:, None]
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
    c = env.config
    plain = load_model(c.mjcf, c.physics_dt, visual=False, robot=c.robot, num_balls=c.num_balls)
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
