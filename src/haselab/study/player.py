"""Play one experiment on a bench, within the drives that it has declared."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, LimitError
from haselab.runtime.loop import LoopSettings
from haselab.runtime.runner import Runner
from haselab.safety.feasibility import Drive
from haselab.store.session.layout import ExperimentPlan
from haselab.study.analysis import Analysis
from haselab.study.experiments.foreign import AnyExperiment, declared

__all__ = ["UPDATE_HZ", "Player"]

UPDATE_HZ = 100.0  # one new output a block, row S5
_SAME_V = 1e-9

Floats = NDArray[np.float64]


class Player:
    """Plays the drives of one experiment, and gives access to earlier findings.

    Args:
        runner: of the session.
        experiment: the experiment to play.
        analysis: of the study.
    """

    def __init__(self, runner: Runner, experiment: AnyExperiment, analysis: Analysis) -> None:
        self._runner, self._name, self.analysis = runner, experiment.table, analysis
        plans = declared(experiment, "plans", ExperimentPlan, experiment.plans)
        self._planned, self._played = {plan.name for plan in plans}, set[str]()
        self.rig, self._hung_kg = analysis.rig, runner.mass_kg
        listed = declared(experiment, "drives", Drive, partial(experiment.drives, self.rig))
        drives = [np.append(0.0, drive.values_v) for drive in listed]
        self._low_v = min((float(values.min()) for values in drives), default=0.0)
        self._high_v = max((float(values.max()) for values in drives), default=0.0)
        self._jump_v = max((float(np.abs(np.diff(v)).max()) for v in drives if v.size > 1),
                           default=0.0)  # fmt: skip

    @property
    def mass_kg(self) -> float:
        """The rig's own hung mass, in kg."""
        return self._runner.mass_kg

    def play(
        self, name: str, drive_v: Floats, frame_rate_hz: float, *, particles: str = ""
    ) -> None:
        """Play one drive value per block in open loop, and record.

        Args:
            name: one of `Experiment.recordings`.
            drive_v: in V, shape `(blocks,)`.
            frame_rate_hz: of the camera.
            particles: name of the recording of the sheet's particles; empty: not recorded.
        Raises:
            InputError: the recording is not planned, or was made before.
            LimitError: a drive was not declared, or is beyond the drive limits.
            SafetyError: the bench protected itself.
            DeviceError: disk or instrument failed.
        """
        self._check(drive_v)
        self._begin(name)
        self._runner.play(name, drive_v, frame_rate_hz, self._hung_kg, particles=particles)

    def settle(self, drive_v: float, duration_s: float) -> None:
        """Hold one output without recording, until creep has faded.

        Args:
            drive_v: in V.
            duration_s: for how long.
        """
        self._check(np.array([drive_v]))
        self._runner.settle(drive_v, duration_s)

    def release(
        self, name: str, drive_v: float, settle_s: float, record_s: float, frame_rate_hz: float
    ) -> None:
        """Lift the mass, wait, drop it and record; see `Runner.release`."""
        self._check(np.array([drive_v]))
        self._begin(name)
        self._runner.release(name, drive_v, settle_s, record_s, frame_rate_hz, self._hung_kg)

    def hang(
        self, name: str, masses_kg: list[float], settle_s: float, frame_rate_hz: float
    ) -> None:
        """Hang each mass in turn at 0 V, then the rig's own again; see `Runner.hang`."""
        self._begin(name)
        self._runner.hang(name, masses_kg, settle_s, frame_rate_hz)
        self.load(self.mass_kg)

    def load(self, mass_kg: float) -> None:
        """Hang a mass at 0 V, which stays; hang the rig's own again at the end.

        Args:
            mass_kg: one of `Experiment.masses_kg`, or the rig's own.
        """
        self._runner.load(mass_kg)
        self._hung_kg = mass_kg

    def close_loop(
        self, name: str, reference: Floats, loop: LoopSettings, frame_rate_hz: float
    ) -> None:
        """Close the loop, with one desired strain per block; see `Runner.close_loop`."""
        self._begin(name)
        self._runner.close_loop(name, reference, loop, frame_rate_hz, self._hung_kg)

    def rest(self) -> None:
        """Set the drive to 0 V at once; the sensing signal stays on."""
        self._runner.rest()

    def _begin(self, name: str) -> None:
        """Refuse a recording that is not planned, or that was made before."""
        if name in self._played:
            raise InputError(
                f"The experiment [{self._name}] plays {name!r} twice, but one recording is one "
                "drive. List a second name in its method 'recordings'."
            )
        if name not in self._planned:
            raise InputError(
                f"The experiment [{self._name}] plays {name!r}, which its method 'recordings' does "
                "not list. Add the name there."
            )
        self._played.add(name)

    def _check(self, drive_v: Floats) -> None:
        """Refuse drives that were not declared to the feasibility check."""
        low_v, high_v = float(np.min(drive_v)), float(np.max(drive_v))
        declared = f"declares drives of {self._low_v:g} to {self._high_v:g} V"
        if low_v < self._low_v - _SAME_V or high_v > self._high_v + _SAME_V:
            worst_v = low_v if low_v < self._low_v - _SAME_V else high_v
            raise LimitError(
                f"The experiment [{self._name}] {declared}, but plays {worst_v:g} V. Return every "
                "drive from its method 'drives', so that the feasibility check covers it."
            )
        jump_v = float(np.abs(np.diff(drive_v)).max()) if drive_v.size > 1 else 0.0
        if jump_v > self._jump_v + _SAME_V:
            raise LimitError(
                f"The experiment [{self._name}] {declared} with steps of at most {self._jump_v:g} "
                f"V, but plays one of {jump_v:g} V. Return that step from its method 'drives'."
            )
