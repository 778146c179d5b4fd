"""Lift and drop the mass, to find natural frequency and decay (row S19)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from haselab.base import Estimate, ResultError
from haselab.rig import RigDescription
from haselab.safety.feasibility import Drive
from haselab.study.analysis import Analysis
from haselab.study.experiment import Experiment, ExperimentResult, NotPlayedError
from haselab.study.experiments.operating_point import baseline_v, possible_baselines_v
from haselab.study.fits.dynamics import Dynamics
from haselab.study.fits.free import Free, fit_free
from haselab.study.paper.quantity_table import paper_rows
from haselab.study.player import Player
from haselab.study.quantity import Quantity
from haselab.study.tables import FreeResponse

__all__ = ["FreeResponseTest"]

_ENVELOPES = ("S19.decay_1", "S19.decay_2", "S19.eq6_decay_1", "S19.eq6_decay_2")
_DIFFERENCE = "S19.chirp_difference"


class FreeResponseTest(Experiment[FreeResponse]):
    """Lift the mass, wait and drop it, at the baseline voltage."""

    table = "free_response"
    title = "Free response"
    settings_type = FreeResponse
    gives = (Free,)
    report_figures = ("fig5",)

    def recordings(self) -> dict[str, str]:
        """See `Experiment`."""
        return {f"free-{k + 1}": "free response" for k in range(self.settings.trials)}

    def drives(self, rig: RigDescription) -> list[Drive]:
        """See `Experiment`."""
        return [Drive("free response", np.array([0.0, possible_baselines_v(self.study)[1]]))]

    def seconds(self, rig: RigDescription) -> float:
        """See `Experiment`."""
        return self.settings.trials * (self.settings.settle_s + self.settings.record_s)

    def play(self, player: Player) -> None:
        """See `Experiment`."""
        s = self.settings
        drive_v = baseline_v(player.analysis)
        for name in self.recordings():
            player.release(name, drive_v, s.settle_s, s.record_s, s.frame_rate_hz)

    def fit(self, analysis: Analysis) -> ExperimentResult:
        """See `Experiment`."""
        trials = [analysis.observe(name) for name in self.recordings()]
        try:
            found = fit_free(trials, analysis.near(Free))
        except ResultError as reason:  # as of an actuator that is too damped to oscillate
            return ExperimentResult(missing=dict.fromkeys(self.rows(), str(reason)))
        quantities, notes = found.quantities, found.notes
        peaks = "too few peaks exceed the noise"
        missing = {name: peaks for name in _ENVELOPES if name not in quantities}
        try:
            dynamics = analysis.need(Dynamics)
            quantities = {**quantities, **_against_chirp(found, dynamics)}
            notes = {**notes, _DIFFERENCE: _discussed(quantities, dynamics)}
        except NotPlayedError as reason:
            missing = {_DIFFERENCE: str(reason)}
        return ExperimentResult(
            quantities, notes, figures=found.figures, values=(found,), missing=missing
        )

    def rows(self) -> Mapping[str, Quantity]:
        """See `Experiment`."""
        return paper_rows("S19.")


def _against_chirp(free: Free, dynamics: Dynamics) -> dict[str, Estimate]:
    """Relative difference of the natural frequencies of free response and chirp."""
    swing, sweep = free.quantities["S19.omega_0"], dynamics.quantities["S20.omega_n"]
    ratio = swing.value / sweep.value
    std = ratio * float(np.hypot(swing.std / swing.value, sweep.std / sweep.value))
    return {_DIFFERENCE: Estimate.normal(ratio - 1.0, std, "")}


def _discussed(quantities: Mapping[str, Estimate], dynamics: Dynamics) -> str:
    """The two frequencies, whether noise explains their difference, and what else differs."""
    swing, sweep = quantities["S19.omega_0"], dynamics.quantities["S20.omega_n"]
    difference = quantities[_DIFFERENCE]
    low, high = difference.ci95
    told = (
        f"{swing.value:.4g} rad/s from the free response, {sweep.value:.4g} rad/s from the chirp: "
        f"{100.0 * difference.value:+.2g} %"
    )
    if low <= 0.0 <= high:
        return f"{told}, which the intervals of the two explain"
    return (
        f"{told}, more than the intervals of the two explain ({100.0 * low:.2g} to "
        f"{100.0 * high:.2g} %). The experiments differ in amplitude and in what came before; a "
        "spring that is not linear, or creep, gives such a difference"
    )
