"""Gymnasium: one environment, and many at once."""
