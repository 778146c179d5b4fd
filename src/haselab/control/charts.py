"""Figures of a loop: its predicted step, and the Bode diagram of its open loop."""

from __future__ import annotations

import numpy as np

from haselab.base.chart import Chart, Curve, Panel
from haselab.control.gains import PidGains
from haselab.control.linear import LinearController
from haselab.control.plants.general import AnyPlant
from haselab.control.predicted_step import predicted_step
from haselab.control.simulate import LoopSetting
from haselab.control.stability.margins import loop_response

__all__ = ["loop_chart", "step_chart"]

_POINTS = 600


def loop_chart(
    plant: AnyPlant,
    gains: PidGains | LinearController,
    setting: LoopSetting,
    middle_rad_s: float,
) -> Chart:
    """Bode diagram of the open loop with its delay.

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
    response = loop_response(
        plant, gains, omega, loop_delay_s=setting.measurement_delay_s, rate_hz=setting.rate_hz,
        feedthrough=setting.feedthrough,
    )  # fmt: skip
    hz, one = omega / (2.0 * np.pi), np.ones(_POINTS)
    axis = "Frequency (Hz)"
    return Chart("Open loop with its delay", (
        Panel(axis, "Magnitude (1)", (Curve(hz, np.abs(response)),
                                      Curve(hz, one, "crossover at 1")), log_x=True, log_y=True),
        Panel(axis, "Phase (°)", (Curve(hz, np.degrees(np.unwrap(np.angle(response)))),
                                  Curve(hz, -180.0 * one, "-180°")), log_x=True),
    ))  # fmt: skip


def step_chart(
    plant: AnyPlant,
    gains: PidGains,
    setting: LoopSetting,
    step: float,
    crossover_rad_s: float,
    names: tuple[str, str] | None = None,
) -> Chart:
    """Predicted step of the closed loop, saturation included, and the open loop.

    Args:
        plant: of the loop.
        gains: of the controller.
        setting: rate, delay and limits.
        step: size of the step, in the unit of the model's output.
        crossover_rad_s: of the open loop, which determines the time and the frequencies shown.
        names: of the axes of the controller's and the plant's output.
    Returns:
        The chart.
    """
    found = predicted_step(plant, gains, setting, step, 20.0 / max(crossover_rad_s, 1e-3))
    loop = loop_chart(plant, gains, setting, crossover_rad_s)
    controller, output = names or ("Controller", "Output")
    curves = [Curve(found.time_s, found.measured, "measured by the loop")]
    if setting.feedthrough:
        curves.append(
            Curve(found.time_s, found.output, "output, with the delay of the measurement")
        )
    curves.append(Curve(found.time_s, found.reference, "reference"))
    return Chart("Predicted step, and the open loop with its delay", (
        Panel("Time (s)", output, tuple(curves)),
        Panel("Time (s)", controller, (Curve(found.time_s, found.u, "", "steps"),)),
        *loop.panels,
    ), shared_x=False)  # fmt: skip
