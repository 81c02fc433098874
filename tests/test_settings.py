"""Settings are layers: what wins, what says so, and that every way to say one is alike."""

import contextlib
import io
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

import bounce_mjx
from arms import ARM
from bounce_mjx.commands.main import main
from bounce_mjx.config import user_code
from bounce_mjx.config.command_line import flag_names
from bounce_mjx.config.files import flat
from bounce_mjx.config.settings import merged
from bounce_mjx.config.user_code import import_code
from bounce_mjx.errors import UserError
from bounce_mjx.runs import presets
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.creation import create_run
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.runs.layers import read_layers, read_preset
from bounce_mjx.runs.start import Choice
from bounce_mjx.training import job
from bounce_mjx.training.run import notes_on_intervals, notes_on_learning_rate, notes_on_worlds
from test_keys import KEYS, NEEDED, WITH, other, settings
from tiny_runs import settings_of

OWN = """
from bounce_mjx.learning.ppo import PPO, PPOConfig
class Own(PPO):
    class Config(PPOConfig):
        num_epochs: int = 1
        "Passes."
        own_cost: float = 0.5
        "Weight."
"""
DRIBBLE = Path(__file__).parents[1] / "examples/dribble_task.py"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory on a machine without an accelerator."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(presets, "has_accelerator", lambda: False)
    return tmp_path


class Resolved(Exception):
    """Carries the config of a training that does not begin."""


def python(*args: Any, **kwargs: Any) -> TrainConfig:
    """The config with which `bounce_mjx.train` would train."""

    def stop(config: TrainConfig, *_: Any, **__: Any) -> None:
        raise Resolved(config)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Resolved) as caught:
        patch.setattr(job, "train", stop)
        bounce_mjx.train(*args, quiet=True, **kwargs)
    return caught.value.args[0]


def words(flag: str, value: Any) -> list[str]:
    """A value on the command line."""
    if isinstance(value, bool):
        return [flag if value else flag.replace("--", "--no-", 1)]
    if isinstance(value, dict):
        return [flag, *(str(word) for item in value.items() for word in item)]
    return [flag, *map(str, value)] if isinstance(value, list) else [flag, str(value)]


def outcome(read: Callable[[], TrainConfig]) -> TrainConfig | None:
    """A config; None where it is refused."""
    try:
        return read()
    except UserError:
        return None


def leaves(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The settings in nested values by dotted key; one of them is a mapping itself."""
    found = {}
    for name, value in values.items():
        key = prefix + name
        is_group = isinstance(value, dict) and key not in KEYS
        found |= leaves(value, f"{key}.") if is_group else {key: value}
    return found


def given(key: str) -> dict[str, Any]:
    """Another value of a key, nested, with the settings without which it has no effect."""
    context = NEEDED.get(key) or WITH.get(key, {})
    return merged({"env": context}, settings(key, other(key)))


@pytest.mark.parametrize("group", ["", "env.", "env.reward.", "env.randomization.", "ppo."])
def test_flag_file_and_python_are_alike_for_every_key(group: str, folder: Path) -> None:
    """In a file a key has its whole name; as a flag and in Python one of `env` or `ppo` may stand
    alone."""
    (folder / "arm.xml").write_text(ARM)
    (folder / "own.py").write_text(OWN)
    import_code("own.py")
    groups = ("", "env.", "env.reward.", "env.randomization.", "ppo.")
    keys = [k for k in KEYS if max(filter(k.startswith, groups), key=len) == group]
    flags = flag_names(KEYS)
    # A file cannot name code, and a run does not exist.
    for key in set(keys) - {"algorithm", "warm_start"}:
        values = given(key)
        (folder / "my.yaml").write_text(yaml.safe_dump(values))
        line = [word for k, v in leaves(values).items() for word in words(flags[k], v)]
        alone = {k: v for name in ("env", "ppo") for k, v in values.get(name, {}).items()}
        alone |= {k: v for k, v in values.items() if k not in ("env", "ppo")}
        # An argument of `train` is called robot, as is a group of `env`.
        short = values if "robot" in alone else alone
        configs = [
            outcome(lambda line=line: settings_of(line).config),
            outcome(lambda: settings_of(["--config", "my.yaml"]).config),
            outcome(lambda short=short: python(**short)),
            outcome(lambda values=values: python(**values)),
        ]
        assert all(config == configs[0] for config in configs), key
        if configs[0] is not None:
            sources = [config.sources[key] for config in configs]
            assert sources == ["flags", "my.yaml", "train()", "train()"]


def test_a_source_wins_over_those_before_it(folder: Path) -> None:
    """One key of each layer, which a later layer has too."""
    (folder / "own.py").write_text(OWN)
    import_code("own.py")
    (folder / "a.yaml").write_text("seed: 1\neval_seed: 1\neval_episodes: 1\nnum_seeds: 1")
    (folder / "b.yaml").write_text("seed: 2\neval_seed: 2\neval_episodes: 2")
    line = "--config a.yaml --config b.yaml --world ur5e_rtde --eval-seed 3 --action-scale 0.02"
    config = settings_of([*line.split(), "--algorithm", "own"]).config
    sources = config.sources
    values = {
        "ppo.num_envs": (512, "configs/cpu.yaml"),
        "ppo.num_epochs": (1, "defaults of Own.Config"),
        "ppo.own_cost": (0.5, "default"),
        "num_seeds": (1, "a.yaml"),
        "seed": (2, "b.yaml"),
        "eval_seed": (3, "flags"),
        "env.action_scale": (0.02, "flags"),
        "env.robot.site": ("attachment_site", "the robot configs/robots/ur5e.yaml"),
        "env.randomization.restitution": ((0.82, 0.92), "the world configs/worlds/ur5e_rtde.yaml"),
    }
    flatly = flat(config.model_dump())
    assert {key: (flatly[key], sources[key]) for key in values} == values
    run = create_run(config.model_copy(update={"log_dir": folder / "runs"}))
    assert load_run_config(run).sources == sources
    # Every source is read again, and none is a setting.
    again = read_layers(Choice(config=(run / "config.yaml",), algorithm="own")).config()
    assert again.sources["seed"] == str(run / "config.yaml")


def test_an_algorithms_own_default_wins_over_the_machines_preset_alone(folder: Path) -> None:
    """A preset that the user names wins, and a line says so."""
    (folder / "own.py").write_text(OWN)
    import_code("own.py")
    named = Choice(config=(Path("cpu"),), algorithm="own")
    layers = read_layers(named)
    assert layers.config().ppo.num_epochs == 4
    assert layers.notes == ("configs/cpu.yaml wins over defaults of Own.Config: ppo.num_epochs",)
    layers = read_layers(Choice(algorithm="own"))
    assert (layers.config().ppo.num_epochs, layers.notes) == (1, ())
    (folder / "my.yaml").write_text("ppo: {num_epochs: 3}")
    assert (
        read_layers(Choice(config=(Path("my.yaml"),), algorithm="own")).config().ppo.num_epochs == 3
    )


def test_a_default_that_an_algorithm_makes_or_leaves_out_is_a_default(folder: Path) -> None:
    """It may make one anew for each config, and a narrower type needs none."""
    own = OWN.replace("num_epochs: int = 1", "num_epochs: int = Field(default_factory=lambda: 1)")
    (folder / "own.py").write_text(f"from pydantic import Field\n{own}        num_envs: int\n")
    import_code("own.py")
    config = read_layers(Choice(algorithm="own")).config()
    assert (config.ppo.num_epochs, config.sources["ppo.num_epochs"]) == (
        1,
        "defaults of Own.Config",
    )
    assert (config.ppo.num_envs, config.sources["ppo.num_envs"]) == (512, "configs/cpu.yaml")


def test_a_warm_start_is_alike_in_a_file(folder: Path) -> None:
    """It brings the environment too, and what the file says lies on it."""
    own = load_run_config(find_checkpoint("robust_small").run)
    (folder / "warm.yaml").write_text("warm_start: robust_small\nenv: {action_scale: 0.03}")
    with pytest.raises(
        UserError,
        match="warm.yaml is of the warm_start robust_small, .* of none; give --warm-start rob",
    ):
        settings_of(["--config", "warm.yaml"])
    configs = [
        settings_of("--warm-start robust_small --action-scale 0.03".split()).config,
        settings_of(["robust_small", "--config", "warm.yaml"]).config,
        python("robust_small", action_scale=0.03),
    ]
    assert configs[0] == configs[1] == configs[2]
    assert configs[0].env == own.env.model_copy(update={"action_scale": 0.03})
    assert configs[0].ppo.hidden_layers == own.ppo.hidden_layers == (128, 128)
    assert configs[1].sources["env.observation.action"] == "the warm start robust_small"
    notes = read_layers(Choice(config=(Path("randomized"),), warm_start=Path("robust_small"))).notes
    assert any("the warm start robust_small wins over configs/randomized.yaml" in x for x in notes)


def test_what_is_brought_whole_has_no_part_of_a_mapping_below() -> None:
    """The environment of a policy, a whole config, and a group that Python gives."""
    own = load_run_config(find_checkpoint("robust_small").run)
    transfer = read_preset(Path("transfer"))
    config = settings_of("--config transfer --warm-start robust_small".split()).config
    assert config.env == own.env
    assert config.sources["env.randomization.shares"] == "the warm start robust_small"
    randomization = transfer.env.randomization.model_copy(update={"shares": {"push_speed": 0.4}})
    config = python(config="transfer", randomization=randomization)
    assert config.env.randomization == randomization
    config = python(config=config, warm_start="robust_small")
    assert config.env.randomization == randomization


def test_a_whole_config_stands_alone_below_what_python_says() -> None:
    whole = read_preset(Path("seed")).model_copy(update={"seed": 7})
    config = python(config=whole, seed=5, num_envs=64)
    ppo = whole.ppo.model_copy(update={"num_envs": 64})
    assert config == whole.model_copy(update={"seed": 5, "ppo": ppo})
    assert config.sources["seed"] == "train()" and config.sources["ppo.num_epochs"] == "config"
    for arguments, sentence in (
        ({"nonsense": 5}, "train(): unknown key nonsense; known keys here are"),
        ({"num_env": 5}, "train(): unknown key num_env; did you mean ppo.num_envs?"),
        ({"start": "catch"}, "the config is of the task bounce, and the first argument is catch"),
        ({"task": "catch"}, "task is the first argument: train('catch', ...)"),
        ({"resume": "runs/x"}, "resume is the first argument: train('runs/x', ...)"),
        ({"num_envs": 0}, "train(): ppo.num_envs is 0, but must be greater than or equal to 1"),
        ({"start": whole}, "the first argument is a config; give it by name: train(config=...)"),
        ({"config": {"seed": 1}}, "config is a mapping; give its keys as arguments: train(..., **"),
    ):
        with pytest.raises(UserError) as caught:
            bounce_mjx.train(**{"config": whole, "quiet": True} | arguments)
        assert sentence in str(caught.value)


def test_a_file_has_the_same_defaults_wherever_it_lies(folder: Path, monkeypatch) -> None:
    """Also beside the presets, and where a folder has a preset's name."""
    (folder / "cpu").mkdir()
    assert settings_of(["--config", "cpu"]).config == read_preset(None)
    (folder / "configs").mkdir()
    real = presets.resource_path
    of_folder = lambda name: folder / name if name == "configs" else real(name)  # noqa: E731
    expected = read_preset(None).model_copy(update={"seed": 3})
    monkeypatch.setattr(presets, "resource_path", of_folder)
    for path in (folder / "my.yaml", folder / "configs/my.yaml"):
        path.write_text("seed: 3")
        assert read_preset(path) == expected


def test_a_learning_rate_that_adapts_is_said_to_be_the_first_one() -> None:
    adapts = read_layers(Choice()).config({"learning_rate": 1e-3, "target_kl": 0.01})
    (note,) = notes_on_learning_rate(adapts)
    assert note.startswith(
        "ppo.learning_rate 0.001 is only the first one, since ppo.target_kl 0.01"
    )
    for said in ({"learning_rate": 1e-3, "target_kl": 0.0}, {"target_kl": 0.01}):
        assert not notes_on_learning_rate(read_layers(Choice()).config(said))


def test_a_world_that_most_episodes_do_not_have_is_said(folder: Path) -> None:
    """A preset's share decides how often a number of a named world is sampled at all."""
    world = Path("ur5e_rtde")
    sampled = read_layers(Choice(config=(Path("transfer"),), world=world))
    (note,) = notes_on_worlds(sampled.config())
    assert note.startswith("configs/transfer.yaml samples each number of the world configs/worlds/")
    assert "in 20% of the episodes" in note
    path = folder / "whole.yaml"
    path.write_text("env: {randomization: {share: 1.0, shares: null}}")
    for files in ((Path("transfer"), path), (Path("robust_cpu"),)):
        whole = read_layers(Choice(config=files, world=world))
        assert not notes_on_worlds(whole.config())


def test_a_mistake_names_the_layer_that_has_it(folder: Path, refused) -> None:
    """Of a rule that joins several settings, the last one that set one of them."""
    (folder / "a.yaml").write_text("ppo: {num_minibatches: 7}")
    (folder / "b.yaml").write_text("seed: 1")
    refused("train --config a.yaml --config b.yaml", "error: a.yaml: ppo: num_minibatches 7")
    refused("train --config b.yaml --num-minibatches 7", "(see bounce-mjx train --help)")
    refused("train --config b.yaml --seed -1", "--seed is -1", "(see bounce-mjx train --help)")
    (folder / "c.yaml").write_text("ppo: {num_envs: 0}")
    refused("train --config c.yaml --seed 1", "error: c.yaml: ppo.num_envs is 0, but")
    (folder / "empty.yaml").write_text("foo: {}")
    refused("train --config empty.yaml --seed 1", "error: empty.yaml: unknown key foo;")
    (folder / "own.py").write_text(OWN.replace("own_cost: float = 0.5", 'own_cost: int = "a"'))
    refused(
        "train --import own.py --algorithm own --seed 1", "error: default: ppo.own_cost is a, but"
    )
    # It would end the preset's group, unseen below the flag.
    (folder / "empty.yaml").write_text("ppo:")
    refused(
        "train --config empty.yaml --num-envs 8 --print-config",
        "error: empty.yaml: ppo is None, but must be",
    )
    (folder / "empty.yaml").write_text("env: {reward: 3}")
    refused(
        "train --config empty.yaml --reward.height.weight 1 --print-config",
        "error: empty.yaml: env.reward is 3",
    )
    # A world changes the curriculum before the config is validated.
    (folder / "shares.yaml").write_text("env: {randomization: {shares: 0.5}}")
    shares = "error: shares.yaml: env.randomization.shares is 0.5, but"
    refused("train --config shares.yaml --world fast_servo", shares)
    # As a flag and in Python a key may have dots.
    (folder / "dots.yaml").write_text("ppo.num_envs: 8")
    nested = "error: dots.yaml: unknown key ppo.num_envs; nest it: ppo: {num_envs: ...}"
    refused("train --config dots.yaml", nested)
    refused("train --config dots.yaml --num-envs 8", nested)
    (folder / "dots.yaml").write_text("reward.height.weight: 1")
    refused("train --config dots.yaml", "nest it: env: {reward: {height: {weight: ...}}}")
    (folder / "d.yaml").write_text("warm_start: no")
    refused(
        "train --config d.yaml",
        "error: d.yaml is of the warm_start False, and this training of none; give --warm-start",
    )
    (folder / "e.yaml").write_text("log_dir: 5")
    refused("train --config e.yaml", "error: e.yaml: log_dir is 5, but must be a path")


@pytest.mark.parametrize("key", ["on", "1", "null", "0.5"])
def test_a_key_that_is_no_text_is_refused(key: str, folder: Path, refused) -> None:
    """YAML reads on as true."""
    (folder / "my.yaml").write_text(f"seed: 1\nppo: {{num_envs: 64,\n  {key}: 1}}")
    refused("train --config my.yaml", f"the key {key} in line 3 is no text to YAML")
    with pytest.raises(UserError, match="unknown key"):
        python(ppo={yaml.safe_load(key): 1})


def test_a_mapping_on_the_command_line_is_whole(folder: Path, refused) -> None:
    """No word vanishes, and None ends the mapping of a layer below."""
    config = settings_of("--config robust_small --randomization.shares None".split()).config
    assert config.env.randomization.shares is None
    assert config.sources["env.randomization.shares"] == "flags"
    for shares in ("", "restitution", "restitution 0.5 gravity"):
        refused(f"train --randomization.shares {shares}", "--randomization.shares needs pairs")
    refused("train --randomization.shares gravity 0.5 gravity 1", "has a name twice")


def test_the_command_line_takes_the_words_of_a_file_for_null_and_small_numbers() -> None:
    for word in ("null", "None"):
        config = settings_of(["--eval-every", "3", "--save-every", word]).config
        assert config.save_every is None and config.sources["save_every"] == "flags"
    angles = "--default-joint-angles 0 -1e-3 -.5E+0 -2.e-5 0 -0.1".split()
    assert settings_of(angles).config.env.default_joint_angles == (0, -1e-3, -0.5, -2e-5, 0, -0.1)


def test_the_source_is_what_set_the_value_that_counts(folder: Path) -> None:
    """A policy brings its task; a world ends a curriculum that it has no use for."""
    config = settings_of("--config finetune --warm-start track".split()).config
    assert (config.task, config.sources["task"]) == ("track", "the warm start track")
    config = settings_of("track --warm-start track".split()).config
    assert config.sources["task"] == "flags"
    (folder / "world.yaml").write_text(
        "env: {randomization: {goal_interval: [2.0, 4.0]}}\nsources: {randomization: A test.}"
    )
    # A flag has a part of a mapping that lies first in the preset's, which a file continues.
    (folder / "shares.yaml").write_text(
        "env: {randomization: {push_speed: [0.1, 0.1], shares: {push_speed: 0.5}}}"
    )
    line = "--config robust_small --config shares.yaml --randomization.shares action_latency 0.5"
    config = settings_of(line.split()).config
    assert config.sources["env.randomization.shares"] == "flags"
    config = settings_of("--config transfer --world world.yaml".split()).config
    for key in ("share", "warmup_steps"):
        default = type(config.env.randomization).model_fields[key].default
        assert getattr(config.env.randomization, key) == default
        assert config.sources[f"env.randomization.{key}"] == "default"


def test_a_config_that_disagrees_with_itself_is_refused(folder: Path) -> None:
    """It would train PPO with the settings of another algorithm, or a task with another's."""
    (folder / "own.py").write_text(OWN)
    import_code("own.py")
    ppo = read_layers(Choice(algorithm="own")).start.algorithm_config()
    whole = TrainConfig(algorithm="own", ppo=ppo)
    assert python(config=whole).ppo == ppo
    for algorithm, settings_of_other in (("ppo", ppo), ("own", TrainConfig().ppo)):
        mixed = TrainConfig(algorithm=algorithm, ppo=settings_of_other)
        with pytest.raises(UserError, match="name the algorithm that has them"):
            bounce_mjx.train(config=mixed, quiet=True)
    # Plain values are PPO's, as the code of a file does not run here.
    with pytest.raises(ValueError, match="num_env"):
        TrainConfig(algorithm="own", ppo={"num_env": 8})
    with pytest.raises(ValueError, match="these are the settings of Bounce, and task is track"):
        TrainConfig(task="track", env=TrainConfig().env)


def test_a_run_of_another_algorithm_is_refused_as_such(folder: Path, refused) -> None:
    """Its settings are no settings of the algorithm that the user names: the run is not damaged."""
    (folder / "own.py").write_text(OWN)
    import_code("own.py")
    (folder / "other.py").write_text(OWN.replace("own_cost", "other_cost"))
    own = read_layers(Choice(algorithm="own")).config({"log_dir": folder / "runs"})
    run = create_run(own)
    refused(f"train {run} --algorithm ppo", "has its algorithm, with which it is resumed")
    user_code._code_files.clear()
    code = run / "algorithm/own.py"
    refused(f"train {run}", f"whose code is {code}; import it to run it: bounce-mjx train {run}")
    refused(
        f"train {run} --import other.py", "cannot be resumed with another algorithm than it was"
    )
    # Whatever acts with the policy needs none of it.
    user_code._code_files.clear()
    assert load_run_config(run).ppo.num_envs == own.ppo.num_envs


def test_the_printed_config_is_a_config_where_a_run_is_chosen(folder: Path, capsys) -> None:
    """What latest stands for is said as a training begins, and not in the config."""
    policy = find_checkpoint("robust_small")
    shutil.copytree(policy.run, folder / "runs/2026-01-01")
    line = "--warm-start latest --log-dir runs".split()
    main(["train", *line, "--print-config"])
    (folder / "again.yaml").write_text(capsys.readouterr().out)
    assert "using the newest run: runs/2026-01-01" in settings_of(line).layers.notes[0]
    line = ["--warm-start", str(policy.run), "--config", "again.yaml"]
    assert settings_of(line).config.ppo.hidden_layers == (128, 128)


def test_the_printed_config_is_a_config_and_says_its_sources(folder: Path) -> None:
    said_by_user = "--seed 3 --randomization.restitution 0.8 0.9".split()
    said_by_user += "--randomization.shares restitution 0.5".split()
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        main(["train", *said_by_user, "--print-config"])
    lines = {line.partition(":")[0].strip(): line for line in said.getvalue().splitlines()}
    assert lines["seed"].split() == ["seed:", "3", "#", "flags"]
    assert lines["num_envs"].split() == ["num_envs:", "512", "#", "configs/cpu.yaml"]
    assert lines["num_seeds"].split() == ["num_seeds:", "1", "#", "default"]
    (folder / "again.yaml").write_text(said.getvalue())
    again = settings_of(["--config", "again.yaml"]).config
    assert again == settings_of(said_by_user).config


def test_the_real_intervals_are_printed_where_they_differ(folder: Path, capsys) -> None:
    """A block is never divided: --save-every 1e5 saved each million steps without a word."""
    line = "train --config default --save-every 1e5 --eval-every 2097152 --print-config"
    main(line.split())
    lines = {x.partition(":")[0].strip(): x for x in capsys.readouterr().out.splitlines()}
    assert lines["save_every"].split("# ")[1] == "flags; in whole blocks 1,048,576"
    assert lines["eval_every"].split("# ")[1] == "flags"
    config = settings_of("--config default --save-every 1e5".split()).config
    (note,) = notes_on_intervals(config)
    assert note.startswith("save_every 100,000 is shorter than a block, so it is done every 1,048,")


def test_what_a_file_cannot_say_is_told(folder: Path, refused) -> None:
    (folder / "my.yaml").write_text("robot: ur5e")
    line = "train --config my.yaml --print-config"
    refused(line, "my.yaml: robot is no setting; leave it out, and give --robot or train(robot=")
    (folder / "my.yaml").write_text("task: null")
    refused(line, "my.yaml: task is null, but must be a name")
    (folder / "run").mkdir()
    refused("train run --log-dir typo", "--log-dir is where the newest run is looked for")


def test_no_setting_of_a_task_takes_a_flag_of_the_algorithms(folder: Path) -> None:
    """`--num-envs 8` once trained with 512 environments: it was the task's."""
    text = DRIBBLE.read_text(encoding="utf-8")
    before = "    apex_range: tuple"
    assert before in text
    own = '    num_envs: int = 3\n    """A number of its own."""\n'
    text = text.replace(before, own + before).replace("class Dribble(", "class Numbered(")
    (folder / "own.py").write_text(text, encoding="utf-8")
    import_code("own.py")
    with pytest.raises(UserError, match="env.num_envs and ppo.num_envs have the same name; give"):
        settings_of(["numbered", "--config", "cpu", "--num-envs", "8"])
