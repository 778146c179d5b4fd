"""Series computed from a recorded experiment: capacitance of each block, strain over time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, is_real, shown, table_at
from haselab.pipelines.sensing.source import Request, session_config
from haselab.pipelines.sensing.table import columns_of
from haselab.runtime.observer import FIDUCIALS
from haselab.sensing import Lockin
from haselab.store.actuator_file import ACTUATOR, read_actuator
from haselab.store.session.layout import ExperimentRecord
from haselab.store.session.reader import SessionReader
from haselab.study.fits.observe import gauge_length

__all__ = ["DEFAULT_REQUEST", "derived_series", "known_zero_length_m"]

Columns = dict[str, NDArray[Any]]
_SWITCH, _SCALE, _ZERO = ("rig", "switch_sample"), "scale_m_per_px", ("rig", "zero_length_px")
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


def derived_series(
    reader: SessionReader, experiment: str, *, zero_length_m: float | None = None
) -> Mapping[str, Columns]:
    """Compute capacitance and strain of one experiment of a session.

    Args:
        reader: of the session, open.
        experiment: its name.
        zero_length_m: length at zero strain, in m, for the column `strain`. None: that of an
            imported session, else `zero_length_m` of the actuator file beside the session.
    Returns:
        `capacitance` (time_s, capacitance_f, capacitance_std_f, resistance_ohm,
        relative_capacitance, valid; one row per block) if the session states its carrier, and
        `strain` (time_s, length_px, strain_from_start; if the scale is known, length_m; if there
        are blocks, voltage_v, the mean drive voltage until the next frame; if the zero length is
        known, strain; one row per frame) if the frames show both rows of fiducials.
    Raises:
        InputError: no such experiment, its data cannot be read, or a zero length for a session
            without scale.
    """
    record = reader.experiment(experiment)
    found: dict[str, Columns] = {}
    if len(record.codes) and any(reader.states(*keys) for keys in _CARRIERS):
        found["capacitance"] = _capacitance(reader, record)
    if record.tracks.ndim == 2 and record.tracks.shape[1] == FIDUCIALS and record.tracks.size:
        found["strain"] = _strain(reader, record, zero_length_m)
    return found


def known_zero_length_m(session: Path) -> float | None:
    """`zero_length_m` of the actuator file beside a session, such as that of its run, in m.

    Args:
        session: path of the session.
    Returns:
        The length at zero strain; None: there is no such file, or it does not state one.
    Raises:
        InputError: the file cannot be read, or its length is not a positive number.
    """
    path = session.parent / ACTUATOR
    if not path.is_file():
        return None
    found = table_at(read_actuator(path), "actuator", "geometry").get("zero_length_m")
    if found is None:
        return None
    if not is_real(found) or not 0.0 < found < math.inf:
        raise InputError(
            f"zero_length_m in [actuator.geometry] is {shown(found)}, but must be a positive "
            f"length in m. Write one, or remove the key. {path}"
        )
    return float(found)


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


def _strain(
    reader: SessionReader, record: ExperimentRecord, zero_length_m: float | None
) -> Columns:
    """Distance of the rows of fiducials, and its change since the first frame that shows them."""
    length_px = gauge_length(record.tracks, 1.0)
    good = np.flatnonzero(np.isfinite(length_px))
    start_px = length_px[good[0]] if good.size else np.nan
    columns = {"time_s": record.frame_time_s}
    if record.drive_v.size and len(record.frame_time_s) > 1 and reader.states(*_SWITCH):
        delay_s = reader.stated(*_SWITCH) / reader.stated("rig", "rate_hz")
        columns["voltage_v"] = _mean_voltage(record, delay_s)
    columns["length_px"] = length_px
    scaled = isinstance(reader.header.get("rig", {}).get(_SCALE), float)
    if zero_length_m is not None or scaled:
        columns["length_m"] = length_px * reader.stated("rig", _SCALE)
    columns["strain_from_start"] = length_px / start_px - 1.0
    if zero_length_m is not None:
        columns["strain"] = columns["length_m"] / zero_length_m - 1.0
    elif reader.states(*_ZERO):  # of an imported strain
        columns["strain"] = length_px / reader.stated(*_ZERO) - 1.0
    elif scaled and (zero_m := known_zero_length_m(reader.path)) is not None:
        columns["strain"] = columns["length_m"] / zero_m - 1.0
    return columns


def _mean_voltage(record: ExperimentRecord, delay_s: float) -> NDArray[np.float64]:
    """Mean of the drive from each frame to the next, as a model with a held input expects it.

    Args:
        record: the experiment.
        delay_s: from the start of a block until its output takes effect.
    """
    switch_s, drive_v = record.block_start_s + delay_s, record.drive_v
    from_s = np.append(record.frame_time_s, 2.0 * record.frame_time_s[-1] - record.frame_time_s[-2])
    volt_s = np.append(0.0, np.cumsum(np.diff(switch_s) * drive_v[:-1]))
    block = np.clip(np.searchsorted(switch_s, from_s, side="right") - 1, 0, None)
    sums = volt_s[block] + (from_s - switch_s[block]) * drive_v[block]
    return np.asarray(np.diff(sums) / np.diff(from_s))
