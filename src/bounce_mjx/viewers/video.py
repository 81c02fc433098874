"""Videos of an episode: MP4, or an animated WebP or GIF for a web page."""

import contextlib
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from bounce_mjx.env.env import Env
from bounce_mjx.errors import MissingPackage, UserError, install_command
from bounce_mjx.interrupt import Interrupted, StopRequest
from bounce_mjx.runs.storage import new_file, writable
from bounce_mjx.viewers.display import Trail
from bounce_mjx.viewers.offscreen import Renderer, choose_opengl
from bounce_mjx.viewers.simulation import (
    EnvFrame,
    environment_pose,
    frame_at,
    frame_readings,
    resample,
)

SUFFIXES = (".mp4", ".webp", ".gif")
# A GIF counts time in 1/100 s, and browsers show at most 50 frames per second.
_DEFAULT_FPS = {".mp4": 60, ".webp": 25, ".gif": 25}
_MAX_GIF_FPS = 50
_POLL_SECONDS = 0.1
_ENCODINGS = {
    ".mp4": "-c:v libx264 -pix_fmt yuv420p -crf 20 -movflags +faststart".split(),
    ".webp": "-c:v libwebp_anim -q:v 60 -loop 0".split(),
    # One palette, for the moving parts; each picture stores only its changed pixels.
    ".gif": (
        "-filter_complex",
        "split[a][b];[a]palettegen=max_colors=128:stats_mode=diff[p];"
        "[b][p]paletteuse=dither=bayer:bayer_scale=5:diff_mode=rectangle",
        "-loop",
        "0",
    ),
}


def find_ffmpeg() -> str:
    """Path of ffmpeg: of the extra `video`, if it is installed, else the system's, which may lack
    an encoder.

    Raises:
      MissingPackage: there is none.
    """
    with contextlib.suppress(ImportError):
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    if found := shutil.which("ffmpeg"):
        return found
    raise MissingPackage(
        "a video needs the program ffmpeg, which is not found; install it, or the extra "
        f"video: {install_command('bounce_mjx[video]')}"
    )


class VideoWriter:
    """Writes recordings as a video; the constructor checks everything that can be checked in
    advance."""

    def __init__(self, path: Path, size: tuple[int, int], fps: int | None, zoom: float = 1.0):
        """Chooses the OpenGL library.

        Args:
          size: width and height in pixels.
          fps: frames per second; None for 60, or 25 for a WebP or a GIF.
          zoom: see `camera_pose`.

        Raises:
          UserError: the size or the rate does not fit the format, there is no ffmpeg, or no
            OpenGL library works.
        """
        self._path = path
        self._size = size
        self._zoom = zoom
        self.fps = fps or _DEFAULT_FPS[path.suffix.lower()]
        if any(pixels % 2 for pixels in size):
            raise UserError(f"--size {size[0]} {size[1]} is odd; give even numbers of pixels")
        if path.suffix.lower() == ".gif" and (self.fps > _MAX_GIF_FPS or 100 % self.fps):
            raise UserError(
                f"--fps {self.fps} does not suit a GIF, which counts time in 1/100 s; give 10, "
                "20, 25 or 50"
            )
        self._ffmpeg = find_ffmpeg()
        choose_opengl()

    def write(
        self, env: Env, recording: EnvFrame, tell: Callable[[int, int], None] | None = None
    ) -> None:
        """Writes the first environment of a recording.

        Args:
          tell: is called after each picture with their number so far, and that of all.

        Raises:
          UserError: the file cannot be written.
          Interrupted: Ctrl-C came; no file is left.
        """
        frames = resample(recording, env.dt, self.fps)
        pictures = draw_frames(env, frames, self._size, self.fps, self._zoom)
        if tell is not None:
            pictures = _counted(pictures, len(frames.time), tell)
        self.write_pictures(pictures)

    def write_pictures(self, shown: Iterable[np.ndarray]) -> None:
        """Writes pictures, each [height, width, 3] (uint8), one a frame.

        Raises:
          UserError: the file cannot be written.
          Interrupted: Ctrl-C came; no file is left.
        """
        width, height = self._size
        pictures = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {self.fps} -i -"
        encoding = _ENCODINGS[self._path.suffix.lower()]
        advice = "give another file"
        with writable(self._path, advice), new_file(self._path) as new:
            # It reads pictures from its standard input.
            command = [self._ffmpeg, "-y", "-loglevel", "error", *pictures.split(), *encoding]
            encoder = subprocess.Popen(
                [*command, str(new)],
                stdin=subprocess.PIPE,
                stderr=subprocess.PIPE,
                # A terminal would send Ctrl-C to it too.
                start_new_session=True,
            )
            try:
                with StopRequest() as stop:
                    # A broken pipe means that the encoder failed; it prints the reason.
                    with contextlib.suppress(BrokenPipeError):
                        for picture in shown:
                            if stop.requested:
                                break
                            encoder.stdin.write(picture.tobytes())
                    errors = _wait(encoder, stop)
                if stop.requested:
                    raise Interrupted
                if encoder.returncode:
                    reason = " ".join(errors.decode(errors="replace").split())
                    raise UserError(f"{self._path} cannot be written ({reason[-200:]}); {advice}")
            finally:
                encoder.kill()
                encoder.communicate()


def _counted(
    pictures: Iterable[np.ndarray], number: int, tell: Callable[[int, int], None]
) -> Iterator[np.ndarray]:
    """The pictures, each of which is told (`VideoWriter.write`)."""
    for done, picture in enumerate(pictures, start=1):
        yield picture
        tell(done, number)


def _wait(encoder: subprocess.Popen, stop: StopRequest) -> bytes:
    """Waits until the encoder has written its file, or a stop is requested; what it printed."""
    while not stop.requested:
        with contextlib.suppress(subprocess.TimeoutExpired):
            _, errors = encoder.communicate(timeout=_POLL_SECONDS)
            return errors
    return b""


def draw_frames(
    env: Env, frames: EnvFrame, size: tuple[int, int], fps: float, zoom: float = 1.0
) -> Iterator[np.ndarray]:
    """The first environment in each of F frames of a rate, with a caption and the ball's path.

    Args:
      size: width and height in pixels.
      zoom: see `camera_pose`.

    Returns:
      F pictures, each [height, width, 3] (uint8).
    """
    trail = Trail(1.0 / fps)
    with Renderer(env, *size, zoom=zoom) as renderer:
        for i in range(len(frames.time)):
            frame = frame_at(frames, i)
            trail.add(frame)
            picture = renderer.render(*environment_pose(frame, 0), trail.points[:, 0])
            yield caption(picture, frame_readings(env, frame), frame.balls[0, 0, 2])


def caption(picture: np.ndarray, readings: dict[str, str], height: float) -> np.ndarray:
    """A picture [height, width, 3] with a caption: the task's readings, the first one large, and
    the first ball's height, m."""
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    unit = max(16, image.height // 26)
    large, small = (ImageFont.load_default(size) for size in (round(1.5 * unit), unit))
    lines = [f"{name}: {value}" for name, value in (*readings.items(), ("ball", f"{height:.2f} m"))]
    fonts = [large] + [small] * (len(lines) - 1)
    longest = max(draw.textlength(line, font) for line, font in zip(lines, fonts, strict=True))
    # In steps, so that the box seldom changes its width.
    right = 2.0 * unit * (1 + longest // (2.0 * unit))
    tops = unit * (1.2 + np.array([0.0, *(1.9 + 1.3 * np.arange(len(lines) - 1))]))
    box = (0.6 * unit, 0.6 * unit, 1.6 * unit + right, tops[-1] + 1.8 * unit)
    draw.rounded_rectangle(box, unit // 2, fill=(15, 20, 28, 170))
    for line, font, top in zip(lines, fonts, tops, strict=True):
        draw.text((1.2 * unit, top), line, font=font, fill="white")
    return np.asarray(image)
