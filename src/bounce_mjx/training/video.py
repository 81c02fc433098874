"""A callback that films the policy for TensorBoard."""

import contextlib
import io
from pathlib import Path

from PIL import Image

from bounce_mjx.env.env import Env
from bounce_mjx.learning.policy import networks_of
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.events import Event
from bounce_mjx.training.log import TensorBoardLog
from bounce_mjx.viewers.offscreen import choose_opengl
from bounce_mjx.viewers.simulation import Simulation, make_policy_controller, resample
from bounce_mjx.viewers.video import draw_frames


class EvaluationVideo:
    """A callback that shows each evaluated policy as a GIF in TensorBoard, under Images, in the log
    RUN/video. The training waits for it: seconds where no GPU renders."""

    def __init__(
        self, seconds: float = 4.0, size: tuple[int, int] = (320, 240), fps: int = 10
    ) -> None:
        """
        Args:
          seconds: simulated time from the reset.
          size: width and height in pixels.
          fps: frames per second.
        """
        self._seconds = seconds
        self._size = size
        self._fps = fps
        self._simulation: Simulation | None = None
        self._log: TensorBoardLog | None = None

    def start(self, run: Path, config: TrainConfig) -> None:
        """
        Raises:
          UserError: no OpenGL library works.
        """
        choose_opengl()

    def __call__(self, event: Event) -> None:
        if event.policy is None:
            return
        if self._simulation is None:
            env = Env(event.config.env)
            controller = make_policy_controller(networks_of(event.config.ppo)(env))
            self._simulation = Simulation(env, controller, 1, seed=0, policy=event.policy)
        if self._log is None:
            # A resumed training may have filmed later policies before.
            self._log = TensorBoardLog(resumed=event.steps - 1)
        self._simulation.policy = event.policy
        self._simulation.reset()
        recording = self._simulation.record(self._seconds)
        frames = resample(recording, self._simulation.env.dt, self._fps)
        pictures = draw_frames(self._simulation.env, frames, self._size, self._fps)
        first, *others = map(Image.fromarray, pictures)
        gif = io.BytesIO()
        duration = 1000 / self._fps
        first.save(gif, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
        width, height = self._size
        kind = self._log.summary.Summary
        image = kind.Image(
            width=width, height=height, colorspace=3, encoded_image_string=gif.getvalue()
        )
        summary = kind(value=[kind.Value(tag="policy", image=image)])
        # In its own folder, as TensorBoard stops reading a file once its folder has a newer one.
        folder = event.run / "video"
        with contextlib.suppress(OSError):
            folder.mkdir(exist_ok=True)
        self._log.add(folder, event.steps, summary=summary)
