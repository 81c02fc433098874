"""The replay page: episodes in one HTML file, for any browser, offline."""

import contextlib
import threading
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import viser

from bounce_mjx.env.env import Env
from bounce_mjx.viewers.files import new_output
from bounce_mjx.viewers.guard import start_server
from bounce_mjx.viewers.scene import Scene
from bounce_mjx.viewers.simulation import EnvFrame, SideBySide, Simulation, frame_at, resample

SUFFIXES = (".html",)
_DEFAULT_FPS = 30
_VISER_TITLE = "<title>Viser</title>"
# viser's `stop` waits up to 6 s for clients that do not answer, such as a page in a debugger.
_STOP_SECONDS = 1.0


def write_page(
    path: Path,
    simulation: Simulation | SideBySide,
    recording: EnvFrame,
    fps: int | None,
    names: Sequence[str] | None = None,
) -> None:
    """Writes a recording of all environments of the simulation as a page.

    Args:
      names: see `Scene`.

    Raises:
      UserError: the file cannot be written.
    """
    text = replay(simulation.env, recording, fps or _DEFAULT_FPS, names)
    with new_output(path, "--html") as new:
        new.write_text(text, encoding="utf-8")


def replay(
    env: Env, recording: EnvFrame, fps: int = _DEFAULT_FPS, names: Sequence[str] | None = None
) -> str:
    """A page (HTML) that replays a recording [T, N, ...]."""
    frames = resample(recording, env.dt, fps)
    with open_server("127.0.0.1", 0) as server:
        scene = Scene(server, env, frames.time.shape[1], names)
        recorder = server.get_scene_serializer()
        for i in range(len(frames.time)):
            scene.update([frame_at(frames, i)])
            recorder.insert_sleep(1.0 / fps)
        return recorder.as_html().replace(_VISER_TITLE, "<title>bounce_mjx</title>", 1)


@contextlib.contextmanager
def open_server(host: str, port: int, allowed: Collection[str] = ()) -> Iterator[viser.ViserServer]:
    """A server of `start_server`; port 0 takes any free port.

    Closing it takes at most a second: a background thread waits for clients that do not answer.
    """
    server = start_server(host, port, allowed)
    try:
        yield server
    finally:
        stopping = threading.Thread(target=server.stop, daemon=True)
        stopping.start()
        stopping.join(_STOP_SECONDS)
