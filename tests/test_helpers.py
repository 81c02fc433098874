"""Processes that take over a part of a training's start. This needs no GPU."""

import os
import re
import subprocess
import sys
import sysconfig
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import bounce_mjx
from bounce_mjx.config.validation import validate
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.folders import latest_checkpoint
from bounce_mjx.training import helper_process, helpers
from bounce_mjx.training.helpers import Helpers, start_helpers
from tiny_runs import TINY, arrays, job

ROOT = Path(bounce_mjx.__file__).parent.parent.parent

# A training on a CPU, where there are no kernels, as on a machine with a GPU.
HELPED = """
import sys
import jax
from bounce_mjx.commands.train import main
from bounce_mjx.training import helper_process, helpers
helped = "--helped" in sys.argv
helpers._are_of_use = lambda: helped
helpers._WORK = (helpers.EVALUATION,)
started, traced = [], []
start = helpers._start
helpers._start = lambda *arguments: started.append(arguments[0]) or start(*arguments)
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, fun_name="", **__: traced.append(fun_name) if "jaxpr_trace" in event else None
)
sys.argv = [word for word in sys.argv if word != "--helped"]
"""


def test_a_helper_compiles_the_evaluation_of_a_first_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It leaves the program that the training itself would compile: evaluations are the same. A
    note tells the next start of the same command that it needs no helper."""
    script = tmp_path / "train_jax.py"
    script.write_text(
        HELPED
        + "main()\n"
        + 'print("helpers:", *started)\n'
        + 'print("traced:", *sorted({"train_block", "evaluate"} & set(traced)))\n'
    )

    def start(name: str, cache: str, *flags: str) -> tuple[str, str, dict[str, np.ndarray], str]:
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / cache))
        monkeypatch.setenv("BOUNCE_MJX_HELPERS", "on")
        log_dir = tmp_path / name
        flags = [*TINY, "--total-steps", "64", "--no-report", "--log-dir", log_dir, *flags]
        with job(tmp_path / f"{name}.log", *flags, script=script) as process:
            assert process.wait() == 0, process.said
        (started,) = re.findall(r"^helpers:(.*)$", process.said, re.MULTILINE)
        (traced,) = re.findall(r"^traced:(.*)$", process.said, re.MULTILINE)
        (run,) = log_dir.iterdir()
        results = re.sub(r'"seconds".*', "", (run / "results.json").read_text(), flags=re.DOTALL)
        return started, traced, arrays(latest_checkpoint(run)), results

    first = start("first", "cache", "--helped")
    assert first[:2] == (" evaluation", " train_block")
    assert len(list((tmp_path / "cache" / "starts").iterdir())) == 1
    alone = start("alone", "other")
    assert alone[:2] == ("", " evaluate train_block")
    np.testing.assert_equal(alone[2], first[2])
    assert alone[3] == first[3] and "mean_return" in first[3]


@pytest.fixture
def fake_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Makes the helpers run Python code instead."""

    def use(code: str) -> None:
        script = tmp_path / "helper.py"
        script.write_text(f"import json, sys, time\n{code}")

        def start(*_: str) -> subprocess.Popen:
            pipe = subprocess.PIPE
            return subprocess.Popen([sys.executable, script], stdin=pipe, stdout=pipe, text=True)

        monkeypatch.setattr(helpers, "_start", start)

    return use


FILES = "print(json.dumps({'files': FILES}), flush=True)\nsys.stdin.readline()\n"
KERNEL = "print(json.dumps({'name': 'a', 'attributes': {'module': 'AAE=', 'b': True}}), flush=True)"


@pytest.mark.parametrize(
    ("files", "then", "given"),
    [
        ("own", KERNEL, {"module": b"\0\1", "b": True}),
        ("own", "", None),
        ("own", "raise ValueError", None),
        ("own", "print('no JSON', flush=True)\ntime.sleep(600)", None),
        # The training's process has imported a module that the helpers have not.
        ("others", KERNEL + "\ntime.sleep(600)", None),
    ],
)
def test_a_kernel_comes_from_a_helper_or_from_nowhere(
    fake_process, tmp_path: Path, files: str, then: str, given: dict | None
) -> None:
    listed = helpers.module_files() if files == "own" else ["other.py"]
    fake_process(FILES.replace("FILES", repr(listed)) + then)
    started = Helpers(tmp_path / "note")
    try:
        started.begin(validate(TrainConfig, {}, "test"))
        assert started.wait_for("sums", "a") == given
        started.wait_for_evaluation()
    finally:
        started.close()
    assert started.wait_for("sums", "b") is None and not started.lowers("sums")


@pytest.mark.parametrize(("modes", "alone"), [((0, 0), False), ((0, 3), True), (None, False)])
def test_a_gpu_for_one_process_is_left_to_the_training(
    monkeypatch: pytest.MonkeyPatch, modes: tuple[int, ...] | None, alone: bool
) -> None:
    """A stand-in for NVIDIA's library, whose functions return 0 where they succeed."""

    class Library:
        def __init__(self, _: str):
            if modes is None:
                raise OSError("no library")

        def nvmlInit_v2(self) -> int:
            return 0

        def nvmlDeviceGetCount_v2(self, count) -> int:
            count._obj.value = len(modes)
            return 0

        def nvmlDeviceGetHandleByIndex_v2(self, index: int, device) -> int:
            device._obj.value = index + 1
            return 0

        def nvmlDeviceGetComputeMode(self, device, mode) -> int:
            mode._obj.value = modes[device.value - 1]
            return 0

    monkeypatch.setattr(helper_process.ctypes, "CDLL", Library)
    assert helper_process.admits_one_process() == alone


def test_helpers_end_with_the_training(fake_process, tmp_path: Path) -> None:
    fake_process("sys.stdin.readline()\ntime.sleep(600)")
    started = Helpers(tmp_path / "note")
    started.begin(validate(TrainConfig, {}, "test"))
    assert started.lowers("elementwise") and not started.lowers("other")
    started.close()
    started.wait_for_evaluation()
    assert all(process.poll() is not None for process in started._processes.values())


def test_a_helper_that_hangs_is_given_up(fake_process, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(helpers, "_PATIENCE", 0.1)
    fake_process("time.sleep(600)")
    started = Helpers(tmp_path / "note")
    try:
        started.begin(validate(TrainConfig, {}, "test"))
        assert started.wait_for("sums", "a") is None
        started.wait_for_evaluation()
        assert started._processes[helpers.EVALUATION].poll() is not None
    finally:
        started.close()


def test_a_helper_ends_when_the_training_has_died() -> None:
    started = [helpers._start(*work) for work in helpers._WORK[2:]]
    for process in started:
        process.stdin.close()
        assert process.wait(60) != 0


class TestStart:
    """`start_helpers` on a machine that seems to have a GPU, for the command `train_jax.py`."""

    @pytest.fixture(autouse=True)
    def gpu(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
        monkeypatch.setattr(helpers.importlib.util, "find_spec", lambda name: "jax_plugins" in name)
        monkeypatch.setattr(
            helpers.os, "sched_getaffinity", lambda _: set(range(16)), raising=False
        )
        monkeypatch.setattr(helpers, "Helpers", lambda note: note)
        for name in ("JAX_PLATFORMS", "BOUNCE_MJX_HELPERS"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
        self.run_as(monkeypatch, ROOT / "train_jax.py", main=None, refuse=None, sys=sys)

    @staticmethod
    def run_as(monkeypatch: pytest.MonkeyPatch, script: Path, **names: object) -> None:
        main = ModuleType("__main__")
        vars(main).update(names, __file__=str(script))
        monkeypatch.setitem(sys.modules, "__main__", main)

    def test_it_starts_them(self) -> None:
        assert start_helpers([]) is not None

    @pytest.mark.parametrize(
        "script",
        [
            ROOT / "src" / "bounce_mjx" / "train.py",
            Path(sysconfig.get_path("scripts"), "bounce-mjx"),
        ],
    )
    def test_other_names_of_the_command(self, script: Path, monkeypatch) -> None:
        self.run_as(monkeypatch, script)
        assert start_helpers([]) is not None

    @pytest.mark.parametrize(
        ("script", "names"),
        [
            ("notebook.py", {}),
            (ROOT / "train_jax.py", {"my_term": None}),
            ("train_jax.py", {}),
        ],
    )
    def test_a_user_program_may_have_changed_the_package(
        self, script: Path, names: dict, monkeypatch, tmp_path: Path
    ) -> None:
        self.run_as(monkeypatch, tmp_path / script, **names)
        assert start_helpers([]) is None
        monkeypatch.setenv("BOUNCE_MJX_HELPERS", "on")
        assert start_helpers([]) is not None

    @pytest.mark.parametrize(
        ("name", "value", "starts"),
        [
            ("JAX_PLATFORMS", "cpu", False),
            ("JAX_PLATFORMS", "cuda,cpu", True),
            ("BOUNCE_MJX_HELPERS", "off", False),
        ],
    )
    def test_variables(self, name: str, value: str, starts: bool, monkeypatch) -> None:
        monkeypatch.setenv(name, value)
        assert (start_helpers([]) is not None) == starts

    def test_too_few_cores(self, monkeypatch) -> None:
        monkeypatch.setattr(helpers.os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
        assert start_helpers([]) is None

    def test_no_gpu(self, monkeypatch) -> None:
        monkeypatch.setattr(helpers.importlib.util, "find_spec", lambda _: None)
        assert start_helpers([]) is None

    def test_a_deleted_working_folder(self, monkeypatch, tmp_path: Path) -> None:
        monkeypatch.setattr(helpers.os, "getcwd", Path(tmp_path / "missing").stat)
        assert start_helpers([]) is None

    def test_programs_that_are_kept(self, tmp_path: Path) -> None:
        """The note of one command line holds for those that compile the same programs."""
        config = tmp_path / "mine.yaml"
        config.write_text("ppo: {num_envs: 64}")
        args = ["--config", str(config), "--seed", "1", "--stop-when-solved", "--robot=ur5e"]
        note = start_helpers(args)
        note.parent.mkdir(parents=True)
        note.touch()
        assert start_helpers(args) is None
        same = ["--config", str(config), "--log-dir=runs", "--robot=ur5e", "--total_steps", "9"]
        assert start_helpers(same) is None
        assert start_helpers([*args, "--num-envs", "128"]) is not None
        config.write_text("ppo: {num_envs: 128}")
        os.utime(config, (1.0, 1.0))
        assert start_helpers(args) is not None
