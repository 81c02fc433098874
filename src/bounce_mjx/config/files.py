"""Settings as YAML."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import UserError, shorten

# A config has at most a thousand values.
_MAX_VALUES = 20_000

# Text, and the key << that joins mappings.
_KEY_TAGS = ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge")


class _Loader(yaml.SafeLoader):
    """Refuses YAML in which a key appears twice, of which the last would count, or is no text, and
    YAML that has very many values, also by aliases of aliases."""

    def __init__(self, stream: str):
        super().__init__(stream)
        self._count = 0
        self._counts: dict[yaml.Node, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        before = self._count
        is_alias = self.check_event(yaml.AliasEvent)
        node = super().compose_node(parent, index)
        # An alias inside its own anchor, whose values are not counted yet, has no end.
        self._count += self._counts.get(node, _MAX_VALUES) if is_alias else 1
        if self._count > _MAX_VALUES:
            raise yaml.YAMLError(f"it has more than {_MAX_VALUES:,} values")
        if not is_alias:
            self._counts[node] = self._count - before
        return node

    def compose_mapping_node(self, anchor: str | None) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        first: dict[str, yaml.Node] = {}
        for key, _ in node.value:
            other = first.setdefault(str(key.value), key)
            if other is not key:
                lines = f"{other.start_mark.line + 1} and {key.start_mark.line + 1}"
                raise yaml.YAMLError(
                    f"the key {key.value} appears twice, in lines {lines}; join the two"
                )
            # YAML reads on, yes and 1 as true, true and a number.
            if key.tag not in _KEY_TAGS:
                line = key.start_mark.line + 1
                raise yaml.YAMLError(
                    f"the key {shorten(str(key.value))} in line {line} is no text to YAML; "
                    "correct it, or put it in quotes"
                )
        return node


def read_mapping(path: Path, kind: str, example: str) -> dict[str, Any]:
    """Reads a YAML file of keys and values; an empty file has none.

    Args:
      kind: kind of the file for error messages, such as "config file".
      example: a file of that kind, for error messages.

    Raises:
      UserError: the file is missing or is not a YAML mapping.
    """
    advice = f"give a YAML file of keys and values such as {example}"
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    # PyYAML raises exceptions of many types where a value looks like a number or a date but is not
    # one.
    except Exception as error:
        reason = " ".join((getattr(error, "strerror", None) or str(error) or repr(error)).split())
        raise UserError(
            f"the {kind} {shorten(str(path))} cannot be read ({shorten(reason, 300)}); {advice}"
        ) from error
    if not isinstance(values, dict | None):
        kind = f"the {kind} {shorten(str(path))} holds a {type(values).__name__}"
        raise UserError(f"{kind}, not a mapping; {advice}")
    return values or {}


def dump_config(config: StrictModel) -> str:
    """The whole config as YAML, for `load_run_config` and --config."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def dump_with_sources(plain: dict[str, Any], sources: Mapping[str, str], prefix: str = "") -> str:
    """Nested settings as YAML, each with a comment that names its source.

    Args:
      sources: by dotted key, with what else the comment says.
      prefix: dotted key of the group, with a dot.
    """
    lines = []
    indent = "  " * prefix.count(".")
    for name, value in plain.items():
        key = prefix + name
        is_group = key not in sources
        if is_group:
            lines.append(f"{indent}{name}:\n")
            lines.append(dump_with_sources(value, sources, f"{key}."))
        else:
            # YAML marks the end of a single word.
            text = yaml.safe_dump(value, default_flow_style=True, width=math.inf).split("\n")[0]
            line = f"{indent}{name}: {text}"
            lines.append(f"{line:<48}  # {sources[key]}\n")
    return "".join(lines)


def differing_keys(one: StrictModel, other: StrictModel) -> set[str]:
    """Dotted names of the settings in which two configs differ."""
    ours = flat(one.model_dump())
    theirs = flat(other.model_dump())
    return {key for key in ours.keys() | theirs.keys() if ours.get(key) != theirs.get(key)}


def flat(plain: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested mappings by their dotted names."""
    values = {}
    for key, value in plain.items():
        # A key from Python may be no text; validation then refuses it.
        name = f"{prefix}{key}"
        values |= flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return values
