"""Controllers that are not trained, to compare policies with."""
