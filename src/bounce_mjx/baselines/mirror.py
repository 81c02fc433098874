"""The mirror law of a juggling arm, a model-based baseline for every robot.

The paddle mirrors the ball's height: it rises as the ball falls, as fast as the next impact needs
to send the ball to its target height (Buehler, Koditschek and Kindlmann, "Planning and control of
robotic juggling and catching tasks", IJRR 1994). It waits where the ball will land, with a tilt
that sends the ball back (Rizzi and Koditschek, "Further progress in robot juggling: solvable mirror
laws", ICRA 1994). The arm's inverse kinematics turn the paddle's pose into joint angles.

Like a policy, the law sees only the observation. It knows the nominal model.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.physics.parameters import MODEL_PARAMETERS
from bounce_mjx.robot.model import data_at, scatter, upper_face
from bounce_mjx.world.config import WorldConfig

# Restitution of the ball on the paddle.
_RESTITUTION = 0.85
# Share of the way back to its place that a ball makes in one flight.
_RETURN = 0.7
# Bounds of minus the ratio of the paddle's velocity to the ball's.
_MIRRORING = (-0.05, 0.18)
# Largest tilt of the paddle, rad, and its largest distance from its home, m.
_MAX_TILT = 0.2
_MAX_DISTANCE = 0.12
# Least squared speed of an impact, m^2/s^2, and least height of a flight, m.
_LEAST_SQUARED_SPEED = 0.3
_LEAST_HEIGHT = 0.05
# Iterations of the inverse kinematics with the Jacobian of the home pose.
_ITERATIONS = 4


class _Impact(NamedTuple):
    """The next impact of a ball that flies freely until then."""

    arriving: jax.Array
    """Speed downward with which it arrives [], m/s."""
    leaving: jax.Array
    """Speed upward with which it must leave to reach its target [], m/s."""
    offset: jax.Array
    """Where it arrives, from the place where the ball is to bounce [2], m."""


def observing(config: WorldConfig) -> WorldConfig:
    """A config whose observation has what the law needs, if the task has it."""
    counts = {}
    for name in _needs(config):
        if hasattr(config.observation, name):
            counts[name] = max(1, getattr(config.observation, name))
    observation = config.observation.model_copy(update=counts)
    return config.model_copy(update={"observation": observation})


def _needs(config: WorldConfig) -> tuple[str, ...]:
    """The quantities of the observation that the law reads."""
    needed = ("joint_angles", "ball_position", "ball_velocity", "target_height")
    if config.action.base == "target":
        return (*needed, "servo_lead")
    return needed


class MirrorLaw:
    """The mirror law for an environment whose task has the goal `target_height`."""

    def __init__(self, env: Env):
        """Linearises the kinematics at the home pose.

        Raises:
          UserError: the task has several balls or no target height, or the observation lacks what
            the law needs.
        """
        config = env.config
        needed = _needs(config)
        missing = [name for name in needed if name not in config.observation.counts()]
        if missing or config.num_balls > 1:
            raise UserError(
                f"the mirror law bounces one ball with {', '.join(needed)} in the "
                f"observation; the task {type(env.task).__name__} has {config.num_balls}, and "
                f"lacks {', '.join(missing) or 'nothing'}; give a policy"
            )
        model = env.mj_model
        addresses = env.addresses
        self._env = env
        self._arm = list(addresses.arm_qpos)
        self._home = np.array(config.default_joint_angles)
        self._gravity = model.opt.gravity.copy()
        normal, height = upper_face(model, addresses, self._home)
        # From the paddle's centre to that of a ball that touches it, m.
        self._contact_distance = float(height + model.geom_size[addresses.balls[0].geom, 0])
        # A point over the paddle's centre, whose direction is the paddle's normal.
        self._above = model.geom_pos[addresses.paddle_geom] + normal
        home_pose = self._pose(jnp.asarray(self._home))
        self._place = np.array([*config.ball_init_pos[:2], float(home_pose[2])])
        jacobian = jax.jacfwd(self._pose)(jnp.asarray(self._home))
        self._inverse_jacobian = np.linalg.pinv(jacobian)
        self._read_servos()

    def _read_servos(self) -> None:
        """How far a servo lags behind a target that moves, s, and sags under the arm's weight."""
        model = self._env.mj_model
        addresses = self._env.addresses
        servos = list(addresses.actuators)
        dofs = list(addresses.arm_qvel)
        squared_gear = model.actuator_gear[servos, 0] ** 2
        stiffness = squared_gear * model.actuator_gainprm[servos, 0]
        damping = model.dof_damping[dofs] - squared_gear * model.actuator_biasprm[servos, 2]
        self._lag = damping / stiffness
        data = data_at(model, addresses, self._home)
        mujoco.mj_forward(model, data)
        weight = data.qfrc_bias - data.qfrc_passive
        self._sag = weight[dofs] / stiffness

    def act(self, policy: None, observation: jax.Array) -> jax.Array:
        """Actions [..., A] for observations [..., N]; there are no parameters."""
        return jnp.vectorize(self._action, signature="(n)->(a)")(observation)

    def _action(self, observation: jax.Array) -> jax.Array:
        """The action [A] for an observation [N]: how far the servo targets move towards the joint
        angles at which the paddle mirrors the ball."""
        config = self._env.config
        layout = self._env.layout
        # The newest value of each quantity comes first.
        seen = {part.name: observation[layout[part.name]][: part.size] for part in layout.parts}
        ball = seen["ball_position"]
        velocity = seen["ball_velocity"]
        place = jnp.asarray(self._place)
        if "target_x" in seen:
            place = jnp.concatenate([seen["target_x"], seen["target_y"], place[2:]])

        def joint_angles(ball: jax.Array, velocity: jax.Array) -> jax.Array:
            return self._joint_angles(self._paddle(ball, velocity, place, seen["target_height"][0]))

        # Speeds of the joints: the ball moves with its velocity, which gravity changes.
        ball_motion = (velocity, jnp.asarray(self._gravity))
        angles, speeds = jax.jvp(joint_angles, (ball, velocity), ball_motion)
        # While the ball rises there is time; a sudden turn would disturb the last impact.
        speeds = jnp.where(velocity[2] < 0.0, speeds, 0.0)

        start = seen["joint_angles"]
        if "servo_lead" in seen:
            max_lead = config.action.max_lead
            start = start + jnp.clip(seen["servo_lead"], -max_lead, max_lead)
        change = angles + speeds * self._lag + self._sag - start
        max_acceleration = config.robot.limits.acceleration
        if max_acceleration is not None:
            # As fast as the joint can still stop at its target, which itself moves on in the step.
            stopping_speed = jnp.sqrt(np.array(max_acceleration) * jnp.abs(change))
            stopping = config.control_dt * stopping_speed
            change = jnp.clip(change, -stopping, stopping) + config.control_dt * speeds
        return jnp.clip(change / config.action_scale, -1.0, 1.0)

    def _paddle(
        self, ball: jax.Array, velocity: jax.Array, place: jax.Array, target: jax.Array
    ) -> jax.Array:
        """Position and tilt [5] of the paddle that mirrors a ball: its centre (m), and the x and y
        of its normal.

        Args:
          ball: its position [3], m.
          velocity: of the ball [3], m/s.
          place: where the ball bounces: the paddle's centre at an impact [3], m.
          target: height of the ball's apex [], m.
        """
        impact = self._next_impact(ball, velocity, place, target)
        mirroring = (impact.leaving / impact.arriving - _RESTITUTION) / (1.0 + _RESTITUTION)
        mirroring = jnp.clip(mirroring, *_MIRRORING)
        ball_height = ball[2] - (place[2] + self._contact_distance)
        height = place[2] - mirroring * jnp.maximum(ball_height, -self._contact_distance)
        centre = place[:2] + jnp.clip(impact.offset, -_MAX_DISTANCE, _MAX_DISTANCE)
        # The time of flight after the impact is 2 leaving / gravity.
        gravity = float(-self._gravity[2])
        wanted_velocity = -_RETURN * impact.offset * gravity / (2.0 * impact.leaving)
        tilt = (wanted_velocity - velocity[:2]) / (impact.leaving + impact.arriving)
        tilt = jnp.clip(tilt, -_MAX_TILT, _MAX_TILT)
        return jnp.concatenate([centre, height[None], tilt])

    def _next_impact(
        self, ball: jax.Array, velocity: jax.Array, place: jax.Array, target: jax.Array
    ) -> _Impact:
        """The next impact of a ball; the arguments are those of `_paddle`."""
        gravity = float(-self._gravity[2])
        contact_height = place[2] + self._contact_distance
        height = ball[2] - contact_height
        rise = jnp.maximum(target - contact_height, _LEAST_HEIGHT)
        leaving = jnp.sqrt(2.0 * gravity * rise)
        squared_speed = jnp.maximum(velocity[2] ** 2 + 2.0 * gravity * height, _LEAST_SQUARED_SPEED)
        # A ball that touches the paddle does not show its energy.
        arriving = jnp.where(height > 0.0, jnp.sqrt(squared_speed), leaving)
        time_of_flight = (velocity[2] + arriving) / gravity
        offset = ball[:2] + time_of_flight * velocity[:2] - place[:2]
        return _Impact(arriving, leaving, offset)

    def _pose(self, angles: jax.Array) -> jax.Array:
        """Forward kinematics [5] of joint angles [n], as `_paddle`."""
        paddle_position = self._env.engine.paddle_position
        qpos = scatter(self._env.mj_model.qpos0, self._arm, angles)
        centre = paddle_position(MODEL_PARAMETERS, qpos)
        above = MODEL_PARAMETERS._replace(paddle_position=jnp.asarray(self._above, angles.dtype))
        normal = paddle_position(above, qpos) - centre
        return jnp.concatenate([centre, normal[:2]])

    def _joint_angles(self, paddle: jax.Array) -> jax.Array:
        """Inverse kinematics: the joint angles [n] nearest to the home pose, rad, for a pose of
        `_paddle`."""
        home = tuple(jnp.asarray(angle, paddle.dtype) for angle in self._home)

        def improve(_: int, angles: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            error = paddle - self._pose(jnp.stack(angles))
            improved = []
            for angle, row in zip(angles, self._inverse_jacobian, strict=True):
                change = sum(float(share) * error[k] for k, share in enumerate(row))
                improved.append(angle + change)
            return tuple(improved)

        # One scalar per joint, and a loop that stays one: on a CPU, XLA would compute the whole
        # pose again for each entry of a sum over an axis, in each of the steps before it. XLA
        # aborts on a small product of matrices with the option of `training.setup.join_loops`.
        return jnp.stack(jax.lax.fori_loop(0, _ITERATIONS, improve, home))
