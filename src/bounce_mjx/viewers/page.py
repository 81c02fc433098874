"""The replay page: episodes in one HTML file, for any browser, offline."""

from collections.abc import Sequence

import jax
import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.task.task import Recording
from bounce_mjx.viewers.film import episode_frames
from bounce_mjx.viewers.guard import open_server
from bounce_mjx.viewers.scene import ANNOUNCED_SECONDS, Scene
from bounce_mjx.viewers.simulation import EnvFrame, frame_at, resample

SUFFIXES = (".html",)
_DEFAULT_FPS = 30
_EPISODE_SECONDS = 10.0
_VISER_TITLE = "<title>Viser</title>"
# What the page says where a browser cannot draw it, and would leave it white.
_HEAD = """<title>bounce_mjx</title>
<script>
addEventListener("DOMContentLoaded", () => {
  if (document.createElement("canvas").getContext("webgl2")) return;
  const said = document.createElement("p");
  said.style = "position: fixed; inset: 0; z-index: 9999; margin: 0; padding: 1rem;"
    + " background: #fff; font: 15px/1.5 system-ui, sans-serif";
  said.textContent = "The replay needs WebGL, which this browser does not have. A video in its"
    + " place: bounce-mjx play RUN --video replay.mp4";
  document.body.append(said);
});
</script>"""


def replay_first_and_worst(env: Env, recording: Recording) -> str:
    """A page (HTML) that replays the first recorded episode from its start, and beside it the worst
    recorded one up to its end, each up to its end or for 10 s."""
    worst = worst_episode(recording)
    first = episode_frames(env, recording, seconds=_EPISODE_SECONDS)
    if worst == 0:
        return replay(env, first)
    whole = episode_frames(env, recording, worst)
    steps = round(_EPISODE_SECONDS / env.dt)
    last = jax.tree.map(lambda values: values[-steps:], whole)
    return replay(env, _beside(first, last), names=["first", "worst"])


def worst_episode(recording: Recording) -> int:
    """Index of the recorded episode that survived the fewest steps; of several, of the one with the
    lowest return."""
    running = np.asarray(recording.running)
    survived = running & ~np.asarray(recording.terminated)
    terms = [np.asarray(x) for name, x in recording.metrics.items() if name.startswith("reward/")]
    returns = np.where(running, sum(terms, np.zeros(running.shape)), 0.0).sum(axis=0)
    return int(np.lexsort((returns, survived.sum(axis=0)))[0])


def _beside(frames: EnvFrame, others: EnvFrame) -> EnvFrame:
    """Two recordings [T, 1, ...] in one [T, 2, ...]; the shorter one stays at its last frame."""
    count = max(len(frames.time), len(others.time))

    def join(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        held = [x[np.minimum(np.arange(count), len(x) - 1)] for x in (first, second)]
        return np.concatenate(held, axis=1)

    return jax.tree.map(join, frames, others)


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
        scene = Scene(server, env, frames.time.shape[1], names, 1.0 / fps)
        recorder = server.get_scene_serializer()
        for i in range(len(frames.time)):
            scene.update([frame_at(frames, i)])
            recorder.insert_sleep(1.0 / fps)
        if frames.lost[-1].any():
            # The page begins again, which would hide it at once.
            recorder.insert_sleep(ANNOUNCED_SECONDS)
        return recorder.as_html().replace(_VISER_TITLE, _HEAD, 1)
