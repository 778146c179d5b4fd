"""What the header of a LabVIEW measurement file (.lvm) states about its columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from haselab.store.columns.archive import positive

__all__ = ["LabviewHeader", "labview_header", "without_tags"]

_MAGIC, _END = "LabVIEW Measurement", "***End_of_Header***"
_TAGS = ("X_Columns", "X_Dimension", "X_Unit_Label", "Y_Unit_Label", "X0", "Delta_X")
_X, _TIME = "X_Value", "Time"


@dataclass(frozen=True)
class LabviewHeader:
    """Units and rate in the header of a segment.

    Args:
        units: text by column; empty where none is stated.
        rate_hz: rows per second of a file without a column of times, or with the same times for
            each channel; None: not stated.
    """

    units: tuple[str, ...]
    rate_hz: float | None


def without_tags(lines: list[str]) -> list[str]:
    """Blank the headers of the file and of its first segment, whose numbers look like rows.

    Args:
        lines: of any text file, from its first on.
    Returns:
        As many lines; the same for another kind of file.
    """
    ends = [k for k, line in enumerate(lines) if line.startswith(_END)]
    if not (ends and lines[0].startswith(_MAGIC)):
        return lines
    first = ends[:2][-1] + 1
    return [""] * first + lines[first:]


def labview_header(
    lines: Sequence[str], delimiter: str | None, names: Sequence[str]
) -> LabviewHeader | None:
    """Read the tags above the rows; each channel's value stands in the channel's column.

    Args:
        lines: above the first row of numbers.
        delimiter: between cells; None: white space.
        names: of the columns.
    Returns:
        The header; None for another kind of file.
    Source: NI, Specification for the LabVIEW Measurement File (.lvm): X_Dimension is Time where
        the header does not state another one, and its unit then s.
    Example:
        >>> lines = ["LabVIEW Measurement\\t", "Y_Unit_Label\\tmV\\tV", "X_Dimension\\tTime\\tTime"]
        >>> labview_header(lines, "\\t", ["X_Value", "u", "y", "Comment"])
        LabviewHeader(units=('s', 'mV', 'V', ''), rate_hz=None)
    """
    if not (lines and lines[0].startswith(_MAGIC)):
        return None
    rows = ([cell.strip() for cell in line.split(delimiter)] for line in lines)
    cells = {row[0]: row for row in rows if row and row[0] in _TAGS}

    def cell(tag: str, column: int) -> str:
        row = cells.get(tag, [])
        return row[column] if column < len(row) else ""

    def unit_of_x(channel: int) -> str:
        dimension = cell("X_Dimension", channel) or _TIME
        return cell("X_Unit_Label", channel) or ("s" if dimension == _TIME else dimension)

    units = [
        unit_of_x(k + 1) if name == _X else cell("Y_Unit_Label", k) if k else ""
        for k, name in enumerate(names)
    ]
    every = range(1, len(names))
    steps = {cell("Delta_X", k).replace(",", ".") for k in every} - {""}
    starts = {cell("X0", k).replace(",", ".") for k in every} - {""}
    no_column = cell("X_Columns", 1) == "No" or (
        cell("X_Columns", 1) == "Multi" and names.count(_X) > 1 and len(starts) <= 1
    )
    evenly = no_column and len(steps) == 1 and unit_of_x(1) == "s"
    step_s = positive(steps.pop()) if evenly else None
    return LabviewHeader(tuple(units), None if step_s is None else 1.0 / step_s)
