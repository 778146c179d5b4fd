"""Numbers in what a page sends."""

from __future__ import annotations

import math

from haselab.base import InputError, JsonObject, is_real, shown

__all__ = ["number", "up_to_millivolts"]


def number(values: JsonObject, name: str) -> float:
    """Read a number that a page has sent.

    Args:
        values: arguments of a command or a request.
        name: of the number.
    Returns:
        The number.
    Raises:
        InputError: It is missing, of another type, or not finite.
    Example:
        >>> number({"value_v": 1}, "value_v")
        1.0
    """
    found: object = values.get(name)
    if not is_real(found) or not math.isfinite(found):
        raise InputError(f"{name} is {shown(found)}, but it must be a finite number.")
    return float(found)


def up_to_millivolts(volt: float) -> str:
    """A voltage rounded up, so that a limit typed as shown is high enough.

    Example:
        >>> up_to_millivolts(1.8142), up_to_millivolts(1.815)
        ('1.815', '1.815')
    """
    return f"{math.ceil(1e3 * volt - 1e-9) / 1e3:g}"
