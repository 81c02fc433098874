"""A training survives interruptions between any two steps, signals, full disks and numbers that are
not finite. The resumed training reaches exactly the state of an undisturbed one."""

import concurrent.futures
import contextlib
import dataclasses
import errno
import functools
import io
import itertools
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
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bounce_mjx.commands import train as train_command
from bounce_mjx.config.files import differing_keys
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import Report, Result, judge
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.learning.ppo import CHECKED, first_fault
from bounce_mjx.runs import writing
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.files import seal
from bounce_mjx.runs.folders import (
    best_checkpoint,
    find_checkpoint,
    latest_checkpoint,
    save_config,
    stored_checkpoints,
)
from bounce_mjx.runs.lock import lock_run
from bounce_mjx.runs.progress import Progress
from bounce_mjx.runs.reading import RESUMABLE_KEYS, read_actor, read_policy, read_record
from bounce_mjx.runs.writing import CheckpointWriter, save_checkpoint
from bounce_mjx.tasks.bounce_ball import BounceBall
from bounce_mjx.training import console, ppo_trainer
from bounce_mjx.training import job as training_job
from bounce_mjx.training.command import TrainCommand
from bounce_mjx.training.console import Reporter
from bounce_mjx.training.devices import make_mesh
from bounce_mjx.training.evaluators import Evaluators
from bounce_mjx.training.ppo_trainer import PPOTrainer
from bounce_mjx.training.warm_start import present_start
from tiny_runs import STEPS, TIMEOUT, TINY, arrays, contents, job


@pytest.fixture(scope="module", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keeps compiled programs: in this process by config, and for other processes in a cache."""
    kept = {}

    def once(lower: Callable) -> Callable:
        """Lowers and compiles only what is new."""

        def lower_once(owner: PPOTrainer | Evaluators) -> SimpleNamespace:
            varied = {"total_steps": 0, "eval_every": 0, "log_dir": None}
            if isinstance(owner, PPOTrainer):
                varied["screening_episodes"] = 0
            key = lower, repr(owner._config.model_copy(update=varied))

            def compile() -> jax.stages.Compiled:
                if key not in kept:
                    kept[key] = lower(owner).compile()
                return kept[key]

            return SimpleNamespace(compile=compile)

        return lower_once

    with pytest.MonkeyPatch.context() as patch:
        for owner, name in (
            (PPOTrainer, "_lower_run"),
            (PPOTrainer, "_lower_init"),
            (Evaluators, "_lower"),
        ):
            patch.setattr(owner, name, once(getattr(owner, name)))
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


def evaluations(run: Path) -> list[dict]:
    return json.loads((run / "results.json").read_text())["evaluations"]


def assert_same_training(run: Path, straight: Path) -> None:
    """Checks that state, evaluations and best checkpoint are the same bit for bit."""
    for find in (latest_checkpoint, best_checkpoint):
        assert read_record(find(run)).steps == read_record(find(straight)).steps
        ours, theirs = arrays(find(run)), arrays(find(straight))
        assert ours.keys() == theirs.keys()
        for name in theirs:
            np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
    assert evaluations(run) == evaluations(straight)


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 256 steps without an interruption."""
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


def test_checkpoint_holds_the_whole_training_state(straight: Path) -> None:
    checkpoint = latest_checkpoint(straight)
    names = set(arrays(checkpoint))
    for group in (
        "params.policy",
        "params.value",
        "optimizer",
        "statistics",
        "env.env",
        "env.clock",
    ):
        assert any(name.startswith(group) for name in names), group
    assert {"key", "iteration", "learning_rate"} <= names
    record = read_record(checkpoint)
    assert record.steps == STEPS
    config = load_run_config(straight)
    assert type(config).model_validate(record.config) == config
    assert record.progress["evaluations"] == evaluations(straight)


def test_resumed_training_is_the_same(run: Path, straight: Path) -> None:
    resume(run, "--total-steps", str(STEPS))
    assert_same_training(run, straight)


def test_results_that_are_newer_than_the_checkpoint_do_not_count(run: Path, straight: Path) -> None:
    # As after a crash that lost the last checkpoint, but not the files that were written after it.
    for newer in ("results.json", "config.yaml"):
        shutil.copy(straight / newer, run)
    resume(run, "--total-steps", str(STEPS))
    assert_same_training(run, straight)


def test_what_a_killed_process_was_writing_is_removed(run: Path, straight: Path) -> None:
    folder, (latest,) = run / "checkpoints", (run / "checkpoints").iterdir()
    shutil.copytree(latest, folder / "256.orbax-checkpoint-tmp")
    shutil.copytree(latest, folder / "replaced/64")
    (run / ".unfinished-0123.json").touch()
    assert latest_checkpoint(run).folder == latest
    resume(run, "--total-steps", str(STEPS))
    assert_same_training(run, straight)
    assert not list(run.rglob(".unfinished-*"))
    kept = {best_checkpoint(run).folder.name, latest_checkpoint(run).folder.name}
    assert {path.name for path in folder.iterdir()} == kept


@pytest.mark.slow
def test_lost_evaluation_is_repeated(tmp_path: Path, straight: Path) -> None:
    # As after a signal at a step where an evaluation was due.
    run = train(tmp_path, STEPS // 2, "--eval-every", str(STEPS))
    (folder,) = (run / "checkpoints").iterdir()
    record = json.loads((folder / "record/metadata").read_text())
    record["progress"] |= {"best": None, "best_steps": 0, "evaluations": []}
    (folder / "record/metadata").write_text(json.dumps(record))
    (folder / "metrics/metrics").write_text(json.dumps({"score": []}))
    seal(folder)
    resume(run, "--total-steps", str(STEPS), "--eval-every", str(STEPS // 2))
    assert_same_training(run, straight)


def test_help_lists_what_a_resumed_run_may_change() -> None:
    text = " ".join(TrainCommand.model_fields["resume"].description.split())
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
    return shlex.split(re.search(r"continue with: bounce-mjx train (.+)", said)[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "number",
    [signal.SIGTERM, signal.SIGINT, signal.SIGHUP],
    ids=["SIGTERM", "Ctrl-C", "SIGHUP"],
)
def test_signal_saves_and_says_how_to_resume(
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
    total = max(STEPS, steps + 64)
    if total > STEPS:
        straight = train(tmp_path / "straight", total)
    train_command.main([*resume_command(said), "--total-steps", str(total)])
    assert_same_training(run, straight)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=["SIGTERM", "Ctrl-C"])
def test_signal_while_compiling_ends_at_once_and_leaves_nothing(
    tmp_path: Path, number: signal.Signals
) -> None:
    # Unusual layers, so that the programs are not in the cache.
    args = [*TINY, "--hidden-layers", 24, 24, "--total-steps", 256, "--log-dir", tmp_path / "runs"]
    with job(tmp_path / "log", *args) as training:
        training.wait_until_said("device:")
        training.process.send_signal(number)
        assert training.wait() == 130, training.said
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
    assert read_record(latest_checkpoint(run)).progress["evaluations"] == []


def test_a_slow_block_is_stopped_between_two_iterations(tmp_path: Path, monkeypatch) -> None:
    """On MJX a block may take minutes. The resumed training first completes the block."""
    monkeypatch.setattr(ppo_trainer, "_iterations_at_once", lambda *_: 1)
    flags = [*TINY, "--block-steps", "128", "--total-steps", "256", "--no-report"]

    class Stopped(PPOTrainer):
        def run(self, iterations, stopping):
            os.kill(os.getpid(), signal.SIGTERM)
            while not stopping():
                time.sleep(0.01)
            return super().run(iterations, stopping)

    def train(name: str, trainer: type[PPOTrainer], **resumed) -> Path:
        command = train_command.read_command([*flags, "--log-dir", str(tmp_path / name)])
        console = Console(file=io.StringIO())
        with contextlib.suppress(training_job.TrainingStopped):
            training_job.train(command.training, console, make_trainer=trainer, **resumed)
        return next((tmp_path / name).iterdir())

    stopped = train("stopped", Stopped)
    assert latest_checkpoint(stopped).steps == 64
    train("stopped", PPOTrainer, resume=stopped)
    assert_same_training(stopped, train("straight", PPOTrainer))


@pytest.mark.parametrize("pause", [0.0, 0.8], ids=["told twice", "second Ctrl-C"])
def test_second_ctrl_c_ends_the_process_at_once(pause: float) -> None:
    code = (
        "import time\n"
        "from bounce_mjx.interrupt import StopRequest, end_on_ctrl_c\n"
        "end_on_ctrl_c()\n"
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
        # A launcher that forwards the same Ctrl-C must not turn it into a second one.
        assert process.wait(TIMEOUT) == (130 if pause else 0)


def _train_in_silence(args: list[str]) -> None:
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        train_command.main(args)


@pytest.mark.slow
def test_killed_at_any_moment(tmp_path: Path, straight: Path) -> None:
    """One training is killed with kill -9 five times: while it starts, trains, writes a checkpoint
    and removes the previous one. Each process resumes from the checkpoint that the previous process
    left."""
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["bounce_mjx.commands.train"])
    random_seconds = random.Random(0).uniform
    log_dir = tmp_path / "runs"
    args = [*TINY, "--eval-every", "64", "--total-steps", str(10**6), "--log-dir", str(log_dir)]
    saved = 0

    def written() -> list[int]:
        """A value that changes whenever something is written to the folder of the latest
        checkpoint."""
        return [p.stat().st_mtime_ns for p in log_dir.glob("*/checkpoints")]

    def steps_saved() -> int:
        """Environment steps of the latest complete checkpoint."""
        stored = (x.steps for run in log_dir.glob("*") for x in stored_checkpoints(run))
        return max(stored, default=0)

    def wait_until(happens: Callable[[], bool]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not happens():
            assert process.is_alive() and time.monotonic() < deadline
            time.sleep(0.0002)

    for moment in ("start", "any", "*orbax-checkpoint-tmp*", "replaced/*", "any"):
        before = written()
        process = processes.Process(target=_train_in_silence, args=(args,))
        process.start()
        if moment == "start":
            time.sleep(random_seconds(0.0, 3.0))
        elif moment == "any":
            wait_until(lambda saved=saved: steps_saved() > saved)
            time.sleep(random_seconds(0.0, 1.0))
        else:
            wait_until(lambda before=before: written() != before)
            wait_until(lambda end=moment: any(log_dir.glob(f"*/checkpoints/{end}")))
        process.kill()
        process.join()
        if steps_saved():
            (run,) = log_dir.glob("*")
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


# One writer


def test_a_run_in_use_is_not_resumed(run: Path, capfd) -> None:
    before = contents(run)
    with lock_run(run), pytest.raises(SystemExit) as exit_info:
        resume(run, "--total-steps", str(STEPS))
    assert exit_info.value.code == 2
    assert re.fullmatch(
        rf"error: {run} is in use by another training process; .+\n", capfd.readouterr().err
    )
    assert contents(run) == before


def test_a_lock_ends_with_its_process(run: Path, straight: Path) -> None:
    code = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from bounce_mjx.runs.lock import lock_run\n"
        "with lock_run(Path(sys.argv[1])):\n"
        "    print('locked', flush=True)\n"
        "    time.sleep(100)\n"
    )
    command = [sys.executable, "-c", code, str(run)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "locked\n"
        with pytest.raises(UserError, match="is in use"), lock_run(run):
            pass
        holder.kill()
    resume(run, "--total-steps", str(STEPS))
    assert_same_training(run, straight)


def test_a_training_holds_the_lock_of_its_run(run: Path, monkeypatch) -> None:
    refusals, train_block = [], PPOTrainer.run

    def run_block(*args):
        with pytest.raises(UserError, match="is in use") as refused, lock_run(run):
            pass
        refusals.append(refused)
        return train_block(*args)

    monkeypatch.setattr(PPOTrainer, "run", run_block)
    resume(run, "--total-steps", str(STEPS))
    assert len(refusals) == 2
    with lock_run(run):
        pass
    assert not list(run.glob(".*"))


# Readers


def test_a_reader_reads_the_next_checkpoint_where_a_training_replaces_one(run: Path) -> None:
    """The policy that it reads is that of the checkpoint that it names."""
    config = load_run_config(run)
    policy = read_policy(latest_checkpoint(run), config)
    ended = threading.Event()

    def save() -> None:
        for steps in itertools.count(STEPS):
            marked = jax.tree.map(lambda leaf, steps=steps: np.full_like(leaf, steps), policy)
            # Each is better than the one before.
            save_checkpoint(run, config, steps, {"policy": marked}, score=(True, 5, 1.0, steps))
            if ended.wait(0.02):
                return

    saver = threading.Thread(target=save)
    saver.start()
    try:
        read = [read_actor(find_checkpoint(run), config)[:2] for _ in range(10)]
    finally:
        ended.set()
        saver.join()
    assert len({checkpoint.steps for checkpoint, _ in read}) > 1
    for checkpoint, marked in read:
        if checkpoint.steps >= STEPS:
            assert all((leaf == checkpoint.steps).all() for leaf in jax.tree.leaves(marked))


def test_a_warm_start_takes_the_next_checkpoint_where_a_training_replaces_one(run: Path) -> None:
    latest = latest_checkpoint(run).folder
    start = TrainConfig(warm_start=latest.with_name("64"))
    assert present_start(start).warm_start == latest
    for kept in (latest, run, Path("robust"), None):
        config = start.model_copy(update={"warm_start": kept})
        assert present_start(config) == config


# Paths


def test_a_path_with_a_square_bracket_is_refused(tmp_path: Path, straight: Path, capsys) -> None:
    with pytest.raises(SystemExit):
        train(tmp_path / "exp[lr]", STEPS)
    assert "exp[lr] has a square bracket" in capsys.readouterr().err
    assert not (tmp_path / "exp[lr]").exists()
    moved = shutil.copytree(straight, tmp_path / "moved[1]")
    with pytest.raises(SystemExit):
        resume(moved, "--total-steps", str(2 * STEPS))
    assert "moved[1] has a square bracket" in capsys.readouterr().err


# Evaluations and logs


def test_the_best_is_reported_on_fresh_resets(straight: Path, capfd) -> None:
    results = json.loads((straight / "results.json").read_text())
    assert results["fresh_resets"] is True
    config = load_run_config(straight)
    selected = read_record(best_checkpoint(straight)).progress["best"]
    env = BounceBall(config.env)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    evaluate = make_evaluator(env, networks, config.eval_episodes)
    policy = read_policy(best_checkpoint(straight), config)

    def mean_return(seed: int) -> float:
        key = jax.random.split(jax.random.PRNGKey(np.uint32(seed)))[0]
        return judge(env, evaluate(policy, key)).details["mean_return"]

    assert selected["details"]["mean_return"] == pytest.approx(mean_return(config.eval_seed))
    fresh = mean_return(config.eval_seed + 2**31)
    assert results["details"]["mean_return"] == pytest.approx(fresh)
    assert fresh != pytest.approx(mean_return(config.eval_seed))


# Starts


# Each factor is read in a way in which a user's own code may read it: those of a reward term and of
# the networks from files, that of the environment's step from the environment, and that of the loss
# from the script itself, which patches all four functions.
CHANGED = """
import os, sys
from pathlib import Path
import jax
from bounce_mjx.commands.train import main
from bounce_mjx.learning import networks, ppo
from bounce_mjx.tasks.bounce_rewards import PaddleHomeReward
from bounce_mjx.env.env import Env
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
def from_file(name):
    return float(Path(__file__).with_name(f"{name}.factor").read_text())
formula = PaddleHomeReward.value
PaddleHomeReward.value = lambda *args: formula(*args) * from_file("term")
silu = networks.nn.silu
networks.nn.silu = lambda x: silu(x) * from_file("networks")
step = Env.step
def from_variable(self, state, action, *args):
    return step(self, state, action * float(os.environ["FACTOR"]), *args)
Env.step = from_variable
loss = ppo.loss
def from_script(*args):
    total, metrics = loss(*args)
    return total + (LOSS - 1.0) * metrics["loss/value"], metrics
ppo.loss = from_script
main(sys.argv[1:])
names = "compile_requests_use_cache", "cache_hits"
print("counts:", *(events.count("/jax/compilation_cache/" + name) for name in names))
"""


@pytest.mark.slow
def test_only_an_equal_training_finds_its_programs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its second start compiles nothing and trains the same. A change in what a user's code reads
    trains something else, with the same cache."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    script = tmp_path / "changed.py"

    def start(name: str, **changed: str) -> tuple[int, int, bytes]:
        factors = dict.fromkeys(("term", "networks", "step", "loss"), "1.0") | changed
        for of_file in ("term", "networks"):
            (tmp_path / f"{of_file}.factor").write_text(factors[of_file])
        monkeypatch.setenv("FACTOR", factors["step"])
        script.write_text(CHANGED.replace("LOSS", factors["loss"]))
        flags = [*TINY, "--total-steps", "64", "--no-report"]
        flags += ["--log-dir", tmp_path / name]
        with job(tmp_path / f"{name}.log", *flags, script=script) as process:
            assert process.wait() == 0, process.said
        (counts,) = re.findall(r"^counts: (\d+) (\d+)$", process.said, re.MULTILINE)
        (run,) = (tmp_path / name).iterdir()
        trained = arrays(latest_checkpoint(run))
        return *map(int, counts), b"".join(trained[key].tobytes() for key in sorted(trained))

    _, _, trained = start("first")
    requests, hits, again = start("second")
    assert hits == requests > 0 and again == trained
    for changed in ("term", "networks", "step", "loss"):
        assert start(changed, **{changed: "0.5"})[2] != trained


@pytest.mark.slow
def test_the_chunks_of_an_evaluation_are_its_episodes(straight: Path) -> None:
    """The program of a screening of three episodes also runs a full evaluation of four, on the
    resets that one program of four episodes uses."""
    config = load_run_config(straight).model_copy(update={"screening_episodes": 3})
    env, policy = BounceBall(config.env), read_policy(best_checkpoint(straight), config)
    with concurrent.futures.ThreadPoolExecutor() as pool:
        chunked, whole = (
            Evaluators(each, env, make_mesh(1, config.ppo), pool)
            for each in (config, config.model_copy(update={"screening_episodes": 0}))
        )
    (expected,) = whole.final(policy)
    (report,) = chunked.final(policy)
    assert report.details == pytest.approx(expected.details)
    jax.tree.map(
        lambda ours, theirs: np.testing.assert_allclose(ours, theirs, atol=1e-5),
        report.recording,
        expected.recording,
    )

    (screening,) = chunked.select(policy)
    _, key = jax.random.split(jax.random.PRNGKey(np.uint32(config.eval_seed)))
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    evaluate = make_evaluator(env, networks, config.eval_episodes)
    first_three = jax.tree.map(lambda x: x[:3], evaluate(policy, key))
    assert screening.screening
    assert screening.details == pytest.approx(judge(env, first_three).details)


@pytest.mark.slow
def test_a_failed_screening_is_no_evaluation(tmp_path: Path, capfd) -> None:
    run = train(tmp_path, STEPS, "--screening-episodes", "2")
    said = capfd.readouterr().out
    assert said.count("screening (2 episodes) at") == 2 and "evaluation at" not in said
    assert [e["screening"] for e in evaluations(run)] == [True, True]
    tags = EventAccumulator(str(run)).Reload().Tags()["scalars"]
    assert "results/stable" in tags
    page = (run / "report.html").read_text(encoding="utf-8")
    assert page.count(">screening</td>") == 2
    # The end reports all episodes.
    results = json.loads((run / "results.json").read_text())
    assert (results["screening"], results["details"]["episodes"]) == (False, 4)


def test_a_screening_is_never_better_than_a_full_evaluation() -> None:
    def report(passed: bool, mean_return: float, screening: bool) -> Report:
        result = Result("stable", "episodes, %", 0.0, ">= 99", passed)
        details = {"mean_return": mean_return, "episodes": 2.0}
        return Report((result,), details, screening=screening)

    progress = Progress()
    assert progress.improves(report(False, 5.0, True), 1, 0.0)
    assert progress.improves(report(False, 1.0, False), 2, 0.0)
    assert not progress.improves(report(False, 9.0, True), 3, 0.0)
    stored = Progress.from_dict(
        json.loads(json.dumps(progress.model_dump())) | {"best": None}, Path()
    )
    assert progress.best_steps == 2
    assert [e.screening for e in stored.evaluations] == [True, False, True]


@pytest.mark.slow
def test_a_training_stops_once_its_results_have_a_margin(tmp_path: Path, monkeypatch) -> None:
    """It tells the first evaluation that met all results, and the end."""
    margins = iter([None, 0.5, 1.0])
    select = Evaluators.select

    def passing(evaluators: Evaluators, policies) -> list[Report]:
        margin = next(margins)
        (report,) = select(evaluators, policies)
        met = {"passed": margin is not None, "margin": margin}
        results = tuple(dataclasses.replace(result, **met) for result in report.results)
        return [dataclasses.replace(report, results=results)]

    monkeypatch.setattr(Evaluators, "select", passing)
    run = train(tmp_path, STEPS, "--eval-every", "64", "--stop-when-solved")
    results = json.loads((run / "results.json").read_text())
    steps = [results[name] for name in ("solved_steps", "margin_steps", "trained_steps")]
    assert steps == [128, 192, 192]
    assert 0.0 < results["solved_seconds"] < sum(results["seconds"].values())
    assert best_checkpoint(run).steps == 192


@pytest.mark.parametrize(
    ("evaluations", "solved"),
    [
        ([(64, None)], False),
        ([(64, None), (128, 1.0)], True),
        ([(128, 0.5)], False),
        # Half as many steps again.
        ([(128, 0.5), (191, 0.5)], False),
        ([(128, 0.5), (192, 0.5)], True),
        ([(128, 0.5), (192, None)], True),
        ([(128, 0.5), (160, 1.0)], True),
    ],
)
def test_a_training_does_not_wait_long_for_a_margin(evaluations, solved: bool) -> None:
    progress = Progress()
    for steps, margin in evaluations:
        result = Result("stable", "episodes, %", 0.0, ">= 99", margin is not None, margin)
        progress.improves(Report((result,), {"mean_return": 1.0}), steps, 0.0)
    assert progress.solved is solved


@pytest.mark.parametrize(
    ("steps", "solved", "expected"),
    [(100, False, ", 0 s left"), (70, False, ", 180 s left"), (70, True, ", at most 180 s left")],
)
def test_the_time_left(monkeypatch, steps: int, solved: bool, expected: str) -> None:
    """A training that is resumed after 50 steps needs 120 s for the next 20, evaluations
    included."""
    now = 0.0
    monkeypatch.setattr(console.time, "monotonic", lambda: now)
    shown = io.StringIO()
    config = TrainConfig(total_steps=100, stop_when_solved=solved)
    names = ("episode/return", "episode/bounces", "task/non_finite", "speed/steps_per_second")
    metrics = {name: np.ones(1) for name in names} | {"task/non_finite": np.zeros(1)}
    reporter = Reporter(Console(file=shown, width=200), config, 50)
    now = 120.0
    reporter.block(steps, 1.0, metrics)
    assert expected in shown.getvalue()


@pytest.fixture
def solved(run: Path) -> Path:
    """A run of 128 steps that ended because it met all results."""
    for path in [run / "results.json", run / "checkpoints/128/record/metadata"]:
        plain = json.loads(path.read_text())
        progress = plain if path.name == "results.json" else plain["progress"]
        progress |= {"solved_steps": 128, "margin_steps": 128}
        if path.name == "metadata":
            plain["config"] |= {"stop_when_solved": True, "total_steps": 10**6}
        path.write_text(json.dumps(plain))
    seal(run / "checkpoints/128")
    config = load_run_config(run).model_copy(
        update={"stop_when_solved": True, "total_steps": 10**6}
    )
    save_config(run, config)
    return run


@pytest.mark.slow
def test_a_solved_run_is_told_as_such(solved: Path, capsys) -> None:
    resume(solved)
    assert latest_checkpoint(solved).steps == STEPS // 2
    said = capsys.readouterr().out
    assert f"{solved} has met all results after 128 steps; add --total-steps N to train on" in said
    resume(solved, "--total-steps", "128")
    assert f"{solved} has been trained to its end, 128 steps;" in capsys.readouterr().out


@pytest.mark.slow
def test_a_solved_run_goes_on_to_new_total_steps(solved: Path, straight: Path, capsys) -> None:
    resume(solved, "--total-steps", str(STEPS))
    assert "it continues to 256 steps" in capsys.readouterr().out
    assert not load_run_config(solved).stop_when_solved
    ours, theirs = arrays(latest_checkpoint(solved)), arrays(latest_checkpoint(straight))
    for name in theirs:
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)


def test_the_log_holds_every_point_of_a_checkpoint(run: Path, monkeypatch) -> None:
    """This holds even if the process dies right after the save, because a second SIGTERM does not
    wait."""
    logged = []
    save = CheckpointWriter.save

    def save_and_look(writer, steps, *rest):
        log = EventAccumulator(str(run)).Reload()
        scalars = [log.Scalars(tag) for tag in ("loss/value", "results/mean_length_s")]
        # The last that an evaluation adds.
        points = [*scalars, log.Tensors("results/text_summary")]
        logged.append((steps, *(tag[-1].step for tag in points)))
        save(writer, steps, *rest)

    monkeypatch.setattr(CheckpointWriter, "save", save_and_look)
    resume(run, "--total-steps", str(2 * STEPS))
    assert logged == [(steps,) * 4 for steps in (256, 384, 512)]


# Full disks


@contextlib.contextmanager
def tmpfs(folder: Path) -> Iterator[None]:
    """A file system of 4 MB, mounted at a folder."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("a file system cannot be mounted here")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["full", "read-only"])
def test_a_training_goes_on_while_it_cannot_save(tmp_path: Path, what: str) -> None:
    """It saves its newest state once there is room again, and continues exactly."""
    disk, filler = tmp_path / "disk", tmp_path / "disk/filler"
    remount = ["mount", "-o", "remount,size=4m,"]
    args = [*TINY, "--total-steps", 10**6, "--log-dir", disk / "runs"]
    with tmpfs(disk), job(tmp_path / "log", *args) as training:
        training.wait_until_said("device:")
        if what == "full":
            with contextlib.suppress(OSError):
                filler.write_bytes(bytes(2**22))
            make_room, reason = filler.unlink, "No space left on device"
        else:
            subprocess.run([*remount[:-1], remount[-1] + "ro", str(disk)], check=True)
            writable = [*remount[:-1], remount[-1] + "rw", str(disk)]
            make_room = functools.partial(subprocess.run, writable, check=True)
            reason = "Read-only file system"
        training.wait_until_said("training continues")
        make_room()
        training.wait_until_said("the state is saved again")
        training.process.send_signal(signal.SIGTERM)
        assert training.wait() == 0, training.said
        for sentence in ("training continues", "the state is saved again"):
            assert training.said.count(sentence) == 1
        assert f"cannot be written ({reason})" in training.said
        assert "Traceback" not in training.said
        (run,) = (disk / "runs").iterdir()
        steps = latest_checkpoint(run).steps
        straight = train(tmp_path / "straight", steps + 64)
        resume(run, "--total-steps", str(steps + 64))
        ours, theirs = arrays(latest_checkpoint(run)), arrays(latest_checkpoint(straight))
        for name in theirs:
            np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
        # Points may be lost, but the log stays one.
        EventAccumulator(str(run)).Reload()


def test_a_training_that_ends_without_room_says_so(run: Path, monkeypatch, capfd) -> None:
    """The last good checkpoint stays, and the training resumes from it."""
    saved = contents(run / "checkpoints")

    def full(*_) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(writing, "save_checkpoint", full)
        with pytest.raises(SystemExit) as exit_info:
            resume(run, "--total-steps", str(STEPS))
    assert exit_info.value.code == 2
    sentence = capfd.readouterr().err
    assert "(No space left on device), so the end of the training is lost; make room" in sentence
    assert f"continue with: bounce-mjx train --resume {run}" in sentence
    assert contents(run / "checkpoints") == saved


# Numbers that are not finite


def change_state(monkeypatch, iteration: int, change: Callable) -> None:
    """Changes the state of every training before the given iteration."""
    run = PPOTrainer.run

    def run_changed(trainer: PPOTrainer, *args):
        if trainer.state.iteration == iteration - 1:
            trainer.state = change(trainer.state)
        return run(trainer, *args)

    monkeypatch.setattr(PPOTrainer, "run", run_changed)


def test_divergence_ends_the_training_and_keeps_the_last_good_state(
    run: Path, half: Path, monkeypatch, capfd
) -> None:
    def spoil(state):
        params = jax.tree.map(lambda x: x * jnp.nan, state.params.policy)
        return state._replace(params=state.params._replace(policy=params))

    change_state(monkeypatch, 4, spoil)
    with pytest.raises(SystemExit) as exit_info:
        resume(run, "--total-steps", "100000")
    assert exit_info.value.code == 2
    sentence = capfd.readouterr().err
    assert re.fullmatch(r"error: .+\n", sentence)
    assert "loss/policy was the first that was not finite, at iteration 4;" in sentence
    assert f"the last good checkpoint is {latest_checkpoint(run).folder}" in sentence
    assert_same_training(run, half)


@pytest.mark.parametrize("quantity", CHECKED)
def test_first_fault_names_the_first_quantity(quantity: str) -> None:
    def value(name: str):
        """The value of a quantity: NaN from the first broken quantity on, as everything computed
        after it would be."""
        return jnp.where(CHECKED.index(name) >= CHECKED.index(quantity), jnp.nan, 1.0)

    def minibatches(name: str):
        return jnp.ones((2, 3)).at[1, 1].set(value(name)).at[1, 2].set(value("parameters"))

    minibatch_metrics = {
        "loss/value": minibatches("loss/value"),
        "loss/policy": minibatches("loss/policy"),
        "loss/gradient_norm": minibatches("gradient"),
    }
    if quantity == "parameters":
        minibatch_metrics = dict.fromkeys(minibatch_metrics, jnp.ones((2, 3)))
    number = first_fault(
        value("reward"), {"mean": value("observation")}, minibatch_metrics, value("parameters")
    )
    assert CHECKED[number - 1] == quantity


def test_no_fault_where_all_is_finite() -> None:
    minibatch_metrics = dict.fromkeys(
        ("loss/value", "loss/policy", "loss/gradient_norm"), jnp.ones((2, 3))
    )
    assert first_fault(jnp.ones(()), jnp.ones(3), minibatch_metrics, jnp.ones(4)) == 0


def test_non_finite_state_is_reset_reported_and_does_not_spread(
    run: Path, straight: Path, monkeypatch, capfd
) -> None:
    def spoil(state):
        physics = state.env.env.pipeline_state.physics
        broken = physics._replace(qvel=physics.qvel.at[2, 5].set(jnp.nan))
        pipeline = state.env.env.pipeline_state._replace(physics=broken)
        env = state.env.env.replace(pipeline_state=pipeline)
        return state._replace(env=state.env._replace(env=env))

    change_state(monkeypatch, 3, spoil)
    resume(run, "--total-steps", str(STEPS))
    said = "states that were not finite, whose environments were reset: 1\n"
    assert said in capfd.readouterr().out
    counts = EventAccumulator(str(run)).Reload().Scalars("task/non_finite")
    assert {event.step: event.value for event in counts} == {64: 0, 128: 0, 192: 1, 256: 0}
    for name, array in arrays(latest_checkpoint(run)).items():
        assert np.isfinite(array).all(), name
