"""Identification: from a log of a robot to the ranges of the world in which it acts."""
