"""A simulation for the tests of the viewers, a client of their page, and two other tasks."""

import contextlib
import functools
import io
import re
import threading
import time
from collections.abc import Callable, Iterator

import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
import viser
import zstandard
from rich.console import Console
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from bounce_mjx import BounceBall, EnvConfig, task
from bounce_mjx.baselines.mirror import MirrorLaw
from bounce_mjx.evaluation.failures import Film
from bounce_mjx.evaluation.results import Report, Result
from bounce_mjx.evaluation.statistics import Statistics
from bounce_mjx.task.task import Recording, Tally
from bounce_mjx.viewers import show
from bounce_mjx.viewers.film import FilmPlayer
from bounce_mjx.viewers.options import PageStart, ViewerOptions
from bounce_mjx.viewers.simulation import EnvFrame, Simulation, make_policy_controller
from bounce_mjx.world.config import WorldConfig

GRAVITY = 9.81
NAN, INFINITY = float("nan"), float("inf")
SECONDS = 3.0
PATIENCE = 60.0


def at_height(target: float) -> dict[str, float]:
    return {"target_height": target}


def target_of(frame: EnvFrame) -> np.ndarray:
    return frame.goal["target_height"]


@functools.cache
def mirrored() -> Simulation:
    """Two robots under the mirror law, which keeps both balls up."""
    env = BounceBall(EnvConfig(physics="fused", episode_seconds=SECONDS))
    return Simulation(env, make_policy_controller(MirrorLaw(env)), 2, seed=0)


def exchangeable() -> Simulation:
    """Two robots under a policy that is one constant action for all joints, from a new reset with
    the policy 0, whatever another file's tests left."""
    simulation = _exchangeable()
    simulation.goal, simulation.world, simulation.policy = {}, None, np.float32(0.0)
    simulation.reset()
    return simulation


@functools.cache
def _exchangeable() -> Simulation:
    env = mirrored().env

    def controller(policy, states, key):
        return policy + jnp.zeros_like(states.obs[: env.action_size])

    # As many robots as above, with which it has the program of the reset in common.
    return Simulation(env, controller, 2, seed=0, policy=np.float32(0.0))


def recording_of(simulation: Simulation, steps: int, lasted: bool = True) -> Recording:
    """The next steps of a simulation's first robot, as an episode of so many, which lasted or
    failed in the last of them."""
    frames = simulation.record(steps * simulation.env.dt)
    terminated = np.zeros((steps, 1), bool)
    terminated[-1] = not lasted
    return Recording(
        joint_angles=None,
        ball=None,
        paddle=frames.paddle[1:, :1].transpose(0, 2, 1),
        goal={name: values[1:, :1] for name, values in frames.goal.items()},
        running=np.ones((steps, 1), bool),
        terminated=terminated,
        qpos=frames.qpos[1:, :1].transpose(0, 2, 1),
        metrics={name: values[1:, :1] for name, values in frames.metrics.items()},
    )


def film_of(simulation: Simulation, steps: int, lasted: bool = True) -> FilmPlayer:
    """A film of the episode of `recording_of`."""
    recording = recording_of(simulation, steps, lasted)
    statistics = Statistics(np.array([lasted]), np.full(1, steps), np.zeros(1), Tally({}, {}))
    return FilmPlayer(Film(simulation.env, recording, statistics))


class Client:
    """A client of the page that speaks viser's protocol but is not a browser."""

    def __init__(self, address: str):
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        self.address = address
        # The page may send for ever, so that a close would wait for its answer in vain.
        self._socket = connect(
            address.replace("http", "ws"),
            subprotocols=[protocol],
            compression=None,
            max_size=None,
            ping_interval=None,
            close_timeout=0.1,
        )
        self.send(CAMERA)
        self._controls: dict[str, str] = {}
        self._labels: list[str] = []
        self.texts: list[str] = []
        self.sliders: dict[str, tuple[float, float, float]] = {}
        self.lines: list[str] = []
        self.height_axis: object = None
        self.values: dict[str, object] = {}

    def has(self, label: str) -> bool:
        """Whether a control or a key's command of this label has come so far."""
        return label in self._controls

    def control(self, label: str) -> str:
        """The identifier of a control or of a key's command, by its label."""
        while label not in self._controls:
            self.receive()
        return self._controls[label]

    def press(self, label: str) -> None:
        self.send({"type": "CommandTriggerMessage", "uuid": self.control(label)})

    def labels(self) -> list[str]:
        """All texts of labels in the scene so far."""
        self.receive()
        return self._labels

    def receive(self) -> None:
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
                self.height_axis = props["scales"]["y"]["range"]
            updates = message.get("updates", {})
            self.texts += [part["content"] for part in (props, updates) if "content" in part]
            if "value" in updates:
                self.values[message["uuid"]] = updates["value"]
            if "text" in updates:
                self._labels.append(updates["text"])

    def set(self, label: str, value: object) -> None:
        """Sets a control, and gives the page time to read it."""
        self.send({"type": "GuiUpdateMessage", "uuid": label, "updates": {"value": value}})

    def send(self, message: object) -> None:
        self._socket.send(msgspec.msgpack.encode(message))
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

    watch(monkeypatch, type(simulation), "step", step)

    def serve() -> None:
        try:
            start = PageStart("exp[lr] <b>")
            show._serve(lambda: simulation, start, options, Console(file=printed))
        except BaseException as error:
            failures.append(error)

    server = threading.Thread(target=serve)
    server.start()
    while "viewer" not in printed.getvalue():
        assert server.is_alive(), failures
        time.sleep(0.05)
    try:
        yield Client(re.search(r"http://\S+", printed.getvalue())[0])
        assert server.is_alive(), failures
    finally:
        # Else a test that fails would never end.
        ended.set()
        server.join(PATIENCE)
    assert [type(failure) for failure in failures] == [KeyboardInterrupt], failures


def wait_until(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.05)


CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [1.0, 0.0, 0.0],
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
} | {"fov": 1.0, "near": 0.01, "far": 9.0, "image_height": 9, "image_width": 9}


class StillConfig(WorldConfig):
    """A task without goals."""


class Still(task.Task):
    Config = StillConfig

    def reset(self, start: task.Start) -> tuple:
        return ()

    def step(self, state: tuple, step: task.Step) -> task.TaskStep:
        reward = {"calm": -jnp.sum(jnp.square(step.action))}
        return task.TaskStep((), reward, jnp.array(False), {})


class LeanConfig(WorldConfig):
    """A goal that may be negative, a fixed one without a unit, and a choice."""

    @property
    def goals(self) -> dict[str, task.Goal]:
        angle = task.Goal(-0.2, 0.2, "rad", least=-0.3, greatest=0.3, step=0.1, hidden=True)
        pace = task.Goal(2.0, 2.0, span=(1.0, 3.0), step=1.0)
        gait = task.Goal(0.0, 2.0, "", 0.0, 2.0, step=1.0, names=("walk", "slow run"), hidden=True)
        return {"lean_angle": angle, "pace": pace, "gait": gait}


class Lean(Still):
    Config = LeanConfig

    def step(self, state: tuple, step: task.Step) -> task.TaskStep:
        twice = 2.0 * step.goal["lean_angle"]
        return super().step(state, step)._replace(metrics={"twice": twice})

    def markers(self, goal: dict, metrics: dict) -> tuple[task.Marker, ...]:
        place, size = (0.5, 0.0, 0.2 + goal["lean_angle"]), (0.1, 0.1, 0.01)
        wall = task.Marker("high_wall", place, size, (0.9, 0.1, 0.1, 1.0))
        dots = (task.Marker(f"dot {i}", (0.1 * i, 0.0, 0.5), size, (0, 0, 1, 1)) for i in range(3))
        return wall, *dots

    def levels(self, goal: dict[str, float]) -> dict[str, float]:
        return {"shelf": 0.3, "wall": 0.2 + goal["lean_angle"]}

    def readings(self, goal: dict[str, float], metrics: dict[str, float]) -> dict[str, str]:
        return {"twice": f"{metrics['twice']:.1f}", "pace": f"{goal['pace']:.0f}"}


def evaluated(*passed: bool | None) -> Report:
    return Report(tuple(Result(f"r{i}", "%", 1.0, ">= 1", p) for i, p in enumerate(passed)), {})
