"""A task is a file among others: of the package, of a user, of another package."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rest_task
from bounce_mjx import load_policy, task
from bounce_mjx.commands import train as train_command
from bounce_mjx.commands.eval import EvalCommand
from bounce_mjx.commands.goals import parse_with_goals
from bounce_mjx.commands.main import main
from bounce_mjx.commands.play import PlayCommand
from bounce_mjx.config import user_code
from bounce_mjx.config.files import dump_config
from bounce_mjx.config.user_code import import_code
from bounce_mjx.config.validation import validate
from bounce_mjx.env.env import Env, EnvState
from bounce_mjx.env.vector import VectorStep
from bounce_mjx.errors import UserError
from bounce_mjx.learning.metrics import rollout_metrics, step_metrics
from bounce_mjx.runs import checkpoints
from bounce_mjx.runs.config import CONFIG_FILE, TrainConfig, import_flags_of_run, load_run_config
from bounce_mjx.runs.creation import create_run
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.runs.storage import seal
from bounce_mjx.task import paths, registry
from bounce_mjx.task.registry import find_task, task_name
from bounce_mjx.world.observation import ObservationLayout, Part
from bounce_mjx.world.sensing import Sensing
from tiny_runs import TINY, settings_of

CHECKOUT = Path(__file__).parent.parent

REST = CHECKOUT / "tests" / "rest_task.py"
DRIBBLE = CHECKOUT / "examples" / "dribble_task.py"


# A row of the results of `REST`.
RESULT = r"rests +episodes"


@pytest.mark.slow
def test_a_task_without_events_goes_through_every_command(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    quick_compilation: None,
) -> None:
    """It has no goal, event, curve, marker or plot."""
    monkeypatch.chdir(tmp_path)

    def command(*args: str, code: int = 0) -> str:
        """The output of a command, which must exit with `code`."""
        status = 0
        try:
            main([*args])
        except SystemExit as end:
            status = end.code or 0
        said = "".join(capsys.readouterr())
        assert status == code, said
        return said

    task = ("--task", "rest", "--import", str(REST))
    said = command("train", "rest", *task[2:], *TINY, "--total-steps", "128")
    assert re.search(RESULT, said) and "report:" in said
    (line,) = re.findall(r"measure it: bounce-mjx (eval .+)", said)
    _, run, *imports = shlex.split(line)
    assert imports == ["--import", f"{run}/task/{REST.name}"]
    (folder,) = (tmp_path / "runs" / "rest").iterdir()
    assert "rests" in (folder / "report.html").read_text(encoding="utf-8")
    assert re.search(RESULT, command("eval", *task, "--episodes", "4"))
    command("play", *task, "--html", "play.html", "--seconds", "0.1")
    flags = ("--html", "x.html", "--actions", "mirror")
    assert "target_height" in command("view", *task, *flags, code=2)
    command("plot", *task, "--formats", "svg")
    command("export", *task, "--onnx", "rest.onnx")
    policy, again = load_policy("rest.onnx"), load_policy(folder)
    assert again.metadata == policy.metadata
    measured = {
        "joint_angles": policy.metadata.default_joint_angles,
        "joint_velocities": np.zeros(6),
        "ball_position": (0.58856, 0.0, 0.075),
        "ball_velocity": np.zeros(3),
    }
    assert policy.step({name: measured[name] for name in policy.needs}).shape == (6,)


def test_a_goal_that_the_policy_does_not_see_is_refused() -> None:
    bounce = find_task("bounce").Config
    unseen = {"target_height": 0}
    with pytest.raises(UserError, match="not see the goal target_height, which varies from 0.4"):
        Env(bounce(observation=unseen))
    # A fixed one, or one that a quantity of the task may show.
    Env(bounce(observation=unseen, target_height_range=(0.5, 0.5)))
    Env(bounce(observation=unseen | {"apex_error": 1}))

    class Config(bounce):
        """A goal with the name of a setting that shows nothing."""

        @property
        def goals(self) -> dict[str, task.Goal]:
            return {"velocity": task.Goal(0.0, 1.0)}

    with pytest.raises(UserError, match="not see the goal velocity, which varies from 0 to 1"):
        Env(Config())


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("ball_mass", "a term of the randomisation"),
        ("joint_angles", "a measurement"),
        ("apex_error", "a quantity of the task; choose .* give the quantity the group goal"),
    ],
)
def test_a_goal_with_the_name_of_something_else_is_refused(name, kind) -> None:
    class Config(find_task("bounce").Config):
        @property
        def goals(self) -> dict[str, task.Goal]:
            return {name: task.Goal(0.0, 1.0, hidden=True)}

    with pytest.raises(UserError, match=f"the goal {name} has the name of {kind}"):
        Env(Config())


@pytest.mark.parametrize("name", ["too_fast", "world/wind", "reward/height", "steps"])
def test_a_metric_with_a_name_of_the_environment_is_refused(name) -> None:
    balance = find_task("balance")

    class Named(balance):
        class Config(balance.Config):
            pass

        def step(self, state, step):
            result = super().step(state, step)
            return result._replace(metrics=result.metrics | {name: 1.0})

    with pytest.raises(UserError, match=f"the metric {name} of the task Named has a name of"):
        jax.eval_shape(Env(Named.Config()).reset, jax.random.PRNGKey(0))


@pytest.mark.parametrize(
    "tag",
    [
        "task/error",  # of the curve of balance itself
        "task/drop",  # of a metric that no curve shows
        "task/non_finite",
        "episode/length",
        "length",
        "loss/value",
        "reward/centre",
    ],
)
def test_a_curve_with_the_tag_of_another_is_refused(tag) -> None:
    """In the log, one would silently take the other's place."""
    balance = find_task("balance")

    class Twice(balance):
        class Config(balance.Config):
            pass

        curves = (*balance.curves, task.Curve(tag, "error"))

        def step(self, state, step):
            result = super().step(state, step)
            return result._replace(metrics=result.metrics | {"drop": 1.0})

    with pytest.raises(UserError, match=f"the tag {tag} of a curve of the task Twice is taken"):
        jax.eval_shape(Env(Twice.Config()).reset, jax.random.PRNGKey(0))


class _Wrong(rest_task.Rest):
    """The tests give it a wrong method."""

    class Config(rest_task.Rest.Config):
        goals: ClassVar = {"height": task.Goal(0.4, 0.4)}


@pytest.fixture(scope="module")
def wrong() -> Env:
    return Env(_Wrong.Config())


TWO_BOOLS = jnp.zeros(2, bool)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"reward": {"still": jnp.ones(3)}},
            r"step of the task _Wrong \(test_tasks.py, line \d+\) returns float32 of the shape "
            r"\(3,\) for reward\['still'\]; return one number",
        ),
        ({"reward": {"still": None}}, r"returns None for reward\['still'\]; return one number"),
        ({"reward": jnp.ones(())}, "returns float32 of .* for reward; return a dictionary"),
        ({"metrics": {"drop": jnp.ones((1,))}}, r"float32 of .* \(1,\) for metrics\['drop'\]"),
        ({"ended": jnp.zeros(())}, "_Wrong .* returns float32 of .* for ended; return one bool"),
        ({"ended": TWO_BOOLS}, r"returns bool of the shape \(2,\) for ended; return one bool"),
        ({"state": jnp.zeros(())}, r"float32 of .* for state; return a tuple of the same struct"),
        ({"metrics": {"drop": "low"}}, "returns something that is no array .*; return arrays and"),
    ],
)
def test_a_step_that_returns_something_else_is_refused(
    changes: dict, words: str, wrong: Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its name, where JAX would stack it, or end in an error of its own."""

    def step(self, state: tuple, step: task.Step) -> task.TaskStep:
        return rest_task.Rest.step(self, state, step)._replace(**changes)

    monkeypatch.setattr(_Wrong, "step", step)
    with pytest.raises(UserError, match=words):
        jax.eval_shape(lambda key: wrong.reset(key), jax.random.key(0))


GOAL = r"of the task _Wrong \(test_tasks.py, line \d+\) returns"


@pytest.mark.parametrize(
    ("method", "returned", "words"),
    [
        ("step", None, "step of the task _Wrong .* returns None; return a task.TaskStep"),
        ("reset", {"rose": False}, "returns a tuple for state; return a dict of the same struct"),
        ("first_goal", None, f"first_goal {GOAL} None; return a dictionary"),
        ("first_goal", {"height": jnp.ones(1)}, r"float32 of the shape \(1,\) for \['height'\]"),
        ("next_goal", {"height": jnp.ones(1)}, rf"next_goal {GOAL} .* for \['height'\];"),
        ("next_goal", {"height": 1}, rf"next_goal {GOAL} a int for \['height'\]; return"),
        ("next_goal", {"height": jnp.int32(1)}, f"{GOAL} int32 .* of a floating-point type"),
        ("throw", np.zeros(3), rf"throw {GOAL} float64 of the shape \(3,\); return the pos"),
        ("throw", (np.zeros(2), np.zeros(3)), r"a tuple of the shapes \(2,\), \(3,\); return"),
    ],
)
def test_a_method_that_returns_something_else_is_refused(
    method: str, returned: object, words: str, wrong: Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_Wrong, method, lambda *_: returned)
    with pytest.raises(UserError, match=words):
        jax.eval_shape(lambda key: wrong.reset(key), jax.random.key(0))


def test_a_state_that_changes_its_type_is_refused(
    wrong: Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the name of its part."""

    def step(self, state: dict, step: task.Step) -> task.TaskStep:
        return rest_task.Rest.step(self, (), step)._replace(state={"rose": jnp.zeros(())})

    monkeypatch.setattr(_Wrong, "step", step)
    monkeypatch.setattr(_Wrong, "reset", lambda *_: {"rose": False})
    words = r"returns float32 .* for state\['rose'\]; return bool of the shape \(\), as at a reset"
    with pytest.raises(UserError, match=words):
        jax.eval_shape(lambda key: wrong.reset(key), jax.random.key(0))


@pytest.mark.parametrize(
    ("tally", "words"),
    [
        ({"speed": 1.0}, "tally of the task _Wrong .* returns a dict; return a task.Tally"),
        (task.Tally({"p": jnp.ones(3)}), r"returns float32 of the shape \(3,\) for sums\['p'\]"),
        (task.Tally({}, {"p": jnp.ones(3)}), r"returns float32 of .* for maxima\['p'\]; return o"),
    ],
)
def test_a_tally_that_is_not_numbers_is_refused(
    tally: object, words: str, wrong: Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the first reset, as everything that a task returns."""
    monkeypatch.setattr(_Wrong, "tally", lambda *_: tally)
    with pytest.raises(UserError, match=words):
        jax.eval_shape(lambda key: wrong.reset(key), jax.random.key(0))


@pytest.mark.parametrize(
    ("method", "body", "words"),
    [
        (
            "step",
            lambda task, state, step: step.comand,
            r"ends in AttributeError: .*comand.* mean",
        ),
        (
            "step",
            lambda task, state, step: step.goal["hieght"],
            r"_Wrong \(test_tasks.py, line \d+\) ends in KeyError: 'hieght' \(did you mean",
        ),
        (
            "step",
            lambda task, state, step: 1 if step.truth.ball_position[2] > 0 else 0,
            "ends in TracerBoolConversionError, as Python's if, .*; write jnp.where",
        ),
        (
            "step",
            lambda task, state, step: step.action + step.truth.ball_position,
            "ends in TypeError: add got incompatible shapes",
        ),
        ("results", lambda task, episodes: episodes.sums["rest"], "results of .* KeyError: 'rest'"),
        (
            "results",
            lambda task, episodes: None,
            "results .* returns None; return a tuple of task.R",
        ),
        (
            "results",
            lambda task, episodes: 1.0 / len(episodes.maxima),
            "ends in ZeroDivisionError: ",
        ),
    ],
)
def test_an_error_in_a_task_is_one_sentence_with_its_line(
    method: str, body: object, words: str, wrong: Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything is compiled, also of the results of an evaluation."""
    monkeypatch.setattr(_Wrong, method, body)
    with pytest.raises(UserError, match=words):
        jax.eval_shape(lambda key: wrong.reset(key), jax.random.key(0))


COMMON_MISTAKES = {
    "a field": (
        "step.truth.ball_velocity[2]",
        "step.truth.ball_velocty[2]",
        "AttributeError: .* mean ball_velocity",
    ),
    "a name": ('step.goal["apex"]', 'step.goal["apx"]', "KeyError: 'apx' .did you mean apex"),
    "an if": (
        "is_low = ",
        "low = 1 if height > 0 else 0\n        is_low = ",
        "Python's if, .*where",
    ),
    "no return": ("return task.TaskStep(", "task.TaskStep(", "step .*None; return a task.TaskStep"),
    "a vector": ("height < -0.03", "ball_position < -0.03", "bool of the shape .3,. for ended"),
    "an end": ("ended=is_lost", "ended=height", "float32 of the shape .. for ended; return one b"),
    "a state": (
        "state=velocity_z > 0.0",
        "state=velocity_z",
        "returns float32 of the shape .. for state; return bool of the shape .., as at a reset",
    ),
    "a shape": (
        "reach = height + ",
        "reach = step.action + ball_position + ",
        "TypeError: add got",
    ),
    "a curve": ('"apex_error", "apexes"', '"apex_eror", "apexes"', "a metric that .* apex_eror"),
    "an order": ("Goal(low, high", "Goal(high, low", "from 0.085 to 0.065; give two finite"),
    "a group": (
        ', "goal")] = 1',
        ")] = 1",
        "the name of a quantity of the task; .* the group goal",
    ),
    "an unseen": (
        "apex: Annotated[",
        "apx: Annotated[",
        "policy does not see the goal apex, wh",
    ),
    "a tally": ("return task.Tally(sums)", "return sums", "tally .* a dict; return a task.Tally"),
    "a sum": (
        'sums["apexes"]',
        'sums["apexs"]',
        "results .*KeyError: 'apexs' .did you mean apexes",
    ),
    "a share": (
        "low_apexes, apexes, 0.95",
        "low_apexes, apexes, 95",
        "least share 95; give one fro",
    ),
    "a class": (
        "class Dribble(task.Task):",
        "class Drible(task.Task):",
        "there is no task 'dribble' .*; did you mean drible?",
    ),
    "a config": ("    Config = Config\n", "", "Dribble has no Config of its own"),
    "an old field": ('step.goal["apex"]', 'step.command["apex"]', "AttributeError.* mean goal"),
    "an old type": (
        "task.Goal(low",
        "task.Command(low",
        r"the goals \(mine.py, line 79\) end in .* 'Command' \(did you mean Goal",
    ),
    "an old method": ("def goals(", "def commands(", "Dribble has commands, which is goals today"),
    "an old import": (
        "from bounce_mjx import task",
        "from bounce_mjx import task\nfrom bounce_mjx.task.bounce import BounceConfig",
        "in line 10: cannot import name 'BounceConfig' .*did you mean Config",
    ),
    "an import": (
        "import jax.numpy as jnp",
        "import jax.numpi as jnp",
        "ModuleNotFoundError in line 7",
    ),
    "a weight": (
        "weight: float = 4.0",
        'weight: float = "high"',
        "in line 53: weight is high, but must be a valid number",
    ),
}


@pytest.mark.parametrize("mistake", COMMON_MISTAKES)
def test_a_common_mistake_in_a_task_is_one_sentence(mistake: str, tmp_path: Path) -> None:
    """In a file like the page's: before anything is compiled, with its line where it has one."""
    right, wrong, words = COMMON_MISTAKES[mistake]
    text = DRIBBLE.read_text(encoding="utf-8")
    assert right in text
    path = tmp_path / "mine.py"
    path.write_text(text.replace(right, wrong, 1), encoding="utf-8")

    def trace() -> None:
        import_code(path)
        env = Env(validate(find_task("dribble").Config, {}, "mine.yaml"))
        jax.eval_shape(lambda key: env.step(env.reset(key), jnp.zeros(6)), jax.random.key(0))

    with pytest.raises(UserError, match=words) as refused:
        trace()
    about_a_value = ("a curve", "a group", "an unseen", "a class", "a config", "an old method")
    assert ("line " in str(refused.value)) == (mistake not in about_a_value)


@pytest.mark.parametrize("method", ["reset", "step", "results"])
def test_a_task_without_a_method_is_refused(
    method: str, wrong: Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_Wrong, method, getattr(task.Task, method))
    words = f"the task _Wrong has no method {method}; write one, which"
    arguments = (None,) if method != "step" else (None, None)
    with pytest.raises(UserError, match=words):
        getattr(wrong.task, method)(*arguments)


class _Still(task.RewardTerm):
    pass


class _Nothing(task.RewardTerm):
    def value(self, speed: jax.Array) -> None:
        """It forgets its return."""


@pytest.mark.parametrize(
    ("term", "words"),
    [
        (_Still, "the reward term _Still has no method value; write one, which returns"),
        (_Nothing, "the reward term still, a _Nothing, returns None; return one number"),
    ],
)
def test_a_reward_term_without_a_value_is_refused(term: type, words: str) -> None:
    class Rewards(task.StrictModel):
        still: term = term()

    with pytest.raises(UserError, match=words):
        task.weighted_terms(Rewards(), 1.0)


@pytest.mark.parametrize(
    ("attribute", "value", "words"),
    [
        ("num_balls", 1, r"num_balls of the task _Wrong is 1; give a tuple .* such as \(1,\)"),
        (
            "curves",
            task.Curve("a", "speed"),
            r"curves of the task _Wrong is Curve\(.*; give a tuple",
        ),
        ("curves", ("speed",), r"curves of the task _Wrong is \('speed',\); give a tuple of"),
    ],
)
def test_an_attribute_of_another_type_is_refused(
    attribute: str, value: object, words: str, wrong: Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_Wrong, attribute, value)
    with pytest.raises(UserError, match=words):
        Env(wrong.config)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"low": 0.5, "high": 0.4}, "is sampled from 0.5 to 0.4; give two finite numbers, the low"),
        ({"low": np.nan, "high": 0.4}, "is sampled from nan to 0.4; give two finite numbers"),
        ({"low": 0.4, "high": np.inf}, "is sampled from 0.4 to inf; give two finite numbers"),
        ({"low": "0.4", "high": 0.5}, "is sampled from '0.4' to 0.5; give two finite numbers"),
        ({"low": True, "high": 1.5}, "is sampled from True to 1.5; give two finite numbers"),
        (
            {"low": 0.1, "high": 2.0, "greatest": 1.0, "unit": "m", "reason": "as it ends there"},
            r"is sampled from 0.1 to 2, but must be <= 1 \(m\), as it ends there",
        ),
        ({"low": 0.1, "high": 2.0, "least": 0.2}, "is sampled from 0.1 to 2, but must be >= 0.2"),
        ({"low": 0.0, "high": 1.0, "span": (1.0, 0.0)}, r"is offered as \(1.0, 0.0\); give two"),
        ({"low": 0.0, "high": 1.0, "step": 0.0}, "has the step 0.0; give a number above 0"),
        ({"low": 0.0, "high": 1.0, "names": "ab"}, "has the names 'ab'; give a tuple of names"),
        ({"low": 0.0, "high": 1.0, "names": ("1",)}, "the names .'1',.; give a tuple of names, of"),
    ],
)
def test_a_goal_from_which_nothing_can_be_sampled_is_refused(settings: dict, words: str) -> None:
    """Where it is written, with its line."""
    with pytest.raises(UserError, match=rf"a goal( \(test_tasks.py, line \d+\))?:? .*{words}"):
        task.Goal(**settings)


@pytest.mark.parametrize(
    ("goals", "words"),
    [
        ({"height": (0.4, 0.5)}, r"the goal height .* is \(0.4, 0.5\); give a task.Goal"),
        ([task.Goal(0.4, 0.5)], "the goals of .* _Wrong are .*; return a dictionary of a"),
    ],
)
def test_goals_of_another_type_are_refused(
    goals: object, words: str, wrong: Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_Wrong.Config, "goals", goals)
    with pytest.raises(UserError, match=words):
        Env(wrong.config)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ((2, "m", "goal"), r"shows a goal, which is one number; give task.Quantity\(1, 'm'"),
        ((None, "", "goal"), "shows a goal, which is one number"),
        ((1, "m", "goal", True), "shows a goal, which is one number"),
        ((1, "m", "goals"), "has the group 'goals'; choose from state, goal, past, task"),
        ((0, "m"), "has the size 0; give a number of entries, or None for one of each joint"),
        ((1.5, "m"), "has the size 1.5; give a number of entries"),
    ],
)
def test_a_quantity_that_cannot_be_is_refused(settings: tuple, words: str) -> None:
    """Where it is written. Of a larger size, the observation would repeat a goal."""
    with pytest.raises(
        UserError, match=rf"Quantity\(size=.*\) \(test_tasks.py, line \d+\) {words}"
    ):
        task.Quantity(*settings)


def test_a_goal_is_not_shown_by_a_quantity_of_another_group(wrong: Env) -> None:
    class Seen(task.ObservationConfig):
        height: Annotated[int, task.Quantity(1, "m")] = 1

    with pytest.raises(UserError, match="height has the name of a quantity of the task; .* group"):
        Env(wrong.config.model_copy(update={"observation": Seen()}))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (("", "error"), "the tag of a task.Curve .* is ''; give a name"),
        (("task/error", None), "the metric of a task.Curve .* is None; give a name"),
        (("task/error", "error", 3), "the over of a task.Curve .* is 3; give a name"),
        (("a", "b", "steps", 100.0), "the title of the curve a .* is 100.0; give words"),
        (("a", "b", "steps", "", 1.0, None), "the unit of the curve a .* is None; give words"),
        (("a", "b", "steps", "", "cm"), "the scale of the curve a .* is 'cm'; give a finite num"),
    ],
)
def test_a_curve_that_cannot_be_is_refused(settings: tuple, words: str) -> None:
    with pytest.raises(UserError, match=words):
        task.Curve(*settings)


def test_a_goal_that_is_shown_but_not_there_is_refused(wrong: Env) -> None:
    class Seen(task.ObservationConfig):
        heigth: Annotated[int, task.Quantity(1, "m", "goal")] = 1

    with pytest.raises(UserError, match="the goal heigth, which there is not; .*: height"):
        Env(wrong.config.model_copy(update={"observation": Seen()}))


@pytest.mark.parametrize("size", [1, 3])
def test_a_quantity_of_another_size_is_refused(size: int) -> None:
    """JAX would cut it off, or repeat its last entry."""
    layout = ObservationLayout((Part("aim", 2, "m", 1),))
    with pytest.raises(UserError, match=f"quantity aim gets {size} numbers, but takes 2, which"):
        layout.pack({"aim": jnp.zeros(size)})


def test_settings_without_a_task_are_refused() -> None:
    with pytest.raises(UserError, match="WorldConfig has the settings of a world without a task"):
        Env(task.WorldConfig())


class _Observation(task.ObservationConfig):
    seconds: Annotated[int, task.Quantity(1, "s")] = 1


class _Config(rest_task.Config):
    observation: _Observation = _Observation()


class _Forgetful(rest_task.Rest):
    """It returns the quantities `first` at a reset and `later` after each step."""

    Config = _Config
    first: ClassVar[tuple[str, ...]] = ("seconds",)
    later: ClassVar[tuple[str, ...]] = ("seconds",)

    def first_quantities(self, measured: task.Values) -> tuple[None, task.Values]:
        return None, {name: jnp.zeros(1) for name in self.first}

    def next_quantities(
        self, memory: None, histories: task.Values, measured: task.Values
    ) -> tuple[None, task.Values]:
        return None, {name: jnp.zeros((1, 1)) for name in self.later}


@pytest.mark.parametrize(
    "first, later, words",
    [
        ((), ("seconds",), "first_quantities .* lacks the observation's quantity seconds"),
        (("seconds", "action"), ("seconds",), "first_quantities .* has the quantity action, which"),
        (("seconds",), (), "next_quantities .* returns the histories none; return .*: seconds"),
        (("seconds",), ("seconds", "more"), "returns the histories seconds, more; return"),
    ],
)
def test_a_task_returns_the_quantities_of_its_observation(
    first: tuple[str, ...], later: tuple[str, ...], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_Forgetful, "first", first)
    monkeypatch.setattr(_Forgetful, "later", later)
    env = Env(_Config())

    def reset_and_step(key: jax.Array) -> jax.Array:
        return env.step(env.reset(key), jnp.zeros(6)).obs

    with pytest.raises(UserError, match=words):
        jax.eval_shape(reset_and_step, jax.random.key(0))


def test_goals_are_observed_in_one_order() -> None:
    """Not in that of a set, which differs between processes: each would compile its own program."""
    values = {f"goal_{i}": jnp.zeros(()) for i in range(8)}
    histories = {name: jnp.zeros((2, 1)) for name in values}
    env = object.__new__(Env)
    env.layout = ObservationLayout(tuple(Part(name, 1, "", 2) for name in values))

    def observe(histories: task.Values) -> jax.Array:
        sensing = Sensing(balls=None, picture=None, histories=histories, task=())
        return env.observe(EnvState(None, values, last_action=None, sensing=sensing))

    program = jax.make_jaxpr(observe)(histories).jaxpr
    read = [equation.invars[0] for equation in program.eqns if equation.primitive.name == "slice"]
    assert [variable for variable in read if variable in program.invars] == program.invars


RADIUS, HALF_HEIGHT = 0.03, 0.01


@pytest.fixture
def large(tmp_path: Path) -> Path:
    """The project's robot with a larger ball and a thicker paddle."""
    spec = mujoco.MjSpec.from_file(str(CHECKOUT / "mjcf/bounce_ball.xml"))
    spec.geom("ball").size[0] = RADIUS
    spec.geom("blocker").size[2] = HALF_HEIGHT
    (tmp_path / "large.xml").write_text(spec.to_xml())
    return tmp_path / "large.xml"


def test_tasks_have_the_geometry_of_the_model(large: Path) -> None:
    """A ball that is laid on the paddle does not start within it, a throw aims at its rest, a
    flight ends there, and balls touch that overlap."""
    tasks = {name: find_task(name) for name in ("balance", "catch", "juggle", "track")}
    balance, catch, juggle, track = (task(task.Config(mjcf=large)) for task in tasks.values())
    x, y, home = balance.geometry.paddle_home
    np.testing.assert_allclose((x, y, home), task.PADDLE_HOME, atol=5e-5)
    rest = home + RADIUS + HALF_HEIGHT
    assert balance.throw(jnp.full(4, 0.5), {})[0][2] == pytest.approx(rest + 0.003)
    position, velocity = catch.throw(jnp.array([0.0, 0.0, 0.5, 0.5, 0.5]), {})
    # A parabola is again at the height from which it rose.
    assert position[2] == pytest.approx(rest) and velocity[2] == pytest.approx(0.5 * 9.81 * 0.65)

    speed = jnp.zeros(6)

    def truth(balls: jax.Array, velocities: jax.Array) -> task.Kinematics:
        paddle = jnp.array([x, y, home])
        return task.Kinematics(speed, balls, None, speed, velocities, None, paddle)

    def touched(distance: float, radius: float | None = None) -> bool:
        balls = jnp.array([[x, -0.5 * distance, 0.5], [x, 0.5 * distance, 0.5]])
        state = jnp.array([False, False]), 1.0
        step = task.Step(
            truth(balls, jnp.zeros((2, 3))), {"target_height": 0.5}, speed, speed, radius
        )
        return bool(juggle.step(state, step).metrics["touched"])

    assert touched(0.059) and not touched(0.061)
    # In an episode with other balls.
    assert touched(0.039, 0.02) and not touched(0.041, 0.02)
    for flown in (juggle, track):
        height = flown.config.home[2] + RADIUS + HALF_HEIGHT
        assert flown.ground == pytest.approx(height)
    with pytest.raises(UserError, match=r"a ball of the radius 0.03 m rests on .* 0.0898 m"):
        Env(find_task("bounce").Config(mjcf=large, ball_init_pos=(0.59, 0.0, 0.07)))


@pytest.mark.parametrize(
    ("task_name", "settings", "words"),
    [
        (
            "catch",
            {"randomization": {"goal_interval": (1.0, 2.0)}},
            "randomization.goal_interval is given, but the task Catch has no goals; leave",
        ),
        (
            "catch",
            {"randomization": {"first_goal_range": 0.5, "warmup_steps": 10}},
            "randomization.first_goal_range is given, but the task Catch has no goals",
        ),
        ("bounce", {"target_height_range": 0.5}, "0.5 is not a range; give two numbers"),
        ("track", {"speed_range": (0.1,)}, r"\(0.1,\) is not a range; give two numbers"),
        ("juggle", {"height_range": (0.5, 0.4)}, r"\(0.5, 0.4\) is not a range; give the lower"),
        ("bounce", {"randomization": {"restitution": 0.9}}, "0.9 is not a range; give two numbers"),
        (
            "bounce",
            {"max_height_above_target": 0.01},
            "target_height_range: .* >= 0.44 .*max_height_above_target .* a ball starts at 0.45 m",
        ),
        (
            "bounce",
            {"min_ball_height": 0.5},
            "target_height_range: .* >= 0.5 .* with a ball lower than min_ball_height .0.5 m.",
        ),
        (
            "bounce",
            {"max_horizontal_distance": 0.5},
            "max_horizontal_distance is 0.5 m, so an episode ends where it starts, at the ball_in",
        ),
    ],
)
def test_a_setting_that_a_task_cannot_have_is_refused(
    task_name: str, settings: dict, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        find_task(task_name).Config.model_validate(settings)


@pytest.mark.parametrize("name", ["juggle", "track"])
def test_no_height_that_may_be_a_goal_ends_the_episode_at_a_hit(name: str) -> None:
    """A ball exactly in its column or under its point is not lost where the paddle hits it, at the
    greatest height that a flag or a slider may set; 5 cm more would end the episode."""
    kind = find_task(name)
    flown = kind(kind.Config())
    goal = flown.config.goals["target_height"]
    # The point rises from the lowest place of its sway to the highest one.
    rise = 2.0 * paths.SWAY if name == "track" else 0.0
    rest = jnp.zeros(6)

    def is_ended(height: float) -> bool:
        tops = jnp.array([flown.config.home])
        if name == "juggle":
            tops = jnp.array(flown.config.columns(height))
        balls = tops.at[:, 2].set(flown.ground)
        if name == "track":
            balls = balls[0]
        truth = task.Kinematics(rest, balls, None, rest, 0.0 * balls, None, jnp.array(tops[0]))
        middle = {name: jnp.float32(each.low) for name, each in flown.config.goals.items()}
        x, y, _ = flown.config.home
        goals = middle | {"target_x": x, "target_y": y, "target_height": jnp.float32(height)}
        state = flown.reset(task.Start(truth, goals, jnp.zeros(0)))
        return bool(flown.step(state, task.Step(truth, goals, rest, rest)).ended)

    assert not is_ended(goal.greatest + rise) and is_ended(goal.greatest + rise + 0.05)
    lowest, highest = goal.offered
    assert goal.least <= lowest and highest <= goal.greatest
    for height in (goal.least - 1e-3, goal.greatest + 1e-3):
        with pytest.raises(UserError, match="target_height is .* but must be a finite number >= "):
            goal.checked(height, "target_height")
    with pytest.raises(ValueError, match="height_range: a goal .* farther than max_distance"):
        kind.Config(height_range=(0.72, 0.75))


@pytest.mark.parametrize("name", ["balance", "catch", "juggle", "track"])
def test_every_task_shows_the_balls_rotation_if_asked(name: str) -> None:
    config = find_task(name).Config()
    seen = config.observation.model_copy(update={"ball_quaternion": 1, "ball_angular_velocity": 2})
    size = Env(config.model_copy(update={"observation": seen})).layout.size
    assert size == Env(config).layout.size + config.num_balls * (4 + 2 * 3)


def test_libraries_take_another_task() -> None:
    """Those whose own tests have no other task: the shape of the first observation."""
    import brax.envs

    import bounce_mjx.adapters.brax  # noqa: F401
    from bounce_mjx import environment
    from bounce_mjx.adapters.gymnax_env import GymnaxTaskEnv

    import_code(DRIBBLE)
    key, size = jax.random.PRNGKey(0), find_task("dribble").Config().layout.size
    env = brax.envs.get_environment("bounce_ball", task="dribble")
    assert jax.eval_shape(env.reset, key).obs.shape == (size,)
    env = GymnaxTaskEnv(environment("dribble"))
    assert jax.eval_shape(env.reset, key, env.default_params)[0].shape == (size,)


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A copy of the example that no other test has named."""
    path = tmp_path / "mine.py"
    text = DRIBBLE.read_text(encoding="utf-8")
    path.write_text(f"{text}\n# {tmp_path}\n", encoding="utf-8")
    return path


def in_another_process(*lines: str) -> str:
    """What the lines print in a process in which no task was named."""
    head = (
        "from pathlib import Path",
        "from bounce_mjx.config.user_code import import_code",
        "from bounce_mjx.runs.config import load_run_config",
    )
    done = subprocess.run(
        [sys.executable, "-c", "\n".join([*head, *lines])], capture_output=True, text=True
    )
    return done.stdout + done.stderr


@pytest.mark.slow
def test_a_run_keeps_its_task_which_runs_only_if_the_user_imports_it(
    mine: Path, tmp_path: Path
) -> None:
    import_code(mine)
    config = read_preset(None, task="dribble").model_copy(update={"log_dir": tmp_path})
    run_folder = create_run(config)
    copy = run_folder / "task" / "mine.py"
    assert copy.read_bytes() == mine.read_bytes()
    assert "task: dribble\n" in (run_folder / CONFIG_FILE).read_text()
    assert load_run_config(run_folder).env == config.env

    marker = tmp_path / "ran"
    copy.write_text(copy.read_text() + f"open({str(marker)!r}, 'w')\n")
    said = in_another_process(f"load_run_config(Path({str(run_folder)!r}))")
    assert (
        f'has the task dribble, whose code is {copy}; import it to run it: import_code("{copy}")'
        in said
    )
    assert not marker.exists()
    said = in_another_process(
        f"import_code({str(copy)!r})",
        f"config = load_run_config(Path({str(run_folder)!r}))",
        "print(type(config.env).__name__, config.env.apex_range)",
    )
    assert said == "Config (0.065, 0.085)\n" and marker.exists()


def test_a_command_without_its_import_prints_the_whole_command(
    mine: Path, tmp_path: Path, refused
) -> None:
    """With the run's copy of the code, as what a training prints has it."""
    import_code(mine)
    run_folder = create_run(
        read_preset(None, task="dribble").model_copy(update={"log_dir": tmp_path / "runs"})
    )
    (run_folder / "checkpoints/1").mkdir(parents=True)
    copy = run_folder / "task" / "mine.py"
    assert import_flags_of_run(run_folder) == ["--import", str(copy)]
    for line in (f"eval {run_folder}", f"play {run_folder}", f"train {run_folder} --seed 3"):
        user_code._code_files.clear()
        refused(line, f"import it to run it: bounce-mjx {line} --import {copy}")


def write_policy(config: TrainConfig) -> Path:
    """A run with an untrained policy."""
    shapes = checkpoints.policy_shapes(config)
    policy = jax.tree.map(lambda shape: jnp.ones(shape.shape, shape.dtype), shapes)
    return checkpoints.write_run(config, 1, policy)


def test_a_checkpoint_is_read_without_the_original_files(mine: Path, tmp_path: Path) -> None:
    """The run's own copy is imported, and nothing else runs."""
    import_code(mine)
    config = read_preset(None, task="dribble").model_copy(update={"log_dir": tmp_path})
    run_folder = write_policy(config)
    marker = tmp_path / "ran"
    mine.write_text(f"open({str(marker)!r}, 'w')\n")
    moved = run_folder.rename(tmp_path / "moved")
    user_code._code_files.clear()
    import_code(moved / "task/mine.py")
    checkpoints.read_policy(find_checkpoint(moved), load_run_config(moved))
    assert not marker.exists()


def test_a_checkpoint_does_not_bring_code_into_a_run_without(mine: Path, tmp_path: Path) -> None:
    """Neither a task nor an algorithm, also with a valid manifest."""
    marker = tmp_path / "ran"
    mine.write_text(f"open({str(marker)!r}, 'w')\n")
    config = read_preset(None).model_copy(update={"log_dir": tmp_path})
    run_folder = write_policy(config)
    for key in ("task", "algorithm"):
        (record,) = run_folder.glob("checkpoints/*/record/metadata")
        stored = json.loads(record.read_text())
        stored["config"] |= {"task": config.task, "algorithm": "ppo", key: f"{mine}:Dribble"}
        record.write_text(json.dumps(stored))
        seal(record.parent.parent)
        with pytest.raises(UserError, match=f"different config.*differs in {key};"):
            checkpoints.read_policy(find_checkpoint(run_folder), config)
    assert not marker.exists()


def test_another_file_than_the_runs_is_told(
    mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import_code(mine)
    config = read_preset(None, task="dribble").model_copy(update={"log_dir": tmp_path})
    run_folder = create_run(config)
    assert settings_of([str(run_folder)]).config.env == config.env
    changed = tmp_path / "changed.py"
    changed.write_text(mine.read_text().replace("weight: float = 4.0", "weight: float = 5.0"))
    user_code._code_files.clear()
    import_code(changed)
    with pytest.raises(UserError, match=r"cannot be resumed with another task than it was trained"):
        settings_of([str(run_folder)])
    assert load_run_config(run_folder).env.reward.apex.weight == 4.0
    assert "changed.py differs from the task that" in capsys.readouterr().err


def test_two_files_with_a_task_of_one_name_are_refused(mine: Path, tmp_path: Path) -> None:
    """Neither wins in silence; a copy is the same code, and a class of a package's name no task."""
    changed = tmp_path / "changed.py"
    changed.write_text(mine.read_text().replace("weight: float = 4.0", "weight: float = 5.0"))
    import_code(mine)
    import_code(shutil.copy(mine, tmp_path / "copy.py"))
    assert find_task("dribble") is find_task("Dribble")
    import_code(changed)
    with pytest.raises(UserError, match="dribble is a class of .*; import one of them, or rename"):
        find_task("dribble")
    named = type("Catch", (rest_task.Rest,), {"Config": type("Config", (rest_task.Config,), {})})
    with pytest.raises(UserError, match="has the name of the task catch; rename it"):
        task_name(named)


def test_a_config_file_cannot_name_code(mine: Path, tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("task: dribble\nenv: {apex_range: [0.06, 0.07]}\n")
    with pytest.raises(UserError, match="is of the task dribble, and this training of bounce"):
        settings_of(["--config", str(path)])
    with pytest.raises(UserError, match="no task, policy or run dribble; .*--import FILE.py for a"):
        read_preset(path)
    import_code(mine)
    assert read_preset(path, task="dribble").env.apex_range == (0.06, 0.07)
    with pytest.raises(UserError, match="run straight; give .*, dribble, .*--import FILE.py"):
        settings_of(["straight"])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("bonce", "there is no task 'bonce' .*; did you mean bounce?"),
        ("missing.py:Task", "there is no task 'missing.py:Task' .*--import the file of your own"),
    ],
)
def test_a_wrong_task_is_one_sentence(name: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        find_task(name)


def test_a_mistake_in_a_tasks_file_names_its_line(tmp_path: Path) -> None:
    path = tmp_path / "wrong.py"
    path.write_text("import bounce_mjx.task\n\nx = 1 / 0\n")
    with pytest.raises(
        UserError, match=r"wrong\.py cannot be imported \(ZeroDivisionError in line 3"
    ):
        import_code(path)


def test_a_package_can_have_tasks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its entry point gives the task a name, which its runs keep."""
    package = tmp_path / "my_tasks"
    package.mkdir()
    shutil.copy(DRIBBLE, package / "__init__.py")
    info = tmp_path / "my_tasks-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_tasks\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\nlow = my_tasks:Dribble\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    task = find_task("low")
    assert task.__name__ == "Dribble" and task_name(task) == "low"
    (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\ngone = my_tasks:Gone\n")
    with pytest.raises(UserError, match="the task gone cannot be imported .*; install the package"):
        find_task("gone")
    # A policy of another task is evaluated all the same, also where the code itself is wrong.
    (tmp_path / "wrong.py").write_text("undefined")
    (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\nbad = wrong:Task\n")
    command, _ = parse_with_goals(EvalCommand, ["robust"], prog="bounce-mjx eval")
    assert command.checkpoint == Path("robust")
    said = capsys.readouterr().err
    assert "warning: the task bad cannot be imported (name 'undefined' is not defined)" in said
    with pytest.raises(UserError, match="the task bad cannot be imported"):
        parse_with_goals(EvalCommand, ["--task", "bad"], prog="bounce-mjx eval")
    for attribute in ("Config", "__name__", "task.Task"):
        (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\nno = my_tasks:{attribute}\n")
        words = "cannot be imported" if "." in attribute else "is no subclass of Task; correct the"
        with pytest.raises(UserError, match=f"the task no .*{words}"):
            find_task("no")
    (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\nlow = my_tasks:Dribble\n")
    config = read_preset(None, task="low")
    assert "task: low\n" in dump_config(config) and config.log_dir == Path("runs/dribble")


def test_a_tasks_class_without_a_config_is_one_sentence() -> None:
    """The remedy is right for a task from scratch and for one that extends another."""
    for base, extended in ((task.Task, "task.WorldConfig"), (rest_task.Rest, "Config")):
        with pytest.raises(UserError, match=rf"no Config .* write Config, .* extends {extended}$"):
            type("Mine", (base,), {})
    with pytest.raises(UserError, match="the Config of the task Mine is .*; give a class that"):
        type("Mine", (task.Task,), {"Config": dict})


def test_a_robot_serves_another_task() -> None:
    """Its arm and its start pose are kept; the heights are those of the task above its paddle."""
    preset, robot = CHECKOUT / "configs/cpu.yaml", CHECKOUT / "configs/robots/ur5e.yaml"
    import_code(DRIBBLE)
    config, bounce = read_preset(preset, robot, "dribble").env, read_preset(preset, robot).env
    assert config.mjcf == bounce.mjcf and config.robot == bounce.robot
    assert config.default_joint_angles == bounce.default_joint_angles
    # A viewer offers targets over the paddle, as far as over that of the package's own arm.
    lowest, highest = bounce.goals["target_height"].span
    assert (lowest, highest) == pytest.approx(
        np.add(bounce.reward.paddle_home_height, (0.25, 0.75))
    )
    env = Env(config)
    truth = env.kinematics(jax.jit(env.reset)(jax.random.PRNGKey(0)).pipeline_state)
    above = np.asarray(truth.ball_position - truth.paddle_position)
    np.testing.assert_allclose(above, [0.0, 0.0, 0.2], atol=0.08)


NAMED_LIKE_FLAGS = """
import rest_task
from bounce_mjx import task

class Sized(rest_task.Rest):
    class Config(rest_task.Rest.Config):
        report: float = 0.5
        \"\"\"A setting whose name a flag of train has.\"\"\"
        seed: int = 3
        \"\"\"A setting whose name another setting has.\"\"\"

        @property
        def goals(self):
            names = "size", "zoom", "episodes", "copy", "help", "model_config", "depth"
            return {name: task.Goal(0.0, 1.0) for name in names}
"""


def test_a_task_may_name_a_goal_or_a_setting_like_a_flag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The flag that stands in no group stays, and the other one has its group."""
    (tmp_path / "sized.py").write_text(NAMED_LIKE_FLAGS)
    import_code(tmp_path / "sized.py")
    task_flag = ["--task", "sized"]
    env = find_task("sized").Config()
    flags = "--goals.size 0.5 --size 64 64 --copy 0.25 --goals.help 1 --depth 1".split()
    command, given = parse_with_goals(PlayCommand, [*task_flag, *flags], prog="play")
    assert command.viewing.size == (64, 64)
    assert given.checked(env) == {"size": 0.5, "copy": 0.25, "help": 1.0, "depth": 1.0}
    flags = "--episodes 7 --goals.episodes 0.5 --model-config 1 --size 0.1".split()
    command, given = parse_with_goals(EvalCommand, [*task_flag, *flags], prog="eval")
    assert command.episodes == 7
    assert given.checked(env) == {"episodes": 0.5, "model_config": 1.0, "size": 0.1}
    flags = "--no-report --env.report 0.25 --seed 8 --env.seed 9".split()
    command = train_command.read_command(["sized", *flags])
    config = command.settings(Path("cpu")).config
    assert (command.flags.report, config.seed) == (False, 8)
    assert (config.env.report, config.env.seed) == (0.25, 9)


class _Rising(rest_task.Rest):
    class Config(rest_task.Rest.Config):
        goals: ClassVar = {"height": task.Goal(0.4, 0.4)}

    def next_goal(self, state: tuple, goal: task.Values) -> task.Values:
        return {"height": goal["height"] + 0.01}


def test_the_log_has_each_metric_of_a_task() -> None:
    """Also one that no curve names, as its mean over the steps; but not what the world samples."""
    ended = jnp.array([False, True, False, True])
    shown = {"apex_error": jnp.array([0.2, 0.0, 0.4, 0.0]), "apexes": jnp.array([1.0, 0, 1.0, 0])}
    metrics = shown | {"low": jnp.array([1.0, 0.0, 0.0, 2.0]), "world/mass": jnp.ones(4)}
    metrics |= dict.fromkeys(("non_finite", "too_fast"), jnp.zeros(4))
    zero = jnp.zeros(4)
    result = VectorStep(zero, zero, zero, ended, ~ended, metrics, zero, zero)
    curve = task.Curve("task/error", "apex_error", over="apexes")
    sums = [step_metrics(result, groups=2, curves=[curve])] * 3
    logged = rollout_metrics(jax.tree.map(lambda *steps: jnp.stack(steps), *sums))
    of_task = {name: float(x) for name, x in logged.items() if name.startswith("task/")}
    expected = {"task/error": 0.3, "task/low": 0.75, "task/non_finite": 0.0, "task/too_fast": 0.0}
    assert of_task == pytest.approx(expected)


@pytest.mark.slow
def test_a_task_moves_its_goals() -> None:
    env = Env(_Rising.Config())
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.PRNGKey(0))
    for count in range(3):
        np.testing.assert_allclose(state.pipeline_state.goal["height"], 0.41 + 0.01 * count)
        state = step(state, jnp.zeros(6))


class _Timed(rest_task.Rest):
    """It ends after 25 ms, and tells the time."""

    class Config(rest_task.Rest.Config):
        pass

    def step(self, state: tuple, step: task.Step) -> task.TaskStep:
        result = super().step(state, step)
        metrics = result.metrics | {"time": step.seconds}
        return result._replace(ended=step.seconds > 0.025, metrics=metrics)


def test_a_step_has_its_time() -> None:
    """The environment counts its steps only for a task that reads it: the state of the others is
    what it was."""
    env = Env(_Timed.Config())
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    state = reset(jax.random.key(0))
    times = []
    ends = []
    for _ in range(4):
        state = step(state, jnp.zeros(6))
        times.append(float(state.metrics["time"]))
        ends.append(bool(state.done))
    np.testing.assert_allclose(times, [0.01, 0.02, 0.03, 0.04], rtol=1e-6)
    assert ends == [False, False, True, True]
    assert float(reset(jax.random.key(1)).pipeline_state.steps) == 0
    untimed = jax.eval_shape(Env(rest_task.Config()).reset, jax.random.key(0))
    assert untimed.pipeline_state.steps is None
