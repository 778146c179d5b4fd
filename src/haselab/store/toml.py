"""TOML files checked by a pydantic model: all faults at once, each with its path in the file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from haselab.base import InputError

__all__ = ["read_toml", "validated"]

Model = TypeVar("Model", bound=BaseModel)


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """The tables of a TOML file.

    Args:
        path: of the file.
        what: the file is, for the message: "twin file".
    Returns:
        Its content.
    Raises:
        InputError: no such file, or no TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"No such {what}; give a TOML file that exists. {path}") from None
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"Not a TOML file that can be read: {error}. {path}") from None


def validated(model: type[Model], data: dict[str, Any], source: object) -> Model:
    """The data as a model.

    Args:
        model: class that checks them.
        data: as `read_toml` gives them.
        source: where they come from, for the message.
    Returns:
        The checked model.
    Raises:
        InputError: unknown keys or values out of range, every one with its path.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        faults = "; ".join(
            f"{'.'.join(str(part) for part in fault['loc']) or 'file'}: {fault['msg']}"
            f"{_got(fault['input'])}"
            for fault in error.errors()
        )
        count = error.error_count()
    raise InputError(f"{count} fault(s): {faults}. Correct them. {source}")


def _got(value: object) -> str:
    """What stood there, where it is one value and not a whole table."""
    return "" if isinstance(value, (dict, list)) else f" (got {value!r})"
