"""The task: environment, rewards, batching."""
