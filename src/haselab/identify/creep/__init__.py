"""Creep under a constant input."""
