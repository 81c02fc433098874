"""The replay page: episodes in one HTML file, for any browser, offline."""

import contextlib
import io
import threading
from collections.abc import Iterator
from pathlib import Path

import viser

from bounce_mjx.errors import UserError
from bounce_mjx.viewers.files import replace_file
from bounce_mjx.viewers.scene import Scene
from bounce_mjx.viewers.simulation import Frame, Simulation, resample

SUFFIXES = (".html",)
_DEFAULT_FPS = 30
# viser's `stop` waits up to 6 s for clients that do not answer, such as a page in a debugger.
_STOP_SECONDS = 1.0


def write_page(path: Path, simulation: Simulation, recording: Frame, fps: int | None) -> None:
    """Writes a recording of all environments of the simulation as a page.

    Raises:
      UserError: the file cannot be written.
    """
    fps = fps or _DEFAULT_FPS
    frames = resample(recording, simulation.env.dt, fps)
    with open_server("127.0.0.1", 0) as server:
        scene = Scene(server, simulation.env, simulation.num_envs)
        recorder = server.get_scene_serializer()
        for i in range(len(frames.time)):
            scene.update([Frame(*(values[i] for values in frames))])
            recorder.insert_sleep(1.0 / fps)
        text = recorder.as_html()
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


@contextlib.contextmanager
def open_server(host: str, port: int) -> Iterator[viser.ViserServer]:
    """A viser server that prints nothing; port 0 takes any free port.

    Closing it takes at most a second: a background thread waits for clients that do not answer.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    try:
        yield server
    finally:
        stopping = threading.Thread(target=server.stop, daemon=True)
        with contextlib.redirect_stdout(io.StringIO()):
            stopping.start()
            stopping.join(_STOP_SECONDS)
