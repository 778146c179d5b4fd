"""The simulated step of a closed loop, for figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.control.gains import PidGains
from haselab.control.plants.general import AnyPlant
from haselab.control.plants.general_loops import plant_output, trace_general
from haselab.control.simulate import LoopSetting, simulate_loop
from haselab.models.plant import Plant

__all__ = ["PredictedStep", "predicted_step"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PredictedStep:
    """Step of a closed loop from rest, one value per update.

    Args:
        time_s: since the step, in s. Shape `(N,)`.
        reference: the step.
        measured: what the loop measures, with its delay.
        output: of the plant, with the delay of the measurement. It differs from `measured` in a
            loop with feedthrough.
        u: output of the controller.
    """

    time_s: Floats
    reference: Floats
    measured: Floats
    output: Floats
    u: Floats


def predicted_step(
    plant: AnyPlant, gains: PidGains, setting: LoopSetting, step: float, span_s: float
) -> PredictedStep:
    """Simulate a step of the closed loop, saturation included.

    Args:
        plant: of the loop.
        gains: of the controller.
        setting: rate, delay and limits.
        step: size of the step, in the unit of the model's output.
        span_s: time to simulate, in s; 50 to 20,000 updates are simulated.
    Returns:
        The step.
    """
    count = max(50, min(round(span_s * setting.rate_hz), 20_000))
    reference = np.full(count, step)
    time_s = np.arange(count) / setting.rate_hz
    if isinstance(plant, Plant):
        trace = simulate_loop(plant, gains, reference, setting)
        measured, u = trace.measured, trace.u
    else:
        traced, driven = trace_general(plant, [gains], reference, setting)
        measured, u = traced[0], driven[0]
    output = plant_output(plant, measured, u, setting)
    return PredictedStep(time_s, reference, measured, output, u)
