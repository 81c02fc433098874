"""Calls of GPU kernels that are compiled while JAX still traces the program around them.

XLA compiles the kernels of Pallas' Mosaic GPU backend one after another, half a second each and
more, when it has optimised everything else. It keeps every compiled kernel for the process, though.
So each kernel is lowered on its own, and a thread compiles it as a program of its own; the program
around it only names it.
"""

import contextlib
import threading
from collections.abc import Callable, Hashable, Iterator
from typing import Any, NamedTuple

import jax

_TARGET = "mosaic_gpu_v2"
# Kernels that are kept for a second call.
_MOST_KEPT = 8


class _Lowered(NamedTuple):
    """A lowered kernel."""

    results: Any
    """Shapes of its results, with the structure in which the kernel returns them."""
    attributes: dict[str, bytes | bool]
    """What XLA compiles."""


_kept: dict[Hashable, _Lowered] = {}


def call_kernel(kernel: Callable[..., Any], *args: jax.Array, key: Hashable = None) -> Any:
    """Calls a kernel of `plgpu.kernel`, which a thread compiles meanwhile.

    Args:
      key: stands for this kernel and no other, so that a second call need not lower it again. A
        program can thus start a long compilation by a call whose results it drops.
    """
    # XLA itself lowers the kernels of several devices, once it has split the arrays.
    if jax.device_count() > 1:
        return kernel(*args)
    shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args)
    lowered = None if key is None else _kept.get((key, shapes))
    if lowered is None:
        lowered = _lower(kernel, shapes)
    if key is not None:
        _kept[key, shapes] = lowered
        if len(_kept) > _MOST_KEPT:
            del _kept[next(iter(_kept))]
    leaves, structure = jax.tree.flatten(lowered.results)
    return structure.unflatten(jax.ffi.ffi_call(_TARGET, leaves)(*args, **lowered.attributes))


def _lower(kernel: Callable[..., Any], shapes: tuple[jax.ShapeDtypeStruct, ...]) -> _Lowered:
    """Lowers a kernel, and starts to compile it if there is a GPU."""
    traced = jax.jit(kernel).trace(*shapes)
    if jax.default_backend() == "gpu":
        program = traced.lower()
        threading.Thread(target=_compile, args=(program,)).start()
    else:
        program = traced.lower(lowering_platforms=("cuda",))
    (config,) = (
        operation.attributes["mhlo.backend_config"]
        for operation in _operations(program.compiler_ir("stablehlo").operation)
        if operation.name == "stablehlo.custom_call"
    )
    attributes = {
        item.name: item.attr.value_bytes if hasattr(item.attr, "value_bytes") else item.attr.value
        for item in config
    }
    results = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), traced.out_info)
    return _Lowered(results, attributes)


def _compile(program: jax.stages.Lowered) -> None:
    # An error comes again when the program around the kernel is compiled, and is reported there.
    with contextlib.suppress(Exception):
        program.compile()


def _operations(operation: Any) -> Iterator[Any]:
    for region in operation.regions:
        for block in region:
            for inner in block:
                yield inner.operation
                yield from _operations(inner.operation)
