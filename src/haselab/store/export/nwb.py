"""Export a session as Neurodata Without Borders, a format that some archives require."""

from __future__ import annotations

import hashlib
import importlib
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from haselab.base import InputError
from haselab.store.folder import drafted
from haselab.store.session.reader import SessionReader

__all__ = ["write_nwb"]

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)  # the session's clock is the acquisition's, not a day's


def write_nwb(reader: SessionReader, path: Path, volt_per_code: float, rate_hz: float) -> None:
    """Write both monitors, the drive and the events; times are those of the acquisition's clock.

    Codes stay integers, with their scale. An experiment whose blocks follow one another without a
    gap has a rate, any other one a time for each block.

    Args:
        reader: of the session.
        path: of the new file.
        volt_per_code: of both monitors.
        rate_hz: samples per second and channel.
    Raises:
        InputError: pynwb is not installed.
    """
    try:
        nwb: Any = importlib.import_module("pynwb")
    except ImportError:
        raise InputError(
            "NWB files need pynwb, which is not installed. "
            f"Run: pip install 'haselab[formats]', or use --to mat. {path}"
        ) from None
    header = json.dumps(reader.header)
    file = nwb.NWBFile(
        session_description="haselab session",
        identifier=hashlib.sha256(header.encode()).hexdigest(),
        session_start_time=_EPOCH,
        notes=header,
    )
    for name in reader.names:
        record = reader.experiment(name)
        if not record.block_start_s.size:
            continue
        blocks, samples, _ = record.codes.shape
        even_s = record.block_start_s[0] + samples / rate_hz * np.arange(blocks)
        if np.allclose(record.block_start_s, even_s, rtol=0.0, atol=0.1 / rate_hz):
            when: dict[str, Any] = {"starting_time": float(even_s[0]), "rate": rate_hz}
        else:
            sample_s = np.arange(samples) / rate_hz
            when = {"timestamps": (record.block_start_s[:, None] + sample_s).ravel()}
        for k, channel in enumerate(("v_monitor", "i_monitor")):
            file.add_acquisition(
                nwb.TimeSeries(name=f"{name}_{channel}", data=record.codes[:, :, k].ravel(),
                               unit="volts", conversion=volt_per_code, **when)
            )  # fmt: skip
        for what, values in (("drive_v", record.drive_v), ("reference", record.reference)):
            file.add_stimulus(
                nwb.TimeSeries(name=f"{name}_{what}", data=values,
                               unit="volts" if what == "drive_v" else "strain",
                               timestamps=record.block_start_s)
            )  # fmt: skip
    events = reader.events()
    if events:
        columns = [
            nwb.core.VectorData(name="time_s", description="of the acquisition's clock",
                                data=[time_s for time_s, _ in events]),
            nwb.core.VectorData(name="what", description="happened",
                                data=[what for _, what in events]),
        ]  # fmt: skip
        file.add_acquisition(
            nwb.core.DynamicTable(name="events", description="of the session", columns=columns)
        )
    with drafted(path) as draft, nwb.NWBHDF5IO(str(draft), "w") as out:
        out.write(file)
