"""The figures of `haselab design` and `haselab margins`: open loop and predicted step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.base.chart import Chart, Curve, Panel
from haselab.base.estimate import Z95
from haselab.control import LinearController, LoopSetting, PidGains
from haselab.control.plants.general import AnyPlant
from haselab.control.stability.margins import loop_response
from haselab.identify.fit import Prediction
from haselab.pipelines.design.answer import predicted_step

__all__ = ["design_chart", "loop_chart", "prediction_chart"]

_POINTS = 600
Floats = NDArray[np.float64]


def loop_chart(
    plant: AnyPlant,
    gains: PidGains | LinearController,
    setting: LoopSetting,
    middle_rad_s: float,
) -> Chart:
    """Bode plot of the open loop with its delay.

    Args:
        plant: of the loop.
        gains: of the controller.
        setting: rate and delay.
        middle_rad_s: angular frequency in the middle of the plot, such as the crossover.
    Returns:
        The chart.
    """
    highest = np.pi * setting.rate_hz
    middle = middle_rad_s if np.isfinite(middle_rad_s) and middle_rad_s > 0.0 else 0.05 * highest
    omega = np.geomspace(middle / 100.0, min(100.0 * middle, highest), _POINTS)
    response = loop_response(plant, gains, omega, loop_delay_s=setting.measurement_delay_s,
                             rate_hz=setting.rate_hz)  # fmt: skip
    hz, one = omega / (2.0 * np.pi), np.ones(_POINTS)
    axis = "Frequency (Hz)"
    return Chart("Open loop with its delay", (
        Panel(axis, "Magnitude", (Curve(hz, np.abs(response)), Curve(hz, one, "crossover at 1")),
              log_x=True, log_y=True),
        Panel(axis, "Phase (°)", (Curve(hz, np.degrees(np.unwrap(np.angle(response)))),
                                  Curve(hz, -180.0 * one, "-180°")), log_x=True),
    ))  # fmt: skip


def design_chart(
    plant: AnyPlant, gains: PidGains, setting: LoopSetting, step: float, span_s: float
) -> Chart:
    """Predicted step of the closed loop, saturation included.

    Args:
        plant: of the loop.
        gains: of the controller.
        setting: rate, delay and limits.
        step: size of the step, in the unit of the model's output.
        span_s: time to show.
    Returns:
        The chart.
    """
    found = predicted_step(plant, gains, setting, step, span_s)
    return Chart("Predicted step", (
        Panel("Time (s)", "Output", (Curve(found.time_s, found.measured, "measured by the loop"),
                                     Curve(found.time_s, found.reference, "reference"))),
        Panel("Time (s)", "Controller", (Curve(found.time_s, found.u, "", "steps"),)),
    ))  # fmt: skip


def prediction_chart(found: Prediction, time_s: Floats, title: str) -> Chart:
    """Measured and predicted output of records, one after the other, and what is left.

    Args:
        found: the prediction.
        time_s: of its samples; records follow each other. Shape `(M,)`.
        title: of the figure.
    Returns:
        The chart.
    """
    std = found.half_band / Z95 if found.half_band.size else None
    label = "predicted" if std is None else "predicted, 95 % band"
    return Chart(title, (
        Panel("Time (s)", "Output", (Curve(time_s, found.measured, "measured", "points"),
                                     Curve(time_s, found.predicted, label, std=std))),
        Panel("Time (s)", "Measured less predicted",
              (Curve(time_s, found.measured - found.predicted),)),
    ))  # fmt: skip
