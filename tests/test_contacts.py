"""Contacts of the arm with itself and the floor in a recording."""

import json

import jax
import numpy as np
import pytest

from bounce_mjx import EnvConfig
from bounce_mjx.commands.main import main
from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.contacts import arm_contacts, describe_contacts
from bounce_mjx.evaluation.episodes import make_recording_evaluator
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import pretrained_checkpoint
from bounce_mjx.runs.reading import read_policy
from bounce_mjx.task.shown import Recording

HOME = np.radians([0.0, 40.0, 110.0, 0.0, -60.0, 0.0])


def recording(joint_angles: np.ndarray, running: np.ndarray | None = None) -> Recording:
    """Episodes with the same postures [T, 6]."""
    steps = len(joint_angles)
    running = np.ones((steps, 2), bool) if running is None else running
    empty = np.zeros((steps, 3, 2))
    return Recording(np.stack([joint_angles] * 2, axis=-1), empty, empty, {}, {}, running)


def test_an_arm_that_folds_or_dives_touches() -> None:
    config = EnvConfig()
    assert arm_contacts(config, recording(HOME[None])) == []
    # The wrist folds until the paddle is in the forearm.
    folded = HOME + np.outer(np.linspace(0.0, 1.0, 30), [0.0, 0.0, 0.0, 0.0, -2.0, 0.0])
    (first, *_) = found = arm_contacts(config, recording(folded))
    assert first.episodes == 2 and "the floor" not in str(found)
    # The shoulder leans forward until the paddle is on the floor.
    diving = HOME + np.outer(np.linspace(0.0, 1.0, 30), [0.0, 0.8, 0.0, 0.0, 0.0, 0.0])
    found = arm_contacts(config, recording(diving))
    assert any("the floor" in contact.bodies for contact in found)
    assert all(contact.steps < 2 * 30 for contact in found)
    # An episode that has ended does not count.
    running = np.ones((30, 2), bool)
    running[:, 1] = False
    assert all(c.episodes == 1 for c in arm_contacts(config, recording(diving, running)))


def test_a_margin_counts_what_is_near() -> None:
    config = EnvConfig()
    diving = HOME + np.outer(np.linspace(0.0, 1.0, 60), [0.0, 0.8, 0.0, 0.0, 0.0, 0.0])
    steps = [
        sum(
            c.steps
            for c in arm_contacts(config, recording(diving), margin)
            if "the floor" in c.bodies
        )
        for margin in (0.0, 0.005, 0.02)
    ]
    assert steps[0] < steps[1] < steps[2]


@pytest.mark.slow
def test_the_shipped_policy_touches_the_floor_only_after_a_noisy_start() -> None:
    """The paddle's home is 5 cm above the floor, and a reset's noise can lower it by as much."""
    checkpoint = pretrained_checkpoint()
    config = load_run_config(checkpoint.run)
    env_config = config.env.model_copy(update={"episode_seconds": 3.0})
    env = Env(env_config)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    evaluate = make_recording_evaluator(env, networks, 8, 8)
    _, recorded = evaluate(read_policy(checkpoint, config), jax.random.PRNGKey(0))
    found = arm_contacts(env_config, recorded)
    assert all("the floor" in contact.bodies for contact in found)
    later = np.array(recorded.running)
    later[:100] = False
    assert arm_contacts(env_config, recorded._replace(running=later)) == []
    assert describe_contacts([], 8) == "contacts of the arm in 8 episodes: none"


@pytest.mark.parametrize("angle", [0.0, 0.3])
def test_neighbours_and_the_start_pose_are_no_contacts(angle: float) -> None:
    config = EnvConfig(default_joint_angles=tuple(HOME + angle))
    assert arm_contacts(config, recording((HOME + angle)[None])) == []


@pytest.mark.slow
def test_eval_counts_them(capsys: pytest.CaptureFixture, tmp_path) -> None:
    file = tmp_path / "results.json"
    with pytest.raises(SystemExit):
        main(["eval", "pretrained", "--episodes", "4", "--contacts", "--json", str(file)])
    assert "contacts of the arm in 32 episodes: " in capsys.readouterr().out
    found = json.loads(file.read_text())["contacts"]
    assert all("the floor" in contact["bodies"] for contact in found)
