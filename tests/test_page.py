"""The live page: what its controls do, and that no client can do more."""

import contextlib
import dataclasses
import io
import re
import socket
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import viser
import yaml
from rich.console import Console

import viewing
from arms import ARM
from bounce_mjx import EnvConfig
from bounce_mjx.commands import adopt
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training import watch as watched
from bounce_mjx.training.events import Event
from bounce_mjx.training.watch import TrainingPage
from bounce_mjx.viewers import browser, guard, show
from bounce_mjx.viewers.guard import open_server
from bounce_mjx.viewers.options import PageStart, ViewerOptions
from bounce_mjx.viewers.scene import Scene
from bounce_mjx.viewers.simulation import Simulation, make_zero_controller
from viewing import Client, LeanConfig, evaluated, served, wait_until, watch


@pytest.fixture(scope="module")
def mirrored() -> Simulation:
    return viewing.mirrored()


@pytest.fixture
def page(mirrored: Simulation, monkeypatch) -> Iterator[tuple[Client, dict[str, list]]]:
    """A client of a served simulation of two environments, and a record of the page's actions: the
    numbers of environments shown, the speeds, the target heights and the pushes."""
    did: dict[str, list] = {"shown": [], "speed": [], "target": [], "push": []}
    for owner, method, record in (
        (Scene, "show", lambda _, number: did["shown"].append(number)),
        (Simulation, "step", lambda one: did["target"].append(one.goal.get("target_height"))),
        (Simulation, "push", lambda _, velocity: did["push"].append(velocity)),
    ):
        watch(monkeypatch, owner, method, record)
    mirrored.goal = {}
    make_clock = browser.in_real_time

    def clock(simulation, seconds, speed):
        def watched() -> float:
            did["speed"].append(speed())
            return did["speed"][-1]

        return make_clock(simulation, seconds, watched)

    monkeypatch.setattr(browser, "in_real_time", clock)
    with served(mirrored, monkeypatch) as client:
        yield client, did
    mirrored.goal = {}


def stands_still(did: dict[str, list]) -> bool:
    """Whether the page makes no steps."""
    before = len(did["target"])
    time.sleep(0.3)
    return len(did["target"]) == before


def handshake(address: str, host: str | None, origin: str | None) -> int:
    """The status of the answer to a page that opens a WebSocket."""
    where = urllib.parse.urlsplit(address)
    lines = ["GET / HTTP/1.1", "Upgrade: websocket", "Connection: Upgrade"]
    lines += ["Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13"]
    lines += [f"Sec-WebSocket-Protocol: viser-v{viser.__version__}"]
    lines += [f"{name}: {x}" for name, x in (("Host", host), ("Origin", origin)) if x is not None]
    with socket.create_connection((where.hostname, where.port)) as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode())
        return int(client.recv(12)[-3:])


LOOPBACK = "http://127.0.0.1:PORT http://localhost:PORT http://[::1]:9 https://LocalHost"
STRANGE = "http://evil.test:PORT http://localhost.evil.test http://"
HOSTS = {
    "local": ("127.0.0.1", (), LOOPBACK, STRANGE),
    "everywhere": (
        "0.0.0.0",
        (),
        f"http://192.0.2.1:PORT http://[2001:db8::1]:PORT http://{socket.gethostname()}",
        "http://evil.test:PORT http://127.0.0.1.evil.test:PORT",
    ),
    "allowed": (
        "127.0.0.1",
        ("gpu.lab",),
        "http://gpu.lab:PORT https://GPU.lab http://localhost:PORT",
        "http://evil.test:PORT http://agpu.lab",
    ),
}


@pytest.mark.parametrize(("host", "allowed", "pages", "strangers"), HOSTS.values(), ids=HOSTS)
def test_only_its_own_page_may_connect(host, allowed, pages, strangers, capfd) -> None:
    with open_server(host, 0, allowed) as server:
        port = str(server.get_port())
        pages, strangers = (text.replace("PORT", port).split() for text in (pages, strangers))
        address = f"http://127.0.0.1:{port}"
        for page in pages:
            name = page.partition("://")[2]
            assert handshake(address, name, page) == 101, page
            # A program other than a browser sends no origin.
            assert handshake(address, name, None) == 101, page
            for stranger in [*strangers, "null", "http://localhost:1", "file://", "http://[", ""]:
                assert handshake(address, name, stranger) == 403, (page, stranger)
        for stranger in strangers:
            name = stranger.partition("://")[2]
            assert handshake(address, name, stranger) == 403, stranger
            assert handshake(address, name, None) == 403, stranger
        assert handshake(address, None, None) == 403
        # A proxy replaces the name.
        for name in allowed:
            assert handshake(address, "127.0.0.1", f"https://{name}") == 101
        request = urllib.request.Request(address, headers={"Host": "evil.test"})
        with pytest.raises(urllib.error.HTTPError) as refusal:
            urllib.request.urlopen(request)
        assert refusal.value.code == 403 and b"--allow-host" in refusal.value.read()
        with urllib.request.urlopen(address) as answer:
            assert b"<html" in answer.read(2000)
    assert capfd.readouterr() == ("", "")


def test_each_body_of_an_arm_has_its_place_whatever_its_name(tmp_path) -> None:
    """Of a hand-written arm, bodies have no names; of another, slashes."""
    names = iter(("", "", "wam", "wam/hand", "wam/bat", ""))
    text = re.sub("<body ", lambda _: f'<body name="{next(names)}" ', ARM)
    (tmp_path / "arm.xml").write_text(text.replace(' name=""', ""))
    adopt.main([str(tmp_path / "arm.xml"), "--site", "tool", "--out", str(tmp_path / "arm.yaml")])
    settings = yaml.safe_load((tmp_path / "arm.yaml").read_text())
    env = Env(EnvConfig.model_validate(settings["env"]))
    server = viser.ViserServer(port=0, verbose=False)
    try:
        bodies = Scene(server, env, 1)._bodies
        places = [handle.name for handle in bodies.values()]
        assert len(set(places)) == len(places) >= 7
        assert all(place.count("/") == 2 for place in places)
    finally:
        server.stop()


def test_the_printed_address_is_that_of_the_server(monkeypatch) -> None:
    """Also where another program took the free port while the simulation was compiled."""
    ports, printed = [], io.StringIO()

    def run_page(server, simulation, start, is_over, say, seconds) -> None:
        ports.append(server.get_port())
        say()

    monkeypatch.setattr(browser, "run_page", run_page)
    with socket.create_server(("127.0.0.1", 0)) as other:
        monkeypatch.setattr(browser, "free_port", lambda host, port: other.getsockname()[1])
        show._serve(lambda: None, PageStart("a"), ViewerOptions(), Console(file=printed))
        assert ports != [other.getsockname()[1]]
    assert printed.getvalue() == f"viewer: http://127.0.0.1:{ports[0]}  (Ctrl-C ends it)\n"


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
    # A ball above or below the usual range is shown too: uPlot widens ends that are only soft.
    assert client.height_axis["min"]["soft"] == 0.0 and "hard" not in client.height_axis["min"]
    assert client.height_axis["max"]["soft"] > 0.8 and "hard" not in client.height_axis["max"]
    client.set(client.control("height, m"), 0.5)
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


def test_a_paused_page_shows_the_values_that_hold(page, mirrored: Simulation) -> None:
    """What a user set in a pause and gave up again is not shown any more."""
    client, did = page
    client.press("pause")
    wait_until(lambda: stands_still(did))
    height, sampled = client.control("height, m"), client.control("sampled")
    client.set(height, 0.8)
    client.values.clear()
    client.set(sampled, True)
    wait_until(lambda: mirrored.goal == {})
    holds = round(float(mirrored.frame.goal["target_height"][0]), 2)
    while client.values.get(height) != holds:
        client.receive()
    client.press("pause")


def test_a_film_has_no_keys_that_change_it(mirrored: Simulation, monkeypatch) -> None:
    film = viewing.film_of(mirrored, 20)
    with served(film, monkeypatch) as client:
        # The last key of those that a film has.
        client.control("slower")
        assert client.has("pause") and client.has("reset")
        for label in ("target height up", "target height down", "push the ball up"):
            assert not client.has(label), label


NAN, INFINITY, HUGE = float("nan"), float("inf"), 2**63 - 1
# For each control what a page may not send it, and at the end a value that it may have.
HOSTILE = {
    "robots": (1e308, -1e308, 40, HUGE, -HUGE, NAN, INFINITY, "many", "nan", [1], None, True, 2),
    "speed": (1e9, -1e9, NAN, INFINITY, -INFINITY, "fast", "nan", "inf", {}, b"", 0.5),
    "height, m": (1e9, -1.0, NAN, -INFINITY, "high", "inf", [0.5, 0.6], 0.6),
    "speed, m/s": (1e9, NAN, INFINITY, "nan", None, 1.0),
    "pause": (0.0, "yes", None, [], NAN, False),
    "push": ("sideways", "", 3, None, [], "x" * 2000, "ball up"),
}
WORDS = {"level 2": True, "1-leg": True, "walk": True, "": True} | dict.fromkeys(
    ("nan", "inf", "-Infinity", " 7", "1e308", "1_0", "٣"), False
)


def test_a_text_may_be_a_choice_but_no_number() -> None:
    """viser would read a number, or none, from such a text, and send it to the other pages."""
    for text, is_choice in WORDS.items():
        message = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": text}}
        assert guard._is_valid(msgspec.msgpack.encode(message)) is is_choice, text


FOREIGN = (
    [1, 2, 3],
    None,
    {},
    {"type": "NoSuchMessage"},
    {"type": "GuiUpdateMessage", "uuid": ["a"], "updates": {"value": 1}},
    {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 1}},
    {"type": "CommandTriggerMessage", "uuid": "a", "more": 1},
    {"type": "FileTransferPart", "transfer_uuid": "a", "part_index": 0, "content": b"a"},
    {"type": "GetRenderResponseMessage", "payload": b"", "render_uuid": "a"},
)


def test_no_client_can_end_the_server_or_leave_a_range(page, capfd) -> None:
    """Whatever a client sends, the simulation gets values within the ranges of the controls, the
    next client is served, and nothing is printed."""
    client, did = page
    controls = {label: client.control(label) for label in HOSTILE}
    for label, (*values, _) in HOSTILE.items():
        for value in values:
            client.set(controls[label], value)
    for message in FOREIGN:
        client.send(message)
    with contextlib.closing(Client(client.address)) as other:
        for label, (*_, value) in HOSTILE.items():
            other.set(other.control(label), value)
        wait_until(lambda: did["push"] and did["shown"][-1] == 2 and did["speed"][-1] == 0.5)
        wait_until(lambda: did["target"][-1] == pytest.approx(0.6))
    np.testing.assert_allclose(did["push"], [(0.0, 0.0, 1.0)])
    assert set(did["shown"]) <= {1, 2}
    assert all(speed == 0.0 or 0.1 <= speed <= 4.0 for speed in did["speed"])
    assert all(target is None or 0.3 <= target <= 0.8 for target in did["target"])
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
@pytest.mark.usefixtures("quick_compilation")
def test_the_page_shows_the_goals_of_any_task(monkeypatch) -> None:
    env = Env(LeanConfig(physics="fused"))
    leaning = Simulation(env, make_zero_controller(env), 2, seed=0)
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
        client.set(client.control("angle, rad"), 0.0)
        client.press("lean angle up")
        wait_until(lambda: leaning.goal == {"lean_angle": 0.1})
        wait_until(lambda: "twice 0.2   pace 2" in client.labels())
        for _ in range(2):
            client.press("lean angle up")
        wait_until(lambda: leaning.goal == {"lean_angle": 0.2})
        client.set(client.control("pace"), 3.0)
        wait_until(lambda: leaning.goal == {"lean_angle": 0.2, "pace": 3.0})
        client.set(client.control("gait"), "slow run")
        wait_until(lambda: leaning.goal.get("gait") == 1.0)


@pytest.fixture
def exchangeable() -> Simulation:
    return viewing.exchangeable()


def test_the_page_of_a_training_shows_its_newest_policy(
    exchangeable: Simulation, monkeypatch
) -> None:
    """The training only puts the news into a queue. The address is printed before the simulation is
    compiled."""
    printed, stop = io.StringIO(), threading.Event()

    def simulate(config: TrainConfig) -> Simulation:
        assert "watch: " in printed.getvalue()
        return exchangeable

    monkeypatch.setattr(watched, "_simulate", simulate)

    def step(simulation) -> None:
        if stop.is_set():
            raise RuntimeError("the\nend")

    watch(monkeypatch, Simulation, "step", step)
    address = watched.Address("127.0.0.1", 8500, ())
    training = TrainingPage(TrainConfig(), address, Console(file=printed, width=200))
    wait_until(lambda: "watch: " in printed.getvalue())
    client = Client(re.search(r"http://\S+", printed.getvalue())[0])
    means = {"episode/return": 1.0, "task/apex_error": 0.02, "speed/steps_per_second": 2e6}
    block = Event(Path("run"), TrainConfig(), 500_000, means)
    training(block)
    report = evaluated(True, False)
    training(dataclasses.replace(block, metrics={}, report=report, policy=np.float32(0.5)))
    wait_until(lambda: exchangeable.policy == 0.5)
    for told in ("500,000 of 50,000,000 steps", "1 of 2 results met"):
        while not any(told in text for text in client.texts):
            client.receive()
    # A page that fails leaves the training alone.
    stop.set()
    wait_until(lambda: "the page is not served (the end); training continues" in printed.getvalue())
    training.wait()
