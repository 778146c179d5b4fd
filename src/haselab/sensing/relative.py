"""The paper's relative capacitance: eqs. 2 and 3, with its scale factors as calibration data."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.base import LimitError

__all__ = ["relative_capacitance"]


def relative_capacitance(
    v_pp: NDArray[np.float64],
    i_pp: NDArray[np.float64],
    phase_rad: NDArray[np.float64],
    *,
    frequency_hz: float,
    reactance_scale: float = 2.5e6,
    capacitance_scale: float = 10.0,
) -> NDArray[np.float64]:
    r"""Relative capacitance from the monitor amplitudes and their phase difference.

    $X_c = k_X\,|V_v/V_c|\,\sin|\varphi|,\quad C_r = 1/(2\pi f\,k_C\,X_c)$

    Args:
        v_pp: peak-to-peak sensing component of the voltage monitor, in V. Shape `(...)`.
        i_pp: the same of the current monitor, in V. Broadcasts with `v_pp`.
        phase_rad: phase of current against voltage, in rad.
        frequency_hz: sensing frequency, in Hz.
        reactance_scale: $k_X$, printed as 2.5e6; eq. 5 requires 2.5e3 (row D11b).
        capacitance_scale: $k_C$, printed as 10.
    Returns:
        Relative capacitance, arbitrary units. The broadcast shape.
    Raises:
        LimitError: a voltage or current is zero or the phase is a multiple of pi.
    Source: reference study, eqs. 2 and 3.
    Example:
        >>> c = relative_capacitance(np.array([0.04]), np.array([0.7]), np.array([np.pi / 2]),
        ...                          frequency_hz=2000.0)
        >>> [f"{x:.3e}" for x in c]
        ['5.570e-11']
    """
    v_pp, i_pp, phase_rad = np.broadcast_arrays(v_pp, i_pp, phase_rad)
    quadrature = np.abs(v_pp * np.sin(np.abs(phase_rad)))
    if not (np.all(quadrature > 0.0) and np.all(i_pp > 0.0)):
        raise LimitError(
            "An amplitude is 0 or the phase a multiple of pi, so there is no reactance; check "
            "that the sensing signal is on and both monitors are connected."
        )
    reactance = reactance_scale * quadrature / i_pp
    return np.asarray(1.0 / (2.0 * np.pi * frequency_hz * capacitance_scale * reactance))
