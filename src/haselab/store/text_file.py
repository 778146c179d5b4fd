"""Small text files, bounded in size: settings, models, headers, tables of points."""

from __future__ import annotations

import json
import re
import stat
import tomllib
from pathlib import Path
from typing import Any

from haselab.base import InputError, JsonObject

__all__ = ["check_regular", "decode_json", "parse_json", "parse_toml", "read_text"]

# The parser's time grows with the square of the parts of a dotted key: 20,000 take a minute.
_DOTTED = re.compile(r"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){64}")
_MOST_BYTES = 64 << 20
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")  # one alone is no character
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def check_regular(path: Path, what: str = "file") -> int:
    """Refuse a path that is not a regular file: reading a pipe or a device may never end.

    Args:
        path: of the file.
        what: kind of file for the message, such as "twin file".
    Returns:
        The size of the file, in bytes.
    Raises:
        InputError: no such file, or not a regular one.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        raise InputError(f"No such {what}. Give the name of one that exists: {path}") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a name of a file"
        raise InputError(f"The file cannot be read ({reason}). Check the name: {path}") from None
    kind = _KINDS.get(stat.S_IFMT(status.st_mode))
    if kind is not None:
        raise InputError(f"The path is {kind}. Name a regular file: {path}")
    return status.st_size


def read_text(path: Path, what: str = "file") -> str:
    """Read a text file in UTF-8, with or without a byte order mark.

    Args:
        path: of the file, 64 MiB at most.
        what: kind of file for the message.
    Raises:
        InputError: no such file, not a regular one, too large, or not UTF-8.
    """
    size = check_regular(path, what)
    if size > _MOST_BYTES:
        raise InputError(
            f"The file has {size} bytes, more than the {_MOST_BYTES} of a text file. Check the "
            f"name: {path}"
        )
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(
            f"The file cannot be read ({error.strerror}). Check its permissions: {path}"
        ) from None
    except UnicodeDecodeError as error:
        raise InputError(
            f"The file is not a text in UTF-8 (byte {error.start}). Save it as UTF-8: {path}"
        ) from None


def decode_json(text: str) -> Any:
    """Parse a JSON document of values that can all be written again.

    Raises:
        ValueError: not JSON, an integer of thousands of digits, or half of a character.
        RecursionError: nested too deeply.
    """
    content = json.loads(text)
    if _SURROGATE.search(text):
        json.dumps(content, ensure_ascii=False).encode()
    return content


def parse_json(text: str, path: Path) -> Any:
    """Parse a JSON document.

    Args:
        text: of the document.
        path: of its file, for the message.
    Raises:
        InputError: not JSON, nested too deeply, an integer of thousands of digits, or half of a
            character.
    """
    try:
        return decode_json(text)
    except json.JSONDecodeError as error:
        why = f"line {error.lineno}: {error.msg}"
    except RecursionError:
        why = "it is nested too deeply"
    except UnicodeEncodeError as error:
        why = f"half of a character, {error.object[error.start]!a}"
    except ValueError:
        why = "a number has too many digits"
    raise InputError(f"{path.name} is not a JSON document ({why}). Write it again: {path}")


def parse_toml(text: str) -> JsonObject:
    """Parse a TOML text, in a time proportional to its length.

    Raises:
        ValueError: not TOML, or a key of more than 64 parts.
        RecursionError: nested too deeply.
    """
    if found := _DOTTED.search(text):
        raise ValueError(f"a key of more than 64 parts, {found[0][:20]!r} ...")
    return tomllib.loads(text)
