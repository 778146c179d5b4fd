"""Checks of the columns of a creep record."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["are_swapped", "is_noisy"]

Floats = NDArray[np.float64]
_NOISE = 0.1  # of the input's range: median step of an input that is noisy, ...
_TURNED = 0.58  # ... and share of the steps that reverse
_HELD = 0.02  # of the rows are updates of an input, at most, ...
_MOVING = 0.5  # ... and of an output that creeps or is noisy, at least


def are_swapped(u: Floats, y: Floats) -> bool:
    """Whether the output changes as rarely as an input, and the input as often as an output.

    Args:
        u: inputs. Shape `(N,)`.
        y: outputs. Shape `(N,)`.
    """
    updates, moves = (np.count_nonzero(np.diff(column)) for column in (y, u))
    return bool(updates <= _HELD * u.size and moves >= _MOVING * u.size)


def is_noisy(u: Floats) -> bool:
    """Whether most changes of the input are noise: small, and about two thirds reverse the last.

    Args:
        u: inputs. Shape `(N,)`.
    """
    steps = np.diff(u)
    if np.count_nonzero(steps) < _MOVING * steps.size:
        return False
    small = float(np.median(np.abs(steps))) < _NOISE * float(np.ptp(u))
    turned = np.count_nonzero(steps[1:] * steps[:-1] < 0.0)
    return bool(small and turned > _TURNED * steps.size)
