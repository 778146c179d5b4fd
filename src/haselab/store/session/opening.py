"""Open a session file safely: depending on its state, and so that HDF5 cannot hang.

| file | how it is checked | how it is opened |
|---|---|---|
| sealed | SHA-256 of the whole file, before HDF5 sees it | as it is |
| a program writes it | each block and frame as it is read | in SWMR mode |
| killed, format 1, `unverified` | read in full by a child with limits | as if it had been closed |
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import h5py

from haselab.store.session.lock import CAN_TELL, is_held
from haselab.store.session.seal import is_sealed
from haselab.store.session.superblock import closed_superblock, is_marked_open

__all__ = ["OpenedSession", "is_session", "open_session", "open_unsealed", "probed"]

_SIGN = b"haselab session"  # first attribute of the file, and in its seal
_HEAD_BYTES, _TAIL_BYTES = 1 << 16, 200
_PATIENCE_S = 60.0  # until a child that neither computes nor ends is given up
# What the child found in files that it has read, by their place, size and time of change.
_Key = tuple[int, int, int, int]
_KNOWN: dict[_Key, str] = {}


@dataclass(frozen=True)
class OpenedSession:
    """A session file, open.

    Args:
        file: of HDF5.
        live: a program still writes it.
        doubt: why its data are not verified; empty if they are.
    """

    file: h5py.File
    live: bool
    doubt: str


def is_session(path: Path) -> bool:
    """Whether a file is a session, perhaps a damaged one, from its first and last bytes.

    Args:
        path: of any file.
    """
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
        file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
        return _SIGN in file.read() or (head.startswith(b"\x89HDF") and _SIGN in head)


class _Closed(io.RawIOBase):
    """A view of a session file as if its writer had closed it; the file is not changed."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        try:
            self._head = closed_superblock(path)
        except ValueError:
            self._head = b""  # HDF5 reports what is wrong
        self._file = path.open("rb", buffering=0)
        self._size = path.stat().st_size

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Fill the buffer completely; HDF5 treats a short read as a full one."""
        place, view = self._file.tell(), memoryview(buffer).cast("B")
        if place + len(view) > self._size:
            raise OSError(f"truncated: {self._size} bytes of {place + len(view)}")
        left = view
        while left:
            got = self._file.readinto(left)
            if not got:
                raise OSError("truncated while it is read")
            left = left[got:]
        head = self._head[place : place + len(view)]
        view[: len(head)] = head
        return len(view)

    def close(self) -> None:
        if not self.closed:
            self._file.close()
        super().close()


def open_unsealed(path: Path) -> h5py.File:
    """Open a session file as if its writer had closed it; the file is not changed."""
    return h5py.File(_Closed(path), "r")


def open_session(path: Path, *, unverified: bool = False) -> OpenedSession:
    """Open a session file for reading.

    Args:
        path: of the file.
        unverified: continue, with a doubt, if a checksum does not match.
    Returns:
        The file and its state.
    Raises:
        ValueError: truncated or changed, or HDF5 could not read it within bounds.
        OSError: the system or HDF5 cannot open it.
    """
    if is_held(path) or (not CAN_TELL and _is_marked(path)):
        return OpenedSession(h5py.File(path, "r", libver="latest", swmr=True), True, "")
    doubt = ""
    try:
        if is_sealed(path):
            return OpenedSession(h5py.File(path, "r"), False, "")
    except ValueError as error:
        if not unverified:
            raise
        doubt = str(error)
    found = _read_in_child(path, unverified=unverified)
    return OpenedSession(open_unsealed(path), False, doubt or found)


def _is_marked(path: Path) -> bool:
    try:
        return is_marked_open(path)
    except ValueError:
        return False


def _read_in_child(path: Path, *, unverified: bool) -> str:
    """Read a file once in a separate process with limited time and memory.

    Returns:
        Why the numbers are not verified; empty when they are.
    Raises:
        ValueError: the child could not read it, or found a checksum that does not match.
    """
    status = path.stat()
    key = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
    if key not in _KNOWN:
        _KNOWN[key] = probed(path, _PATIENCE_S + 1e-7 * status.st_size)
    kind, _, text = _KNOWN[key].partition(" ")
    if kind not in ("whole", "unchecked", "changed"):
        raise ValueError(text or "HDF5 cannot read it within bounds of time and memory")
    if kind == "changed" and not unverified:
        raise ValueError(text)
    return text


def probed(path: Path, patience_s: float) -> str:
    """Check a file in a separate process, see `probe`; empty if that did not end.

    Args:
        path: of the file.
        patience_s: until a process that neither computes nor ends is given up.
    """
    command = [sys.executable, "-m", "haselab.store.session.probe", str(path)]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", check=False,
            stdin=subprocess.DEVNULL, timeout=patience_s,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return ""
    return (done.stdout.splitlines() or [""])[-1] if done.returncode == 0 else ""
