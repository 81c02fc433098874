"""The GPU kernels of a program as programs of their own, which several threads can compile.

XLA compiles the kernels of Pallas' Mosaic GPU backend one after another, half a second each. It
keeps every compiled kernel for the process, though, so a kernel that another thread has compiled
costs nothing.
"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

_TARGET = "mosaic_gpu_v2"
_TYPES = {"f32": jnp.float32, "bf16": jnp.bfloat16, "i32": jnp.int32}


def kernel_programs(lowered: jax.stages.Lowered) -> list[jax.stages.Lowered]:
    """A program for each different kernel of a lowered program; compiling it leaves the kernel
    ready for that program."""
    calls = {
        str(call.attributes["mhlo.backend_config"]["kernel_hash"]): call
        for call in _operations(lowered.compiler_ir("stablehlo").operation)
        if call.name == "stablehlo.custom_call"
        and call.attributes["call_target_name"].value == _TARGET
    }
    return [_program(call) for call in calls.values()]


def _operations(operation: Any) -> Iterator[Any]:
    for region in operation.regions:
        for block in region:
            for inner in block:
                yield inner.operation
                yield from _operations(inner.operation)


def _program(call: Any) -> jax.stages.Lowered:
    config = call.attributes["mhlo.backend_config"]
    attributes = {item.name: _value(item.attr) for item in config}
    results = [_shape(result.type) for result in call.results]

    def run(*args: jax.Array) -> Any:
        return jax.ffi.ffi_call(_TARGET, results)(*args, **attributes)

    return jax.jit(run).lower(*(_shape(operand.type) for operand in call.operands))


def _value(attribute: Any) -> bytes | bool:
    return attribute.value_bytes if hasattr(attribute, "value_bytes") else attribute.value


def _shape(kind: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(kind.shape, _TYPES[str(kind.element_type)])
