"""How much the noise of the chip's sensing moves an actuator at rest, with the drive's rate limit.

A design assumes a loop that is linear. If the noise of one update asks for faster changes of the
drive than the firmware permits, the loop answers late and too little, and its resonance is damped
less: the strain scatters several times as much as the linear loop predicts.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab import _core
from haselab.control import LoopSetting, Saturation, simulate_drive
from haselab.control.plants.held import HeldPlants
from haselab.controllers import ControllerSetting, Measurement
from haselab.study.chip.loops import LoopRun, controller_of
from haselab.study.simulated.agreement import StepCase

__all__ = ["Scatter", "predicted_scatter", "scatter_of"]

_REST_S, _COUNTED_S = 2.0, 10.0  # until the noise is stationary; from then on it counts
_MAP_POINTS = 2001
_LIMITING = 1.5  # times the scatter of the linear loop: the limit is then its cause


@dataclass(frozen=True)
class Scatter:
    """Standard deviation of the true strain at rest, as a fraction of the step.

    Args:
        simulated: of the chip on the twin.
        predicted: by the noise of its sensing, with the drive's rate limit.
        linear: by the same noise without this limit.
        rise_v_per_s: the limit.
    """

    simulated: float
    predicted: float
    linear: float
    rise_v_per_s: float

    @property
    def cause(self) -> str:
        """Why the strain scatters more than the design assumes; empty: it does not."""
        if self.predicted < _LIMITING * self.linear:
            return ""
        return (
            f"Noise changes the drive faster than its rate limit of {self.rise_v_per_s:g} V/s. "
            "This increases the standard deviation of the strain before the step from "
            f"{100.0 * self.linear:.2g} to {100.0 * self.predicted:.2g} % of the step. Design "
            "with a smaller noise_gain in [controller.demands]."
        )


def scatter_of(run: LoopRun, case: StepCase) -> Scatter:
    """Compare the scatter of a simulated loop before its step with the predicted one.

    Args:
        run: the simulated response.
        case: plant and controller.
    Returns:
        Both, the simulated one from the later half of the time before the step, without its drift.
    """
    rest = (run.time_s > 0.5 * run.time_s[0]) & (run.time_s <= 0.0)
    time_s, strain = run.time_s[rest], run.strain[rest]
    drift = np.polyval(np.polyfit(time_s, strain, 1), time_s)
    found = float(np.std(strain - drift)) / abs(case.plan.after - case.plan.before)
    rise = case.design.settings.rise_v_per_s
    return Scatter(found, predicted_scatter(case), predicted_scatter(case, math.inf), rise)


def predicted_scatter(case: StepCase, rise_v_per_s: float | None = None) -> float:
    """Scatter of the strain at rest before the step, by the noise of the chip's sensing.

    Args:
        case: plant and controller.
        rise_v_per_s: limit of the drive's changes; None: that of the firmware.
    Returns:
        Standard deviation of the strain, as a fraction of the step.
    """
    loop, settings = case.loop, case.design.settings
    rise = settings.rise_v_per_s if rise_v_per_s is None else rise_v_per_s
    count = round((_REST_S + _COUNTED_S) * loop.rate_hz)
    noise = np.random.default_rng(case.seed).normal(0.0, case.noise_std, count)
    u = _outputs(case, noise, rise / loop.rate_hz)
    limits = Saturation(min(settings.strain_low, u[0]), settings.strain_high)
    setting = LoopSetting(loop.rate_hz, loop.measurement_delay_s, limits, float(u[0]), 1)
    strain = simulate_drive(case.design.plant, u, setting).y[round(_REST_S * loop.rate_hz) :]
    return float(np.std(strain)) / abs(case.plan.after - case.plan.before)


def _outputs(case: StepCase, noise: NDArray[np.float64], most_v: float) -> NDArray[np.float64]:
    """Corrected strains of the loop at rest, each by the drive that its rate limit permits."""
    loop, s, plant = case.loop, case.design.settings, case.design.plant
    period_s, low, high = 1.0 / loop.rate_hz, s.strain_low, s.strain_high
    start = min(max(case.plan.before / plant.static_gain, low), high)
    held = HeldPlants.of([plant], period_s=period_s, feedthrough=loop.feedthrough,
                         measurement_delay_s=loop.measurement_delay_s)  # fmt: skip
    free, push = held.free[0].reshape(2, 2), held.push[0]
    state, slow = start * held.rest[0][:2], start * held.rest[0][2:]
    line = deque([start * float(held.static_gain[0])] * int(held.samples[0]))
    strains = np.linspace(low, high, _MAP_POINTS)
    volts = np.array([_core.voltage_from_strain(*s.voltage_map, float(x)) for x in strains])
    pid = controller_of(s).make()
    pid.start(ControllerSetting(period_s, low, high, start))
    drive_v, u = float(np.interp(start, strains, volts)), np.empty(noise.size)
    for k, error in enumerate(noise.tolist()):
        seen = Measurement(line.popleft() + error, math.nan, drive_v, (k + 1) * period_s)
        wanted_v = float(np.interp(pid.step(case.plan.before, seen), strains, volts))
        drive_v += min(max(wanted_v - drive_v, -most_v), most_v)
        u[k] = np.interp(drive_v, volts, strains)
        line.append(float(state[0] + slow.sum() + held.feed[0] * u[k]))
        state = free @ state + push * u[k]
        slow = held.slow_decay[0] * slow + held.slow_push[0] * u[k]
    return u
