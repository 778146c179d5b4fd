"""A session as pandas tables and as an xarray data set."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from haselab.base import InputError
from haselab.store.export.session import Derived, nothing_derived
from haselab.store.export.tables import event_table, tables_of
from haselab.store.optional import library
from haselab.store.session.layout import Sampling
from haselab.store.session.reader import SessionReader, session_file

if TYPE_CHECKING:
    import pandas
    import xarray

__all__ = ["session_dataset", "session_tables"]

_UNITS = {"_v": "V", "_s": "s", "_f": "F", "_ohm": "ohm", "_m": "m", "_kg": "kg", "_px": "px"}


def _scales(reader: SessionReader, path: Path) -> tuple[float, float]:
    """Volts per code and samples per second."""
    sampling = Sampling.of_header(1, reader.header)
    if sampling.volt_per_code is None or sampling.rate_hz is None:
        raise InputError(
            "The session's header lacks rig.volt_per_code or rig.rate_hz, so its codes cannot be "
            f"converted to volts and seconds. Record again with this version. {path}"
        )
    return sampling.volt_per_code, sampling.rate_hz


def session_tables(
    path: str | Path,
    experiment: str,
    *,
    derived: Derived = nothing_derived,
) -> dict[str, pandas.DataFrame]:
    """One experiment of a session as pandas tables.

    Args:
        path: of session.h5 or the folder that holds it.
        experiment: its name.
        derived: gives tables of columns that follow from an experiment, by name, such as
            `haselab.pipelines.sensing.series.derived_series`.
    Returns:
        `monitors` (time_s, v_monitor_v, i_monitor_v; a row a sample), `blocks`, `tracks`,
        `events`, and the derived ones.
    Raises:
        InputError: no session, no such experiment, or pandas is not installed.
    """
    frames = library("pandas", "frames")
    path = session_file(path)
    with SessionReader(path) as reader:
        reader.experiment(experiment)  # refuses an unknown name
        scales = _scales(reader, path)
        recorded = tables_of(reader, experiment, "", *scales)
        tables = dict(zip(("monitors", "blocks", "tracks"), recorded, strict=True))
        tables["events"] = event_table(reader)
        found = {}
        for name, table in tables.items():
            chunks = [frames.DataFrame(chunk) for chunk in table.chunks()]
            found[name] = frames.concat(chunks, ignore_index=True) if chunks[1:] else chunks[0]
        for name, columns in derived(reader, experiment).items():
            found[name] = frames.DataFrame(columns)
    return found


def session_dataset(
    path: str | Path,
    experiment: str,
    *,
    derived: Derived = nothing_derived,
) -> xarray.Dataset:
    """One experiment of a session as an xarray data set.

    Args:
        path: of session.h5 or the folder that holds it.
        experiment: its name.
        derived: as of `session_tables`.
    Returns:
        `v_monitor_v` and `i_monitor_v` over `block` and `sample`, with the coordinates `start_s`
        and `sample_s`; `drive_v` and `reference` over `block`; the tracks over `frame` and
        `point`; derived series each over a dimension of its own name. Variables have the attribute
        `units`, the data set the experiment's settings as JSON.
    Raises:
        InputError: no session, no such experiment, or xarray is not installed.
    """
    xarray_library = library("xarray", "frames")
    path = session_file(path)
    with SessionReader(path) as reader:
        record = reader.experiment(experiment)
        volt_per_code, rate_hz = _scales(reader, path)
        series_of = derived(reader, experiment)
    volts = (record.codes * volt_per_code).astype(np.float32)
    data: dict[str, Any] = {
        "v_monitor_v": (("block", "sample"), volts[:, :, 0]),
        "i_monitor_v": (("block", "sample"), volts[:, :, 1]),
        "drive_v": ("block", record.drive_v),
        "reference": ("block", record.reference),
        "mass_kg": ("frame", record.mass_kg),
    }
    for field in record.tracks.dtype.names or ():
        data[field] = (("frame", "point"), record.tracks[field])
    coordinates: dict[str, Any] = {
        "start_s": ("block", record.block_start_s),
        "sample_s": ("sample", np.arange(volts.shape[1]) / rate_hz),
        "frame_s": ("frame", record.frame_time_s),
    }
    for series, columns in series_of.items():
        for name, values in columns.items():
            own = name if name.startswith(series) else f"{series}_{name}"
            (coordinates if name == "time_s" else data)[own] = (series, values)
    attributes = {
        "experiment": record.name,
        "kind": record.kind,
        "settings": json.dumps(record.settings),
    }
    dataset: xarray.Dataset = xarray_library.Dataset(data, coordinates, attributes)
    for key, variable in dataset.variables.items():
        unit = next((unit for end, unit in _UNITS.items() if str(key).endswith(end)), None)
        if unit is not None:
            variable.attrs["units"] = unit
    return dataset
