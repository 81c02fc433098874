"""Calls of GPU kernels that are compiled while JAX still lowers the program around them.

XLA compiles the kernels of Pallas' Mosaic GPU backend one after another, half a second each and
more, when it has optimised everything else. It keeps every compiled kernel for the process, though.
So where a program is lowered, each of its kernels is lowered on its own, and a thread compiles it
as a program of its own; the program around it only names it.
"""

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import mlir

_TARGET = "mosaic_gpu_v2"

Shapes = tuple[jax.ShapeDtypeStruct, ...]
Attributes = dict[str, bytes | bool]
"""A lowered kernel, as XLA takes it."""


def call_kernel(kernel: Callable[..., Any], results: Any, *args: jax.Array) -> Any:
    """Calls a kernel of `plgpu.kernel`; only in compiled programs.

    Args:
      results: shapes of its results, in the structure in which the kernel returns them.
    """
    leaves, structure = jax.tree.flatten(results)
    called = _kernel_call.bind(*args, kernel=kernel, results=tuple(leaves))
    return structure.unflatten(called)


# A primitive, because only where a program is lowered is it known which devices run it.
_kernel_call = Primitive("kernel_call")
_kernel_call.multiple_results = True


@_kernel_call.def_abstract_eval
def _result_types(*_: ShapedArray, results: Shapes, **__: object) -> list[ShapedArray]:
    return [ShapedArray(x.shape, x.dtype) for x in results]


def _lower_call(
    context: mlir.LoweringRuleContext, *args: Any, kernel: Callable[..., Any], **parameters: Any
) -> Sequence[Any]:
    # XLA itself lowers the kernels of several devices, once it has split the arrays.
    alone = getattr(context.module_context.axis_context, "num_devices", None) == 1
    call = _call_lowered if alone else _call_plain
    rule = mlir.lower_fun(call, multiple_results=True)
    return rule(context, *args, kernel=kernel, **parameters)


mlir.register_lowering(_kernel_call, _lower_call)


def _call_plain(*args: jax.Array, kernel: Callable[..., Any], **_: object) -> Sequence[jax.Array]:
    return jax.tree.leaves(kernel(*args))


def _call_lowered(
    *args: jax.Array, kernel: Callable[..., Any], results: Shapes
) -> Sequence[jax.Array]:
    shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args)
    return jax.ffi.ffi_call(_TARGET, results)(*args, **_lower(kernel, shapes))


def _lower(kernel: Callable[..., Any], shapes: Shapes) -> Attributes:
    """Lowers a kernel, and on a GPU starts to compile a program that only calls it."""
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
    return {
        item.name: item.attr.value_bytes if hasattr(item.attr, "value_bytes") else item.attr.value
        for item in config
    }


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
