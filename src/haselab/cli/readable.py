"""Format an answer as readable lines: one number, or one row of a table, per line."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from haselab.base import Estimate, to_plain

__all__ = ["readable"]

_NAME_WIDTH, _INDENT, _WIDEST = 32, 2, 100
_MOST_NUMBERS = 8  # longest list of numbers that is shown


def readable(answer: Mapping[str, Any]) -> list[str]:
    """Format an answer as lines.

    Args:
        answer: numbers, estimates, texts, and tables and lists of them.
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
    return list(_lines(answer, 0))


def _lines(table: Mapping[str, Any], indent: int) -> Iterator[str]:
    for name, value in table.items():
        head = f"{' ' * indent}{name!s:{_NAME_WIDTH - indent}s}"
        short = _short(value)
        if short is not None and len(short) <= _WIDEST - _NAME_WIDTH:
            yield f"{head} {short}".rstrip()
        elif isinstance(value, Mapping):
            yield head.rstrip()
            yield from _lines(value, indent + _INDENT)
        elif isinstance(value, (list, tuple)):
            yield head.rstrip()
            yield from _items(value, indent + _INDENT)
        else:
            yield f"{head} {short}".rstrip()


def _items(values: Sequence[Any], indent: int) -> Iterator[str]:
    """Format each item on its own lines; number the rows of a table."""
    for number, value in enumerate(values, start=1):
        if isinstance(value, Mapping):
            yield f"{' ' * indent}{number}"
            yield from _lines(value, indent + _INDENT)
        else:
            yield f"{' ' * indent}{_short(value) or to_plain(value)}"


def _short(value: Any) -> str | None:
    """Format a value on one line; None if it needs several."""
    if isinstance(value, Estimate):
        return _estimate(value)
    if hasattr(value, "shape") and getattr(value, "size", 0) > _MOST_NUMBERS:
        return f"array of {value.size} values (use --json or --out)"
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
