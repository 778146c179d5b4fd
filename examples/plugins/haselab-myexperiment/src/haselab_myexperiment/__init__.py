"""Creep at a constant voltage: an experiment with a fit, a result and a figure of its own."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import Field
from scipy.optimize import curve_fit

from haselab.base import Estimate, ResultError
from haselab.rig import RigDescription
from haselab.safety.feasibility import Drive
from haselab.signals import constant
from haselab.store.toml import Section
from haselab.study import (
    UPDATE_HZ,
    Analysis,
    Chart,
    Curve,
    Experiment,
    ExperimentResult,
    Player,
    Quantity,
)

__all__ = ["CreepSettings", "CreepTest"]


class CreepSettings(Section):
    """Table [creep] of STUDY.toml."""

    drive_v: float = Field(ge=0, le=100, description="held, in V ahead of the amplifier")
    hold_s: float = Field(gt=5, le=3600)
    ramp_s: float = Field(2.0, ge=0.1, description="to that voltage, so that little rings")
    skip_s: float = Field(3.0, gt=0, description="left out of the fit, from the start")
    frame_rate_hz: float = Field(50.0, gt=0, le=1e4)


class CreepTest(Experiment[CreepSettings]):
    """A constant voltage; the length approaches its final value exponentially."""

    table = "creep"
    title = "Creep"
    settings_type = CreepSettings

    def drives(self, rig: RigDescription) -> list[Drive]:
        """A ramp to the voltage, and the constant voltage after it."""
        s = self.settings
        ramp_v = np.linspace(0.0, s.drive_v, round(s.ramp_s * UPDATE_HZ), endpoint=False)
        return [Drive("creep", np.append(ramp_v, constant(s.drive_v, s.hold_s, UPDATE_HZ)))]

    def play(self, player: Player) -> None:
        """Wait at 0 V, then hold the voltage and record."""
        (drive,) = self.drives(player.rig)
        player.settle(0.0, self.settings.hold_s)
        player.play("creep", drive.values_v, self.settings.frame_rate_hz)

    def fit(self, analysis: Analysis) -> ExperimentResult:
        """Length after the ramp: l(t) = l_end - a exp(-t / tau)."""
        seen = analysis.observe("creep")
        time_s = seen.frame_time_s - seen.block_start_s[0]
        late = time_s > self.settings.skip_s
        time_s, length_m = time_s[late], seen.length_m[late]
        start = (length_m[-1], length_m[-1] - length_m[0], 0.2 * self.settings.hold_s)
        try:
            found, covariance = curve_fit(_length_m, time_s, length_m, start)
        except RuntimeError as error:
            raise ResultError(f"No creep can be fitted to [creep]: {error}") from error
        end_m, amplitude_m, tau_s = found
        end_std_m, amplitude_std_m, tau_std_s = np.sqrt(np.diag(covariance))
        return ExperimentResult(
            quantities={
                "creep.time_constant": Estimate.normal(tau_s, tau_std_s, "s"),
                "creep.amplitude": Estimate.normal(amplitude_m, amplitude_std_m, "m"),
                "creep.end": Estimate.normal(end_m, end_std_m, "m"),
            },
            charts=(self._chart(time_s, length_m, _length_m(time_s, *found)),),
        )

    def rows(self) -> Mapping[str, Quantity]:
        """Names and units of the results in the report."""
        return {
            "creep.time_constant": Quantity("creep, time constant", "s"),
            "creep.amplitude": Quantity("creep, amplitude", "m"),
            "creep.end": Quantity("creep, length at the end", "m"),
        }

    def _chart(self, time_s: np.ndarray, length_m: np.ndarray, fitted_m: np.ndarray) -> Chart:
        title = f"Creep at {self.settings.drive_v:g} V"
        caption = "Length between the clamps at a constant voltage, and the exponential fit."
        curves = (Curve("camera", time_s, 1e3 * length_m, points=True),
                  Curve("fit", time_s, 1e3 * fitted_m))  # fmt: skip
        return Chart("creep", title, caption, "Time (s)", "Length (mm)", curves)


def _length_m(time_s: np.ndarray, end_m: float, amplitude_m: float, tau_s: float) -> np.ndarray:
    return end_m - amplitude_m * np.exp(-time_s / tau_s)
