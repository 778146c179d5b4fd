"""Propose the shortest study that determines a parameter of a physical model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from haselab.base import HaselabError, InputError, JsonObject
from haselab.identify.physical.misfit import model_record
from haselab.identify.physical.outlook import Outlook
from haselab.identify.physical.record import MotionRecord
from haselab.models.actuator.sections import PhysicalRecords
from haselab.pipelines.planning.catalogue import Candidate, Range, candidates, combine
from haselab.pipelines.planning.planned_record import planned_record
from haselab.study.feasibility import check_settings

__all__ = ["DETERMINED", "Planner", "Proposal"]

Floats = NDArray[np.float64]
DETERMINED = 0.1  # relative standard deviation of a parameter that counts as determined
_PARTNERS = 6  # best experiments of which pairs are tried
_IMPROVES = 0.9  # of the standard deviation: an experiment that helps
_MARGIN = 0.05  # of the range of the records, by which an experiment may exceed it
_SOFTENING = "softening"


@dataclass(frozen=True)
class Proposal:
    """A study for a parameter, and what it is expected to give.

    Args:
        parameter: its name.
        candidate: the study.
        duration_s: of the study, without what people and programs take in between.
        before: relative standard deviation now.
        after: with this study.
        wanted: largest one that was wanted.
        notes: what to mind, one sentence each.
    """

    parameter: str
    candidate: Candidate
    duration_s: float
    before: float
    after: float
    wanted: float
    notes: tuple[str, ...] = ()

    @property
    def status(self) -> str:
        """ "ok", or that no known experiment is enough."""
        if self.after <= self.wanted:
            return "ok"
        return (
            f"no experiment of the catalogue reaches a relative standard deviation of "
            f"{self.wanted:g} for {self.parameter}; the best one reaches {self.after:.2g}"
        )

    def answer(self) -> JsonObject:
        """Keys of the JSON answer."""
        return {
            "parameter": self.parameter,
            "experiment": self.candidate.text,
            "duration_s": self.duration_s,
            "relative_std_before": self.before,
            "relative_std_after": self.after,
            "study": self.candidate.tables,
            "notes": list(self.notes),
            "status": self.status,
        }

    @property
    def change(self) -> str:
        """The relative standard deviation before and after it, in words."""
        far = "" if self.after <= self.wanted else " (not enough)"
        return f"{self.before:.2g} to {self.after:.2g}{far}"

    @property
    def text(self) -> str:
        """One line of a table."""
        return (
            f"{self.candidate.text}: {self.duration_s:.0f} s, relative standard deviation "
            f"{self.change}"
        )


@dataclass
class Planner:
    """Experiments that might be played, with the information that each would add.

    Args:
        outlook: what is known now.
        records: of the model.
        within: what the actuator may be exposed to.
    """

    outlook: Outlook
    records: PhysicalRecords
    within: Range
    _played: list[tuple[float, Candidate, MotionRecord]] = field(init=False)
    _information: dict[str, Floats | None] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        found = [self._written(candidate) for candidate in candidates(self.within)]
        self._played = sorted((one for one in found if one is not None), key=lambda one: one[0])

    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.outlook.unknowns.names

    def before(self) -> Mapping[str, float]:
        """Relative standard deviations now, by name."""
        return dict(zip(self.names(), self.outlook.relative_std().tolist(), strict=True))

    def propose(
        self, parameter: str, wanted: float = DETERMINED, *, pairs: bool = True
    ) -> Proposal | None:
        """Find the shortest study after which a parameter is known well enough.

        Args:
            parameter: its name.
            wanted: relative standard deviation to be reached.
            pairs: try studies of two experiments if no single one is enough.
        Returns:
            The study, or the one that comes nearest; None if none helps.
        Raises:
            InputError: There is no such parameter.
        """
        if parameter not in self.names():
            raise InputError(
                f"{parameter} is not a parameter of the model. Its parameters are "
                f"{', '.join(self.names())}."
            )
        index = self.names().index(parameter)
        before = float(self.outlook.relative_std()[index])
        tried: list[tuple[float, float, Candidate]] = []  # after, seconds
        for seconds, candidate, record in self._played:
            after = self._after(candidate, record, index)
            if after is None:
                continue
            tried.append((after, seconds, candidate))
            if after <= wanted:
                return self._proposal(parameter, tried[-1], before, wanted)
        tried += self._pairs(tried, index) if pairs else []
        enough = [one for one in tried if one[0] <= wanted]
        if not tried:
            return None
        best = min(enough, key=lambda one: one[1]) if enough else min(tried, key=lambda one: one[0])
        helps = best[0] < _IMPROVES * before
        return self._proposal(parameter, best, before, wanted) if helps else None

    def _proposal(
        self, parameter: str, best: tuple[float, float, Candidate], before: float, wanted: float
    ) -> Proposal:
        after, seconds, candidate = best
        return Proposal(
            parameter, candidate, seconds, before, after, wanted, self._notes(parameter, candidate)
        )

    def _notes(self, parameter: str, candidate: Candidate) -> tuple[str, ...]:
        found = []
        about = {each.key: each.name for each in self.outlook.unknowns.law.described()}
        if about.get(parameter.partition("[")[0], "").startswith(_SOFTENING):
            found.append(
                f"{parameter} shows only where the actuator is stretched for the first time: use a "
                "device that was never stretched this far, or one that has recovered."
            )
        loads = candidate.tables.get("static_load", {}).get("masses_kg", [])
        top_kg = max(loads) if isinstance(loads, list) and loads else 0.0
        if top_kg > self.within.heaviest_kg:
            found.append(
                f"{top_kg:g} kg is heavier than any mass so far ({self.within.heaviest_kg:g} kg): "
                "make sure that actuator and clamps withstand it."
            )
        return (*found, *self._further(candidate))

    def _further(self, candidate: Candidate) -> tuple[str, ...]:
        """A note if a study moves the actuator further than the records."""
        seen_m, written = self.records.lengths_m, self._written(candidate)
        if seen_m is None or written is None:
            return ()
        lengths_m = model_record(self.outlook.unknowns, written[2], derivatives=False).length_m
        low_m, high_m = float(lengths_m.min()), float(lengths_m.max())
        margin_m = _MARGIN * (seen_m[1] - seen_m[0])
        if low_m > seen_m[0] - margin_m and high_m < seen_m[1] + margin_m:
            return ()
        return (
            f"The experiment moves the actuator from {1e3 * low_m:.3g} to {1e3 * high_m:.3g} mm, "
            f"further than the records ({1e3 * seen_m[0]:.3g} to {1e3 * seen_m[1]:.3g} mm): make "
            "sure that the actuator withstands it and that nothing is in its way.",
        )

    def _pairs(
        self, tried: Sequence[tuple[float, float, Candidate]], index: int
    ) -> list[tuple[float, float, Candidate]]:
        """Studies of two of the best experiments."""
        best: dict[tuple[str, ...], tuple[float, float, Candidate]] = {}
        for one in sorted(tried, key=lambda one: one[0]):
            key = (*one[2].tables, str(one[2].tables.get("operating_point")))
            best.setdefault(key, one)
        some = [one[2] for one in list(best.values())[:_PARTNERS]]
        found = []
        for k, first in enumerate(some):
            for second in some[k + 1 :]:
                pair = combine(first, second)
                written = None if pair is None else self._written(pair)
                if written is None:
                    continue
                seconds, candidate, record = written
                after = self._after(candidate, record, index)
                if after is not None:
                    found.append((after, seconds, candidate))
        return found

    def _written(self, candidate: Candidate) -> tuple[float, Candidate, MotionRecord] | None:
        """Duration and motion; None if the study would be refused."""
        try:
            study = candidate.study()
            check_settings(study)
            record = planned_record(study, self.records, self.within.mass_kg)
        except InputError:
            return None
        return float(np.ptp(record.drive.edge_s)), candidate, record

    def _after(self, candidate: Candidate, record: MotionRecord, index: int) -> float | None:
        """Relative standard deviation with a study; None if the actuator would leave its limits."""
        if candidate.text not in self._information:
            try:
                self._information[candidate.text] = self.outlook.information(record)
            except HaselabError:
                self._information[candidate.text] = None
        added = self._information[candidate.text]
        return None if added is None else float(self.outlook.relative_std([added])[index])
