"""Where the package's own GPU kernels run.

They are written for Pallas' Mosaic GPU backend: NVIDIA's Hopper and later. XLA compiles the same
computation everywhere else, and with `BOUNCE_MJX_GPU_KERNEL=off`.
"""

import os

import jax

_SWITCH = "BOUNCE_MJX_GPU_KERNEL"
_MIN_COMPUTE_CAPABILITY = 9.0


def has_kernels() -> bool:
    """Whether JAX's default device runs the kernels."""
    if jax.default_backend() != "gpu" or os.environ.get(_SWITCH) == "off":
        return False
    # For AMD's GPUs this is a name, such as gfx90a.
    capabilities = [str(device.compute_capability) for device in jax.local_devices(backend="gpu")]
    return all(
        c.replace(".", "").isdigit() and float(c) >= _MIN_COMPUTE_CAPABILITY for c in capabilities
    )
