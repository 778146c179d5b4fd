"""Series computed from a recorded experiment: capacitance of each block, strain over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.pipelines.sensing.source import Request, session_config
from haselab.pipelines.sensing.table import columns_of
from haselab.runtime.observer import FIDUCIALS
from haselab.sensing import Lockin
from haselab.store.session.layout import ExperimentRecord
from haselab.store.session.reader import SessionReader
from haselab.study.fits.observe import gauge_length

__all__ = ["DEFAULT_REQUEST", "derived_series"]

Columns = dict[str, NDArray[Any]]
_CARRIERS = (("study", "sensing", "carrier_hz"), ("sensing", "carrier_hz"))
_NAMES = (
    "time_s", "capacitance_f", "capacitance_std_f", "resistance_ohm", "relative_capacitance",
)  # fmt: skip
DEFAULT_REQUEST = Request(
    carrier_hz=None, rate_hz=None, block_s=None, method="lockin", skew_s=None, blank_s=None,
    volt_per_monitor_volt=None, ampere_per_monitor_volt=None, reactance_scale=2.5e6,
    capacitance_scale=10.0, calibration=None, amplifier=None, full_scale_v=None,
    current_limit_a=None, experiment=None, v_column="", i_column="", unverified=False,
)  # fmt: skip


def derived_series(reader: SessionReader, experiment: str) -> Mapping[str, Columns]:
    """Compute capacitance and strain of one experiment of a session.

    Args:
        reader: of the session, open.
        experiment: its name.
    Returns:
        `capacitance` (time_s, capacitance_f, capacitance_std_f, resistance_ohm,
        relative_capacitance, valid; one row per block) if the session states its carrier, and
        `strain` (time_s, length_px, strain_from_start and, if the scale is known, length_m; one
        row per frame) if the frames show both rows of fiducials.
    Raises:
        InputError: no such experiment, or its data cannot be read.
    """
    record = reader.experiment(experiment)
    found: dict[str, Columns] = {}
    if len(record.codes) and any(reader.states(*keys) for keys in _CARRIERS):
        found["capacitance"] = _capacitance(reader, record)
    if record.tracks.ndim == 2 and record.tracks.shape[1] == FIDUCIALS and record.tracks.size:
        found["strain"] = _strain(record.tracks, record.frame_time_s, reader.header)
    return found


def _capacitance(reader: SessionReader, record: ExperimentRecord) -> Columns:
    blocks, samples, _ = record.codes.shape
    config = session_config(reader, samples, DEFAULT_REQUEST, Path(record.name))
    sensed = Lockin(config).sense(record.codes)
    columns = columns_of(
        sensed,
        time_s=sensed.time_s - config.block_s * np.arange(blocks) + record.block_start_s,
        volt_per_reading=float(reader.stated("rig", "volt_per_code")),
        frequency_hz=config.carrier_hz,
        reactance_scale=DEFAULT_REQUEST.reactance_scale,
        capacitance_scale=DEFAULT_REQUEST.capacitance_scale,
    )
    return {name: np.asarray(columns[name]) for name in _NAMES} | {"valid": sensed.valid}


def _strain(tracks: NDArray[np.void], time_s: NDArray[np.float64], header: Any) -> Columns:
    """Distance of the rows of fiducials, and its change since the first frame that shows them."""
    length_px = gauge_length(tracks, 1.0)
    good = np.flatnonzero(np.isfinite(length_px))
    start_px = length_px[good[0]] if good.size else np.nan
    columns = {"time_s": time_s, "length_px": length_px}
    scale = header.get("rig", {}).get("scale_m_per_px")
    if isinstance(scale, float):
        columns["length_m"] = length_px * scale
    return columns | {"strain_from_start": length_px / start_px - 1.0}
