"""An arm on MuJoCo's C engine, with the delays, the noise and the errors of one world, behind the
interface of a driver (`deploy.session.Arm`)."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.physics import CEngine, edited_model
from bounce_mjx.rehearsal.camera import Camera
from bounce_mjx.rehearsal.faults import Injection, Moment
from bounce_mjx.robot.model import balls_above, find_addresses, joint_names, joint_ranges
from bounce_mjx.world.actuation import DEFAULT_PUSH_INTERVAL
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import world_model
from bounce_mjx.world.randomization import TERMS
from bounce_mjx.world.sampling import nominal_values, physics_parameters, sample_world

_MOST_COMMANDS = 5
"""Commands in a control step, at most: 500 Hz at 10 ms."""
# Farthest that the arm rests from its home when a rehearsal begins, rad.
_AWAY = 0.05
# Vertical speed with which a ball bounces, and does not rest, m/s.
_BOUNCES = 0.1
# Where the balls are if nobody has one, m.
_PUT_AWAY = (0.0, 0.0, 20.0)
# Times are sums of physics steps, which rounding makes a little too small, s.
_ROUNDING = 1e-9


def sampled(config: WorldConfig, seed: int = 0) -> dict[str, np.ndarray]:
    """A world of a config's randomisation, as an episode of the training has it: the value of each
    of its terms."""
    model = world_model(config, visual=False)
    randomization = config.randomization
    nominals = nominal_values(model, randomization.terms)
    world = sample_world(
        randomization.ranges(1.0, nominals),
        jax.random.key(seed),
        jnp.result_type(float),
        config.num_joints,
        nominals,
        randomization.share,
        randomization.shares or {},
    )
    return {name: np.asarray(value, float) for name, value in world.items()}


def middle(config: WorldConfig) -> dict[str, np.ndarray]:
    """The world in the middle of a config's randomisation: the value of each of its terms."""
    world = {}
    for name, (low, high) in config.randomization.ranges(1.0).items():
        value = 0.5 * (np.asarray(low, float) + np.asarray(high, float))
        world[name] = np.broadcast_to(value, TERMS[name].shape(config.num_joints))
    return world


def in_words(world: Mapping[str, np.ndarray]) -> str:
    """The delays and the camera of a world, in words."""
    words = []
    for name in ("action_latency", "servo_lag", "ball_latency"):
        if name in world:
            words.append(f"{name} {1e3 * float(world[name]):.0f} ms")
    if "camera_rate" in world:
        words.append(f"camera_rate {float(world['camera_rate']):.0f} Hz")
    others = len(world) - len(words)
    if others:
        more = "more " if words else ""
        words.append(f"{others} {more}term{'s' if others > 1 else ''}")
    return ", ".join(words) or "without delays or noise"


def rate_of(config: WorldConfig) -> float:
    """The commands a second of a simulated arm, Hz: at most five in a control step, each of whole
    physics steps."""
    fitting = [m for m in range(1, _MOST_COMMANDS + 1) if config.num_substeps % m == 0]
    return fitting[-1] / config.control_dt


class Moved(NamedTuple):
    """The arm after a period, for a film."""

    time: float
    """s."""
    qpos: np.ndarray
    """Generalised positions [nq]."""


class SimulatedArm:
    """An arm with a paddle, its balls, its encoders and a camera. Somebody holds the balls at their
    start (`is_held`) until they let go."""

    def __init__(
        self,
        config: WorldConfig,
        world: Mapping[str, Any],
        seed: int = 0,
        rate: float | None = None,
        injection: Injection | None = None,
        model: mujoco.MjModel | None = None,
        camera: Any = None,
    ):
        """The arm at rest near its start pose.

        Args:
          config: of the arm, its ball and its task.
          world: value of each term of the randomisation that is not nominal, such as `sampled`.
          seed: of the noise, of where the arm rests first, and of the throws.
          rate: of the commands, Hz; by default `rate_of`.
          injection: a fault that comes in the first episode; None for none.
          model: in place of the config's, such as one with textures.
          camera: in place of that of the world: `look(data)` after each physics step, and
            `measure(time)`.
        """
        self.config = config
        self.world = dict(world)
        self.rate = rate or rate_of(config)
        self.random = np.random.default_rng(seed)
        own = world_model(config, visual=False) if model is None else model
        physical = {name: jnp.asarray(value) for name, value in self.world.items()}
        self.engine = CEngine(edited_model(own, physics_parameters(physical, own)))
        self.model = self.engine.model
        self.data = mujoco.MjData(self.model)
        addresses = find_addresses(self.model)
        self.joint_names = joint_names(self.model)
        self.qpos = list(addresses.arm_qpos)
        self.qvel = list(addresses.arm_qvel)
        self.servos = list(addresses.actuators)
        self.gears = self.model.actuator_gear[self.servos, 0]
        self.paddle_geom = addresses.paddle_geom
        self.balls = addresses.balls
        self._task = config.task(config)
        differences = config.observation.velocity == "differences"
        if camera is None:
            camera = Camera(self.balls, self.world, differences, self.random)
        self.camera = camera
        self.home = np.array(config.default_joint_angles)
        self.is_dead = np.zeros(len(self.home), bool)
        """Whether each servo has no torque [J]."""
        self.stuck: dict[int, float] = {}
        """Angle at which each joint that is stuck stays, rad."""
        self.is_deaf = False
        """Whether the arm ignores its commands."""
        self.command_delay = float(self.world.get("action_latency", 0.0))
        """From a command to the servos, s."""
        self.started: float | None = None
        """Time at which the first episode started, s."""
        self.is_held = True
        """Whether somebody holds the balls."""
        self.bounces: list[float] = []
        """Times at which the first ball turned from falling to rising, s."""
        self._falls = False
        self.path: list[Moved] = []
        """After each period."""
        self._injection = injection
        self._first: dict[str, Any] = {}
        self._sent: deque[tuple[float, np.ndarray]] = deque()
        self._next_push = self.random.uniform() * self._push_interval
        self._rest()

    def _rest(self) -> None:
        low, high = joint_ranges(self.model, find_addresses(self.model))
        away = _AWAY * self.random.uniform(-1.0, 1.0, len(self.home))
        self.command = np.clip(self.home + away, low, high)
        """The last command that reached the servos [J], rad."""
        self._filtered = self.command.copy()
        self.data.qpos[self.qpos] = self._true(self.command)
        self._throw()
        self.hold()
        mujoco.mj_forward(self.model, self.data)
        self.camera.look(self.data)

    def _true(self, targets: np.ndarray) -> np.ndarray:
        """Where servos hold the joints that the encoders show at targets [J], rad."""
        offset = self.world.get("servo_offset", 0.0) - self.world.get("encoder_bias", 0.0)
        return targets + offset

    @property
    def _push_interval(self) -> float:
        return float(self.world.get("push_interval", DEFAULT_PUSH_INTERVAL))

    @property
    def angles(self) -> np.ndarray:
        """The true joint angles [J], rad."""
        return self.data.qpos[self.qpos].copy()

    @property
    def paddle(self) -> np.ndarray:
        """The paddle's centre [3], m."""
        return self.data.geom_xpos[self.paddle_geom].copy()

    @property
    def picture_time(self) -> float:
        """Time at which the newest picture that has arrived was taken, s."""
        return self.camera.newest.taken

    @property
    def picture_noise(self) -> float:
        """Standard deviation of a ball's position in a picture, m."""
        return float(self.world.get("ball_position_noise", 0.0))

    def targets(self) -> np.ndarray:
        """As `Arm.targets`."""
        return self.command.copy()

    def measure(self) -> dict[str, Any]:
        """As `Arm.measure`, with what a fault makes of it."""
        measured = self.read()
        self._inject(measured)
        return measured

    def read(self) -> dict[str, Any]:
        """What the sensors show, without a fault."""
        world = self.world
        count = len(self.home)
        angle_noise, velocity_noise = self.random.standard_normal((2, count))
        velocities = self.data.qvel[self.qvel] + world.get("joint_velocity_bias", 0.0)
        angles = self.angles + world.get("encoder_bias", 0.0)
        return {
            "joint_angles": angles + world.get("joint_angle_noise", 0.0) * angle_noise,
            "joint_velocities": velocities
            + world.get("joint_velocity_noise", 0.0) * velocity_noise,
            "time": self.data.time,
            **self.camera.measure(self.data.time),
        }

    def _inject(self, measured: dict[str, Any]) -> None:
        """Lets the fault change what is measured, and the arm, once it has come."""
        if self._injection is None or self.started is None:
            return
        # A sum of many time steps is a little beside the time that it means.
        since = round(self.data.time - self.started - self._injection.after, 9)
        if since < 0.0:
            return
        if not self._first:
            self._first = {name: np.copy(value) for name, value in measured.items()}
        self._injection.act(Moment(self, measured, self._first, since))

    def send(self, commands: np.ndarray) -> None:
        """As `Arm.send`: simulates the periods."""
        if len(commands) == 0:
            self.idle(1.0 / self.rate)
        for command in commands:
            if not self.is_deaf:
                self._sent.append((self.data.time + self.command_delay, np.array(command)))
            self.idle(1.0 / self.rate)

    def idle(self, seconds: float) -> None:
        """Simulates a time in which nothing is sent, so that the last command holds."""
        for _ in range(round(seconds / self.model.opt.timestep)):
            self._step()
        self.path.append(Moved(self.data.time, self.data.qpos.copy()))

    def stop(self) -> None:
        """As `Arm.stop`; nothing is sent by itself."""

    def bounces_in(self, start: float, seconds: float) -> int:
        """Number of bounces from a time on (s), for a time (s)."""
        return sum(start <= time <= start + seconds for time in self.bounces)

    def put_balls_away(self) -> None:
        """Leaves the arm alone, for a motion."""
        self._places = np.array(_PUT_AWAY) + np.arange(len(self.balls))[:, None]
        self.started = self.data.time
        self.hold()

    def hold(self) -> None:
        """Puts the balls at their start."""
        for ball, place in zip(self.balls, self._places, strict=True):
            self.data.qpos[list(ball.qpos)] = [*place, 1.0, 0.0, 0.0, 0.0]
            self.data.qvel[list(ball.qvel)] = 0.0

    def _throw(self) -> None:
        """Draws where the balls are let go, and how fast."""
        config = self.config
        shape = (len(self.balls), 3)
        noise = config.reset.ball_position * self.random.uniform(-1.0, 1.0, shape)
        draws = jnp.asarray(self.random.uniform(size=self._task.num_draws))
        goals = {}
        for name, goal in config.goals.items():
            goals[name] = jnp.asarray(0.5 * (goal.low + goal.high))
        thrown = self._task.throw(draws, goals)
        if thrown is None:
            thrown = balls_above(config.ball_init_pos, len(self.balls)), np.zeros(shape)
        places, velocities = (np.asarray(x, float).reshape(shape) for x in thrown)
        self._places = places + noise + self.world.get("ball_start", 0.0)
        self._velocities = velocities

    def let_go(self) -> None:
        """Lets the balls go, as the task throws them."""
        self.is_held = False
        for ball, velocity in zip(self.balls, self._velocities, strict=True):
            self.data.qvel[list(ball.qvel[:3])] = velocity
        if self.started is None:
            self.started = self.data.time
        self._throw()

    def _step(self) -> None:
        """A physics step."""
        data = self.data
        dt = self.model.opt.timestep
        while self._sent and self._sent[0][0] <= data.time + _ROUNDING:
            self.command = self._sent.popleft()[1]
        lag = float(self.world.get("servo_lag", 0.0))
        share = 1.0 if lag < dt * 1e-3 else -np.expm1(-dt / lag)
        self._filtered += share * (self.command - self._filtered)
        target = np.where(self.is_dead, self.angles, self._true(self._filtered))
        data.ctrl[self.servos] = self.gears * target
        self._push()
        self._drag()
        if self.is_held:
            self.hold()
        self.engine.step(data)
        for joint, angle in self.stuck.items():
            data.qpos[self.qpos[joint]] = angle
            data.qvel[self.qvel[joint]] = 0.0
        self._count_bounce(data.qvel[self.balls[0].qvel[2]])
        self.camera.look(data)

    def _count_bounce(self, velocity: float) -> None:
        """Looks at the first ball's vertical velocity, m/s; one that rests does not bounce."""
        if self._falls and velocity > _BOUNCES:
            self.bounces.append(self.data.time)
            self._falls = False
        elif velocity < -_BOUNCES:
            self._falls = not self.is_held

    def _push(self) -> None:
        """Pushes each ball aside when a push is due."""
        speed = self.world.get("push_speed")
        if speed is None or self.data.time < self._next_push:
            return
        self._next_push += self._push_interval
        for ball in self.balls:
            angle = self.random.uniform(0.0, 2.0 * np.pi)
            push = speed * np.array([np.cos(angle), np.sin(angle)])
            self.data.qvel[list(ball.qvel[:2])] += push

    def _drag(self) -> None:
        """The air's force on each ball."""
        drag = self.world.get("air_drag")
        if drag is None:
            return
        for ball in self.balls:
            velocity = self.data.qvel[list(ball.qvel[:3])]
            mass = self.model.body_mass[ball.body]
            self.data.xfrc_applied[ball.body, :3] = (
                -drag * mass * np.linalg.norm(velocity) * velocity
            )


def goals_in_turn(
    config: WorldConfig, given: Mapping[str, Sequence[float]], seconds: float = 3.0
) -> Callable[[float], dict[str, float]]:
    """What a task asks for over time: the values that are given, one after another, or the middle,
    the upper end and the lower end of the range, each for a time (s)."""
    turns: dict[str, Sequence[float]] = {}
    for name, goal in config.goals.items():
        ends = (0.5 * (goal.low + goal.high), goal.high, goal.low)
        turns[name] = given.get(name) or ends

    def goals(time: float) -> dict[str, float]:
        turn = int(time / seconds + _ROUNDING)
        return {name: float(values[turn % len(values)]) for name, values in turns.items()}

    return goals
