"""TOML texts in bounded time."""

from __future__ import annotations

import re
import tomllib
from typing import Any

__all__ = ["parse_toml"]

# The parser's time grows with the square of the parts of a dotted key: 20,000 take a minute.
_DOTTED = re.compile(r"(?:[\w-]+[ \t]*\.[ \t]*){64}")


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML text, in a time that grows with its length alone.

    Raises:
        ValueError: no TOML, or a key of more than 64 parts.
        RecursionError: nested too deeply.
    """
    if found := _DOTTED.search(text):
        raise ValueError(f"a key of more than 64 parts, {found[0][:20]!r} ...")
    return tomllib.loads(text)
