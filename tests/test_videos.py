"""The commands play and view: videos, the native window, their flags and mistakes."""

import io
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import imageio_ffmpeg
import jax
import numpy as np
import pytest
from PIL import Image, ImageSequence
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bounce_mjx.commands import play
from bounce_mjx.errors import UserError
from bounce_mjx.interrupt import Interrupted
from bounce_mjx.runs.checkpoints import read_policy
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.training.events import Event
from bounce_mjx.training.video import EvaluationVideo
from bounce_mjx.viewers import browser, offscreen, show, video
from bounce_mjx.viewers.offscreen import choose_backend
from bounce_mjx.viewers.simulation import Simulation
from bounce_mjx.viewers.video import VideoWriter, find_ffmpeg
from viewing import wait_until


@pytest.fixture(autouse=True)
def no_opengl_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo stores the chosen OpenGL library in an environment variable, which a child process
    would inherit."""
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    offscreen.choose_opengl.cache_clear()


def test_a_video_needs_ffmpeg_of_the_extra_or_of_the_system(monkeypatch, tmp_path) -> None:
    assert Path(find_ffmpeg()) == Path(imageio_ffmpeg.get_ffmpeg_exe())
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=r"ffmpeg, which is not found; install it, or the extra"):
        VideoWriter(tmp_path / "a.mp4", (64, 64), None)
    (tmp_path / "ffmpeg").touch(mode=0o755)
    assert Path(find_ffmpeg()) == tmp_path / "ffmpeg"


SLOW_ENCODER = """#!{python}
import os, pathlib, sys, time
sys.stdin.buffer.read()
pathlib.Path("{folder}/read").write_text(str(os.getsid(0)))
time.sleep(60.0)
"""


def test_ctrl_c_while_the_encoder_ends_leaves_no_file(tmp_path: Path, monkeypatch) -> None:
    """A GIF is encoded when all pictures have come. The encoder is not the terminal's, whose Ctrl-C
    would make it fail first."""
    encoder, read = tmp_path / "ffmpeg", tmp_path / "read"
    encoder.write_text(SLOW_ENCODER.format(python=sys.executable, folder=tmp_path))
    encoder.chmod(0o755)
    picture = np.zeros((64, 64, 3), np.uint8)
    monkeypatch.setattr(video, "find_ffmpeg", lambda: str(encoder))
    monkeypatch.setattr(video, "choose_opengl", lambda: None)
    monkeypatch.setattr(video, "resample", lambda recording, dt, fps: recording)
    monkeypatch.setattr(video, "draw_frames", lambda *_: iter([picture] * 3))

    def press_ctrl_c() -> None:
        wait_until(read.exists)
        os.kill(os.getpid(), signal.SIGINT)

    (tmp_path / "out").mkdir()
    writer = VideoWriter(tmp_path / "out/a.gif", (64, 64), None)
    threading.Thread(target=press_ctrl_c).start()
    with pytest.raises(Interrupted):
        writer.write(SimpleNamespace(dt=0.01), None)
    assert not os.listdir(tmp_path / "out")
    assert int(read.read_text()) != os.getsid(0)


def run(command: list[str], cwd: Path, **variables: str) -> subprocess.CompletedProcess:
    """Runs `python -m bounce_mjx COMMAND` in a folder, without a display."""
    env = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    return subprocess.run(
        [sys.executable, "-m", "bounce_mjx", *command], cwd=cwd, env=env | variables,
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip


def read_video(path: Path) -> tuple[float, np.ndarray]:
    """The rate that ffmpeg finds in a video, and its frames [F, height, width, 3]."""
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path)]
    raw = "-f rawvideo -pix_fmt rgb24 -fps_mode passthrough -".split()
    done = subprocess.run([*ffmpeg, *raw], capture_output=True, check=True)
    stream = re.search(r"Stream .* (\d+)x(\d+).* ([\d.]+) fps", done.stderr.decode())
    width, height = int(stream[1]), int(stream[2])
    return float(stream[3]), np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)


@pytest.mark.slow
def test_evaluations_are_filmed_for_tensorboard(opengl, tmp_path: Path) -> None:
    """Each evaluated policy is a GIF of the reset and what follows; a block is none."""
    checkpoint = find_checkpoint("pretrained")
    config = load_run_config(checkpoint.run)
    policy = read_policy(checkpoint, config)
    blind = jax.tree.map(np.zeros_like, policy)
    film = EvaluationVideo(seconds=0.6, size=(64, 48), fps=10)
    film.start(tmp_path, config)
    film(Event(tmp_path, config, 32, {}))
    for steps, shown in ((64, policy), (128, blind)):
        film(Event(tmp_path, config, steps, {}, policy=shown))
    log = EventAccumulator(str(tmp_path / "video"))
    log.Reload()
    assert [event.step for event in log.Images("policy")] == [64, 128]
    videos = []
    for event in log.Images("policy"):
        with Image.open(io.BytesIO(event.encoded_image_string)) as gif:
            assert (gif.format, gif.size, gif.n_frames) == ("GIF", (64, 48), 7)
            videos.append([np.asarray(x.convert("RGB"), int) for x in ImageSequence.Iterator(gif)])
    good, still = np.array(videos)
    assert np.abs(good[-1] - good[0]).max() > 50
    assert np.abs(good[-1] - still[-1]).max() > 50
    # What a killed training filmed after its checkpoint does not count.
    resumed = EvaluationVideo(seconds=0.6, size=(64, 48), fps=10)
    resumed._simulation = film._simulation
    resumed(Event(tmp_path, config, 96, {}, policy=blind))
    log = EventAccumulator(str(tmp_path / "video")).Reload()
    assert [event.step for event in log.Images("policy")] == [64, 96]


VIDEOS = {
    "mp4 by EGL": ("egl", "a.mp4", "play", 60),
    "gif by OSMesa": ("osmesa", "a.gif", "view --actions mirror", 25),
}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="EGL and OSMesa are of Linux")
@pytest.mark.parametrize("case", VIDEOS.values(), ids=VIDEOS)
def test_video_shows_the_arm_and_a_moving_ball(tmp_path: Path, case: tuple) -> None:
    backend, name, command, fps = case
    if not offscreen.works(backend):
        pytest.skip(f"{backend} is not installed")
    flags = f"--video {name} --size 320 240 --seconds 0.6".split()
    mine, planted = tmp_path / "mine", tmp_path / f".unfinished-{name}"
    mine.write_text("mine")
    planted.symlink_to(mine)
    done = run([*command.split(), *flags], tmp_path, MUJOCO_GL=backend)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    # Without a terminal a line for each tenth, however few frames there are.
    told = re.findall(r"recording: (\d+) of (\d+) frames", done.stdout)
    number = round(0.6 * fps) + 1
    assert told[-1] == (str(number), str(number)) and len(told) == 10
    assert mine.read_text() == "mine"
    assert set(os.listdir(tmp_path)) == {name, mine.name, planted.name}
    rate, frames = read_video(tmp_path / name)
    assert rate == fps
    # From the reset to the last step.
    assert frames.shape == (number, 240, 320, 3)
    red, green, blue = np.moveaxis(frames[0].astype(int), -1, 0)
    orange = (red > 140) & (green < 140) & (blue < 90)
    assert 0.01 < orange.mean() < 0.2
    # The white ball falls: the centre of the white pixels outside the caption moves down.
    rows = []
    for frame in (frames[0], frames[len(frames) // 3]):
        white = np.all(frame[:, 150:] > 215, axis=-1)
        assert white.any()
        rows.append(np.nonzero(white)[0].mean())
    assert rows[1] > rows[0] + 10
    # The caption is bright on dark.
    assert frames[0][10:60, 10:110].max() > 230


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="Xvfb is not installed")
def test_native_viewer_shows_the_arm(tmp_path: Path) -> None:
    """On a virtual screen; the window fills it with floor, sky and an orange arm."""
    from PIL import ImageGrab

    log = (tmp_path / "xvfb").open("wb")
    screen = subprocess.Popen(
        ["Xvfb", "-displayfd", "1", "-screen", "0", "800x600x24"],
        stdout=subprocess.PIPE,
        stderr=log,
    )
    try:
        display = f":{int(screen.stdout.readline())}"
        viewer = subprocess.Popen(
            [sys.executable, "-m", "bounce_mjx", "play", "--seconds", "60"],
            cwd=tmp_path,
            env=os.environ | {"DISPLAY": display},
            stdout=log,
            stderr=log,
        )
        try:
            for _ in range(240):
                picture = np.asarray(ImageGrab.grab(xdisplay=display)).astype(int)
                red, green, blue = np.moveaxis(picture[..., :3], -1, 0)
                orange = (red > 140) & (green < 140) & (blue < 90)
                assert viewer.poll() is None, (tmp_path / "xvfb").read_text()
                if orange.mean() > 0.003:
                    break
                time.sleep(0.25)
            assert 0.003 < orange.mean() < 0.2
        finally:
            viewer.kill()
            viewer.wait()
    finally:
        screen.kill()
        screen.wait()
        log.close()


def test_policies_given_together_are_named_and_have_one_world(monkeypatch) -> None:
    """Only the task of robust draws its worlds, unless the command draws them."""

    class Named:
        def __init__(self, env, controller, num_envs, seed, ranges, policy):
            self.env, self.others, self._steps = env, (), np.zeros(num_envs)

        num_envs = Simulation.num_envs

    shown = []
    monkeypatch.setattr(show, "Simulation", Named)
    monkeypatch.setattr(browser, "run_page", lambda _, *given: shown.append(given[:2]))
    both_play = "pretrained robust --viewer browser --num-envs 4".split()
    play.main(both_play)
    play.main([*both_play, "--randomization.action-latency", "0.0", "0.02"])
    (both, start), (drawn, _) = shown
    assert [one.world for one in (both, *both.others)] == [{}, {}]
    assert [one.world for one in (drawn, *drawn.others)] == [None, None]
    assert start.names == ["A", "A", "B", "B"] and start.num_shown == both.num_envs == 4
    assert re.fullmatch(r"A: pretrained, .* steps, B: robust, .* steps", start.title)
    for simulation, name in zip((both, *both.others), ("pretrained", "robust"), strict=True):
        observation = load_run_config(find_checkpoint(name).run).env.observation
        assert simulation.env.config.observation == observation


def test_without_opengl_the_package_is_named(refused, monkeypatch) -> None:
    monkeypatch.setattr(offscreen.sys, "executable", "/bin/false")
    sentence = refused("view --video a.mp4")
    assert "libosmesa6" in sentence and "libegl1" in sentence
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    assert "MUJOCO_GL=vulkan does not work" in refused("view --video a.mp4")


@pytest.mark.skipif(sys.platform != "linux", reason="EGL and OSMesa are of Linux")
def test_the_working_backend_is_chosen(tmp_path: Path, monkeypatch) -> None:
    """EGL looks for its drivers in a folder that the environment may name."""
    if not offscreen.works("osmesa"):
        pytest.skip("OSMesa is not installed")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", str(tmp_path))
    assert choose_backend() == "osmesa"
