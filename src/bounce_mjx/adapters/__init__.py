"""The environment with the interfaces of other libraries, a folder for each library."""
