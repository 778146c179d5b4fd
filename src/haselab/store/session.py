"""The session file: raw blocks, tracks, events and configuration, readable while it is written."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, InputError

if sys.platform != "win32":
    import resource

__all__ = ["ExperimentPlan", "ExperimentRecord", "SessionReader", "SessionWriter"]

_FORMAT = "haselab session 1"
_BLOCKS_PER_CHUNK = 10
_RESERVE_BYTES = 8_000_000  # left free, so that the file can be finished
_SETTINGS_BYTES = 65000
_HDF5_ERRORS = (OSError, RuntimeError, ValueError, KeyError)
_EVENT = np.dtype([("time_s", "f8"), ("what", "S96")])
_BLOCK = np.dtype([("drive_v", "f8"), ("reference", "f8"), ("start_s", "f8")])
_FRAME = np.dtype([("time_s", "f8"), ("mass_kg", "f8")])
_TRACK = np.dtype(
    [("x_px", "f8"), ("y_px", "f8"), ("std_x_px", "f4"), ("std_y_px", "f4"), ("valid", "?")]
)


@dataclass(frozen=True)
class ExperimentPlan:
    """What one experiment will record; all datasets are made before the first block.

    Args:
        name: unique in the session.
        kind: of the study's step.
        points: tracked points per frame.
        settings: anything that JSON holds: signals, loads, gains.
    """

    name: str
    kind: str
    points: int
    settings: dict[str, Any]


@dataclass(frozen=True)
class ExperimentRecord:
    """What one experiment recorded; B blocks of N samples, F frames of P points.

    Args:
        name: of the experiment.
        kind: of the study's step.
        settings: as planned, and as completed in the run.
        codes: ADC codes, shape `(B, N, 2)`.
        drive_v: output asked for in each block, shape `(B,)`.
        reference: desired strain in each block, NaN in open loop, shape `(B,)`.
        block_start_s: clock at each block's first sample, shape `(B,)`.
        frame_time_s: middle of the exposures, shape `(F,)`.
        tracks: fields `x_px y_px std_x_px std_y_px valid`, shape `(F, P)`.
        mass_kg: hung at each frame, shape `(F,)`.
    """

    name: str
    kind: str
    settings: dict[str, Any]
    codes: NDArray[np.int16]
    drive_v: NDArray[np.float64]
    reference: NDArray[np.float64]
    block_start_s: NDArray[np.float64]
    frame_time_s: NDArray[np.float64]
    tracks: NDArray[np.void]
    mass_kg: NDArray[np.float64]


def _resizable(group: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any, rows: int) -> None:
    group.create_dataset(
        name,
        shape=(0, *shape),
        maxshape=(None, *shape),
        chunks=(rows, *shape),
        dtype=dtype,
        compression="gzip",
        compression_opts=1,
        shuffle=True,
    )


def _read(file: h5py.File, name: str) -> ExperimentRecord:
    group = file[f"experiments/{name}"]
    count = min(group[dataset].shape[0] for dataset in ("codes", "blocks"))
    blocks = group["blocks"][:count]
    seen = min(group[dataset].shape[0] for dataset in ("frames", "tracks"))
    frames = group["frames"][:seen]
    return ExperimentRecord(
        name=name,
        kind=str(group.attrs["kind"]),
        settings=json.loads(bytes(group["settings"][0]).decode()),
        codes=group["codes"][:count],
        drive_v=blocks["drive_v"],
        reference=blocks["reference"],
        block_start_s=blocks["start_s"],
        frame_time_s=frames["time_s"],
        tracks=group["tracks"][:seen],
        mass_kg=frames["mass_kg"],
    )


def _read_events(file: h5py.File) -> list[tuple[float, str]]:
    rows = file["events"][:]
    return [(float(row["time_s"]), row["what"].decode(errors="ignore")) for row in rows]


def _first_line(error: BaseException) -> str:
    return str(error).partition("\n")[0] or type(error).__name__


def _size_limit() -> int:
    """The largest file that this process may write, in bytes."""
    if sys.platform == "win32":
        return sys.maxsize
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return sys.maxsize if limit == resource.RLIM_INFINITY else limit


class SessionWriter:
    """Writes a session; every `append` reaches the file before the next block is asked for.

    Args:
        path: of the new file; an old one is replaced.
        plans: all experiments that may be recorded.
        block_samples: samples per channel in one block.
        header: configuration, versions and hashes, as JSON holds them.
    Raises:
        DeviceError: the disk refuses, for instance because it is full.
    """

    def __init__(
        self, path: Path, plans: list[ExperimentPlan], block_samples: int, header: dict[str, Any]
    ) -> None:
        self._path = path
        self._pending: dict[str, list[NDArray[np.int16]]] = {}
        self._rows: dict[str, list[tuple[float, float, float]]] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # v110: readable by HDF5 1.10 and later, and by others while it is being written.
            self._file = h5py.File(path, "w", libver=("v110", "v110"))
        except OSError as error:
            raise self._failed(error) from None
        try:
            self._check_room()
            self._file.attrs["format"] = _FORMAT
            self._file.attrs["header"] = json.dumps(header)
            _resizable(self._file, "events", (), _EVENT, 64)
            for plan in plans:
                self._create(plan, block_samples)
            self._file.swmr_mode = True
        except BaseException:
            self._file.close()
            raise

    def _failed(self, error: BaseException) -> DeviceError:
        if isinstance(error, DeviceError):
            return error
        return DeviceError(
            f"The session file cannot be written ({_first_line(error)}); what was written before "
            f"is kept. Free disk space or choose another folder. {self._path}"
        )

    def _create(self, plan: ExperimentPlan, block_samples: int) -> None:
        group = self._file.create_group(f"experiments/{plan.name}")
        group.attrs["kind"] = plan.kind
        group.create_dataset("settings", shape=(1,), dtype=f"S{_SETTINGS_BYTES}")
        group["settings"][0] = self._text(plan.name, plan.settings)
        _resizable(group, "codes", (block_samples, 2), np.int16, _BLOCKS_PER_CHUNK)
        _resizable(group, "blocks", (), _BLOCK, 1000)
        _resizable(group, "frames", (), _FRAME, 1000)
        _resizable(group, "tracks", (plan.points,), _TRACK, 100)

    def _text(self, name: str, settings: dict[str, Any]) -> bytes:
        text = json.dumps(settings).encode()
        if len(text) > _SETTINGS_BYTES:
            raise InputError(
                f"Settings of {name!r} have {len(text)} bytes, allowed are {_SETTINGS_BYTES}. "
                f"Shorten them. {self._path}"
            )
        return text

    def _check_room(self) -> None:
        """Stop while HDF5 can still finish the file: it cannot once a write has failed."""
        free = shutil.disk_usage(self._path.parent).free
        free = min(free, _size_limit() - self._path.stat().st_size)
        if free < _RESERVE_BYTES:
            raise DeviceError(
                f"The disk is full: {free / 1e6:.0f} MB left, {_RESERVE_BYTES / 1e6:.0f} MB "
                "are needed; what was recorded is kept. Free disk space or choose another folder. "
                f"{self._path}"
            )

    def _extend(self, name: str, dataset: str, rows: NDArray[Any]) -> None:
        self._check_room()
        target = self._file[f"experiments/{name}/{dataset}"]
        try:
            old = target.shape[0]
            target.resize(old + rows.shape[0], axis=0)
            target[old:] = rows
            target.flush()
        except _HDF5_ERRORS as error:
            raise self._failed(error) from None

    def append_block(
        self, name: str, codes: NDArray[np.int16], start_s: float, drive_v: float, reference: float
    ) -> None:
        """Add one block; chunks of ten reach the file together (0.1 s)."""
        self._pending.setdefault(name, []).append(codes)
        self._rows.setdefault(name, []).append((drive_v, reference, start_s))
        if len(self._pending[name]) >= _BLOCKS_PER_CHUNK:
            self.flush(name)

    def flush(self, name: str) -> None:
        """Write what is pending of one experiment."""
        blocks = self._pending.pop(name, [])
        if not blocks:
            return
        self._extend(name, "codes", np.stack(blocks))
        self._extend(name, "blocks", np.array(self._rows.pop(name), dtype=_BLOCK))

    def append_frames(
        self,
        name: str,
        time_s: NDArray[np.float64],
        tracks: NDArray[np.void],
        mass_kg: float,
    ) -> None:
        """Add the tracks of frames: `time_s` `(F,)`, `tracks` `(F, P)` of `track_dtype()`."""
        frames = np.empty(time_s.size, dtype=_FRAME)
        frames["time_s"], frames["mass_kg"] = time_s, mass_kg
        self._extend(name, "tracks", tracks)
        self._extend(name, "frames", frames)

    @staticmethod
    def track_dtype() -> np.dtype[np.void]:
        """Fields of one tracked point."""
        return _TRACK

    def complete_settings(self, name: str, settings: dict[str, Any]) -> None:
        """Replace the settings of an experiment by what was really used."""
        self._file[f"experiments/{name}/settings"][0] = self._text(name, settings)

    def event(self, time_s: float, what: str) -> None:
        """Note that something happened."""
        try:
            events = self._file["events"]
            events.resize(events.shape[0] + 1, axis=0)
            events[-1] = (time_s, what.encode()[: _EVENT["what"].itemsize])
            events.flush()
        except _HDF5_ERRORS as error:
            raise self._failed(error) from None

    def experiment(self, name: str) -> ExperimentRecord:
        """Everything one experiment has recorded so far, as the file holds it."""
        return _read(self._file, name)

    def events(self) -> list[tuple[float, str]]:
        """Time in s and text of each event so far."""
        return _read_events(self._file)

    def close(self) -> None:
        """Write all that is pending and close; safe to call twice.

        Raises:
            DeviceError: the disk refuses what is pending.
        """
        if not self._file:
            return
        try:
            self._finish()
        except _HDF5_ERRORS as error:
            raise self._failed(error) from None

    def _finish(self) -> None:
        try:
            for name in list(self._pending):
                self.flush(name)
        finally:
            self._file.close()

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


def _check_size(path: Path) -> None:
    """Refuse a file that is shorter than its own superblock says: HDF5 would search it for hours.

    Bytes 28 to 35 of a superblock of version 2 or 3 are the address of the end of the file.
    """
    with path.open("rb") as file:
        head = file.read(36)
    if len(head) < 36 or head[:8] != b"\x89HDF\r\n\x1a\n" or head[8] not in (2, 3):
        raise ValueError("no HDF5 superblock of this format")
    stated, size = int.from_bytes(head[28:36], "little"), path.stat().st_size
    if size < stated:
        raise ValueError(f"truncated: {size} bytes of {stated}")


class SessionReader:
    """Reads a session, also one whose writer was killed or still writes.

    Args:
        path: of session.h5.
    Raises:
        InputError: no such file, not a session, or damaged beyond reading.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.is_file():
            raise InputError(f"No session here; run a study first. {path}")
        try:
            _check_size(path)
            self._file = h5py.File(path, "r", libver="latest", swmr=True)
        except _HDF5_ERRORS as error:
            raise self._damaged(error) from None
        try:
            if self._file.attrs["format"] != _FORMAT:
                raise KeyError("format")
            self.header: dict[str, Any] = json.loads(self._file.attrs["header"])
            self.names: list[str] = [
                name
                for name, group in self._file["experiments"].items()
                if group["frames"].shape[0] or group["codes"].shape[0]
            ]
        except _HDF5_ERRORS as error:
            self._file.close()
            raise self._damaged(error) from None

    def _damaged(self, error: BaseException) -> InputError:
        return InputError(
            f"Not a whole haselab session ({_first_line(error)}); copy the file again or record "
            f"anew. {self._path}"
        )

    def experiment(self, name: str) -> ExperimentRecord:
        """Everything one experiment recorded.

        Raises:
            InputError: no such experiment, or its data cannot be read.
        """
        if name not in self.names:
            raise InputError(f"No experiment {name!r}; there are {self.names}. {self._path}")
        try:
            return _read(self._file, name)
        except _HDF5_ERRORS as error:
            raise self._damaged(error) from None

    def events(self) -> list[tuple[float, str]]:
        """Time in s and text of each event.

        Raises:
            InputError: the events cannot be read.
        """
        try:
            return _read_events(self._file)
        except _HDF5_ERRORS as error:
            raise self._damaged(error) from None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
