"""Export a session for other tools: CSV, Parquet, MATLAB, LabVIEW's TDMS, NWB."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.columns.mat_struct import write_mat_structs
from haselab.store.export.nwb import write_nwb
from haselab.store.export.tables import (
    DERIVED,
    ENDINGS,
    EVENTS,
    Columns,
    Table,
    event_table,
    table_of,
    tables_of,
    write_csv,
    write_parquet,
)
from haselab.store.folder import drafted, write_text
from haselab.store.names import check_name, matlab_names, table_names
from haselab.store.session.layout import Sampling
from haselab.store.session.reader import SessionReader, session_file

__all__ = ["FOLDERS", "FORMS", "Derived", "Exported", "export_session", "nothing_derived"]

# Tables of columns that follow from the experiment of a name.
Derived = Callable[[SessionReader, str], Mapping[str, Columns]]

_CHUNK_BLOCKS = 500
_MAT_BYTES = 2**31 - 2**20  # of one variable in a file of version 5
_SESSION = "session"  # the variable of a MATLAB file with header and events
_RAW_INPUT = 0xFFFFFFFF  # of LabVIEW's scales: the numbers as they are stored


@dataclass(frozen=True)
class _Source:
    """A session to export.

    Args:
        path: of session.h5.
        reader: open.
        volt_per_code: of both monitors.
        rate_hz: samples per second and channel.
        experiments: the name of each on its way out.
        derived: gives the series that follow from an experiment, by name.
        empty: names of the tables that were left out because they have no rows.
    """

    path: Path
    reader: SessionReader
    volt_per_code: float
    rate_hz: float
    experiments: dict[str, str]
    derived: Derived
    empty: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Exported:
    """Summary of an export.

    Args:
        files: written.
        experiments: the name of each in these files.
        doubt: why their numbers are not verified; empty where they are.
        unreadable: experiments that were left out, and why.
        empty: tables of csv and parquet that were not written because they have no rows.
    """

    files: list[Path]
    experiments: dict[str, str]
    doubt: str
    unreadable: dict[str, str]
    empty: list[str]


def nothing_derived(reader: SessionReader, name: str) -> Mapping[str, Columns]:
    """No tables that follow from an experiment."""
    del reader, name
    return {}


def export_session(
    path: Path,
    form: str,
    out: Path,
    *,
    experiments: Sequence[str] = (),
    derived: Derived = nothing_derived,
    unverified: bool = False,
) -> Exported:
    """Write a session for another tool; every reading of its monitors can be got back.

    Each file appears when it is whole; an export that fails leaves none behind.

    Args:
        path: of session.h5 or the folder that holds it.
        form: a key of `FORMS`.
        out: file to write, or the folder for csv and parquet.
        experiments: names of those to write; none: all.
        derived: gives tables of columns, by name, that follow from an experiment, such as its
            capacitance; they are written beside it. NWB files leave them out.
        unverified: read on where a checksum does not match, and leave out what cannot be read.
    Returns:
        What was written. Where the numbers are not verified, the exported header says
        `"unverified": true`, and `"unreadable"` names the experiments that are left out.
    Raises:
        InputError: unknown form, no session, no such experiment, a session without scale, one too
            large for the form, or a library that is missing.
    """
    if form not in FORMS:
        raise InputError(f"Unknown format {form!r}. Use one of {', '.join(FORMS)}.")
    path = session_file(path)
    with SessionReader(path, unverified=unverified) as reader:
        _keep_only(reader, experiments, path)
        for name in reader.names:
            check_name(name)
        unreadable = _leave_out(reader) if unverified else {}
        if reader.doubt:
            reader.header["unverified"] = True
        if unreadable:
            reader.header["unreadable"] = unreadable
        sampling = Sampling.of_header(1, reader.header)
        if sampling.volt_per_code is None or sampling.rate_hz is None:
            raise InputError(
                f"The session's header lacks rig.volt_per_code or rig.rate_hz, so its codes cannot "
                f"be converted to volts and seconds. Record again with this version. {path}"
            )
        new_names = _names_of(reader, form)
        source = _Source(path, reader, sampling.volt_per_code, sampling.rate_hz, new_names, derived)
        (out if form in FOLDERS else out.parent).mkdir(parents=True, exist_ok=True)
        files: list[Path] = []
        try:
            for file in FORMS[form](source, out):
                files.append(file)
        except BaseException:
            for file in files:
                file.unlink(missing_ok=True)
            raise
        return Exported(files, new_names, reader.doubt, unreadable, source.empty)


def _keep_only(reader: SessionReader, wanted: Sequence[str], path: Path) -> None:
    """Take all other experiments from the names of a reader."""
    for name in wanted:
        if name not in reader.names:
            raise InputError(
                f"The session has no experiment '{name}', only "
                f"{', '.join(reader.names) or 'none at all'}. Name one of them: {path}"
            )
    if wanted:
        reader.names[:] = [name for name in reader.names if name in wanted]


def _leave_out(reader: SessionReader) -> dict[str, str]:
    """Take the experiments that cannot be read from the names of a reader."""
    unreadable: dict[str, str] = {}
    for name in list(reader.names):
        try:
            reader.experiment(name)
        except InputError as error:
            unreadable[name] = str(error)
            reader.names.remove(name)
    return unreadable


def _names_of(reader: SessionReader, form: str) -> dict[str, str]:
    """What each experiment is called in the other tool's files: no two the same."""
    if form in FOLDERS:
        return table_names(reader.names, (*ENDINGS, *DERIVED), (EVENTS,))
    if form == "mat":
        return matlab_names(reader.names, (_SESSION,))
    return {name: name for name in reader.names}


def _tables(source: _Source) -> Iterator[Table]:
    """The tables that have rows."""
    for table in _all_tables(source):
        if all(column.size for column in next(table.chunks()).values()):
            yield table
        else:
            source.empty.append(table.name)


def _all_tables(source: _Source) -> Iterator[Table]:
    yield event_table(source.reader)
    for name, table in source.experiments.items():
        yield from tables_of(source.reader, name, table, source.volt_per_code, source.rate_hz)
        for series, columns in source.derived(source.reader, name).items():
            yield table_of(f"{table}-{series}", columns)


def _header(source: _Source) -> dict[str, Any]:
    """Of the session, with the names of tables that are not those of their experiments."""
    new = {name: table for name, table in source.experiments.items() if name != table}
    return source.reader.header | ({"exported_as": new} if new else {})


def _csv(source: _Source, out: Path) -> Iterator[Path]:
    write_text(out / "header.json", json.dumps(_header(source), indent=1) + "\n")
    yield out / "header.json"
    yield from (write_csv(table, out) for table in _tables(source))


def _parquet(source: _Source, out: Path) -> Iterator[Path]:
    header = json.dumps(_header(source))
    yield from (write_parquet(table, out, header) for table in _tables(source))


def _mat(source: _Source, out: Path) -> Iterator[Path]:
    structs: dict[str, dict[str, Any]] = {}
    for name in source.reader.names:
        record = source.reader.experiment(name)
        size = 2 * record.codes.size  # single precision of one channel
        if size > _MAT_BYTES:
            raise InputError(
                f"A channel of {name!r} has {size / 1e9:.1f} GB, but a MATLAB file of version 5 "
                "can hold only 2.1 GB. Read the session in MATLAB with h5read, or use --to "
                f"parquet. {source.path}"
            )
        volts = (record.codes * source.volt_per_code).astype(np.float32)
        structs[source.experiments[name]] = {
            "name": name,
            "kind": record.kind,
            "settings": json.dumps(record.settings),
            "rate_hz": source.rate_hz,
            "volt_per_code": source.volt_per_code,
            "v_monitor_v": volts[:, :, 0].ravel(),
            "i_monitor_v": volts[:, :, 1].ravel(),
            "block_start_s": record.block_start_s,
            "drive_v": record.drive_v,
            "reference": record.reference,
            "frame_time_s": record.frame_time_s,
            "mass_kg": record.mass_kg,
        } | {field: record.tracks[field] for field in record.tracks.dtype.names or ()}
        structs[source.experiments[name]] |= dict(source.derived(source.reader, name))
    events = source.reader.events()
    structs[_SESSION] = {
        "header": json.dumps(source.reader.header),
        "event_time_s": np.array([time_s for time_s, _ in events]),
        "event": np.array([what for _, what in events], dtype=object),
    }
    write_mat_structs(out, structs)
    yield out


def _tdms(source: _Source, out: Path) -> Iterator[Path]:
    try:
        tdms: Any = importlib.import_module("nptdms")
    except ImportError:
        raise InputError(
            "LabVIEW files need nptdms, which is not installed. "
            f"Run: pip install 'haselab[formats]', or use --to csv. {out}"
        ) from None
    scale = {
        "unit_string": "V",
        "wf_increment": 1.0 / source.rate_hz,
        "NI_Scaling_Status": "unscaled",
        "NI_Number_Of_Scales": 1,
        "NI_Scale[0]_Scale_Type": "Linear",
        "NI_Scale[0]_Linear_Slope": source.volt_per_code,
        "NI_Scale[0]_Linear_Y_Intercept": 0.0,
        "NI_Scale[0]_Linear_Input_Source": tdms.types.Uint32(_RAW_INPUT),
    }
    root = tdms.RootObject(properties={"header": json.dumps(source.reader.header)})
    with drafted(out) as draft, tdms.TdmsWriter(draft) as writer:
        writer.write_segment([root])
        for name in source.reader.names:
            for rows in _pieces(source.reader, name):
                channels: list[tuple[str, NDArray[Any], dict[str, Any]]] = [
                    ("v_monitor_v", rows.codes[:, :, 0].ravel(), scale),
                    ("i_monitor_v", rows.codes[:, :, 1].ravel(), scale),
                    ("block_start_s", rows.start_s, {"unit_string": "s"}),
                    ("drive_v", rows.drive_v, {"unit_string": "V"}),
                    ("reference", rows.reference, {}),
                ]
                writer.write_segment(
                    [
                        tdms.ChannelObject(name, each, values, properties)
                        for each, values, properties in channels
                    ]
                )
            for series, columns in source.derived(source.reader, name).items():
                named = {
                    each if each.startswith(series) else f"{series}_{each}": values
                    for each, values in columns.items()
                }
                writer.write_segment(
                    [tdms.ChannelObject(name, each, values) for each, values in named.items()]
                )
    yield out


def _pieces(reader: SessionReader, name: str) -> Iterator[Any]:
    first = 0
    while True:
        rows = reader.follow(name, first, _CHUNK_BLOCKS)
        if not rows.start_s.size:
            return
        yield rows
        first += rows.start_s.size


def _nwb(source: _Source, out: Path) -> Iterator[Path]:
    write_nwb(source.reader, out, source.volt_per_code, source.rate_hz)
    yield out


FORMS: dict[str, Callable[[_Source, Path], Iterator[Path]]] = {
    "csv": _csv,
    "mat": _mat,
    "nwb": _nwb,
    "parquet": _parquet,
    "tdms": _tdms,
}
FOLDERS = ("csv", "parquet")
