"""Capacitance from the microcontroller's readings, with its own arithmetic."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab import _core
from haselab.base import InputError
from haselab.firmware import ChipSettings

__all__ = ["sense_quadrature"]

_HALF = 4  # readings of a channel in an update: half of its window


def sense_quadrature(codes: NDArray[np.int16], settings: ChipSettings) -> NDArray[np.float64]:
    """Capacitance that the microcontroller computed from its readings, bit for bit.

    An update uses its own readings and the previous ones; the first of a recording has none
    before it and therefore no capacitance.

    Args:
        codes: of the converter, voltage then current, four rows per update, without a gap. Shape
            `(4 N, 2)`.
        settings: settings that were compiled in.
    Returns:
        Capacitance in F; NaN where the carrier was lost or the capacitance is out of range.
        Shape `(N,)`.
    Raises:
        InputError: another shape.
    Source: `hs_capacitance_of` of core/.
    Example:
        >>> from haselab.firmware import FrontEnd
        >>> settings = ChipSettings(1, 1, 0, 0.01, -0.04, 0.1, (1.0, 5.0, -0.5, -9.0),
        ...                         (5e8, -0.3, 0.0, 0.0), FrontEnd())
        >>> sense_quadrature(np.zeros((8, 2), np.int16), settings)
        array([nan, nan])
    """
    if codes.ndim != 2 or codes.shape[1] != 2 or len(codes) % _HALF or not len(codes):
        raise InputError(f"Codes of shape {codes.shape}; it must be (4 N, 2). Give whole updates.")
    updates = len(codes) // _HALF
    farad, reason = np.zeros(updates, np.float32), np.ones(updates, np.uint8)
    rows = np.ascontiguousarray(codes, dtype=np.int16)
    _core.capacitances_from_quadrature(*settings.sensing, rows, farad[1:], reason[1:])
    low, high = (np.float32(limit) for limit in settings.capacitance_range_f)
    good = (reason == 0) & (farad >= low) & (farad <= high)
    return np.where(good, farad, np.nan).astype(np.float64)
