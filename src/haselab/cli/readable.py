"""Format an answer as readable lines: one number, or one row of a table, per line."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from haselab.base import Estimate, to_plain

__all__ = ["readable"]

_NAME_WIDTH, _INDENT, _WIDEST = 32, 2, 100
_UNIT = "_unit"
_MOST_NUMBERS = 8  # longest list of numbers that is shown


def readable(answer: Mapping[str, Any], units: Mapping[str, str] | None = None) -> list[str]:
    """Format an answer as lines.

    A key `NAME_unit` gives the unit of `NAME`, in the tables within the table too, and has no line
    of its own. Arrays of one size share a line.

    Args:
        answer: numbers, estimates, texts, and tables and lists of them.
        units: by name, of numbers whose unit is neither in their name nor in the answer.
    Returns:
        Lines of at most about 100 characters, tables indented below their names.
    Example:
        >>> print("\\n".join(readable({"gain": 0.5, "poles": [-1 + 2j], "fit": {"a": 1, "b": 2}})))
        gain                             0.5
        poles                            -1 + 2i
        fit
          a                              1
          b                              2
    """
    return list(_lines(answer, 0, units or {}))


def _lines(table: Mapping[str, Any], indent: int, units: Mapping[str, str]) -> Iterator[str]:
    stated = {
        name.removesuffix(_UNIT): unit
        for name, unit in table.items()
        if isinstance(unit, str) and name.endswith(_UNIT) and name.removesuffix(_UNIT) in table
    }
    units, arrays = {**units, **stated}, _arrays(table)
    for name, value in table.items():
        if isinstance(name, str) and name.removesuffix(_UNIT) in stated and name.endswith(_UNIT):
            continue
        if size := next((size for size, names in arrays.items() if name in names), 0):
            if name == arrays[size][0]:
                yield from _array_lines(size, arrays[size], indent)
            continue
        head = f"{' ' * indent}{name!s:{_NAME_WIDTH - indent}s}"
        short = _with_unit(value, _short(value), units.get(name, ""))
        if short is not None and len(short) <= _WIDEST - _NAME_WIDTH:
            yield f"{head} {short}".rstrip()
        elif isinstance(value, Mapping):
            yield head.rstrip()
            yield from _lines(value, indent + _INDENT, units)
        elif isinstance(value, (list, tuple)):
            yield head.rstrip()
            yield from _items(value, indent + _INDENT, units)
        else:
            yield f"{head} {short}".rstrip()


def _items(values: Sequence[Any], indent: int, units: Mapping[str, str]) -> Iterator[str]:
    """Format each item on its own lines; number the rows of a table."""
    for number, value in enumerate(values, start=1):
        if isinstance(value, Mapping):
            yield f"{' ' * indent}{number}"
            yield from _lines(value, indent + _INDENT, units)
        else:
            yield f"{' ' * indent}{_short(value) or to_plain(value)}"


def _arrays(table: Mapping[str, Any]) -> dict[int, list[str]]:
    """Names of the arrays that are not shown, by their size."""
    found: dict[int, list[str]] = {}
    for name, value in table.items():
        if _is_long(value):
            found.setdefault(value.size, []).append(name)
    return found


def _is_long(value: Any) -> bool:
    return hasattr(value, "shape") and getattr(value, "size", 0) > _MOST_NUMBERS


def _array_lines(size: int, names: Sequence[str], indent: int) -> Iterator[str]:
    what = f"{size} values of each" if len(names) > 1 else f"array of {size} values"
    head = f"{' ' * indent}{what if len(names) > 1 else names[0]:{_NAME_WIDTH - indent}s}"
    text = f"{', '.join(names) if len(names) > 1 else what} (use --json or --out)"
    parts = textwrap.wrap(text, _WIDEST - _NAME_WIDTH)
    yield from (f"{head if k == 0 else ' ' * _NAME_WIDTH} {part}" for k, part in enumerate(parts))


def _with_unit(value: Any, short: str | None, unit: str) -> str | None:
    """Append a unit to a number, to an estimate without one or to numbers in one line."""
    if not unit or unit == "1" or short is None or short == "none":
        return short
    if isinstance(value, str):
        return f"{short} ({unit})"
    if isinstance(value, Estimate):
        return short if value.unit else _estimate(replace(value, unit=unit))
    return short if isinstance(value, bool) else f"{short} {unit}"


def _short(value: Any) -> str | None:
    """Format a value on one line; None if it needs several."""
    if isinstance(value, Estimate):
        return _estimate(value)
    if isinstance(value, Mapping):
        return "none" if not value else None
    if isinstance(value, (list, tuple)):
        return _list(value)
    if isinstance(value, complex):
        return _complex(value)
    plain = to_plain(value)
    if plain is None:
        return "none"
    if isinstance(plain, bool):
        return "yes" if plain else "no"
    if isinstance(plain, list):
        return _list(plain)
    return f"{plain:.6g}" if isinstance(plain, float) else str(plain)


def _list(values: Sequence[Any]) -> str | None:
    if len(values) == 0:
        return "none"
    if any(isinstance(each, (Mapping, Estimate, list, tuple)) for each in values):
        return None
    if len(values) > _MOST_NUMBERS and not any(isinstance(each, str) for each in values):
        return f"{len(values)} values (use --json or --out)"
    parts = [_short(each) or "" for each in values]
    return None if any(len(part) > 40 for part in parts) else ", ".join(parts)


def _complex(value: complex) -> str:
    if not (math.isfinite(value.real) and math.isfinite(value.imag)):
        return "not identifiable"
    sign = "-" if value.imag < 0.0 else "+"
    return f"{value.real:.6g} {sign} {abs(value.imag):.6g}i" if value.imag else f"{value.real:.6g}"


def _estimate(value: Estimate) -> str:
    if math.isnan(value.value):
        return "not identifiable"
    low, high = value.ci95
    unit = f" {value.unit}" if value.unit else ""
    if low == high:
        return f"{value.value:.6g}{unit}"  # exact
    if math.isinf(value.std):
        return f"not identifiable from these data (the value {value.value:.6g}{unit} is arbitrary)"
    return f"{value.value:.6g}{unit}   95 % [{low:.6g}, {high:.6g}]"
