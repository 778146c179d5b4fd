"""Numbers in tables of a file: neither `true` nor a text is one, though Python converts both."""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterator, Mapping
from types import NoneType
from typing import Any

__all__ = ["numbers_only", "switches_only"]


def numbers_only(model: Any, value: Any, info: Any) -> Any:
    """Refuse a boolean or a text where a field needs a number; a validator of pydantic models.

    Args:
        model: class of the table.
        value: of one of its keys, as it is in the file.
        info: with the name of the field.
    Returns:
        The value.
    Raises:
        ValueError: the value is or holds a boolean or a text, and the field only takes numbers.
    """
    annotation = model.model_fields[info.field_name].annotation
    kinds, is_table = set(_leaves(annotation)), "dict[" in str(annotation)
    if not kinds & {int, float}:
        return value
    for name, part in _parts(value, str(info.field_name) if is_table else "Input"):
        estimate = not is_table and isinstance(value, Mapping)  # with the text of its unit
        wrong = "true or false" if isinstance(part, bool) and bool not in kinds else ""
        if isinstance(part, str) and kinds <= {int, float, NoneType} and not estimate:
            wrong = "a text"
        if wrong:
            raise ValueError(f"{name} should be a number, not {wrong}")
    return value


def switches_only(*names: str) -> Callable[[Mapping[str, object]], Mapping[str, object]]:
    """Make a validator for a table of numbers in which only some keys may be true or false.

    Args:
        names: of these keys.
    Returns:
        The validator; it raises `ValueError`.
    """

    def check(table: Mapping[str, object]) -> Mapping[str, object]:
        for name, value in table.items():
            if isinstance(value, bool) and name not in names:
                raise ValueError(f"{name} should be a number, not true or false")
        return table

    return check


def _leaves(annotation: Any) -> Iterator[Any]:
    """The types that an annotation is made of, without containers."""
    origin = typing.get_origin(annotation)
    parts = [part for part in typing.get_args(annotation) if part is not Ellipsis]
    if origin is typing.Annotated:
        parts = parts[:1]  # without its metadata
    elif origin is dict:
        parts = parts[1:]  # without its keys
    elif origin is typing.Literal:
        parts = [type(part) for part in parts]
    if not parts:
        yield annotation
    for part in parts:
        yield from _leaves(part)


def _parts(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """The values in nested lists and tables, with the names of their keys."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _parts(part, f"{name}.{key}")
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from _parts(part, name)
    else:
        yield name, value
