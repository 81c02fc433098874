"""What a training survives: an end between any two steps, signals, full disks, numbers that are
not finite. Going on leads to the very state of a training that nothing happened to."""

import json
import multiprocessing
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bounce_mjx import checkpoints
from bounce_mjx import train as train_command
from bounce_mjx.config import differing_keys
from bounce_mjx.runs import RESUMABLE_KEYS, best_checkpoint, latest_checkpoint, load_run_config
from tiny_runs import STEPS, TIMEOUT, TINY, job


@pytest.fixture(scope="module", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A cache of compiled programs, also for the processes that the tests start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        patch.setenv("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")
        yield


def train(log_dir: Path, steps: int, *flags: str) -> Path:
    """The folder of a new run."""
    before = set(log_dir.glob("*"))
    train_command.main([*TINY, "--total-steps", str(steps), "--log-dir", str(log_dir), *flags])
    (run,) = set(log_dir.glob("*")) - before
    return run


def resume(run: Path, *flags: str) -> None:
    train_command.main(["--resume", str(run), *flags])


def arrays(checkpoint) -> dict[str, np.ndarray]:
    """Every array of the training state in a checkpoint."""
    checkpoints.check_integrity(checkpoint.folder)
    return checkpoints.read_arrays(checkpoints.open_item(checkpoint.folder, "training"))


def evaluations(run: Path) -> list[dict]:
    return json.loads((run / "results.json").read_text())["evaluations"]


def assert_same_training(run: Path, straight: Path) -> None:
    """Bit for bit the same state, evaluations and best checkpoint."""
    for find in (latest_checkpoint, best_checkpoint):
        assert find(run).steps == find(straight).steps
        ours, theirs = arrays(find(run)), arrays(find(straight))
        assert ours.keys() == theirs.keys()
        for name in theirs:
            np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
    assert evaluations(run) == evaluations(straight)


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 256 steps to which nothing happened."""
    return train(tmp_path_factory.mktemp("straight"), STEPS)


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 128 steps."""
    return train(tmp_path_factory.mktemp("half"), STEPS // 2)


@pytest.fixture
def run(half: Path, tmp_path: Path) -> Path:
    """A copy of the run of 128 steps."""
    return shutil.copytree(half, tmp_path / "run")


# Resuming


def test_checkpoint_holds_all_that_training_goes_on_from(straight: Path) -> None:
    checkpoint = latest_checkpoint(straight)
    names = set(arrays(checkpoint))
    for group in (
        "params.policy",
        "params.value",
        "optimizer",
        "normalizer",
        "env.env",
        "env.clock",
    ):
        assert any(name.startswith(group) for name in names), group
    assert {"key", "iteration", "learning_rate"} <= names
    record = checkpoints.read_record(checkpoint.folder)
    assert record["steps"] == STEPS
    assert record["config"] == load_run_config(straight).model_dump(mode="json")
    assert record["progress"]["evaluations"] == evaluations(straight)


def test_resumed_training_is_the_same(run: Path, straight: Path) -> None:
    resume(run, "--total-steps", str(STEPS))
    assert_same_training(run, straight)


def test_results_that_are_newer_than_the_checkpoint_do_not_count(run: Path, straight: Path) -> None:
    # As after a crash that lost the last checkpoint, but not what had been written after it.
    for newer in ("results.json", "config.yaml"):
        shutil.copy(straight / newer, run)
    shutil.rmtree(run / "checkpoints/best")
    shutil.copytree(straight / "checkpoints/best", run / "checkpoints/best")
    resume(run, "--total-steps", str(STEPS))
    assert_same_training(run, straight)


def test_best_checkpoint_that_was_not_yet_written_is_written(run: Path, straight: Path) -> None:
    assert best_checkpoint(run).steps == latest_checkpoint(run).steps
    shutil.rmtree(run / "checkpoints/best")
    resume(run)
    assert best_checkpoint(run).steps == latest_checkpoint(run).steps
    resume(run, "--total-steps", str(STEPS))
    assert_same_training(run, straight)


def test_replaced_checkpoint_counts_until_the_new_one_is_there(run: Path, straight: Path) -> None:
    # As after a crash between the two renames.
    latest = latest_checkpoint(run).folder
    latest.rename(latest.with_name(latest.name + ".replaced"))
    (latest.with_name(latest.name + ".partial")).mkdir()
    resume(run, "--total-steps", str(STEPS))
    assert_same_training(run, straight)
    assert [p.name for p in latest.parent.iterdir()] == [str(STEPS)]


def test_lost_evaluation_is_made_up_for(tmp_path: Path, straight: Path) -> None:
    # As after a signal at a step at which an evaluation was due.
    run = train(tmp_path, STEPS // 2, "--eval-every", str(STEPS))
    for name in ("latest", "best"):
        path = run / f"checkpoints/{name}/{STEPS // 2}/run.json"
        record = json.loads(path.read_text())
        record["progress"] |= {"best": None, "best_steps": 0, "evaluations": []}
        path.write_text(json.dumps(record))
        checkpoints.seal(path.parent)
    shutil.rmtree(run / "checkpoints/best")
    resume(run, "--total-steps", str(STEPS), "--eval-every", str(STEPS // 2))
    assert_same_training(run, straight)


def test_help_lists_what_a_resumed_run_may_change() -> None:
    text = " ".join(train_command.TrainCommand.model_fields["resume"].description.split())
    for key in RESUMABLE_KEYS:
        assert key.split(".")[-1].replace("_", "-") in text, key


@pytest.mark.parametrize(
    ("key", "old", "new"),
    [("ppo.discount", "discount: 0.98", "discount: 0.9"), ("seed", "seed: 0", "seed: 1")],
)
def test_edited_config_is_refused_by_name(run: Path, capfd, key: str, old: str, new: str) -> None:
    config = run / "config.yaml"
    text = config.read_text()
    before = load_run_config(run)
    config.write_text(re.sub(rf"\b{old}", new, text, count=1))
    assert differing_keys(before, load_run_config(run)) == {key}
    with pytest.raises(SystemExit) as exit_info:
        resume(run)
    assert exit_info.value.code == 2
    sentence = capfd.readouterr().err
    assert f"which differs in {key};" in sentence
    assert re.fullmatch(r"error: .+\n", sentence)


# Signals


def resume_command(said: str) -> list[str]:
    """The arguments in the command that a stopped training prints."""
    return shlex.split(re.search(r"go on with: python train_jax\.py (.+)", said)[1])


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=["SIGTERM", "Ctrl-C"])
def test_signal_saves_and_says_how_to_go_on(
    tmp_path: Path, straight: Path, number: signal.Signals
) -> None:
    args = [*TINY, "--total-steps", 10**6, "--log-dir", tmp_path / "runs"]
    with job(tmp_path / "log", *args) as training:
        training.wait_until_said("evaluation at")
        training.process.send_signal(number)
        assert training.wait() == 0, training.said
    said = training.said
    assert "Traceback" not in said
    (run,) = (tmp_path / "runs").iterdir()
    steps = latest_checkpoint(run).steps
    assert f"stopped after {steps:,} steps" in said
    assert resume_command(said) == ["--resume", str(run)]
    if steps > STEPS:
        straight = train(tmp_path / "straight", steps + 64)
    total = max(STEPS, steps + 64)
    train_command.main([*resume_command(said), "--total-steps", str(total)])
    assert_same_training(run, straight)


@pytest.mark.slow
def test_signal_while_compiling_ends_at_once_and_leaves_nothing(tmp_path: Path) -> None:
    # Layers of their own, so that the cache does not hold the programs.
    args = [*TINY, "--hidden-layers", 24, 24, "--total-steps", 256, "--log-dir", tmp_path / "runs"]
    with job(tmp_path / "log", *args) as training:
        training.wait_until_said("device:")
        training.process.send_signal(signal.SIGTERM)
        assert training.wait() == 0, training.said
    assert "stopped before anything was trained" in training.said
    assert "Traceback" not in training.said
    assert not list((tmp_path / "runs").iterdir())


@pytest.mark.slow
def test_signal_does_not_wait_for_an_evaluation(tmp_path: Path) -> None:
    # Its 20,000 episodes take longer than the test.
    args = [*TINY, "--eval-episodes", 20_000, "--episode-seconds", 200, "--total-steps", 128]
    with job(tmp_path / "log", *args, "--log-dir", tmp_path / "runs") as training:
        training.wait_until_said("s left", times=2)
        time.sleep(0.5)
        training.process.send_signal(signal.SIGTERM)
        assert training.wait() == 0, training.said
    assert "evaluation at" not in training.said
    (run,) = (tmp_path / "runs").iterdir()
    assert latest_checkpoint(run).steps == 128
    assert checkpoints.read_record(latest_checkpoint(run).folder)["progress"]["evaluations"] == []


@pytest.mark.parametrize("pause", [0.0, 0.8], ids=["told twice", "second Ctrl-C"])
def test_second_ctrl_c_ends_the_process_at_once(pause: float) -> None:
    code = (
        "import time\n"
        "from bounce_mjx.signals import StopRequest\n"
        "with StopRequest() as stop:\n"
        "    print('ready', flush=True)\n"
        "    while not stop.requested: time.sleep(0.01)\n"
        "    print('requested', flush=True)\n"
        "    time.sleep(3)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "requested\n"
        time.sleep(pause)
        process.send_signal(signal.SIGINT)
        # A launcher that hands the same Ctrl-C on must not turn it into a second one.
        assert process.wait(TIMEOUT) == (-signal.SIGINT if pause else 0)


def _train_in_silence(args: list[str]) -> None:
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        train_command.main(args)


@pytest.mark.slow
def test_killed_at_any_moment(tmp_path: Path, straight: Path) -> None:
    """kill -9 at 20 random moments of one training: while it starts, trains, writes, renames and
    removes. Each process goes on from the checkpoint that the one before left."""
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["bounce_mjx.train"])
    moments = random.Random(0)
    log_dir = tmp_path / "runs"
    args = [*TINY, "--eval-every", "64", "--total-steps", str(10**6), "--log-dir", str(log_dir)]
    saved = 0
    for attempt in range(20):
        process = processes.Process(target=_train_in_silence, args=(args,))
        process.start()
        if attempt % 5 == 4:
            time.sleep(moments.uniform(0.0, 3.0))
        else:
            deadline = time.monotonic() + TIMEOUT
            while not any(p.name > f"{saved}" for p in log_dir.glob("*/checkpoints/latest/*")):
                assert process.is_alive() and time.monotonic() < deadline
                time.sleep(0.005)
            time.sleep(moments.uniform(0.0, 0.4))
        process.kill()
        process.join()
        runs = list(log_dir.glob("*"))
        if any(run.glob("checkpoints/latest/*") for run in runs):
            (run,) = runs
            checkpoint = latest_checkpoint(run)
            arrays(checkpoint)
            assert checkpoint.steps >= saved
            saved = checkpoint.steps
            args = ["--resume", str(run)]
        else:
            shutil.rmtree(log_dir, ignore_errors=True)
    assert saved > 64
    total = saved + 64
    resume(run, "--total-steps", str(total))
    assert_same_training(run, train(tmp_path / "straight", total, "--eval-every", "64"))
    log = EventAccumulator(str(run)).Reload()
    logged = [event.step for event in log.Scalars("loss/value")]
    assert logged == sorted(set(logged))
