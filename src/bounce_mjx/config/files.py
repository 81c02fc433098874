"""Settings as YAML."""

from pathlib import Path
from typing import Any

import yaml

from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.files import read_regular

_MAX_BYTES = 2**16
_MAX_ALIASES = 10


class _Loader(yaml.SafeLoader):
    """Refuses YAML in which a key appears twice, or whose size multiplies because repeated groups
    contain repeated groups."""

    _aliases = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        is_alias = self.check_event(yaml.AliasEvent)
        node = super().compose_node(parent, index)
        self._aliases += is_alias and isinstance(node, yaml.CollectionNode)
        if self._aliases > _MAX_ALIASES:
            raise yaml.YAMLError(f"it repeats a group more than {_MAX_ALIASES} times")
        return node

    def compose_mapping_node(self, anchor: str | None) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        first: dict[Any, yaml.Node] = {}
        for key, _ in node.value:
            name = (key.tag, key.value) if isinstance(key, yaml.ScalarNode) else key
            if (other := first.setdefault(name, key)) is not key:
                lines = f"{other.start_mark.line + 1} and {key.start_mark.line + 1}"
                raise yaml.YAMLError(
                    f"the key {key.value} appears twice, in lines {lines}; join the two"
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
    try:
        values = _Loader(read_regular(path, _MAX_BYTES).decode("utf-8")).get_single_data()
    # PyYAML raises exceptions of many types where a value looks like a number or a date but is not
    # one.
    except Exception as error:
        reason = " ".join((getattr(error, "strerror", None) or str(error) or repr(error)).split())
        raise UserError(
            f"the {kind} {shorten(str(path))} cannot be read ({shorten(reason, 300)}); give a "
            f"YAML file such as {example}"
        ) from error
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise UserError(
            f"the {kind} {shorten(str(path))} holds a {type(values).__name__}, not a mapping "
            f"of keys to values; write it like {example}"
        )
    return values


def dump_config(config: StrictModel) -> str:
    """The whole config as YAML, for `load_config`."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def differing_keys(one: StrictModel, other: StrictModel) -> set[str]:
    """Dotted names of the settings in which two configs differ."""
    a, b = flat(one.model_dump()), flat(other.model_dump())
    return {key for key in a.keys() | b.keys() if a.get(key) != b.get(key)}


def flat(plain: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested mappings by their dotted names."""
    values = {}
    for key, value in plain.items():
        name = prefix + key
        values |= flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return values
