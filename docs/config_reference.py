"""Prints the reference of every config key, generated from the types of the settings:

python docs/config_reference.py > docs/config.md
"""

from collections.abc import Iterator
from typing import Any

from bounce_mjx.config.settings import StrictModel
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.layers import Rank
from bounce_mjx.world.randomization import Term

_HEAD = """# Config reference

Look up any setting of a training: its key, default, meaning and range. In a [YAML
file](training.md#a-file-of-your-own) the keys are nested groups, one per section here. A flag is
the full name without `env.` or `ppo.`, with hyphens: `--num-envs` for `ppo.num_envs`,
`--reward.height.weight` for `env.reward.height.weight`.

A setting may come from several places, of which a later one wins:

{order}

`bounce-mjx train --print-config` prints the config with what set each value; of a run, that is
`Run(FOLDER).config.sources`. Unknown keys, values out of range and settings without effect are
refused. A list is `256 256` or `256,256` on the command line, and a switch `--stop-when-solved`,
`--no-stop-when-solved` or `--stop-when-solved=false`. Whole numbers are below 2^31, steps at most
10^12 (`1e6` is one too).

- `env.control_dt` is a multiple of `env.physics_dt`; an episode is whole control steps, at least
  one.
- An episode must not end where it starts (`env.ball_init_pos`), and the ball and the targets are
  above the paddle in `env.default_joint_angles`.
- `ppo.num_minibatches` divides `ppo.num_envs` × `ppo.rollout_length`; a rollout is at most an
  episode.

`python docs/config_reference.py > docs/config.md` writes this page.
"""


def main() -> None:
    """Prints the page."""
    print(reference(), end="")


def reference() -> str:
    """The whole page, Markdown."""
    order = "\n".join(f"{number}. {layer}" for number, layer in enumerate(Rank, start=1))
    sections = [_section(group, prefix) for group, prefix in _groups(TrainConfig(), "")]
    return _HEAD.replace("{order}", order) + "".join(sections)


def _groups(group: StrictModel, prefix: str) -> Iterator[tuple[StrictModel, str]]:
    """A group of settings and the groups nested in it, each with the prefix of its keys."""
    yield group, prefix
    for name, value in group:
        if isinstance(value, StrictModel):
            yield from _groups(value, f"{prefix}{name}.")


def _section(group: StrictModel, prefix: str) -> str:
    entries, values, model = [], [], type(group)
    schema, defaults = model.model_json_schema(), group.model_dump(mode="json")
    for name, field in model.model_fields.items():
        plain = schema["properties"][name]
        if "$ref" in plain:
            continue
        text = " ".join((field.description or "").split())
        terms = [mark for mark in field.metadata if isinstance(mark, Term)]
        span = "{:g} to {:g}".format(*terms[0].bounds) if terms else _range(plain)
        kind = "" if terms or "enum" in plain else _type(plain, plain.get("default") is None)
        values.append((", " if kind == "list" else " ").join(p for p in (kind, span) if p))
        text = "" if text == "Weight of the term." else f" {text}"
        entries.append(f"- `{name}: {_default(defaults[name])}`{text}")
    title = f"`{prefix.removesuffix('.')}`" if prefix else "The run"
    text = " ".join((model.__doc__ or "").split())
    # Most quantities of the observation have the same range.
    most = max(values, key=values.count, default="")
    common = most if values.count(most) > 10 else ""
    text += f" Where nothing else is said, a value is {common}." if common else ""
    ends = [f" ({value})" if value and value != common else "" for value in values]
    lines = [f"{entry}{end}\n" for entry, end in zip(entries, ends, strict=True)]
    return f"\n## {title}\n\n{text}\n\n" + "".join(lines)


def _type(plain: dict[str, Any], in_full: bool) -> str:
    """The type of a JSON schema in words; unless in full, what its default does not show."""
    if "anyOf" in plain:
        return _type(plain["anyOf"][0], in_full)
    if plain["type"] == "integer":
        return "whole"
    if not in_full:
        return ""
    if plain.get("format") == "path":
        return "path"
    if plain["type"] == "array":
        items = plain.get("prefixItems")
        return f"{len(items)} items" if items else "list"
    return {"string": "word"}.get(plain["type"], plain["type"])


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
        least = f"at least {plain['minItems']} item" if not items and plain.get("minItems") else ""
        return ", ".join(text for text in (least, f"each {each}" if each else "") if text)
    if "minimum" in plain and plain.get("maximum", 10**12) < 10**12:
        return f"{plain['minimum']:g} to {plain['maximum']:g}"
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    # pydantic keeps its own names for the bounds behind a validator.
    signs |= {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    limits = {sign: plain[key] for key, sign in signs.items() if key in plain}
    # The head of the page has the bounds of all whole numbers.
    return ", ".join(f"{s} {x:g}" for s, x in limits.items() if x not in (2**31, 10**12))


if __name__ == "__main__":
    main()
