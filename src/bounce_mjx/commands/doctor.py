"""Prints what a report of a problem needs: `bounce-mjx doctor`."""

import argparse
import importlib.metadata
import os
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path

from bounce_mjx.errors import UserError, install_command, reason_of
from bounce_mjx.resources import VERSION

_DISTRIBUTION = "bounce_mjx"
# Versions on which the results of simulation and training depend.
_PACKAGES = "jax jaxlib mujoco mujoco-mjx numpy flax optax tensorstore onnxruntime".split()
_VARIABLES = ("JAX_", "XLA_", "MUJOCO_GL", "CUDA_VISIBLE_DEVICES")


_ABOUT = "Prints versions, devices, the cache, and what each extra lacks, to paste into an issue."


def main(args: Sequence[str]) -> None:
    """Runs the command line, also where any package is missing, as on a robot: even pydantic, with
    which the other commands read theirs."""
    parser = argparse.ArgumentParser("bounce-mjx doctor", description=_ABOUT)
    _, unknown = parser.parse_known_args(args)
    if unknown:
        raise UserError(f"unknown argument {unknown[0]} (see {parser.prog} --help)")
    print("```")
    for name, text in describe():
        print(f"{name}: {text}", flush=True)
    print("```")


def describe() -> Iterator[tuple[str, str]]:
    """The lines, each a name and a text."""
    yield "bounce_mjx", f"{VERSION} in {Path(__file__).parents[1]}"
    yield "python", f"{platform.python_version()} ({sys.executable}) on {platform.platform()}"
    yield "packages", ", ".join(f"{name} {version_of(name) or 'missing'}" for name in _PACKAGES)
    chosen = {name: value for name, value in os.environ.items() if name.startswith(_VARIABLES)}
    yield "variables", ", ".join(f"{n}={v}" for n, v in sorted(chosen.items())) or "none"
    yield "processors", f"{os.cpu_count()}"
    yield "devices", _try(_devices)
    yield "cache", _try(_cache)
    viewers = "bounce_mjx.viewers"
    yield "pictures", _try(lambda: import_module(f"{viewers}.offscreen").choose_backend())
    yield "videos", _try(lambda: import_module(f"{viewers}.video").find_ffmpeg())
    try:
        needed = sorted(extras().items())
    except ImportError as error:
        # Without packaging, which reads what an extra needs.
        yield "extras", f"unknown ({reason_of(error)})"
        return
    for extra, packages in needed:
        missing = [package for package in packages if version_of(package) is None]
        command = install_command(f"{_DISTRIBUTION}[{extra}]")
        state = f"lacks {', '.join(missing)} ({command})" if missing else "installed"
        yield f"extra {extra}", state


def version_of(package: str) -> str | None:
    """The version of an installed package; None if it is missing."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def extras() -> dict[str, list[str]]:
    """The packages of each extra; none where the package runs without being installed."""
    if version_of(_DISTRIBUTION) is None:
        return {}
    names = importlib.metadata.metadata(_DISTRIBUTION).get_all("Provides-Extra", [])
    return {extra: list(_packages(_DISTRIBUTION, extra)) for extra in names}


def _packages(distribution: str, extra: str) -> Iterator[str]:
    """The packages of an installed package's extra, with those of the extras that it includes."""
    from packaging.requirements import Requirement

    for needed in map(Requirement, importlib.metadata.requires(distribution) or []):
        if needed.marker is None:
            continue
        # A marker of the version of Python alone holds without an extra too.
        is_always_needed = needed.marker.evaluate({"extra": ""})
        if needed.marker.evaluate({"extra": extra}) and not is_always_needed:
            yield needed.name
            for inner in needed.extras if version_of(needed.name) else ():
                yield from _packages(needed.name, inner)


def _try(describe: Callable[[], str]) -> str:
    """A description, or why there is none: a broken installation is what this command is for, so
    each description imports its libraries itself."""
    try:
        return describe()
    except Exception as error:
        return f"none ({reason_of(error)})"


def _devices() -> str:
    import jax

    return ", ".join(f"{device.device_kind} ({device})" for device in jax.devices())


def _cache() -> str:
    import jax

    from bounce_mjx.training.setup import cache_compilations

    cache_compilations()
    folder = jax.config.jax_compilation_cache_dir
    if folder is None:
        return "none"
    sizes = [path.stat().st_size for path in Path(folder).glob("*") if path.is_file()]
    return f"{folder}, {len(sizes)} files, {sum(sizes) / 1e6:.0f} MB"
