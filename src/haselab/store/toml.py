"""Check TOML files with a pydantic model; report all errors at once, with their paths."""

from __future__ import annotations

import difflib
import json
import reprlib
import typing
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator
from pydantic_core import PydanticCustomError

from haselab.base import InputError, JsonObject
from haselab.base.numbers_only import numbers_only
from haselab.store.keys import describe_key
from haselab.store.text_file import parse_toml, read_text

__all__ = ["PrintableSection", "Section", "read_toml", "toml_text", "validated"]

Model = TypeVar("Model", bound=BaseModel)
_MOST_SHOWN = 8
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 60

_MOST_KEYS = 24  # of a table, named where a key is not one of them

_SMALLEST, _LARGEST = 1e-18, 1e18
_UNPRINTABLE = {"Cc", "Zl", "Zp"}  # control characters and line breaks


class Section(BaseModel):
    """A table of a settings file: no unknown keys, and no extreme numbers.

    A field states its own range. A number is neither `true` nor a text. It must also be finite, and
    0 or between 1e-18 and 1e18 in size, so that squares and quotients neither overflow nor
    underflow.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    former_names: ClassVar[Mapping[str, str]] = {}  # of keys that were renamed

    _numbers = field_validator("*", mode="before")(classmethod(numbers_only))

    @field_validator("*", mode="after")
    @classmethod
    def _moderate(cls, value: Any) -> Any:
        for number in value if isinstance(value, tuple) else (value,):
            sized = isinstance(number, float) and number != 0.0
            if sized and not _SMALLEST <= abs(number) <= _LARGEST:
                raise PydanticCustomError("size", "must be 0 or of a size between 1e-18 and 1e18")
        return value


class PrintableSection(Section):
    """A section with names and addresses: texts must not have control characters."""

    @field_validator("*", mode="after")
    @classmethod
    def _printable(cls, value: Any) -> Any:
        for text in value if isinstance(value, tuple) else (value,):
            if isinstance(text, str) and _UNPRINTABLE & set(map(unicodedata.category, text)):
                raise PydanticCustomError(
                    "printable", "must have no control characters or line breaks"
                )
        return value


def toml_text(data: Mapping[str, Any]) -> str:
    """Format tables as a TOML file; leave out values of None.

    Args:
        data: numbers, texts, booleans, lists and tables of them.
    Returns:
        The text.
    Example:
        >>> print(toml_text({"kind": "twin", "load": {"mass_kg": 0.25}}), end="")
        kind = "twin"
        [load]
        mass_kg = 0.25
    """
    return "\n".join(_lines("", data)) + "\n"


def _lines(name: str, table: Mapping[str, Any]) -> list[str]:
    """Lines of one table: its own values, then the tables in it."""
    lines = [f"[{name}]"] if name else []
    tables = {key: value for key, value in table.items() if isinstance(value, Mapping)}
    for key, value in table.items():
        if key not in tables and value is not None:
            lines.append(f"{key} = {json.dumps(value)}")  # a JSON text, number or list is TOML too
    for key, value in tables.items():
        lines += _lines(f"{name}.{key}" if name else key, value)
    return lines


def read_toml(path: Path, what: str) -> JsonObject:
    """Read the tables of a TOML file.

    Args:
        path: of the file.
        what: kind of file for the message, such as "twin file".
    Returns:
        Its content.
    Raises:
        InputError: no such file, or not TOML.
    """
    text = read_text(path, what)
    try:
        return parse_toml(text)
    except RecursionError:
        why = "it is nested too deeply"
    except ValueError as error:  # also integers of thousands of digits and invalid dates
        why = str(error)
    raise InputError(f"Not a TOML file that can be read: {why}. {path}")


def validated(model: type[Model], data: Any, source: object, section: str = "") -> Model:
    """Check data with a model.

    Args:
        model: class of the model.
        data: from `read_toml` or `read_json`.
        source: where they come from, for the message.
        section: of the file, if the data are one of its tables.
    Returns:
        The checked model.
    Raises:
        InputError: unknown keys or values out of range, every one with its path.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        count = error.error_count()
        shown = error.errors(include_url=False)[:_MOST_SHOWN]
    faults = "; ".join(
        _missing(model, fault, data, section)
        if fault["type"] == "missing"
        else f"{_place(section, fault['loc'])}{_said(model, fault, data)}{_got(fault['input'])}"
        for fault in shown
    )
    more = f"; and {count - len(shown)} more" if count > len(shown) else ""
    advice = "" if all(fault["type"] == "missing" for fault in shown) else " Change these values."
    errors = "1 error" if count == 1 else f"{count} errors"
    raise InputError(f"{errors}: {faults}{more}.{advice} {source}")


def _path(section: str, parts: Sequence[Any]) -> str:
    return ".".join([*([section] if section else []), *(str(part)[:60] for part in parts)])


def _place(section: str, parts: Sequence[Any]) -> str:
    """Path of a key in front of what is wrong with it; nothing for the whole file."""
    path = _path(section, parts)
    return f"{path}: " if path else ""


def _missing(model: type[BaseModel], fault: Any, data: Any, section: str) -> str:
    """Name a missing key or table, what it means, and an example."""
    *inside, name = fault["loc"]
    path = _path(section, inside)
    table = _table_of(model, inside, data)
    field = None if table is None else table.model_fields.get(name)
    place = f"[{path}]" if path else "the file"
    if field is None:
        return f"{place} has no key {name}"
    chosen = (each.model_of({}) for each in field.metadata if hasattr(each, "model_of"))
    kind: Any = next(chosen, field.annotation)
    if _is_model(kind):
        keys = ", ".join(key for key, each in kind.model_fields.items() if each.is_required())
        what = (kind.__doc__ or "").strip().partition("\n")[0].rstrip(".")
        needs = f"; it needs the keys {keys}" if keys else ""
        return f"{place} has no table [{_path(path, [name])}] ({what}{needs})"
    advice = describe_key(name, field).advice
    return f"{place} has no key {name}" + (f" ({advice})" if advice else "")


def _said(model: type[BaseModel], fault: Any, data: Any) -> str:
    """Describe an error, with the valid keys of the table."""
    if fault["type"] == "model_type":
        return f"must be a table, headed [{_path('', fault['loc'])}]"
    if fault["type"] != "extra_forbidden":
        return str(fault["msg"]).removeprefix("Value error, ").replace("Input should", "must", 1)
    table = _table_of(model, fault["loc"][:-1], data)
    former = getattr(table, "former_names", {}).get(fault["loc"][-1])
    if former is not None:
        return f"no such key; it is now called {former}"
    keys = [] if table is None else sorted(table.model_fields)
    if 0 < len(keys) <= _MOST_KEYS:
        return f"no such key; the keys are {', '.join(keys)}"
    close = difflib.get_close_matches(str(fault["loc"][-1]), keys, 1)
    return f"no such key; did you mean {close[0]}" if close else "no such key"


def _table_of(model: type[BaseModel], path: Sequence[Any], data: Any) -> Any:
    """The model of a table inside a file; None if there is none at this path.

    A field whose model depends on the table has metadata with a method `model_of`.
    """
    table: Any = model
    for part in path:
        data = data.get(part) if isinstance(data, dict) else None
        field = table.model_fields.get(part)
        kinds = () if field is None else (field.annotation, *typing.get_args(field.annotation))
        table = next((kind for kind in kinds if _is_model(kind)), None)
        chosen = () if field is None else (m for m in field.metadata if hasattr(m, "model_of"))
        table = next((each.model_of(data) for each in chosen), table)
        if table is None:
            return None
    return table


def _is_model(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _got(value: object) -> str:
    """The value that was found, unless it is a whole table."""
    return "" if isinstance(value, (dict, list)) else f" (got {_SHORT.repr(value)})"
