"""Columns of text tables: a header row, then rows of numbers."""

from __future__ import annotations

import contextlib
import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.columns.archive import Archive, Take, missing, positive

__all__ = ["CsvArchive"]

_RATE_LINE = re.compile(r"#\s*(?:rate_hz|sample_rate_hz|fs)\s*[=:]\s*([-+.\deE]+)\s*$")
_PIECE_BYTES = 1 << 22


class CsvArchive(Archive):
    """A text table with comma, semicolon or tabulator; lines that begin with `#` are comments.

    Args:
        file: where it is.
        opened: closes what the archive opens.
    Raises:
        InputError: empty.
    """

    def __init__(self, file: Path, opened: contextlib.ExitStack) -> None:
        super().__init__(file, opened)
        self._rate_hz: float | None = None
        self._header_lines, self._read_bytes, header = 0, 0, ""
        with file.open("rb") as stream:
            for raw in stream:
                self._header_lines += 1
                line = raw.decode("utf-8-sig").strip()
                match = _RATE_LINE.match(line)
                self._rate_hz = positive(match.group(1)) if match else self._rate_hz
                if line and not line.startswith("#"):
                    header = line
                    break
            self._offset = stream.tell()
        if not header:
            raise InputError(
                f"The file is empty; allowed is a header and rows. Record again: {file}"
            )
        self._delimiter = max(",;\t", key=header.count)
        cells = next(csv.reader([header], delimiter=self._delimiter))
        self._names = [cell.strip() for cell in cells]

    @property
    def names(self) -> Sequence[str]:
        """Cells of the header."""
        return self._names

    def locate(self, name: str) -> str | None:
        """The name itself, if it is there."""
        return name if name in self._names else None

    def locate_all(self, names: Sequence[str]) -> list[str]:
        """Names of columns that must be there."""
        lacking = [name for name in names if name not in self._names]
        if lacking and all(_is_number(name) for name in self._names):
            raise InputError(
                f"The file has no header row; allowed is one with the names of the columns. "
                f"Add it: {self.file}"
            )
        if lacking:
            raise missing(lacking, self._names, self.file)
        return list(names)

    def rate_hz(self, names: Sequence[str]) -> float | None:
        """From a line like `# rate_hz = 400` above the header."""
        del names
        return self._rate_hz

    def rows(self, names: Sequence[str]) -> int | None:
        """Unknown: lines are counted by reading them."""
        del names
        return None

    def share_read(self) -> float | None:
        """Bytes read over those of the file."""
        return self._read_bytes / max(1, self.file.stat().st_size)

    def start(self, names: Sequence[str]) -> Take:
        """Begin to read these columns at the row after the header."""
        stream = self.stream()
        self._read_bytes = stream.seek(self._offset)
        places = [self._names.index(name) for name in names]
        waiting, line_number, carry = np.empty((0, len(names))), self._header_lines + 1, b""

        def more() -> bool:
            nonlocal waiting, line_number, carry
            data = stream.read(_PIECE_BYTES)
            self._read_bytes += len(data)
            whole, _, rest = (carry + data).rpartition(b"\n")
            if not data:
                whole, rest = carry, b""
            carry = rest
            lines = whole.decode("utf-8").splitlines()
            waiting = np.concatenate([waiting, self._numbers(lines, names, places, line_number)])
            line_number += len(lines)
            return bool(data)

        def take(rows: int) -> tuple[NDArray[Any], ...]:
            nonlocal waiting
            while len(waiting) < rows and more():
                pass
            table, waiting = waiting[:rows], waiting[rows:]
            return tuple(np.ascontiguousarray(column) for column in table.T)

        return take

    def _numbers(
        self, lines: list[str], names: Sequence[str], places: list[int], first: int
    ) -> NDArray[np.float64]:
        """Rows of these lines, the first of which has this number in the file."""
        if not any(line.strip() and not line.lstrip().startswith("#") for line in lines):
            return np.empty((0, len(names)))
        try:
            return np.loadtxt(
                lines, delimiter=self._delimiter, usecols=places, ndmin=2, comments="#"
            )
        except ValueError as error:
            raise self._bad_cell(lines, names, places, first) from error

    def _bad_cell(
        self, lines: list[str], names: Sequence[str], places: list[int], first: int
    ) -> InputError:
        """The first cell that is no number."""
        for number, line in enumerate(lines, start=first):
            if not line.strip() or line.startswith("#"):
                continue
            cells = next(csv.reader([line], delimiter=self._delimiter))
            for name, place in zip(names, places, strict=True):
                cell = cells[place].strip() if place < len(cells) else "nothing"
                if not _is_number(cell):
                    return InputError(
                        f"Column {name} holds '{cell}' in line {number}; allowed are numbers. "
                        f"Correct or remove the line: {self.file}"
                    )
        return InputError(
            f"The rows cannot be read as numbers. Export the table again: {self.file}"
        )


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
