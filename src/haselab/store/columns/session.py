"""The ADC codes of a session's experiment as two columns."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.columns.archive import Archive, Take
from haselab.store.columns.hdf5 import chunked_reader
from haselab.store.columns.reader import ColumnStream
from haselab.store.session.opening import is_session
from haselab.store.session.writer import SessionReader

__all__ = ["SessionColumns", "session_experiments"]

_NAMES = ("v_monitor", "i_monitor")


def session_experiments(path: Path, *, unverified: bool = False) -> list[str] | None:
    """Names of the experiments with blocks in a session; None if the file is not a session.

    Args:
        path: of any file.
        unverified: read a session whose checksums do not match.
    Raises:
        InputError: a session that is damaged.
    """
    if not is_session(path):
        return None
    with SessionReader(path, unverified=unverified) as session:
        return session.names


class _CodesArchive(Archive):
    """Codes of shape `(B, N, 2)` as two columns of `B N` rows."""

    def __init__(self, file: Path, opened: contextlib.ExitStack, codes: h5py.Dataset) -> None:
        super().__init__(file, opened)
        self._codes = codes

    @property
    def names(self) -> Sequence[str]:
        """Both monitors."""
        return _NAMES

    def rate_hz(self, names: Sequence[str]) -> float | None:
        """Nothing: the session's header states it."""
        del names
        return None

    def rows(self, names: Sequence[str]) -> int | None:
        """Samples of a channel."""
        del names
        return int(self._codes.shape[0] * self._codes.shape[1])

    def start(self, names: Sequence[str]) -> Take:
        """Begin at the first block; chunks are whole blocks."""
        del names
        read, (left, length, _) = chunked_reader(self._codes, 0, self._open), self._codes.shape

        def take(rows: int) -> tuple[NDArray[Any], ...]:
            nonlocal left
            blocks = min(rows // length, left)
            left -= blocks
            table = read(blocks * length * 2).reshape(-1, 2)
            return table[:, 0], table[:, 1]

        return take


class SessionColumns(SessionReader):
    """A session whose codes are read in parts.

    Args:
        path: of session.h5.
        experiment: whose blocks are read.
        unverified: continue if a checksum does not match.
    Raises:
        InputError: no session, damaged, no such experiment, or one without blocks.
    """

    def __init__(self, path: Path, experiment: str, *, unverified: bool = False) -> None:
        super().__init__(path, unverified=unverified)
        self._opened = contextlib.ExitStack()
        try:
            self._group = self._group_of(experiment)
        except BaseException:
            self.close()
            raise
        self._codes: h5py.Dataset = self._group["codes"]
        self.block_samples = int(self._codes.shape[1])

    def _group_of(self, experiment: str) -> h5py.Group:
        there = [name for name in self.names if self._file["experiments"][name]["codes"].shape[0]]
        if experiment not in there:
            raise InputError(
                f"The session has no experiment {experiment!r} with blocks, only "
                f"{', '.join(there) or 'none at all'}. Name one of them. {self._path}"
            )
        return self._file["experiments"][experiment]

    def columns(self) -> ColumnStream:
        """Codes of both monitors, int16; ask for chunks of whole blocks."""
        archive = _CodesArchive(self._path, self._opened, self._codes)
        return ColumnStream(archive, _NAMES, use_times=False)

    def block_start_s(self, first: int, count: int) -> NDArray[np.float64]:
        """Clock at the first sample of some blocks, shape `(count,)`; NaN where none was kept."""
        start_s = np.full(count, np.nan)
        rows = self._group["blocks"].fields("start_s")[first : first + count]
        start_s[: len(rows)] = rows
        return start_s

    def close(self) -> None:
        """Close the file."""
        self._opened.close()
        super().close()
