"""Export the tables of a session in parts, as CSV or Parquet."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.folder import drafted
from haselab.store.session.reader import SessionReader

__all__ = [
    "DERIVED",
    "ENDINGS",
    "EVENTS",
    "Columns",
    "Table",
    "event_table",
    "table_of",
    "tables_of",
    "write_csv",
    "write_parquet",
]

Columns = dict[str, NDArray[Any]]
ENDINGS = ("", "-blocks", "-tracks")  # of the recorded tables of an experiment
DERIVED = ("-capacitance", "-strain")  # of those that follow from them
EVENTS = "events"
_CHUNK_BLOCKS = 500


@dataclass(frozen=True)
class Table:
    """Columns of equal length, in chunks.

    Args:
        name: of the file, without its ending.
        chunks: the rows from the first on; at least one chunk, perhaps empty.
    """

    name: str
    chunks: Callable[[], Iterator[Columns]]


def event_table(reader: SessionReader) -> Table:
    """The events with their times."""

    def chunks() -> Iterator[Columns]:
        events = reader.events()
        yield {
            "time_s": np.array([time_s for time_s, _ in events], float),
            "what": np.array([what for _, what in events], dtype=np.str_),
        }

    return Table(EVENTS, chunks)


def table_of(name: str, columns: Columns) -> Table:
    """A table of columns that are in memory."""

    def whole() -> Iterator[Columns]:
        yield columns

    return Table(name, whole)


def tables_of(
    reader: SessionReader, name: str, table: str, volt_per_code: float, rate_hz: float
) -> list[Table]:
    """Monitors, blocks and tracks of one experiment.

    Args:
        reader: of the session.
        name: of the experiment.
        table: its name as a table.
        volt_per_code: of both monitors.
        rate_hz: samples per second and channel.
    """

    def monitors() -> Iterator[Columns]:
        first, count = 0, 1
        while count:
            rows = reader.follow(name, first, _CHUNK_BLOCKS)
            count = rows.start_s.size
            if count or not first:
                sample_s = np.arange(rows.codes.shape[1]) / rate_hz
                volts = (rows.codes * volt_per_code).astype(np.float32)
                yield {
                    "time_s": (rows.start_s[:, None] + sample_s).ravel(),
                    "v_monitor_v": volts[:, :, 0].ravel(),
                    "i_monitor_v": volts[:, :, 1].ravel(),
                }
            first += count

    def blocks() -> Iterator[Columns]:
        rows = reader.experiment(name)
        yield {
            "start_s": rows.block_start_s,
            "drive_v": rows.drive_v,
            "reference": rows.reference,
        }

    def tracks() -> Iterator[Columns]:
        rows = reader.experiment(name)
        frames, points = rows.tracks.shape
        yield {
            "frame": np.repeat(np.arange(frames), points),
            "time_s": np.repeat(rows.frame_time_s, points),
            "mass_kg": np.repeat(rows.mass_kg, points),
            "point": np.tile(np.arange(points), frames),
        } | {field: rows.tracks[field].ravel() for field in rows.tracks.dtype.names or ()}

    parts = zip(ENDINGS, (monitors, blocks, tracks), strict=True)
    return [Table(table + ending, chunks) for ending, chunks in parts]


def _cells(column: NDArray[Any]) -> list[str]:
    if column.dtype == bool:
        return ["1" if value else "0" for value in column.tolist()]
    if column.dtype.kind == "U":
        return ['"' + value.replace('"', '""') + '"' for value in column.tolist()]
    if column.dtype == np.float32:
        return [f"{value:.9g}" for value in column.tolist()]  # nine digits hold every float32
    return [repr(value) for value in column.tolist()]


def write_csv(table: Table, folder: Path) -> Path:
    """Write a table as CSV with a header row; digits enough to get each number back."""
    path = folder / f"{table.name}.csv"
    with drafted(path) as draft, draft.open("w", encoding="utf-8", newline="\n") as file:
        for k, columns in enumerate(table.chunks()):
            if k == 0:
                file.write(",".join(columns) + "\n")
            cells = [_cells(column) for column in columns.values()]
            file.writelines(",".join(row) + "\n" for row in zip(*cells, strict=True))
    return path


def write_parquet(table: Table, folder: Path, header: str) -> Path:
    """Write a table as Parquet, with the session's header among its metadata.

    Raises:
        InputError: pyarrow is not installed.
    """
    try:
        arrow: Any = importlib.import_module("pyarrow")
        parquet: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise InputError(
            "Parquet files need pyarrow, which is not installed. "
            f"Run: pip install 'haselab[formats]', or use --to csv. {folder}"
        ) from None
    path = folder / f"{table.name}.parquet"
    writer: Any = None
    with drafted(path) as draft:
        try:
            for columns in table.chunks():
                chunk = arrow.table(columns, metadata={"haselab": header})
                writer = writer or parquet.ParquetWriter(draft, chunk.schema, compression="zstd")
                writer.write_table(chunk)
        finally:
            if writer is not None:
                writer.close()
    return path
