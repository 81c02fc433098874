"""The wheel: its content, and that it works without a source checkout."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parent.parent

# An editable install puts the checkout on the path of every interpreter of this environment.


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=CHECKOUT, check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    return path


def test_import_is_light(tmp_path: Path) -> None:
    """The package imports JAX only at its first use, and the environment imports none of the
    libraries of trainers, other engines, viewers and adapters."""
    script = """
import sys
import bounce_mjx
print("jax" in sys.modules)
env = bounce_mjx.BounceBall(bounce_mjx.EnvConfig())
heavy = (
    "brax mujoco.mjx trimesh scipy networkx numba flax optax orbax matplotlib gymnasium torch "
    "array_api_compat stable_baselines3 sbx torchrl skrl"
)
print(env.backend, *(name for name in heavy.split() if name in sys.modules))
print(*sorted(set(bounce_mjx.__all__) & set(dir(bounce_mjx))))
"""
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    names = "BounceBall EnvConfig Run __version__ load_policy train"
    assert done.stdout.splitlines() == ["False", "fused", names], done.stderr


def test_a_missing_extra_is_told_in_one_way() -> None:
    """To a program as an ImportError, and to the user of a command as one sentence."""
    script = """
import importlib, sys
for library in ("brax", "torch", "stable_baselines3", "ml_collections"):
    sys.modules[library] = None
from bounce_mjx.errors import UserError
for name in ("brax", "sb3", "torch", "playground"):
    try:
        importlib.import_module("bounce_mjx.adapters." + name)
    except ImportError as error:
        print(isinstance(error, UserError), error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    sentence = r"True .+ cannot be imported \(.+\); install it with: pip install .+\n"
    assert re.fullmatch(f"({sentence}){{4}}", done.stdout), done.stdout + done.stderr


def test_wheel_holds_the_package_and_its_data(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
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
