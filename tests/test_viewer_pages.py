"""In a browser, the live page moves and obeys, the replay moves, and neither asks a stranger."""

import io
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from bounce_mjx.commands import view

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("quick_compilation"),
    pytest.mark.skipif(shutil.which("chromium") is None, reason="Chromium is not installed"),
]

# Chromium runs without a GPU and as root, and must make no network requests of its own.
FLAGS = (
    "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist "
    "--disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync"
).split()
# Software WebGL may take minutes when other tests have the cores.
PATIENCE = 300.0


class Watched:
    """A page, with its network requests and its error messages."""

    def __init__(self, page: Page):
        self.page, self.requests, self.complaints = page, [], []
        page.set_default_timeout(1000 * PATIENCE)
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("websocket", lambda socket: self.requests.append(socket.url))
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", lambda said: said.type == "error" and self.complaints.append(said.text))

    def picture(self) -> np.ndarray:
        """A screenshot of the page [height, width, 3]."""
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB"))

    def wait_for_arm(self) -> np.ndarray:
        """The first screenshot that shows the orange arm."""
        return self.wait_until(lambda picture: arm_share(picture) > 0.005)

    def wait_for_motion(self, picture: np.ndarray) -> np.ndarray:
        """The first screenshot whose canvas differs from another screenshot."""
        return self.wait_until(lambda now: (canvas(now) != canvas(picture)).any(-1).sum() > 100)

    def wait_until(self, holds: Callable[[np.ndarray], bool]) -> np.ndarray:
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            picture = self.picture()
            if holds(picture):
                return picture
            self.page.wait_for_timeout(300)
        raise AssertionError(f"it did not come about; the page said {self.complaints}")


def canvas(picture: np.ndarray) -> np.ndarray:
    """The part of a picture between the panels and above the player."""
    height, width, _ = picture.shape
    return picture[: int(0.85 * height), int(0.35 * width) : int(0.7 * width)]


def arm_share(picture: np.ndarray) -> float:
    """Share of the canvas that has the arm's orange colour."""
    red, green, blue = np.moveaxis(canvas(picture).astype(int), -1, 0)
    return float(((red > 130) & (green < 120) & (blue < 80)).mean())


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def watch(browser: Browser) -> Iterator[Callable[[str], Watched]]:
    """A function (address) -> a page that shows this address."""
    pages = []

    def watch(address: str) -> Watched:
        watched = Watched(browser.new_page(viewport={"width": 900, "height": 380}))
        pages.append(watched.page)
        watched.page.goto(address)
        return watched

    yield watch
    for page in pages:
        page.close()


def test_replay_page_moves_and_makes_no_requests(
    watch, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    view.main("--actions mirror --num-envs 2 --seconds 3 --html replay[lr].html".split())
    assert "written: replay[lr].html\n" in capsys.readouterr().out
    assert os.listdir(tmp_path) == ["replay[lr].html"]
    own = (tmp_path / "replay[lr].html").as_uri()
    watched = watch(own)
    watched.wait_for_motion(watched.wait_for_arm())
    assert watched.page.title() == "bounce_mjx"
    assert own in watched.requests
    strangers = [url for url in watched.requests if url != own and not url.startswith("blob:null")]
    assert not strangers
    assert not watched.complaints
    # A browser that cannot draw it says so in place of a white page.
    sentence = watched.page.get_by_text("needs WebGL")
    assert sentence.count() == 0
    watched.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    watched.page.reload()
    sentence.wait_for()


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[subprocess.Popen, str]]:
    """`bounce-mjx play`, without a display and a run, and the address that it prints."""
    env = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "bounce_mjx", "play", "--port", "8230"],
        cwd=tmp_path,
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        said = ""
        for line in process.stdout:
            said += line
            found = re.search(r"http://\S+", line)
            if found:
                break
        assert found, said
        yield process, found[0]
    finally:
        process.kill()
        process.wait()


def test_live_page_moves_obeys_and_stays_local(watch, served) -> None:
    process, address = served
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+", address)
    watched = watch(address)
    page = watched.page
    watched.wait_for_motion(watched.wait_for_arm())
    assert page.title().startswith("bounce_mjx: pretrained, ")

    # The panel shows the reward terms, and they change.
    terms = page.get_by_text("consecutive bounces").locator("xpath=..")
    before = terms.inner_text()
    page.wait_for_function("([e, t]) => e.innerText != t", arg=[terms.element_handle(), before])
    assert page.locator(".uplot").count() == 1

    # While it is paused nothing moves; a reset moves the ball.
    page.get_by_label("pause").click()
    still = watched.picture()
    for _ in range(20):
        page.wait_for_timeout(500)
        before, still = still, watched.picture()
        if (canvas(before) == canvas(still)).all():
            break
    np.testing.assert_array_equal(canvas(before), canvas(still))
    page.get_by_role("button", name="reset").click()
    still = watched.wait_for_motion(still)

    # A slider's handle covers no label of its ends, and on a phone the panel has the whole width.
    label = page.locator(".mantine-Slider-markLabel").first.bounding_box()
    handle = page.locator(".mantine-Slider-thumb").first.bounding_box()
    assert label["y"] + label["height"] - handle["y"] - handle["height"] > 8.0
    page.set_viewport_size({"width": 390, "height": 844})
    panel = page.locator('.mantine-Paper-root[style*="position: fixed"]')
    panel.wait_for()
    assert panel.bounding_box()["x"] == 0.0 and panel.bounding_box()["width"] == 390.0

    strangers = [
        url
        for url in watched.requests
        if not url.startswith((address, address.replace("http", "ws"), f"blob:{address}"))
    ]
    assert not strangers
    assert not watched.complaints

    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=30)
    assert (process.returncode, "Traceback" in said) == (0, False), said
