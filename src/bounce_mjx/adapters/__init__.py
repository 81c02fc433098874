"""The environment in the form that other libraries expect."""
