"""Files are written whole and never through a link; compiled programs are kept, and their loops are
joined where the engine allows it, unless the user decides."""

import os
import pwd
from pathlib import Path

import jax
import pytest

from bounce_mjx.errors import UserError
from bounce_mjx.resources import resource_path
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.runs.presets import default_preset
from bounce_mjx.runs.storage import check_output, new_file, write_atomically, write_output
from bounce_mjx.task.bounce import Config as EnvConfig
from bounce_mjx.training.setup import JOINED_LOOPS, cache_compilations, join_loops


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A file outside of the folder in which files are written."""
    path = tmp_path / "victim"
    path.write_text("mine")
    return path


@pytest.mark.parametrize("write", [write_atomically, write_output])
def test_nothing_is_written_through_a_link(tmp_path: Path, victim: Path, write) -> None:
    """Neither the file's own name nor a name that an unfinished file may have leads elsewhere."""
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("results.json", "results.json.partial", ".unfinished-results.json"):
        (folder / name).symlink_to(victim)
    write(folder / "results.json", "new")
    assert victim.read_text() == "mine"
    assert not (folder / "results.json").is_symlink()
    assert (folder / "results.json").read_text() == "new"


def test_what_could_not_be_written_is_refused_before_the_work(tmp_path: Path, monkeypatch) -> None:
    """A file is replaced by a new one in its folder, so that both must be writable."""
    file = tmp_path / "results.json"
    file.write_text("{}")
    denied: list[Path] = []
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) not in denied)
    check_output(file, "--json")
    for denied[:] in ([tmp_path], [file]):
        with pytest.raises(UserError, match=f"--json: {denied[0]} may not be written; give"):
            check_output(file, "--json")
    with pytest.raises(UserError, match="is a folder; give a file"):
        check_output(tmp_path, "--json")
    # A device is written itself.
    denied[:] = [Path("/dev")]
    check_output(Path("/dev/null"), "--json")


def test_a_page_may_name_a_path_that_is_not_utf_8(tmp_path: Path) -> None:
    write_output(tmp_path / "page.html", os.fsdecode(b"run \xff"))
    assert (tmp_path / "page.html").read_text() == "run ?"


def test_an_unfinished_file_leaves_the_old_one(tmp_path: Path, victim: Path) -> None:
    with pytest.raises(KeyboardInterrupt), new_file(victim) as new:
        new.write_text("half")
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["victim"]
    assert victim.read_text() == "mine"


@pytest.mark.parametrize("has_home", [True, False])
def test_compiled_programs_are_kept(has_home: bool, tmp_path: Path, monkeypatch) -> None:
    """Not for a user without a home, as a number without a name in a container."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path) if has_home else "")
    if not has_home:
        monkeypatch.delenv("HOME", raising=False)
        monkeypatch.setattr(pwd, "getpwuid", {}.__getitem__)
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        cache_compilations()
        used = jax.config.jax_compilation_cache_dir
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    assert used == (str(tmp_path / "bounce_mjx/jax") if has_home else None)


def shipped_model(path: Path, text: str, changed: str) -> Path:
    """Writes the shipped model with another text in it to a path."""
    model = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
    assert text in model
    path.write_text(model.replace(text, changed), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def rk4(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped model with an integrator that only MJX has."""
    path = tmp_path_factory.mktemp("model") / "rk4.xml"
    return shipped_model(path, 'integrator="implicitfast"', 'integrator="RK4"')


@pytest.fixture(scope="module")
def elliptic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped model with elliptic cones, which MuJoCo's own friction has alone."""
    path = tmp_path_factory.mktemp("model") / "elliptic.xml"
    return shipped_model(path, 'cone="pyramidal"', 'cone="elliptic"')


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
    rk4: Path, elliptic: Path, monkeypatch, user: str | None, joined: str
) -> None:
    def flags(*configs: EnvConfig) -> str | None:
        monkeypatch.delenv("XLA_FLAGS", raising=False)
        if user is not None:
            monkeypatch.setenv("XLA_FLAGS", user)
        join_loops(*configs)
        return os.environ.get("XLA_FLAGS")

    fused, chosen = EnvConfig(), EnvConfig(physics="fused")
    mjx, falls_to_mjx = EnvConfig(physics="mjx"), EnvConfig(mjcf=rk4)
    without, with_friction = EnvConfig(mjcf=elliptic), EnvConfig(mjcf=elliptic, friction=0.3)
    for configs in ((fused,), (chosen,), (fused, chosen), (without,), (without, with_friction)):
        assert flags(*configs) == joined
    for configs in ((mjx,), (falls_to_mjx,), (fused, mjx), (chosen, falls_to_mjx)):
        assert flags(*configs) == user


def test_the_presets_of_all_machines_have_one_task() -> None:
    """So the engine is known before it is known whether there is an accelerator."""
    one, other = (read_preset(default_preset(accelerator)) for accelerator in (True, False))
    assert one.env == other.env
