"""Convert results to JSON types."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from haselab.base.estimate import Estimate

__all__ = ["to_plain"]


def to_plain(value: Any) -> Any:
    """Convert estimates, arrays and numbers to JSON types; NaN and infinity become null.

    Args:
        value: estimate, mapping, sequence, array or number; anything else is returned unchanged.
    Returns:
        The value as dictionaries, lists, numbers, text and None.
    Example:
        >>> to_plain({"wn": Estimate(5.0, 0.1, (4.8, 5.2), "rad/s"), "bad": float("nan")})
        {'wn': {'value': 5.0, 'std': 0.1, 'ci95': [4.8, 5.2], 'unit': 'rad/s'}, 'bad': None}
    """
    if isinstance(value, Estimate):
        return to_plain(value.to_dict())
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return to_plain(value.tolist())
    if isinstance(value, complex):
        return [to_plain(value.real), to_plain(value.imag)]
    if isinstance(value, float):
        return value if value - value == 0.0 else None
    return value
