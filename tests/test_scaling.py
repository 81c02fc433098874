"""Several seeds in one program, several devices, several hosts: each gives the same training as one
alone."""

import concurrent.futures
import contextlib
import itertools
import json
import re
import shutil
import socket
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import multihost_utils

import tiny_runs
from bounce_mjx.commands import train as train_command
from bounce_mjx.errors import UserError
from bounce_mjx.learning import ppo
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.folders import latest_checkpoint
from bounce_mjx.training import hosts, ppo_trainer
from tiny_runs import STEPS, TINY, arrays, job

SHARED = [*TINY, "--total-steps", str(2 * STEPS), "--no-report"]
SEEDS = 3


def train(log_dir: Path, *flags: str) -> Path:
    with tiny_runs.quick_compilation():
        train_command.main([*SHARED, "--log-dir", str(log_dir), *flags])
    (run,) = log_dir.iterdir()
    return run


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tmp_path_factory.mktemp("alone"))


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tmp_path_factory.mktemp("seeds"), "--num-seeds", str(SEEDS))


def assert_equal_up_to_rounding(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> None:
    """Checks that two trainings are equal up to the order of summation."""
    assert ours.keys() == theirs.keys()
    for name in theirs:
        if name.startswith("params"):
            # Adam magnifies the rounding of gradients near zero to at most a step of the learning
            # rate.
            np.testing.assert_allclose(ours[name], theirs[name], rtol=0, atol=1e-3, err_msg=name)
        elif name in ("key", "iteration", "env.clock", "env.length"):
            np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
        elif name.endswith("qpos"):
            np.testing.assert_allclose(ours[name], theirs[name], rtol=0, atol=1e-3, err_msg=name)


def test_a_training_overwrites_no_array_of_a_snapshot():
    """JAX keeps a buffer that NumPy sees, though the program was given it: the best policy of a
    training is such a view."""
    block = jax.jit(lambda state: state + 1.0, donate_argnums=0)
    state = block(jnp.zeros(1000))
    snapshot = multihost_utils.process_allgather(state, tiled=True)
    before = snapshot.copy()
    for _ in range(2):
        state = block(state)
    np.testing.assert_array_equal(snapshot, before)


def test_groups_hold_the_samples_of_their_environments():
    length, batch, groups = 3, 8, 4
    environment_ids = jnp.broadcast_to(jnp.arange(batch), (length, batch))
    at_time = jnp.broadcast_to(jnp.arange(length)[:, None], (length, batch))
    dealt = ppo.group(jnp.stack([environment_ids, at_time], axis=-1), groups)
    for i, samples in enumerate(np.asarray(dealt)):
        expected = {(env, t) for env in (2 * i, 2 * i + 1) for t in range(length)}
        assert {tuple(sample) for sample in samples.tolist()} == expected
        assert len(samples) == len(expected)


@pytest.mark.slow
def test_each_of_several_seeds_trains_as_if_alone(seeds: Path, alone: Path, tmp_path: Path):
    together = arrays(latest_checkpoint(seeds))
    for i, single in enumerate([alone, train(tmp_path / "1", "--seed", "1")]):
        theirs = arrays(latest_checkpoint(single))
        assert_equal_up_to_rounding({name: value[i] for name, value in together.items()}, theirs)
    assert (together["params.policy.params.Dense_0.kernel"].std(axis=0) > 0).any()


@pytest.mark.slow
def test_several_seeds_resume_exactly(seeds: Path, tmp_path: Path, quick_compilation: None):
    run = train(tmp_path / "half", "--num-seeds", str(SEEDS), "--total-steps", str(STEPS))
    train_command.main([str(run), "--total-steps", str(2 * STEPS), "--no-report"])
    ours, theirs = (arrays(latest_checkpoint(r)) for r in (run, seeds))
    for name in theirs:
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
    for i in range(SEEDS):
        seed = f"seed_{i:03d}"
        both = [json.loads((r / seed / "results.json").read_text()) for r in (run, seeds)]
        assert both[0]["evaluations"] == both[1]["evaluations"]
        assert both[0]["best_steps"] == both[1]["best_steps"]


@pytest.mark.slow
def test_eight_devices_train_as_one(
    alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick_compilation: None
):
    """And one device resumes what eight began."""
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=8")
    flags = [*SHARED, "--num-devices", "8", "--total-steps", "384", "--log-dir", tmp_path / "runs"]
    with job(tmp_path / "log", *flags) as eight:
        assert eight.wait() == 0, eight.said
    assert "device: 8 x cpu" in eight.said
    (run,) = (tmp_path / "runs").iterdir()
    total = ["--total-steps", str(2 * STEPS)]
    train_command.main([str(run), "--num-devices", "1", "--no-report", *total])
    assert_equal_up_to_rounding(arrays(latest_checkpoint(run)), arrays(latest_checkpoint(alone)))


@pytest.mark.parametrize(
    ("num_devices", "num_envs", "num_seeds", "sentence"),
    [
        (
            64,
            4096,
            1,
            "but the number of devices here is 8; give --num-devices 8",
        ),
        (
            3,
            4096,
            1,
            "makes 64 groups of environments, which cannot be divided among 3 devices; choose",
        ),
        (4, 4098, 1, "num_envs 4098 with num_minibatches"),
        (2, 4096, 3, "num_seeds 3 cannot be divided among 2 devices; choose a multiple of 2"),
    ],
)
def test_devices_that_cannot_share(monkeypatch, num_devices, num_envs, num_seeds, sentence):
    monkeypatch.setattr(jax, "devices", lambda: [jax.local_devices()[0]] * 8)
    config = PPOConfig(num_envs=num_envs, num_minibatches=1)
    with pytest.raises(UserError, match=sentence):
        ppo_trainer.make_mesh(num_devices, config, num_seeds)


def free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


@pytest.mark.slow
def test_two_processes_train_as_one(
    alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick_compilation: None
):
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    flags = [*SHARED, "--log-dir", tmp_path / "runs", "--num-processes", "2"]
    flags += ["--coordinator-address", f"127.0.0.1:{free_port()}"]
    with contextlib.ExitStack() as stack:
        processes = [
            stack.enter_context(job(tmp_path / f"log{i}", *flags, "--process-id", i))
            for i in range(2)
        ]
        for process in processes:
            assert process.wait() == 0, process.said
    leader, follower = (process.said for process in processes)
    assert "device: 4 x cpu" in leader
    assert "steps/s" in leader and "steps/s" not in follower
    (run,) = (tmp_path / "runs").iterdir()
    assert len(list(run.glob("events.*"))) == 1
    assert_equal_up_to_rounding(arrays(latest_checkpoint(run)), arrays(latest_checkpoint(alone)))


@pytest.mark.parametrize(
    ("flags", "several"),
    [
        ("--coordinator-address a:1 --num_processes 2e0 --process_id=1", True),
        ("--distributed --host_timeout 7", True),
        ("--distributed=false", False),
        ("--num-envs 8", False),
    ],
)
def test_flags_tell_whether_there_are_other_hosts(flags: str, several: bool) -> None:
    command = train_command.read_command(flags.split())
    assert command.flags.on_several_hosts == several
    assert command.flags.host_timeout == (7 if "7" in flags else 300)


@pytest.mark.parametrize(
    ("changes", "resume", "difference"),
    [
        (
            {"ppo": PPOConfig(hidden_layers=(8,))},
            None,
            r"processes 0 and 2 differ in ppo.hidden_layers, \[.+\] and \[8\];",
        ),
        ({}, Path("/runs/1"), 'differ in resume, null and "/runs/1";'),
        ({"log_dir": Path("elsewhere")}, None, None),
    ],
)
def test_the_setting_in_which_hosts_differ_is_named(
    changes, resume, difference, monkeypatch: pytest.MonkeyPatch
):
    def exchange(value):
        """Processes 0 and 1 agree, and this is process 2."""
        common = TrainConfig().model_dump(mode="json", exclude={"log_dir"}) | {"resume": None}
        return json.loads(json.dumps([common, common, value]))

    monkeypatch.setattr(hosts, "exchange", exchange)
    expected = (
        pytest.raises(UserError, match=difference) if difference else contextlib.nullcontext()
    )
    with expected:
        hosts.check_equal_configs(TrainConfig().model_copy(update=changes), resume)


def test_what_hosts_exchange_is_deleted_once_all_have_read_it(monkeypatch) -> None:
    """A long training would fill the memory of its leader."""
    stored: dict[str, str] = {}
    left: list[int] = []
    lock = threading.Condition()

    class Client:
        def key_value_set(self, key: str, value: str) -> None:
            with lock:
                stored[key] = value
                lock.notify_all()

        def blocking_key_value_get(self, key: str, _: int) -> str:
            with lock:
                assert lock.wait_for(lambda: key in stored, timeout=10)
                return stored[key]

        def key_value_delete(self, key: str) -> None:
            with lock:
                del stored[key]

    number = threading.local()

    class Processes:
        client = Client()
        num_processes = 2

        @property
        def process_id(self) -> int:
            return number.process

    def process(i: int) -> None:
        number.process = i
        for k in range(20):
            number.exchanges = itertools.count(k)
            assert hosts.exchange([i, k]) == [[0, k], [1, k]]
            left.append(len(stored))

    class Exchanges:
        """Each of the two processes has its own count."""

        def __next__(self) -> int:
            return next(number.exchanges)

    monkeypatch.setattr(hosts.distributed, "global_state", Processes())
    monkeypatch.setattr(hosts, "_exchanges", Exchanges())
    with concurrent.futures.ThreadPoolExecutor() as pool:
        list(pool.map(process, range(2)))
    assert max(left) <= 4 and len(stored) == 2


@pytest.mark.slow
def test_hosts_that_do_not_find_each_other_end_with_a_sentence(tmp_path: Path):
    flags = ["--coordinator-address", f"127.0.0.1:{free_port()}", "--num_processes", 2]
    with job(tmp_path / "log", *flags, "--process_id", 0, "--host-timeout", 2) as alone:
        assert alone.wait() == 2
    sentence = r"error: .+ cannot be joined \(TimeoutError\); .+ --host-timeout\n"
    assert re.fullmatch(sentence, alone.said)


@pytest.mark.slow
def test_distributed_without_a_launcher_gives_one_sentence(tmp_path: Path):
    with job(tmp_path / "log", "--distributed") as alone:
        assert alone.wait() == 2
    assert alone.said.startswith("error: the processes cannot be joined")
    assert alone.said.count("\n") == 1
    assert shutil.which("srun") is None or "Traceback" not in alone.said
