"""Particles: detection, linking, following."""
