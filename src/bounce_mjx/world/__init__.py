"""The world of an environment: what is the same for every task."""
