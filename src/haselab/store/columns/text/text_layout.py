"""Find the layout of a text table: encoding, separator, decimal mark, preamble, header, units."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from haselab.base import InputError
from haselab.store.columns.text.clock import clock_s
from haselab.store.columns.text.labview import without_tags
from haselab.store.columns.units import is_unit

__all__ = ["HEAD_BYTES", "TextLayout", "is_number", "layout_of", "split_cells"]

HEAD_BYTES = 1 << 20
_MOST_LINES, _MOST_CHARACTERS, _FEWEST_LINES = 400, 400_000, 12
_NUMBER = re.compile(
    r"[+-]?(?:(?:\d+(?:(?P<mark>[.,])\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?|nan|inf(?:inity)?|∞)",
    re.IGNORECASE,
)
_MOST_SPOILT = 3
_LATEST_HEADER = 12  # row of a preamble of numbers that the names follow at the latest
_LEAST_SHARE = 0.5  # of cells that are numbers, where white space separates them
_RULER = re.compile(r"[-=_*\s;,\t|]*")
_DELIMITERS = (";", "\t", ",", "|", None)


@dataclass(frozen=True)
class TextLayout:
    """Where the numbers of a text table are, and how they are written.

    Args:
        encoding: of the bytes.
        delimiter: between cells; None: white space.
        decimal: the decimal mark, "." or ","; empty where the first lines have none.
        names: of the columns; empty without a header.
        units: text of the row below the header, by column; empty without such a row.
        cells: in a row of numbers.
        first_line: number of lines before the first row of numbers.
        mixed: columns whose numbers have another decimal mark than those of other columns.
        newline: that ends a line.
        clocks: columns of clock times.
    """

    encoding: str
    delimiter: str | None
    decimal: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    cells: int
    first_line: int
    mixed: frozenset[int]
    newline: str
    clocks: frozenset[int] = frozenset()


@dataclass(frozen=True)
class _Guess:
    """A layout by one delimiter, and how well it explains the lines."""

    delimiter: str | None
    names: tuple[str, ...]
    units: tuple[str, ...]
    cells: int
    first_line: int
    rows: Sequence[Sequence[str]]
    share: float
    halved: bool

    @property
    def rank(self) -> tuple[float, bool, int]:
        return round(self.share, 2), bool(self.names), self.cells


def is_number(cell: str) -> bool:
    """Whether a cell is a number, with a decimal point or comma."""
    return _NUMBER.fullmatch(cell.strip()) is not None


def split_cells(line: str, delimiter: str | None) -> list[str]:
    """Cells of a line without the spaces around them."""
    if delimiter is None:
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(delimiter)]
    reader = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    return [cell.strip() for cell in next(reader, [])]


def layout_of(head: bytes, file: Path, *, whole: bool) -> TextLayout:
    """The layout of a table from its first bytes.

    Args:
        head: the first `HEAD_BYTES` of the file, or all of it.
        file: where they are from, for the message.
        whole: these are all bytes of the file.
    Returns:
        The layout; `cells` is 0 where no row of numbers is found.
    Raises:
        InputError: commas separate the columns and the decimals alike.
    """
    encoding = _encoding(head)
    text = head.decode(encoding, errors="replace").lstrip("\ufeff")
    newline = "\r" if "\r" in text and "\n" not in text else "\n"
    lines = [line.rstrip("\r") for line in text.split(newline)]
    if not whole and len(lines) > 1:
        lines.pop()
    lines = without_tags(_some(lines))
    guesses = [guess for each in _DELIMITERS if (guess := _guess(lines, each)) is not None]
    guesses = [each for each in guesses if each.delimiter or each.share >= _LEAST_SHARE]
    best = max(guesses, key=lambda guess: guess.rank, default=None)
    if best is None:
        return _without_rows(lines, encoding, newline)
    if best.halved:
        raise InputError(
            f"The rows have {best.cells} cells, but the header names {best.cells // 2} columns: "
            "commas separate the columns and the decimals alike. Export the table with semicolons "
            f"or with decimal points: {file}"
        )
    decimal, mixed = _decimal_mark(best.rows)
    return TextLayout(
        encoding, best.delimiter, decimal, best.names, best.units, best.cells, best.first_line,
        mixed, newline, _clocks(best.rows),
    )  # fmt: skip


def _clocks(rows: Sequence[Sequence[str]]) -> frozenset[int]:
    """Columns of which each cell is a clock time."""
    columns = range(min((len(row) for row in rows), default=0))
    return frozenset(k for k in columns if all(clock_s(row[k]) is not None for row in rows))


def _encoding(head: bytes) -> str:
    for mark, name in ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"),
                       (codecs.BOM_UTF16_BE, "utf-16-be")):  # fmt: skip
        if head.startswith(mark):
            return name
    odd, even = head[1:2000:2], head[0:2000:2]
    if odd and odd.count(0) > 0.8 * len(odd):
        return "utf-16-le"
    if odd and even.count(0) > 0.8 * len(even):
        return "utf-16-be"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252" if not {0x81, 0x8D, 0x8F, 0x90, 0x9D} & set(head) else "latin-1"
    return "utf-8"


def _some(lines: list[str]) -> list[str]:
    """The first lines, few enough to be examined quickly."""
    count = characters = 0
    for line in lines[:_MOST_LINES]:
        characters += len(line)
        if count >= _FEWEST_LINES and characters > _MOST_CHARACTERS:
            break
        count += 1
    return lines[:count]


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _guess(lines: Sequence[str], delimiter: str | None) -> _Guess | None:
    """The layout with this delimiter; None if it gives no rows of numbers."""
    numbered = [
        (number, split_cells(line, delimiter))
        for number, line in enumerate(lines)
        if line.strip() and not _is_comment(line)
    ]
    numeric = {number: [is_number(cell) for cell in cells] for number, cells in numbered}
    counts = Counter(len(cells) for number, cells in numbered if any(numeric[number]))
    if not counts:
        return None
    most = max(counts, key=lambda size: (counts[size], size))
    rows = [(number, cells) for number, cells in numbered if len(cells) == most]
    some = [(number, cells) for number, cells in rows if any(numeric[number])]
    columns = [
        k for k in range(most)
        if 2 * sum(numeric[number][k] for number, _ in some) > sum(bool(row[k]) for _, row in some)
    ]  # fmt: skip
    if not columns:
        return None
    first = next((n for n, _ in rows if all(numeric[n][k] for k in columns)), None)
    if first is None:
        return None
    late = next((n for n, row in rows[:_LATEST_HEADER] if n > first and _is_names(row)), -1)
    first = next((n for n, _ in rows if n > late and all(numeric[n][k] for k in columns)), first)
    names, units, first = _header(lines, numbered, columns, first, delimiter)
    data = [cells for number, cells in rows if number >= first]
    filled = sum(bool(cell) for cells in data for cell in cells)
    good = sum(is_number(cell) for cells in data for cell in cells)
    halved = delimiter == "," and not names and _is_halved(numbered, first, most)
    return _Guess(delimiter, names, units, most, first, data, good / filled, halved)


def _is_names(cells: Sequence[str]) -> bool:
    """Whether the cells can be the names below a preamble of numbers; words of gaps are equal."""
    return len(set(cells)) == len(cells) > 1 and all(cells) and not any(map(is_number, cells))


def _is_halved(numbered: Sequence[tuple[int, list[str]]], first: int, cells: int) -> bool:
    """Whether the line above has names for half of the cells, as with decimal commas."""
    above = [row for number, row in numbered if number < first]
    return bool(above) and 2 * len([c for c in above[-1] if c]) == cells > 2


def _header(
    lines: Sequence[str],
    numbered: Sequence[tuple[int, list[str]]],
    columns: Sequence[int],
    first: int,
    delimiter: str | None,
) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """Names, units, and the first row: a row with a cell that is no number may come before it."""
    needed = columns[-1] + 1
    above = [(n, row) for n, row in numbered if n < first and not _RULER.fullmatch(lines[n])]

    def is_text(cells: Sequence[str]) -> bool:
        texts = [cells[k] for k in columns if k < len(cells) and cells[k]]
        return bool(texts) and not any(is_number(text) for text in texts)

    units: tuple[str, ...] = ()
    if len(above) > 1 and _all_units(above[-1][1][:needed]):
        over = above[-2][1]
        if len(over) >= needed and is_text(over):
            units = tuple(above.pop()[1])
    if not units:
        spoilt = 0  # rows of which some cells are numbers
        while spoilt < len(above) and _is_spoilt(above[-1 - spoilt][1], needed, is_text):
            spoilt += 1
        if 0 < spoilt <= _MOST_SPOILT and spoilt < len(above):
            number, cells = above[-1 - spoilt]
            if len(cells) >= needed:
                return tuple(cells), (), above[len(above) - spoilt][0]
    if above:
        number, cells = above[-1]
        names = _names(lines[number], cells, needed, delimiter)
        if names and is_text(names):
            return names, units, first
    return _commented_header(lines, first, needed, delimiter), (), first


def _is_spoilt(cells: Sequence[str], needed: int, is_text: Callable[[Sequence[str]], bool]) -> bool:
    return len(cells) >= needed and not is_text(cells) and any(map(is_number, cells))


def _all_units(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell]
    return bool(filled) and all(is_unit(cell) for cell in filled)


def _names(line: str, cells: Sequence[str], needed: int, delimiter: str | None) -> tuple[str, ...]:
    """Names of columns; between white space a name may have single spaces of its own."""
    if delimiter is None:
        wide = [cell.strip() for cell in re.split(r"\s{2,}|\t", line.strip())]
        cells = wide if len(wide) == needed else cells
        return tuple(cells) if len(cells) == needed else ()
    return tuple(cells) if len(cells) >= needed else ()


def _commented_header(
    lines: Sequence[str], first: int, needed: int, delimiter: str | None
) -> tuple[str, ...]:
    """Names in a comment right above the rows, as numpy.savetxt writes them."""
    above = [line for line in lines[:first] if line.strip()]
    if not above or not _is_comment(above[-1]):
        return ()
    cells = split_cells(above[-1].lstrip().lstrip("#").strip(), delimiter)
    texts = all(cell and not is_number(cell) for cell in cells)
    return tuple(cells) if len(cells) == needed and texts and "=" not in above[-1] else ()


def _without_rows(lines: Sequence[str], encoding: str, newline: str) -> TextLayout:
    """A header alone, or nothing."""
    for number, line in enumerate(lines):
        if line.strip() and not _is_comment(line):
            delimiter = max(",;\t", key=line.count)
            names = tuple(split_cells(line, delimiter))
            return TextLayout(
                encoding, delimiter, "", names, (), 0, number + 1, frozenset(), newline
            )
    return TextLayout(encoding, ",", "", (), (), 0, len(lines), frozenset(), newline)


def _decimal_mark(rows: Sequence[Sequence[str]]) -> tuple[str, frozenset[int]]:
    """The decimal mark of the rows, and columns with another one."""
    found: dict[int, set[str]] = {}
    for row in rows:
        for k, cell in enumerate(row):
            match = _NUMBER.fullmatch(cell)
            if match and match["mark"]:
                found.setdefault(k, set()).add(match["mark"])
            elif match and cell.strip("+-")[:1] in {".", ","}:
                found.setdefault(k, set()).add(cell.strip("+-")[0])
    marks = set().union(*found.values()) if found else set()
    decimal = "," if "," in marks else "." if marks else ""
    return decimal, frozenset(k for k, seen in found.items() if seen - {decimal})
