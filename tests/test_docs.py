"""The documentation: links resolve, commands and flags exist, and quotations are true."""

import argparse
import ast
import dataclasses
import functools
import importlib
import inspect
import os
import pkgutil
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bounce_mjx
import mutations
from bounce_mjx import commands as commands_package
from bounce_mjx.commands import main as console_script
from bounce_mjx.commands.train import fields_of_command
from bounce_mjx.config import command_line as cli
from bounce_mjx.config.files import dump_config
from bounce_mjx.config.settings import StrictModel, fields_in
from bounce_mjx.config.user_code import import_code
from bounce_mjx.errors import MissingPackage
from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.layers import read_layers, read_preset
from bounce_mjx.runs.start import Choice, StartFlags, find_start
from bounce_mjx.task import registry, term_names, weighted_terms
from bounce_mjx.task.bounce import Bounce
from bounce_mjx.task.bounce_rewards import RewardInputs, Rewards
from bounce_mjx.task.registry import find_task
from bounce_mjx.training import hosts
from bounce_mjx.training.run import Run, notes_on_learning_rate
from bounce_mjx.world.randomization import TERMS
from tiny_runs import shared_run

CHECKOUT = Path(__file__).resolve().parent.parent
REFERENCE = runpy.run_path(str(CHECKOUT / "docs/config_reference.py"))["reference"]()
API = CHECKOUT / "docs/api_reference.py"
PAGES = [
    CHECKOUT / "README.md",
    CHECKOUT / "CONTRIBUTING.md",
    *sorted((CHECKOUT / "docs").rglob("*.md")),
]
RECORDS = [CHECKOUT / "CHANGELOG.md", *sorted((CHECKOUT / "benchmarks").glob("*.md"))]


def page_id(page: Path) -> str:
    return str(page.relative_to(CHECKOUT))


def content(page: str) -> str:
    return (CHECKOUT / "docs" / page).read_text(encoding="utf-8")


def examples(page: str, language: str) -> list[str]:
    """The code blocks of a page in a language; of a page outside docs/, none."""
    text = content(page) if (CHECKOUT / "docs" / page).is_file() else ""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def code(page: Path) -> list[str]:
    """The lines of a page's code blocks, and its inline code."""
    text = page.read_text(encoding="utf-8")
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    rest = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    indented = re.findall(r"^ {4}(.+)$", rest, re.MULTILINE)
    inline = re.findall(r"`([^`]+)`", rest)
    return [line for block in fenced for line in block.splitlines()] + indented + inline


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives to a page's headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES + RECORDS, ids=page_id)
def test_links_resolve_and_pictures_have_a_description(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for description, picture in re.findall(r"!\[([^]]*)\]\(([^)]+)\)", text):
        assert len(description) >= 15, picture
        assert (page.parent / picture).stat().st_size < 1_000_000, picture
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith(("http://", "https://")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def commands(page: Path) -> list[tuple[str, list[str]]]:
    """The page's own commands: a script or a module, and its arguments."""
    found = []
    for line in code(page):
        if line.startswith(("$ ", "error: ")):  # a command that is refused
            continue
        plain = re.sub(r"<[^>]*>", "x", line.replace("$seed", "1"))
        for match in re.finditer(r"(?:uv run|python3?|bounce-mjx) [^;#>&|()]+", plain):
            words = shlex.split(match[0])
            if "bounce-mjx" in words:
                name, *args = words[words.index("bounce-mjx") + 1 :]
                if name != "--help":
                    found.append((f"bounce-mjx {name}", args))
                continue
            script = next((i for i, word in enumerate(words) if word.endswith(".py")), None)
            if "-m" in words and words[words.index("-m") + 1].startswith("bounce_mjx"):
                at = words.index("-m") + 1
                found.append((words[at], words[at + 1 :]))
            elif script is not None:
                found.append((words[script], words[script + 1 :]))
    return found


class Parsed(Exception):
    """A command line was read."""


COMMANDS = sorted({(name, *args) for page in PAGES for name, args in commands(page)})


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_shown_commands_are_understood(command, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command's own parser accepts them; nothing else of the command runs."""
    name, *args = command
    path = CHECKOUT / name
    if name.startswith("bounce-mjx "):
        assert name.split()[1] in console_script.COMMANDS
    else:
        assert path.is_file() if name.endswith(".py") else importlib.util.find_spec(name)
    # Playground's own program reads its flags.
    if not args or args == ["--help"] or name == "bounce_mjx.adapters.playground":
        return
    if "--import" in args:  # its file would have to exist
        at = args.index("--import")
        args = args[:at] + args[at + 2 :]
    # A module that the command imports below would keep the changed function.
    for info in pkgutil.iter_modules(commands_package.__path__):
        importlib.import_module(f"bounce_mjx.commands.{info.name}")
    real = cli.parse

    def parse(*given, **named):
        real(*given, **named)
        raise Parsed

    for module in [m for n, m in sys.modules.items() if n.startswith("bounce_mjx")]:
        if getattr(module, "parse", None) is real:
            monkeypatch.setattr(module, "parse", parse)
    read = argparse.ArgumentParser.parse_args

    def parse_args(*given, **named):
        read(*given, **named)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_args)
    monkeypatch.setattr(hosts, "join", lambda *_: None)
    monkeypatch.setattr(sys, "argv", [name, *args])
    monkeypatch.syspath_prepend(str(path.parent))
    monkeypatch.chdir(CHECKOUT)
    with pytest.raises(Parsed):
        if name.startswith("bounce-mjx "):
            console_script.main([name.split()[1], *args])
        elif name.endswith(".py"):
            runpy.run_path(str(path), run_name="__main__")
        else:
            runpy.run_module(name, run_name="__main__")


def known_flags() -> set[str]:
    """The flags of every command of the package, and of the maintainers' one."""
    ship = runpy.run_path(str(CHECKOUT / "benchmarks/ship.py"))
    flags = {"--help", "--help-all", "--import", *cli.all_flags(fields_in(ship["ShipCommand"]))}
    flags |= set(cli.all_flags(fields_of_command(find_start(None, StartFlags()))))
    for info in pkgutil.iter_modules(commands_package.__path__):
        module = importlib.import_module(f"bounce_mjx.commands.{info.name}")
        for name, member in vars(module).items():
            is_command = inspect.isclass(member) and issubclass(member, StrictModel)
            if is_command and name.endswith("Command"):
                flags |= set(cli.all_flags(fields_in(member)))
    for example in EXCERPTS.values():
        import_code(CHECKOUT / example)
    for task in (Bounce, find_task("dribble"), find_task("line")):
        flags |= {f"--{name}".replace("_", "-") for name in task.Config().goals}
    return flags


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_flags_in_sentences_exist(page: Path) -> None:
    shown = {re.split(r"[ =]", piece)[0] for piece in code(page) if piece.startswith("--")}
    assert shown - known_flags() == set()


def test_config_reference_is_fresh() -> None:
    page = content("config.md")
    assert page == REFERENCE, "docs/config.md is stale; it names the command that prints it"


def test_api_index_is_fresh() -> None:
    pytest.importorskip("griffe")
    written = runpy.run_path(str(API))["index"]()
    assert content("api.md") == written, "docs/api.md is stale; it names the command that prints it"


IMPORTS = sorted(
    {
        (module, name)
        for page in PAGES
        for block in re.findall(r"^```py.*?^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
        for module, names in re.findall(r"^from (bounce_mjx\S*) import (.+)$", block, re.MULTILINE)
        for name in names.split(", ")
    }
)


@pytest.mark.parametrize("imported", IMPORTS, ids=".".join)
def test_what_a_page_imports_is_in_a_reference(imported: tuple[str, str]) -> None:
    """In the API; settings are in the config reference, and the tasks have a page."""
    module, name = imported
    documented = set(re.findall(r"^\| \[`\S+\.(\w+)`\]", content("api.md"), re.MULTILINE))
    try:
        # A module of a package is its attribute only once it is imported.
        is_package = importlib.util.find_spec(module).submodule_search_locations is not None
        if is_package and importlib.util.find_spec(f"{module}.{name}") is not None:
            importlib.import_module(f"{module}.{name}")
        member = getattr(importlib.import_module(module), name, None)
    except MissingPackage as missing:
        pytest.skip(str(missing))
    is_setting = inspect.isclass(member) and issubclass(member, StrictModel)
    is_type = module == "bounce_mjx.config.settings"
    folder = getattr(importlib.import_module(module), "__path__", None)
    is_module = folder is not None and name in {info.name for info in pkgutil.iter_modules(folder)}
    is_elsewhere = is_module or is_setting or is_type or member is Bounce
    assert is_elsewhere or name in documented


def test_the_site_has_the_arguments_shapes_and_errors_of_the_api(need) -> None:
    """Its page has the headings of the index, to which pages link, and the whole docstrings."""
    need("griffe")
    hooks = runpy.run_path(str(CHECKOUT / "docs/site_hooks.py"))
    config = need("mkdocs.config").load_config(str(CHECKOUT / "mkdocs.yml"))
    files = need("mkdocs.structure.files")
    file = files.File("api.md", config.docs_dir, config.site_dir, use_directory_urls=False)
    site_page = need("mkdocs.structure.pages").Page(None, file, config)
    page = hooks["on_page_markdown"](content("api.md"), site_page, config, files.Files([file]))
    heads = re.compile(r"^## .+$", re.MULTILINE)
    assert heads.findall(page) == heads.findall(content("api.md"))
    entry = page.split("\n### Env\n")[1].split("\n### ")[0]
    assert "`from bounce_mjx.env.env import Env`" in entry
    assert "Env.step(state: State, action: jax.Array) -> State" in entry
    assert "under the action [n], clipped to [-1, 1]" in " ".join(entry.split())
    assert "- `rng`: key; consumed." in entry and "- `UserError`: " in entry
    state = page.split("\n### State\n")[1].split("\n### ")[0]
    assert "- `obs: jax.Array` Observation [observation_size]." in state


def test_table_of_libraries_names_every_example_and_existing_tests() -> None:
    page = content("libraries.md")
    rows = re.findall(r"^\| .+ \| .+ \| (`.+`) \| (`.+`) \|$", page, re.MULTILINE)
    examples = {path.name for path in (CHECKOUT / "examples").glob("*.*")} - {
        "deploy.py",
        "dribble_task.py",
        "line_task.py",
        "two_cameras.py",
        "smooth_ppo.py",
        "ur_rtde_bridge.py",
        "ros2_bridge.py",
    }
    assert set(re.findall(r"examples/([\w.]+)", "".join(row[0] for row in rows))) == examples
    for _, tests in rows:
        for test in re.findall(r"`(.+?)`", tests):
            file, _, name = test.partition("::")
            text = (CHECKOUT / file).read_text(encoding="utf-8")
            assert not name or f"\ndef {name}(" in text, test


def test_task_page_has_the_table_of_the_terms() -> None:
    page = content("task.md")
    assert page.count("\n<!-- reward terms -->\n| term |") == 1
    script = runpy.run_path(str(CHECKOUT / "docs/reward_table.py"))
    assert page == script["with_table"](page), "stale; python docs/reward_table.py writes it"


TROUBLES = re.findall(
    r"^ {4}\$ (python train_jax\.py|bounce-mjx \w+)(.*)\n {4}(error: .+)$",
    content("troubleshooting.md"),
    re.MULTILINE,
)


@pytest.mark.parametrize(("name", "args", "error"), TROUBLES)
def test_troubleshooting_quotes_the_errors(
    name: str, args: str, error: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd
) -> None:
    mjcf = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
    (tmp_path / "rk4.xml").write_text(mjcf.replace('"implicitfast"', '"RK4"'))
    (tmp_path / "nameless.xml").write_text(mjcf.replace('"blocker"', '"bat"'))
    (tmp_path / "wrong.yaml").write_text("num_envs: 64")
    (tmp_path / "run/checkpoints/64").mkdir(parents=True)
    (tmp_path / "run/config.yaml").write_text(dump_config(TrainConfig()))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        command = name.replace("python train_jax.py", "bounce-mjx train").removeprefix(
            "bounce-mjx "
        )
        console_script.main([command, *shlex.split(args)])
    assert exit_info.value.code == 2
    # The documentation cannot know the folder.
    assert capfd.readouterr().err.replace(f"{tmp_path}/", "") == error + "\n"


def test_troubleshooting_quotes_the_reason_for_mjx(tmp_path: Path) -> None:
    from bounce_mjx import BounceBall, EnvConfig

    mjcf = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
    (tmp_path / "rk4.xml").write_text(mjcf.replace('"implicitfast"', '"RK4"'))
    engine = BounceBall(EnvConfig(mjcf=tmp_path / "rk4.xml")).engine
    page = content("troubleshooting.md")
    assert f"    physics: {engine.name} ({engine.reason})\n" in page


def imported_modules(path: Path) -> set[str]:
    """The modules that a file imports, also within its functions; of `from bounce_mjx import name`,
    `bounce_mjx.name`."""
    modules = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            modules |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            is_root = node.module == "bounce_mjx"
            modules |= {f"bounce_mjx.{x.name}" for x in node.names} if is_root else {node.module}
    return modules


def test_packages_import_in_the_order_of_the_map():
    """The map's promise: each folder of the package imports only from the rows above it and from
    the modules below them all, never the public names of the package itself."""
    text = (CHECKOUT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = text.split("## Where things are\n")[1]
    order = re.findall(r"^\| `src/bounce_mjx/(\w+)/`", section, re.MULTILINE)
    (below,) = re.findall(r"from the modules `(.+?)`;", " ".join(section.split()))
    below = below.replace("`", "").replace(" and ", ", ").split(", ")
    package = CHECKOUT / "src" / "bounce_mjx"
    files = [(path, below) for path in package.glob("*.py") if path.stem in below]
    for i, folder in enumerate(order):
        known = [*below, *order[: i + 1]]
        files += [(path, known) for path in (package / folder).rglob("*.py")]
    against = []
    for path, known in files:
        for module in imported_modules(path):
            root, _, rest = module.partition(".")
            if root == "bounce_mjx" and rest.split(".")[0] not in known:
                against.append(f"{path.relative_to(package)} imports {module}")
    assert len(files) > len(order) and not against


def test_benchmarks_do_not_import_in_a_circle() -> None:
    folder = CHECKOUT / "benchmarks"
    left = {path.stem: imported_modules(path) for path in folder.glob("*.py")}
    while left:
        free = [name for name, modules in left.items() if not modules & left.keys() - {name}]
        assert free, f"these import one another: {', '.join(sorted(left))}"
        for name in free:
            del left[name]


def test_the_site_has_the_files_that_its_pages_link_to(need) -> None:
    """`mkdocs build --strict` does not see links to files that it leaves out."""
    config = need("mkdocs.config").load_config(str(CHECKOUT / "mkdocs.yml"))
    linked = {x for path in PAGES for x in re.findall(r"\]\(\.\./([^)#]+)", content(path))}
    assert "examples/dribble_task.py" in linked
    assert not [path for path in linked if config.exclude_docs.match_file(path)]


@pytest.mark.parametrize("page", [path.name for path in PAGES if examples(path.name, "yaml")])
def test_files_on_pages_are_configs_or_worlds(page: str, tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    for file in examples(page, "yaml"):
        path.write_text(file, encoding="utf-8")
        is_world = "sources:" in file
        read_preset(None, world=path) if is_world else read_preset(path)


def test_other_blocks_of_pages_are_what_they_say() -> None:
    """Shell scripts, a package's metadata, and Python that would train for minutes, whose names
    exist; test_sb3.py does what it says."""
    languages = {
        x for path in PAGES for x in re.findall(r"^```(\w+)$", path.read_text("utf-8"), re.M)
    }
    assert languages == {"python", "py", "yaml", "bash", "toml"}
    for page in ("libraries.md", "runs.md"):
        for script in examples(page, "bash"):
            subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    (package,) = examples("tasks.md", "toml")
    assert tomllib.loads(package)["project"]["entry-points"].keys() == {registry.GROUP}
    for program in examples("libraries.md", "py"):
        for line in ast.walk(ast.parse(program)):
            if isinstance(line, ast.ImportFrom) and line.module == "bounce_mjx":
                assert {name.name for name in line.names} <= set(bounce_mjx.__all__)
            elif isinstance(line, ast.ImportFrom) and line.module.startswith("bounce_mjx."):
                source = CHECKOUT / "src" / f"{line.module.replace('.', '/')}.py"
                defined = {
                    getattr(x, "name", "") for x in ast.parse(source.read_text("utf-8")).body
                }
                assert {name.name for name in line.names} <= defined


def test_new_term_of_the_rewards_page_is_a_term(tmp_path: Path) -> None:
    """The page's code, as a file of the user's."""
    (example,) = examples("task.md", "python")
    (tmp_path / "straight.py").write_text(example)
    import_code(tmp_path / "straight.py")
    task = find_task("straight")
    config = task.Config(reward={"sideways_velocity": {"weight": 2.0}}).reward
    names = [field.name for field in dataclasses.fields(RewardInputs) if field.name != "reward"]
    inputs = {name: np.zeros(3) for name in names}
    inputs |= {"n_bounces": np.zeros(()), "target_height": np.zeros(())}
    inputs |= {"ball_velocity": np.array([3.0, 4.0, 1.0]), "bounced": np.array(False)}
    for height, expected in ((0.3, -2.0 * 25.0), (0.05, 0.0)):  # flying, and at the paddle
        inputs["ball_position"] = np.array([0.0, 0.0, height])
        terms = weighted_terms(config, RewardInputs(**inputs, reward=config))
        assert float(terms["sideways_velocity"]) == pytest.approx(expected)
    assert terms.keys() == {*term_names(Rewards), "sideways_velocity"}


def short_training(folder: Path) -> Callable:
    """`train` with few steps; from the second call on, only the settings are read."""
    real, calls = bounce_mjx.train, []
    short = dict(num_envs=8, rollout_length=8, num_minibatches=2, block_steps=64, eval_every=128)
    short |= dict(eval_episodes=4, screening_episodes=0, total_steps=256, episode_seconds=0.5)

    def train(*given, callbacks=(), **settings):
        calls.append(settings)
        if len(calls) > 1:  # the page's sweep
            config = read_layers(Choice()).config(settings)
            assert not notes_on_learning_rate(config)
            return config
        return real(*given, callbacks=callbacks, **settings | short, log_dir=folder)

    return train


# Pages whose Python is of a file.
EXCERPTS = {"tasks.md": "examples/dribble_task.py", "tutorial.md": "examples/line_task.py"}

# test_examples.py and test_deploy.py run the most of real-robot.md.
SLOW_PAGES = "../README.md", "libraries.md", "real-robot.md", "training.md"


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.slow] * (page in SLOW_PAGES))
        for page in (os.path.relpath(path, CHECKOUT / "docs") for path in PAGES)
        # test_small_changes.py runs that page.
        if examples(page, "python") and page != "small-changes.md"
    ],
)
def test_python_of_a_page_runs(page: str, capsys, tmp_path: Path, monkeypatch, request) -> None:
    """From top to bottom, as a notebook; excerpts are those of their file. Compiled functions are
    only traced, which takes a tenth of the time, and a training is short."""
    monkeypatch.setattr(bounce_mjx, "train", short_training(tmp_path), raising=False)

    def traced(function, **_):
        shapes = functools.partial(jax.eval_shape, function)
        return lambda *args: jax.tree.map(lambda x: jnp.ones(x.shape, x.dtype), shapes(*args))

    if page == "../README.md":
        monkeypatch.setattr(bounce_mjx, "train", lambda *_, **settings: Run(shared_run()))
    else:
        request.getfixturevalue("quick_compilation")
    if page == "libraries.md":
        for fixture in ("opengl", "torch_libraries"):
            request.getfixturevalue(fixture)
    names: dict = {"traced": traced}
    for example in examples(page, "python"):
        if page in EXCERPTS:
            assert example in (CHECKOUT / EXCERPTS[page]).read_text("utf-8")
            continue
        example = example.replace("jax.jit", "traced")
        example = example.replace(
            "/path/to/runs/bounce_ball/<time stamp>", f"{CHECKOUT}/pretrained"
        )
        exec(compile(example, page, "exec"), names)
        assert "print(" not in example or capsys.readouterr().out
    if page == "real-robot.md":
        # The arm is in its posture, and no target is farther than the action scale.
        angles = bounce_mjx.load_policy("pretrained").metadata.default_joint_angles
        np.testing.assert_allclose(names["servo_targets"], angles, atol=0.02 + 0.005)


def test_tables_of_figures_are_as_drawn() -> None:
    """README, RESULTS and the pages have the tables of figures.yaml, each somewhere."""
    figures = runpy.run_path(str(CHECKOUT / "benchmarks/figures.py"))
    known, shown = figures["tables"](), set()
    for page in figures["PAGES"]:
        text = page.read_text(encoding="utf-8")
        assert figures["drawn"](text, known) == text, f"python benchmarks/figures.py writes {page}"
        shown |= {name for _, name in figures["TABLE"].findall(text)}
    assert shown == known.keys()


def test_verdicts_of_figures_are_by_their_worst_number() -> None:
    verdict = runpy.run_path(str(CHECKOUT / "benchmarks/figures.py"))["verdict"]
    assert verdict("at most 45 s", "34 to 45 s") == "reached"
    assert verdict("at most 45 s", "34 to 46 s") == "missed"
    assert verdict("at least 11.5 M", "11.4 to 11.6 M") == "missed"
    assert verdict("at least 1,000", "1,271") == "reached"
    assert verdict("90 to 99%", "89.9%") == "missed"
    assert verdict("at most 1e-11", "5.6e-13") == "reached"
    assert verdict("all five results", "four of them") == "missed"
    assert verdict("at most 12 s", "11.5 and 14.5 s") == "missed"
    assert verdict("at least 95%", "97% and 93%") == "missed"
    assert verdict("at most 0.02", "-0.008") == "reached"
    for text in ("below 13.8", "None"):
        with pytest.raises(ValueError, match="begins with no number"):
            verdict("at most 15", text)


HAND_WRITTEN = [page for page in PAGES if page.name not in ("api.md", "config.md")]


def test_pages_have_at_most_the_words_that_contributing_allows() -> None:
    bound = re.search(
        r"README and docs/ have ([\d,]+) words", PAGES[1].read_text(encoding="utf-8")
    )[1]
    words = {}
    for page in HAND_WRITTEN:
        text = page.read_text(encoding="utf-8")
        text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
        words[page_id(page)] = len(re.sub(r"^ {4}.*$", "", text, flags=re.MULTILINE).split())
    del words["CONTRIBUTING.md"]
    assert sum(words.values()) <= int(bound.replace(",", "")), words


def test_users_pages_name_no_commit() -> None:
    for page in PAGES:
        found = re.findall(r"\b(?=[0-9a-f]*\d)(?=\d*[a-f])[0-9a-f]{7,8}\b", page.read_text("utf-8"))
        assert not found, f"{page_id(page)}: {found}"


def test_robot_page_has_every_term_of_the_randomisation() -> None:
    page = content("real-robot.md")
    section = page.split("## Randomised quantities\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| \w+ \| (`.+) \|$", section, re.MULTILINE)
    assert sorted(name for row in rows for name in re.findall(r"`(\w+)`", row)) == sorted(TERMS)


def test_each_promise_has_its_place_and_its_test() -> None:
    """The rows of "What we promise" in CONTRIBUTING.md."""
    section = (CHECKOUT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = section.split("## What we promise\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (.+) \| (`.+`) \| (`.+`) \|$", section, re.MULTILINE)
    assert len(rows) >= 40
    for promise, places, tests in rows:
        for place in re.findall(r"`([^`]+)`", places):
            assert (CHECKOUT / "src/bounce_mjx" / place).is_file(), f"{promise}: {place}"
        for test in re.findall(r"`([^`]+)`", tests):
            file, _, name = test.partition("::")
            text = (CHECKOUT / "tests" / file).read_text(encoding="utf-8")
            assert name in text, f"{promise}: {test}"


def test_each_deliberate_fault_still_has_its_place() -> None:
    """`tests/mutations.py`, which CI does not run: the code that it changes, and the number of
    faults in CONTRIBUTING.md."""
    for fault, file, code, _, test in mutations.FAULTS:
        text = (CHECKOUT / "src/bounce_mjx" / file).read_text(encoding="utf-8")
        assert text.count(code) == 1, f"{fault}: {code}"
        assert (CHECKOUT / "tests" / test.split(" -k ")[0]).is_file(), fault
    said = (CHECKOUT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert f"puts {len(mutations.FAULTS)} deliberate faults" in said
