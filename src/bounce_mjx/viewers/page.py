"""The replay page: episodes in one HTML file, for any browser, offline."""

from collections.abc import Sequence

from bounce_mjx.env.env import Env
from bounce_mjx.task.task import Recording
from bounce_mjx.viewers.film import episode_frames
from bounce_mjx.viewers.guard import open_server
from bounce_mjx.viewers.scene import Scene
from bounce_mjx.viewers.simulation import EnvFrame, frame_at, resample

SUFFIXES = (".html",)
_DEFAULT_FPS = 30
_EPISODE_SECONDS = 10.0
_VISER_TITLE = "<title>Viser</title>"


def replay_first_episode(env: Env, recording: Recording) -> str:
    """A page (HTML) that replays the first recorded episode up to its end, or for 10 s."""
    frames = episode_frames(env, recording, seconds=_EPISODE_SECONDS)
    return replay(env, frames)


def replay(
    env: Env, recording: EnvFrame, fps: int | None = None, names: Sequence[str] | None = None
) -> str:
    """A page (HTML) that replays a recording [T, N, ...], at 30 frames per second or another rate.

    Args:
      names: see `Scene`.
    """
    fps = fps or _DEFAULT_FPS
    frames = resample(recording, env.dt, fps)
    with open_server("127.0.0.1", 0) as server:
        scene = Scene(server, env, frames.time.shape[1], names)
        recorder = server.get_scene_serializer()
        for i in range(len(frames.time)):
            scene.update([frame_at(frames, i)])
            recorder.insert_sleep(1.0 / fps)
        return recorder.as_html().replace(_VISER_TITLE, "<title>bounce_mjx</title>", 1)
