"""Read a whole session file and compare all its checksums, in a process with limits.

With changed metadata HDF5 may compute for ever, or request all memory. Here only this process ends.
The last line of its output is `whole`, `unchecked WHY`, `changed WHY` or `damaged WHY`. Even in a
changed file everything is tried, so that it can be read on request.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from haselab.store.session.checksums import (
    STATIC,
    check_links,
    compare,
    condition_check,
    event_check,
    frame_checks,
    static_digest,
)
from haselab.store.session.layout import (
    BLOCK_ORDER,
    FORMAT,
    FORMATS,
    FRAME_ORDER,
    HDF5_ERRORS,
    read_conditions,
    settings_of,
    whole_rows,
)
from haselab.store.session.opening import open_unsealed
from haselab.store.session.tail import TailReader, block_checks

__all__ = ["main", "verify"]

_MEMORY_BYTES = 1 << 30  # in addition to the interpreter's
_CPU_S, _CPU_S_PER_BYTE = 5, 1e-7
_CHUNK_ROWS = 200


def _limit(size: int) -> None:
    """Limit the time and the memory of this process, if the system supports it."""
    if sys.platform == "win32":
        return
    import resource

    pages = 0
    status = Path("/proc/self/statm")
    if status.exists():
        pages = int(status.read_text().split()[0])
    limit = pages * resource.getpagesize() + _MEMORY_BYTES
    if pages:
        _lower(resource.RLIMIT_AS, limit)
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = int(used.ru_utime + used.ru_stime + _CPU_S + _CPU_S_PER_BYTE * size) + 1
    _lower(resource.RLIMIT_CPU, seconds)
    _lower(resource.RLIMIT_CORE, 0)


def _lower(kind: int, limit: int) -> None:
    """Set a limit, unless a lower one is already set."""
    if sys.platform != "win32":
        import resource

        hard = resource.getrlimit(kind)[1]
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (limit, hard))


def _verify_blocks(name: str, group: h5py.Group, tail: TailReader) -> None:
    number, count = int(group.attrs["number"]), whole_rows(group, BLOCK_ORDER)
    for first in range(0, count, _CHUNK_ROWS):
        until = min(count, first + _CHUNK_ROWS)
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
    for first in range(0, count, _CHUNK_ROWS):
        until = min(count, first + _CHUNK_ROWS)
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


def _verify_conditions(file: h5py.File) -> None:
    for k, row in enumerate(read_conditions(file)):
        *values, stated = row.tolist()
        if condition_check(k, values) != stated:
            raise ValueError(f"condition {k} does not match its checksum")


def _read_all(group: h5py.Group) -> None:
    """Read every dataset of an experiment of format 1, whose rows carry no checksum."""
    for data in group.values():
        for first in range(0, data.shape[0] if data.shape else 0, _CHUNK_ROWS):
            data[first : first + _CHUNK_ROWS]


def _verify_settings(name: str, group: h5py.Group) -> None:
    if not settings_of(group)[1]:
        raise ValueError(f"the settings of {name!r} do not match their checksum")


def _verify_static(file: h5py.File) -> None:
    if static_digest(file) != bytes(file.attrs[STATIC]).decode():
        raise ValueError("header, attributes or scales do not match their checksum")


class _Problems:
    """Collects problems; the rest of the file is still read."""

    def __init__(self) -> None:
        self.found: list[str] = []

    def attempt(self, check: Callable[..., None], *arguments: Any) -> None:
        """Make one check.

        Raises:
            MemoryError: the check needs more memory than a session can.
        """
        try:
            check(*arguments)
        except HDF5_ERRORS as error:
            text = str(error).partition("\n")[0] or type(error).__name__
            if "alloc" in str(error):
                raise MemoryError(text) from None
            self.found.append(text)


def verify(path: Path) -> tuple[str, list[str]]:
    """Read a whole session file that no program writes, and compare its checksums.

    Args:
        path: of the file.
    Returns:
        Why it could not be verified, empty if it could; and what does not match.
    Raises:
        ValueError: no session, or one with links; HDF5 raises others.
    """
    problems = _Problems()
    with open_unsealed(path) as file:
        check_links(file)
        kind = str(file.attrs["format"])
        if kind not in FORMATS:
            raise KeyError("format")
        tail = TailReader(file, path)
        experiments = file["experiments"].items()
        if kind != FORMAT:
            for _, group in experiments:
                problems.attempt(_read_all, group)
            return f"{kind} has no checksums", problems.found
        problems.attempt(_verify_static, file)
        problems.attempt(tail.verify)
        for name, group in experiments:
            problems.attempt(_verify_settings, name, group)
            problems.attempt(_verify_blocks, name, group, tail)
            problems.attempt(_verify_frames, name, group)
        problems.attempt(_verify_events, file)
        problems.attempt(_verify_conditions, file)
        tail.close()
    return "", problems.found


def main(path: Path) -> str:
    """Return the last line of the output, see above."""
    _limit(path.stat().st_size)
    try:
        doubt, problems = verify(path)
    except (*HDF5_ERRORS, MemoryError, TypeError, AttributeError) as error:
        return f"damaged {str(error).partition(chr(10))[0] or type(error).__name__}"
    if problems:
        return f"changed {problems[0]}"
    return f"unchecked {doubt}" if doubt else "whole"


if __name__ == "__main__":
    print(main(Path(sys.argv[1])))
