"""A real training that is signalled, killed or resumed reaches exactly the state of an undisturbed
one (`test_job.py` has the job's own logic)."""

import concurrent.futures
import itertools
import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bounce_mjx.commands import train as train_command
from bounce_mjx.env.bounce_ball import BounceBall
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import judge
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.runs.checkpoints import read_actor, read_policy, read_record, save_checkpoint
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import (
    best_checkpoint,
    find_checkpoint,
    latest_checkpoint,
    stored_checkpoints,
)
from bounce_mjx.runs.progress import Progress
from bounce_mjx.training.evaluators import Evaluators
from bounce_mjx.training.ppo_trainer import PPOTrainer, make_mesh
from tiny_runs import STEPS, TIMEOUT, TINY, arrays, job, shared_run


def train(log_dir: Path, steps: int, *flags: str) -> Path:
    before = set(log_dir.glob("*"))
    flags = "--total-steps", str(steps), "--log-dir", str(log_dir), "--no-report", *flags
    train_command.main([*TINY, *flags])
    (run,) = set(log_dir.glob("*")) - before
    return run


def resume(run: Path, *flags: str) -> None:
    train_command.main([str(run), "--no-report", *flags])


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
def straight() -> Path:
    return shared_run()


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tmp_path_factory.mktemp("half"), STEPS // 2)


@pytest.fixture
def run(half: Path, tmp_path: Path) -> Path:
    """A copy of the run of 128 steps."""
    return shutil.copytree(half, tmp_path / "run")


@pytest.mark.slow
def test_resumed_training_is_the_same(run: Path, straight: Path) -> None:
    resume(run, "--total-steps", str(STEPS))
    assert_same_training(run, straight)


@pytest.mark.parametrize("pause", [0.4, 0.6], ids=["told twice", "second Ctrl-C"])
def test_second_ctrl_c_ends_the_process_at_once(pause: float) -> None:
    """Of two signals that are 0.4 s apart, the second one is the first one again, as a launcher
    forwards it. The process's clock is the test's: on a busy machine, seconds may pass meanwhile.
    """
    code = f"""
import time
from bounce_mjx.interrupt import StopRequest, end_on_ctrl_c
now = 100.0
time.monotonic = lambda: now
end_on_ctrl_c()
with StopRequest() as stop:
    print("ready", flush=True)
    while not stop.requested:
        time.sleep(0.01)
    now += {pause}
    print("requested", flush=True)
    input()
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "requested\n"
        process.send_signal(signal.SIGINT)
        if pause == 0.6:
            assert process.wait(TIMEOUT) == 130
        else:
            # Whoever reads the line has had the signal.
            process.communicate("\n", TIMEOUT)
            assert process.returncode == 0


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
        """A value that changes whenever a checkpoint comes or goes."""
        return [p.stat().st_mtime_ns for p in log_dir.glob("*/checkpoints")]

    def steps_saved() -> int:
        """Environment steps of the latest complete checkpoint."""
        stored = (x.number for run in log_dir.glob("*") for x in stored_checkpoints(run))
        return max(stored, default=0)

    def wait_until(happens: Callable[[], bool], period: float = 0.02) -> None:
        # Often enough for what happens; more would take a core from the training.
        deadline = time.monotonic() + TIMEOUT
        while not happens():
            assert process.is_alive() and time.monotonic() < deadline
            time.sleep(period)

    for moment in ("start", "any", "*.orbax-checkpoint-tmp", "*[0-9]", "any"):
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
            unfinished = f"*/checkpoints/.unfinished/{moment}"
            wait_until(lambda path=unfinished: any(log_dir.glob(path)), period=0.0002)
        process.kill()
        process.join()
        if steps_saved():
            (run,) = log_dir.glob("*")
            checkpoint = latest_checkpoint(run)
            arrays(checkpoint)
            assert checkpoint.number >= saved
            saved = checkpoint.number
            args = [str(run)]
        else:
            shutil.rmtree(log_dir, ignore_errors=True)
    assert saved > 64
    total = saved + 64
    resume(run, "--total-steps", str(total))
    assert_same_training(run, train(tmp_path / "straight", total, "--eval-every", "64"))
    log = EventAccumulator(str(run)).Reload()
    logged = [event.step for event in log.Scalars("loss/value")]
    assert logged == sorted(set(logged))


# Readers


def test_a_reader_reads_the_next_checkpoint_where_a_training_replaces_one(run: Path) -> None:
    """The policy that it reads is that of the checkpoint that it names."""
    config = load_run_config(run)
    policy = read_policy(latest_checkpoint(run), config)
    ended = threading.Event()

    def save() -> None:
        for steps in itertools.count(STEPS):
            marked = jax.tree.map(lambda leaf, steps=steps: np.full_like(leaf, steps), policy)
            save_checkpoint(run, config, steps, {"policy": marked})
            if ended.wait(0.02):
                return

    saver = threading.Thread(target=save)
    saver.start()
    try:
        read = [read_actor(find_checkpoint(run), config)[:2] for _ in range(10)]
    finally:
        ended.set()
        saver.join()
    assert len({checkpoint.number for checkpoint, _ in read}) > 1
    for checkpoint, marked in read:
        if checkpoint.number >= STEPS:
            assert all((leaf == checkpoint.number).all() for leaf in jax.tree.leaves(marked))


# Evaluations and logs


@pytest.mark.slow
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
        key = jax.random.PRNGKey(np.uint32(seed))
        return judge(env, *evaluate(policy, key)).details["mean_return"]

    assert selected["details"]["mean_return"] == pytest.approx(mean_return(config.eval_seed))
    fresh = mean_return(config.eval_seed + 2**31)
    assert results["details"]["mean_return"] == pytest.approx(fresh)
    assert fresh != pytest.approx(mean_return(config.eval_seed))


COUNTED = """
import sys, jax
from bounce_mjx.commands.train import main
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
main(sys.argv[1:])
names = "compile_requests_use_cache", "cache_hits"
print("counts:", *(events.count("/jax/compilation_cache/" + name) for name in names))
"""


@pytest.mark.slow
def test_a_second_start_compiles_nothing_and_trains_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick_compilation: None
) -> None:
    """The process of the first one gets a signal, and ends with 0; what it saves and says is in
    `test_job.py`. The second one trains for as long undisturbed."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    flags = [*TINY, "--eval-every", "64", "--no-report"]
    args = [*flags, "--total-steps", 10**6, "--log-dir", tmp_path / "first"]
    with job(tmp_path / "first.log", *args) as training:
        training.wait_until_said("evaluation at")
        training.process.send_signal(signal.SIGTERM)
        assert training.wait() == 0, training.said
    assert "Traceback" not in training.said
    assert "continue with: bounce-mjx train " in training.said
    (first,) = (tmp_path / "first").iterdir()
    stopped = latest_checkpoint(first)
    args = [*flags, "--total-steps", stopped.number, "--log-dir", tmp_path / "second"]
    with job(tmp_path / "second.log", *args, code=COUNTED) as process:
        assert process.wait() == 0, process.said
    ((requests, hits),) = re.findall(r"^counts: (\d+) (\d+)$", process.said, re.MULTILINE)
    assert hits == requests != "0"
    (second,) = (tmp_path / "second").iterdir()
    jax.tree.map(np.testing.assert_array_equal, arrays(stopped), arrays(latest_checkpoint(second)))


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
    (expected,) = whole.final([policy])
    (report,) = chunked.final([policy])
    assert report.details == pytest.approx(expected.details)
    jax.tree.map(
        lambda ours, theirs: np.testing.assert_allclose(ours, theirs, atol=1e-5),
        report.recording,
        expected.recording,
    )

    # Untrained, it misses results: the evaluation ends with its first three episodes.
    (screening,) = chunked.select([policy], [Progress()])
    key = jax.random.PRNGKey(np.uint32(config.eval_seed))
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    evaluate = make_evaluator(env, networks, config.eval_episodes)
    first_three = jax.tree.map(lambda x: x[:3], evaluate(policy, key)[0])
    assert screening.screening
    assert screening.details == pytest.approx(judge(env, first_three).details)


def change_state(monkeypatch, iteration: int, change: Callable) -> None:
    """Changes the state of every training before the given iteration."""
    train_block = PPOTrainer.train_block

    def train_changed(trainer: PPOTrainer, *args):
        if trainer.state.iteration == iteration - 1:
            trainer.state = change(trainer.state)
        return train_block(trainer, *args)

    monkeypatch.setattr(PPOTrainer, "train_block", train_changed)


@pytest.mark.slow
def test_a_parameter_that_is_not_finite_ends_a_training_with_2(
    run: Path, half: Path, monkeypatch, capfd
) -> None:
    """What the job says and keeps is in `test_job.py`; here the quantity is found, and nothing of
    it reaches the run's folder."""

    def spoil(state):
        params = jax.tree.map(lambda x: x * jnp.nan, state.params.policy)
        return state._replace(params=state.params._replace(policy=params))

    change_state(monkeypatch, 4, spoil)
    with pytest.raises(SystemExit) as exit_info:
        resume(run, "--total-steps", "100000")
    assert exit_info.value.code == 2
    sentence = capfd.readouterr().err
    assert re.fullmatch(r"error: .*loss/policy became infinite or NaN .+\n", sentence)
    assert_same_training(run, half)


@pytest.mark.slow
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
