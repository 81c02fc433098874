"""The console script: its commands, its help, what it imports, and Ctrl-C while it starts."""

import email.message
import importlib.metadata
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml

import bounce_mjx
from bounce_mjx import lazy
from bounce_mjx.commands import main as console_script
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.interrupt import StopRequest
from tiny_runs import settings_of

CHECKOUT = Path(__file__).parent.parent


def test_help_lists_the_commands(capsys) -> None:
    console_script.main(["--help"])
    text = capsys.readouterr().out
    assert re.findall(r"^  ([\w-]+) +\w", text, re.MULTILINE) == list(console_script.COMMANDS)
    console_script.main([])
    assert capsys.readouterr().out == text
    readme = (CHECKOUT / "README.md").read_text(encoding="utf-8")
    (listed,) = re.findall(r"`bounce-mjx ((?:[a-z-]+\|)+[a-z-]+)`", readme)
    assert sorted(listed.split("|")) == sorted(console_script.COMMANDS)


@pytest.mark.parametrize(("args", "status"), [(["--help"], 0), (["evl"], 2)])
def test_an_output_that_cannot_be_written_is_dropped(args: list[str], status: int) -> None:
    """To a reader that has ended, such as head; a mistake is said on stderr."""
    command = [sys.executable, "-m", "bounce_mjx", *args]
    read, output = os.pipe()
    os.close(read)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    streams["stderr" if status else "stdout"] = output
    done = subprocess.run(command, **streams, text=True)
    os.close(output)
    assert done.returncode == status
    assert not done.stderr and not done.stdout


def test_a_device_on_which_jax_does_not_start_is_named(monkeypatch, capsys) -> None:
    """Also where a checkpoint could therefore not be read."""
    monkeypatch.setenv("JAX_PLATFORMS", "nope")
    for wrap in (False, True):
        with pytest.raises(SystemExit) as exit_info, exit_on_user_error():
            try:
                raise RuntimeError("Unable to initialize backend 'nope': it is not known")
            except RuntimeError as error:
                if wrap:
                    raise UserError("the checkpoint is damaged") from error
                raise
        assert exit_info.value.code == 2
        sentence = capsys.readouterr().err
        assert sentence.startswith("error: JAX does not start on JAX_PLATFORMS=nope (Unable to")
        assert sentence.endswith("; unset it, or name platforms of this machine, such as cpu\n")
    with pytest.raises(RuntimeError, match="another"), exit_on_user_error():
        raise RuntimeError("another")


def test_a_sentence_has_no_codes_that_a_terminal_would_obey(capsys) -> None:
    with pytest.raises(SystemExit), exit_on_user_error():
        raise UserError("there is no run a\x1b]0;title\x07 of\nB\udcff")
    assert capsys.readouterr().err == "error: there is no run a\\x1b]0;title\\x07 of B\\udcff\n"


def test_an_import_of_mjx_drops_its_own_lines_alone(monkeypatch, capsys) -> None:
    """Not those of another thread, and the output is restored also where two threads import."""

    def import_module(name: str) -> str:
        print("Failed to import warp")
        other = threading.Thread(target=print, args=("meanwhile",))
        other.start()
        other.join()
        return name

    monkeypatch.setattr(lazy.importlib, "import_module", import_module)
    threads = [threading.Thread(target=lazy.import_mjx) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print("after")
    assert capsys.readouterr().out == "meanwhile\nmeanwhile\nafter\n"


def test_version(capsys) -> None:
    console_script.main(["--version"])
    assert capsys.readouterr().out == f"bounce_mjx {bounce_mjx.__version__}\n"
    citation = yaml.safe_load((CHECKOUT / "CITATION.cff").read_text(encoding="utf-8"))
    changes = (CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert bounce_mjx.__version__ == citation["version"]
    assert f"\n## [{bounce_mjx.__version__}] - " in changes


def test_doctor_says_what_an_issue_needs(monkeypatch, capsys) -> None:
    """Also where packages are missing and JAX does not start."""
    requires = {
        "bounce_mjx": [
            "numpy>=2",
            "numpy; extra == 'sim'",
            'jax[gpu]<2; (python_version > "3") and extra == "sim"',
            "bounce_mjx[sim]; extra == 'all'",
            "nonesuch; extra == 'all'",
            "needed-without-an-extra; python_version > '3'",
        ],
        "jax": ["nonesuch-plugin>=1; extra == 'gpu'", "numpy; extra == 'cpu'"],
    }
    provided = email.message.Message()
    for extra in ("sim", "all"):
        provided["Provides-Extra"] = extra
    monkeypatch.setattr(importlib.metadata, "requires", requires.get)
    monkeypatch.setattr(importlib.metadata, "metadata", lambda name: provided)
    monkeypatch.setattr(jax, "devices", lambda: (_ for _ in ()).throw(RuntimeError("no\nGPU")))
    monkeypatch.setenv("JAX_TEST_VARIABLE", "3")
    console_script.main(["doctor"])
    first, *lines, last = capsys.readouterr().out.splitlines()
    assert first == last == "```"
    said = dict(line.split(": ", 1) for line in lines)
    assert said["bounce_mjx"].startswith(f"{bounce_mjx.__version__} in ")
    assert f"numpy {np.__version__}" in said["packages"]
    assert said["devices"] == "none (no GPU)"
    assert "JAX_TEST_VARIABLE=3" in said["variables"]
    assert said["extra sim"] == "lacks nonesuch-plugin (pip install 'bounce_mjx[sim]')"
    assert said["extra all"] == "lacks nonesuch-plugin, nonesuch (pip install 'bounce_mjx[all]')"


PYTHON_3_10 = "import sys; sys.version_info = (3, 10, 9, 'final', 0)\n"


@pytest.mark.parametrize(
    ("before", "sentence"),
    [
        (
            "",
            r"error: bounce_mjx is not installed for \S+; run: pip install -e \S+; or use: uv run ",
        ),
        (PYTHON_3_10, "error: Python 3.10 is too old; use 3.11 to 3.13; or use: uv run "),
    ],
    ids=["not installed", "Python 3.10"],
)
def test_script_without_the_package(before: str, sentence: str) -> None:
    script = str(CHECKOUT / "train_jax.py")
    run = f"import runpy; runpy.run_path({script!r}, run_name='__main__')"
    # Isolated from the packages of this environment.
    command = [sys.executable, "-I", "-S", "-c", before + run]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert re.fullmatch(sentence + "train_jax.py\n", done.stderr), done.stderr


# Libraries that read a command line and print its help; the last line has their dependencies.
HELP_NEEDS = set(
    "bounce_mjx pydantic rich yaml annotated_types pydantic_core typing_extensions "
    "typing_inspection".split()
)


def test_each_help_is_light(monkeypatch) -> None:
    """It imports no library that computes, draws or simulates."""
    # Of which MuJoCo is told at once.
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    code = """
import contextlib, io, sys
before = set(sys.modules)
import bounce_mjx
from bounce_mjx import lazy
from bounce_mjx.commands.main import COMMANDS, main
for name in COMMANDS:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        main([name, "--help"])
imported = {name.split(".")[0] for name in set(sys.modules) - before}
print(*sorted(imported - sys.stdlib_module_names))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    imported = set(done.stdout.split())
    libraries = {name for name in imported if not name.startswith(("_", "cython"))}
    assert "bounce_mjx" in libraries and libraries <= HELP_NEEDS


@pytest.mark.parametrize(("given", "level"), [(None, "3"), ("0", "0")])
def test_a_command_hides_the_banner_of_a_slow_compilation(monkeypatch, given, level) -> None:
    """Unless the user chose a level; XLA reads it when JAX is imported."""
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "9")
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL")
    if given is not None:
        monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", given)
    console_script.main(["--version"])
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == level


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
    names = "BounceBall EnvConfig Run __version__ environment import_code load_policy train"
    assert done.stdout.splitlines() == ["False", "fused", names], done.stderr


@pytest.mark.slow
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


# Ctrl-C comes while a library is looked for.
PRESS = """
import os, runpy, signal, sys
from importlib.abc import MetaPathFinder

class Press(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "{moment}":
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

# A process that a shell starts in the background ignores SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Press())
sys.argv[1:] = []
{start}
"""
STARTS = {
    "bounce-mjx eval": "from bounce_mjx.commands.main import main; main(['eval'])",
    "python -m bounce_mjx play": (
        "sys.argv[1:] = ['play']; runpy.run_module('bounce_mjx', run_name='__main__')"
    ),
    "train_jax.py": f"runpy.run_path({str(CHECKOUT / 'train_jax.py')!r}, run_name='__main__')",
}


@pytest.mark.parametrize(
    ("start", "moment"), [*zip(STARTS, ("numpy", "jax", "pydantic"), strict=True)]
)
def test_ctrl_c_while_a_command_is_imported(tmp_path: Path, start: str, moment: str) -> None:
    code = PRESS.format(moment=moment, start=STARTS[start])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True
    )
    # A shell reports it as status 130.
    assert done.returncode == -signal.SIGINT
    assert "Traceback" not in done.stderr, done.stderr
    assert not list(tmp_path.iterdir())


def test_ctrl_c_while_its_handler_changes_is_not_lost() -> None:
    """Python drops a signal that it has seen and that then gets the default action."""
    code = """
import os, signal
from bounce_mjx.interrupt import StopRequest, end_on_ctrl_c
change = signal.signal
def changed(*args):
    os.kill(os.getpid(), signal.SIGINT)
    return change(*args)
signal.signal = changed
change(signal.SIGINT, signal.default_int_handler)
end_on_ctrl_c()
print("lost")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


@pytest.mark.parametrize("is_read", [True, False])
def test_a_slow_reader_of_an_output_that_does_not_block(is_read: bool) -> None:
    """Costs lines, and not the process; a reader that is only late gets every line."""
    code = """
import sys
from bounce_mjx.errors import exit_on_user_error
with exit_on_user_error():
    for i in range(5000):
        print(f"{i:099d}")
print("done", file=sys.stderr)
"""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with os.fdopen(reader, "rb") as lines:
        process = subprocess.Popen(
            [sys.executable, "-c", code], stdout=writer, stderr=subprocess.PIPE
        )
        os.close(writer)
        read = lines.read() if is_read else b""
        assert process.communicate(timeout=60)[1] == b"done\n" and process.returncode == 0
        read += lines.read()
    numbers = [int(line) for line in read.splitlines()]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) == 5000 if is_read else 0 < len(numbers) < 5000


def test_the_innermost_request_receives_the_signal() -> None:
    """A viewer ends, and the command that shows it continues."""
    with StopRequest() as outer:
        with StopRequest() as stop:
            os.kill(os.getpid(), signal.SIGINT)
        assert stop.requested and not outer.requested


USUAL_SPELLINGS = {
    "--stop-when-solved=false": (False, "stop_when_solved"),
    "--total-steps 1e6": (10**6, "total_steps"),
    "--hidden-layers=256,64 --seed 3": ((256, 64), "ppo", "hidden_layers"),
    "--hidden-layers 1e2,64 16": ((100, 64, 16), "ppo", "hidden_layers"),
    "--ball-init-pos=0.5,-0.1,0.4": ((0.5, -0.1, 0.4), "env", "ball_init_pos"),
    "--critic-metrics bounced,apex_error": (("bounced", "apex_error"), "ppo", "critic_metrics"),
    "--log-dir a,b": (Path("a,b"), "log_dir"),
}


@pytest.mark.parametrize("flags", USUAL_SPELLINGS)
def test_usual_spellings_of_flags(flags: str) -> None:
    expected, *path = USUAL_SPELLINGS[flags]
    value = settings_of(flags.split()).config
    for name in path:
        value = getattr(value, name)
    assert value == expected
