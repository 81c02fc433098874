"""Evaluation of a policy: its episodes, their statistics and the expected results."""
