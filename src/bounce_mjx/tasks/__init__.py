"""The tasks that come with the package, one file each, made of the parts in `bounce_mjx.task`."""
