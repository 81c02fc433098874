"""A release: the wheel, built from the sdist and installed alone in a new environment, trains a
policy, evaluates and exports it, and another folder loads it."""

import os
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tiny_runs import TIMEOUT, TINY

CHECKOUT = Path(__file__).resolve().parent.parent
HERE = f"{sys.version_info.major}.{sys.version_info.minor}"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("uv") is None, reason="uv is not installed"),
]


# Runs command lines in one process, which imports JAX once.
COMMANDS = """
import shlex, sys
from bounce_mjx.commands.main import main
for line in sys.argv[1:]:
    main(shlex.split(line))
"""


def call(*words: object, folder: Path, status: int = 0, **variables: str) -> str:
    hidden = ("PYTHONPATH", "VIRTUAL_ENV")
    environ = {name: value for name, value in os.environ.items() if name not in hidden}
    done = subprocess.run(
        [str(word) for word in words],
        cwd=folder,
        env=environ | variables,
        capture_output=True,
        text=True,
        timeout=2 * TIMEOUT,
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, which uv builds from the sdist."""
    folder = tmp_path_factory.mktemp("dist")
    call("uv", "build", "--quiet", "--out-dir", folder, CHECKOUT, folder=folder)
    return next(folder.glob("*.whl"))


def test_wheel_holds_the_package_and_its_data(built: Path) -> None:
    with zipfile.ZipFile(built) as archive:
        names = set(archive.namelist())
    source = CHECKOUT / "src"
    expected = {str(p.relative_to(source)) for p in (source / "bounce_mjx").rglob("*.py")}
    expected |= {"bounce_mjx/py.typed"}
    for folder in ("mjcf", "configs", "pretrained"):
        data = [p for p in (CHECKOUT / folder).rglob("*") if p.is_file()]
        assert data
        expected |= {f"bounce_mjx/{p.relative_to(CHECKOUT)}" for p in data}
    assert expected <= names
    assert {name.split("/")[0].split("-")[0] for name in names} == {"bounce_mjx"}


@pytest.mark.parametrize("version", [HERE, *(v for v in ("3.12", "3.13") if v != HERE)])
def test_an_installed_release_trains_evaluates_exports_and_acts(
    version: str, built: Path, tmp_path: Path, opengl: None
) -> None:
    found = subprocess.run(
        ["uv", "python", "find", "--no-project", "--no-python-downloads", version],
        capture_output=True,
    )
    if found.returncode:
        pytest.skip(f"Python {version} is not installed")
    call("uv", "venv", "--quiet", "--python", version, tmp_path / "env", folder=tmp_path)
    bin_folder = next(p for p in (tmp_path / "env/bin", tmp_path / "env/Scripts") if p.exists())
    python, command = bin_folder / "python", bin_folder / "bounce-mjx"
    file = f"bounce_mjx[deploy,video] @ {built.as_uri()}"
    call("uv", "pip", "install", "--quiet", "--python", python, file, folder=tmp_path)

    work, other = tmp_path / "work", tmp_path / "other"
    work.mkdir()
    other.mkdir()
    log_dir = work / "runs"
    said = call(command, "train", *TINY, "--total-steps", 128, "--log-dir", log_dir, folder=work)
    (run,) = log_dir.iterdir()
    assert "consecutive bounces" in said and (run / "report.html").is_file()
    assert "<iframe" in (run / "report.html").read_text(encoding="utf-8")
    # An untrained policy misses results, which is status 1.
    lines = (
        "export {} --onnx policy.onnx",
        "play {} --video a.gif --seconds 1",
        "eval {} --episodes 4",
    )
    lines = [line.format(shlex.quote(str(run))) for line in lines]
    said = call(python, "-c", COMMANDS, *lines, folder=other, status=1)
    assert "FAIL" in said
    assert (other / "a.gif").read_bytes().startswith(b"GIF")
    acts = (
        "import numpy, bounce_mjx; p = bounce_mjx.load_policy('policy.onnx')\n"
        "shapes = {'joint_angles': 6, 'joint_velocities': 6, 'target_height': ()}\n"
        "values = {name: numpy.zeros(shapes.get(name, 3)) for name in p.needs}\n"
        "values['joint_angles'] = p.metadata.default_joint_angles\n"
        "print(bounce_mjx.__file__, p.step(values).shape)"
    )
    package, shape = call(python, "-c", acts, folder=other).split(maxsplit=1)
    assert Path(package).is_relative_to(tmp_path / "env") and shape == "(6,)\n"
