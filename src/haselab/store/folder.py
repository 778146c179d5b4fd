"""Small files of a run's folder, each whole or not there at all."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

from haselab.base import DeviceError, to_plain
from haselab.store.claim import create_exclusively
from haselab.store.text_file import parse_json, read_text

__all__ = ["read_json", "write_json", "write_new", "write_text"]


def write_text(path: Path, text: str) -> None:
    """Write a text file; an older one is replaced at the end, in one step.

    Raises:
        DeviceError: the disk refuses.
    """
    draft = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(text, encoding="utf-8")
        draft.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise DeviceError(
            f"Cannot write ({error.strerror}); free disk space or choose another folder. {path}"
        ) from None


def write_new(path: Path, text: str) -> None:
    """Write a text file that did not exist before.

    Raises:
        InputError: it exists; nothing in it was changed.
        DeviceError: the disk refuses.
    """
    create_exclusively(path)
    write_text(path, text)


def write_json(path: Path, data: Any) -> None:
    """Write a JSON file of estimates, arrays and plain values."""
    write_text(path, json.dumps(to_plain(data), indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        InputError: no such file, not a regular one, or not JSON.
    """
    return parse_json(read_text(path), path)
