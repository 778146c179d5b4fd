"""Drive signals: triangle, chirp, constant, square, pseudo-random, multisine."""

from haselab.signals.drive import constant, linear_chirp, multisine, prbs, square, triangle

__all__ = ["constant", "linear_chirp", "multisine", "prbs", "square", "triangle"]
