"""The replay page: episodes in one HTML file, for any browser, offline."""

import contextlib
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import rich
import viser

from bounce_mjx.errors import UserError
from bounce_mjx.task.env import BounceBall
from bounce_mjx.viewers.files import replace_file
from bounce_mjx.viewers.scene import Scene
from bounce_mjx.viewers.simulation import Frame, SideBySide, Simulation, resample

SUFFIXES = (".html",)
_DEFAULT_FPS = 30
_VISER_TITLE = "<title>Viser</title>"
# viser's `stop` waits up to 6 s for clients that do not answer, such as a page in a debugger.
_STOP_SECONDS = 1.0


def write_page(
    path: Path,
    simulation: Simulation | SideBySide,
    recording: Frame,
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
    unfinished = path.with_name(f".unfinished-{path.name}")
    try:
        unfinished.write_text(text, encoding="utf-8")
        replace_file(unfinished, path, "--html")
    except OSError as error:
        raise UserError(
            f"--html {path} cannot be written ({error.strerror}); give another file"
        ) from error
    finally:
        unfinished.unlink(missing_ok=True)


def replay(
    env: BounceBall, recording: Frame, fps: int = _DEFAULT_FPS, names: Sequence[str] | None = None
) -> str:
    """A page (HTML) that replays a recording [T, N, ...]."""
    frames = resample(recording, env.dt, fps)
    with open_server("127.0.0.1", 0) as server:
        scene = Scene(server, env, frames.time.shape[1], names)
        recorder = server.get_scene_serializer()
        for i in range(len(frames.time)):
            scene.update([Frame(*(values[i] for values in frames))])
            recorder.insert_sleep(1.0 / fps)
        return recorder.as_html().replace(_VISER_TITLE, "<title>bounce_mjx</title>", 1)


@contextlib.contextmanager
def open_server(host: str, port: int) -> Iterator[viser.ViserServer]:
    """A viser server that prints nothing; port 0 takes any free port.

    Closing it takes at most a second: a background thread waits for clients that do not answer.
    """
    # viser prints to rich's shared console even if it is not verbose; the commands have their own.
    rich.get_console().quiet = True
    server = viser.ViserServer(host=host, port=port, verbose=False)
    try:
        yield server
    finally:
        stopping = threading.Thread(target=server.stop, daemon=True)
        stopping.start()
        stopping.join(_STOP_SECONDS)
