"""Finished cases of a campaign as Parquet shards: the only record of what is done.

A shard is written under a temporary name, synchronised to the disk and renamed, so it is complete
or absent. Shards are never changed. Small ones are merged: the merged shard is in place before the
small ones are deleted, and a case that is in several shards counts once.

The name of a shard has a checksum of all its bytes. The checksums of Parquet would not do: they
leave out the names of the columns. Shards of older versions have no checksum.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import secrets
import zlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from haselab.base import InputError, Json
from haselab.store.claim import not_written
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
_TYPES = dict(zip(KEYS, ("string", "int64", "string", "string", "int64", "string", "double"),
                  strict=True))  # fmt: skip
_CHECKSUM = re.compile(r"\.([0-9a-f]{8})\.parquet")


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
        packed = io.BytesIO()
        self._parquet.write_table(table, packed, compression="zstd")
        path = self._folder / f"{name}.{zlib.crc32(packed.getbuffer()):08x}{_ENDING}"
        self._read_names.add(path.name)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with drafted(path) as draft, draft.open("wb") as file:
                file.write(packed.getbuffer())
                file.flush()
                os.fsync(file.fileno())
            _synchronise(self._folder)
        except OSError as error:
            raise not_written(path, error) from None

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
        for table, _ in self._tables(_STATE, self._read_names):
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
        for table, path in self._tables(None, set()):
            used = not wanted.isdisjoint(table.column("case").to_pylist())
            if used and (wrong := self._no_results(table.schema, parameters)):
                raise _no_shard(path, wrong)
            for data in table.to_pylist() if used else ():
                case = data["case"]
                if case not in wanted:
                    continue
                old, row = found.get(case), _row(data, parameters)
                if old is None or (not row.error, row.attempt) > (not old.error, old.attempt):
                    found[case] = row
        return sorted(found.values(), key=lambda row: row.index)

    def _tables(self, columns: list[str] | None, known: set[str]) -> list[tuple[Any, Path]]:
        """All shards but the known ones, also while another program merges some of them."""
        while True:
            names = [name for name in self._names() if name not in known]
            try:
                paths = [self._folder / name for name in sorted(names)]
                found = [(self._read(path, columns), path) for path in paths]
            except FileNotFoundError:
                continue
            known.update(names)
            return found

    def _read(self, path: Path, columns: list[str] | None) -> Any:
        data = path.read_bytes()
        stated = _CHECKSUM.search(path.name)
        if stated and int(stated[1], 16) != zlib.crc32(data):
            raise _no_shard(path, "damaged: its checksum differs from that in its name")
        try:
            # without threads: one that still holds `data` when Python ends aborts the program
            file = self._parquet.ParquetFile(io.BytesIO(data), pre_buffer=False)
            wrong = _no_keys(file.schema_arrow)
            table = None if wrong else file.read(columns=columns, use_threads=False)
            if table is not None and not stated:
                table.validate(full=True)
        except (self._arrow.ArrowException, KeyError, OSError, ValueError) as error:
            raise _no_shard(path, " ".join(str(error).split())[:200]) from None
        if table is None:
            raise _no_shard(path, wrong)
        for name in KEYS:
            if name in table.column_names and table.column(name).null_count:
                raise _no_shard(path, f"its column {name!r} has empty places")
        return table

    def _no_results(self, schema: Any, parameters: Collection[str]) -> str:
        """What is wrong with the columns of parameters and results, or an empty text."""
        if missing := [name for name in parameters if name not in schema.names]:
            return f"it has no column {missing[0]!r}"
        numbers = (self._arrow.float64(), self._arrow.null())
        for one in schema:
            if one.name not in (*KEYS, *parameters) and one.type not in numbers:
                return f"its column {one.name!r} has the type {one.type}, not double"
        return ""

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
            try:
                merged = self._arrow.concat_tables(tables, promote_options="permissive")
            except self._arrow.ArrowException:
                return  # one of them is no shard of this campaign, see `_no_results`
            self._save(merged, f"{self._writer}-merged-{secrets.token_hex(4)}")
            for path in small:
                path.unlink()


def _no_keys(schema: Any) -> str:
    """What is wrong with the columns that all shards have, or an empty text."""
    for name, kind in _TYPES.items():
        if (count := schema.names.count(name)) != 1:
            return f"it has {count or 'no'} column{'s' if count else ''} {name!r}"
        if (found := str(schema.field(name).type)) != kind:
            return f"its column {name!r} has the type {found}, not {kind}"
    return ""


def _no_shard(path: Path, wrong: str) -> InputError:
    return InputError(
        f"Not a shard of a campaign ({wrong}). Delete the file; its cases are then computed "
        f"again. {path}"
    )


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
