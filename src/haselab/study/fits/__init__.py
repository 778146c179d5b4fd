"""Fits of the built-in experiments: from observations to results, each without a bench."""
