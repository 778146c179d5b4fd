"""The seal of a finished session file: a last line with the SHA-256 of all bytes before it.

HDF5 ignores bytes after its own data, so other programs can still open the file. A reader compares
the line with the file first, so that HDF5 never parses a changed file.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path
from typing import BinaryIO

from haselab.store.session.superblock import check_superblock

__all__ = ["ChangedError", "is_sealed", "write_seal"]

_FORM = "\nhaselab session: SHA-256 of the {:020d} bytes before this line is {}\n"
_LENGTH = len(_FORM.format(0, "0" * 64))
_SEAL = re.compile(
    _FORM.format(0, "x").replace("0" * 20, r"(\d{20})").replace("x", "([0-9a-f]{64})")
)
_CHUNK_BYTES = 1 << 20
# Files with a valid seal, by path, size and time of change: a command opens a file repeatedly.
_Key = tuple[int, int, int, int]
_KNOWN: set[_Key] = set()
_MOST_KNOWN = 1000


class ChangedError(ValueError):
    """A sealed file is complete, but at least one of its bytes was changed."""


def _digest(file: BinaryIO, size: int) -> str:
    """SHA-256 of the first bytes of a file."""
    digest = hashlib.sha256()
    file.seek(0)
    while size and (chunk := file.read(min(size, _CHUNK_BYTES))):
        digest.update(chunk)
        size -= len(chunk)
    return digest.hexdigest()


def write_seal(file: BinaryIO) -> None:
    """Append the line to a session file that HDF5 has closed.

    Args:
        file: open for reading and writing.
    Raises:
        OSError: the file cannot be written.
    """
    size = file.seek(0, os.SEEK_END)
    line = _FORM.format(size, _digest(file, size)).encode()
    file.seek(size)
    file.write(line)
    file.flush()


def is_sealed(path: Path) -> bool:
    """Whether a session file is finished; compares every byte of it.

    Args:
        path: of the session file, which no program writes.
    Returns:
        False: its writer was killed, or it was recorded before sessions had this line.
    Raises:
        ChangedError: changed.
        ValueError: truncated.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        status = os.fstat(file.fileno())
        key = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
        if key in _KNOWN:
            return True
        size = max(0, status.st_size - _LENGTH)
        file.seek(size)
        found = _SEAL.fullmatch(file.read().decode("latin1"))
        if found is None:
            check_superblock(path)
            return False
        if int(found[1]) != size:
            raise ValueError(f"{size} bytes of {int(found[1])}")
        if _digest(file, size) != found[2]:
            raise ChangedError("SHA-256 does not match")
    if len(_KNOWN) >= _MOST_KNOWN:
        _KNOWN.clear()
    _KNOWN.add(key)
    return True
