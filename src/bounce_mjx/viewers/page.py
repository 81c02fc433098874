"""An episode as one HTML file that replays offline in any browser."""

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path

import viser

from bounce_mjx.errors import UserError
from bounce_mjx.viewers.files import replace_file
from bounce_mjx.viewers.scene import Scene
from bounce_mjx.viewers.simulation import Frame, Simulation, resample

SUFFIXES = (".html",)
_DEFAULT_FPS = 30


def write_page(path: Path, simulation: Simulation, recording: Frame, fps: int | None) -> None:
    """Writes a recording of the simulation, with all its environments, as a page.

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
    """A viser server, without the lines that it prints; port 0 is any free one."""
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
