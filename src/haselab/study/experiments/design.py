"""Design controllers for the identified plant; plays nothing (rows S21, S22 and S25)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from haselab.rig import RigDescription
from haselab.safety.feasibility import Drive
from haselab.study.analysis import Analysis
from haselab.study.experiment import Experiment, ExperimentResult, NotPlayedError
from haselab.study.experiments.steps import open_names
from haselab.study.fits.dynamics import Dynamics
from haselab.study.fits.loops import Loops, design_loops, measured_latency
from haselab.study.fits.maps import Maps
from haselab.study.paper.quantity_table import paper_rows
from haselab.study.player import Player
from haselab.study.quantity import Quantity
from haselab.study.tables import Control

__all__ = ["ControllerDesign"]

_SEED = 20181001  # of the design's search


class ControllerDesign(Experiment[Control]):
    """The paper's PI, scaled to the identified plant, and a PID, for the step trials."""

    table = "control"
    title = "Controllers"
    settings_type = Control
    gives = (Loops,)
    report_figures = ("fig7",)

    def recordings(self) -> dict[str, str]:
        """See `Experiment`; none."""
        return {}

    def drives(self, rig: RigDescription) -> list[Drive]:
        """See `Experiment`; none."""
        return []

    def play(self, player: Player) -> None:
        """See `Experiment`; the design is made when the closed loops need it."""

    def fit(self, analysis: Analysis) -> ExperimentResult:
        """See `Experiment`."""
        dynamics, maps = analysis.need(Dynamics), analysis.need(Maps)
        if not self.study.has("steps"):
            raise NotPlayedError("needs [steps], which is not in this study")
        opened = [analysis.observe(name) for name in open_names(self.study)]
        found = design_loops(
            dynamics, maps.voltage_map, self.study, analysis.rig,
            np.random.default_rng(_SEED), measured_latency(opened, analysis.rig),
            analysis.repeated(Loops),
        )  # fmt: skip
        notes = dict(found.notes)
        for key in found.quantities:
            if unplayed := self._unplayed(key):
                notes[key] = "; ".join(filter(None, (notes.get(key, ""), unplayed)))
        return ExperimentResult(found.quantities, notes, figures=found.figures, values=(found,))

    def _unplayed(self, key: str) -> str:
        """Say that a loop of S21 was computed and not played; empty if it was played."""
        trials = self.study.steps
        if not key.startswith("S21.") or key.startswith(("S21.plant_", "S21.printed_")):
            return ""
        if key == "S21.delay":  # of every loop
            return ""
        delayed = key.startswith("S21.delayed_")
        if trials.extra_delay_trials if delayed else trials.pi_trials:
            return ""
        name = "extra_delay_trials" if delayed else "pi_trials"
        return f"not played (steps.{name} = 0); computed for the scaled PI"

    def rows(self) -> Mapping[str, Quantity]:
        """See `Experiment`."""
        return paper_rows(
            "S21.", "S22.saturation_", "S25.k", "S25.derivative_filter", "S25.phase_margin",
            "S25.gain_margin",
        )  # fmt: skip
