"""A policy outside the simulation: its ONNX file, and the NumPy around it."""
