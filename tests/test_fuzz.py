"""Config files and command lines of any kind: each gives a valid run or one error sentence, and
never touches the disk. several hundred cases in all."""

import contextlib
import io
import re
from collections.abc import Callable
from pathlib import Path

import pydantic
import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from bounce_mjx.commands import train as train_command
from bounce_mjx.config.files import dump_config
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.runs.config import train_config
from bounce_mjx.tasks.bounce import Bounce
from bounce_mjx.training.command import TrainCommand
from tiny_runs import contents

CONFIG = train_config(Bounce)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory):
    """The working directory of all cases: a preset, a run without a checkpoint, and a file."""
    folder = tmp_path_factory.mktemp("fuzz")
    (folder / "run").mkdir()
    (folder / "run/config.yaml").write_text(dump_config(CONFIG()))
    (folder / "preset.yaml").write_text("seed: 3\n")
    (folder / "fuzzed.yaml").write_bytes(b"")
    with contextlib.chdir(folder):
        yield folder


def cases(number: int) -> Callable:
    """Settings for this number of cases, the same cases in every run."""
    return settings(
        max_examples=number,
        derandomize=True,
        deadline=None,
        database=None,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )


def read(folder: Path, reader: Callable[[], StrictModel]) -> StrictModel | None:
    """The command of a command line; None if one sentence refuses it or if it asks for help."""
    before = contents(folder)
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), exit_on_user_error():
            return reader()
    except SystemExit as end:
        if end.code == 0:
            assert "usage:" in out.getvalue() and not err.getvalue()
        else:
            assert end.code == 2
            if "Missing value for argument" in err.getvalue():
                # In tyro's own box.
                return None
            assert re.fullmatch(r"error: .+\n", err.getvalue()), err.getvalue()
            assert len(err.getvalue()) < 5000
            assert err.getvalue()[:-1].isprintable()
        return None
    finally:
        assert contents(folder) == before


def assert_valid_run(command: TrainCommand) -> None:
    """Checks that the command's config passes the validation again and survives a round trip
    through a file."""
    config = command.training
    again = CONFIG.model_validate(yaml.safe_load(dump_config(config)))
    assert again == config


# Config files

SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(min_value=10**300, max_value=10**301),
    st.floats(),
    st.text(max_size=20),
    st.binary(max_size=20),
    st.dates(),
    st.datetimes(),
    st.sampled_from([0, 1, 2**31, -1, 1e308, 5e-324, float("nan"), "1e400", "~nobody/a", "\0"]),
)
TREES = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=7)
        | st.dictionaries(
            SCALARS | st.sampled_from(["env", "ppo", "seed", "reward"]), inner, max_size=4
        )
    ),
    max_leaves=12,
)


def groups(group: type[pydantic.BaseModel]) -> st.SearchStrategy[dict]:
    """Trees with some of the keys of a config and values of any kind."""
    fields = {}
    for name, field in group.model_fields.items():
        inner = field.annotation
        nested = isinstance(inner, type) and issubclass(inner, pydantic.BaseModel)
        default = field.get_default()
        default = str(default) if isinstance(default, Path) else default
        plausible = st.sampled_from([1, 2, 0.5, [8, 8], default])
        fields[name] = (groups(inner) if nested else plausible) | TREES
    return st.sets(st.sampled_from(sorted(fields)), max_size=4).flatmap(
        lambda names: st.fixed_dictionaries({name: fields[name] for name in sorted(names)})
    )


EXAMPLES = (
    b"",
    b"\xff\xfe\x00",
    b"- 1",
    b"? [1]\n: 2",
    b"<<: 1",
    b"seed: !!int ''",
    b"seed: !!timestamp a",
    b"seed: !!python/object/apply:os.system [touch ran]",
    b"seed: 2001-99-99",
    b"env: &e {env: *e}",
    b"seed: " + b"[" * 5000,
    b"env: {mjcf: ~nobody/a.xml}",
    b"env: {mjcf: ~nobody/a.xml, physics: mjx}",
    b'log_dir: "a\\0b"',
    b'"a\\nb\\e[31m": 1',
    b"env: {control_dt: 1.0e+308, physics_dt: 1.0e-308}",
    b"ppo: {critic_metrics: [[]]}",
)


def read_config(folder: Path, data: bytes) -> None:
    (folder / "fuzzed.yaml").write_bytes(data)
    command = read(folder, lambda: train_command.read_command(["--config", "fuzzed.yaml"]))
    if command is not None:
        assert_valid_run(command)


@pytest.mark.slow
@cases(80)
@given(tree=TREES | groups(CONFIG), style=st.booleans(), unicode=st.booleans())
def test_config_file_of_any_structure(folder: Path, tree, style: bool, unicode: bool) -> None:
    text = yaml.safe_dump(tree, default_flow_style=style, allow_unicode=unicode)
    read_config(folder, text.encode("utf-8", "surrogatepass"))


@pytest.mark.parametrize("data", EXAMPLES, ids=range(len(EXAMPLES)))
def test_config_file_that_once_caused_an_error(folder: Path, data: bytes) -> None:
    read_config(folder, data)


# Command lines
