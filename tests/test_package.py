"""The wheel: its content, and that it works without a source checkout."""

import ast
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parent.parent
PACKAGE = CHECKOUT / "src" / "bounce_mjx"

# An editable install puts the checkout on the path of every interpreter of this environment.


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from the checkout."""
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


def test_trainer_needs_neither_brax_nor_mjx(tmp_path: Path) -> None:
    script = """
import sys
import bounce_mjx.commands.eval, bounce_mjx.commands.train
from bounce_mjx.training import job
print(*(name for name in ("brax", "mujoco.mjx", "trimesh") if name in sys.modules))
"""
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stdout == "\n", done.stdout + done.stderr


@pytest.mark.parametrize("module", ["brax", "sb3", "torch", "playground"])
def test_a_missing_extra_is_told_in_one_way(module: str) -> None:
    """To a program as an ImportError, and to the user of a command as one sentence."""
    script = f"""
import sys
for library in ("brax", "torch", "stable_baselines3", "ml_collections"):
    sys.modules[library] = None
from bounce_mjx.errors import UserError
try:
    import bounce_mjx.adapters.{module}
except ImportError as error:
    print(isinstance(error, UserError), error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    sentence = r"True .+ cannot be imported \(.+\); install it with: pip install .+\n"
    assert re.fullmatch(sentence, done.stdout), done.stdout + done.stderr


# Documented, although they begin with a line: of named tuples, and of the module os.
DOCUMENTED = {"_replace", "_asdict", "_fields", "_field_defaults", "_exit"}


def private_names() -> set[str]:
    """Names of other libraries that begin with a line and that the package uses: modules, and
    attributes that the package does not define itself."""
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    modules, used, own = set(), set(), set()
    for node in nodes:
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.module.startswith("bounce_mjx"):
            modules |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Attribute):
            (own if isinstance(node.ctx, ast.Store) else used).add(node.attr)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            own.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            own.add(node.id)
    modules = {name for name in modules if re.search(r"(^|\.)_[a-z]", name)}
    return modules | {name for name in used - own - DOCUMENTED if re.match("_[a-zA-Z]", name)}


def test_private_names_of_other_libraries_are_listed() -> None:
    """CONTRIBUTING.md lists them all, and none that is gone."""
    text = (CHECKOUT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = text.split("## Private names\n")[1].split("\n## ")[0]
    listed = set(re.findall(r"^\| [^|]+ \| `([^`]+)` \|", section, re.MULTILINE))
    sources = "".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    names = {name.rpartition(".")[2] for name in private_names()}
    assert names <= {name.rpartition(".")[2] for name in listed}
    assert all(name.rpartition(".")[2] in sources for name in listed)


@pytest.mark.slow
def test_a_new_reward_term_is_one_entry_in_one_file(tmp_path: Path) -> None:
    """In a copy of the package, one more term is added to those of bouncing. The config, the
    metrics, the reward, the viewer's bars and the report's figure then have it."""
    copy = tmp_path / "src" / "bounce_mjx"
    shutil.copytree(CHECKOUT / "src" / "bounce_mjx", copy)
    for folder in ("mjcf", "configs"):
        shutil.copytree(CHECKOUT / folder, tmp_path / folder)
    rewards = copy / "tasks" / "bounce_rewards.py"
    term = """
class SpinReward(RewardTerm):
    weight: Finite = -0.5
    offset: Finite = 3.0

    def value(self, inputs: RewardInputs) -> jax.Array:
        return inputs.vz - self.offset


class BounceReward(StrictModel):
"""
    source = rewards.read_text(encoding="utf-8")
    assert source.count("class BounceReward(StrictModel):\n") == 1
    source = source.replace("class BounceReward(StrictModel):\n", term)
    source += "    spin: SpinReward = SpinReward()\n"
    rewards.write_text(source, encoding="utf-8")
    script = """
import jax
import numpy as np
from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.reports.curves import Group, LoggedCurve, RunCurves
from bounce_mjx.reports.figures import image, rewards_figure
from bounce_mjx.viewers.browser import reward_bars
from bounce_mjx.task import term_names
from bounce_mjx.tasks.bounce_rewards import BounceReward
TERM_NAMES = term_names(BounceReward)
env = BounceBall(EnvConfig(reward={"spin": {"offset": 4.0}}))
state = jax.jit(env.step)(jax.jit(env.reset)(jax.random.PRNGKey(0)), jax.numpy.zeros(6))
terms = {k: v for k, v in state.metrics.items() if k.startswith("reward/")}
print(bool(abs(sum(terms.values()) - state.reward) < 1e-4), len(terms) == len(TERM_NAMES))
expected = -0.5 * (state.pipeline_state.physics.qvel[8] - 4.0)
print(bool(abs(terms["reward/spin"] - expected) < 1e-5))
print(reward_bars({name: 1.0 for name in TERM_NAMES}).count("spin"))
curve = LoggedCurve(np.arange(3), np.arange(3.0))
run = RunCurves("run", {f"reward/{name}": curve for name in TERM_NAMES}, None)
figure = rewards_figure([Group("group", [run])])
titles = [axes.get_title() for axes in figure.axes]
print(sorted(title.replace(" ", "_") for title in titles) == sorted(TERM_NAMES), len(titles))
print(len(image(figure, "png")) > 1000)
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "src")},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["True True", "True", "1", "True 16", "True"]


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


def test_wheel_has_the_console_script(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith("/entry_points.txt")]
        text = archive.read(name).decode()
    assert text.split() == ["[console_scripts]", "bounce-mjx", "=", "bounce_mjx.commands.main:main"]


@pytest.mark.parametrize(
    ("page", "number", "printed", "needs"),
    [
        ("README.md", 0, "(64, 29) ", None),
        pytest.param(
            "docs/libraries.md",
            0,
            "(29,) (480, 640, 3) (64, 29)\n",
            "opengl",
            marks=pytest.mark.slow,
        ),
        ("docs/libraries.md", 1, "torch.Size([64, 29]) ", "torch_libraries"),
        ("docs/libraries.md", 2, "(64, 29) 0", None),
    ],
    ids=["jax", "gymnasium", "torch", "brax"],
)
def test_example_of_a_page_runs(page, number, printed, needs, request, capsys):
    """The first examples for each kind of user run unchanged."""
    if needs:
        request.getfixturevalue(needs)
    text = (CHECKOUT / page).read_text(encoding="utf-8")
    example = text.split("```python\n")[1 + number].split("```")[0]
    exec(compile(example, page, "exec"), {})
    assert capsys.readouterr().out.startswith(printed)
