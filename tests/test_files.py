"""Files are written whole and never through a link, and compiled programs are kept."""

from pathlib import Path

import jax
import pytest

from bounce_mjx.files import new_file
from bounce_mjx.runs.files import write_atomically, write_output
from bounce_mjx.training.setup import cache_compilations


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


def test_an_unfinished_file_leaves_the_old_one(tmp_path: Path, victim: Path) -> None:
    with pytest.raises(KeyboardInterrupt), new_file(victim) as new:
        new.write_text("half")
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["victim"]
    assert victim.read_text() == "mine"


@pytest.mark.parametrize("free", [True, False])
def test_compiled_programs_are_kept(free: bool, tmp_path: Path, monkeypatch, capsys) -> None:
    """A file in the folder's place is left alone: a warning says that nothing is cached."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if not free:
        (tmp_path / "bounce_mjx").touch()
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        cache_compilations()
        used = jax.config.jax_compilation_cache_dir
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    said = capsys.readouterr().err
    if free:
        assert (used, said) == (str(tmp_path / "bounce_mjx/jax"), "")
    else:
        assert used is None and said.count("\n") == 1
        assert said.startswith("warning: compiled programs are not cached, as ")
        assert f"{tmp_path}/bounce_mjx" in said
