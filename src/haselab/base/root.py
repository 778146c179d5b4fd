"""Root of a function, by scipy.optimize, whose import takes a quarter of a second."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["root"]


def root(function: Callable[[float], float], low: float, high: float, **accuracy: float) -> float:
    """`scipy.optimize.brentq`, imported at first use.

    Args:
        function: continuous, of different sign at both ends.
        low: one end.
        high: the other end.
        accuracy: `xtol` and `rtol`.
    Returns:
        The root.
    """
    from scipy.optimize import brentq

    return float(brentq(function, low, high, **accuracy))
