"""Prints the reference of every config key, generated from the types of the settings:

python docs/config_reference.py > docs/config.md
"""

from collections.abc import Iterator
from typing import Any

from bounce_mjx.config.settings import StrictModel
from bounce_mjx.config.validation import unit_of
from bounce_mjx.runs.config import train_config
from bounce_mjx.tasks.registry import DEFAULT, find_task
from bounce_mjx.world.randomization import Term

_HEAD = """# Config reference

Every setting of a training run for the task bounce; [other tasks](tasks.md#write-a-task) have other
keys in `env`. In a YAML file (`--config FILE`, see [training](training.md#a-file-of-your-own)) the
keys are nested groups. A preset overrides the defaults, a file of yours the preset, a robot
(`--robot`) the file, and a command-line flag all of them. Unknown keys and values out of range are
refused.

Each section lists the keys of one group. A key's flag is its full name without `env.` or `ppo.`
and with hyphens: `--num-envs` for `ppo.num_envs`, and `--reward.height.weight` for
`env.reward.height.weight`.

A whole number may have an exponent (`1e6`). On the command line, the items of a list are separated
by spaces or commas (`256 256` or `256,256`), and a switch has three forms, such as
`--stop-when-solved`, `--no-stop-when-solved` and `--stop-when-solved=false`.

This page is generated from the types of the settings (`TrainConfig` in
`src/bounce_mjx/runs/config.py`, and the groups in it):

    python docs/config_reference.py > docs/config.md

These rules apply across keys:

- `env.control_dt` is a multiple of `env.physics_dt`, and `env.episode_seconds` is at least as long;
- a range is [low, high] with low ≤ high;
- an episode does not end where it starts: `env.ball_init_pos` is over `env.min_ball_height`, less
  than `env.max_height_above_target` over the lowest target, and within
  `env.max_horizontal_distance`;
- the model's joint ranges contain `env.default_joint_angles`, and the ball's start and the target
  heights are over the paddle there;
- a setting that would have no effect is refused: `env.robot.*` but its limits without
  `env.robot.site`, `env.action.max_lead` without `env.action.base: target`,
  `env.randomization.push_interval` without `push_speed`;
- `ppo.num_minibatches` divides `ppo.num_envs` × `ppo.rollout_length`, and a rollout is at most as
  long as an episode;
- `ppo.min_learning_rate` is at most the two upper limits;
- `ppo.critic_metrics` names metrics of the environment.
"""

_CONFIG = train_config(find_task(DEFAULT))


def main() -> None:
    """Prints the page."""
    print(reference(), end="")


def reference() -> str:
    """The whole page, Markdown."""
    return _HEAD + "".join(_section(model, prefix) for model, prefix in _groups(_CONFIG, ""))


def _groups(model: type[StrictModel], prefix: str) -> Iterator[tuple[type[StrictModel], str]]:
    """A group of settings and the groups nested in it, each with the prefix of its keys."""
    yield model, prefix
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, StrictModel):
            yield from _groups(field.annotation, f"{prefix}{name}.")


def _section(model: type[StrictModel], prefix: str) -> str:
    rows = []
    schema = model.model_json_schema()
    for name, field in model.model_fields.items():
        plain = schema["properties"][name]
        if "$ref" in plain:
            continue
        text = " ".join((field.description or "").split())
        unit = unit_of(text)
        kind = "" if "enum" in plain else _type(plain)
        is_list = "array" in {option.get("type") for option in plain.get("anyOf", [plain])}
        terms = [mark for mark in field.metadata if isinstance(mark, Term)]
        span = "each {:g} to {:g}".format(*terms[0].bounds) if terms else _range(plain)
        value = (", " if is_list else " ").join(part for part in (kind, span) if part)
        value += f" ({unit})" if unit else ""
        cells = f"`{name}`", value, _default(plain.get("default")), text
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n")
    title = f"`{prefix.removesuffix('.')}`" if prefix else "The run"
    text = " ".join((model.__doc__ or "").split())
    return (
        f"\n## {title}\n\n{text}\n\n"
        "| key | value | default | meaning |\n|---|---|---|---|\n" + "".join(rows)
    )


def _type(plain: dict[str, Any]) -> str:
    """The type of a JSON schema in a word or two."""
    if "anyOf" in plain:
        return " or ".join(_type(option) for option in plain["anyOf"])
    if "enum" in plain:
        return "word"
    if plain.get("format") == "path":
        return "path"
    if plain["type"] == "array":
        items = plain.get("prefixItems")
        first, *rest = _type(items[0] if items else plain["items"]).split(" or ")
        each = " or ".join((f"{first}s", *rest))
        return f"{len(items)} {each}" if items else f"list of {each}"
    names = {"integer": "whole number", "string": "word", "boolean": "switch", "null": "nothing"}
    return names.get(plain["type"], plain["type"])


def _default(value: Any) -> str:
    """A default value as YAML; numbers have six digits."""
    if isinstance(value, list):
        return f"[{', '.join(_default(item) for item in value)}]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int):
        return f"{value:_}" if value >= 10_000 else str(value)
    if isinstance(value, float):
        # YAML reads a number with an exponent but no point as a word.
        digits, exponent, power = f"{value:.6g}".partition("e")
        return (
            f"{digits}.0e{power}" if exponent and "." not in digits else digits + exponent + power
        )
    return str(value)


def _range(plain: dict[str, Any]) -> str:
    """The bounds of the value in a JSON schema, or of the items of its list."""
    if "enum" in plain:
        return ", ".join(plain["enum"])
    if "anyOf" in plain:
        return next((text for text in map(_range, plain["anyOf"]) if text), "")
    if plain.get("type") == "array":
        items = plain.get("prefixItems")
        each = _range(items[0] if items else plain["items"])
        least = f"at least {plain['minItems']}" if not items and plain.get("minItems") else ""
        return ", ".join(text for text in (least, f"each {each}" if each else "") if text)
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    # pydantic keeps its own names for the bounds behind a validator.
    signs |= {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    limits = [f"{sign} {_bound(plain[key])}" for key, sign in signs.items() if key in plain]
    return ", ".join(limits) or ("finite" if plain.get("type") == "number" else "")


def _bound(value: float) -> str:
    return {2**31: "2^31", 10**12: "10^12"}.get(value, f"{value:g}")


if __name__ == "__main__":
    main()
