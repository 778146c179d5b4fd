"""Repair a recording whose writer was killed, with every block that was recorded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from haselab.base import DeviceError, InputError
from haselab.store.manifest import MANIFEST, changed_files, read_manifest, seal
from haselab.store.session.checksums import event_check
from haselab.store.session.layout import BLOCK_ORDER, HDF5_ERRORS, whole_rows
from haselab.store.session.lock import hold, is_held
from haselab.store.session.reader import SessionReader
from haselab.store.session.seal import is_sealed, write_seal
from haselab.store.session.superblock import is_marked_open, mark_closed
from haselab.store.session.tail import TailReader
from haselab.store.video.raw import transcode, waiting_videos

__all__ = ["Recovery", "recover"]


@dataclass(frozen=True)
class Recovery:
    """Summary of a recovery.

    Args:
        state: of the manifest after the recovery.
        blocks: of each experiment.
        blocks_from_ring_buffer: how many of all blocks came from the ring buffer (`tail`).
        writer_mark_cleared: the mark of a writer was removed.
        changed_files: files that were changed after sealing.
        videos_encoded: videos made from raw frames that were left.
    """

    state: str
    blocks: dict[str, int]
    blocks_from_ring_buffer: int
    writer_mark_cleared: bool
    changed_files: list[str]
    videos_encoded: int


def recover(folder: Path) -> Recovery:
    """Repair the recording of a killed writer, verify it, and update the manifest.

    A complete, sealed recording is not changed. Nothing is written before the whole file has been
    read.

    Args:
        folder: of the recording, or its session.h5.
    Returns:
        A summary.
    Raises:
        InputError: no session, or an unreadable one.
        DeviceError: it is still being written, or a file cannot be written.
    """
    if folder.is_file():
        if folder.name != "session.h5":
            raise InputError(
                "recover takes the folder of a run or its session.h5. Copy this file into a folder "
                f"of its own, as session.h5. {folder}"
            )
        folder = folder.parent
    path = folder / "session.h5"
    if is_held(path):
        raise _still_written(path)
    counts = _verified(path)
    known = (folder / MANIFEST).exists()
    manifest = read_manifest(folder) if known else {"state": "OPEN"}
    try:
        sealed = is_sealed(path)
        if sealed and manifest["state"] != "OPEN":
            changed = changed_files(folder, manifest)
            return Recovery(str(manifest["state"]), counts, 0, False, changed, 0)
        marked = is_marked_open(path)
        late = 0 if sealed else _mend(path)
    except HDF5_ERRORS as error:
        if isinstance(error, DeviceError):
            raise
        line = str(error).partition("\n")[0]
        raise DeviceError(
            f"The session cannot be repaired ({line}). The recording can still be read. Free disk "
            f"space, or copy it elsewhere and recover it there. {path}"
        ) from None
    counts = _verified(path)
    tried = [transcode(raw) for raw in waiting_videos(folder / "video")]
    videos = [video for video in tried if video.exists()]
    if sealed and not known:  # its writer closed it; how the run ended is not in the file
        seal(folder, "SEALED", {"ended": "unknown: the manifest was missing"})
        return Recovery("SEALED", counts, 0, False, [], len(videos))
    details = {"recovered_blocks": late, "ended": manifest.get("ended", "not closed by its writer")}
    seal(folder, "RECOVERED", details)
    return Recovery("RECOVERED", counts, late, marked, [], len(videos))


def _still_written(path: Path) -> DeviceError:
    return DeviceError(
        f"The session is still being written. End the program that records it. {path}"
    )


def _mend(path: Path) -> int:
    """Close and seal the file of a killed writer; return how many blocks came from its tail.

    This is the only place where an existing session is opened for writing.
    """
    with path.open("r+b", buffering=0) as raw:
        try:
            hold(raw.fileno())
        except OSError:
            raise _still_written(path) from None
        if is_marked_open(path):
            mark_closed(path)
        late = _take_tail(path)
        write_seal(raw)
    return late


def _verified(path: Path) -> dict[str, int]:
    """Read all blocks, and return their number for each experiment."""
    counts = {}
    with SessionReader(path) as session:
        session.events()
        for name in session.names:
            record = session.experiment(name)
            if not np.all(np.isfinite(record.block_start_s)):
                raise InputError(f"Blocks of {name!r} have no time. Record again. {path}")
            counts[name] = len(record.codes)
    return counts


def _take_tail(path: Path) -> int:
    """Move the blocks in the tail to their datasets."""
    taken, last_s = 0, 0.0
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        tail = TailReader(file, path)
        for group in file["experiments"].values():
            if "number" not in group.attrs:
                continue
            count = whole_rows(group, BLOCK_ORDER)
            late = tail.rows(int(group.attrs["number"]), count)
            table = np.empty(late.size, group["blocks"].dtype)
            for name in table.dtype.names or ():
                table[name] = late[name]
            # Cut first: a writer that was killed between two datasets leaves them unequal.
            columns: dict[str, Any] = {"blocks": table, "start_s": table["start_s"]}
            columns["codes"] = late["codes"] if late.size else None
            for name, rows in columns.items():
                group[name].resize(count + late.size, axis=0)
                if late.size:
                    group[name][count:] = rows
            taken += late.size
            last_s = max([last_s, *table["start_s"].tolist()])
        tail.close()
        events = file["events"]
        count = _written_events(events)
        text = f"recovered; {taken} blocks from the tail".encode()
        row = (last_s, text, event_check(count, last_s, text))
        events.resize(count + 1, axis=0)
        events[-1] = np.array(row[: len(events.dtype)], events.dtype)
    return taken


def _written_events(events: h5py.Dataset) -> int:
    """Number of events, without one that was only partly written."""
    rows = events[:]
    return len(rows) - bool(len(rows) and not rows[-1].tobytes().strip(b"\0"))
