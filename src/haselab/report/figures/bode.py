"""Axes of a Bode plot, in rad/s below and Hz above, so that the two are never confused."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase
from matplotlib.ticker import MultipleLocator

from haselab.report.analysis import Array
from haselab.report.style import scale_by

__all__ = ["bode_axes", "decibel", "phase_degrees"]


def decibel(magnitude: Array) -> Array:
    """Magnitude in dB; NaN where the magnitude is not positive."""
    return 20.0 * np.log10(np.where(magnitude > 0.0, magnitude, np.nan))


def phase_degrees(phase_rad: Array) -> Array:
    """Continuous phase in degrees, from the first finite value on."""
    degrees = np.full(phase_rad.shape, np.nan)
    finite = np.isfinite(phase_rad)
    degrees[finite] = np.degrees(np.unwrap(phase_rad[finite]))
    return degrees


def bode_axes(host: FigureBase, rows: int = 2) -> tuple[Axes, ...]:
    """Magnitude, phase and, with three rows, coherence, over a logarithmic frequency axis.

    Args:
        host: empty figure.
        rows: 2, or 3 with coherence.

    Returns:
        The axes, from the top.
    """
    ratios = (3, 2, 1.4)[:rows]
    stacked = host.subplots(rows, 1, sharex=True, gridspec_kw={"height_ratios": ratios})
    axes: tuple[Axes, ...] = tuple(stacked)
    axes[0].set_xscale("log")
    axes[0].set_ylabel("Magnitude (dB)")
    axes[1].set_ylabel("Phase (°)")
    axes[1].yaxis.set_major_locator(MultipleLocator(90.0))
    if rows == 3:
        axes[2].set_ylabel("Coherence (0 to 1)")
        axes[2].set_ylim(0.0, 1.05)
    axes[-1].set_xlabel("Angular frequency (rad/s)")
    top = axes[0].secondary_xaxis("top", functions=scale_by(1.0 / (2.0 * math.pi)))
    top.set_xlabel("Frequency (Hz)")
    for each in stacked:
        each.grid(which="minor", axis="x", alpha=0.25)
    host.align_ylabels()
    return axes
