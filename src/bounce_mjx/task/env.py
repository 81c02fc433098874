"""`BounceBall`: the arm, the ball, and the task of bouncing it at a chosen height."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from bounce_mjx.errors import UserError
from bounce_mjx.physics import Engine, PhysicsParameters, PhysicsState, make_engine
from bounce_mjx.robot.model import (
    JOINT_NAMES,
    check_unedited,
    find_addresses,
    fingerprint,
    load_model,
    resting_activations,
)
from bounce_mjx.task.config import EnvConfig
from bounce_mjx.task.observation import OBSERVATION, Kinematics
from bounce_mjx.task.rewards import (
    TERM_NAMES,
    RewardInputs,
    horizontal_distance,
    weighted_terms,
)
from bounce_mjx.task.state import State

# MuJoCo's mjMAXVAL: a coordinate beyond it has diverged and counts as non-finite.
_MAX_COORDINATE = 1e10


class TaskState(NamedTuple):
    """State of an episode besides the physics."""

    target_height: jax.Array
    """Target height of the bounces [], m."""
    last_action: jax.Array
    """Clipped action of the last step [6]."""
    rising: jax.Array
    """Whether the ball moved upward after the last step [], bool."""
    n_bounces: jax.Array
    """Consecutive bounces [], float."""
    apex: jax.Array
    """Highest ball position since the last bounce [], m."""


class BounceState(NamedTuple):
    """The whole state of one environment, `State.pipeline_state`."""

    physics: PhysicsState
    task: TaskState
    parameters: PhysicsParameters = PhysicsParameters()
    """The world of this environment; drawn at its reset."""


class BounceBall:
    """One environment, unbatched and pure: use `jax.vmap` and `jax.jit` on `reset` and `step`.

    It has the interface of brax's `Env` by structure. `done` is 1 where the episode terminated;
    the time limit belongs to the training wrapper.
    """

    def __init__(
        self,
        config: EnvConfig | None = None,
        randomize: Callable[[jax.Array], PhysicsParameters] | None = None,
    ):
        """Compiles the model and chooses the physics engine.

        Args:
          randomize: a key -> the world of one episode, drawn at each reset; None for the model's
            own world.

        Raises:
          UserError: the MJCF file or the engine does not fit the task.
        """
        self.config = config or EnvConfig()
        self.mj_model: mujoco.MjModel = load_model(self.config.mjcf, self.config.physics_dt)
        self.engine: Engine = make_engine(self.mj_model, self.config.physics)
        self._addresses = find_addresses(self.mj_model)
        self._randomize = randomize
        self._fingerprint = fingerprint(self.mj_model)

    @property
    def dt(self) -> float:
        """Time of one control step, s."""
        return self.config.control_dt

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""
        return OBSERVATION.size

    @property
    def action_size(self) -> int:
        """Length of the action vector."""
        return len(JOINT_NAMES)

    @property
    def backend(self) -> str:
        """Name of the physics engine."""
        return self.engine.name

    @property
    def unwrapped(self) -> "BounceBall":
        """The environment itself, as there is no wrapper around it."""
        return self

    @property
    def sys(self) -> None:
        """brax's system, which its domain randomisation edits; there is none here.

        Raises:
          UserError: always.
        """
        raise UserError(
            "brax's randomization_fn changes brax's own physics, which this environment does not "
            "use, so it would have no effect; give BounceBall a function randomize instead"
        )

    def reset(self, rng: jax.Array) -> State:
        """Starts an episode; consumes the key `rng`."""
        check_unedited(self.mj_model, self._fingerprint)
        config, addresses = self.config, self._addresses
        parameters = PhysicsParameters()
        if self._randomize is not None:
            rng, world_rng = jax.random.split(rng)
            parameters = self._randomize(world_rng)
        # One draw for all: the keys of separate draws would cost more than the numbers.
        noise = jax.random.uniform(rng, (16,), minval=-1.0, maxval=1.0)
        zero = jnp.zeros((), noise.dtype)
        low, high = config.target_height_range

        qpos = [jnp.asarray(q, noise.dtype) for q in self.mj_model.qpos0]
        qvel = [zero] * self.mj_model.nv
        for i, angle in enumerate(config.default_joint_angles):
            qpos[addresses.arm_qpos[i]] = angle + config.joint_angle_noise * noise[i]
            qvel[addresses.arm_qvel[i]] = config.joint_velocity_noise * noise[6 + i]
        for i, coordinate in enumerate(config.ball_init_pos):
            qpos[addresses.ball_qpos[i]] = coordinate + config.ball_position_noise * noise[12 + i]
        for i, component in enumerate((1.0, 0.0, 0.0, 0.0)):
            qpos[addresses.ball_qpos[3 + i]] = jnp.asarray(component, noise.dtype)
        physics = PhysicsState(
            jnp.stack(qpos), jnp.stack(qvel), resting_activations(self.mj_model, qpos)
        )

        task = TaskState(
            target_height=low + (high - low) * 0.5 * (noise[15] + 1.0),
            last_action=jnp.zeros(self.action_size, noise.dtype),
            rising=jnp.zeros((), bool),
            n_bounces=zero,
            apex=physics.qpos[addresses.ball_qpos[2]],
        )
        metrics = {f"reward/{name}": zero for name in TERM_NAMES}
        metrics |= dict.fromkeys(
            ("bounced", "n_bounces", "ball_xy_error", "apex_error", "non_finite"), zero
        )
        state = BounceState(physics, task, parameters)
        return State(
            pipeline_state=state,
            obs=self.observe(self.kinematics(state), task),
            reward=zero,
            done=zero,
            metrics=metrics,
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step under the action [6], clipped to [-1, 1]."""
        check_unedited(self.mj_model, self._fingerprint)
        action = jnp.clip(action, -1.0, 1.0)
        before = state.pipeline_state
        targets = self.servo_targets(before.physics, action)
        physics = self.engine.step(
            before.parameters, before.physics, targets, self.config.num_substeps
        )
        return self.finish_step(state, action, physics)

    def servo_targets(self, physics: PhysicsState, action: jax.Array) -> jax.Array:
        """Servo targets ctrl [nu] of a clipped action [6]: the measured joint angles plus the
        scaled action (rad), clipped to the range of each joint that has one, times the gear."""
        model, addresses = self.mj_model, self._addresses
        targets = [jnp.zeros_like(action[0])] * model.nu
        # One scalar a joint, which XLA fuses with the physics; an indexed update would not be.
        for i, actuator in enumerate(addresses.actuators):
            target = physics.qpos[addresses.arm_qpos[i]] + self.config.action_scale * action[i]
            low, high = (float(limit) for limit in model.jnt_range[addresses.arm_joints[i]])
            if low < high:
                target = jnp.clip(target, low, high)
            gear = float(model.actuator_gear[actuator, 0])
            targets[actuator] = target if gear == 1.0 else gear * target
        return jnp.stack(targets)

    def finish_step(self, state: State, action: jax.Array, physics: PhysicsState) -> State:
        """The task's part of a step: bounces, reward, end and observation.

        A non-finite physics state ends the episode and is replaced by the previous one, so that
        nothing non-finite leaves the environment.

        Args:
          state: before the step.
          action: clipped [6].
          physics: after the step, from any engine.
        """
        config = self.config
        before = state.pipeline_state
        finite = jnp.array(True)
        for coordinates in jax.tree.leaves(physics):
            finite &= jnp.all(jnp.abs(coordinates) < _MAX_COORDINATE)
        # The previous state is checked too, in case the memory was damaged.
        physics = jax.tree.map(
            lambda new, old: jnp.where(
                finite, new, jnp.where(jnp.abs(old) < _MAX_COORDINATE, old, 0.0)
            ),
            physics,
            before.physics,
        )
        action = jnp.where(finite, action, before.task.last_action)

        kinematics = self.kinematics(before._replace(physics=physics))
        ball = kinematics.ball_position

        task, bounced = update_task(
            config,
            before.task,
            ball,
            kinematics.ball_velocity,
            kinematics.paddle_position,
            action,
        )
        terms = weighted_terms(
            config.reward,
            RewardInputs(
                ball_position=ball,
                ball_velocity=kinematics.ball_velocity,
                paddle_position=kinematics.paddle_position,
                target_height=task.target_height,
                n_bounces=task.n_bounces,
                bounced=bounced,
                action=action,
                last_action=before.task.last_action,
                joint_velocity=kinematics.joint_velocities,
            ),
        )
        ended = ~finite | terminated(config, ball, kinematics.joint_velocities, task.target_height)
        target = (config.reward.target_x, config.reward.target_y)
        apex_error = jnp.abs(before.task.apex - task.target_height)

        dtype = ball.dtype
        metrics = {f"reward/{name}": value for name, value in terms.items()}
        metrics |= {
            "bounced": bounced.astype(dtype),
            "n_bounces": task.n_bounces,
            "ball_xy_error": horizontal_distance(ball, target),
            "apex_error": jnp.where(bounced, apex_error, 0.0),
            "non_finite": (~finite).astype(dtype),
        }
        return state.replace(
            pipeline_state=before._replace(physics=physics, task=task),
            obs=self.observe(kinematics, task),
            reward=sum(terms.values()),
            done=ended.astype(dtype),
            # Wrappers add metrics of their own, which a step must keep.
            metrics=state.metrics | metrics,
        )

    def kinematics(self, state: BounceState) -> Kinematics:
        """True positions and velocities of one environment's state, read from its physics."""
        addresses, (qpos, qvel) = self._addresses, (state.physics.qpos, state.physics.qvel)
        return Kinematics(
            joint_angles=jnp.stack([qpos[i] for i in addresses.arm_qpos]),
            ball_position=jnp.stack([qpos[i] for i in addresses.ball_qpos[:3]]),
            ball_quaternion=jnp.stack([qpos[i] for i in addresses.ball_qpos[3:]]),
            joint_velocities=jnp.stack([qvel[i] for i in addresses.arm_qvel]),
            ball_velocity=jnp.stack([qvel[i] for i in addresses.ball_qvel[:3]]),
            ball_angular_velocity=jnp.stack([qvel[i] for i in addresses.ball_qvel[3:]]),
            paddle_position=self.engine.paddle_position(state.parameters, qpos),
        )

    def observe(self, kinematics: Kinematics, task: TaskState) -> jax.Array:
        """The observation [29], laid out as `OBSERVATION`; sensor noise would go here."""
        return OBSERVATION.pack(kinematics._asdict() | {"target_height": task.target_height[None]})


def update_task(
    config: EnvConfig,
    task: TaskState,
    ball: jax.Array,
    ball_velocity: jax.Array,
    paddle: jax.Array,
    action: jax.Array,
) -> tuple[TaskState, jax.Array]:
    """Detects a bounce and counts it.

    A bounce is the first step on which the ball rises, near the paddle. It adds to the count if
    the apex before it was above the target height minus the tolerance; otherwise the count restarts
    at 1, which is also the count after the first bounce of an episode.

    Args:
      ball, ball_velocity, paddle: positions [3] (m) and velocity [3] (m/s) after the step.
      action: clipped action [6] of the step.

    Returns:
      The new task state, and whether this step is a bounce [] (bool).
    """
    rising = ball_velocity[2] > config.bounce_min_velocity
    near = jnp.abs(ball[2] - paddle[2]) < config.bounce_max_distance
    bounced = rising & ~task.rising & near
    continues = task.apex > task.target_height - config.apex_tolerance
    counted = jnp.where(continues, task.n_bounces + 1.0, 1.0)
    updated = TaskState(
        target_height=task.target_height,
        last_action=action,
        rising=rising,
        n_bounces=jnp.where(bounced, counted, task.n_bounces),
        apex=jnp.where(bounced, ball[2], jnp.maximum(task.apex, ball[2])),
    )
    return updated, bounced


def terminated(
    config: EnvConfig, ball: jax.Array, joint_velocity: jax.Array, target_height: jax.Array
) -> jax.Array:
    """Whether the episode ends [] (bool): the ball fell, flew too high or too far, or a joint is
    too fast. Units m and rad/s."""
    fell = ball[2] < config.min_ball_height
    too_high = ball[2] > target_height + config.max_height_above_target
    too_far = jnp.any(jnp.abs(ball[:2]) > config.max_horizontal_distance)
    too_fast = jnp.any(jnp.abs(joint_velocity) > config.max_joint_velocity)
    return fell | too_high | too_far | too_fast
