"""A chirp around the baseline, to identify the plant's transfer function (row S20)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from haselab.base import Estimate
from haselab.rig import RigDescription
from haselab.safety.feasibility import Drive
from haselab.signals import constant, linear_chirp
from haselab.study.analysis import Analysis
from haselab.study.experiment import Experiment, ExperimentResult
from haselab.study.experiments.operating_point import baseline_v, possible_baselines_v
from haselab.study.experiments.steps import open_names
from haselab.study.fits.dynamics import (
    Dynamics,
    fit_chirp,
    fit_chirp_and_steps,
    fit_chirp_of_voltage,
)
from haselab.study.fits.maps import Maps
from haselab.study.paper.quantity_table import paper_rows
from haselab.study.player import UPDATE_HZ, Player
from haselab.study.quantity import Quantity
from haselab.study.tables import Chirp

__all__ = ["ChirpTest"]

_PER_VOLT = {"S20.gain_per_volt": Quantity("plant, gain from the drive voltage", "1/V")}
_ABOUT = "strain for a volt before the amplifier, about the baseline; no voltage map is known"
_NO_SLOW = "the open-loop trials do not determine a slow branch of the plant"
_RETURN = "no creep, but a slow partial return after the fast motion: S20.gain has the other sign"
_LEAD_S = 1.0  # recorded at the baseline before the chirp


class ChirpTest(Experiment[Chirp]):
    """The chirp, played after the creep at the baseline has faded."""

    table = "chirp"
    title = "Transfer function"
    settings_type = Chirp
    gives = (Dynamics,)
    report_figures = ("bode-plant",)

    def _drive_v(self, about_v: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        c = self.settings
        sweep = linear_chirp(c.start_hz, c.stop_hz, c.duration_s, UPDATE_HZ)
        return about_v + c.amplitude_v * sweep

    def drives(self, rig: RigDescription) -> list[Drive]:
        """See `Experiment`; around the lowest and the highest possible baseline."""
        return [
            Drive("chirp", np.append(about_v, self._drive_v(about_v)), self.settings.stop_hz)
            for about_v in possible_baselines_v(self.study)
        ]

    def seconds(self, rig: RigDescription) -> float:
        """See `Experiment`."""
        return self.settings.hold_s + _LEAD_S + self.settings.duration_s

    def play(self, player: Player) -> None:
        """See `Experiment`."""
        about_v = baseline_v(player.analysis)
        player.settle(about_v, self.settings.hold_s)
        lead = constant(about_v, _LEAD_S, UPDATE_HZ)
        drive_v = np.concatenate([lead, self._drive_v(about_v)])
        player.play(self.table, drive_v, self.settings.frame_rate_hz)

    def fit(self, analysis: Analysis) -> ExperimentResult:
        """See `Experiment`; without steps or maps, only the second-order model."""
        maps, seen = analysis.find(Maps), analysis.observe(self.table)
        stop_hz = self.settings.stop_hz
        if maps is None:
            found = fit_chirp_of_voltage(seen, analysis.rig, _LEAD_S, stop_hz)
            return self._alone(*found, "needs the voltage map of [triangle], or of --actuator")
        if not self.study.has("steps"):
            found = fit_chirp(seen, maps, analysis.rig, stop_hz)
            return self._alone(*found, "needs the open-loop trials of [steps]")
        opened = [analysis.observe(name) for name in open_names(self.study)]
        near = analysis.near(Dynamics)
        both = fit_chirp_and_steps(seen, opened, maps, self.study, analysis.rig, near)
        missing = {key: _NO_SLOW for key in self.rows() if key not in both.quantities}
        return ExperimentResult(
            both.quantities, _slow_notes(both.quantities), figures=both.figures, values=(both,),
            missing=missing,
        )  # fmt: skip

    def _alone(
        self, quantities: Mapping[str, Estimate], figures: Mapping[str, object], needs: str
    ) -> ExperimentResult:
        """The second order alone; why the other results are missing."""
        reason = f"{needs}; this study has none"
        missing = {key: reason for key in self.rows() if key not in quantities}
        if "S20.gain_per_volt" in missing:
            missing["S20.gain_per_volt"] = "the voltage map is known, see S20.eq8_gain"
        note = {"S20.gain_per_volt": _ABOUT} if "S20.gain_per_volt" in quantities else {}
        return ExperimentResult(quantities, note, figures=figures, missing=missing)

    def rows(self) -> Mapping[str, Quantity]:
        """See `Experiment`; without a triangle, the gain from the drive voltage too."""
        rows = paper_rows("S20.")
        return rows if self.study.has("triangle") else {**rows, **_PER_VOLT}


def _slow_notes(found: Mapping[str, Estimate]) -> dict[str, str]:
    """Say that a slow branch of the other sign is no creep."""
    slow, fast = found.get("S20.slow_gain"), found.get("S20.gain")
    if slow is None or fast is None or slow.value * fast.value >= 0.0:
        return {}
    return {"S20.slow_gain": _RETURN}
