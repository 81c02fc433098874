"""Calls of GPU kernels that are compiled while JAX still traces the program around them.

XLA compiles the kernels of Pallas' Mosaic GPU backend one after another, half a second each and
more, when it has optimised everything else. It keeps every compiled kernel for the process, though.
So each kernel is lowered on its own, and a thread compiles it as a program of its own; the program
around it only names it.

Python lowers one kernel at a time, and a large one takes most of a second. So other processes may
lower kernels meanwhile (`lower_elsewhere`, `lower_for_another`).
"""

import contextlib
import threading
from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import mlir

from bounce_mjx.gpu.batches import is_dropped

_TARGET = "mosaic_gpu_v2"
# Kernels that are kept for a second call.
_MOST_KEPT = 8

Key = tuple[Hashable, ...]
Shapes = tuple[jax.ShapeDtypeStruct, ...]
Attributes = dict[str, bytes | bool]
"""A lowered kernel, as XLA takes it."""


class LoweredKernel(NamedTuple):
    """A kernel that was lowered for another process."""

    name: str
    """Stands for this kernel and no other, in every process."""
    attributes: Attributes
    program: jax.stages.Lowered
    """A program that only calls the kernel."""


class Helper(Protocol):
    """Other processes that lower kernels of this process."""

    def lowers(self, kind: Hashable) -> bool:
        """Whether a process was asked for the kernels of a kind."""

    def wait_for(self, kind: Hashable, name: str) -> Attributes | None:
        """Waits for a kernel; None if no process will lower it."""


_kept: dict[Hashable, Attributes] = {}
_helper: Helper | None = None
_receive: Callable[[Key, Callable[..., Any], Shapes], None] | None = None


def lower_elsewhere(helper: Helper | None) -> None:
    """Takes kernels from other processes from now on; None ends it."""
    global _helper
    _helper = helper


def lower_for_another(
    kinds: Collection[Hashable], receive: Callable[[LoweredKernel], None]
) -> None:
    """Makes this process lower kernels for another one: `receive` gets each kernel of these kinds
    once, as soon as a program that calls it is traced. The program itself is of no use, as it
    leaves all kernels out."""
    given: set[str] = set()

    def lower(key: Key, kernel: Callable[..., Any], shapes: Shapes) -> None:
        name = _name(key, shapes)
        if key[0] in kinds and name not in given:
            given.add(name)
            receive(LoweredKernel(name, *_lower(kernel, shapes)))

    global _receive
    _receive = lower


def lowers_for_another() -> bool:
    """Whether this process lowers kernels for another one."""
    return _receive is not None


def call_kernel(
    kernel: Callable[..., Any], results: Any, *args: jax.Array, key: Key | None = None
) -> Any:
    """Calls a kernel of `plgpu.kernel`, which a thread compiles meanwhile.

    Args:
      results: shapes of its results, in the structure in which the kernel returns them.
      key: stands for this kernel and no other, in every process; its kind comes first. A second
        call then need not lower the kernel again, and another process can lower it. A program can
        also start a long compilation by a call whose results it drops.
    """
    # XLA itself lowers the kernels of several devices, once it has split the arrays.
    if jax.device_count() > 1:
        return kernel(*args)
    shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args)
    leaves, structure = jax.tree.flatten(results)
    if _receive is not None:
        if key is not None and not is_dropped():
            _receive(key, kernel, shapes)
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), results)
    lowers = _helper is not None and key is not None and _helper.lowers(key[0])
    if lowers or is_dropped():
        called = _deferred.bind(*args, kernel=kernel, key=key, results=tuple(leaves))
    else:
        attributes = _kept_or_lowered(kernel, shapes, key)
        called = jax.ffi.ffi_call(_TARGET, leaves)(*args, **attributes)
    return structure.unflatten(called)


# The call of a kernel that is not lowered yet: another process lowers it, and this one waits for it
# when it lowers the program that calls it; or JAX drops the call.
_deferred = Primitive("deferred_kernel")
_deferred.multiple_results = True


@_deferred.def_abstract_eval
def _result_types(*_: ShapedArray, results: Shapes, **__: object) -> list[ShapedArray]:
    return [ShapedArray(x.shape, x.dtype) for x in results]


def _call_when_lowered(
    *args: jax.Array, kernel: Callable[..., Any], key: Key | None, results: Shapes
) -> Sequence[jax.Array]:
    shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args)
    attributes = None
    if _helper is not None and key is not None:
        attributes = _helper.wait_for(key[0], _name(key, shapes))
    if attributes is None:
        attributes = _kept_or_lowered(kernel, shapes, key)
    return jax.ffi.ffi_call(_TARGET, results)(*args, **attributes)


mlir.register_lowering(_deferred, mlir.lower_fun(_call_when_lowered, multiple_results=True))


def _name(key: Key, shapes: Shapes) -> str:
    return repr((key, [(x.shape, x.dtype.name) for x in shapes]))


def _kept_or_lowered(kernel: Callable[..., Any], shapes: Shapes, key: Key | None) -> Attributes:
    if key is None:
        return _lower(kernel, shapes)[0]
    attributes = _kept.get((key, shapes)) or _lower(kernel, shapes)[0]
    _kept[key, shapes] = attributes
    if len(_kept) > _MOST_KEPT:
        del _kept[next(iter(_kept))]
    return attributes


def _lower(kernel: Callable[..., Any], shapes: Shapes) -> tuple[Attributes, jax.stages.Lowered]:
    """Lowers a kernel, also as a program that only calls it, and starts to compile that on a GPU,
    unless another process wants it."""
    traced = jax.jit(kernel).trace(*shapes)
    if jax.default_backend() == "gpu":
        program = traced.lower()
        if _receive is None:
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
    return attributes, program


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
