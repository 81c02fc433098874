"""Prints the index of the public names, generated from their docstrings:

python docs/api_reference.py > docs/api.md

The site has `reference` in its place: the whole docstrings, with the signatures (`site_hooks.py`).
"""

import logging
import textwrap
from collections.abc import Iterator
from pathlib import Path

import griffe

SOURCE = Path(__file__).resolve().parent.parent / "src"

_INDEX_HEAD = """# API reference

Look up where a public name is and what it is. Its arguments, fields, shapes, units and errors are
in its docstring: `help(Env.step)`, or this page on the site (`uv run mkdocs serve`). {shared}

`python docs/api_reference.py > docs/api.md` writes this page.
"""
_HEAD = """# API reference

Look up any public name: its arguments, fields, shapes, units and errors. {shared}
"""
_SHARED = """Arrays have the
shapes in square brackets: `[B, 29]` is a batch of B observations. The settings are in the [config
reference](config.md). `BounceBall`, `EnvConfig` (`Bounce.Config`), `train`, `Run` and `load_policy`
are also names of `bounce_mjx` itself."""

# The title of a section, a sentence about it, and its names; of a module, all public ones.
_SECTIONS = (
    (
        "The environment",
        "",
        "env.env.Env env.bounce_ball.BounceBall task.bounce.Config env.env.State "
        "world.observation.ObservationLayout world.observation.Kinematics "
        "physics.parameters.PhysicsParameters physics.c_engine.CEngine",
    ),
    ("Batches of environments", "", "env.vector"),
    (
        "Tasks",
        "All but `find_task` are names of `bounce_mjx.task`. "
        "[Write a task](tasks.md#write-a-task) shows their use.",
        "task.task world.config.WorldConfig world.config.Goal world.observation.Quantity "
        "world.limits task.results task.registry.find_task",
    ),
    (
        "Policies on a robot",
        "",
        "deploy.loading.load_policy deploy.policy.DeployedPolicy deploy.supervisor.Supervisor "
        "deploy.controller.Controller deploy.controller.Memory deploy.samples.Samples "
        "deploy.flight.fit_fall deploy.faults.Watch deploy.metadata.Metadata "
        "deploy.recorder.Recorder",
    ),
    (
        "Two cameras",
        "[Two cameras](cameras.md) shows their use.",
        "vision.camera vision.circles vision.tracker vision.calibration vision.poses vision.view "
        "vision.rig vision.capture vision.check vision.procedures",
    ),
    (
        "Policies in JAX",
        "",
        "runs.folders.find_checkpoint runs.checkpoints.read_policy learning.policy.Policy "
        "learning.policy.make_networks learning.policy.networks_of learning.policy.Networks "
        "baselines.mirror.MirrorLaw",
    ),
    ("Rewards", "", "task.rewards task.flights task.bounce_rewards.RewardInputs"),
    ("Robots", "", "robot.config.RobotConfig robot.adopt.adopt"),
    (
        "Evaluation",
        "",
        "evaluation.policy_evaluation.evaluate_policy evaluation.config.EvaluationOptions "
        "evaluation.policy_evaluation.PolicyEvaluation evaluation.results.Report "
        "evaluation.robustness.measure_conditions evaluation.episodes.make_evaluator "
        "evaluation.results.judge",
    ),
    (
        "Plots",
        "",
        "reports.figures.run_plot reports.figures.RunPlot reports.figures.make_panels",
    ),
    (
        "Training",
        "",
        "training.run.train training.run.Run training.events.Event training.events.Callback "
        "training.video.EvaluationVideo training.job.train training.ppo_trainer.PPOTrainer "
        "training.trainer.Trainer training.trainer.Snapshot learning.algorithm.Algorithm "
        "learning.ppo.PPO learning.ppo.Samples "
        "learning.policy.ActionDistribution learning.policy.NetworkFunctions "
        "learning.statistics.normalize",
    ),
    (
        "Adapters",
        "",
        "deploy.environments.environment "
        "adapters.gymnasium.environments.TaskEnv adapters.gymnasium.environments.TaskVectorEnv "
        "adapters.sb3.Sb3VecEnv adapters.torch.vector_env.TorchVectorEnv "
        "adapters.torch.vector_env.StepResult adapters.torch.rsl_rl_env.RslRlVecEnv "
        "adapters.torch.skrl_env.SkrlEnv adapters.torch.policy.to_policy "
        "adapters.torch.policy.write_run adapters.brax.environment.BraxTaskEnv "
        "adapters.gymnax_env.GymnaxTaskEnv adapters.gymnax_env.PureJaxRLTaskEnv "
        "adapters.playground.environment.PlaygroundTaskEnv adapters.brax.ppo.ppo_settings "
        "adapters.brax.ppo.network_settings adapters.brax.ppo.load_brax_policy",
    ),
)


def main() -> None:
    """Prints the index."""
    print(index(), end="")


def index() -> str:
    """The page with a line for each name, Markdown."""
    parts = [_INDEX_HEAD.format(shared=_SHARED).rstrip()]
    for heading, members in _sections():
        rows = [
            f"| [`{member.parent.path}.{member.name}`]({_source(member)}) | {_summary(member)} |"
            for member in members
        ]
        parts.append(heading)
        parts.append("\n".join(["| name | what it is |", "|---|---|", *rows]))
    return "\n\n".join(parts) + "\n"


def reference() -> str:
    """The page with the signatures and the whole docstrings, Markdown."""
    parts = [_HEAD.format(shared=_SHARED).rstrip()]
    for heading, members in _sections():
        parts.append(heading)
        for member in members:
            parts.append(f"### {member.name}")
            parts.append(f"`from {member.parent.path} import {member.name}`")
            parts += _class(member) if member.is_class else _entry(member)
    return "\n\n".join(parts) + "\n"


def _sections() -> Iterator[tuple[str, list[griffe.Object]]]:
    """The heading of each section and its objects: of a module, all its public ones."""
    logging.getLogger("griffe").setLevel(logging.ERROR)  # of arguments without a type
    package = griffe.load("bounce_mjx", search_paths=[str(SOURCE)], docstring_parser="google")
    for title, sentence, names in _SECTIONS:
        members = []
        for name in names.split():
            documented = package[name]
            if documented.is_module:
                public = [member for _, member in _public(documented)]
                members += [x for x in public if x.is_class or x.is_function]
            else:
                members.append(documented)
        yield (f"## {title}\n\n{sentence}" if sentence else f"## {title}"), members


def _source(documented: griffe.Object) -> str:
    """The link from the page to the file."""
    return f"../src/{documented.relative_package_filepath.as_posix()}"


def _summary(documented: griffe.Object) -> str:
    """The docstring's first sentence up to a semicolon, in a cell of a table."""
    paragraph, *_ = documented.docstring.value.split("\n\n")
    sentence, *_ = f"{' '.join(paragraph.split())} ".split(". ")
    clause, *_ = sentence.split("; ")
    return f"{clause.strip().removesuffix('.')}.".replace("|", "\\|")


def _class(documented: griffe.Class) -> Iterator[str]:
    """Its head, its fields or attributes, and its methods."""
    bases = ", ".join(f"`{base}`" for base in documented.bases if str(base) not in _NO_BASES)
    yield from _entry(documented)
    if bases:
        yield f"Base: {bases}."
    if _is_config(documented):
        yield "Its settings are in the [config reference](config.md)."
        return
    members = list(_public(documented))
    has_defaults = _is_tuple(documented)
    fields = [_field(name, member, has_defaults) for name, member in members if member.is_attribute]
    if fields:
        yield "Fields and properties:"
        yield "\n".join(fields)
    for _, member in members:
        if member.is_function:
            yield from _entry(member, f"{documented.name}.")


def _is_config(documented: griffe.Class) -> bool:
    """Whether the config reference has its fields."""
    return documented.name.endswith("Config")


def _is_tuple(documented: griffe.Class) -> bool:
    """Whether its fields, in their order, are its arguments."""
    return "NamedTuple" in map(str, documented.bases)


_NO_BASES = "NamedTuple", "StrictModel", "Protocol", "object"


def _public(documented: griffe.Object) -> Iterator[tuple[str, griffe.Object]]:
    """The public members by name that are written where the object is, in the source's order."""
    for name, member in documented.members.items():
        if not name.startswith("_") and not member.is_alias:
            yield name, member


def _field(name: str, member: griffe.Attribute, has_default: bool) -> str:
    """A line for a field, an attribute or a property."""
    annotation = f": {member.annotation}" if member.annotation is not None else ""
    text = " ".join((member.docstring.value if member.docstring else "").split())
    default = f" = {member.value}" if has_default and member.value is not None else ""
    return f"- `{name}{annotation}{default}` {text}".rstrip()


def _entry(documented: griffe.Object, prefix: str = "") -> Iterator[str]:
    """The signature and the docstring of a class, a function or a method, or a type's alias."""
    name = prefix + documented.name
    constructor = documented.members.get("__init__") if documented.is_class else None
    if documented.is_attribute:
        yield f"```py\n{name} = {documented.value}\n```"
    elif documented.is_function:
        yield _signature(name, documented.parameters, documented.returns)
    elif not (_is_config(documented) or _is_tuple(documented)):
        yield _signature(name, (constructor or documented).parameters, None)
    yield from _docstring(documented)
    if constructor is not None:
        yield from _docstring(constructor)


def _signature(name: str, parameters: griffe.Parameters, returns: griffe.Expr | None) -> str:
    """A definition on one line, or on a line for each parameter."""
    shown, are_keywords = [], False
    for parameter in parameters:
        if parameter.name in ("self", "cls"):
            continue
        if parameter.kind is griffe.ParameterKind.keyword_only and not are_keywords:
            are_keywords = True
            shown.append("*")
        stars = _STARS.get(parameter.kind, "")
        are_keywords = are_keywords or stars == "*"
        kind = f": {parameter.annotation}" if parameter.annotation is not None else ""
        has_default = parameter.default is not None and not stars
        default = (" = " if kind else "=") + str(parameter.default) if has_default else ""
        shown.append(f"{stars}{parameter.name}{kind}{default}")
    end = f") -> {returns}" if returns else ")"
    line = f"{name}({', '.join(shown)}{end}"
    if len(line) > 80:
        line = f"{name}(\n" + "".join(f"    {part},\n" for part in shown) + end
    return f"```py\n{line}\n```"


_STARS = {
    griffe.ParameterKind.var_positional: "*",
    griffe.ParameterKind.var_keyword: "**",
}


def _docstring(documented: griffe.Object) -> Iterator[str]:
    """Its text, its arguments, what it returns and its errors."""
    if documented.docstring is None:
        return
    for part in documented.docstring.parsed:
        if part.kind is griffe.DocstringSectionKind.text:
            yield part.value
        elif part.kind in _TITLES:
            lines = [f"- {_named(item)}{_line(item.description)}" for item in part.value]
            yield f"{_TITLES[part.kind]}:\n\n" + "\n".join(lines)
        else:
            raise ValueError(f"{documented.path} has a section {part.kind}")


_TITLES = {
    griffe.DocstringSectionKind.parameters: "Arguments",
    griffe.DocstringSectionKind.returns: "Returns",
    griffe.DocstringSectionKind.raises: "Errors",
}


def _named(item: griffe.DocstringNamedElement) -> str:
    """The argument, or the type of the error."""
    if isinstance(item, griffe.DocstringRaise):
        return f"`{item.annotation}`: "
    return f"`{item.name}`: " if item.name else ""


def _line(text: str) -> str:
    return " ".join(textwrap.dedent(text).split())


if __name__ == "__main__":
    main()
