"""Experiment design: drives inside the limits of the bench, ranked by their information."""
