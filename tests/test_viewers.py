"""The viewers: the simulated frames, the model's geometry, the clock, the recordings."""

import contextlib
import io
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import imageio_ffmpeg
import jax
import jax.numpy as jnp
import msgspec
import mujoco
import numpy as np
import pytest
import viser
import zstandard
from rich.console import Console
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from bounce_mjx import BounceBall, EnvConfig, task
from bounce_mjx.baselines.mirror import MirrorLaw
from bounce_mjx.commands import play, train, view
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.results import Report, Result
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.folders import latest_checkpoint, pretrained_checkpoint
from bounce_mjx.runs.reading import read_policy
from bounce_mjx.task import term_names
from bounce_mjx.tasks.bounce_rewards import BounceReward
from bounce_mjx.viewers import browser, native, offscreen, show
from bounce_mjx.viewers.browser import LivePage, reward_bars
from bounce_mjx.viewers.controls import direction
from bounce_mjx.viewers.display import Display, _primitive, body_scenes, marker_body
from bounce_mjx.viewers.guard import open_server
from bounce_mjx.viewers.offscreen import choose_backend
from bounce_mjx.viewers.options import PageStart, ViewerOptions
from bounce_mjx.viewers.page import write_page
from bounce_mjx.viewers.scene import Scene, camera_pose
from bounce_mjx.viewers.scene import _grid as scene_grid
from bounce_mjx.viewers.simulation import (
    EnvFrame,
    SideBySide,
    Simulation,
    at_index,
    frame_at,
    in_real_time,
    make_policy_controller,
    make_random_controller,
    make_zero_controller,
    resample,
)
from bounce_mjx.viewers.video import VideoWriter, find_ffmpeg
from bounce_mjx.viewers.watch import TrainingPage, _Panel, results_list
from bounce_mjx.viewers.world import SLIDERS, reset_ranges, sliders_for, with_sliders
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import RandomizationConfig
from tiny_runs import TINY

GRAVITY = 9.81
HUGE, NAN, INFINITY = 20_000_000, float("nan"), float("inf")
SECONDS = 3.0
PATIENCE = 60.0


def at_height(target: float) -> dict[str, float]:
    return {"target_height": target}


def target_of(frame: EnvFrame) -> np.ndarray:
    return frame.command["target_height"]


@pytest.fixture(autouse=True)
def no_opengl_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo stores the chosen OpenGL library in an environment variable, which a child process
    would inherit."""
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    offscreen.choose_opengl.cache_clear()


@pytest.fixture(scope="module")
def env() -> BounceBall:
    return BounceBall(EnvConfig(physics="fused", episode_seconds=SECONDS))


@pytest.fixture(scope="module")
def mirrored(env: BounceBall) -> Simulation:
    return Simulation(env, make_policy_controller(MirrorLaw(env)), 2, seed=0)


@pytest.fixture(scope="module")
def recording(mirrored: Simulation) -> EnvFrame:
    """A recording that is one step longer than an episode."""
    return mirrored.record(SECONDS + mirrored.env.dt)


# The simulation


def test_frames_describe_one_state(env: BounceBall, recording: EnvFrame) -> None:
    """MuJoCo's kinematics find the ball and the paddle where the frame has them."""
    display = Display(env)
    for step in (0, 57, 123):
        for i in range(2):
            display.pose(recording.qpos[step, i], at_index(frame_at(recording, step).command, i))
            geom = display.data.geom
            np.testing.assert_allclose(geom("ball").xpos, recording.ball[step, i], atol=1e-6)
            np.testing.assert_allclose(geom("blocker").xpos, recording.paddle[step, i], atol=1e-5)


def test_ball_falls_freely(recording: EnvFrame, env: BounceBall) -> None:
    """High above the paddle the ball only falls: z'' = -g."""
    z = recording.ball[:-2, 0, 2]
    high = z[1:-1] > 0.2
    assert high.sum() > 100
    acceleration = (z[2:] - 2.0 * z[1:-1] + z[:-2]) / env.dt**2
    np.testing.assert_allclose(acceleration[high], -GRAVITY, atol=0.02)


def test_time_runs_until_the_episode_ends(recording: EnvFrame, env: BounceBall) -> None:
    steps = round(SECONDS / env.dt)
    np.testing.assert_allclose(recording.time[: steps + 1, 0], np.arange(steps + 1) * env.dt)
    np.testing.assert_array_equal(np.flatnonzero(recording.over[:, 0]), [steps])
    np.testing.assert_allclose(recording.time[steps + 1], env.dt)
    start = np.asarray(env.config.ball_init_pos)
    distance = np.abs(recording.ball[steps + 1] - start)
    assert np.all(distance < env.config.reset.ball_position + 0.001)
    assert np.all(recording.metrics["n_bounces"][steps + 1] == 0)


def test_environments_differ(recording: EnvFrame) -> None:
    assert np.all(recording.qpos[0, 0, :6] != recording.qpos[0, 1, :6])


def test_zero_actions_hold_the_arm_and_lose_the_ball(env: BounceBall, recording: EnvFrame) -> None:
    held = Simulation(env, make_zero_controller(env), 2, seed=0).record(SECONDS)
    moved = np.abs(held.qpos[20, :, :6] - held.qpos[0, :, :6])
    assert np.all(moved < 0.01)
    # The mirror law keeps both balls up from the same start.
    np.testing.assert_array_equal(held.qpos[0], recording.qpos[0])
    assert np.all(held.over[:-1].any(axis=0))
    assert not recording.over[: len(held.over) - 1].any()


def test_random_actions_are_uniform(env: BounceBall) -> None:
    states = jax.vmap(env.reset, out_axes=-1)(jax.random.split(jax.random.PRNGKey(0), 500))
    control = make_random_controller(env)
    actions = control(None, states, jax.random.PRNGKey(1))
    assert actions.shape == (env.action_size, 500)
    np.testing.assert_allclose(
        np.quantile(actions, (0.0, 0.25, 0.75, 1.0)), (-1, -0.5, 0.5, 1), atol=0.05
    )
    assert np.all(control(None, states, jax.random.PRNGKey(2)) != actions)


def test_the_target_height_can_be_set_and_stays(mirrored: Simulation) -> None:
    mirrored.reset()
    drawn = target_of(mirrored.frame)
    mirrored.command = at_height(0.77)
    assert np.all(drawn != np.float32(0.77))
    np.testing.assert_allclose(target_of(mirrored.step()), 0.77)
    mirrored.reset()
    np.testing.assert_allclose(target_of(mirrored.step()), 0.77)
    mirrored.command = {}
    mirrored.reset()
    low, high = mirrored.env.config.target_height_range
    target = target_of(mirrored.step())
    assert np.all((target >= low) & (target <= high))


def test_a_new_target_is_seen_before_the_next_step(mirrored: Simulation) -> None:
    """While the page is paused, and after a reset."""
    mirrored.reset()
    mirrored.command = at_height(0.77)
    np.testing.assert_allclose(target_of(mirrored.frame), 0.77)
    mirrored.reset()
    np.testing.assert_allclose(target_of(mirrored.frame), 0.77)
    mirrored.command = {}


def test_only_an_episode_that_was_not_timed_out_is_lost(
    env: BounceBall, mirrored: Simulation, recording: EnvFrame
) -> None:
    assert recording.over.any() and not recording.lost.any()
    mirrored.reset()
    mirrored.push((2.0, 0.0, 0.0))
    frames = mirrored.record(1.0)
    assert frames.lost.any(axis=0).all() and frames.over.any(axis=0).all()
    mirrored.reset()


def test_policies_side_by_side_are_shown_as_one(mirrored: Simulation) -> None:
    both = SideBySide([mirrored, mirrored])
    both.command = at_height(0.7)
    both.reset()
    frame = both.step()
    assert both.num_envs == len(frame.ball) == len(both.frame.metrics["n_bounces"]) == 4
    np.testing.assert_allclose(target_of(both.frame), 0.7)
    assert both.record(0.05).qpos.shape[:2] == (6, 4)
    both.command = {}


@pytest.fixture(scope="module")
def exchangeable(env: BounceBall) -> Simulation:
    """One robot under a policy that is one constant action for all joints."""

    def controller(policy, states, key):
        return policy + jnp.zeros_like(states.obs[: env.action_size])

    return Simulation(env, controller, 1, seed=0, policy=np.float32(0.0))


def test_an_exchanged_policy_acts(env: BounceBall, exchangeable: Simulation) -> None:
    before = exchangeable.frame.qpos[0, :6]
    np.testing.assert_allclose(exchangeable.record(0.1).qpos[-1, 0, :6], before, atol=0.01)
    exchangeable.policy = np.float32(1.0)
    moved = exchangeable.record(0.1).qpos[-1, 0, :6] - before
    # The target of a servo is ahead of its joint by the scale of an action.
    assert np.all(moved > 0.5 * env.config.action_scale)


VIEWS = {
    # From the default camera, the arm's side (-x, +y) is away.
    "default": ((-1.06, 1.17, -0.42), "right", (1.17, 1.06, 0.0)),
    "from behind the arm": ((1.0, 0.0, -0.3), "left", (0.0, 1.0, 0.0)),
    "from the front": ((-1.0, 0.0, -0.3), "left", (0.0, -1.0, 0.0)),
    "from above": ((0.0, 0.0, -1.0), "away", (1.0, 0.0, 0.0)),
    "any": ((0.0, 2.0, 0.0), "back", (0.0, -1.0, 0.0)),
    "no number": ((NAN, 0.0, 0.0), "up", (0.0, 0.0, 1.0)),
}


@pytest.mark.parametrize("case", VIEWS.values(), ids=VIEWS)
def test_pushes_follow_the_camera(case) -> None:
    view, towards, expected = case
    expected = np.array(expected) / np.linalg.norm(expected)
    np.testing.assert_allclose(direction(towards, np.array(view)), expected, atol=1e-12)


def test_a_push_adds_its_velocity_to_the_ball_once(mirrored: Simulation) -> None:
    steps, push = 5, np.array([0.2, -0.1, 0.3])
    mirrored.reset()
    start = mirrored.frame.ball
    mirrored.push(tuple(push))
    for _ in range(steps):
        mirrored.step()
    flight = steps * mirrored.env.dt
    # The sum of a semi-implicit integrator's steps, in place of g t^2 / 2.
    fall = 0.5 * GRAVITY * flight * (flight + mirrored.env.config.physics_dt)
    expected = start + push * flight - np.array([0.0, 0.0, fall])
    np.testing.assert_allclose(mirrored.frame.ball, expected, atol=1e-5)


# Resampling


def ramp(over: tuple[int, ...] = ()) -> EnvFrame:
    """Eleven frames of one environment, 0.01 s apart; every value is the frame's time in steps."""
    value = np.arange(11.0)[:, None]
    wide = np.repeat(value[..., None], 3, axis=-1)
    ended = np.zeros((11, 1), bool)
    ended[list(over)] = True
    command, metrics = {"height": value}, {"count": value}
    return EnvFrame(value * 0.01, wide, wide[:, :, None], wide, command, metrics, ended, ended)


def test_resampling_interpolates_positions() -> None:
    frames = resample(ramp(), dt=0.01, fps=60)
    assert len(frames.time) == 6
    times = np.arange(6) / 60
    np.testing.assert_allclose(frames.time[:, 0], times)
    for positions in (frames.qpos, frames.balls[:, 0], frames.paddle):
        np.testing.assert_allclose(positions[:, 0, 0], 100 * times)
    # Commands and metrics come from the last step.
    for values in (frames.command["height"], frames.metrics["count"]):
        np.testing.assert_array_equal(values[:, 0], np.floor(100 * times + 1e-9))


def test_resampling_does_not_blend_two_episodes() -> None:
    frames = resample(ramp(over=(3,)), dt=0.01, fps=60)
    expected = 100 * np.arange(6) / 60
    expected[2] = 3.0  # at 3.33 steps
    np.testing.assert_allclose(frames.ball[:, 0, 0], expected)


# Geometry

SHAPES = """<mujoco><worldbody>
  <geom type="sphere" size=".1"/><geom type="capsule" size=".1 .3"/>
  <geom type="cylinder" size=".1 .3"/><geom type="box" size=".1 .3 .2"/>
  <geom type="ellipsoid" size=".1 .3 .2"/>
</worldbody></mujoco>"""


@pytest.mark.parametrize("geom", range(5))
def test_shapes_have_the_sizes_of_mujoco(geom: int) -> None:
    model = mujoco.MjModel.from_xml_string(SHAPES)
    mesh = _primitive(model.geom_type[geom], model.geom_size[geom])
    center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    np.testing.assert_allclose(mesh.bounds, [center - half, center + half], rtol=0.01, atol=1e-9)
    # The faces look outward.
    assert np.all(np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center) > 0.0)


def test_every_shown_geom_is_in_the_meshes(env: BounceBall) -> None:
    model = Display(env).model
    shapes = {model.body(body).name: len(s.geometry) for body, s in body_scenes(model)}
    shown = {model.body(body).name: int(model.body_geomnum[body]) for body in range(model.nbody)}
    shown["world"] -= 1  # the floor
    assert shapes == shown


def marker_position(display: Display, name: str) -> np.ndarray:
    return display.data.body(marker_body(name)).xpos


def test_markers_are_at_the_positions_of_the_task() -> None:
    config = EnvConfig(reward=BounceReward(paddle_home_height=0.15))
    display = Display(env := BounceBall(config))
    display.pose(env.mj_model.qpos0, at_height(0.61))
    x, y = config.reward.target_x, config.reward.target_y
    np.testing.assert_allclose(marker_position(display, "target_height"), (x, y, 0.61))
    np.testing.assert_allclose(marker_position(display, "paddle_home"), (x, y, 0.15))


def test_the_home_is_an_outline_that_leaves_the_paddle_free(env: BounceBall) -> None:
    model, data = (display := Display(env)).model, display.data
    qpos = env.mj_model.qpos0.copy()
    qpos[find_addresses(env.mj_model).arm_qpos,] = env.config.default_joint_angles
    display.pose(qpos, at_height(0.5))
    home = model.body(marker_body("paddle_home"))
    assert home.geomnum == 4
    paddle, half = data.geom("blocker").xpos, model.geom("blocker").size
    for edge in home.geomadr + np.arange(4):
        gap = np.abs(data.geom_xpos[edge] - paddle) - model.geom_size[edge] - half
        assert np.max(gap[:2]) > 0.0


def test_a_model_without_markers_gets_them(tmp_path: Path) -> None:
    text = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
    bare = tmp_path / "bare.xml"
    bare.write_text(re.sub(r"<site [^>]*/>", "", text), encoding="utf-8")
    env = BounceBall(EnvConfig(mjcf=bare))
    assert env.mj_model.nsite == 0
    display = Display(env)
    display.pose(env.mj_model.qpos0, at_height(0.5))
    assert marker_position(display, "target_height")[2] == 0.5
    home_height = env.config.reward.paddle_home_height
    assert marker_position(display, "paddle_home")[2] == pytest.approx(home_height)


# The camera of the page


def projected(points: np.ndarray, focus, aspect: float, offsets) -> np.ndarray:
    """Points [N, 3] in the picture [N, 2]: -1 to 1 from left to right and from below."""
    position, gaze = camera_pose(offsets, focus, aspect)
    forward = (gaze - position) / np.linalg.norm(gaze - position)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    seen = (points - position) @ np.stack([right, np.cross(right, forward), forward]).T
    return seen[:, :2] / seen[:, 2:] / np.tan(np.radians(20.0)) / (aspect, 1.0)


ASPECTS = (0.46, 0.85, 2.0)
"""Width / height of a picture."""

HOMES = {
    "default": (0.58856, 0.0, 0.05),
    "raised": (0.67, 0.0, 0.4),
    "turned": (0.0, 0.55, 0.25),
    "behind": (-0.6, 0.0, 0.3),
}


@pytest.mark.parametrize("home", HOMES.values(), ids=HOMES)
@pytest.mark.parametrize("number", [1, 2, 4, 16])
@pytest.mark.parametrize("aspect", ASPECTS)
def test_the_camera_sees_every_robot(number: int, home, aspect: float) -> None:
    """Base, paddle, and the ball at the highest target."""
    x, y, z = home
    paddle = np.array([x, y, 0.0]) * (1.0 + 0.05 / np.hypot(x, y)) + (0.0, 0.0, z)
    parts = np.array([(-0.1, 0.0, 0.0), paddle, (x, y, z + 0.8)])
    offsets = scene_grid(number)
    points = (offsets[:, None] + parts).reshape(-1, 3)
    assert np.all(np.abs(projected(points, np.array(home), aspect, offsets)) < 1.0)


@pytest.mark.parametrize("number", [1, 2, 16])
def test_labels_are_above_the_highest_target_and_in_the_picture(
    env: BounceBall, recording: EnvFrame, number: int
) -> None:
    frame = jax.tree.map(
        lambda values: np.resize(values[0], (number, *values.shape[2:])), recording
    )
    names = ["A", "B"] if number == 2 else None
    with open_server("127.0.0.1", 0) as server:
        scene = Scene(server, env, number, names)
        scene.update([frame._replace(command=at_height(np.full(number, 0.8)))])
        labels = np.array([label.position for label in scene._labels])
        body = scene._display.model.body(marker_body("target_height")).id
        targets = scene._bodies[body].batched_positions
        texts = [label.text for label in scene._labels]
    np.testing.assert_allclose(labels - targets, [(0.0, 0.0, 0.14)] * number, atol=1e-6)
    for aspect in ASPECTS:
        offsets = scene_grid(number)
        across, up = projected(labels, np.array(env.task.focus()), aspect, offsets).T
        # Room for the text of a label.
        assert np.all(np.abs(across) < 0.9) and np.all((-1.0 < up) & (up < 0.93))
    assert (
        texts[-1]
        == {
            1: "bounces 0   target 0.80 m",
            2: "B:  bounces 0   target 0.80 m",
            16: "16:  0",
        }[number]
    )


# The clock


def test_steps_become_due_with_the_clock(mirrored: Simulation, monkeypatch) -> None:
    now, speed = 0.0, 0.5
    monkeypatch.setattr(time, "monotonic", lambda: now)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    clock = in_real_time(mirrored, 0.65, lambda: speed)
    assert not next(clock)
    steps = []
    for _ in range(60):
        now += 1.0 / 60.0
        steps.append(len(next(clock)))
    assert sum(steps) in (49, 50)
    assert max(steps) == 1
    now, speed = now + 100.0, 0.0
    assert not next(clock)
    now, speed = now + 100.0, 1.0  # a machine that slept
    steps.append(len(next(clock)))
    assert 9 <= steps[-1] <= 11
    now += 100.0
    steps.append(len(next(clock)))
    assert sum(steps) == 65 and next(clock, None) is None


# The page's server, to which any client may send anything


class Client:
    """A client of the page that speaks viser's protocol but is not a browser."""

    def __init__(self, address: str):
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        self.address = address
        self._socket = connect(
            address.replace("http", "ws"), subprotocols=[protocol], compression=None, max_size=None,
            ping_interval=None,
        )  # fmt: skip
        self.look(position=[1.0, 0.0, 0.0])
        self._controls: dict[str, str] = {}
        self._labels: list[str] = []
        self.texts: list[str] = []
        self.values: dict[str, object] = {}
        self.sliders: dict[str, tuple[float, float, float]] = {}
        self.lines: list[str] = []
        self.keys: list[str] = []
        self.camera: dict[str, list[float]] = {}
        self.download = b""

    def control(self, label: str) -> str:
        """The identifier of a control or of a key's command, by its label."""
        while label not in self._controls:
            self.receive()
        return self._controls[label]

    def press(self, label: str) -> None:
        """Triggers the command of a key."""
        self.send({"type": "CommandTriggerMessage", "uuid": self.control(label)})

    def labels(self) -> list[str]:
        """All texts of labels in the scene so far."""
        self.receive()
        return self._labels

    def receive(self) -> None:
        """Reads the next messages of the server."""
        window = self._socket.recv(timeout=PATIENCE)
        length = int.from_bytes(window[8:16], "little")
        text = zstandard.ZstdDecompressor().decompress(window[16 : 16 + length])
        for message in msgspec.msgpack.decode(text)["messages"]:
            props = message.get("props", {})
            if "label" in props:
                self._controls[props["label"]] = message["uuid"]
            if message["type"] == "GuiSliderMessage":
                self.sliders[props["label"]] = props["min"], props["max"], props["step"]
            if message["type"] == "GuiUplotMessage":
                self.lines += [line["label"] for line in props["series"]]
            if "hotkey" in props:
                self.keys.append(props["hotkey"])
            if message["type"].startswith("SetCamera"):
                self.camera |= message
            if message["type"] == "FileTransferPart":
                self.download += message["content"]
            updates = message.get("updates", {})
            self.texts += [part["content"] for part in (props, updates) if "content" in part]
            if "value" in updates:
                self.values[message["uuid"]] = updates["value"]
            if "text" in updates:
                self._labels.append(updates["text"])

    def set(self, label: str, value: object, name: str = "value") -> None:
        """Sets a control, and gives the page time to read it."""
        self.send({"type": "GuiUpdateMessage", "uuid": label, "updates": {name: value}})

    def look(self, position: list[float]) -> None:
        """Reports the client's camera."""
        self.send(CAMERA | {"position": position})

    def send(self, message: object) -> None:
        self.send_bytes(msgspec.msgpack.encode(message))

    def send_bytes(self, data: bytes | str) -> None:
        self._socket.send(data)
        time.sleep(0.1)

    def close(self) -> None:
        self._socket.close()


def watch(
    monkeypatch: pytest.MonkeyPatch, owner: type, method: str, record: Callable[..., None]
) -> None:
    """Calls `record` with the arguments of every call of a method."""
    original = getattr(owner, method)

    def watched(self, *args):
        record(self, *args)
        return original(self, *args)

    monkeypatch.setattr(owner, method, watched)


@contextlib.contextmanager
def served(simulation: Simulation, monkeypatch: pytest.MonkeyPatch) -> Iterator[Client]:
    """A client of a simulation's page."""
    failures, printed, ended = [], io.StringIO(), threading.Event()
    options = ViewerOptions(viewer="browser", port=8400)

    def step(simulation) -> None:
        if ended.is_set():
            raise KeyboardInterrupt

    watch(monkeypatch, Simulation, "step", step)

    def serve() -> None:
        try:
            show._page(options, Console(file=printed))(simulation, PageStart("exp[lr] <b>"))
        except BaseException as error:
            failures.append(error)

    server = threading.Thread(target=serve)
    server.start()
    while "viewer" not in printed.getvalue():
        assert server.is_alive(), failures
        time.sleep(0.05)
    yield Client(re.search(r"http://\S+", printed.getvalue())[0])
    assert server.is_alive(), failures
    ended.set()
    server.join(PATIENCE)
    assert [type(failure) for failure in failures] == [KeyboardInterrupt], failures


@pytest.fixture
def page(mirrored: Simulation, monkeypatch) -> Iterator[tuple[Client, dict[str, list]]]:
    """A client of a served simulation of two environments, and a record of the page's actions: the
    numbers of environments shown, the speeds, the target heights and the pushes."""
    did: dict[str, list] = {"shown": [], "speed": [], "target": [], "push": []}
    for owner, method, record in (
        (Scene, "show", lambda _, number: did["shown"].append(number)),
        (Simulation, "step", lambda one: did["target"].append(one.command.get("target_height"))),
        (Simulation, "push", lambda _, velocity: did["push"].append(velocity)),
    ):
        watch(monkeypatch, owner, method, record)
    mirrored.command = {}
    make_clock = browser.in_real_time

    def clock(simulation, seconds, speed):
        def watched() -> float:
            did["speed"].append(speed())
            return did["speed"][-1]

        return make_clock(simulation, seconds, watched)

    monkeypatch.setattr(browser, "in_real_time", clock)
    with served(mirrored, monkeypatch) as client:
        yield client, did
    mirrored.command = {}


def wait_until(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def stands_still(did: dict[str, list]) -> bool:
    """Whether the page makes no steps."""
    before = len(did["target"])
    time.sleep(0.3)
    return len(did["target"]) == before


# Values that the controls do not offer; the last item of each row is one that it offers.
HOSTILE = {
    "robots": (1e308, -1e308, 40, HUGE, -HUGE, NAN, INFINITY, "many", [1], None, True, 10**18, 2),
    "speed": (1e9, -1e9, 1e308, NAN, INFINITY, -INFINITY, "fast", {}, b"", 0.5),
    "height, m": (1e9, -1.0, NAN, -INFINITY, "high", [0.5, 0.6], 0.6),
    "speed, m/s": (1e9, NAN, INFINITY, None, 1.0),
    "pause": (1, 0.0, "yes", None, [], NAN, False),
    "drawn at each reset": (1, "no", {}, True),
    "reset": ("", 3, None, [], True),
    "towards": ("sideways", "", 3, None, [], "x" * 2000, "up"),
}
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [1.0, 0.0, 0.0],
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
} | {"fov": 1.0, "near": 0.01, "far": 9.0, "image_height": 9, "image_width": 9}
# Messages that a page never sends; most of them are valid for viser.
FOREIGN = (
    [1, 2, 3],
    None,
    {},
    {"type": "NoSuchMessage"},
    {"type": ["GuiUpdateMessage"], "uuid": "a", "updates": {}},
    {"type": "GuiUpdateMessage", "uuid": ["a"], "updates": {"value": 1}},
    {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 1}},
    {"type": "GuiUpdateMessage", "uuid": "a"},
    {"type": "CommandTriggerMessage", "uuid": 3},
    {"type": "CommandTriggerMessage", "uuid": "a", "more": 1},
    {"type": "GuiButtonHoldMessage", "uuid": "a", "frequency": "x"},
    {"type": "GuiFormDirtyMessage", "uuid": "a"},
    {"type": "FileTransferPart", "transfer_uuid": "a", "part_index": 0, "content": b"a"},
    {"type": "GetRenderResponseMessage", "payload": b"", "render_uuid": "a"},
    {"type": "ScenePointerMessage", "event_type": "click"},
    *(CAMERA | {name: value} for name in list(CAMERA)[1:] for value in (NAN, 1e300, "a", [0, "a"])),
)


@pytest.mark.slow
def test_no_client_can_end_or_stall_the_server(page, capfd) -> None:
    """Whatever a client sends, the simulation keeps within what the controls offer, other clients
    read on, and nothing is printed."""
    client, did = page
    controls = {label: client.control(label) for label in HOSTILE}
    capfd.readouterr()
    for label, (*values, _) in HOSTILE.items():
        for value in values:
            client.set(controls[label], value)
        for name in ("update_cb", "disabled", "min", "uuid", "nonsense"):
            client.set(controls[label], [], name=name)
    for message in FOREIGN:
        client.send(message)
    client.send_bytes(b"\xc1")
    client.send_bytes(b"\x91" * 2000)
    client.send_bytes("text")
    client.set(controls["pause"], False)
    steps = len(did["target"])
    wait_until(lambda: len(did["target"]) > steps)
    assert set(did["shown"]) <= {1, 2}
    assert all(speed == 0.0 or 0.1 <= speed <= 4.0 for speed in did["speed"])
    assert all(target is None or 0.3 <= target <= 0.8 for target in did["target"])
    assert not did["push"]

    with contextlib.closing(Client(client.address)) as other:
        assert other.control("robots") == controls["robots"]
        for label, (*_, value) in HOSTILE.items():
            client.set(controls[label], value)
        wait_until(lambda: did["push"] and did["shown"][-1] == 2 and did["speed"][-1] == 0.5)
        np.testing.assert_allclose(did["push"], [(0.0, 0.0, 1.0)])
        client.press("faster")
        while other.values.get(controls["speed"]) != 0.6:
            other.receive()
        # The values that the other client was told, in the server's own number of decimals.
        told = [other.values[controls[label]] for label in ("robots", "height, m", "speed, m/s")]
        assert told == [2, 0.6, 1.0]
    assert capfd.readouterr() == ("", "")


def handshake(address: str, host: str | None, origin: str | None) -> bytes:
    """The status of the answer to a page that opens a WebSocket."""
    where = urllib.parse.urlsplit(address)
    lines = ["GET / HTTP/1.1", "Upgrade: websocket", "Connection: Upgrade"]
    lines += ["Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13"]
    lines += [f"Sec-WebSocket-Protocol: viser-v{viser.__version__}"]
    lines += [] if host is None else [f"Host: {host}"]
    lines += [] if origin is None else [f"Origin: {origin}"]
    with socket.create_connection((where.hostname, where.port)) as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode())
        return client.recv(12)[-3:]


@pytest.mark.parametrize(
    ("host", "allowed", "pages", "strangers"),
    [
        (
            "127.0.0.1",
            (),
            (
                "http://127.0.0.1:PORT",
                "http://localhost:PORT",
                "http://[::1]:9",
                "https://LocalHost",
            ),
            (
                "http://evil.test:PORT",
                "http://192.0.2.1:PORT",
                "http://localhost.evil.test",
                "http://",
            ),
        ),
        (
            "0.0.0.0",
            (),
            (
                "http://192.0.2.1:PORT",
                "http://[2001:db8::1]:PORT",
                f"http://{socket.gethostname()}",
            ),
            ("http://evil.test:PORT", "http://127.0.0.1.evil.test:PORT"),
        ),
        (
            "127.0.0.1",
            ("gpu.lab",),
            ("http://gpu.lab:PORT", "https://GPU.lab", "http://localhost:PORT"),
            ("http://evil.test:PORT", "http://agpu.lab"),
        ),
    ],
    ids=["local", "everywhere", "allowed"],
)
def test_only_its_own_page_may_connect(host, allowed, pages, strangers, capfd) -> None:
    with open_server(host, 0, allowed) as server:
        address = f"http://127.0.0.1:{server.get_port()}"
        pages, strangers = (
            [text.replace("PORT", str(server.get_port())) for text in texts]
            for texts in (pages, strangers)
        )
        for page in pages:
            name = page.partition("://")[2]
            assert handshake(address, name, page) == b"101", page
            # A program other than a browser sends no origin.
            assert handshake(address, name, None) == b"101", page
            for stranger in [*strangers, "null", "http://localhost:1", "file://", "http://[", ""]:
                assert handshake(address, name, stranger) == b"403", (page, stranger)
        for stranger in strangers:
            name = stranger.partition("://")[2]
            assert handshake(address, name, stranger) == b"403", stranger
            assert handshake(address, name, None) == b"403", stranger
        assert handshake(address, None, None) == b"403"
        # A proxy replaces the name.
        for name in allowed:
            assert handshake(address, "127.0.0.1", f"https://{name}") == b"101"

        request = urllib.request.Request(address, headers={"Host": "evil.test"})
        with pytest.raises(urllib.error.HTTPError) as refusal:
            urllib.request.urlopen(request)
        assert refusal.value.code == 403 and b"--allow-host" in refusal.value.read()
        with urllib.request.urlopen(address) as answer:
            assert b"<html" in answer.read(2000)
    assert capfd.readouterr() == ("", "")


def test_a_viser_that_cannot_be_guarded_is_refused(monkeypatch) -> None:
    """As a version would be that starts its server in another way."""

    class Other:
        def __init__(self, **options):
            self.stop = lambda: stopped.append(True)

    stopped = []
    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(UserError, match="would admit every website.*; install"):
        with open_server("127.0.0.1", 0):
            pass
    assert stopped


def test_keys_act(page) -> None:
    client, did = page
    client.control("push the ball right")
    assert client.sliders["height, m"] == (0.3, 0.8, 0.01)
    assert client.lines == ["s", "ball", "target", "paddle"]
    client.press("target height up")
    wait_until(lambda: did["target"][-1] == pytest.approx(0.55))
    client.press("slower")
    wait_until(lambda: did["speed"][-1] == pytest.approx(0.9))
    client.press("push the ball up")
    wait_until(lambda: did["push"])
    np.testing.assert_allclose(did["push"][-1], (0.0, 0.0, 0.2))
    client.press("pause")
    wait_until(lambda: stands_still(did))
    client.press("pause")


@pytest.mark.slow
def test_pushes_follow_the_camera_and_the_camera_follows_the_ball(
    page, mirrored: Simulation
) -> None:
    client, did = page
    up = np.array([0.0, 0.0, 1.0])
    position, gaze = camera_pose(np.zeros((1, 3)), np.array(mirrored.env.task.focus()))
    for forward in (gaze - position, np.array([-1.0, 0.0, 0.0])):
        pushes = len(did["push"])
        client.set(client.control("towards"), "left")
        wait_until(lambda pushes=pushes: len(did["push"]) > pushes)
        left = np.cross(up, forward)
        np.testing.assert_allclose(did["push"][-1], 0.2 * left / np.linalg.norm(left), atol=1e-6)
        client.look(position=[1.0, 0.0, 0.0])
    client.press("pause")
    client.set(client.control("follow the ball"), True)

    def has_arrived() -> bool:
        client.receive()
        return np.allclose(client.camera.get("look_at"), mirrored.frame.ball[0], atol=1e-3)

    wait_until(has_arrived)
    forward = np.subtract(client.camera["look_at"], client.camera["position"])
    np.testing.assert_allclose(forward, (-1.0, 0.0, 0.0), atol=1e-6)
    client.press("pause")


def test_the_last_seconds_are_saved_as_they_were_seen(
    page, mirrored: Simulation, monkeypatch
) -> None:
    client, did = page
    saved = []

    def replay(env: BounceBall, recording: EnvFrame, names) -> str:
        saved.append(recording)
        return "<html>"

    monkeypatch.setattr(browser, "replay", replay)
    wait_until(lambda: len(did["target"]) > 20)
    client.press("pause")
    wait_until(lambda: stands_still(did))
    client.set(client.control("save the last 10 s"), True)
    while not client.download:
        client.receive()
    assert client.download == b"<html>"
    (recording,) = saved
    assert len(recording.ball) == len(did["target"]) and recording.ball.shape[1:] == (1, 3)
    np.testing.assert_array_equal(recording.ball[-1, 0], mirrored.frame.ball[0])
    client.press("pause")


@pytest.mark.slow
def test_a_lost_ball_is_announced(page) -> None:
    client, _ = page
    client.set(client.control("speed, m/s"), 1.0)

    def is_announced() -> bool:
        client.press("push the ball left")
        return any("BALL LOST" in text for text in client.labels())

    wait_until(is_announced)


def evaluated(*passed: bool | None) -> Report:
    return Report(tuple(Result(f"r{i}", "%", 1.0, ">= 1", p) for i, p in enumerate(passed)), {})


def test_results_are_shown_as_they_are_met() -> None:
    """Each with the step since which it is met without a break."""
    met_at: dict[str, int] = {}
    for steps, *passed in (
        (1_000_000, True, True, None),
        (2_000_000, True, False, None),
        (3_000_000, True, True, None),
    ):
        text = results_list(evaluated(*passed), steps, met_at)
    assert met_at == {"r0": 1_000_000, "r1": 3_000_000}
    assert "evaluation at 3,000,000 steps" in text and "2 of 2 judged results met" in text
    assert re.findall(r"since ([\d,]+)", text) == ["1,000,000", "3,000,000"]


def test_the_page_of_a_training_shows_its_newest_policy(
    exchangeable: Simulation, monkeypatch
) -> None:
    """The training only puts the news into a queue. The address is printed before the simulation is
    compiled."""
    printed, stop = io.StringIO(), threading.Event()

    def simulate(page: TrainingPage) -> Simulation:
        assert "watch: " in printed.getvalue()
        return exchangeable

    monkeypatch.setattr(TrainingPage, "_simulate", simulate)

    def step(simulation) -> None:
        if stop.is_set():
            raise RuntimeError("the\nend")

    watch(monkeypatch, Simulation, "step", step)
    points: list[tuple[float, ...]] = []
    watch(monkeypatch, _Panel, "draw", lambda panel: points.extend(panel._points))
    training = TrainingPage(TrainConfig(), "127.0.0.1", 8500, Console(file=printed, width=200))
    wait_until(lambda: "watch: " in printed.getvalue())
    client = Client(re.search(r"http://\S+", printed.getvalue())[0])
    means = {"episode/return": 1.0, "episode/bounces": NAN, "task/apex_error": 0.02}
    training.block(500_000, means | {"speed/steps_per_second": 2e6})
    training.evaluation(500_000, evaluated(True, False), np.float32(0.5))
    wait_until(lambda: exchangeable.policy == 0.5)
    for told in ("500,000 of 50,000,000 steps", "1 of 2 results met"):
        while not any(told in text for text in client.texts):
            client.receive()
    np.testing.assert_allclose(points[0], (0.5, 1.0, NAN, 2.0))
    titles = ("return of an episode", "bounces in a row at its end", "|apex − target height|, cm")
    assert [line for line in client.lines if line in titles] == list(titles)
    # A page that fails leaves the training alone.
    stop.set()
    wait_until(lambda: "the page is not served (the end); training continues" in printed.getvalue())
    training.wait()


@pytest.mark.slow
def test_a_watched_training_tells_the_page(tmp_path: Path, monkeypatch, capsys) -> None:
    """The last line of a training names the command that shows its policy."""
    told, shown = [], []

    class Page:
        def __init__(self, config: TrainConfig, host: str, port: int, console: Console, allowed):
            told.append(("served", host, port, allowed))

        def block(self, steps: int, means: dict[str, float]) -> None:
            told.append(("block", steps, means["speed/steps_per_second"] > 0.0))

        def evaluation(self, steps: int, report: Report, policy) -> None:
            told.append(("evaluation", steps, len(report.results)))
            shown.append(policy)

        def wait(self) -> None:
            told.append(("ended",))

    monkeypatch.setattr("bounce_mjx.viewers.watch.TrainingPage", Page)
    # The process would end there.
    monkeypatch.setattr(train, "leave", lambda status: None)
    flags = ["--total-steps", "128", "--log-dir", str(tmp_path), "--no-report"]
    train.main([*TINY, *flags, "--watch", "--watch-port", "8123", "--watch-allow-host", "gpu.lab"])
    assert told == [
        ("served", "127.0.0.1", 8123, ("gpu.lab",)),
        ("block", 64, True),
        ("block", 128, True),
        ("evaluation", 128, 5),
        ("ended",),
    ]
    (folder,) = tmp_path.iterdir()
    saved = read_policy(latest_checkpoint(folder), load_run_config(folder))
    jax.tree.map(np.testing.assert_array_equal, *shown, saved)
    assert capsys.readouterr().out.endswith(f"\nwatch it: bounce-mjx play {folder}\n")


def test_the_legend_explains_the_markers(page) -> None:
    client, _ = page
    client.control("push the ball right")
    (legend,) = {text for text in client.texts if "path of the ball" in text}
    assert "target height" in legend and "paddle home" in legend and "Ctrl-K" in legend
    assert "".join(client.keys) == "spaceRTGMNIKJL"


def test_a_title_is_not_markup(page) -> None:
    client, _ = page
    client.control("robots")
    assert any("exp[lr] &lt;b&gt;" in text for text in client.texts)


def test_an_invalid_camera_is_ignored(page) -> None:
    """One camera position is not a number, and one is the point that the camera looks at."""
    client, did = page
    for position, number in ((NAN, 2), (0.0, 1)):
        client.look(position=[position, 0.0, 0.0])
        client.set(client.control("robots"), number)
        wait_until(lambda number=number: did["shown"][-1] == number)


# Other tasks


class StillConfig(WorldConfig):
    """A task without commands."""


class Still(task.Task):
    Config = StillConfig

    def reset(self, start: task.Start) -> tuple:
        return ()

    def step(self, state: tuple, step: task.Step) -> task.TaskStep:
        reward = {"calm": -jnp.sum(jnp.square(step.action))}
        return task.TaskStep((), reward, jnp.array(False), {})


class LeanConfig(WorldConfig):
    """A command that may be negative, and a fixed one without a unit."""

    @property
    def commands(self) -> dict[str, task.Command]:
        angle = task.Command(-0.2, 0.2, "rad", least=-0.3, greatest=0.3, step=0.1)
        return {"lean_angle": angle, "pace": task.Command(2.0, 2.0, span=(1.0, 3.0), step=1.0)}


class Lean(Still):
    Config = LeanConfig

    def step(self, state: tuple, step: task.Step) -> task.TaskStep:
        twice = 2.0 * step.command["lean_angle"]
        return super().step(state, step)._replace(metrics={"twice": twice})

    def markers(self, command: dict, metrics: dict) -> tuple[task.Marker, ...]:
        place, size = (0.5, 0.0, 0.2 + command["lean_angle"]), (0.1, 0.1, 0.01)
        wall = task.Marker("high_wall", place, size, (0.9, 0.1, 0.1, 1.0))
        dots = (task.Marker(f"dot {i}", (0.1 * i, 0.0, 0.5), size, (0, 0, 1, 1)) for i in range(3))
        return wall, *dots

    def levels(self, command: dict[str, float]) -> dict[str, float]:
        return {"shelf": 0.3, "wall": 0.2 + command["lean_angle"]}

    def readings(self, command: dict[str, float], metrics: dict[str, float]) -> dict[str, str]:
        return {"twice": f"{metrics['twice']:.1f}", "pace": f"{command['pace']:.0f}"}


@pytest.fixture(scope="module")
def leaning() -> Simulation:
    env = Env(LeanConfig(physics="fused"))
    return Simulation(env, make_zero_controller(env), 2, seed=0)


@pytest.fixture(scope="module")
def still() -> Simulation:
    env = Env(StillConfig(physics="fused"))
    return Simulation(env, make_zero_controller(env), 1, seed=0)


def test_a_video_needs_ffmpeg_of_the_extra_or_of_the_system(monkeypatch, tmp_path) -> None:
    assert Path(find_ffmpeg()) == Path(imageio_ffmpeg.get_ffmpeg_exe())
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=r"ffmpeg, which is not found; install it, or the extra"):
        VideoWriter(tmp_path / "a.mp4", (64, 64), None)
    (tmp_path / "ffmpeg").touch(mode=0o755)
    assert Path(find_ffmpeg()) == tmp_path / "ffmpeg"


def test_the_page_shows_the_commands_of_any_task(leaning: Simulation, monkeypatch) -> None:
    leaning.command = {}
    with served(leaning, monkeypatch) as client:
        client.control("push the ball right")
        sliders = {"angle, rad": (-0.2, 0.2, 0.02), "pace": (1.0, 3.0, 0.2)}
        assert {label: client.sliders[label] for label in sliders} == sliders
        assert client.sliders.keys() == {"speed", "robots", "speed, m/s", *sliders}
        assert client.lines == ["s", "ball", "shelf", "wall", "paddle"]
        (legend,) = {text for text in client.texts if "path of the ball" in text}
        assert 'rgb(230,26,26)">&#9632;</b> high wall<' in legend
        assert legend.count("dot") == 1
        assert any(">calm<" in text for text in client.texts)
        client.press("lean angle up")
        wait_until(lambda: leaning.command == {"lean_angle": 0.1})
        wait_until(lambda: "twice 0.2   pace 2" in client.labels())
        for _ in range(2):
            client.press("lean angle up")
        wait_until(lambda: leaning.command == {"lean_angle": 0.2})
        client.set(client.control("pace"), 3.0)
        wait_until(lambda: leaning.command == {"lean_angle": 0.2, "pace": 3.0})
    leaning.command = {}


def test_a_task_without_commands_has_no_slider_and_no_key_for_one(
    still: Simulation, monkeypatch
) -> None:
    with served(still, monkeypatch) as client:
        client.control("push the ball right")
        assert client.sliders.keys() == {"speed", "robots", "speed, m/s"}
        assert "".join(client.keys) == "spaceRMNIKJL"
        assert client.lines == ["s", "ball", "paddle"]


def test_a_label_without_readings_is_not_shown(still: Simulation, mirrored: Simulation) -> None:
    """It would be a white stroke."""
    for simulation, is_shown in ((still, False), (mirrored, True)):
        with open_server("127.0.0.1", 0) as server:
            scene = Scene(server, simulation.env, 1)
            scene.update([simulation.frame])
            assert [label.visible for label in scene._labels] == [is_shown]


def test_a_replay_shows_the_commands_of_any_task(
    leaning: Simulation, tmp_path: Path, monkeypatch
) -> None:
    shown = []
    watch(monkeypatch, Scene, "update", lambda _, frames: shown.extend(frames))
    leaning.command = {"lean_angle": 0.1, "pace": 1.5}
    write_page(tmp_path / "a.html", leaning.env, leaning.record(0.2), fps=20)
    assert (tmp_path / "a.html").exists() and len(shown) == 4
    for frame in shown:
        np.testing.assert_allclose(frame.command["lean_angle"], [0.1, 0.1])
        np.testing.assert_array_equal(frame.command["pace"], [1.5, 1.5])
    leaning.command = {}


def test_policies_of_different_tasks_are_not_shown_together() -> None:
    shown = [show.Shown(config(), None, "") for config in (LeanConfig, StillConfig)]
    options = ViewerOptions(viewer="browser")
    with pytest.raises(UserError, match="different tasks; show one at a time"):
        show.show(shown, options, commands={}, console=Console())


# The world's sliders

NOMINAL = {slider.term: slider.world_value(slider.nominal) for slider in SLIDERS}


@pytest.fixture(scope="module")
def played() -> Simulation:
    """The nominal policy in worlds whose ball mass is drawn, under the sliders."""
    checkpoint = pretrained_checkpoint()
    run = load_run_config(checkpoint.run)
    config = run.env.model_copy(
        update={"randomization": RandomizationConfig(ball_mass=(0.8, 0.95))}
    )
    env = BounceBall(with_sliders(config))
    networks = make_networks(run.ppo, env.observation_size, env.action_size)
    controller, policy = make_policy_controller(networks), read_policy(checkpoint, run)
    return Simulation(env, controller, 2, 0, reset_ranges(config), policy)


def recorded(simulation: Simulation, seconds: float, **world: tuple[float, ...]) -> EnvFrame:
    """An episode whose world changes after its first second, which is nominal."""
    simulation.world = {}
    simulation.reset()
    simulation.record(1.0)
    simulation.world = world
    return simulation.record(seconds)


@pytest.mark.slow
def test_policies_of_different_worlds_are_shown_as_one(
    mirrored: Simulation, played: Simulation
) -> None:
    """They have other metrics, such as those of the world's terms."""
    both = SideBySide([mirrored, played])
    both.reset()
    start = both.frame
    both.push((0.0, 0.0, 0.5))
    frame = both.step()
    assert frame.metrics.keys() < played.frame.metrics.keys()
    assert len(frame.metrics["n_bounces"]) == both.num_envs == 4
    assert np.all(frame.ball[:, 2] > start.ball[:, 2])


WORSE = {
    "late actions": {"action_latency": (0.03,)},
    "late ball": {"ball_latency": (0.03,)},
    "tilted paddle": {"paddle_tilt": (np.radians(3.0), 0.0)},
}


@pytest.mark.parametrize("world", WORSE.values(), ids=WORSE)
def test_the_nominal_policy_loses_the_ball_in_another_world(played: Simulation, world) -> None:
    assert not recorded(played, 6.0).over.any()
    assert recorded(played, 6.0, **world).over.any(axis=0).all()


def test_bounces_get_lower_with_the_restitution(played: Simulation) -> None:
    """The policy was trained for one restitution only."""
    highest = [
        recorded(played, 4.0, restitution=(e,)).ball[-200:, :, 2].max() for e in (0.6, 0.85, 0.98)
    ]
    assert highest[0] < highest[1] - 0.05 < highest[2] - 0.1


def test_only_the_worlds_own_terms_are_drawn(played: Simulation) -> None:
    """The sliders' terms are nominal where they are not drawn, and all terms where nothing is."""
    played.world = None
    played.reset()
    played.step()
    world = played._states.pipeline_state.world
    mass = np.asarray(world["ball_mass"])
    assert np.all((mass >= 0.8) & (mass <= 0.95)) and mass[0] != mass[1]
    np.testing.assert_allclose(world["restitution"], 0.85)
    np.testing.assert_array_equal(world["action_latency"], 0.0)
    played.world = {}
    played.step()
    np.testing.assert_array_equal(played._states.pipeline_state.world["ball_mass"], 1.0)


def test_a_moved_slider_changes_the_world_at_once(played: Simulation, monkeypatch) -> None:
    frames, worlds = [], []
    watch(monkeypatch, Simulation, "step", lambda simulation: frames.append(simulation.frame))
    watch(monkeypatch, Simulation, "step", lambda simulation: worlds.append(simulation.world))
    played.world = None
    played.reset()
    with served(played, monkeypatch) as client:
        wait_until(lambda: len(frames) > 100)
        assert worlds[-1] is None and not any(frame.over.any() for frame in frames)
        client.set(client.control("action latency, ms"), 30)
        wait_until(lambda: worlds[-1] == NOMINAL | {"action_latency": (0.03,)})
        wait_until(lambda: any(frame.over.any() for frame in frames))
        for value in (1e9, -1e9, NAN, INFINITY, "much", [1], None):
            client.set(client.control("restitution"), value)
        assert {world["restitution"] for world in worlds if world} == {(0.85,)}
        client.set(client.control("nominal world"), True)
        wait_until(lambda: worlds[-1] == NOMINAL)


def test_sliders_extend_the_ranges_of_a_task() -> None:
    config = EnvConfig(
        randomization=RandomizationConfig(action_latency=(0.01, 0.2), restitution=(0.7, 0.8))
    )
    widened = with_sliders(config).randomization
    assert (widened.action_latency, widened.restitution) == ((0.0, 0.2), (0.6, 0.98))
    assert sliders_for(widened) == SLIDERS and not sliders_for(config.randomization)
    ranges = reset_ranges(config)
    assert set(ranges) == set(widened.terms)
    np.testing.assert_allclose(ranges["restitution"], (0.7, 0.8))
    np.testing.assert_array_equal(ranges["paddle_tilt"], np.zeros((2, 2)))


def test_a_slider_extends_the_ranges_of_all_axes() -> None:
    tilt = (-0.08, 0.01), (-0.07, 0.2)
    config = EnvConfig(randomization=RandomizationConfig(paddle_tilt=tilt))
    widened = with_sliders(config).randomization
    assert widened.paddle_tilt == (-0.08, 0.2) and sliders_for(widened) == SLIDERS
    assert not sliders_for(config.randomization)
    np.testing.assert_allclose(reset_ranges(config)["paddle_tilt"], tilt)


def test_another_robot_has_no_slider_for_the_restitution() -> None:
    """Its own restitution is unknown."""
    config = EnvConfig(mjcf=resource_path("mjcf/bounce_ball.xml"))
    labels = [slider.term for slider in sliders_for(with_sliders(config).randomization)]
    assert labels == [slider.term for slider in SLIDERS if slider.term != "restitution"]


def test_a_server_prints_nothing_and_hides_no_output(capsys, monkeypatch) -> None:
    """Another thread prints while the server starts."""
    make_server = viser.ViserServer

    def make_beside_output(**named) -> viser.ViserServer:
        thread = threading.Thread(target=print, args=("meanwhile",))
        thread.start()
        thread.join()
        return make_server(**named)

    monkeypatch.setattr(viser, "ViserServer", make_beside_output)
    with open_server("127.0.0.1", 0):
        pass
    assert capsys.readouterr().out == "meanwhile\n"


def test_a_client_that_does_not_answer_does_not_delay_the_end(capfd) -> None:
    """A page that is stopped in a debugger never answers when the server closes the connection."""
    with contextlib.ExitStack() as servers, contextlib.ExitStack() as stack:
        server = servers.enter_context(open_server("127.0.0.1", 0))
        client = stack.enter_context(
            socket.create_connection((server.get_host(), server.get_port()))
        )
        client.sendall(
            b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
            + f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n\r\n".encode()
        )
        assert client.recv(12) == b"HTTP/1.1 101"
        ending = threading.Thread(target=servers.close)
        ending.start()
        ending.join(4.0)
        assert not ending.is_alive()
    wait_until(lambda: not server._websock_server._server_thread.is_alive())
    assert capfd.readouterr() == ("", "")


def test_reward_bars_show_every_term() -> None:
    """The bars show all terms, however many there are."""
    terms = dict.fromkeys(term_names(BounceReward), 0.0) | {"position": 2.0, "alignment": -1.25}
    terms["sixteenth_term"] = 0.5
    text = reward_bars(terms)
    for name in terms:
        assert text.count(f">{name.replace('_', ' ')}<") == 1
    assert ">2.00<" in text and ">-1.25<" in text and "sum 1.25" in text
    assert "-0.00" not in reward_bars({"a": -0.001})


# The command lines


def run(command: list[str], cwd: Path, **variables: str) -> subprocess.CompletedProcess:
    """Runs `python -m bounce_mjx COMMAND` in a folder, without a display."""
    env = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    return subprocess.run(
        [sys.executable, "-m", "bounce_mjx", *command], cwd=cwd, env=env | variables,
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip


def read_video(path: Path) -> tuple[float, np.ndarray]:
    """The rate that ffmpeg finds in a video, and its frames [F, height, width, 3]."""
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path)]
    raw = "-f rawvideo -pix_fmt rgb24 -fps_mode passthrough -".split()
    done = subprocess.run([*ffmpeg, *raw], capture_output=True, check=True)
    stream = re.search(r"Stream .* (\d+)x(\d+).* ([\d.]+) fps", done.stderr.decode())
    width, height = int(stream[1]), int(stream[2])
    return float(stream[3]), np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)


VIDEOS = {
    "mp4 by EGL": ("egl", "a.mp4", "play", 60),
    "gif by OSMesa": ("osmesa", "a.gif", "view --actions mirror", 25),
}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="EGL and OSMesa are of Linux")
@pytest.mark.parametrize("case", VIDEOS.values(), ids=VIDEOS)
def test_video_shows_the_arm_and_a_moving_ball(tmp_path: Path, case: tuple) -> None:
    backend, name, command, fps = case
    if "CI" not in os.environ and not offscreen.works(backend):
        pytest.skip(f"{backend} is not installed")
    flags = f"--video {name} --size 320 240 --seconds 0.6".split()
    mine, planted = tmp_path / "mine", tmp_path / f".unfinished-{name}"
    mine.write_text("mine")
    planted.symlink_to(mine)
    done = run([*command.split(), *flags], tmp_path, MUJOCO_GL=backend)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert mine.read_text() == "mine"
    assert set(os.listdir(tmp_path)) == {name, mine.name, planted.name}
    rate, frames = read_video(tmp_path / name)
    assert rate == fps
    assert frames.shape == (round(0.6 * fps), 240, 320, 3)
    red, green, blue = np.moveaxis(frames[0].astype(int), -1, 0)
    orange = (red > 140) & (green < 140) & (blue < 90)
    assert 0.01 < orange.mean() < 0.2
    # The white ball falls: the centre of the white pixels outside the caption moves down.
    rows = []
    for frame in (frames[0], frames[len(frames) // 3]):
        white = np.all(frame[:, 150:] > 215, axis=-1)
        assert white.any()
        rows.append(np.nonzero(white)[0].mean())
    assert rows[1] > rows[0] + 10
    # The caption is bright on dark.
    assert frames[0][10:60, 10:110].max() > 230


@pytest.mark.slow
@pytest.mark.skipif(
    "CI" not in os.environ and shutil.which("Xvfb") is None, reason="Xvfb is not installed"
)
def test_native_viewer_shows_the_arm(tmp_path: Path) -> None:
    """On a virtual screen; the window fills it with floor, sky and an orange arm."""
    from PIL import ImageGrab

    log = (tmp_path / "xvfb").open("wb")
    screen = subprocess.Popen(
        ["Xvfb", "-displayfd", "1", "-screen", "0", "800x600x24"],
        stdout=subprocess.PIPE,
        stderr=log,
    )
    try:
        display = f":{int(screen.stdout.readline())}"
        viewer = subprocess.Popen(
            [sys.executable, "-m", "bounce_mjx", "play", "--seconds", "60"],
            cwd=tmp_path,
            env=os.environ | {"DISPLAY": display},
            stdout=log,
            stderr=log,
        )
        try:
            for _ in range(240):
                picture = np.asarray(ImageGrab.grab(xdisplay=display)).astype(int)
                red, green, blue = np.moveaxis(picture[..., :3], -1, 0)
                orange = (red > 140) & (green < 140) & (blue < 90)
                assert viewer.poll() is None, (tmp_path / "xvfb").read_text()
                if orange.mean() > 0.003:
                    break
                time.sleep(0.25)
            assert 0.003 < orange.mean() < 0.2
        finally:
            viewer.kill()
            viewer.wait()
    finally:
        screen.kill()
        screen.wait()
        log.close()


MISTAKES = {
    "suffix of a video": ("--video a.avi", "--video a.avi", ".mp4 or .gif", "rename"),
    "suffix of a page": ("--html a.txt", "--html a.txt", ".html", "rename"),
    "no folder": ("--video no/a.mp4", "no/a.mp4", "does not exist", "make it"),
    "a folder": ("--html folder.html", "folder.html is a folder", "give a file"),
    "odd size": ("--video a.mp4 --size 321 240", "--size 321 240", "even"),
    "small size": ("--video a.mp4 --size 2 2", "--size is 2", "64"),
    "rate of a gif": ("--video a.gif --fps 60", "--fps 60", "GIF", "25 or 50"),
    "too many robots": ("--num-envs 17", "--num-envs is 17", "16"),
    "two ways": ("--viewer browser --video a.mp4", "--viewer browser", "give only one"),
    "no screen": ("--viewer native", "--viewer native", "display", "--viewer browser"),
    "unknown viewer": ("--viewer vr", "--viewer", "vr", "native"),
    "foreign address": ("--viewer browser --host 192.0.2.1", "--host 192.0.2.1", "127.0.0.1"),
    "speed": ("--speed 0", "--speed is 0", "0.1"),
    "no host": ("--allow-host http://a", "'http://a' is not the name of a host", "without http://"),
}


@pytest.fixture
def fails(tmp_path: Path, monkeypatch, capfd):
    """A function (main, arguments) -> the sentence with which a command refuses them; it leaves an
    empty directory as it is."""
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "folder.html").mkdir()

    def call(main, args: list[str]) -> str:
        with pytest.raises(SystemExit) as exit_info:
            main(args)
        err = capfd.readouterr().err
        assert exit_info.value.code == 2
        assert re.fullmatch(r"error: .+\n", err), err
        assert os.listdir(tmp_path) == ["folder.html"]
        return err

    return call


def test_a_dead_display_is_not_used(monkeypatch) -> None:
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":987")
    assert sys.platform != "linux" or not native.has_display()


def test_policies_given_together_are_named_and_have_one_world(monkeypatch) -> None:
    """Only the task of robust draws its worlds, unless the command draws them."""

    class Named:
        def __init__(self, env, controller, num_envs, seed, ranges, policy):
            self.env, self.num_envs = env, num_envs

    shown = []
    monkeypatch.setattr(show, "Simulation", Named)
    monkeypatch.setattr(LivePage, "__init__", lambda _, server, *given: shown.append(given))
    monkeypatch.setattr(LivePage, "run", lambda *_: None)
    both_play = "pretrained robust --viewer browser --num-envs 4".split()
    play.main(both_play)
    play.main([*both_play, "--randomization.action-latency", "0.0", "0.02"])
    (both, start), (drawn, _) = shown
    assert [one.world for one in both._simulations] == [{}, {}]
    assert [one.world for one in drawn._simulations] == [None, None]
    assert start.names == ["A", "A", "B", "B"] and start.num_shown == both.num_envs == 4
    assert re.fullmatch(r"A: pretrained, .* steps, B: robust, .* steps", start.title)
    for simulation, name in zip(both._simulations, ("pretrained", "robust"), strict=True):
        observation = load_run_config(pretrained_checkpoint(name).run).env.observation
        assert simulation.env.config.observation == observation


def test_a_video_shows_one_policy(fails, monkeypatch) -> None:
    monkeypatch.setattr(Simulation, "__init__", None)
    sentence = fails(play.main, "pretrained pretrained --video a.mp4".split())
    assert "shows one policy" in sentence and "--viewer browser" in sentence


@pytest.mark.parametrize("main", [view.main, play.main])
@pytest.mark.parametrize("case", MISTAKES.values(), ids=MISTAKES)
def test_mistakes_give_one_sentence(fails, main, case: tuple, monkeypatch) -> None:
    # The compilation is not tested here, and every mistake must be found before it.
    if "address" not in case[0]:
        monkeypatch.setattr(Simulation, "__init__", None)
    flags, *words = case
    sentence = fails(main, flags.split())
    assert not [word for word in words if word not in sentence], sentence


def test_without_opengl_the_package_is_named(fails, monkeypatch) -> None:
    monkeypatch.setattr(offscreen.sys, "executable", "/bin/false")
    sentence = fails(view.main, ["--video", "a.mp4"])
    assert "libosmesa6" in sentence and "libegl1" in sentence


def test_an_unknown_backend_is_refused(fails, monkeypatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    assert "MUJOCO_GL is 'vulkan'" in fails(view.main, ["--video", "a.mp4"])


@pytest.mark.skipif(sys.platform != "linux", reason="EGL and OSMesa are of Linux")
def test_the_working_backend_is_chosen(tmp_path: Path, monkeypatch) -> None:
    """EGL looks for its drivers in a folder that the environment may name."""
    if "CI" not in os.environ and not offscreen.works("osmesa"):
        pytest.skip("OSMesa is not installed")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", str(tmp_path))
    assert choose_backend() == "osmesa"
