"""Drive signals: triangle, chirp, constant."""

from haselab.signals.drive import constant, linear_chirp, triangle

__all__ = ["constant", "linear_chirp", "triangle"]
