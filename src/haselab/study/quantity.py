"""A result's row: its name, its unit, and what a publication printed for it."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["TOLERANCE", "Quantity"]

TOLERANCE = 0.10  # a printed number of two digits is met within this part of it


@dataclass(frozen=True)
class Quantity:
    """One row of the table.

    Args:
        name: for people.
        unit: SI.
        paper: printed value, or range; None where the paper gives none.
        recomputed: what the paper's own numbers give; None where nothing was recomputed.
        paper_note: what the reader should know of the comparison.
        within: distance from the printed value that still agrees; None: a tenth of it.
        setting: what of the study was set to the value; "" for what is measured.
        same_as: id of the row with the same printed quantity; the two count as one comparison.
        note: what the reader of any study should know.
        reference_only: it is about the publication, and no result of another study.
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
    reference_only: bool = False

    def without_paper(self) -> Quantity:
        """The same row in a study that is not compared with a publication."""
        return Quantity(self.name, self.unit, note=self.note)

    @property
    def agreed(self) -> tuple[float, float] | None:
        """Values that agree with the paper; None where it gives none."""
        if self.paper is None or isinstance(self.paper, tuple):
            return self.paper
        margin = TOLERANCE * abs(self.paper) if self.within is None else self.within
        return self.paper - margin, self.paper + margin
