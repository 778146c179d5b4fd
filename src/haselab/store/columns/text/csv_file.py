"""Columns of text tables: an optional preamble, a header row, then rows of numbers."""

from __future__ import annotations

import codecs
import contextlib
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.columns.archive import Archive, MissingColumnsError, Take, positive
from haselab.store.columns.text.clock import DAY_S, clock_s
from haselab.store.columns.text.labview import labview_header
from haselab.store.columns.text.text_layout import (
    HEAD_BYTES,
    TextLayout,
    is_number,
    layout_of,
    split_cells,
)
from haselab.store.columns.units import parse_unit, split_header

__all__ = ["CsvArchive"]

_RATE_LINE = re.compile(
    r"^#\s*(?:rate_hz|sample_rate_hz|fs)\s*[=:]\s*([-+.\deE]+)\s*$", re.MULTILINE
)
_CHUNK_BYTES = 1 << 22


class CsvArchive(Archive):
    """A text table: comma, semicolon, tab, bar or white space, decimal point or comma.

    Lines before the header are a preamble; those that begin with `#` are comments. A row of units
    may follow the header. Columns have numbers as well, from 1 on.

    Args:
        file: where it is.
        opened: closes what the archive opens.
    Raises:
        InputError: the file is empty or ambiguous.
    """

    def __init__(self, file: Path, opened: contextlib.ExitStack) -> None:
        super().__init__(file, opened)
        with file.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
        layout = layout_of(head, file, whole=len(head) < HEAD_BYTES)
        if not (layout.names or layout.cells):
            raise InputError(f"The file is empty. Export a header and rows of numbers: {file}")
        self._layout: TextLayout = layout
        top = head.decode(layout.encoding, errors="replace").lstrip("\ufeff")
        lines = top.splitlines()[: layout.first_line]
        rates = _RATE_LINE.findall("\n".join(line.strip() for line in lines))
        self._rate_hz = positive(rates[-1]) if rates else None
        self._units = layout.units
        labview = labview_header(lines, layout.delimiter, layout.names)
        if labview is not None:
            self._units, self._rate_hz = labview.units, labview.rate_hz
        self._names = _distinct(layout.names, layout.cells)
        self._read_bytes = 0

    @property
    def names(self) -> Sequence[str]:
        """Cells of the header; `column 3` for an empty cell, `U (column 3)` for a repeated one."""
        return self._names

    def _locate(self, name: str) -> str | None:
        if name in self._names:
            return name
        same = [k for k, cell in enumerate(self._layout.names) if cell == name]
        if len(same) > 1:
            raise self._several(name, same)
        return self._by_name_without_unit(name) or self._by_number(name)

    def _several(self, name: str, places: Sequence[int]) -> InputError:
        listed = ", ".join(str(place + 1) for place in places)
        return InputError(
            f"The file has {len(places)} columns {name}: columns {listed}. Use the number of the "
            f"column instead of its name: {self.file}"
        )

    def _by_number(self, name: str) -> str | None:
        if not (name.isascii() and name.isdigit() and 1 <= int(name) <= len(self._names)):
            return None
        return self._names[int(name) - 1]

    def locate_all(self, names: Sequence[str]) -> list[str]:
        """Names of columns that must be there."""
        found = {name: self.locate(name) for name in names}
        lacking = [name for name, full in found.items() if full is None]
        if lacking and not self._layout.names:
            raise InputError(
                f"The file has no header row with {', '.join(lacking)}. Add one, or name its "
                f"{len(self._names)} columns by their numbers, 1 for the first: {self.file}"
            )
        if lacking:
            raise MissingColumnsError(lacking, self._names, self.file)
        return [full for full in found.values() if full is not None]

    def plain_name(self, full: str) -> str:
        """The name of a column without its unit."""
        return split_header(full)[0]

    def is_clock(self, full: str) -> bool:
        """Whether the first rows have clock times, with or without a date."""
        return self._names.index(full) in self._layout.clocks

    def unit_text(self, full: str) -> str:
        """From the row of units below or above the header, else from the header."""
        place = self._names.index(full)
        if place in self._layout.clocks:
            return "s"
        header = super().unit_text(full)
        below = self._units[place].strip("[]() ") if place < len(self._units) else ""
        if header and below and parse_unit(header, full) != parse_unit(below, full):
            raise InputError(
                f"Column '{full}' has the unit {header} in its header, but {below} in the row "
                "of units. State the true one with --unit "
                f"'{self.plain_name(full)}=UNIT': {self.file}"
            )
        return below or header

    def rate_hz(self, names: Sequence[str]) -> float | None:
        """From a line like `# rate_hz = 400` above the header, or from LabVIEW's Delta_X."""
        del names
        return self._rate_hz

    def rows(self, names: Sequence[str]) -> int | None:
        """Unknown before all lines are read."""
        del names
        return None

    def share_read(self) -> float | None:
        """Share of the file's bytes that has been read."""
        return self._read_bytes / max(1, self.file.stat().st_size)

    def start(self, names: Sequence[str]) -> Take:
        """Begin to read these columns at the row after the header."""
        places = [self._names.index(name) for name in names]
        for name, place in zip(names, places, strict=True):
            if place in self._layout.mixed:
                raise InputError(
                    f"Column {name} has points, but other columns have decimal commas, so its "
                    "points may be thousands separators. Export the table with one decimal mark: "
                    f"{self.file}"
                )
        more = self._lines()
        rows = _Rows(self._layout, names, places, self.file)
        waiting = np.empty((0, len(names)))

        def take(count: int) -> tuple[NDArray[Any], ...]:
            nonlocal waiting
            while len(waiting) < count and (lines := more()) is not None:
                waiting = np.concatenate([waiting, rows.numbers(lines)])
            table, waiting = waiting[:count], waiting[count:]
            return tuple(np.ascontiguousarray(column) for column in table.T)

        return take

    def _lines(self) -> Callable[[], list[str] | None]:
        """Gives the next lines from the first row of numbers on; None at the end."""
        stream, newline = self.stream(), self._layout.newline
        decoder = codecs.getincrementaldecoder(self._layout.encoding)(errors="replace")
        skip, carry, ended = self._layout.first_line, "", False
        self._read_bytes = 0

        def more() -> list[str] | None:
            nonlocal skip, carry, ended
            if ended:
                return None
            data = stream.read(_CHUNK_BYTES)
            ended = not data
            self._read_bytes += len(data)
            text = carry + decoder.decode(data, final=ended)
            whole, _, carry = (text, "", "") if ended else text.rpartition(newline)
            lines = whole.split(newline) if whole else []
            skipped, skip = min(skip, len(lines)), max(0, skip - len(lines))
            return lines[skipped:]

        return more


def _distinct(names: Sequence[str], cells: int) -> list[str]:
    """Give each column a unique name."""
    if not names:
        return [str(k + 1) for k in range(cells)]
    if not names[-1] and len(names) > cells:
        names = names[:-1]  # a separator at the end of the line
    counts = Counter(names)
    found = []
    for k, name in enumerate(names, start=1):
        if not name:
            found.append(f"column {k}")
        else:
            found.append(name if counts[name] == 1 else f"{name} (column {k})")
    return found


class _Rows:
    """Converts lines of a table to rows of numbers.

    Args:
        layout: of the table.
        names: of the wanted columns.
        places: of them.
        file: where it is, for messages.
    """

    def __init__(
        self, layout: TextLayout, names: Sequence[str], places: Sequence[int], file: Path
    ) -> None:
        self._layout, self._names, self._places, self._file = layout, names, places, file
        self._decimal = layout.decimal
        self._line_number = layout.first_line + 1
        self._clocks = layout.clocks.intersection(places)
        self._first_days: dict[int, int | None] = dict.fromkeys(self._clocks)
        self._latest_s: dict[int, float] = {}

    def numbers(self, lines: Sequence[str]) -> NDArray[np.float64]:
        """The rows of the next lines, shape `(rows, columns)`."""
        first, self._line_number = self._line_number, self._line_number + len(lines)
        if not any(line.strip() and not line.lstrip().startswith("#") for line in lines):
            return np.empty((0, len(self._names)))
        try:
            if not self._clocks and self._has_equal_rows(lines):
                return self._load(self._plain(lines))
        except ValueError:
            pass
        rows = []  # quotes, separators after the last row, a cell that is no number
        blank = f'"\r\n \t{self._layout.delimiter or ""}'
        for number, line in enumerate(lines, start=first):
            if line.strip(blank) and not line.lstrip().startswith("#"):
                rows.append(self._row(line, number))
        return np.array(rows, dtype=np.float64).reshape(-1, len(self._names))

    def _plain(self, lines: Sequence[str]) -> Sequence[str]:
        """Lines with decimal points."""
        comma_cells = self._layout.delimiter == ","
        if not self._decimal and not comma_cells:
            text = "".join(lines)
            self._decimal = "." if "." in text else "," if "," in text else ""
        if self._decimal != ",":
            return lines
        if comma_cells:
            raise ValueError  # quoted cells
        return "\n".join(lines).replace(",", ".").split("\n")

    def _has_equal_rows(self, lines: Sequence[str]) -> bool:
        """Whether no row can have more cells than the table: those are read one by one."""
        mark = self._layout.delimiter
        if mark is None:
            return True
        between = sum(line.count(mark) for line in lines)
        return between == sum(map(bool, map(str.strip, lines))) * (self._layout.cells - 1)

    def _load(self, lines: Sequence[str]) -> NDArray[np.float64]:
        return np.loadtxt(
            lines, delimiter=self._layout.delimiter, usecols=self._places, ndmin=2, comments="#"
        )

    def _row(self, line: str, number: int) -> list[float]:
        cells = split_cells(line.rstrip("\r").partition("#")[0], self._layout.delimiter)
        if cells[0] == "Channels":
            raise InputError(
                f"Line {number} begins another segment of a LabVIEW file. Split the file into its "
                f"segments, which are separate records: {self._file}"
            )
        width = self._layout.cells  # 0: no row of numbers was found
        if width and any(cell.strip() for cell in cells[width:]):
            raise InputError(
                f"Line {number} has {len(cells)} cells, but the table has {width} "
                f"columns. Is a comma in it a decimal comma? Change or remove it: {self._file}"
            )
        row = []
        for name, place in zip(self._names, self._places, strict=True):
            cell = cells[place] if place < len(cells) else ""
            if place in self._clocks:
                row.append(self._clock(name, place, cell, number))
                continue
            text = cell.replace("∞", "inf")
            two_marks = self._decimal == "," and "." in text
            if self._decimal == ",":
                text = text.replace(",", ".")
            if two_marks or not (is_number(cell) and _is_float(text)):
                found = f"has '{cell}'" if cell else "has no value"
                raise InputError(
                    f"Column {name} {found} in line {number}. Change or remove the line: "
                    f"{self._file}"
                )
            row.append(float(text))
        return row

    def _clock(self, name: str, place: int, cell: str, number: int) -> float:
        """Seconds of a clock time since midnight of the first day."""
        found = clock_s(cell, self._first_days[place])
        if found is None:
            raise InputError(
                f"Column {name} has '{cell}' in line {number}, which is no clock time, or the date "
                "has changed and is written with slashes, whose order is not known. Change or "
                f"remove the line, or write dates as 2026-03-29: {self._file}"
            )
        seconds, day = found
        self._first_days[place] = day
        if day == 0:  # no date: a fall by half a day or more is midnight
            days = round((self._latest_s.get(place, seconds) - seconds) / DAY_S)
            self._latest_s[place] = seconds = seconds + DAY_S * max(days, 0)
        return seconds


def _is_float(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
