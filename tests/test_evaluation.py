"""The results of an evaluation are counted, judged and shown as specified, on both engines."""

import functools
import io
import itertools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pydantic
import pytest
from rich.console import Console

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.config.user_code import import_code
from bounce_mjx.env.env import Env, Redraw, State
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation import c_episodes, policy_evaluation
from bounce_mjx.evaluation.c_episodes import episode_models, make_mujoco_evaluator
from bounce_mjx.evaluation.config import EvaluationOptions
from bounce_mjx.evaluation.episodes import make_evaluator, reset_episodes
from bounce_mjx.evaluation.policy_evaluation import evaluate_policy
from bounce_mjx.evaluation.results import Report, Result, judge
from bounce_mjx.evaluation.statistics import Statistics, accumulate, empty_statistics
from bounce_mjx.learning import policy
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import networks_of
from bounce_mjx.learning.statistics import init_normalizer
from bounce_mjx.physics import PhysicsParameters
from bounce_mjx.reports.tables import details_line, seeds_table
from bounce_mjx.resources import TASK_POLICIES
from bounce_mjx.task import Tally, mean_of_events, share_of_episodes, share_of_events
from bounce_mjx.task.registry import find_task

AUTORESET = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
BOUNCES, HORIZONTAL, HEIGHT, SPEED, STABLE = range(5)
TARGET_X = 0.58856
DRIBBLE = Path(__file__).parent.parent / "examples" / "dribble_task.py"
METRICS = "bounced", "n_bounces", "apex_error", "apex_offset"


def states(rows) -> State:
    """A batch (batch axis last) from one dict of values per episode."""
    defaults = {
        "x": TARGET_X, "y": 0.0, "vz": 0.0, "reward": 0.0, "done": 0.0,
        "bounced": 0.0, "n_bounces": 0.0, "apex_error": 0.0, "apex_offset": 0.0,
    }  # fmt: skip
    columns = {
        name: jnp.array([row.get(name, default) for row in rows], jnp.float32)
        for name, default in defaults.items()
    }
    batch = jax.tree.map(lambda x: jnp.stack([x] * len(rows), axis=-1), resting_state())
    physics = batch.pipeline_state.physics
    physics = physics._replace(
        qpos=physics.qpos.at[6].set(columns["x"]).at[7].set(columns["y"]),
        qvel=physics.qvel.at[8].set(columns["vz"]),
    )
    metrics = {name: columns[name] for name in METRICS}
    return batch.replace(
        pipeline_state=batch.pipeline_state._replace(physics=physics),
        reward=columns["reward"],
        done=columns["done"],
        metrics=batch.metrics | metrics,
    )


@functools.cache
def resting_state() -> State:
    return jax.jit(BounceBall().reset)(jax.random.key(0))


def count(env, steps, first_step=0) -> Statistics:
    """Statistics after a list of steps; each step is a list of one dict per episode."""
    statistics = empty_statistics(env, states(steps[0]))
    for i, rows in enumerate(steps, start=first_step):
        statistics = accumulate(env, statistics, states(rows), jnp.int32(i))
    return flat(statistics)


class Flat(dict):
    """Every figure of statistics by its name, also as an attribute."""

    __getattr__ = dict.__getitem__


def flat(statistics: Statistics) -> Flat:
    """The figures, with those that the task tallies, as NumPy arrays."""
    statistics = jax.tree.map(np.asarray, statistics)
    tally = statistics.tally
    names = {"running", "steps", "episode_return", *tally.sums, *tally.maxima}
    assert len(names) == 3 + len(tally.sums) + len(tally.maxima)
    return Flat(statistics._asdict() | tally.sums | tally.maxima)


def test_episode_counts_up_to_its_end(env):
    row = {"reward": 2.0, "vz": 1.0, "n_bounces": 3.0, "bounced": 1.0}
    last = row | {"done": 1.0, "n_bounces": 4.0}
    late = row | {"n_bounces": 9.0}
    s = count(env, [[row, row], [last, row], [late, row], [late, row]], first_step=300)
    np.testing.assert_array_equal(s.running, [False, True])
    np.testing.assert_array_equal(s.steps, [2, 4])
    np.testing.assert_array_equal(s.episode_return, [4, 8])
    np.testing.assert_array_equal(s.n_bounces, [4, 3])
    np.testing.assert_array_equal(s.settled_steps, [2, 4])
    np.testing.assert_array_equal(s.centred_steps, [2, 4])
    np.testing.assert_array_equal(s.settled_bounces, [2, 4])
    np.testing.assert_array_equal(s.accurate_bounces, [2, 4])
    np.testing.assert_array_equal(s.rising_steps, [2, 4])


def test_settling_takes_two_seconds(env):
    """Step i, from 0, ends at (i + 1) * 0.01 s; the first 200 end within the first 2 s."""
    row = {"bounced": 1.0, "apex_error": 0.05, "vz": 1.0}
    s = count(env, [[row]] * 4, first_step=198)
    np.testing.assert_array_equal(s.settled_steps, [2])
    np.testing.assert_array_equal(s.centred_steps, [2])
    np.testing.assert_array_equal(s.settled_bounces, [2])
    np.testing.assert_array_equal(s.accurate_bounces, [2])
    np.testing.assert_allclose(s.apex_error, [0.1])
    # The upward speed is measured over the whole episode.
    np.testing.assert_array_equal(s.rising_steps, [4])


@pytest.mark.slow
def test_bounces_settle_again_after_a_change_of_the_target(env):
    """Ages after the step, of a target that changed 0.01, 2 and 2.01 s before; and of one that
    never does."""
    row = {"bounced": 1.0, "apex_error": 0.05}
    batch = states([row] * 4)
    redraw = Redraw(
        age=jnp.array([0.01, 2.0, 2.01, 7.0], jnp.float32),
        ranges={"target_height": (jnp.full(4, 0.3), jnp.full(4, 0.8))},
    )
    changing = batch.pipeline_state._replace(redraw=redraw)
    batch = batch.replace(pipeline_state=changing)
    s = flat(accumulate(env, empty_statistics(env, batch), batch, jnp.int32(900)))
    np.testing.assert_array_equal(s.settled_bounces, [0, 0, 1, 1])
    np.testing.assert_array_equal(s.accurate_bounces, [0, 0, 1, 1])
    # The horizontal position does not depend on the target.
    np.testing.assert_array_equal(s.settled_steps, [1, 1, 1, 1])


def test_a_settled_step_counts_what_it_shows(env):
    """Within 5 cm of the target in x alone; a bounce within 10 cm in height; a rising speed."""
    for row, expected in (
        ({"x": TARGET_X + 0.0499}, {"centred_steps": 1}),
        ({"x": TARGET_X + 0.0501}, {"centred_steps": 0}),
        ({"x": TARGET_X - 0.0501}, {"centred_steps": 0}),
        ({"y": 1.0}, {"centred_steps": 1}),
        ({"bounced": 1.0, "apex_error": 0.0999}, {"settled_bounces": 1, "accurate_bounces": 1}),
        ({"bounced": 1.0, "apex_error": 0.1001}, {"settled_bounces": 1, "accurate_bounces": 0}),
        ({"apex_error": 0.05}, {"settled_bounces": 0, "accurate_bounces": 0, "apex_error": 0}),
        ({"vz": 0.5}, {"rising_steps": 1, "rising_speed": 0.5}),
        ({"vz": -3.0}, {"rising_steps": 0, "rising_speed": 0.0}),
    ):
        found = count(env, [[row]], first_step=500)
        for name, value in expected.items():
            np.testing.assert_array_equal(found[name], [value], err_msg=f"{row}, {name}")


# Judging

EPISODES = 200


def statistics(**changes) -> Statistics:
    """Statistics of 200 episodes of 20 s that meet every result; `changes` replace fields."""
    perfect = {
        "running": True, "steps": 2000, "episode_return": 20_000, "n_bounces": 40,
        "settled_steps": 1800, "centred_steps": 1800, "settled_bounces": 30,
        "accurate_bounces": 30, "apex_error": 0.6, "rising_steps": 900, "rising_speed": 900,
    }  # fmt: skip
    assert changes.keys() <= perfect.keys()
    values = {
        name: np.broadcast_to(value, EPISODES).astype(bool if name == "running" else np.float32)
        for name, value in (perfect | changes).items()
    }
    own = {name: values.pop(name) for name in ("running", "steps", "episode_return")}
    return Statistics(**own, tally=Tally(values, {"n_bounces": values.pop("n_bounces")}))


def first(number, value, rest):
    """`value` in the first `number` episodes, `rest` in the others."""
    return np.where(np.arange(EPISODES) < number, value, rest)


def test_perfect_statistics_pass(env):
    report = judge(env, statistics())
    assert report.passed
    assert [result.passed for result in report.results] == [True] * 5
    assert [result.value for result in report.results] == [100, 100, 100, 1, 100]
    assert report.details["episodes"] == EPISODES
    assert report.details["mean_consecutive_bounces"] == 40
    assert report.details["mean_return"] == 20_000
    np.testing.assert_allclose(report.details["mean_apex_error_m"], 0.02, rtol=1e-6)
    np.testing.assert_allclose(report.details["mean_length_s"], 20.0)
    assert report.score == (True, 5, 1.0, 20_000)


def test_result_at_its_bound(env):
    for result, changes, value, passed in (
        # 99% of 200 episodes is 198.
        (BOUNCES, {"n_bounces": first(198, 3, 2)}, 99.0, True),
        (BOUNCES, {"n_bounces": first(197, 3, 2)}, 98.5, False),
        # 95% of 1,800 steps are 1,710, of 30 bounces 28.5.
        (HORIZONTAL, {"centred_steps": 1710}, 95.0, True),
        (HORIZONTAL, {"centred_steps": first(1, 1709, 1710)}, 100 * 341999 / 360000, False),
        (HEIGHT, {"accurate_bounces": first(100, 28, 29)}, 95.0, True),
        (HEIGHT, {"accurate_bounces": first(101, 28, 29)}, 100 * 5699 / 6000, False),
        (SPEED, {"rising_speed": 90.1}, 90.1 / 900, True),
        (SPEED, {"rising_speed": 89.9}, 89.9 / 900, False),
        (SPEED, {"rising_speed": 1349.9}, 1349.9 / 900, True),
        (SPEED, {"rising_speed": 1350.1}, 1350.1 / 900, False),
        (STABLE, {"running": first(198, True, False)}, 99.0, True),
        (STABLE, {"running": first(197, True, False)}, 98.5, False),
    ):
        report = judge(env, statistics(**changes))
        np.testing.assert_allclose(report.results[result].value, value, rtol=1e-6)
        expected = [True] * 5
        expected[result] = passed
        assert [r.passed for r in report.results] == expected
        assert report.passed == passed


def test_nothing_to_measure_fails(env):
    """The result has no figure, because any number would be good for some quantities."""
    for result, changes in (
        (HEIGHT, {"settled_bounces": 0, "accurate_bounces": 0, "apex_error": 0}),
        (HORIZONTAL, {"settled_steps": 0, "centred_steps": 0}),
        (SPEED, {"rising_steps": 0, "rising_speed": 0}),
    ):
        report = judge(env, statistics(**changes))
        assert report.results[result].passed is False and not report.passed
        assert report.results[result].value is None
        assert (report.details["mean_apex_error_m"] is None) == (result == HEIGHT)
        plain = json.loads(json.dumps(report.to_dict(), allow_nan=False))
        assert plain["results"][result]["value"] is None
        assert pydantic.TypeAdapter(Report).validate_python(plain) == report


def show(table) -> str:
    console = Console(width=80, file=io.StringIO())
    console.print(table)
    return console.file.getvalue()


def test_upward_speed_is_judged_only_for_low_targets(env):
    """Of the config, or of the goals that were drawn."""
    for (low, high), judged in (((0.4, 0.6), True), ((0.3, 0.6), False), ((0.4, 0.8), False)):
        configured = BounceBall(EnvConfig(target_height_range=(low, high)))
        for speed, passed in ((900, True), (9000, False)):
            figures = statistics(rising_speed=speed)
            given = {"target_height": (low, high)}
            reports = judge(configured, figures), judge(env, figures, goals=given)
            for report in reports:
                assert report.results[SPEED].passed is (passed if judged else None)
                np.testing.assert_allclose(report.results[SPEED].value, speed / 900)
                assert report.passed == (passed or not judged)
                assert judged or report.results[SPEED].margin is None


def half_in_half(low, high):
    """`low` in every second episode, `high` in the others: two standard errors of 64 episodes are
    an eighth of the difference."""
    return np.where(np.arange(EPISODES) % 2, low, high)


def test_margin_of_a_result(env):
    for result, changes, margin in (
        # Of 200 episodes 2 may fail, and half of them with a margin.
        (BOUNCES, {"n_bounces": first(199, 3, 2)}, 1.0),
        (BOUNCES, {"n_bounces": first(198, 3, 2)}, 0.0),
        (STABLE, {"running": first(198, True, False)}, 0.0),
        (SPEED, {"rising_speed": 900 * half_in_half(1.20, 1.67)}, 1.0),
        (SPEED, {"rising_speed": 900 * half_in_half(1.23, 1.71)}, 0.5),
        (SPEED, {"rising_speed": 900 * half_in_half(1.30, 1.78)}, 0.0),
        (SPEED, {"rising_speed": 900 * half_in_half(0.10, 0.14)}, 1.0),
        # 96% of 1,800 steps and of 50 bounces.
        (HORIZONTAL, {"centred_steps": 18 * half_in_half(88, 104)}, 0.5),
        (HEIGHT, {"settled_bounces": 50, "accurate_bounces": half_in_half(44, 52)}, 0.5),
        (HEIGHT, {"settled_bounces": 0, "accurate_bounces": 0}, 0.0),
    ):
        report = judge(env, statistics(**changes))
        np.testing.assert_allclose(report.results[result].margin, margin, atol=1e-5)
        np.testing.assert_allclose(report.margin, margin, atol=1e-5)
        assert report.passed_with_margin == (margin == 1.0)


def report_of(passed, mean_return, margin=0.0) -> Report:
    results = tuple(Result("", "", 0.0, "", p, margin) for p in passed)
    return Report(results, {"mean_return": mean_return})


def test_score_orders_by_results_met_and_margin_and_then_by_return():
    worst_first = [
        report_of([False] * 5, 500.0),
        report_of([True] + [False] * 4, 100.0),
        report_of([False] * 4 + [True], 200.0),
        report_of([True] * 4 + [False], 50.0),
        report_of([True, True, True, None, True], 10.0),
        report_of([True] * 5, 20.0),
        report_of([True] * 5, 5.0, margin=0.5),
        report_of([True] * 5, 1.0, margin=1.0),
        report_of([True] * 5, 2.0, margin=1.0),
    ]
    scores = [report.score for report in worst_first]
    assert scores == sorted(scores) and len(set(scores)) == len(scores)


@pytest.fixture(scope="module")
def networks():
    return policy.make_networks(PPOConfig(hidden_layers=(16,)), 29, 6)


@pytest.fixture(scope="module")
def random_policy(networks):
    params = networks.policy_network.init(jax.random.key(5))
    return policy.Policy(init_normalizer(29), params)


def heavy_and_light(key: jax.Array) -> PhysicsParameters:
    """Environment with balls of 1 to 100 times the mass."""
    return PhysicsParameters(ball_mass=0.0027 * 100.0 ** jax.random.uniform(key))


@pytest.mark.slow
def test_c_evaluates_each_episode_in_its_own_world(networks, random_policy):
    """C agrees with the fused engine, also on the drag of a bouncing ball, and not all worlds equal
    the model's."""
    config = EnvConfig(
        episode_seconds=0.3,
        ball_init_pos=(0.58856, 0.0, 0.1),
        randomization={"air_drag": (5.0, 10.0), "restitution": (0.7, 0.95)},
    )
    key = jax.random.PRNGKey(0)
    env = BounceBall(config, randomize=heavy_and_light)
    c = make_mujoco_evaluator(env, networks, 6)(random_policy, key)[0]
    ours = make_evaluator(env, networks, 6)(random_policy, key)[0]
    np.testing.assert_allclose(c.episode_return, ours.episode_return, rtol=1e-3, atol=1e-2)

    masses = jax.vmap(env.reset, out_axes=-1)(jax.random.split(key, 6)).pipeline_state.parameters
    models = episode_models(env, masses)
    np.testing.assert_allclose(
        [model.body("ball_link").mass[0] for model in models], masses.ball_mass, rtol=1e-6
    )
    assert len(episode_models(BounceBall(config), PhysicsParameters())) == 1
    assert all(model.opt.disableflags & AUTORESET for model in models)


@pytest.mark.slow
def test_mujoco_evaluator_agrees_with_the_fused_one(networks, random_policy):
    env = BounceBall(EnvConfig(episode_seconds=1.0))
    assert env.backend == "fused"
    key = jax.random.key(31)
    fused = flat(make_evaluator(env, networks, 8)(random_policy, key)[0])
    evaluate_on_c = make_mujoco_evaluator(env, networks, 8)
    on_c = flat(evaluate_on_c(random_policy, key)[0])
    assert np.any(fused.n_bounces > 0), "a contact is wanted"
    assert not np.all(fused.running), "an end is wanted"
    np.testing.assert_array_equal(on_c.running, fused.running)
    np.testing.assert_array_equal(on_c.n_bounces, fused.n_bounces)
    np.testing.assert_allclose(on_c.steps, fused.steps, rtol=0, atol=1)
    np.testing.assert_allclose(on_c.rising_steps, fused.rising_steps, rtol=0, atol=1)
    np.testing.assert_allclose(on_c.rising_speed, fused.rising_speed, rtol=1e-2, atol=1e-3)
    # One step more or less is worth up to about 15.
    np.testing.assert_allclose(on_c.episode_return, fused.episode_return, rtol=1e-2, atol=15)

    params = jax.tree.map(lambda x: jnp.nan * x, random_policy.params)
    broken = evaluate_on_c(random_policy._replace(params=params), key)[0]
    np.testing.assert_array_equal(broken.steps, 1)
    assert np.isfinite(broken.episode_return).all() and not np.any(broken.running)


def test_an_episode_that_diverges_on_c_ends(networks, random_policy, monkeypatch, tmp_path):
    """MuJoCo would put the arm and the ball back to the model's own pose and go on."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning into a file.
    env = BounceBall(EnvConfig(episode_seconds=0.1))

    def reset(*args):
        states = reset_episodes(*args)
        now = states.pipeline_state
        physics = now.physics._replace(qvel=now.physics.qvel.at[6, 1].set(1e11))
        return states.replace(pipeline_state=now._replace(physics=physics))

    monkeypatch.setattr(c_episodes, "reset_episodes", reset)
    evaluate = make_mujoco_evaluator(env, networks, 2)
    statistics, _ = evaluate(random_policy, jax.random.key(31))
    np.testing.assert_array_equal(statistics.steps, [10, 1])
    np.testing.assert_array_equal(statistics.ended_by["non_finite"], [False, True])
    # The environment's own model stays as it was compiled.
    assert not env.mj_model.opt.disableflags & AUTORESET


@pytest.mark.slow
def test_worlds_and_goals_are_those_of_the_training_or_of_the_options(monkeypatch):
    """A given goal replaces a drawn one, also where the world of the training changes it. A
    nominal evaluation draws no world, and its goals are the task's. The report is judged by the
    goals that were drawn."""
    drawn = {"goal_interval": (2.0, 4.0), "air_drag": (0.1, 0.2)}
    config = EnvConfig(target_height_range=(0.3, 0.8), randomization=drawn)
    seen, passed = [], []

    def make_evaluator(env, networks, episodes, recorded):
        def evaluate(policy, key, ranges):
            state = reset_episodes(env, key, episodes, ranges).pipeline_state
            seen.append(jax.tree.map(lambda x: x[..., 0], (state.world, state.goal)))
            # Too fast for a low target; at others the speed is not judged.
            return statistics(rising_speed=9000), None

        return evaluate

    monkeypatch.setattr(policy_evaluation, "make_evaluator", make_evaluator)
    for nominal, goals in itertools.product((False, True), ({}, {"target_height": 0.5})):
        options = EvaluationOptions(episodes=2, nominal=nominal, goals=goals)
        evaluated = evaluate_policy(None, config, networks_of(PPOConfig()), options)
        passed.append(evaluated.report.results[SPEED].passed)
    (own, height), (own_but_one, given), (none, tasks), (still_none, also_given) = seen
    assert own.keys() == drawn.keys() and own_but_one.keys() == {"air_drag"}
    assert 0.1 <= own_but_one["air_drag"] <= 0.2 and none == still_none == {}
    assert given == also_given == {"target_height": 0.5} != height
    assert 0.4 <= tasks["target_height"] <= 0.6
    assert passed == [None, False, False, False]


@pytest.fixture(scope="module")
def dribbling() -> Env:
    import_code(DRIBBLE)
    return Env(find_task("dribble").Config(ball_init_pos=(0.6, 0.0, 0.2)))


@pytest.mark.slow
def test_another_task_is_counted_and_judged_by_itself(dribbling):
    """Three invented episodes of its events, the last of which ends early."""
    start = jax.vmap(dribbling.reset, out_axes=-1)(jax.random.split(jax.random.key(0), 3))
    statistics = empty_statistics(dribbling, start)
    # Steps 199 and 200 end after 2.00 and 2.01 s, and only the latter counts.
    rows = [
        (199, [1, 1, 1], [1, 1, 1], [0, 0, 0]),
        (200, [1, 1, 0], [1, 1, 0], [0, 0, 0]),
        (201, [0, 1, 0], [0, 0, 0], [0, 0, 1]),
        (202, [0, 1, 1], [0, 1, 1], [0, 0, 0]),
    ]
    for step, apexes, low, done in rows:
        metrics = {"apexes": jnp.array(apexes, float), "low_apexes": jnp.array(low, float)}
        now = start.replace(
            metrics=start.metrics | metrics, done=jnp.array(done), reward=jnp.ones(3)
        )
        statistics = accumulate(dribbling, statistics, now, jnp.int32(step))
    report = judge(dribbling, statistics)
    assert [result.name for result in report.results] == ["height", "rate", "stable"]
    # Of 4 apexes 3 are low; they came in 3 + 3 + 2 steps of 10 ms.
    values = [result.value for result in report.results]
    np.testing.assert_allclose(values, [75.0, 4 / 0.08, 100 * 2 / 3], rtol=1e-5)
    assert [result.passed for result in report.results] == [False, True, False]
    assert report.summary == "1 of 3 results met"
    assert details_line(report) == "3 episodes: mean return 3.667, mean length 0.03667 s"
    rows = show(seeds_table({0: report, 1: None})).splitlines()
    assert rows[2].split()[:4] == ["seed", "height", "rate", "stable"]
    assert rows[3].split() == ["0", "75.00", "50.00", "66.67", "FAIL"]
    # The mean says that a seed is not in it.
    assert rows[5].split() == ["mean", "of", "1", "75.00", "50.00", "66.67", "0/2"]
    whole = show(seeds_table({0: report, 1: report})).splitlines()
    assert whole[5].split()[:2] == ["mean", "75.00"]


@pytest.mark.parametrize("name", ["steps", "passed", "screening"])
def test_a_result_may_not_have_the_name_of_a_records_own_key(name: str) -> None:
    with pytest.raises(UserError, match=f"has the name '{name}', .*; choose another name"):
        share_of_episodes(name, "episodes", np.ones(3, bool), 0.9)


@pytest.mark.parametrize("least", [95.0, -0.1, np.nan])
def test_a_least_share_that_is_no_share_is_refused(least: float) -> None:
    words = f"the result high has the least share {least:g}; give one from 0 to 1"
    with pytest.raises(UserError, match=words):
        share_of_episodes("high", "episodes", np.ones(3, bool), least)
    with pytest.raises(UserError, match=words):
        share_of_events("high", "apexes", np.ones(3), np.ones(3), least)


def test_bounds_between_which_nothing_lies_are_refused() -> None:
    with pytest.raises(UserError, match="the result rate has the bounds 5 and 3; give the lower"):
        mean_of_events("rate", "apexes a second", np.ones(3), np.ones(3), (5.0, 3.0))


def test_a_share_has_its_unit_once() -> None:
    for words in ("steps left of it", "steps left of it, %", "steps left of it %"):
        of_steps = share_of_events("left", words, np.ones(3), np.ones(3), 0.5)
        of_episodes = share_of_episodes("left", words, np.ones(3, bool), 0.5)
        assert of_steps.measured == of_episodes.measured == "steps left of it, %"


LASTS = share_of_episodes("lasts", "episodes", np.ones(3, bool), 0.9)


@pytest.mark.parametrize(
    ("method", "returned", "words"),
    [
        ("results", (), "results of the task Dribble returns none, by which nothing is judged"),
        ("results", (LASTS, LASTS), "Dribble returns 2 of the name 'lasts'; give each its own"),
        ("results", LASTS, r"results of the task Dribble returns Result\(.*; return a tuple of"),
        ("results", None, "results of the task Dribble returns None; return a tuple of"),
        ("details", {"apexes": np.ones(3)}, r"an array of the shape \(3,\) for apexes; return one"),
        ("details", [1.0], r"details of the task Dribble returns \[1.0\]; return a dictionary"),
    ],
)
def test_figures_that_a_report_cannot_hold_are_refused(
    method: str, returned: object, words: str, dribbling: Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    zeros = np.zeros(3)
    sums = dict.fromkeys(("apexes", "low_apexes", "seconds"), zeros)
    statistics = Statistics(np.ones(3, bool), zeros, zeros, Tally(sums))
    monkeypatch.setattr(dribbling.task, method, lambda _: returned)
    with pytest.raises(UserError, match=words):
        judge(dribbling, statistics)


@pytest.mark.parametrize("name", ["bounce", *TASK_POLICIES])
def test_each_task_judges_what_an_evaluation_gives_it(name) -> None:
    """Two episodes that lasted and in which nothing happened."""
    env = Env(find_task(name).Config())
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    shapes = jax.eval_shape(jax.vmap(env.reset, out_axes=-1), keys)
    states = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    report = judge(env, empty_statistics(env, states))
    assert report.results and report.details["episodes"] == 2.0
