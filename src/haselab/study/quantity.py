"""Row of a result: its name, its unit, and the value in a publication."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["TOLERANCE", "Quantity"]

TOLERANCE = 0.10  # relative distance within which a printed number of two digits agrees


@dataclass(frozen=True)
class Quantity:
    """One row of the table.

    Args:
        name: for people.
        unit: SI.
        paper: printed value or range; None: the paper has none.
        recomputed: value computed from the paper's own numbers; None: not recomputed.
        paper_note: remark about the comparison.
        within: distance from the printed value that still agrees; None: a tenth of it.
        setting: what in the study was set to the value; "": the value is measured.
        same_as: id of the row with the same printed quantity; the two count as one comparison.
        note: remark for any study.
        plain_name: name for readers without the publication; "": use `name`.
        reference_only: the row is about the publication and not part of other studies.
        planar_only: the row is no result of other kinds of actuator than the planar HASEL.
    """

    name: str
    unit: str
    paper: float | tuple[float, float] | None = None
    recomputed: float | tuple[float, float] | None = None
    paper_note: str = ""
    within: float | None = None
    setting: str = ""
    same_as: str = ""
    note: str = ""
    plain_name: str = ""
    reference_only: bool = False
    planar_only: bool = False

    def without_paper(self) -> Quantity:
        """The same row in a study that is not compared with a publication."""
        return Quantity(self.plain_name or self.name, self.unit, note=self.note)

    @property
    def agreed(self) -> tuple[float, float] | None:
        """Range of values that agree with the paper; None if the paper has no value."""
        if self.paper is None or isinstance(self.paper, tuple):
            return self.paper
        margin = TOLERANCE * abs(self.paper) if self.within is None else self.within
        return self.paper - margin, self.paper + margin
