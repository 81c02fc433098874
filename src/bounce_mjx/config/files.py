"""Settings as YAML."""

import yaml

from bounce_mjx.config.settings import StrictModel


def dump_config(config: StrictModel) -> str:
    """The whole config as YAML, for `load_config`."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def differing_keys(one: StrictModel, other: StrictModel) -> set[str]:
    """Dotted names of the settings in which two configs of one type differ."""
    keys = set()
    for name in type(one).model_fields:
        a, b = getattr(one, name), getattr(other, name)
        if isinstance(a, StrictModel):
            keys |= {f"{name}.{inner}" for inner in differing_keys(a, b)}
        elif a != b:
            keys.add(name)
    return keys
