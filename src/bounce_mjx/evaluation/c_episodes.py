"""Evaluation on MuJoCo's C engine: the same task and policy. The physics is in threads, except
while a ball that has friction touches something: those steps are `physics.CEngine`'s."""

import copy
import os

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from bounce_mjx.env.env import Env, EnvState, State
from bounce_mjx.evaluation.episodes import Batch, Evaluator, add_step, begin, reset_episodes
from bounce_mjx.evaluation.statistics import Measured
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.physics import (
    CEngine,
    Control,
    PhysicsParameters,
    PhysicsState,
    edited_model,
    servo_targets,
)
from bounce_mjx.world.actuation import ActuationMemory
from bounce_mjx.world.model import world_model
from bounce_mjx.world.randomization import Ranges

_FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CTRL = mujoco.mjtState.mjSTATE_CTRL
_CTRL_AND_FORCE = _CTRL | mujoco.mjtState.mjSTATE_XFRC_APPLIED
# Change of a ball's velocity in a physics step that is no contact's, m/s.
_NO_CONTACT = 1e-9
_NUM_THREADS = os.cpu_count() or 1


def make_mujoco_evaluator(env: Env, actor: Actor, episodes: int, recorded: int = 0) -> Evaluator:
    """Like `episodes.make_evaluator`, with `mj_step` (float64) in place of the env's engine, and
    without the copies that fill up a block: the last bits of an episode may depend on their number.

    Each episode is simulated in the world that its reset drew.
    """

    @jax.jit
    def start(key: jax.Array, ranges: Ranges | None) -> Batch:
        return begin(env, reset_episodes(env, key, episodes, ranges), recorded)

    @jax.jit
    def decide(
        policy: Policy, states: State
    ) -> tuple[jax.Array, ActuationMemory, Control, jax.Array]:
        now = states.pipeline_state
        actions = actor.act(policy, states.obs.T).T
        control, actuation = jax.vmap(env.control, in_axes=-1, out_axes=-1)(now, actions)
        targets = jax.vmap(servo_targets, in_axes=(-1, None))(control, env.config.num_substeps)
        return actions, actuation, control, targets

    @jax.jit
    def finish(
        now: Batch, actions: jax.Array, actuation: ActuationMemory, physics: PhysicsState
    ) -> Batch:
        finish_step = jax.vmap(env.finish_step, in_axes=-1, out_axes=-1)
        return add_step(env, now, finish_step(now.states, actions, actuation, physics))

    def evaluate(policy: Policy, key: jax.Array, ranges: Ranges | None = None) -> Measured:
        now = start(key, ranges)
        with rollout.Rollout(nthread=_NUM_THREADS) as pool:
            physics = _Physics(env, now.states.pipeline_state, pool)
            for step in range(env.config.episode_steps):
                actions, actuation, control, targets = decide(policy, now.states)
                after = physics.step(control, targets)
                now = finish(now, actions, actuation, after)
                # To look waits for the step, so that the next one would begin later.
                if step % 100 == 99 and not np.any(now.statistics.running):
                    break
        return now.statistics, now.recording

    return evaluate


class _Physics:
    """The physics of N episodes on MuJoCo's C engine."""

    def __init__(self, env: Env, now: EnvState, pool: rollout.Rollout):
        """
        Args:
          now: the episodes' first states, batch last.
        """
        self._mj_model = env.mj_model
        self._pool = pool
        self._engines = [CEngine(model) for model in episode_models(env, now.parameters)]
        self._has_friction = any(engine.has_friction for engine in self._engines)
        self._models = [engine.model for engine in self._engines]
        self._data = [mujoco.MjData(self._models[0]) for _ in range(_NUM_THREADS)]
        self._states = full_states(env.mj_model, now.physics)
        balls = env.addresses.balls
        self._bodies = [ball.body for ball in balls]
        self._masses = np.array([model.body_mass[self._bodies] for model in self._models])
        self._gravity = np.array([[model.opt.gravity] for model in self._models])
        # A state begins with the time and the positions.
        self._velocities = 1 + env.mj_model.nq + np.array([ball.qvel[:3] for ball in balls])

    def step(self, control: Control, targets: jax.Array) -> PhysicsState:
        """The physics [..., N] after one more control step.

        Args:
          control: that of the step [..., N].
          targets: its servo targets [N, substeps, nu].
        """
        targets = np.asarray(targets, np.float64)
        if control.ball_push is not None:
            push = np.asarray(control.ball_push, np.float64)
            push = push.reshape(-1, len(self._states)).T
            self._states[:, self._velocities.ravel()] += push
        if control.air_drag is None:
            self._advance(targets, _CTRL, self._gravity)
        else:
            drag = np.asarray(control.air_drag, np.float64)
            # The drag needs the velocity in each physics step.
            for target in np.moveaxis(targets, 1, 0):
                of_air = self._drag_accelerations(drag)
                forces = self._forces(of_air).reshape(len(target), -1)
                controls = np.concatenate([target, forces], axis=1)[:, None]
                self._advance(controls, _CTRL_AND_FORCE, self._gravity + of_air)
        return physics_states(self._mj_model, self._states)

    def _advance(
        self, controls: np.ndarray, kind: mujoco.mjtState, accelerations: np.ndarray
    ) -> None:
        """Advances by physics steps.

        Args:
          controls: [N, steps, size] of a kind.
          accelerations: of balls that touch nothing [N or 1, balls or 1, 3].
        """
        trajectory, _ = self._pool.rollout(
            self._models, self._data, self._states, controls, control_spec=kind
        )
        after = trajectory[:, -1]
        if self._has_friction:
            # MuJoCo's steps are right for those episodes alone in which no ball touches anything.
            for i in np.flatnonzero(self._is_touched(trajectory, accelerations)):
                after[i] = self._step_one(i, controls[i], kind)
        self._states = after

    def _is_touched(self, trajectory: np.ndarray, accelerations: np.ndarray) -> np.ndarray:
        """Whether a ball of an episode does anything but fly in steps [N, steps, size]: [N].

        A contact that changes a ball's velocity by less than the bound has at most a fraction of
        the bound, the coefficient of friction, from friction.
        """
        states = np.concatenate([self._states[:, None], trajectory], axis=1)
        changes = np.diff(states[:, :, self._velocities], axis=1)
        in_flight = accelerations[:, None] * self._mj_model.opt.timestep
        # What is not finite does not fly.
        flies = np.abs(changes - in_flight) < _NO_CONTACT
        return ~np.all(flies, axis=(1, 2, 3))

    def _step_one(self, episode: int, controls: np.ndarray, kind: mujoco.mjtState) -> np.ndarray:
        """An episode's state [size] after steps with friction and controls [steps, size]."""
        engine = self._engines[episode % len(self._engines)]
        data = self._data[0]
        state = self._states[episode].copy()
        mujoco.mj_resetData(engine.model, data)
        mujoco.mj_setState(engine.model, data, state, _FULL_PHYSICS)
        for control in controls:
            mujoco.mj_setState(engine.model, data, control, kind)
            engine.step(data)
        mujoco.mj_getState(engine.model, data, state, _FULL_PHYSICS)
        return state

    def _drag_accelerations(self, drag: np.ndarray) -> np.ndarray:
        """Accelerations [N, balls, 3] of the balls, m/s^2, from `Control.air_drag` [N]."""
        velocity = self._states[:, self._velocities]
        speed = np.linalg.norm(velocity, axis=2, keepdims=True)
        return -drag[:, None, None] * speed * velocity

    def _forces(self, accelerations: np.ndarray) -> np.ndarray:
        """Forces and torques [N, bodies, 6] that give the balls accelerations [N, balls, 3]."""
        forces = np.zeros((len(accelerations), self._mj_model.nbody, 6))
        forces[:, self._bodies, :3] = self._masses[:, :, None] * accelerations
        return forces


def episode_models(env: Env, parameters: PhysicsParameters) -> list[mujoco.MjModel]:
    """One model for all episodes, or one model per episode where parameters [..., N] are given.

    What diverges in them stays so, which ends the episode (`Env.finish_step`); by default, MuJoCo
    puts everything back to the model's own pose and goes on.
    """
    parameters = jax.tree.map(np.asarray, parameters)
    given = jax.tree.leaves(parameters)
    if not given:
        models = [copy.copy(env.mj_model)]
    else:
        # Without what only pictures need, of which N copies would be large.
        plain = world_model(env.config, visual=False)
        models = [
            edited_model(plain, jax.tree.map(lambda array, i=i: array[..., i], parameters))
            for i in range(given[0].shape[-1])
        ]
    for model in models:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return models


def full_states(mj_model: mujoco.MjModel, physics: PhysicsState) -> np.ndarray:
    """States [N, size] of MuJoCo's mjSTATE_FULLPHYSICS at time 0 from a `PhysicsState` [..., N]."""
    fresh = np.zeros(mujoco.mj_stateSize(mj_model, _FULL_PHYSICS))
    mujoco.mj_getState(mj_model, mujoco.MjData(mj_model), fresh, _FULL_PHYSICS)
    coordinates = np.concatenate(jax.tree.leaves(physics)).T
    states = np.tile(fresh, (len(coordinates), 1))
    # The order: time, positions, velocities (no engine carries activations), histories of sensors.
    states[:, 1 : 1 + coordinates.shape[1]] = coordinates
    return states


def physics_states(mj_model: mujoco.MjModel, states: np.ndarray) -> PhysicsState:
    """The `PhysicsState` [..., N], in float32, of states [N, size] of mjSTATE_FULLPHYSICS."""
    end = 1 + mj_model.nq + mj_model.nv
    coordinates = jnp.asarray(states[:, 1:end].T, jnp.float32)
    return PhysicsState(coordinates[: mj_model.nq], coordinates[mj_model.nq :])
