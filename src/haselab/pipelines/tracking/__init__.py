"""Compute tracks, displacements and strain from a video."""
