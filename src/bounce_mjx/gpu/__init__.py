"""The package's GPU kernels, and where they run."""
