"""Figure of a frequency response: magnitude, phase and coherence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.base.chart import Chart, Curve, Panel
from haselab.identify.frequency.response import FrequencyResponse

__all__ = ["response_chart"]

Floats = NDArray[np.float64]


def response_chart(
    title: str, response: FrequencyResponse, fitted: NDArray[np.complex128] | None
) -> Chart:
    """Magnitude, phase and coherence over frequency.

    Args:
        title: of the figure.
        response: what was estimated.
        fitted: response of a model at the same frequencies. Shape `(N,)`.
    Returns:
        The chart.
    """
    answer = response.answer()
    used = np.asarray(answer["frequency_hz"]) > 0.0
    hz = np.asarray(answer["frequency_hz"])[used]

    def of(key: str) -> Floats:
        return np.asarray(answer[key], dtype=np.float64)[used]

    phase_deg = np.degrees(np.unwrap(of("phase_rad")))
    magnitude = [Curve(hz, of("magnitude"), "estimate, 95 %", "line", of("magnitude_std"))]
    phase = [Curve(hz, phase_deg, "", "line", np.degrees(of("phase_std_rad")))]
    if fitted is not None:
        magnitude.append(Curve(hz, np.abs(fitted[used]), "fit"))
        phase.append(Curve(hz, np.degrees(np.unwrap(np.angle(fitted[used])))))
    axis = "Frequency (Hz)"
    return Chart(title, (
        Panel(axis, "Magnitude", magnitude, log_x=True, log_y=True),
        Panel(axis, "Phase (°)", phase, log_x=True),
        Panel(axis, "Coherence", (Curve(hz, of("coherence")),), log_x=True),
    ))  # fmt: skip
