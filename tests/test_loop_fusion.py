"""XLA joins loops on a CPU in every command whose engine allows it, unless the user decides."""

import os
from pathlib import Path

import pytest

from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import default_preset, read_preset
from bounce_mjx.tasks.bounce import BounceConfig as EnvConfig
from bounce_mjx.training.setup import JOINED_LOOPS, join_loops


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


def test_the_presets_of_all_machines_have_one_task() -> None:
    """So the engine is known before it is known whether there is an accelerator."""
    one, other = (read_preset(default_preset(accelerator)) for accelerator in (True, False))
    assert one.env == other.env
