"""Files are written whole and never through a link, and a cache is private to its user."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from bounce_mjx.files import new_file, private_folder, read_regular
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


def test_a_pipe_that_the_user_names_stays_one() -> None:
    read, write = os.pipe()
    write_output(Path(f"/dev/fd/{write}"), "results")
    assert os.read(read, 100) == b"results"
    os.close(read)
    os.close(write)


def test_regular_files_of_a_limited_length_are_read(tmp_path: Path, victim: Path) -> None:
    (tmp_path / "link").symlink_to(victim)
    assert read_regular(tmp_path / "link", 4) == b"mine"
    with pytest.raises(ValueError, match="longer than 3 bytes"):
        read_regular(victim, 3)
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(ValueError, match="not a regular file"):
            read_regular(path, 4)


def test_a_private_folder_is_for_its_user_alone(tmp_path: Path, monkeypatch) -> None:
    folder = tmp_path / "a/b"
    for _ in range(2):
        assert private_folder(folder) == folder
        assert folder.stat().st_mode & 0o777 == 0o700
        folder.chmod(0o755)
    for path in (tmp_path / "link", tmp_path / "file"):
        path.symlink_to(folder) if path.name == "link" else path.touch()
        with pytest.raises(OSError, match="it is a link or a file"):
            private_folder(path)
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    with pytest.raises(OSError, match="it belongs to another user"):
        private_folder(folder)
    assert folder.stat().st_mode & 0o777 == 0o755


def test_a_system_without_locks_and_user_numbers(tmp_path: Path) -> None:
    """As on Windows: the modules are imported anew without `fcntl` and `os.getuid`."""
    script = f"""
import os, sys
from pathlib import Path
sys.modules["fcntl"] = None
del os.getuid
from bounce_mjx.files import private_folder
from bounce_mjx.runs.lock import lock_run
run = private_folder(Path({str(tmp_path)!r}) / "run")
with lock_run(run), lock_run(run):
    print("two writers")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout == "two writers\n", done.stderr


@pytest.mark.parametrize("linked", [None, "bounce_mjx", "bounce_mjx/jax"])
def test_compiled_programs_are_kept_in_a_private_folder(
    linked: str | None, tmp_path: Path, monkeypatch, capsys
) -> None:
    """A link in its place is left alone: a warning says that nothing is cached."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder, target = tmp_path / "cache/bounce_mjx/jax", tmp_path / "target"
    if linked is not None:
        target.mkdir(mode=0o755)
        (tmp_path / "cache" / linked).parent.mkdir(parents=True)
        (tmp_path / "cache" / linked).symlink_to(target)
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        cache_compilations()
        used = jax.config.jax_compilation_cache_dir
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    said = capsys.readouterr().err
    if linked is None:
        assert (used, said) == (str(folder), "")
        assert {p.stat().st_mode & 0o777 for p in (folder, folder.parent)} == {0o700}
    else:
        assert used is None
        assert said.startswith("warning: compiled programs are not cached, as ")
        assert said.count("\n") == 1 and f"{tmp_path}/cache/{linked}" in said
        assert not list(target.iterdir()) and target.stat().st_mode & 0o777 == 0o755
