"""The reference study row by row: the paper, this project, and the differences."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

__all__ = ["CITATION", "StudyRow", "markdown_table", "study_rows"]

CITATION = (
    "C. Schunk, L. Pearson, E. Acome, T. G. Morrissey, N. Correll, C. Keplinger, M. E. Rentschler, "
    "J. S. Humbert: System Identification and Closed-Loop Control of a Hydraulically Amplified "
    "Self-Healing Electrostatic (HASEL) Actuator. IEEE/RSJ International Conference on Intelligent "
    "Robots and Systems (IROS), 2018."
)
_FILE = Path(__file__).parents[1] / "studies" / "hasel-iros2018-rows.toml"


@dataclass(frozen=True)
class StudyRow:
    """One row of the study.

    Args:
        id: `S1` to `S30`, `D1` to `D17`.
        paper: what the paper does or states.
        here: what is done here.
        where: results, figures and files that show it; "" for an open row.
        differs: what differs and why; "": nothing.
    """

    id: str
    paper: str
    here: str
    where: str
    differs: str


@functools.cache
def study_rows() -> tuple[StudyRow, ...]:
    """All rows in the order of their numbers.

    Example:
        >>> [row.here for row in study_rows() if row.id == "S29"]
        ['open']
    """
    data = tomllib.loads(_FILE.read_text(encoding="utf-8"))
    return tuple(StudyRow(key, **cells) for key, cells in data.items())


def markdown_table(rows: Iterable[StudyRow]) -> str:
    """Format the rows as the table in docs/study/study.md."""
    lines = ["| row | the paper | here | where | what differs |", "|---|---|---|---|---|"]
    lines += [f"| {r.id} | {r.paper} | {r.here} | {r.where} | {r.differs} |" for r in rows]
    return "\n".join(lines)
