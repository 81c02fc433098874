"""A training that starts with the networks of an earlier one."""

import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml

import tiny_runs
from bounce_mjx.commands import train as train_command
from bounce_mjx.config.user_code import import_code
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import make_networks, untrained_policy
from bounce_mjx.learning.ppo import names_of_critic_metrics
from bounce_mjx.learning.statistics import normalize
from bounce_mjx.runs.checkpoints import (
    NETWORKS,
    POLICY,
    read_networks,
    read_policy,
    read_warm_start,
    save_checkpoint,
)
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.creation import create_run
from bounce_mjx.runs.folders import best_checkpoint, find_checkpoint
from bounce_mjx.runs.layers import layers_on
from bounce_mjx.runs.start import FileFlags, StartFlags, find_start
from tiny_runs import STEPS, TINY, settings_of

CRITIC = {"n_bounces", "world/restitution", "world/air_drag"}
WORLD = {
    "env": {"randomization": {"restitution": [0.8, 0.82], "action_latency": [0.01, 0.02]}},
    "sources": {"randomization": "Made for a test."},
}


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose value network sees two terms of the world."""
    log_dir = tmp_path_factory.mktemp("first") / "runs"
    flags = ["--critic-metrics", "n_bounces", "world/*", "--total-steps", str(STEPS)]
    terms = "--randomization.restitution 0.7 0.9 --randomization.air-drag 0.0 0.2".split()
    with tiny_runs.quick_compilation():
        train_command.main([*TINY, *flags, *terms, "--no-report", "--log-dir", str(log_dir)])
    (run,) = log_dir.iterdir()
    return run


def stored(run: Path):
    """Config, names of the critic metrics, networks, parameters and statistics of a run."""
    checkpoint, config = best_checkpoint(run), load_run_config(run)
    *read, names = read_networks(checkpoint, config)
    size = config.env.layout.size
    networks = make_networks(config.ppo, size, config.env.num_joints, len(names))
    return config, names, networks, *read


@pytest.mark.slow
def test_the_value_network_keeps_the_terms_of_both_worlds_and_is_blind_to_new_ones(
    first: Path, tmp_path: Path
) -> None:
    config, old_names, networks, params, statistics = stored(first)
    assert set(old_names) == CRITIC
    world = tmp_path / "world.yaml"
    world.write_text(yaml.safe_dump(WORLD))
    args = ["--warm-start", str(first), "--world", str(world), "--config", "cpu"]
    command = settings_of(args).config
    assert command.ppo.critic_metrics == ("n_bounces", "world/*")
    env = Env(command.env)
    names = names_of_critic_metrics(command.ppo, env)
    assert set(names) == {"n_bounces", "world/restitution", "world/action_latency"}
    start, seen = read_warm_start(command, env)
    size = command.env.layout.size
    of_first = jax.random.normal(jax.random.PRNGKey(2), (16, size + len(CRITIC)))
    # The term that is gone has its mean.
    at = {name: size + old_names.index(name) for name in old_names}
    gone = at["world/air_drag"]
    of_first = of_first.at[:, gone].set(statistics.mean[gone])
    unknown = np.linspace(-5.0, 5.0, 16)
    of_new = np.column_stack(
        [of_first[:, :size], *(of_first[:, at[n]] if n in at else unknown for n in names)]
    )
    old = networks.value_network.apply(params.value, normalize(of_first, statistics.normalizer))
    new = networks.value_network.apply(start.value, normalize(of_new, seen.normalizer))
    np.testing.assert_allclose(new, old, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_a_training_starts_with_the_policy_of_the_run(
    first: Path, tmp_path: Path, quick_compilation: None
) -> None:
    """Its first evaluation, before any step, is that of the run's policy."""
    args = [*TINY[: TINY.index("--hidden-layers")], *TINY[TINY.index("--block-steps") :]]
    args = [x for x in args if x not in ("--episode-seconds", "0.5")]
    args += ["--config", "cpu", "--warm-start", str(first), "--total-steps", str(STEPS)]
    train_command.main([*args, "--log-dir", str(tmp_path), "--num-seeds", "2", "--no-report"])
    (run,) = tmp_path.iterdir()
    assert load_run_config(run).warm_start == best_checkpoint(first).folder
    before = json.loads((first / "results.json").read_text())
    (expected,) = (e for e in before["evaluations"] if e["steps"] == before["best_steps"])
    for seed in ("seed_000", "seed_001"):
        results = json.loads((run / seed / "results.json").read_text())
        evaluations = {e.pop("steps"): e for e in results["evaluations"]}
        assert evaluations.keys() == {0, STEPS // 2, STEPS}
        expected.pop("steps", None)
        assert evaluations[0] == expected != evaluations[STEPS]


def test_the_small_robust_policy_can_be_trained_further() -> None:
    args = "--warm-start robust_small --config finetune --world fast_servo".split()
    command = settings_of(args).config
    assert str(command.warm_start) == "robust_small"
    assert command.env.randomization.terms and command.env.randomization.share == 1.0
    params, _ = read_warm_start(command, Env(command.env))
    checkpoint = find_checkpoint("robust_small")
    own = read_policy(checkpoint, load_run_config(checkpoint.run))
    jax.tree.map(np.testing.assert_array_equal, params.policy, own.params)


OWN_NETWORKS = """
from bounce_mjx.learning.ppo import PPO
class Own(PPO):
    def make_networks(self):
        return super().make_networks()
"""


def test_networks_of_an_own_algorithm_are_no_warm_start(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN_NETWORKS)
    import_code(tmp_path / "own.py")
    flags = [*TINY, "--log-dir", str(tmp_path / "runs"), "--algorithm", "own"]
    config = settings_of(flags).config
    with pytest.raises(UserError, match="Own makes networks of its own, which --warm-start cannot"):
        read_warm_start(
            config.model_copy(update={"warm_start": Path("robust_small")}), Env(config.env)
        )
    # A run whose networks are others.
    run = create_run(config)
    size = config.env.layout.size
    networks = make_networks(config.ppo, size, config.env.num_joints)
    items = {
        POLICY: untrained_policy(networks, size, jax.random.PRNGKey(0)),
        NETWORKS: {"params": np.zeros(3), "statistics": np.zeros(3)},
    }
    save_checkpoint(run, config, STEPS, items)
    with pytest.raises(UserError, match="cannot be read as networks of PPO .its algorithm is own"):
        read_networks(best_checkpoint(run), config)


def test_the_latest_run_is_that_beside_the_new_one_or_else_of_the_task(
    tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs/bounce_ball/2026-01-01_00-00-00"
    shutil.copytree(find_checkpoint("robust_small").run, run)
    config = settings_of("--warm-start latest --log-dir new".split()).config
    assert config.warm_start == best_checkpoint(run).folder
    assert config.log_dir == Path("new")
    # But where the new one's folder has runs, it is one of those, as for a run that is resumed.
    other = shutil.copytree(run, tmp_path / "mine/2025-01-01_00-00-00")
    config = settings_of("--warm-start latest --log-dir mine".split()).config
    assert config.warm_start == best_checkpoint(other).folder
    # A whole config may name it too.
    whole = TrainConfig(warm_start=Path("latest"), env=config.env, ppo=config.ppo)
    start = find_start(None, StartFlags(log_dir=Path("mine")), whole)
    config = layers_on(start, FileFlags()).config()
    assert config.warm_start == best_checkpoint(other).folder
    assert config.sources["warm_start"] == "config"
