"""Import the columns of another tool's file as a session: codes, blocks and provenance."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject
from haselab.store.columns.reader import ColumnStream, check_times, open_columns
from haselab.store.columns.selection import AS_THE_FILE_STATES, ColumnOptions
from haselab.store.manifest import Manifest, sha256_of
from haselab.store.session.writer import ExperimentPlan, SessionWriter

__all__ = ["ImportPlan", "Imported", "LengthColumn", "import_session"]

_LARGEST = 32767
_CHUNK_BLOCKS = 200
_FULL_SCALE_V = 10.0  # of a monitor that stands for values at the actuator
_ZERO_PX, _M_PER_PX = 1000.0, 1e-4  # of lengths that no camera saw
_LENGTH_UNITS = {"strain": "1", "displacement": "m", "length": "m"}
_VOLT_PER_MONITOR_VOLT, _AMPERE_PER_MONITOR_VOLT = 5000.0, 2e-3


@dataclass(frozen=True)
class LengthColumn:
    """A column that shows the length of the actuator.

    The session gets it as the tracks of a camera: one frame a block, whose two rows of fiducials
    are as far apart as the mean length in that block.

    Args:
        column: name of it.
        kind: what it contains.
        points: fiducials of a frame, half of them in each row.
        zero_length_m: length at zero strain, in m; None: unknown.
    """

    column: str
    kind: Literal["strain", "displacement", "length"]
    points: int
    zero_length_m: float | None = None

    def rig_keys(self) -> dict[str, float]:
        """Scale and zero of the tracks, as far as they are known."""
        zero_m = self.zero_length_m
        if self.kind == "strain":
            known = {} if zero_m is None else {"scale_m_per_px": zero_m / _ZERO_PX}
            return known | {"zero_length_px": _ZERO_PX}
        zero = {} if zero_m is None else {"zero_length_px": zero_m / _M_PER_PX}
        return {"scale_m_per_px": _M_PER_PX} | zero

    def length_px(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance of the rows of fiducials for values of the column."""
        if self.kind == "strain":
            return _ZERO_PX * (1.0 + values)
        start_m = (self.zero_length_m or 0.0) if self.kind == "displacement" else 0.0
        return (start_m + values) / _M_PER_PX

    def tracks(self, blocks: NDArray[np.float64]) -> NDArray[np.void]:
        """Tracks of the means of some blocks; rows without a number are left out of a mean.

        Args:
            blocks: values of the column. Shape `(B, N)`.
        Returns:
            Shape `(B, points)`; not valid where a block has no number.
        """
        seen = np.isfinite(blocks)
        count = seen.sum(axis=1)
        sums = np.where(seen, blocks, 0.0).sum(axis=1)
        mean = np.divide(sums, count, out=np.full(len(blocks), np.nan), where=count > 0)
        tracks = np.zeros((len(blocks), self.points), SessionWriter.track_dtype())
        tracks["y_px"][:, self.points // 2 :] = self.length_px(mean)[:, None]
        tracks["std_x_px"] = tracks["std_y_px"] = np.nan  # unknown
        tracks["valid"] = (count > 0)[:, None]
        return tracks


@dataclass(frozen=True)
class ImportPlan:
    """How columns become blocks.

    Args:
        experiment: name in the session.
        columns: of the voltage and the current monitor, in V.
        block_samples: samples per channel in one block.
        rate_hz: samples per second and channel; None: that of the file.
        volt_per_code: None: the finest at which all readings fit into 16 bits.
        options: column of times and units, where the file does not state them.
        volt_per_monitor_volt: scale of the voltage monitor; None: 5000.
        ampere_per_monitor_volt: scale of the current monitor, in A/V; None: 0.002.
        carrier_hz: of the sensing signal, if known.
        skew_s: from a voltage sample to its current sample.
        drive: column of the drive voltage ahead of the amplifier, in V; None: there is none.
        length: column that shows the length; None: there is none.
    """

    experiment: str = "imported"
    columns: tuple[str, str] = ("v_monitor_v", "i_monitor_v")
    block_samples: int = 2000
    rate_hz: float | None = None
    volt_per_code: float | None = None
    options: ColumnOptions = AS_THE_FILE_STATES
    volt_per_monitor_volt: float | None = None
    ampere_per_monitor_volt: float | None = None
    carrier_hz: float | None = None
    skew_s: float = 0.0
    drive: str | None = None
    length: LengthColumn | None = None

    @property
    def all_columns(self) -> tuple[str, ...]:
        """The monitors, and the drive and the length where there is one."""
        drive = () if self.drive is None else (self.drive,)
        return (*self.columns, *drive, *(() if self.length is None else (self.length.column,)))


@dataclass(frozen=True)
class _Scale:
    """How values of the columns become codes.

    Args:
        volt_per_code: of both monitors.
        monitor_v: volts of a monitor for one unit of each column, V or A.
        per_monitor_volt: V and A at the actuator for one volt of its monitor.
    """

    volt_per_code: float
    monitor_v: tuple[float, float]
    per_monitor_volt: tuple[float, float]


@dataclass(frozen=True)
class Imported:
    """Summary of an import.

    Args:
        blocks: recorded.
        samples_left: samples at the end that do not fill a block.
        rate_hz: samples per second and channel.
        volt_per_code: of both channels.
        largest_rounding_v: largest rounding error of the codes, in V.
        volt_per_monitor_volt: scale of the voltage monitor in the session.
        ampere_per_monitor_volt: scale of the current monitor in the session, in A/V.
        start_s: time of the first sample in the file; the session counts from 0.
        assumed_seconds: column of times that states no unit and was taken as seconds; empty: none.
    """

    blocks: int
    samples_left: int
    rate_hz: float
    volt_per_code: float
    largest_rounding_v: float
    volt_per_monitor_volt: float
    ampere_per_monitor_volt: float
    start_s: float
    assumed_seconds: str = ""


def import_session(file: Path, folder: Path, plan: ImportPlan) -> Imported:
    """Make a session of two columns.

    Args:
        file: anything that `open_columns` reads.
        folder: for session.h5 and its manifest.
        plan: names, rate, scale.
    Returns:
        What was made.
    Raises:
        InputError: no rate, readings that do not fit the scale or are no numbers, less than a
            block.
    """
    with _open(file, plan) as stream:
        rate_hz, assumed = plan.rate_hz or stream.rate_hz, stream.assumed_seconds
        start_s = stream.start_s
    if plan.rate_hz:
        start_s = check_times(file, plan.rate_hz, plan.options, plan.columns)
    if not rate_hz:
        raise InputError(
            "The file states no sampling rate. Add --rate-hz, or name the column of the times with "
            f"--time. {file}"
        )
    scale = _scale(file, plan)
    volt_per_unit, ampere_per_unit = scale.per_monitor_volt
    header: dict[str, Any] = {
        "rig": {"name": "imported", "rate_hz": rate_hz, "block_samples": plan.block_samples,
                "volt_per_code": scale.volt_per_code, "v_monitor_v_per_v": 1.0 / volt_per_unit,
                "i_monitor_v_per_a": 1.0 / ampere_per_unit, "skew_s": plan.skew_s},
        "source": {"file": file.name, "sha256": sha256_of(file)},
    }  # fmt: skip
    if plan.length is not None:
        header["rig"] |= plan.length.rig_keys()
    if plan.carrier_hz is not None:
        header["sensing"] = {"carrier_hz": plan.carrier_hz}
    points = 1 if plan.length is None else plan.length.points
    settings: JsonObject = {"columns": list(plan.all_columns)}
    plans = [ExperimentPlan(plan.experiment, "imported", points, settings)]
    path = folder / "session.h5"
    with (
        Manifest(folder, header),
        SessionWriter(path, plans, plan.block_samples, header) as session,
        _open(file, plan) as stream,
    ):
        blocks, left, worst_v = _copy(stream, session, plan, scale, rate_hz, file)
    if blocks == 0:
        raise InputError(
            f"The file has {left} samples, but a block has {plan.block_samples}. Lower "
            f"--block-samples, or record for longer. {file}"
        )
    return Imported(
        blocks, left, rate_hz, scale.volt_per_code, worst_v, volt_per_unit, ampere_per_unit,
        start_s, assumed,
    )  # fmt: skip


def _open(file: Path, plan: ImportPlan) -> ColumnStream:
    return open_columns(
        file, plan.all_columns, use_times=plan.rate_hz is None, options=plan.options
    )


def _scale(file: Path, plan: ImportPlan) -> _Scale:
    """Scales of the codes; columns in kV or A are values at the actuator and get a monitor each."""
    with _open(file, plan) as stream:
        v, i, *rest = stream.units
    wanted = [(v, ("V",), "voltage"), (i, ("V", "A"), "current")]
    if plan.drive is not None:
        wanted.append((rest[0], ("V",), "drive"))
    if plan.length is not None:
        wanted.append((rest[-1], (_LENGTH_UNITS[plan.length.kind],), plan.length.kind))
    for unit, good, what in wanted:
        if unit is not None and unit.si not in good:
            needed = "a ratio or in %" if good == ("1",) else f"in {' or '.join(good)}"
            raise InputError(
                f"The column of the {what} is in {unit.symbol}, but must be {needed}. Name another "
                f"column, or state its unit with --unit. {file}"
            )
    peaks = (1.0, 1.0) if plan.volt_per_code else _peaks(file, plan)
    per_volt = [
        plan.volt_per_monitor_volt or _VOLT_PER_MONITOR_VOLT,
        plan.ampere_per_monitor_volt or _AMPERE_PER_MONITOR_VOLT,
    ]
    monitor_v = [1.0, 1.0]
    for k, at_the_actuator in enumerate(
        (v is not None and v.factor > 1.0, i is not None and i.si == "A")
    ):
        if at_the_actuator:
            if plan.volt_per_code is None:
                per_volt[k] = (
                    plan.volt_per_monitor_volt, plan.ampere_per_monitor_volt
                )[k] or peaks[k] / _FULL_SCALE_V  # fmt: skip
            monitor_v[k] = 1.0 / per_volt[k]
    largest = max(peak * factor for peak, factor in zip(peaks, monitor_v, strict=True))
    volt = plan.volt_per_code or largest / (_LARGEST - 1)  # the last code counts as clipped
    return _Scale(volt, (monitor_v[0], monitor_v[1]), (per_volt[0], per_volt[1]))


def _peaks(file: Path, plan: ImportPlan) -> tuple[float, float]:
    peaks = [0.0, 0.0]
    with _open(file, plan) as stream:
        for chunk in stream.chunks(_CHUNK_BLOCKS * plan.block_samples):
            for k, column in enumerate(chunk[:2]):
                if np.issubdtype(column.dtype, np.integer):
                    raise InputError(
                        f"The columns contain integers, codes of a converter. Add --volt-per-code. "
                        f"{file}"
                    )
                peaks[k] = max(peaks[k], float(np.abs(column).max()))
    return peaks[0] or 1.0, peaks[1] or 1.0


def _codes(
    chunk: tuple[NDArray[Any], ...], scale: _Scale, first: int, file: Path
) -> tuple[NDArray[np.int16], float]:
    values = np.stack(chunk, axis=1)
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.int16), 0.0
    volt = scale.volt_per_code
    scaled = values * np.asarray(scale.monitor_v) / volt
    rounded = np.rint(scaled)
    fits = (np.abs(rounded) <= _LARGEST).all(axis=1)
    if not fits.all():
        row = int(np.argmin(fits))
        raise InputError(
            f"Row {first + row + 1} has {values[row].tolist()}, but {volt:g} V per code only reach "
            f"{_LARGEST * volt:g} V. Raise --volt-per-code, or remove values that are not numbers. "
            f"{file}"
        )
    return rounded.astype(np.int16), float(np.abs(rounded - scaled).max() * volt)


def _copy(
    stream: ColumnStream,
    session: SessionWriter,
    plan: ImportPlan,
    scale: _Scale,
    rate_hz: float,
    file: Path,
) -> tuple[int, int, float]:
    samples, count, worst_v = plan.block_samples, 0, 0.0
    rest, rest_v, rest_length = np.empty((0, 2), np.int16), np.empty(0), np.empty(0)
    for chunk in stream.chunks(_CHUNK_BLOCKS * samples):
        codes, lost_v = _codes(chunk[:2], scale, stream.rows_read - len(chunk[0]), file)
        worst_v = max(worst_v, lost_v)
        codes = np.concatenate([rest, codes])
        drive_v = chunk[2].astype(np.float64) if plan.drive else np.full(len(chunk[0]), np.nan)
        drive_v = np.concatenate([rest_v, drive_v])
        whole = len(codes) // samples
        shape = (whole, samples)
        levels_v = np.median(drive_v[: whole * samples].reshape(shape), axis=1)  # one a block
        if plan.length is not None:
            values = np.concatenate([rest_length, chunk[-1].astype(np.float64)])
            rest_length = values[whole * samples :]
            first = samples * np.arange(count, count + whole, dtype=np.float64)
            middle_s = (first + 0.5 * (samples - 1)) / rate_hz
            tracks = plan.length.tracks(values[: whole * samples].reshape(shape))
            session.append_frames(plan.experiment, middle_s, tracks, float("nan"))
        for block, level_v in zip(
            codes[: whole * samples].reshape(*shape, 2), levels_v, strict=True
        ):
            start_s = count * samples / rate_hz
            session.append_block(plan.experiment, block, start_s, float(level_v), float("nan"))
            count += 1
        rest, rest_v = codes[whole * samples :], drive_v[whole * samples :]
    return count, len(rest), worst_v
