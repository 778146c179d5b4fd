"""Write and read small files of a run's folder atomically."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from haselab.base import to_plain
from haselab.store.claim import create_exclusively, not_written
from haselab.store.text_file import parse_json, read_text

__all__ = [
    "drafted",
    "json_text",
    "read_json",
    "write_bytes",
    "write_json",
    "write_new",
    "write_text",
]

_LONGEST_ENDING = 16
_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)


@contextlib.contextmanager
def drafted(path: Path) -> Iterator[Path]:
    """Write a file under a temporary name, and rename it when it is complete.

    Args:
        path: of the file; an older one is replaced at the end, in one step, by one with the same
            permissions. A link is replaced, not followed. A pipe or a device is written to, not
            replaced.
    Yields:
        An empty file of a random name in the same folder, made by this process, with the same
        ending. It is removed where the context ends by an error.
    Raises:
        OSError: the file cannot be written.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        yield path
        return
    draft = path.with_name(f".haselab-{secrets.token_hex(8)}{path.suffix[:_LONGEST_ENDING]}")
    os.close(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_WRONLY | _NO_LINK, 0o666))
    try:
        if path.is_file() and not path.is_symlink():
            draft.chmod(stat.S_IMODE(path.stat().st_mode))  # a private file stays private
        yield draft
        draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file; replace an older one atomically.

    Nothing else in the folder is touched. A link in the place of the file is replaced; a pipe or a
    device is written to.

    Raises:
        DeviceError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with drafted(path) as draft:
            draft.write_bytes(content)
    except OSError as error:
        raise not_written(path, error) from None


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8; see `write_bytes`."""
    write_bytes(path, text.encode("utf-8"))


def write_new(path: Path, text: str) -> None:
    """Write a text file that did not exist before, in one step.

    Raises:
        InputError: the file exists already; it is not changed.
        DeviceError: the file cannot be written.
    """
    create_exclusively(path, text.encode("utf-8"))
    if path.exists() and not path.is_file():  # a pipe or a device
        write_text(path, text)


def write_json(path: Path, data: Any) -> None:
    """Write a JSON file of estimates, arrays and plain values."""
    write_text(path, json_text(data))


def json_text(data: Any) -> str:
    """JSON of estimates, arrays and plain values."""
    return json.dumps(to_plain(data), indent=1, allow_nan=False) + "\n"


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        InputError: no such file, not a regular one, or not JSON.
    """
    return parse_json(read_text(path), path)
