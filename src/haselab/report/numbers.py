"""Format numbers with the digits that their uncertainty supports, and with powers of ten."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["ABSENT", "interval_text", "number_text", "value_text"]

ABSENT = "—"
_SIGNIFICANT = 5
_MOST_ITEMS, _FIRST_ITEMS = 16, 3  # of a list
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _exponent(size: float) -> int:
    """Power of ten to factor out; 0 for numbers that are readable without one."""
    if size == 0.0 or 1e-3 <= size < 1e5:
        return 0
    return math.floor(math.log10(size))


def _with_power(text: str, exponent: int) -> str:
    text = text.replace("-", "−")
    return text if exponent == 0 else f"{text}×10{str(exponent).translate(_SUPERSCRIPT)}"


def number_text(value: float | None) -> str:
    """Format a number without uncertainty, to five significant digits.

    Args:
        value: any number; `None`, NaN and infinity mean "no value".

    Returns:
        Text with a true minus sign.

    Example:
        >>> number_text(4.923e6), number_text(-0.2805), number_text(None)
        ('4.923×10⁶', '−0.2805', '—')
    """
    if value is None or not math.isfinite(value):
        return ABSENT
    exponent = _exponent(abs(value))
    mantissa = value / 10.0**exponent
    decimals = _SIGNIFICANT - 1 - (math.floor(math.log10(abs(mantissa))) if mantissa else 0)
    text = f"{mantissa:z.{max(decimals, 0)}f}"
    return _with_power(text.rstrip("0").rstrip(".") if "." in text else text, exponent)


def interval_text(
    value: float | None, std: float | None, ci95: Sequence[float | None]
) -> tuple[str, str]:
    """Format value and 95 % interval to two significant digits of the standard deviation.

    Args:
        value: best value.
        std: standard deviation, same unit.
        ci95: low and high end, same unit; an end without a finite value is open.

    Returns:
        Text of the value and text of the interval, which is a dash if both ends are open.

    Example:
        >>> interval_text(5.1134, 0.0213, (5.0717, 5.1551))
        ('5.113', '[5.072, 5.155]')
        >>> interval_text(-2e-5, 0.0021, (-0.0041, 0.0041))
        ('0.0000', '[−0.0041, 0.0041]')
        >>> interval_text(5.1134, None, (None, None))
        ('5.1134', '—')
    """
    if value is None or not math.isfinite(value):
        return ABSENT, ABSENT
    ends = [end if end is not None and math.isfinite(end) else None for end in ci95]
    if std is None or not math.isfinite(std) or std <= 0.0:
        low, high = (number_text(end) if end is not None else "open" for end in ends)
        return number_text(value), ABSENT if ends == [None, None] else f"[{low}, {high}]"
    exponent = _exponent(max(abs(value), std))
    scale = 10.0**exponent
    decimals = min(max(1 - math.floor(math.log10(std / scale)), 0), 9)
    texts = [
        f"{number / scale:z.{decimals}f}" if number is not None else "open"
        for number in (value, *ends)
    ]
    return (
        _with_power(texts[0], exponent),
        ABSENT if ends == [None, None] else _with_power(f"[{texts[1]}, {texts[2]}]", exponent),
    )


def value_text(value: Any) -> str:
    """Format a cell of a results file: number, text, range, estimate or nothing.

    Args:
        value: number, text, list (a range), mapping (an estimate or named values) or `None`.

    Returns:
        One line of text.

    Example:
        >>> value_text([6, 8]), value_text(None), value_text("stable")
        ('6 to 8', '—', 'stable')
        >>> value_text(list(range(256)))
        '256 values: 0, 1, 2, …'
    """
    if value is None:
        return ABSENT
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (int, float)):
        return number_text(float(value))
    if isinstance(value, Mapping):
        if "value" in value and "ci95" in value:
            shown, interval = interval_text(value["value"], value.get("std"), value["ci95"])
            if shown == ABSENT:
                return ABSENT
            parts = (shown, "" if interval == ABSENT else interval, str(value.get("unit") or ""))
            return " ".join(filter(None, parts))
        return "; ".join(f"{name} {value_text(item)}" for name, item in value.items())
    if isinstance(value, (list, tuple)):
        if len(value) > _MOST_ITEMS:
            return f"{len(value)} values: {value_text(value[:_FIRST_ITEMS])}, …"
        is_range = len(value) == 2 and not any(isinstance(item, str) for item in value)
        joint = " to " if is_range else ", "
        return joint.join(value_text(item) for item in value)
    return str(value)
