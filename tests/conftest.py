"""A test of an optional package, of a browser or of OpenGL is skipped with its name where that is
missing. `.ci/run` runs `pytest --passed FILE` as a new clone does, installs the rest, and runs
`pytest --all-but FILE`: what had not passed, and nothing may be missing any more.

All tests and their processes share one cache of compiled programs and one folder of trained runs
(`tiny_runs.shared_run`), which are deleted at the end. XLA joins the loops of the programs, as in
the commands, which halves the compilation.
"""

import collections
import os
import re
import shutil
import signal
import tempfile
import types
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TypeVar

import jax
import mujoco
import pytest

import tiny_runs
from bounce_mjx import BounceBall
from bounce_mjx.commands.main import main
from bounce_mjx.config import user_code
from bounce_mjx.errors import UserError
from bounce_mjx.robot.model import load_model
from bounce_mjx.task.bounce import Config as EnvConfig
from bounce_mjx.training.setup import JOINED_LOOPS
from bounce_mjx.viewers.offscreen import choose_opengl

Report = TypeVar("Report", pytest.TestReport, pytest.CollectReport)

CACHE = "JAX_COMPILATION_CACHE_DIR"
RUNS = "BOUNCE_MJX_TESTS_RUNS"
# A folder that keeps the compiled programs from one run to the next.
KEPT_CACHE = os.environ.get("BOUNCE_MJX_TESTS_CACHE")

# What `.ci/run` does not install.
OF_THE_MACHINE = "needs CUDA", "Python 3.1"


# Before JAX starts its devices.
os.environ.setdefault("XLA_FLAGS", JOINED_LOOPS)
# `uv run pytest` sets it, and the hints of errors would begin with uv.
os.environ.pop("UV_RUN_RECURSION_DEPTH", None)


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("the two passes of .ci/run")
    group.addoption("--passed", metavar="FILE", help="write the names of the tests that pass")
    group.addoption(
        "--all-but",
        metavar="FILE",
        help="leave out the tests that a file names; of the others, a skipped one has failed",
    )


def pytest_configure(config: pytest.Config) -> None:
    # A shell script starts a process in the background with SIGINT ignored, and the processes of
    # the tests about Ctrl-C would inherit that. A command leaves a program's own handler alone.
    signal.signal(signal.SIGINT, lambda *args: signal.default_int_handler(*args))
    # nohup starts one with SIGHUP ignored, which this one still ignores, and its processes do not.
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: None)
    # The workers of pytest-xdist inherit the folders.
    if not hasattr(config, "workerinput"):
        os.environ[RUNS] = tempfile.mkdtemp(prefix="bounce_mjx_runs_")
        os.environ[CACHE] = KEPT_CACHE or tempfile.mkdtemp(prefix="bounce_mjx_tests_")
        if config.option.passed is not None:
            config.pluginmanager.register(Passed(Path(config.option.passed)))
    jax.config.update("jax_compilation_cache_dir", os.environ[CACHE])


class Passed:
    """Writes the names of the tests that pass into a file, a line each."""

    def __init__(self, path: Path):
        self._path = path
        self._names: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" and report.passed:
            self._names.append(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        self._path.write_text("\n".join(self._names), encoding="utf-8")


def pytest_unconfigure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):
        for folder in {os.environ[RUNS], os.environ[CACHE]} - {KEPT_CACHE}:
            shutil.rmtree(folder, ignore_errors=True)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Long files come first, so that the processes end at about the same time; a slow test counts
    as ten. What `--all-but` names is left out."""
    if config.option.all_but is not None:
        passed = set(Path(config.option.all_but).read_text("utf-8").splitlines())
        config.hook.pytest_deselected(items=[item for item in items if item.nodeid in passed])
        items[:] = [item for item in items if item.nodeid not in passed]
    weights = collections.Counter()
    for item in items:
        weights[item.path] += 10 if item.get_closest_marker("slow") else 1
    items.sort(key=lambda item: -weights[item.path])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    return _complete(report, item.config)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report = yield
    return _complete(report, collector.config)


def _complete(report: Report, config: pytest.Config) -> Report:
    """The report; with `--all-but` a skipped test or file has failed, except for what is of the
    machine."""
    if config.option.all_but is not None and report.skipped:
        *_, reason = report.longrepr
        if not any(words in reason for words in OF_THE_MACHINE):
            report.outcome = "failed"
            report.longrepr = f"nothing may be missing here: {reason}"
    return report


@pytest.fixture(autouse=True)
def _no_code_of_another_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a process of a user's, two files may not have classes of one name."""
    monkeypatch.setattr(user_code, "_code_files", {})
    monkeypatch.setattr(user_code, "_command", [])


@pytest.fixture
def float64() -> Iterator[None]:
    """Runs the whole test in float64."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def quick_compilation() -> Iterator[None]:
    """`tiny_runs.quick_compilation` of the whole test."""
    with tiny_runs.quick_compilation():
        yield


@pytest.fixture(scope="session")
def mj_model() -> mujoco.MjModel:
    """The shipped model at the default time step."""
    return load_model(None, EnvConfig().physics_dt)


@pytest.fixture(scope="session")
def env() -> BounceBall:
    return BounceBall()


@pytest.fixture(scope="session")
def trained() -> Path:
    """The folder of a run of 256 steps, for reading alone."""
    return tiny_runs.shared_run()


@pytest.fixture
def refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """A function (command line, words) -> the sentence with which `bounce-mjx` refuses the command
    line, in which the words are. It leaves the working directory `tmp_path` as it is."""
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)

    def refuse(line: str | list, *words: str) -> str:
        before = tiny_runs.contents(tmp_path)
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main(line.split() if isinstance(line, str) else [str(word) for word in line])
        said, sentence = capfd.readouterr()
        assert ended.value.code == 2 and "Traceback" not in said
        assert re.fullmatch(r"error: .+\n", sentence) and sentence[:-1].isprintable(), sentence
        assert not [word for word in words if word not in sentence], sentence
        assert tiny_runs.contents(tmp_path) == before
        return sentence

    return refuse


@pytest.fixture(scope="session")
def need() -> Callable[[str], types.ModuleType]:
    """Imports an optional package, without which it skips the test."""
    return pytest.importorskip


@pytest.fixture(scope="session")
def torch_libraries() -> None:
    for name in ("torch", "rsl_rl", "skrl"):
        pytest.importorskip(name)


@pytest.fixture(scope="session")
def opengl() -> None:
    """A library that can draw without a screen."""
    try:
        choose_opengl()
    except UserError as error:
        pytest.skip(str(error))
