"""Checkpoints are plain data that orbax alone reads; each loads unchanged or is refused in one
sentence."""

import os
import pickle
import random
import resource
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

import bounce_mjx
from bounce_mjx.deploy.export import export_onnx
from bounce_mjx.env.bounce_ball import BounceBall
from bounce_mjx.errors import UserError, warn_once
from bounce_mjx.evaluation.results import Report, Result
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy
from bounce_mjx.learning.ppo import PPO, TrainingState, policy_of
from bounce_mjx.runs import checkpoints, storage
from bounce_mjx.runs.checkpoints import read_policy, read_training, save_checkpoint
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.creation import create_run
from bounce_mjx.runs.folders import (
    best_checkpoint,
    find_checkpoint,
    latest_checkpoint,
    stored_checkpoints,
)
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.runs.records import verify
from bounce_mjx.task.bounce import Config as BounceConfig

OBSERVATION = BounceConfig().layout

CONFIG = TrainConfig(
    ppo=PPOConfig(num_envs=8, rollout_length=8, num_minibatches=2, hidden_layers=(16,))
)


@pytest.fixture(scope="module")
def state() -> TrainingState:
    """A state of the right shapes with random numbers."""
    trainer = PPO(CONFIG.ppo, BounceBall(CONFIG.env), CONFIG.env.episode_steps)
    shapes, rng = jax.eval_shape(trainer.init, jax.random.PRNGKey(0)), np.random.default_rng(0)
    return jax.tree.map(lambda x: jnp.asarray(100.0 * rng.random(x.shape), x.dtype), shapes)


def items_of(state: TrainingState) -> dict:
    return {"policy": policy_of(state, OBSERVATION.size), "training": state}


def write_run(folder: Path, state: TrainingState, steps: int = 64) -> Path:
    run = create_run(CONFIG.model_copy(update={"log_dir": folder}))
    progress = {"best": None, "best_steps": 0, "solved_steps": None, "evaluations": []}
    save_checkpoint(run, CONFIG, steps, items_of(state), progress)
    return run


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, state: TrainingState) -> Path:
    return write_run(tmp_path_factory.mktemp("written"), state)


@pytest.fixture
def run(written: Path, tmp_path: Path) -> Path:
    """Copy of the run for a test to damage."""
    return shutil.copytree(written, tmp_path / "run")


def step_of(run: Path) -> Path:
    return run / "checkpoints/64"


def load_both(run: Path, state: TrainingState) -> tuple[Policy, TrainingState]:
    """Loads the policy like `eval`, and the whole state like `--resume`."""
    checkpoint = find_checkpoint(run)
    policy = read_policy(checkpoint, load_run_config(run))
    template = jax.eval_shape(lambda: state)
    return policy, read_training(checkpoint, template)[0]


def assert_identical(a, b) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


def test_what_is_written_is_read(run: Path, state: TrainingState) -> None:
    assert_identical(load_both(run, state), (policy_of(state, OBSERVATION.size), state))


def test_orbax_alone_reads_a_checkpoint(written: Path, state: TrainingState) -> None:
    folder, policy = step_of(written), policy_of(state, OBSERVATION.size)
    with ocp.CheckpointManager(folder.parent.absolute()) as manager:
        wanted = ocp.args.Composite(
            policy=ocp.args.StandardRestore(), record=ocp.args.JsonRestore()
        )
        found = manager.restore(int(folder.name), args=wanted)
    assert found["record"]["steps"] == int(folder.name)
    expected, theirs = (
        {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
        for leaves in map(jax.tree_util.tree_leaves_with_path, (policy, found["policy"]))
    )
    assert theirs.keys() == expected.keys()
    for name, leaf in expected.items():
        np.testing.assert_array_equal(theirs[name], leaf)


def report_of(mean_return: float) -> Report:
    return Report((Result("stable", "%", 0.0, ">= 99", False),), {"mean_return": mean_return})


def test_the_newest_checkpoint_and_the_one_that_is_named_are_kept(tmp_path: Path, state) -> None:
    run, items = create_run(CONFIG.model_copy(update={"log_dir": tmp_path})), items_of(state)
    stored = []
    for steps, kept in ((10, ()), (20, [10]), (20, [10]), (30, [21]), (40, ())):
        number = save_checkpoint(run, CONFIG, steps, items, kept=kept)
        stored.append(sorted(checkpoint.number for checkpoint in stored_checkpoints(run)))
        newest = latest_checkpoint(run)
        assert newest.number == number == stored[-1][-1]
        assert newest.steps == verify(newest).steps == steps
    assert stored == [[10], [10, 20], [10, 21], [21, 30], [40]]
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["40"]


def test_a_checkpoint_that_cannot_be_removed_stays_beside_the_new_one(
    run: Path, state, monkeypatch
) -> None:
    """The new one is saved: its training must not take it for lost."""
    rename = Path.rename

    def fail(path: Path, target: Path) -> Path:
        if path.name == "64":
            raise PermissionError
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", fail)
        assert save_checkpoint(run, CONFIG, 128, items_of(state)) == 128
    assert {checkpoint.number for checkpoint in stored_checkpoints(run)} == {64, 128}
    save_checkpoint(run, CONFIG, 192, items_of(state))
    assert [checkpoint.number for checkpoint in stored_checkpoints(run)] == [192]


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_a_disk_that_fills_during_a_save_is_one_sentence(run: Path, capfd) -> None:
    """Whatever the threads say that write its many files."""
    arrays = {f"layer {i}": np.random.default_rng(i).normal(size=2**18) for i in range(8)}
    _, limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**19, limit))
    try:
        with pytest.raises(
            checkpoints.NotSavedError, match=r"cannot be written \(File too large\)"
        ):
            save_checkpoint(run, CONFIG, 128, {"training": arrays})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    assert capfd.readouterr() == ("", "")
    assert [checkpoint.number for checkpoint in stored_checkpoints(run)] == [64]


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory, state: TrainingState) -> Path:
    """A run whose first checkpoint is the best one, and whose second one is the newest."""
    run = create_run(CONFIG.model_copy(update={"log_dir": tmp_path_factory.mktemp("two")}))
    items = items_of(state)
    save_checkpoint(run, CONFIG, 64, items, report=report_of(2.0))
    save_checkpoint(run, CONFIG, 128, items, report=report_of(1.0), kept=(64,))
    return run


def test_the_best_checkpoint_has_the_best_evaluation(two: Path) -> None:
    assert (best_checkpoint(two).number, latest_checkpoint(two).number) == (64, 128)
    for number in (64, 128):
        assert find_checkpoint(two / f"checkpoints/{number}").number == number


def test_a_folder_of_a_run_without_a_checkpoint_is_told_from_a_run_without_one(
    two: Path, tmp_path: Path
) -> None:
    (two / "robot").mkdir()
    with pytest.raises(UserError, match=f"robot holds no checkpoint of its run; give {two}"):
        find_checkpoint(two / "robot")
    empty = create_run(CONFIG.model_copy(update={"log_dir": tmp_path}))
    with pytest.raises(UserError, match="as its training ended before the first one"):
        find_checkpoint(empty)
    # A manifest of a later version may mean something else.
    storage.seal(step_of(two))
    manifest = step_of(two) / storage.MANIFEST_FILE
    manifest.write_text(manifest.read_text().replace('"format": 1', '"format": 2'))
    with pytest.raises(UserError, match="damaged or of another version .*format"):
        verify(find_checkpoint(step_of(two)))
    storage.seal(step_of(two))


@pytest.mark.parametrize("wrong", [64, 128])
def test_the_intact_checkpoint_takes_the_place_of_a_damaged_one(
    wrong: int, two: Path, tmp_path: Path, capsys
) -> None:
    """Whichever of its files is damaged; a damaged one that the user names is refused."""
    other = 192 - wrong
    for file in sorted(p for p in (two / f"checkpoints/{wrong}").rglob("*") if p.is_file()):
        run = shutil.copytree(two, tmp_path / "run")
        damaged = run / file.relative_to(two)
        damaged.write_bytes(damaged.read_bytes() + b"more")
        for find in (best_checkpoint, latest_checkpoint, find_checkpoint):
            assert find(run).number == other, file
        warn_once.cache_clear()
        with pytest.raises(UserError, match=f"checkpoints/{wrong} is damaged"):
            read_policy(find_checkpoint(run / f"checkpoints/{wrong}"), CONFIG)
        shutil.rmtree(run)
    said = capsys.readouterr().err.splitlines()
    assert all(f"{wrong} is damaged" in line and "another one is used" in line for line in said)


@pytest.mark.parametrize("name", ["old[1]", "a\\b", "[", "* ?%20"])
def test_a_run_may_have_any_path(name: str, tmp_path: Path, state: TrainingState) -> None:
    """Orbax takes brackets for a pattern, and tensorstore a backslash for a slash."""
    run = write_run(tmp_path / name, state)
    save_checkpoint(run, CONFIG, 128, items_of(state))
    assert_identical(load_both(run, state), (policy_of(state, OBSERVATION.size), state))


def test_a_checkpoint_that_is_not_read_as_it_was_given_replaces_no_other(
    tmp_path: Path, state: TrainingState, monkeypatch
) -> None:
    run = write_run(tmp_path, state)
    lost = lambda folder, template: jax.tree.map(np.zeros_like, template)  # noqa: E731
    monkeypatch.setattr(checkpoints, "_read_item", lost)
    with pytest.raises(checkpoints.NotSavedError, match="cannot be written"):
        save_checkpoint(run, CONFIG, 128, items_of(state))
    monkeypatch.undo()
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["64"]
    assert_identical(load_both(run, state), (policy_of(state, OBSERVATION.size), state))


def test_a_checkpoint_without_a_manifest_is_read_with_a_warning(run, state, capsys) -> None:
    (step_of(run) / storage.MANIFEST_FILE).unlink()
    assert_identical(load_both(run, state), (policy_of(state, OBSERVATION.size), state))
    assert "has no manifest.json to find damage by" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda x: {"params": x["params"]}, "policy.normalizer.mean is missing, and should be fl"),
        (lambda x: jax.tree.map(lambda y: y[None], x), "is float32[1, 29], and should be float32"),
    ],
    ids=["a missing array", "another shape"],
)
def test_arrays_are_compared_before_they_are_read(change, sentence, tmp_path, state) -> None:
    policy = jax.tree.map(np.asarray, policy_of(state, OBSERVATION.size))._asdict()
    policy["normalizer"] = policy["normalizer"]._asdict()
    run = create_run(CONFIG.model_copy(update={"log_dir": tmp_path}))
    save_checkpoint(run, CONFIG, 64, {"policy": change(policy)})
    with pytest.raises(UserError, match="damaged or of another version") as refused:
        read_policy(find_checkpoint(run), CONFIG)
    assert sentence in str(refused.value)


@pytest.mark.parametrize("part", ["std", "weight"])
def test_a_policy_that_is_not_finite_is_refused(part: str, tmp_path: Path, state) -> None:
    """By everything that acts with it: evaluation, viewers, export and `bounce_mjx.load_policy`."""
    policy = policy_of(state, OBSERVATION.size)
    if part == "weight":
        leaves, tree = jax.tree.flatten(policy.params)
        leaves[-1] = leaves[-1].at[0].set(jnp.inf)
        policy = policy._replace(params=jax.tree.unflatten(tree, leaves))
    else:
        wrong = getattr(policy.normalizer, part).at[3].set(jnp.nan)
        policy = policy._replace(normalizer=policy.normalizer._replace(**{part: wrong}))
    run = create_run(CONFIG.model_copy(update={"log_dir": tmp_path}))
    save_checkpoint(run, CONFIG, 64, {"policy": policy})
    name = "in params." if part == "weight" else f"in normalizer.{part};"
    for reads in (
        lambda: read_policy(find_checkpoint(run), CONFIG),
        lambda: export_onnx(find_checkpoint(run)),
        lambda: bounce_mjx.load_policy(run),
    ):
        with pytest.raises(UserError, match=f"not finite, {name}.*give another checkpoint"):
            reads()


def mutate(step: Path, other: Path, draw: random.Random) -> str:
    """Damages one file of a checkpoint; returns a description of the damage."""
    files = sorted(p for p in step.rglob("*") if p.is_file())
    path = draw.choice(files)
    data = path.read_bytes()
    how = draw.choice(("truncate", "flip", "flip", "delete", "swap", "foreign", "grow", "zero"))
    if how == "truncate":
        path.write_bytes(data[: draw.randrange(len(data) or 1)])
    elif how == "flip" and data:
        flipped = bytearray(data)
        flipped[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        path.write_bytes(flipped)
    elif how == "delete":
        path.unlink()
    elif how == "swap":
        second = draw.choice(files)
        path.write_bytes(second.read_bytes())
        second.write_bytes(data)
    elif how == "foreign":
        theirs = sorted(p for p in other.rglob("*") if p.is_file())
        path.write_bytes(draw.choice(theirs).read_bytes())
    elif how == "grow":
        path.write_bytes(data + draw.randbytes(draw.randrange(1, 100)))
    else:
        path.write_bytes(bytes(len(data)))
    return f"{how} {path.relative_to(step)}"


@pytest.mark.slow
def test_damage_is_refused_or_does_no_harm(
    written: Path, tmp_path: Path, state: TrainingState
) -> None:
    """200 mutations: a checkpoint loads bit for bit as saved, or is refused in one sentence."""
    other_state = state._replace(params=jax.tree.map(lambda x: x + 1.0, state.params))
    other = step_of(write_run(tmp_path / "other", other_state))
    draw = random.Random(1)
    refused = 0
    for i in range(200):
        run = shutil.copytree(written, tmp_path / "run")
        what = mutate(step_of(run), other, draw)
        try:
            loaded = load_both(run, state)
        except UserError as error:
            refused += 1
            assert "\n" not in str(error) and len(str(error)) < 1000, (i, what)
        else:
            assert_identical(loaded, (policy_of(state, OBSERVATION.size), state))
        shutil.rmtree(run)
    assert refused > 150


def test_checkpoint_of_another_run_is_refused(run: Path, state: TrainingState) -> None:
    config = read_preset(run / "config.yaml").model_copy(update={"seed": 3})
    shutil.rmtree(step_of(run))
    save_checkpoint(run, config, 64, items_of(state))
    with pytest.raises(UserError, match="a different config.*differs in seed;.*restore that file"):
        load_both(run, state)


class Payload:
    """Object whose unpickling runs code."""

    def __init__(self, target: Path):
        self.target = target

    def __reduce__(self):
        return os.mkdir, (str(self.target),)


@pytest.mark.slow
def test_code_in_any_file_is_not_run(written: Path, tmp_path: Path, state: TrainingState) -> None:
    """Also with a valid manifest."""
    target = tmp_path / "ran"
    names = sorted(p.relative_to(written) for p in written.rglob("*") if p.is_file())
    tagged = f'!!python/object/apply:os.mkdir ["{target}"]\n'.encode()
    for name in names:
        for data in (pickle.dumps(Payload(target)), tagged):
            run = shutil.copytree(written, tmp_path / "run")
            (run / name).write_bytes(data)
            if name.name != storage.MANIFEST_FILE:
                storage.seal(step_of(run))
            try:
                loaded = load_both(run, state)
            except UserError:
                pass
            else:
                assert_identical(loaded, (policy_of(state, OBSERVATION.size), state))
            assert not target.exists(), name
            shutil.rmtree(run)
