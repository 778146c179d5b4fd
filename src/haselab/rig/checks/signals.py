"""Convert samples of a bench to drive volts, to amperes and to volts at the input."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.rig import GaplessAcquisition, Rig

__all__ = ["amperes", "input_volts", "keep", "phasor", "saturated", "span_v", "volts"]


def input_volts(rig: Rig, codes: NDArray[np.int16]) -> NDArray[np.float64]:
    """Both inputs in V at the board, `(n, 2)`."""
    return np.asarray(codes * rig.description.volt_per_code, dtype=np.float64)


def volts(rig: Rig, codes: NDArray[np.int16]) -> NDArray[np.float64]:
    """The voltage monitor in V of drive, `(n,)`."""
    d = rig.description
    gain = d.volt_per_code / d.monitor_v_per_drive_v
    return np.asarray(codes[:, 0] * gain, dtype=np.float64)


def amperes(rig: Rig, codes: NDArray[np.int16]) -> NDArray[np.float64]:
    """The current monitor in A, `(n,)`."""
    d = rig.description
    return np.asarray(codes[:, 1] * (d.volt_per_code / d.i_monitor_v_per_a), dtype=np.float64)


def phasor(values: NDArray[np.float64], frequency_hz: float, rate_hz: float) -> complex:
    """Amplitude and phase of a sine in values `(n,)`.

    Example:
        >>> abs(phasor(3.0 * np.cos(2.0 * np.pi * 0.1 * np.arange(100)), 0.1, 1.0)).__round__(9)
        3.0
    """
    turn = np.exp(-2j * np.pi * frequency_hz * np.arange(values.size) / rate_hz)
    return complex(2.0 * (values * turn).mean())


def saturated(codes: NDArray[np.int16], top_code: int) -> bool:
    """Whether a channel, `(n,)`, is at an end of the range of a converter."""
    return bool(np.abs(codes.astype(int)).max() >= top_code)


def keep(rig: Rig, on: bool) -> None:
    """Start or stop keeping every block, if the acquisition can skip blocks."""
    if isinstance(rig.acquisition, GaplessAcquisition):
        rig.acquisition.keep(on)


def span_v(rig: Rig) -> float:
    """Range of the drive, in V."""
    limits = rig.description.drive_limits
    return limits.high - limits.low
