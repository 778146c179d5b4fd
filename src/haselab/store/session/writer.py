"""Write a session file: raw blocks, tracks, events, configuration; readable meanwhile."""

from __future__ import annotations

import io
import math
import os
import shutil
import sys
import zlib
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, InputError, JsonObject
from haselab.store.session.checksums import (
    STATIC,
    condition_check,
    event_check,
    frame_checks,
    static_digest,
)
from haselab.store.session.growing import GrowingDataset
from haselab.store.session.layout import (
    BLOCK,
    CONDITION,
    EVENT,
    FRAME,
    HDF5_ERRORS,
    TRACK,
    ExperimentPlan,
    ExperimentRecord,
    Sampling,
    create_experiment,
    create_root,
    read_conditions,
    read_events,
    read_experiment,
    settings_text,
)
from haselab.store.session.lock import hold
from haselab.store.session.queue import JobQueue, QueueRule
from haselab.store.session.reader import SessionReader
from haselab.store.session.seal import write_seal
from haselab.store.session.tail import TailReader, TailWriter, create_tail

if sys.platform != "win32":
    import resource

__all__ = ["ExperimentPlan", "ExperimentRecord", "QueueRule", "SessionReader", "SessionWriter"]

_RESERVE_BYTES = 8_000_000  # kept free, so that the file can be finished
# A kill may cut a write between two pages of the system's cache. HDF5 keeps its own records, which
# have checksums, and the slots' numbers within such pages, so that they are written or not.
_PAGE_BYTES = 4096
_SPARE_CHUNKS = 3  # of the tail, beside those that wait: one is filled, one packed, one torn


def _first_line(error: BaseException) -> str:
    return str(error).partition("\n")[0] or type(error).__name__


def _size_limit() -> int:
    """The largest file that this process may write, in bytes."""
    if sys.platform == "win32":
        return sys.maxsize
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return sys.maxsize if limit == resource.RLIM_INFINITY else limit


def _packed(codes: NDArray[np.int16]) -> bytes:
    """Compress a chunk like HDF5's shuffle and gzip; zlib lets other threads run meanwhile."""
    planes = codes.reshape(-1).view(np.uint8).reshape(-1, codes.itemsize).T
    deflate = zlib.compressobj(1, memLevel=9)  # more memory is faster
    return deflate.compress(planes.tobytes()) + deflate.flush()


class _Pending:
    """Blocks of the chunk that is being filled, and the number of rows before it."""

    def __init__(self) -> None:
        self.first = 0
        self.codes: list[NDArray[np.int16]] = []
        self.rows: list[tuple[float, float, float, int]] = []


class SessionWriter:
    """Writes a session. A block is in the file when `append_block` returns.

    A background thread compresses blocks of 0.1 s and writes tracks and events. Its errors are
    raised by the next call, at the latest by `flush` or `close`.

    Args:
        path: of the new file; an existing one is refused and not changed.
        plans: all experiments that may be recorded.
        block_samples: samples per channel in one block.
        header: configuration, versions and hashes as JSON types; scale and rate of the codes
            come from its `rig`.
        queue: limits for data that wait for the disk; on a rig in real time with a patience of 0.
    Raises:
        InputError: the file exists, or an experiment's name cannot be a file name.
        DeviceError: the file cannot be written, for example because the disk is full.
    Example:
        >>> import tempfile
        >>> folder = tempfile.TemporaryDirectory()
        >>> path = Path(folder.name) / "session.h5"
        >>> with SessionWriter(path, [ExperimentPlan("a", "play", 1, {})], 20, {}) as session:
        ...     session.append_block("a", np.zeros((20, 2), np.int16), 0.0, 1.5, float("nan"))
        >>> with SessionReader(path) as session:
        ...     session.experiment("a").drive_v
        array([1.5])
        >>> folder.cleanup()
    """

    def __init__(
        self, path: Path, plans: list[ExperimentPlan], block_samples: int, header: JsonObject,
        queue: QueueRule | None = None,
    ) -> None:  # fmt: skip
        self._path = path
        self._queue = queue or QueueRule()
        self._sampling = Sampling.of_header(block_samples, header)
        # From 1: a slot of the tail that was never written holds 0.
        self._numbers = {plan.name: k for k, plan in enumerate(plans, 1)}
        self._pending = {plan.name: _Pending() for plan in plans}
        self._current = ""
        self._failure: DeviceError | None = None
        self._opened = False
        self._datasets: dict[str, GrowingDataset] = {}
        texts = [self._text(plan.name, plan.settings) for plan in plans]
        with ExitStack() as undo:
            raw = self._claimed(path)
            undo.callback(raw.close)
            try:
                # v110: readable by HDF5 1.10 and later, and by others while it is being written.
                # The file is empty and belongs to this process: "w" deletes nothing.
                self._file = h5py.File(
                    path, "w", libver=("v110", "v110"), fs_strategy="page", fs_page_size=_PAGE_BYTES
                )
            except OSError as error:
                raise self._failed(error) from None
            undo.callback(self._file.close)
            self._check_room()
            self._create(plans, texts, header)
            self._tail = TailWriter(self._file, raw)
            self._file.swmr_mode = True
            self._read_tail = TailReader(self._file, path)
            self._synced_s = self._queue.clock_s()
            self._jobs = JobQueue(self._queue, self._behind)
            self._opened = True
            undo.pop_all()

    def _claimed(self, path: Path) -> io.FileIO:
        """Create and lock the new file."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._failed(error) from None
        try:
            raw = io.FileIO(path, "x+")
        except FileExistsError:
            raise InputError(
                f"The folder has a session already; it was not changed. Name another folder. {path}"
            ) from None
        except OSError as error:
            raise self._failed(error) from None
        try:
            hold(raw.fileno())
        except OSError as error:
            raw.close()
            raise self._failed(error) from None
        return raw

    def _create(
        self, plans: list[ExperimentPlan], texts: list[bytes], header: dict[str, Any]
    ) -> None:
        create_root(self._file, plans, header)
        for plan, text in zip(plans, texts, strict=True):
            number = self._numbers[plan.name]
            create_experiment(self._file, number, plan, self._sampling, text)
        slots = (self._queue.chunks + _SPARE_CHUNKS) * self._sampling.chunk_blocks
        create_tail(self._file, slots, self._sampling.block_samples)
        self._file.attrs[STATIC] = np.bytes_(static_digest(self._file))
        self._file.flush()

    # ---- errors -----------------------------------------------------------------------------

    def _failed(self, error: BaseException) -> DeviceError:
        if isinstance(error, DeviceError):
            return error
        if self._opened and self._is_gone():
            return DeviceError(
                "The session file is no longer there: it was deleted or moved, or its disk was "
                f"removed. A deleted file cannot be recovered. {self._path}"
            )
        return DeviceError(
            f"The session file cannot be written ({_first_line(error)}). The data written so far "
            f"are kept. Free disk space, or choose another folder. {self._path}"
        )

    def _is_gone(self) -> bool:
        try:
            self._path.stat()
        except FileNotFoundError:
            return True
        except OSError:
            return False
        return False

    def _behind(self) -> DeviceError:
        rule = self._queue
        after = f", after waiting for {rule.patience_s:g} s" if rule.patience_s else ""
        return DeviceError(
            f"The disk is too slow: {0.1 * rule.chunks:g} s of data wait to be written{after}. "
            f"The data recorded so far are kept. Use a faster disk. {self._path}"
        )

    def _text(self, name: str, settings: dict[str, Any]) -> bytes:
        try:
            return settings_text(name, settings)
        except InputError as error:
            raise InputError(f"{error} {self._path}") from None

    def _check_room(self) -> None:
        """Stop while HDF5 can still finish the file, which it cannot after a failed write."""
        try:
            free = shutil.disk_usage(self._path.parent).free
            free = min(free, _size_limit() - self._path.stat().st_size)
        except OSError as error:  # the folder or its drive is gone
            raise self._failed(error) from None
        if free < _RESERVE_BYTES:
            raise DeviceError(
                f"The disk is full: {math.floor(free / 1e5) / 10:g} MB are left, "
                f"{_RESERVE_BYTES / 1e6:.0f} MB are needed. The recorded data are kept. Free disk "
                f"space, or choose another folder. {self._path}"
            )

    def _put(self, job: Callable[[], None], *, always: bool = False) -> None:
        """Queue a job; after a failure only jobs with `always` run."""

        def guarded() -> None:
            try:
                job()
            except HDF5_ERRORS as error:
                failure = self._failed(error)
                if not always:
                    self._failure = failure
                raise failure from None

        if self._failure is not None and not always:
            raise self._failure
        self._jobs.put(guarded, always=always)

    # ---- what comes in ----------------------------------------------------------------------

    def append_block(
        self, name: str, codes: NDArray[np.int16], start_s: float, drive_v: float, reference: float
    ) -> None:
        """Add one block.

        Raises:
            DeviceError: the disk fails, or is too slow.
        """
        if self._failure is not None:
            raise self._failure
        if name != self._current:
            self._hand_over(self._current)
            self._current = name
        wanted = (self._sampling.block_samples, 2)
        if getattr(codes, "dtype", None) != np.int16 or codes.shape != wanted:
            raise DeviceError(
                f"A block has shape {getattr(codes, 'shape', None)} and type "
                f"{getattr(codes, 'dtype', type(codes).__name__)}, but the session takes {wanted}, "
                f"int16. Check the driver of the acquisition. {self._path}"
            )
        codes = codes.copy()  # the thread writes later; the acquisition may reuse its array
        pending = self._pending[name]
        row = pending.first + len(pending.codes)
        try:
            check = self._tail.append(self._numbers[name], row, drive_v, reference, start_s, codes)
        except OSError as error:
            raise self._failed(error) from None
        pending.codes.append(codes)
        pending.rows.append((drive_v, reference, start_s, check))
        if (row + 1) % self._sampling.chunk_blocks == 0:
            self._hand_over(name)

    def _hand_over(self, name: str) -> None:
        pending = self._pending.get(name)
        if pending is None or not pending.codes:
            return
        first, codes, rows = pending.first, pending.codes, pending.rows
        try:
            self._check_room()
        except DeviceError as error:
            self._failure = error  # these blocks stay in the tail, which later ones must not take
            raise
        self._put(lambda: self._write_blocks(name, first, codes, rows))
        pending.first, pending.codes, pending.rows = first + len(codes), [], []

    def flush(self, name: str) -> None:
        """Write the pending data of one experiment, and wait.

        Raises:
            DeviceError: this or an earlier write failed.
        """
        self._drain()  # wait here for a full queue, also in real time
        self._hand_over(name)
        self._drain()

    def _drain(self) -> None:
        self._jobs.drain()
        if self._failure is not None:
            raise self._failure

    def append_frames(
        self,
        name: str,
        time_s: NDArray[np.float64],
        tracks: NDArray[np.void],
        mass_kg: float,
    ) -> None:
        """Add the tracks of frames: `time_s` `(F,)`, `tracks` `(F, P)` of `track_dtype()`.

        Raises:
            DeviceError: the disk is full, or an earlier write failed.
        """
        frames = np.empty(time_s.size, dtype=FRAME)
        frames["time_s"], frames["mass_kg"] = time_s, mass_kg
        self._check_room()
        self._put(lambda: self._write_frames(name, frames, tracks.copy()))

    @staticmethod
    def track_dtype() -> np.dtype[np.void]:
        """Fields of one tracked point."""
        return TRACK

    def complete_settings(self, name: str, settings: JsonObject) -> None:
        """Replace the settings of an experiment by those that were really used."""
        text = self._text(name, settings)

        def replace() -> None:
            self._file[f"experiments/{name}/settings"][()] = text

        self._put(replace)

    def event(self, time_s: float, what: str) -> None:
        """Record an event, even after blocks could no longer be written.

        It is in the file when this method returns, unless the rig is in real time.
        """
        text = what.encode()[: EVENT["what"].itemsize]

        def write() -> None:
            count = len(self._growing("events"))
            row = (time_s, text, event_check(count, time_s, text.rstrip(b"\0")))
            self._growing("events").extend(np.array([row], EVENT))

        self._put(write, always=True)
        if self._queue.patience_s > 0.0:
            self._jobs.settle()

    def condition(
        self, time_s: float, drive_v: float, carrier_v: float, pull_n: float, mass_kg: float
    ) -> None:
        """Record what acts on the actuator from a time on, outside the blocks.

        Args:
            time_s: on the clock of the acquisition.
            drive_v: before the amplifier.
            carrier_v: peak amplitude before the amplifier.
            pull_n: load at the moving end.
            mass_kg: that moves with it, hung or lifted.
        """
        values = time_s, drive_v, carrier_v, pull_n, mass_kg

        def write() -> None:
            count = len(self._growing("conditions"))
            row = (*values, condition_check(count, values))
            self._growing("conditions").extend(np.array([row], CONDITION))

        self._put(write, always=True)

    # ---- in the thread ----------------------------------------------------------------------

    def _growing(self, dataset: str) -> GrowingDataset:
        found = self._datasets.get(dataset)
        if found is None:
            found = self._datasets[dataset] = GrowingDataset(self._file[dataset])
        return found

    def _write_blocks(
        self, name: str, first: int, codes: list[NDArray[np.int16]],
        rows: list[tuple[float, float, float, int]],
    ) -> None:  # fmt: skip
        group = f"experiments/{name}"
        whole = np.stack(codes)
        if first % self._sampling.chunk_blocks or len(whole) < self._sampling.chunk_blocks:
            self._growing(f"{group}/codes").extend(whole)
        else:
            self._growing(f"{group}/codes").extend_packed(len(whole), _packed(whole))
        table = np.array(rows, dtype=BLOCK)
        self._growing(f"{group}/blocks").extend(table)
        self._growing(f"{group}/start_s").extend(table["start_s"])
        now_s = self._queue.clock_s()
        if now_s - self._synced_s >= self._queue.sync_s:
            self._synced_s = now_s
            getattr(os, "fdatasync", os.fsync)(self._tail.raw.fileno())

    def _write_frames(self, name: str, frames: NDArray[np.void], tracks: NDArray[np.void]) -> None:
        group = f"experiments/{name}"
        first = len(self._growing(f"{group}/frames"))
        frames["check"] = frame_checks(
            self._numbers[name], first, frames["time_s"], frames["mass_kg"], tracks
        )
        self._growing(f"{group}/tracks").extend(tracks)
        self._growing(f"{group}/frames").extend(frames)
        self._growing(f"{group}/frame_s").extend(frames["time_s"])

    # ---- what was recorded ------------------------------------------------------------------

    def experiment(self, name: str) -> ExperimentRecord:
        """Read all data of one experiment so far from the file."""
        self._drain()
        return read_experiment(self._file, name, self._read_tail)

    def events(self) -> list[tuple[float, str]]:
        """Time in s and text of each event so far."""
        self._drain()
        return read_events(self._file)

    def conditions(self) -> NDArray[np.void]:
        """See `SessionReader.conditions`."""
        self._drain()
        return read_conditions(self._file)

    @property
    def most_waiting(self) -> int:
        """Largest number of jobs that have waited for the disk at once."""
        return self._jobs.most_waiting

    def close(self) -> None:
        """Write all pending data, close and seal the file; safe to call twice.

        Raises:
            DeviceError: pending data cannot be written.
        """
        if not self._file:
            return
        with ExitStack() as end:
            end.callback(self._tail.close)  # last: with it goes the lock
            end.callback(self._close_file)
            end.callback(self._read_tail.close)
            end.callback(self._jobs.close)
            self._jobs.drain()
            for name in self._pending:
                if self._failure is None:
                    self._hand_over(name)

    def _close_file(self) -> None:
        try:
            self._file.close()
            write_seal(self._tail.raw)
        except HDF5_ERRORS as error:
            raise self._failed(error) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except DeviceError:
            if error is None:
                raise
