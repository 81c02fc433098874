"""brax: its registry and what its trainers need."""
