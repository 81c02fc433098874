"""Settings: their types, files and command lines."""
