"""Finished cases of a campaign as Parquet shards: the only record of what is done.

A shard is written under a temporary name, synchronised to the disk and renamed, so it is complete
or absent. Shards are never changed. Small ones are merged: the merged shard is in place before the
small ones are deleted, and a case that is in several shards counts once.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import secrets
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from haselab.base import DeviceError, InputError, Json
from haselab.store.folder import drafted
from haselab.store.session.lock import hold

__all__ = ["KEYS", "CaseRow", "CaseState", "Shards"]

_FAILED = "failed"
_FOLDER = "shards"
_ENDING = ".parquet"
_SMALL_BYTES = 4_000_000
_MOST_SMALL = 64
KEYS = ("case", "index", "status", "error", "attempt", "traceback", "compute_s")
_STATE = ["case", "status", "attempt"]


@dataclass(frozen=True)
class CaseRow:
    """One finished case.

    Args:
        case: hash that identifies it.
        index: in the campaign.
        values: of its parameters, by their paths.
        results: by name; empty after a failure.
        error: what failed, in one line; empty: nothing.
        traceback: of the error; empty without one.
        attempt: 1, or more after it was repeated.
        compute_s: time that it took.
    """

    case: str
    index: int
    values: dict[str, Json]
    results: dict[str, Json] = field(default_factory=dict)
    error: str = ""
    traceback: str = ""
    attempt: int = 1
    compute_s: float = 0.0

    @property
    def status(self) -> str:
        """`ok` or `failed`."""
        return _FAILED if self.error else "ok"


@dataclass(frozen=True)
class CaseState:
    """What is known of a finished case.

    Args:
        failed: whether it failed.
        attempt: how often it was computed.
    """

    failed: bool
    attempt: int


_DONE = CaseState(failed=False, attempt=1)


class Shards:
    """The shards in the folder of a campaign.

    Args:
        folder: of the campaign.
        writer: name of this program, unique among those that write to the folder.
    Raises:
        InputError: pyarrow is not installed.
    """

    def __init__(self, folder: Path, writer: str) -> None:
        try:
            self._arrow: Any = importlib.import_module("pyarrow")
            self._parquet: Any = importlib.import_module("pyarrow.parquet")
        except ImportError:
            raise InputError(
                "A campaign needs pyarrow, which is not installed. "
                "Run: pip install 'haselab[campaign]'"
            ) from None
        self._folder, self._writer, self._count = folder / _FOLDER, writer, 0
        self._small = 0
        self._read_names: set[str] = set()

    def write(self, rows: Sequence[CaseRow]) -> None:
        """Write finished cases, and wait until they are on the disk.

        Args:
            rows: of them.
        Raises:
            DeviceError: the disk is full, or refuses.
        """
        columns: dict[str, list[Json]] = {
            "case": [row.case for row in rows],
            "index": [row.index for row in rows],
            "status": [row.status for row in rows],
            "error": [row.error for row in rows],
            "attempt": [row.attempt for row in rows],
            "traceback": [row.traceback for row in rows],
            "compute_s": [row.compute_s for row in rows],
        }
        for part in ("values", "results"):
            for name in dict.fromkeys(name for row in rows for name in getattr(row, part)):
                columns[name] = [getattr(row, part).get(name) for row in rows]
        self._count += 1
        self._save(self._arrow.table(columns), f"{self._writer}-{self._count:06d}")
        self._small += 1
        if self._small >= _MOST_SMALL:
            self._small = 0
            self.merge()

    def _save(self, table: Any, name: str) -> None:
        self._read_names.add(f"{name}{_ENDING}")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            path = self._folder / f"{name}{_ENDING}"
            with drafted(path) as draft, draft.open("wb") as file:
                self._parquet.write_table(table, file, compression="zstd")
                file.flush()
                os.fsync(file.fileno())
            _synchronise(self._folder)
        except OSError as error:
            raise DeviceError(
                f"Cannot write ({error.strerror or error}). Free disk space, or restore the "
                f"folder. {self._folder}"
            ) from None

    def states(self) -> dict[str, CaseState]:
        """All finished cases by their hashes.

        Returns:
            The states; a case that succeeded once has not failed.
        Raises:
            InputError: a shard is damaged.
        """
        self._read_names.clear()
        return self.news()

    def news(self) -> dict[str, CaseState]:
        """Finished cases in shards of other programs that were not read before.

        Returns:
            The states by the hashes of the cases.
        Raises:
            InputError: a shard is damaged.
        """
        found: dict[str, CaseState] = {}
        for table in self._tables(_STATE, self._read_names):
            cases, statuses, attempts = (table.column(name).to_pylist() for name in _STATE)
            if not found.keys() & cases and set(statuses) == {"ok"} and set(attempts) == {1}:
                found.update(dict.fromkeys(cases, _DONE))  # hundreds of thousands, usually
                continue
            for case, status, attempt in zip(cases, statuses, attempts, strict=True):
                old, new = found.get(case), CaseState(status == _FAILED, attempt)
                if old is None or (not new.failed, attempt) > (not old.failed, old.attempt):
                    found[case] = new
        return found

    def rows(self, cases: Collection[str], parameters: Collection[str]) -> list[CaseRow]:
        """The best row of each of these cases, in the order of their indices.

        Args:
            cases: hashes.
            parameters: names of the columns that are no results.
        Returns:
            Rows of those that are finished.
        Raises:
            InputError: a shard is damaged.
        """
        wanted, found = frozenset(cases), dict[str, CaseRow]()
        for table in self._tables(None, set()):
            for data in table.to_pylist():
                case = data["case"]
                if case not in wanted:
                    continue
                old, row = found.get(case), _row(data, parameters)
                if old is None or (not row.error, row.attempt) > (not old.error, old.attempt):
                    found[case] = row
        return sorted(found.values(), key=lambda row: row.index)

    def _tables(self, columns: list[str] | None, known: set[str]) -> list[Any]:
        """All shards but the known ones, also while another program merges some of them."""
        while True:
            names = [name for name in self._names() if name not in known]
            try:
                found = [self._read(self._folder / name, columns) for name in sorted(names)]
            except FileNotFoundError:
                continue
            known.update(names)
            return found

    def _read(self, path: Path, columns: list[str] | None) -> Any:
        try:
            with path.open("rb") as file:
                return self._parquet.ParquetFile(file).read(columns=columns)
        except (self._arrow.ArrowException, KeyError, OSError) as error:
            if isinstance(error, OSError) and error.errno is not None:
                raise  # of the file system, and not of the contents
            raise InputError(
                f"Not a shard of a campaign ({' '.join(str(error).split())[:200]}). Delete the "
                f"file; its cases are then computed again. {path}"
            ) from None

    def _names(self) -> list[str]:
        """Names of all complete shards."""
        if not self._folder.is_dir():
            return []
        with os.scandir(self._folder) as found:  # often, so without making a path of each
            names = [entry.name for entry in found]
        return [name for name in names if name.endswith(_ENDING) and not name.startswith(".")]

    def merge(self) -> None:
        """Merge the small shards, unless another program does so.

        Raises:
            DeviceError: the disk is full, or refuses.
            InputError: a shard is damaged.
        """
        with _lock(self._folder / "merge.lock") as locked:
            paths = [self._folder / name for name in sorted(self._names())]
            small = [path for path in paths if path.stat().st_size < _SMALL_BYTES]
            if not locked or len(small) < _MOST_SMALL // 2:
                return
            tables = [self._read(path, None) for path in small]
            merged = self._arrow.concat_tables(tables, promote_options="permissive")
            self._save(merged, f"{self._writer}-merged-{secrets.token_hex(4)}")
            for path in small:
                path.unlink()


def _row(data: dict[str, Any], parameters: Collection[str]) -> CaseRow:
    """A row of a table."""
    values = {name: data[name] for name in parameters}
    results = {
        name: value for name, value in data.items()
        if name not in KEYS and name not in values and value is not None
    }  # fmt: skip
    return CaseRow(
        data["case"], data["index"], values, results, data["error"], data["traceback"],
        data["attempt"], data["compute_s"],
    )  # fmt: skip


def _synchronise(folder: Path) -> None:
    """Make the names of new files survive a power failure, where the system can."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[bool]:
    """Whether this program alone has the lock."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as file:
        try:
            hold(file.fileno())
        except OSError:
            yield False
            return
        yield True
