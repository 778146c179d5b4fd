"""Hold some voltages, to find the one that centres the strain (row S18)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

import numpy as np

from haselab.rig import RigDescription
from haselab.safety.feasibility import Drive
from haselab.signals import constant
from haselab.study.analysis import Analysis
from haselab.study.definition import Study
from haselab.study.experiment import Experiment, ExperimentResult
from haselab.study.fits.cycles import Cycles
from haselab.study.fits.maps import Maps
from haselab.study.fits.observe import TRIANGLE
from haselab.study.fits.point import Point, find_point
from haselab.study.fits.static import Static
from haselab.study.paper.quantity_table import paper_rows
from haselab.study.player import UPDATE_HZ, Player
from haselab.study.quantity import Quantity
from haselab.study.tables import OperatingPoint

__all__ = ["OperatingPointTest", "baseline_v", "hold_drives_v", "possible_baselines_v"]

_HOLDS = 5  # number of voltages that are held
_HOLD_S = 0.5  # recorded at each


def baseline_v(analysis: Analysis) -> float:
    """Return the drive voltage of zero strain: found, given, or the middle of the triangle.

    Args:
        analysis: of the study.
    Returns:
        The voltage; if a run is repeated, the one of that run.
    Raises:
        InputError: the study neither states it nor has the experiments to find it.
    """
    point = analysis.repeated(Point) or analysis.find(Point)
    return analysis.study.nominal_baseline_v if point is None else point.baseline_v


def hold_drives_v(study: Study) -> list[float]:
    """Voltages at which the strain at rest is measured: the baseline, or candidates for it.

    Around each of them the chirp stays within the triangle.
    """
    given = study.operating_point.baseline_v
    if given is not None:
        return [given]
    swing_v = study.chirp.amplitude_v if study.has("chirp") else 0.0
    low, high = study.triangle.low_v + swing_v, study.triangle.high_v - swing_v
    return [float(level) for level in np.linspace(low, high, _HOLDS)]


def possible_baselines_v(study: Study) -> tuple[float, float]:
    """The lowest and the highest possible baseline of a study; twice the same if it is given."""
    if OperatingPointTest.of(study) is None:
        return study.nominal_baseline_v, study.nominal_baseline_v
    drives_v = hold_drives_v(study)
    return min(drives_v), max(drives_v)


class OperatingPointTest(Experiment[OperatingPoint]):
    """Hold some voltages, if the study has a triangle and static loads to compare with."""

    table = "operating_point"
    title = "Operating point"
    settings_type = OperatingPoint
    gives = (Point,)

    @classmethod
    def of(cls, study: Study) -> Self | None:
        """See `Experiment`; None if the study has no data to find the point from."""
        found = study.has("triangle") and study.has("static_load")
        return cls(study, study.operating_point) if found else None

    def recordings(self) -> dict[str, str]:
        """See `Experiment`."""
        return dict.fromkeys(self._names(), "voltage held")

    def _names(self) -> list[str]:
        return [f"hold-{k + 1}" for k in range(len(hold_drives_v(self.study)))]

    def drives(self, rig: RigDescription) -> list[Drive]:
        """See `Experiment`."""
        return [Drive("voltage held", np.array(hold_drives_v(self.study)))]

    def seconds(self, rig: RigDescription) -> float:
        """See `Experiment`."""
        settle_s = self.study.static_load.settle_s
        return len(self._names()) * (settle_s + _HOLD_S) + settle_s

    def play(self, player: Player) -> None:
        """See `Experiment`."""
        s = self.study.static_load
        for name, drive_v in zip(self._names(), hold_drives_v(self.study), strict=True):
            player.settle(drive_v, s.settle_s)
            player.play(name, constant(drive_v, _HOLD_S, UPDATE_HZ), s.frame_rate_hz)
        player.settle(0.0, s.settle_s)
        # Fit now, at 0 V: if the triangle has no result, the run ends before hours of other trials.
        player.analysis.find(Maps)

    def fit(self, analysis: Analysis) -> ExperimentResult:
        """See `Experiment`."""
        static = analysis.need(Static)
        cycles = Cycles.of(analysis.observe(TRIANGLE), self.study, analysis.rig)
        repeated = analysis.repeated(Point)
        found = find_point(
            [analysis.observe(name) for name in self._names()], cycles, static, self.study,
            analysis.rig, None if repeated is None else repeated.baseline_v,
        )  # fmt: skip
        figures = {"static": {"operating_point": found.figures}}
        return ExperimentResult(found.quantities, found.notes, figures=figures, values=(found,))

    def rows(self) -> Mapping[str, Quantity]:
        """See `Experiment`."""
        return paper_rows("S18.")
