"""Evaluation on MuJoCo's C engine: the same task and policy, the physics in threads."""

import os
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from bounce_mjx.evaluation.statistics import Statistics, accumulate, empty_statistics
from bounce_mjx.learning.policy import Networks, Policy, act
from bounce_mjx.physics import PhysicsState
from bounce_mjx.task.env import BounceBall


def make_mujoco_evaluator(
    env: BounceBall, networks: Networks, episodes: int
) -> Callable[[Policy, jax.Array], Statistics]:
    """Like `evaluation.make_evaluator`, with `mj_step` (float64) in place of the env's engine."""
    num_threads = os.cpu_count() or 1
    full_physics = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state_size = mujoco.mj_stateSize(env.mj_model, full_physics)
    nq, nv = env.mj_model.nq, env.mj_model.nv
    if state_size != 1 + nq + nv:
        raise ValueError("the model has activations or plugins, which this evaluation lacks")

    @jax.jit
    def start(key):
        return jax.vmap(env.reset, out_axes=-1)(jax.random.split(key, episodes))

    @jax.jit
    def decide(policy, states):
        actions = act(networks, policy, states.obs.T).T
        targets = jax.vmap(env.servo_targets, in_axes=-1, out_axes=-1)(
            states.pipeline_state.physics, actions
        )
        return actions, targets.T

    @jax.jit
    def finish(states, actions, physics, statistics, step):
        states = jax.vmap(env.finish_step, in_axes=-1, out_axes=-1)(states, actions, physics)
        return states, accumulate(env, statistics, states, step)

    def evaluate(policy: Policy, key: jax.Array) -> Statistics:
        states = start(key)
        physics = states.pipeline_state.physics
        simulated = np.zeros((episodes, state_size))
        simulated[:, 1:] = np.concatenate([physics.qpos, physics.qvel]).T
        data = [mujoco.MjData(env.mj_model) for _ in range(num_threads)]
        statistics = empty_statistics(episodes)
        with rollout.Rollout(nthread=num_threads) as pool:
            for step in range(env.config.episode_steps):
                actions, targets = decide(policy, states)
                control = np.repeat(
                    np.asarray(targets, np.float64)[:, None], env.config.num_substeps, axis=1
                )
                trajectory, _ = pool.rollout(env.mj_model, data, simulated, control)
                simulated = trajectory[:, -1]
                physics = PhysicsState(
                    qpos=jnp.asarray(simulated[:, 1 : 1 + nq].T, jnp.float32),
                    qvel=jnp.asarray(simulated[:, 1 + nq :].T, jnp.float32),
                )
                states, statistics = finish(states, actions, physics, statistics, step)
                if step % 100 == 99 and not np.any(statistics.running):
                    break
        return statistics

    return evaluate
