"""The trainer: networks, statistics, PPO."""
