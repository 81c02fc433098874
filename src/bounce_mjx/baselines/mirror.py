"""The mirror law of a juggling arm, a model-based baseline for every robot.

The paddle mirrors the ball's height: it rises as the ball falls, as fast as the next impact needs
to send the ball to its target height (Buehler, Koditschek and Kindlmann, "Planning and control of
robotic juggling and catching tasks", IJRR 1994). It waits where the ball will land, with a tilt
that sends the ball back (Rizzi and Koditschek, "Further progress in robot juggling: solvable mirror
laws", ICRA 1994). The arm's inverse kinematics turn the paddle's pose into joint angles.

Like a policy, the law sees only the observation. It knows the nominal model.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.physics.parameters import MODEL_PARAMETERS
from bounce_mjx.robot.geometry import upper_face
from bounce_mjx.robot.model import data_at, scatter
from bounce_mjx.world.config import WorldConfig

# Restitution of the ball on the paddle.
_RESTITUTION = 0.85
# Share of the way back to its place that a ball makes in one flight.
_RETURN = 0.7
# Bounds of the paddle's velocity over the ball's, and of its tilt (rad) and its distance from its
# home (m).
_MIRRORING, _MAX_TILT, _MAX_DISTANCE = (-0.05, 0.18), 0.2, 0.12
# Lowest square of the speed of an impact, m^2/s^2, and lowest height of a flight, m.
_LEAST_SQUARE, _LEAST_HEIGHT = 0.3, 0.05
# Iterations of the inverse kinematics with the Jacobian of the home pose.
_ITERATIONS = 4


def observing(config: WorldConfig) -> WorldConfig:
    """A config whose observation has what the law needs, if the task has it."""
    seen, names = config.observation, _needs(config)
    counts = {name: max(1, getattr(seen, name)) for name in names if hasattr(seen, name)}
    return config.model_copy(update={"observation": seen.model_copy(update=counts)})


def _needs(config: WorldConfig) -> tuple[str, ...]:
    adds_to_targets = ("servo_lead",) * (config.action.base == "target")
    return "joint_angles", "ball_position", "ball_velocity", "target_height", *adds_to_targets


class MirrorLaw:
    """The mirror law for an environment whose task commands a `target_height`."""

    def __init__(self, env: Env):
        """Linearises the kinematics at the home pose.

        Raises:
          UserError: the task has several balls or no target height, or the observation lacks what
            the law needs.
        """
        config, model = env.config, env.mj_model
        missing = [name for name in _needs(config) if name not in config.observation.lengths()]
        if missing or config.num_balls > 1:
            raise UserError(
                f"the mirror law bounces one ball with {', '.join(_needs(config))} in the "
                f"observation; the task {type(env.task).__name__} has {config.num_balls}, and "
                f"lacks {', '.join(missing) or 'nothing'}; give a policy"
            )
        self._env, at = env, env.addresses
        self._arm, self._servos = list(at.arm_qpos), list(at.actuators)
        self._home = np.array(config.default_joint_angles)
        normal, height = upper_face(model, self._home)
        self._above = model.geom_pos[at.paddle_geom] + normal
        home = self._pose(jnp.asarray(self._home))
        self._inverse = np.linalg.pinv(jax.jacfwd(self._pose)(jnp.asarray(self._home)))
        self._place = np.array([*config.ball_init_pos[:2], float(home[2])])
        self._gravity = model.opt.gravity.copy()
        # From the paddle's centre to that of a ball that touches it, m.
        self._contact_distance = float(height + model.geom_size[at.balls[0].geom, 0])
        self._read_servos(model, list(at.arm_qvel))

    def _read_servos(self, model: mujoco.MjModel, dofs: list[int]) -> None:
        """How far a servo lags behind a target that moves, s, and sags under the arm's weight."""
        gear = model.actuator_gear[self._servos, 0] ** 2
        stiffness = gear * model.actuator_gainprm[self._servos, 0]
        damping = model.dof_damping[dofs] - gear * model.actuator_biasprm[self._servos, 2]
        self._lag = damping / stiffness
        data = data_at(model, self._home)
        mujoco.mj_forward(model, data)
        self._sag = (data.qfrc_bias - data.qfrc_passive)[dofs] / stiffness

    def act(self, policy: None, observation: jax.Array) -> jax.Array:
        """Actions [..., A] for observations [..., N]; there are no parameters."""
        return jnp.vectorize(self._action, signature="(n)->(a)")(observation)

    def _action(self, observation: jax.Array) -> jax.Array:
        config, layout = self._env.config, self._env.layout
        # The newest value of each quantity comes first.
        seen = {part.name: observation[layout[part.name]][: part.size] for part in layout.parts}
        ball, velocity = seen["ball_position"], seen["ball_velocity"]
        place = jnp.asarray(self._place)
        if "target_x" in seen:
            place = jnp.concatenate([seen["target_x"], seen["target_y"], place[2:]])

        def joints(ball: jax.Array, velocity: jax.Array) -> jax.Array:
            return self._joints(self._paddle(ball, velocity, place, seen["target_height"][0]))

        fall = velocity, jnp.asarray(self._gravity)
        angles, speeds = jax.jvp(joints, (ball, velocity), fall)
        # While the ball rises there is time; a sudden turn would disturb the impact that ends.
        speeds = jnp.where(velocity[2] < 0.0, speeds, 0.0)
        start, limits = seen["joint_angles"], config.robot.limits.acceleration
        if "servo_lead" in seen:
            lead = config.action.max_lead
            start = start + jnp.clip(seen["servo_lead"], -lead, lead)
        change = angles + speeds * self._lag + self._sag - start
        if limits is not None:
            # As fast as the joint can still stop at its target.
            stopping = config.control_dt * jnp.sqrt(np.array(limits) * jnp.abs(change))
            change = jnp.clip(change, -stopping, stopping) + config.control_dt * speeds
        return jnp.clip(change / config.action_scale, -1.0, 1.0)

    def _paddle(
        self, ball: jax.Array, velocity: jax.Array, place: jax.Array, target: jax.Array
    ) -> jax.Array:
        """Position and tilt [5] of the paddle that mirrors a ball: its centre (m), and the x and y
        of its normal.

        Args:
          place: where the ball bounces: the paddle's centre at an impact [3], m.
          target: height of the ball's apex [], m.
        """
        gravity, contact = float(-self._gravity[2]), place[2] + self._contact_distance
        height = ball[2] - contact
        leaving = jnp.sqrt(2.0 * gravity * jnp.maximum(target - contact, _LEAST_HEIGHT))
        square = jnp.maximum(velocity[2] ** 2 + 2.0 * gravity * height, _LEAST_SQUARE)
        # A ball that touches the paddle does not show its energy.
        arriving = jnp.where(height > 0.0, jnp.sqrt(square), leaving)
        mirroring = (leaving / arriving - _RESTITUTION) / (1.0 + _RESTITUTION)
        mirroring = jnp.clip(mirroring, *_MIRRORING)
        flight = (velocity[2] + arriving) / gravity
        offset = ball[:2] + flight * velocity[:2] - place[:2]
        wanted = -_RETURN * offset * gravity / (2.0 * leaving)
        tilt = jnp.clip((wanted - velocity[:2]) / (leaving + arriving), -_MAX_TILT, _MAX_TILT)
        centre = place[:2] + jnp.clip(offset, -_MAX_DISTANCE, _MAX_DISTANCE)
        lift = place[2] - mirroring * jnp.maximum(height, -self._contact_distance)
        return jnp.concatenate([centre, lift[None], tilt])

    def _pose(self, angles: jax.Array) -> jax.Array:
        """Forward kinematics [5] of joint angles [n], as `_paddle`."""
        paddle_position = self._env.engine.paddle_position
        qpos = scatter(self._env.mj_model.qpos0, self._arm, angles)
        above = MODEL_PARAMETERS._replace(paddle_position=jnp.asarray(self._above, angles.dtype))
        centre = paddle_position(MODEL_PARAMETERS, qpos)
        return jnp.concatenate([centre, (paddle_position(above, qpos) - centre)[:2]])

    def _joints(self, paddle: jax.Array) -> jax.Array:
        """Inverse kinematics: the joint angles [n] nearest to the home pose, rad."""
        home = tuple(jnp.asarray(angle, paddle.dtype) for angle in self._home)

        def improve(_: int, angles: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            missing = paddle - self._pose(jnp.stack(angles))
            return tuple(
                angle + sum(float(share) * missing[k] for k, share in enumerate(row))
                for angle, row in zip(angles, self._inverse, strict=True)
            )

        # One scalar per joint, and a loop that stays one: on a CPU, XLA would compute the whole
        # pose again for each entry of a sum over an axis, in each of the steps before it. XLA
        # aborts on a small product of matrices with its option of `join_loops`.
        return jnp.stack(jax.lax.fori_loop(0, _ITERATIONS, improve, home))
