"""Read a session, even if its writer was killed or is still writing."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from haselab.base import Closing, InputError
from haselab.store.session.checksums import check_links
from haselab.store.session.layout import (
    BLOCK_ORDER,
    FORMATS,
    HDF5_ERRORS,
    BlockRows,
    ExperimentRecord,
    read_blocks,
    read_conditions,
    read_events,
    read_experiment,
)
from haselab.store.session.opening import open_session
from haselab.store.session.seal import ChangedError
from haselab.store.session.tail import TailReader
from haselab.store.text_file import decode_json

__all__ = ["SessionReader", "cut_short", "session_file"]


# HDF5 shares the state of a dataset between all handles of a process: while one is open, another
# one does not see new chunks and reads rows of old ones. So no handle outlives a call, and calls
# are serialised.
_TURN = threading.RLock()


def session_file(path: str | Path) -> Path:
    """The session file in a run's folder; a path of a file is returned unchanged."""
    path = Path(path)
    return path / "session.h5" if path.is_dir() else path


def cut_short(events: Iterable[tuple[float, str]]) -> tuple[str, ...]:
    """Names of the experiments whose recording has a start and no end.

    Args:
        events: of a session, as a reader or a writer returns them.
    """
    found = list(events)
    ended = _named(found, "end")
    return tuple(name for name in _named(found, "start") if name not in ended)


def _named(events: Iterable[tuple[float, str]], verb: str) -> tuple[str, ...]:
    """Names of the experiments in the events that begin with a verb."""
    said = (what.partition(" ") for _, what in events)
    return tuple(name for first, _, name in said if first == verb)


class SessionReader(Closing):
    """Reads a session, even if its writer was killed or is still writing.

    Several readers may be open in one process; a handle of h5py's own on the same growing file may
    not.

    Args:
        path: of session.h5 or the folder that holds it.
        unverified: continue if a checksum does not match; `doubt` then gives the reason.

    `planned` are the names of the experiments that the run was to record, `names` those of which
    there are data.

    `doubt` says why the data are not verified: they were changed, or recorded before sessions had
    checksums. It is empty if every byte is as recorded.
    Raises:
        InputError: no such file, not a session, truncated, or changed since it was recorded.
    """

    def __init__(self, path: str | Path, *, unverified: bool = False) -> None:
        path = session_file(path)
        self._path, self._unverified = path, unverified
        if not path.is_file():
            raise InputError(f"No session here; run a study first. {path}")
        self._open()
        if self._live and len(self.names) < len(self.planned):
            # rows may have moved from the tail to their table between the two looks
            self._file.close()
            self._open()

    @property
    def path(self) -> Path:
        """Path of session.h5."""
        return self._path

    def _open(self) -> None:
        try:
            opened = open_session(self._path, unverified=self._unverified)
        except HDF5_ERRORS as error:
            raise self._damaged(error) from None
        self._file, self._live, self.doubt = opened.file, opened.live, opened.doubt
        try:
            if self._file.attrs["format"] not in FORMATS:
                raise KeyError("format")
            check_links(self._file)
            self.header: dict[str, Any] = decode_json(self._file.attrs["header"])
            self._tail = TailReader(self._file, self._path)
            groups = self._file["experiments"]
            self.planned: tuple[str, ...] = tuple(groups)
            self.names: list[str] = [name for name, group in groups.items() if self._began(group)]
        except HDF5_ERRORS as error:
            self._file.close()
            raise self._damaged(error) from None

    def _began(self, group: h5py.Group) -> bool:
        if group["frames"].shape[0] or group["codes"].shape[0]:
            return True
        return "number" in group.attrs and bool(self._tail.rows(int(group.attrs["number"]), 0).size)

    def _damaged(self, error: BaseException) -> InputError:
        line = str(error).partition("\n")[0] or type(error).__name__
        if isinstance(error, ChangedError):
            return InputError(
                f"The session was changed after the recording ({line}). Restore session.h5 from a "
                "backup, or read it with 'analyse', 'sense' or 'session export' and --unverified, "
                f"which mark the result. {self._path}"
            )
        return InputError(
            f"The file is not a complete haselab session ({line}). Copy the original file again. "
            f"{self._path}"
        )

    def experiment(self, name: str) -> ExperimentRecord:
        """Read all data of one experiment.

        Raises:
            InputError: no such experiment, or its data cannot be read.
        """
        if name not in self.names:
            raise InputError(f"No experiment {name!r}; there are {self.names}. {self._path}")
        try:
            with _TURN:
                return read_experiment(self._file, name, self._tail, verify=self._live)
        except HDF5_ERRORS as error:
            if isinstance(error, ChangedError):
                raise self._damaged(error) from None
            line = str(error).partition("\n")[0] or type(error).__name__
            raise InputError(
                f"The recording of {name} cannot be read ({line}). Restore session.h5 from a "
                "backup, or write the other experiments with 'haselab session export "
                f"--unverified'. {self._path}"
            ) from None

    def follow(self, name: str, first: int, most: int | None = None) -> BlockRows:
        """Read the blocks from a row on, while the session is being written.

        Args:
            name: of the experiment; before it begins it has no blocks.
            first: the first row to read.
            most: maximum number of stored blocks, for a file larger than memory; blocks in the tail
                are added.
        Raises:
            InputError: no such experiment, or its data cannot be read.
        """
        try:
            group = self._file["experiments"].get(name)
            if group is None:
                there = list(self._file["experiments"])
                raise InputError(f"No experiment {name!r}; there are {there}. {self._path}")
            with _TURN:
                for dataset in reversed(BLOCK_ORDER):
                    if dataset in group:
                        group[dataset].id.refresh()
                return read_blocks(group, self._tail, first, most, verify=self._live)
        except HDF5_ERRORS as error:
            if isinstance(error, InputError):
                raise
            raise self._damaged(error) from None

    def events(self) -> list[tuple[float, str]]:
        """Time in s and text of each event.

        Raises:
            InputError: the events cannot be read.
        """
        try:
            with _TURN:
                self._file["events"].id.refresh()
                return read_events(self._file)
        except HDF5_ERRORS as error:
            raise self._damaged(error) from None

    def complete(self) -> tuple[str, ...]:
        """Names of the experiments that were recorded from start to end.

        Raises:
            InputError: the events cannot be read.
        """
        return _named(self.events(), "end")

    def cut_short(self) -> tuple[str, ...]:
        """Names of the experiments whose recording has a start and no end.

        Raises:
            InputError: the events cannot be read.
        """
        return cut_short(self.events())

    def conditions(self) -> NDArray[np.void]:
        """What acted on the actuator outside the blocks, in the order of time.

        Returns:
            Fields `time_s`, `drive_v` and `carrier_v` before the amplifier, `pull_n`, which changes
            in a straight line from row to row, and `mass_kg`. Shape `(N,)`; empty in sessions
            that were recorded without them.
        Raises:
            InputError: they cannot be read.
        """
        try:
            with _TURN:
                return read_conditions(self._file)
        except HDF5_ERRORS as error:
            raise self._damaged(error) from None

    def stated(self, *keys: str) -> Any:
        """The value of the header under these keys.

        Raises:
            InputError: there is no value.
        """
        found: Any = self.header
        for key in keys:
            if not (isinstance(found, dict) and key in found):
                raise InputError(
                    f"The session's header lacks {'.'.join(keys)}: it was written by another "
                    "program or an old version. Export its codes as .npz and give all values as "
                    f"options. {self._path}"
                )
            found = found[key]
        return found

    def states(self, *keys: str) -> bool:
        """Whether the header has a value under these keys."""
        found: Any = self.header
        for key in keys:
            if not (isinstance(found, dict) and key in found):
                return False
            found = found[key]
        return True

    def close(self) -> None:
        """Close the file."""
        self._tail.close()
        self._file.close()
