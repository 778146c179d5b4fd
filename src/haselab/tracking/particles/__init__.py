"""Particles: detection, linking and tracking."""
