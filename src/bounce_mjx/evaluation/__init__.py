"""The five results."""
