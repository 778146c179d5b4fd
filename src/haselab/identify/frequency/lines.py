"""Lines of a frequency response as returned by the estimators; spectrum of a hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

__all__ = ["EXCITED", "Lines", "Pair", "hold_spectrum"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
# One record: input and output without their means, of equal length.
Pair = tuple[Floats, Floats]
# Lines with a smaller share of the input's largest spectrum are left out.
EXCITED = 5e-2


@dataclass(frozen=True)
class Lines:
    """Response at the excited lines.

    Args:
        frequency_hz: frequencies, in Hz. Shape `(K,)`.
        response: complex gain. Shape `(K,)`.
        coherence: share of the output power that follows the input. Shape `(K,)`.
        std: standard deviation of the complex gain. Shape `(K,)`.
        distortion_std: the same of nonlinear distortion in one realisation; NaN where not
            identifiable. Shape `(K,)`.
        notes: remarks for the user.
        mixing: the errors, real parts first, then imaginary parts, are this matrix times
            independent variables of unit variance. None where not known.
            Shape `(2K, M)`.
    """

    frequency_hz: Floats
    response: Complexes
    coherence: Floats
    std: Floats
    distortion_std: Floats
    notes: tuple[str, ...] = ()
    mixing: csr_array | None = None


def hold_spectrum(frequency_hz: Floats, rate_hz: float) -> Complexes:
    """Ratio of the spectrum of a held input to that of its samples.

    Args:
        frequency_hz: frequencies above zero, in Hz. Shape `(K,)`.
        rate_hz: update rate, in Hz.
    Returns:
        Complex factor. Shape `(K,)`.
    """
    turn = 2j * np.pi * frequency_hz / rate_hz
    return np.asarray(-np.expm1(-turn) / turn)
