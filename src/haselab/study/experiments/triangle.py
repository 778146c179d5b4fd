"""Slow voltage triangles, for the maps of voltage, strain and capacitance (rows S13 to S15)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from haselab.base import InputError
from haselab.rig import RigDescription
from haselab.runtime.lockin import counted_s
from haselab.runtime.observer import PARTICLES
from haselab.safety.feasibility import Drive
from haselab.signals import constant, triangle
from haselab.store.session.writer import ExperimentPlan
from haselab.study.analysis import Analysis, fitting
from haselab.study.experiment import Experiment, ExperimentResult
from haselab.study.experiments.operating_point import baseline_v
from haselab.study.fits.cycles import LEAST_FRAMES, Cycles, near_v
from haselab.study.fits.maps import Maps, fit_maps
from haselab.study.fits.observe import TRIANGLE
from haselab.study.fits.paper_chain import PrintedChain, compare_chain
from haselab.study.paper.quantity_table import paper_rows
from haselab.study.player import UPDATE_HZ, Player
from haselab.study.quantity import Quantity
from haselab.study.tables import Triangle

__all__ = ["TriangleTest"]

_LEAD_S = 0.2  # recorded at the lowest voltage, before the first rise
_SHEET = "particles"
_DRIFTS = ("S13.peak_drift", "S13.residual_drift")


class TriangleTest(Experiment[Triangle]):
    """Triangles from 0 V, with particles tracked all over the sheet."""

    table = "triangle"
    title = "Maps"
    settings_type = Triangle
    gives = (Maps, PrintedChain)
    report_figures = ("fig2", "fig3", "chain")

    def recordings(self) -> dict[str, str]:
        """See `Experiment`."""
        return {TRIANGLE: "triangle"}

    def plans(self) -> list[ExperimentPlan]:
        """See `Experiment`."""
        sheet = ExperimentPlan(_SHEET, "particles of the triangle", PARTICLES, {})
        return [*super().plans(), sheet]

    def _drive_v(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        t = self.settings
        return triangle(t.low_v, t.high_v, t.frequency_hz, t.cycles, UPDATE_HZ)

    def drives(self, rig: RigDescription) -> list[Drive]:
        """See `Experiment`."""
        return [Drive("triangle", self._drive_v(), self.settings.frequency_hz)]

    def check(self) -> None:
        """See `Experiment`: enough frames near the baseline."""
        t, baseline_v = self.settings, self.study.nominal_baseline_v
        near = near_v(t)
        width_v = min(baseline_v + near, t.high_v) - max(baseline_v - near, t.low_v)
        edge_s = 0.5 * max(width_v, 0.0) / ((t.high_v - t.low_v) * t.frequency_hz)
        kept = t.cycles - t.skipped_cycles
        frames = kept * edge_s * t.frame_rate_hz
        if frames < LEAST_FRAMES:
            raise InputError(
                f"The triangle gives only {frames:.2g} frames on each edge within {near:.2g} V of "
                f"the baseline of {baseline_v:g} V, but {LEAST_FRAMES} are needed. Raise "
                "triangle.frame_rate_hz or cycles, lower frequency_hz, or let the triangle cross "
                "the baseline."
            )

    def seconds(self, rig: RigDescription) -> float:
        """See `Experiment`."""
        return _LEAD_S + self.settings.cycles / self.settings.frequency_hz

    def play(self, player: Player) -> None:
        """See `Experiment`."""
        lead = constant(self.settings.low_v, _LEAD_S, UPDATE_HZ)
        drive_v = np.concatenate([lead, self._drive_v()])
        player.play(TRIANGLE, drive_v, self.settings.frame_rate_hz, particles=_SHEET)

    def fit(self, analysis: Analysis) -> ExperimentResult:
        """See `Experiment`."""
        cycles = Cycles.of(analysis.observe(TRIANGLE), self.study, analysis.rig)
        maps = fit_maps(cycles, baseline_v(analysis))
        reason = "one kept cycle; a drift needs two"
        missing = {key: reason for key in _DRIFTS if key not in maps.quantities}
        with fitting("Paper's sensing chain"):
            chain = _chain(cycles, maps, analysis)
        if chain is None:
            return ExperimentResult(
                maps.quantities, maps.notes, figures=maps.figures, values=(maps,), missing=missing
            )
        return ExperimentResult(
            {**maps.quantities, **chain.quantities},
            {**maps.notes, **chain.notes},
            figures={**maps.figures, **chain.figures},
            values=(maps, chain),
            missing=missing,
        )

    def rows(self) -> Mapping[str, Quantity]:
        """See `Experiment`."""
        return paper_rows("S6.", "S7.", "S8.", "S13.", "S14.", "S15.")


def _chain(cycles: Cycles, maps: Maps, analysis: Analysis) -> PrintedChain | None:
    """Compare the paper's sensing chain with the lock-in, over the cycles that are fitted."""
    seen, rig = cycles.seen, analysis.rig
    if seen.lockin is None or seen.printed is None:
        return None
    counted = seen.sensed_s >= cycles.from_s
    strain = np.interp(seen.sensed_s, seen.frame_time_s, seen.length_m / maps.length_m - 1.0)
    carrier_hz = analysis.study.sensing.carrier_hz
    return compare_chain(
        seen.printed.taken(counted),
        seen.lockin.taken(counted),
        strain[counted],
        seen.drive_v[counted],
        seen.sensed_s[counted],
        carrier_hz * rig.block_s,
        carrier_hz * counted_s(rig, carrier_hz),
    )
