"""Reads a session file in full and compares every checksum in it, in a process with limits.

HDF5 may compute for ever, or ask for all memory, on metadata that were changed. Here that ends this
process alone. The last line of its output is `whole`, `unchecked WHY` or `damaged WHY`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np

from haselab.store.session_checks import (
    STATIC,
    check_links,
    compare,
    event_check,
    frame_checks,
    static_digest,
)
from haselab.store.session_layout import (
    BLOCK_ORDER,
    FORMAT,
    FORMATS,
    FRAME_ORDER,
    HDF5_ERRORS,
    settings_of,
    whole_rows,
)
from haselab.store.session_open import open_unsealed
from haselab.store.session_tail import TailReader, block_checks

__all__ = ["main", "verify"]

_MEMORY_BYTES = 1 << 30  # beside what the interpreter takes
_CPU_S, _CPU_S_PER_BYTE = 5, 1e-7
_PIECE_ROWS = 200


def _limit(size: int) -> None:
    """Bound the time and the memory of this process; where the system can."""
    if sys.platform == "win32":
        return
    import resource

    pages = 0
    status = Path("/proc/self/statm")
    if status.exists():
        pages = int(status.read_text().split()[0])
    limit = pages * resource.getpagesize() + _MEMORY_BYTES
    if pages:
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = int(used.ru_utime + used.ru_stime + _CPU_S + _CPU_S_PER_BYTE * size) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _verify_blocks(name: str, group: h5py.Group, tail: TailReader) -> None:
    number, count = int(group.attrs["number"]), whole_rows(group, BLOCK_ORDER)
    for first in range(0, count, _PIECE_ROWS):
        until = min(count, first + _PIECE_ROWS)
        rows = group["blocks"][first:until]
        blocks = {field: rows[field] for field in ("drive_v", "reference", "start_s")}
        blocks["codes"] = group["codes"][first:until]
        compare(rows["check"], block_checks(number, first, blocks), first, f"block of {name!r},")
        start_s = group["start_s"][first:until]
        compare(rows["start_s"].view("u8"), start_s.view("u8"), first, f"start of {name!r},")
    newest = tail.newest(number)
    if newest >= count and count + tail.rows(number, count).size != newest + 1:
        raise ValueError(f"blocks of {name!r} are missing before block {newest}")


def _verify_frames(name: str, group: h5py.Group) -> None:
    number, count = int(group.attrs["number"]), whole_rows(group, FRAME_ORDER)
    for first in range(0, count, _PIECE_ROWS):
        until = min(count, first + _PIECE_ROWS)
        rows, tracks = group["frames"][first:until], group["tracks"][first:until]
        time_s = np.ascontiguousarray(rows["time_s"])
        found = frame_checks(number, first, time_s, rows["mass_kg"], tracks)
        compare(rows["check"], found, first, f"frame of {name!r},")
        compare(time_s.view("u8"), group["frame_s"][first:until].view("u8"), first,
              f"time of a frame of {name!r},")  # fmt: skip


def _verify_events(file: h5py.File) -> None:
    rows = file["events"][:]
    for k, row in enumerate(rows):
        if k == len(rows) - 1 and not row.tobytes().strip(b"\0"):
            return  # the writer was killed between making room for it and writing it
        if event_check(k, float(row["time_s"]), row["what"]) != row["check"]:
            raise ValueError(f"event {k} does not match its checksum")


def verify(path: Path) -> str:
    """Read a session file that nobody writes in full, and compare its checksums.

    Args:
        path: of the file.
    Returns:
        Why it could not be verified; empty when all is as it was recorded.
    Raises:
        ValueError: a checksum that does not match, or no session; HDF5 raises others.
    """
    with open_unsealed(path) as file:
        check_links(file)
        kind = str(file.attrs["format"])
        if kind not in FORMATS:
            raise KeyError("format")
        tail = TailReader(file, path)
        if kind != FORMAT:
            return f"{kind} has no checksums"
        stated = bytes(file.attrs[STATIC]).decode()
        if static_digest(file) != stated:
            raise ValueError("header, attributes or scales do not match their checksum")
        tail.verify()
        for name, group in file["experiments"].items():
            if not settings_of(group)[1]:
                raise ValueError(f"the settings of {name!r} do not match their checksum")
            _verify_blocks(name, group, tail)
            _verify_frames(name, group)
        _verify_events(file)
        tail.close()
    return ""


def main(path: Path) -> str:
    """What is to be said of a file: `whole`, `unchecked WHY` or `damaged WHY`."""
    _limit(path.stat().st_size)
    try:
        doubt = verify(path)
    except (*HDF5_ERRORS, MemoryError, TypeError, AttributeError) as error:
        return f"damaged {str(error).partition(chr(10))[0] or type(error).__name__}"
    return f"unchecked {doubt}" if doubt else "whole"


if __name__ == "__main__":
    print(main(Path(sys.argv[1])))
