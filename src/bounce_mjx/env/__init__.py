"""One environment, and batches of it."""
