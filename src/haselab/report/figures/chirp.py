"""Figure 8: Bode plot of the plant from the chirp, and the chirp itself."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import FigureBase

from haselab.report.figures.bode import bode_axes, decibel, phase_degrees
from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import BLUE, GREY, PALETTE, band, label_text, legend_below, thinned

__all__ = ["PLAN"]

_SAMPLES_DRAWN = 4000
_LINES = ("-", "--", "-.", ":")


def _bode(host: FigureBase, run: RunFolder) -> None:
    section = run.section("chirp")
    response = section.section("frequency_response")
    frequency_hz = response.array("frequency_hz")
    positive = frequency_hz > 0.0
    omega = 2.0 * math.pi * frequency_hz[positive]
    gain = response.array("magnitude", like=frequency_hz)
    gain_std = response.optional("magnitude_std", like=frequency_hz)
    degrees = phase_degrees(response.array("phase_rad", like=frequency_hz)[positive])
    degrees_std = response.optional("phase_std_rad", like=frequency_hz)
    coherence = response.optional("coherence", like=frequency_hz)
    axes = bode_axes(host, 3 if coherence is not None else 2)
    axes[0].plot(omega, decibel(gain[positive]), color=BLUE, label="measured ± 1 st. dev.")
    if gain_std is not None:
        low, high = decibel(gain - gain_std)[positive], decibel(gain + gain_std)[positive]
        axes[0].fill_between(omega, low, high, color=BLUE, alpha=0.2, linewidth=0)
    axes[1].plot(omega, degrees, color=BLUE)
    spread = None if degrees_std is None else np.degrees(degrees_std[positive])
    band(axes[1], omega, degrees, spread, BLUE)
    for at, (name, model) in enumerate(section.sections("models").items()):
        colour, line = PALETTE[(0, 2, 3, 4)[at % 4]], _LINES[1 + at % 3]
        model_gain = model.array("magnitude", like=frequency_hz)[positive]
        model_phase = model.array("phase_rad", like=frequency_hz)[positive]
        axes[0].plot(
            omega, decibel(model_gain), color=colour, linestyle=line, label=label_text(name)
        )
        axes[1].plot(omega, phase_degrees(model_phase), color=colour, linestyle=line)
    if coherence is not None:
        axes[2].plot(omega, coherence[positive], color=GREY)
    axes[0].legend(loc="lower left")


def _sweep(host: FigureBase, run: RunFolder) -> None:
    section = run.section("chirp")
    time_s = section.array("time_s")
    step = thinned(time_s.size, _SAMPLES_DRAWN)
    axes = host.subplots()
    strain = section.array("strain", like=time_s)
    u = section.optional("u", like=time_s)
    if u is not None:
        axes.plot(time_s[step], 100.0 * u[step], color="#bbbbbb", linewidth=0.9, label="input u")
    axes.plot(time_s[step], 100.0 * strain[step], color=BLUE, label="camera")
    for at, (name, fit) in enumerate(section.sections("fits").items()):
        fitted = fit.array("strain", like=time_s)
        axes.plot(
            time_s[step],
            100.0 * fitted[step],
            color=PALETTE[(0, 2, 3, 4)[at % 4]],
            linestyle=_LINES[1 + at % 3],
            linewidth=1.0,
            label=label_text(name),
        )
    axes.set_xlabel("Time (s)")
    axes.set_ylabel("Strain (%)")
    legend_below(host, axes, 4)


PLAN = FigurePlan(
    "bode-plant",
    "Figure 8",
    "plant",
    "Chirp experiment. A: measured frequency response, with one standard deviation as a band, "
    "fitted models, and coherence (1: the strain follows the input linearly and without noise; "
    "below about 0.9 the response is uncertain). B: response to the chirp in time, with those "
    "of the models.",
    (
        Panel("A", "Frequency response", _bode, wide=True, height_in=5.2),
        Panel("B", "Chirp", _sweep, wide=True, height_in=2.8),
    ),
)
