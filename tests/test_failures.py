"""The failed episodes of an evaluation, and a film of one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx import EnvConfig
from bounce_mjx.evaluation import robustness
from bounce_mjx.evaluation.config import EvaluationOptions
from bounce_mjx.evaluation.episodes import make_evaluator, reset_episodes
from bounce_mjx.evaluation.failures import (
    Failure,
    associations,
    failures_of,
    film_episode,
    wilson_interval,
)
from bounce_mjx.evaluation.policy_evaluation import EpisodeSetup, setup_of
from bounce_mjx.evaluation.robustness import find_episode, measure_conditions
from bounce_mjx.evaluation.statistics import Statistics
from bounce_mjx.evaluation.suite import load_suite
from bounce_mjx.task.task import Recording, Tally
from bounce_mjx.viewers.film import FilmPlayer
from bounce_mjx.viewers.page import worst_episode

EPISODES, SEED = 130, 5


class _Jumpy:
    """Actions that differ from one observation to the next, so that a last bit matters."""

    def act(self, policy: jax.Array, observation: jax.Array) -> jax.Array:
        return jnp.tanh(observation @ policy)


@pytest.fixture(scope="module")
def conditions():
    world = {"action_latency": (0.0, 0.03), "paddle_tilt": (-0.05, 0.05), "restitution": (0.7, 0.9)}
    config = EnvConfig(episode_seconds=0.5, randomization=world)
    return setup_of(config, EvaluationOptions(EPISODES, SEED))


@pytest.fixture(scope="module")
def policy(conditions):
    return jax.random.normal(jax.random.key(0), (conditions.env.observation_size, 6))


@pytest.fixture(scope="module")
def measured(conditions, policy):
    """Statistics and recording of every episode of the evaluation."""
    evaluate = make_evaluator(conditions.env, _Jumpy(), EPISODES, EPISODES)
    return jax.device_get(evaluate(policy, jax.random.PRNGKey(SEED), conditions.ranges))


@pytest.mark.slow
@pytest.mark.parametrize("episode", [17, EPISODES - 1])
def test_a_film_is_the_episode_of_the_evaluation_bit_for_bit(
    conditions, policy, measured, episode
) -> None:
    statistics, recording = measured
    film = film_episode(conditions, _Jumpy(), policy, EPISODES, SEED, episode)
    own = jax.tree.map(lambda x: x[episode : episode + 1], statistics)
    jax.tree.map(np.testing.assert_array_equal, film.statistics, own)
    length = int(own.steps[0])
    player = FilmPlayer(film)
    assert len(player.frames.time) == length
    np.testing.assert_array_equal(
        player.frames.balls[:, 0, 0, 2], recording.ball[:length, 2, episode]
    )
    np.testing.assert_array_equal(
        player.frames.qpos[:, 0], np.asarray(recording.qpos)[:length, :, episode]
    )
    # The page shows the world in the sliders, and plays the film again at its end.
    world = {name: value[episode] for name, value in statistics.world.items()}
    assert {slider.term for slider in player.sliders} >= world.keys()
    for name, value in world.items():
        assert player.world_value(name) == np.ravel(value)[0]
    heights = [player.step().balls[0, 0, 2] for _ in range(length)]
    assert heights == [*player.frames.balls[1:, 0, 0, 2], player.frames.balls[0, 0, 0, 2]]


@pytest.mark.slow
def test_an_episode_is_the_same_in_any_number_of_them(conditions, policy, measured) -> None:
    episodes = 7
    evaluate = make_evaluator(conditions.env, _Jumpy(), episodes, EPISODES)
    few = jax.device_get(evaluate(policy, jax.random.PRNGKey(SEED), conditions.ranges))
    statistics, recording = measured
    jax.tree.map(
        lambda ours, all_: np.testing.assert_array_equal(ours, all_[:episodes]),
        few[0],
        statistics,
    )
    jax.tree.map(
        lambda ours, all_: np.testing.assert_array_equal(ours, all_[..., :episodes]),
        few[1],
        recording,
    )


@pytest.mark.slow
def test_a_film_of_a_condition_is_its_episode(policy, tmp_path, monkeypatch) -> None:
    """Of a suite whose conditions share a program with others, in calls of several conditions."""
    path = tmp_path / "suite.yaml"
    path.write_text(
        "perturbations:\n"
        "- {name: late, unit: ms, strengths: [10, 20], terms: {action_latency: strength}}\n"
        "- {name: tilt, terms: {paddle_tilt: {from: -0.1, to: 0.1}}}\n"
    )
    conditions = load_suite(path, EnvConfig(episode_seconds=0.5))
    judge, seen = robustness.judge, []

    def judged(env, statistics, **others):
        seen.append(jax.device_get(statistics))
        return judge(env, statistics, **others)

    monkeypatch.setattr(robustness, "judge", judged)
    options = EvaluationOptions(10, SEED)
    outcomes = measure_conditions(policy, lambda env: _Jumpy(), conditions, options)
    assert [outcome.label for outcome in outcomes] == [
        "nominal",
        "late 10 ms",
        "late 20 ms",
        "tilt",
    ]
    shown, episodes, episode = find_episode(conditions, 3, options, 7)
    film = film_episode(shown, _Jumpy(), policy, episodes, SEED, episode)
    own = jax.tree.map(lambda x: x[7:8], seen[3])
    # The sum of the rewards, which a film does not show, may round otherwise without a recording.
    assert film.statistics.episode_return == pytest.approx(own.episode_return, rel=1e-6)
    own = own._replace(episode_return=film.statistics.episode_return)
    jax.tree.map(np.testing.assert_array_equal, film.statistics, own)
    assert (7 in outcomes[3].lost) == (not film.statistics.running[0])
    assert film.statistics.world["action_latency"][0] == 0.0


@pytest.mark.slow
def test_each_failure_has_its_world_and_its_time(conditions, measured) -> None:
    statistics, recording = measured
    failures = failures_of(conditions, statistics)
    reset = jax.jit(lambda key: reset_episodes(conditions.env, key, EPISODES).pipeline_state)
    states = reset(jax.random.PRNGKey(SEED))
    lost = np.flatnonzero(~statistics.running)
    assert {one.episode for one in failures} >= {*lost.tolist()} and len(lost)
    for one in failures:
        assert one.seconds == pytest.approx(recording.running[:, one.episode].sum() * 0.01)
        assert one.lasted == bool(statistics.running[one.episode])
        for name, value in one.world.items():
            # Another program than that of the evaluation may round once more.
            np.testing.assert_allclose(value, states.world[name][..., one.episode], atol=1e-6)
        height = states.goal["target_height"][one.episode]
        assert one.goal == {"target_height": pytest.approx(float(height))}


def test_an_episode_misses_what_was_measured_of_it(env) -> None:
    """One that ended within its first seconds, one that lasted without a bounce, a good one, and
    one whose steps are off."""
    sums = {
        "settled_steps": [0, 1800, 1800, 1800],
        "centred_steps": [0, 1800, 1800, 900],
        "settled_bounces": [0, 0, 25, 25],
        "accurate_bounces": [0, 0, 25, 25],
        "apex_error": [0, 0, 1, 1],
        "rising_steps": [0, 0, 1, 1],
        "rising_speed": [0, 0, 1, 1],
    }
    tally = Tally(
        {name: np.array(values, float) for name, values in sums.items()},
        {"n_bounces": np.array([0.0, 0.0, 9.0, 9.0])},
    )
    lasted = np.array([False, True, True, True])
    statistics = Statistics(lasted, np.array([80, 2000, 2000, 2000]), np.zeros(4), tally)
    failures = failures_of(EpisodeSetup(env, {}, None), statistics)
    assert [(one.episode, one.seconds, one.failed) for one in failures] == [
        (0, 0.8, ("ended by the task", "consecutive bounces", "stable")),
        (1, 20.0, ("consecutive bounces", "height")),
        (3, 20.0, ("horizontal position",)),
    ]


def test_the_terms_that_go_with_failure_are_named() -> None:
    """A term whose upper third fails, among terms that say nothing."""
    generator = np.random.default_rng(0)
    world = {
        "action_latency": generator.uniform(0.0, 0.06, 600),
        "paddle_tilt": generator.uniform(-0.1, 0.1, (600, 2)),
    }
    fails = (world["action_latency"] > 0.04) & (generator.uniform(size=600) < 0.5)
    statistics = Statistics(
        running=~fails,
        steps=np.ones(600),
        episode_return=np.ones(600),
        tally=Tally({}, {}),
        world=world,
        goal={"target_height": np.full(600, 0.5)},
    )
    failures = [Failure(int(i), 1.0, False, ("stable",), {}, {}) for i in np.flatnonzero(fails)]
    found = associations(statistics, failures)
    # A goal that does not vary cannot go with anything.
    assert [one.name for one in found if one.is_clear] == ["action_latency"]
    assert {one.name for one in found} == {"action_latency", "paddle_tilt[0]", "paddle_tilt[1]"}
    assert [third.failed for third in found[0].thirds[:2]] == [0, 0]
    assert sum(third.episodes for third in found[0].thirds) == 600


def test_the_worst_episode_ends_first_or_has_the_lowest_return() -> None:
    """Of four steps and more; one that ends on the last of them is worse than one that lasts."""
    reward = np.array([1.0, 0.5, 1.0]) * np.ones((4, 3))
    for last_step, ended, worst in ((1, (), 1), (1, (2,), 2), (1, (0, 1), 1), (3, (2,), 2)):
        terminated = np.zeros((4, 3), bool)
        terminated[last_step, list(ended)] = True
        running = np.cumsum(terminated, axis=0) - terminated == 0
        # What follows the end of an episode does not count.
        values = np.where(running, reward, -100.0)
        recording = Recording(
            joint_angles=None,
            ball=None,
            paddle=None,
            goal={},
            running=running,
            terminated=terminated,
            metrics={"reward/height": values},
        )
        assert worst_episode(recording) == worst


@pytest.mark.parametrize(
    "successes, trials, interval",
    # R. G. Newcombe, "Two-sided confidence intervals for the single proportion", 1998, table I.
    [(81, 263, (0.2553, 0.3662)), (15, 148, (0.0624, 0.1605)), (0, 20, (0.0, 0.1611))],
)
def test_an_interval_of_a_share_is_wilsons(successes, trials, interval) -> None:
    np.testing.assert_allclose(wilson_interval(successes, trials), interval, atol=5e-5)


def test_no_trials_say_nothing() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)
