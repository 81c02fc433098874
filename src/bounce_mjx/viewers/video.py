"""Videos of an episode: MP4, or an animated WebP or GIF for a web page."""

import contextlib
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from bounce_mjx.env.env import Env
from bounce_mjx.errors import MissingPackage, UserError, install_command
from bounce_mjx.interrupt import Interrupted, StopRequest
from bounce_mjx.runs.files import new_file, writable
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
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        found = shutil.which("ffmpeg")
        if found is None:
            raise MissingPackage(
                "a video needs the program ffmpeg, which is not found; install it, or the extra "
                f"video: {install_command('bounce_mjx[video]')}"
            ) from error
        return found
    return get_ffmpeg_exe()


def make_video_writer(
    path: Path, size: tuple[int, int], fps: int | None, zoom: float = 1.0
) -> Callable[[Env, EnvFrame], None]:
    """Chooses the OpenGL library, and checks everything that can be checked in advance.

    Args:
      size: width and height in pixels.
      fps: frames per second; None for 60, or 25 for a WebP or a GIF.
      zoom: see `camera_pose`.

    Returns:
      A function that writes the first environment of a recording. It raises UserError if the file
      cannot be written, and Interrupted, without a file, at Ctrl-C.

    Raises:
      UserError: the size or the rate does not fit the format, there is no ffmpeg, or no OpenGL
        library works.
    """
    kind, (width, height) = path.suffix.lower(), size
    fps = fps or _DEFAULT_FPS[kind]
    if any(pixels % 2 for pixels in size):
        raise UserError(f"--size {width} {height} is odd; give even numbers of pixels")
    if kind == ".gif" and (fps > _MAX_GIF_FPS or 100 % fps):
        raise UserError(
            f"--fps {fps} does not suit a GIF, which counts time in 1/100 s; give 10, 20, 25 or 50"
        )
    pictures = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -".split()
    command = [find_ffmpeg(), "-y", "-loglevel", "error", *pictures, *_ENCODINGS[kind]]
    choose_opengl()

    def write(env: Env, recording: EnvFrame) -> None:
        shown = draw_frames(env, resample(recording, env.dt, fps), size, fps, zoom)
        advice = "give another file with --video"
        with writable(path, advice), new_file(path) as new:
            encoder = subprocess.Popen(
                [*command, str(new)], stdin=subprocess.PIPE, stderr=subprocess.PIPE
            )
            try:
                # A broken pipe means that the encoder failed; it prints the reason.
                with contextlib.suppress(BrokenPipeError), StopRequest() as stop:
                    for picture in shown:
                        if stop.requested:
                            raise Interrupted
                        encoder.stdin.write(picture.tobytes())
                _, errors = encoder.communicate()
                if encoder.returncode:
                    reason = " ".join(errors.decode(errors="replace").split())
                    raise UserError(f"{path} cannot be written ({reason[-200:]}); {advice}")
            finally:
                encoder.kill()
                encoder.communicate()

    return write


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
    with contextlib.closing(Renderer(env, *size, zoom=zoom)) as renderer:
        for i in range(len(frames.time)):
            frame = frame_at(frames, i)
            trail.add(frame)
            picture = renderer.render(*environment_pose(frame, 0), trail.points[:, 0])
            yield caption(picture, frame_readings(env, frame), frame.balls[0, 0, 2])


def caption(picture: np.ndarray, readings: dict[str, str], height: float) -> np.ndarray:
    """A picture [height, width, 3] with a caption: the task's readings, the first one large, and
    the ball's height, m."""
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
