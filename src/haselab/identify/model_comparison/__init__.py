"""Comparison of models: which one a record supports."""
