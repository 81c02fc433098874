"""Folders of training runs: configs, checkpoints and results."""
