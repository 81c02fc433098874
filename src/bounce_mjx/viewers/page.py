"""The replay page: episodes in one HTML file, for any browser, offline."""

from collections.abc import Sequence
from pathlib import Path

from bounce_mjx.env.env import Env
from bounce_mjx.runs.files import writable, write_output
from bounce_mjx.viewers.guard import open_server
from bounce_mjx.viewers.scene import Scene
from bounce_mjx.viewers.simulation import EnvFrame, frame_at, resample

SUFFIXES = (".html",)
_DEFAULT_FPS = 30
_VISER_TITLE = "<title>Viser</title>"


def write_page(
    path: Path,
    env: Env,
    recording: EnvFrame,
    fps: int | None,
    names: Sequence[str] | None = None,
) -> None:
    """Writes a recording [T, N, ...] as a page.

    Args:
      names: see `Scene`.

    Raises:
      UserError: the file cannot be written.
    """
    text = replay(env, recording, fps or _DEFAULT_FPS, names)
    with writable(path, "make room there, or give another file"):
        write_output(path, text)


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
