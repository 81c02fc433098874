"""GPU kernels of elementwise functions, and where they run."""
