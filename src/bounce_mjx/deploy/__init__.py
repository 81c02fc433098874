"""Policies outside the simulation: ONNX files, and the NumPy code that runs them."""
