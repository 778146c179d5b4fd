"""Describe the keys of a settings file: meaning, unit, range, default and an example."""

from __future__ import annotations

import json
import math
import typing
from dataclasses import dataclass
from typing import Any

from pydantic.fields import FieldInfo

__all__ = ["Key", "describe_key"]

# By the end of a key's name, the longest ending first.
_UNITS = {
    "v_per_m": "V/m", "v_per_s": "V/s", "v_per_v": "V/V", "m_per_px": "m/px", "per_f2": "1/F²",
    "rad_s": "rad/s", "per_f": "1/F", "ohm": "ohm", "deg": "°", "hz": "Hz", "kg": "kg", "pa": "Pa",
    "px": "px", "db": "dB", "v": "V", "s": "s", "m": "m", "a": "A", "f": "F",
}  # fmt: skip
_UNBOUNDED = 1e15  # a limit of this size only keeps arithmetic finite


@dataclass(frozen=True)
class Key:
    """One key of a table.

    Args:
        name: in the file.
        meaning: a noun phrase; empty if the class of the table does not state one.
        unit: from the end of the name; empty for numbers without unit and for texts.
        values: the permitted ones; empty if all are.
        default: as it is written in a file; empty if the key is required or has none.
        example: as it is written in a file; empty if the class does not state one.
        required: whether the table needs the key.
    """

    name: str
    meaning: str
    unit: str
    values: str
    default: str
    example: str
    required: bool

    @property
    def advice(self) -> str:
        """What to write into the file, for the message about a missing key."""
        unit = f"in {self.unit}" if self.unit else ""
        example = f"for example {self.name} = {self.example}" if self.example else ""
        return ", ".join(text for text in (self.meaning, unit, self.values, example) if text)


def describe_key(name: str, field: FieldInfo) -> Key:
    """Describe one key by the field that checks it.

    Args:
        name: of the key.
        field: of a pydantic model.
    Returns:
        Its description.
    Example:
        >>> from pydantic import Field
        >>> field = Field(gt=0, le=10, description="length of the hold", examples=[2.5])
        >>> describe_key("hold_s", field).advice
        'length of the hold, in s, above 0 and at most 10, for example hold_s = 2.5'
    """
    words = _words(field.annotation)
    examples = field.examples or words[:1]
    default = None if field.is_required() else field.get_default(call_default_factory=True)
    unit = next((unit for end, unit in _UNITS.items() if f"_{name}".endswith(f"_{end}")), "")
    return Key(
        name,
        field.description or "",
        unit,
        " or ".join(json.dumps(word) for word in words) or _range(field),
        "" if default is None else json.dumps(default),
        json.dumps(examples[0]) if examples else "",
        field.is_required(),
    )


def _words(annotation: Any) -> tuple[Any, ...]:
    """The valid values of a key with a choice of words; empty for other keys."""
    return typing.get_args(annotation) if typing.get_origin(annotation) is typing.Literal else ()


def _range(field: FieldInfo) -> str:
    """The limits of a number, and whether it is whole."""
    numbers: dict[str, float] = {}
    for each in field.metadata:
        for bound in ("ge", "gt", "le", "lt", "multiple_of"):
            value = getattr(each, bound, None)
            if value is not None and abs(value) < _UNBOUNDED:
                numbers[bound] = value
    if numbers.get("ge", -math.inf) > numbers.get("gt", -math.inf):
        numbers.pop("gt", None)
    limits = {bound: _number(value) for bound, value in numbers.items()}
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    if {"ge", "le"} <= set(limits) and not {"gt", "lt"} & set(limits):
        between = f"{limits['ge']} to {limits['le']}"
    else:
        between = " and ".join(f"{words[k]} {limits[k]}" for k in words if k in limits)
    whole = int in (field.annotation, *typing.get_args(field.annotation))
    steps = f"a multiple of {limits['multiple_of']}" if "multiple_of" in limits else ""
    return ", ".join(text for text in ("a whole number" if whole else "", between, steps) if text)


def _number(value: float) -> str:
    """A limit as a reader writes it."""
    return f"{value:,.15g}" if 1e-4 <= abs(value) < 1e7 or value == 0 else f"{value:g}"
