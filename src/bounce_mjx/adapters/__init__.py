"""The environment with the interfaces of other libraries."""
