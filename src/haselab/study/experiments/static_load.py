"""Hang masses at 0 V, to find the shell's law and linear regions (rows S16 and S17)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from haselab.rig import RigDescription
from haselab.safety.feasibility import Drive
from haselab.study.analysis import Analysis
from haselab.study.experiment import Experiment, ExperimentResult
from haselab.study.fits.static import Static, fit_static
from haselab.study.paper.quantity_table import paper_rows
from haselab.study.player import Player
from haselab.study.quantity import Quantity
from haselab.study.tables import StaticLoad

__all__ = ["StaticLoadTest"]

_NAME = "static"


class StaticLoadTest(Experiment[StaticLoad]):
    """Hang each mass in turn at 0 V, then the rig's own again."""

    table = "static_load"
    title = "Static load"
    settings_type = StaticLoad
    gives = (Static,)
    report_figures = ("fig4",)

    def recordings(self) -> dict[str, str]:
        """See `Experiment`."""
        return {_NAME: "static load"}

    def drives(self, rig: RigDescription) -> list[Drive]:
        """See `Experiment`."""
        return [Drive("static load", np.zeros(1))]

    def masses_kg(self) -> tuple[float, ...]:
        """See `Experiment`."""
        return self.settings.masses_kg

    def seconds(self, rig: RigDescription) -> float:
        """See `Experiment`."""
        return (len(self.settings.masses_kg) + 1) * self.settings.settle_s

    def play(self, player: Player) -> None:
        """See `Experiment`."""
        s = self.settings
        player.hang(_NAME, list(s.masses_kg), s.settle_s, s.frame_rate_hz)
        player.settle(0.0, s.settle_s)

    def fit(self, analysis: Analysis) -> ExperimentResult:
        """See `Experiment`."""
        found = fit_static(analysis.observe(_NAME), self.study, analysis.rig, analysis.near(Static))
        reason = (
            "only a planar-hasel has such a shell; this actuator is a "
            f"{analysis.rig.actuator_kind}. 'haselab identify actuator' fits its law"
        )
        missing = {key: reason for key in self.rows() if key not in found.quantities}
        return ExperimentResult(
            found.quantities, found.notes, figures=found.figures, values=(found,), missing=missing
        )

    def rows(self) -> Mapping[str, Quantity]:
        """See `Experiment`."""
        return paper_rows("S16.", "S17.")
