"""A lock that the writer of a session holds, and that the system releases when it ends."""

from __future__ import annotations

import contextlib
import struct
import sys
from pathlib import Path

__all__ = ["CAN_TELL", "hold", "is_held"]

CAN_TELL = sys.platform == "linux"  # whether `is_held` works

# A lock of the open file, not of the process: HDF5's own locks are of another kind, and a reader
# in the same process does not take it away. Linux has it.
_FLOCK = struct.Struct("hhqqixxxx")


def hold(descriptor: int) -> None:
    """Hold the lock until this descriptor is closed.

    Args:
        descriptor: of the session file, open for writing.
    Raises:
        OSError: another writer holds it.
    """
    if sys.platform == "linux":
        import fcntl

        lock = _FLOCK.pack(fcntl.F_WRLCK, 0, 0, 0, 0)
        fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, lock)


def is_held(path: Path) -> bool:
    """Whether a process still writes this session; False if the system does not report it.

    Args:
        path: of the session file.
    """
    if sys.platform == "linux" and path.is_file():  # a named pipe would wait for its writer
        import fcntl

        with contextlib.suppress(OSError), path.open("rb") as file:
            lock = _FLOCK.pack(fcntl.F_WRLCK, 0, 0, 0, 0)
            found = fcntl.fcntl(file.fileno(), fcntl.F_OFD_GETLK, lock)
            return bool(_FLOCK.unpack(found)[0] != fcntl.F_UNLCK)
    return False
