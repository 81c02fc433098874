"""XLA joins loops on a CPU in every command whose engine allows it, unless the user decides."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import default_preset, read_preset
from bounce_mjx.tasks.bounce import BounceConfig as EnvConfig
from bounce_mjx.training.setup import JOINED_LOOPS, join_loops


def without_flags() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}


@pytest.fixture(scope="module")
def rk4(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped model with an integrator that only MJX has."""
    path = tmp_path_factory.mktemp("model") / "rk4.xml"
    text = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
    changed = text.replace('integrator="implicitfast"', 'integrator="RK4"')
    assert changed != text
    path.write_text(changed, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("user", "joined"),
    [
        (None, JOINED_LOOPS),
        ("", ""),
        ("--xla_cpu_enable_fast_math=false", f"--xla_cpu_enable_fast_math=false {JOINED_LOOPS}"),
        ("--xla_backend_extra_options=a", "--xla_backend_extra_options=a"),
        ("flags.txt", "flags.txt"),
    ],
)
def test_the_engine_decides_unless_the_user_does(
    rk4: Path, monkeypatch, user: str | None, joined: str
) -> None:
    def flags(*configs: EnvConfig) -> str | None:
        monkeypatch.delenv("XLA_FLAGS", raising=False)
        if user is not None:
            monkeypatch.setenv("XLA_FLAGS", user)
        join_loops(*configs)
        return os.environ.get("XLA_FLAGS")

    fused, chosen = EnvConfig(), EnvConfig(physics="fused")
    mjx, falls_to_mjx = EnvConfig(physics="mjx"), EnvConfig(mjcf=rk4)
    for configs in ((fused,), (chosen,), (fused, chosen)):
        assert flags(*configs) == joined
    for configs in ((mjx,), (falls_to_mjx,), (fused, mjx), (chosen, falls_to_mjx)):
        assert flags(*configs) == user


# Ends the command where it would start JAX's devices.
COMMAND = """
import os, sys
import jax
from jax._src import xla_bridge
from bounce_mjx.commands.main import main
def devices(*_, **__):
    print("flags:", os.environ.get("XLA_FLAGS"), flush=True)
    os._exit(0)
xla_bridge.backends = devices
main(sys.argv[1:])
"""


@pytest.mark.parametrize(
    ("command", "joins"),
    [
        ("train", True),
        ("train --mjcf {rk4}", False),
        ("eval pretrained --physics mjx", False),
        pytest.param("train --config {run}/config.yaml", False, marks=pytest.mark.slow),
        pytest.param("play pretrained --html {run}/page.html", True, marks=pytest.mark.slow),
    ],
)
def test_each_command_decides_before_jax_starts_its_devices(
    command: str, joins: bool, rk4: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(resource_path("pretrained"), run)
    config = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
    config["env"]["physics"] = "mjx"
    (run / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    words = command.format(rk4=rk4, run=run)
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, *words.split()],
        env=without_flags(),
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert f"flags: {JOINED_LOOPS if joins else None}" in done.stdout, done.stdout + done.stderr


def test_the_presets_of_all_machines_have_one_task() -> None:
    """So the engine is known before it is known whether there is an accelerator."""
    one, other = (read_preset(default_preset(accelerator)) for accelerator in (True, False))
    assert one.env == other.env
