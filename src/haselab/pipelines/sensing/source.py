"""Open the input of `haselab sense`: both monitors of a file or a session, and their scales."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.sensing import ChargeConfig, LockinConfig
from haselab.store.columns.reader import (
    ColumnStream,
    check_rate,
    check_times,
    open_columns,
)
from haselab.store.columns.selection import (
    AS_THE_FILE_STATES,
    ColumnOptions,
)
from haselab.store.columns.units import Unit
from haselab.store.session.reader import SessionReader, session_file

if TYPE_CHECKING:
    from haselab.store.columns.session import SessionColumns

# Modules for sessions and calibrations are imported where these are opened: importing HDF5 and the
# rig takes longer than sensing a gigabyte.

__all__ = [
    "Request",
    "Source",
    "at_the_actuator",
    "lockin_config",
    "open_source",
    "session_config",
    "too_short",
]

_MOST_SAMPLES = 2_000_000  # of a block
_VOLT_PER_MONITOR_VOLT, _AMPERE_PER_MONITOR_VOLT = 5000.0, 2e-3
_BLOCK_S, _CHARGE_BLOCK_S = 0.01, 0.5
_SHORTEST, _SHORTEST_CHARGE = 8, 16  # samples of a block
_NO_CONVERTER_V = 1e6  # full scale for volts at the actuator
_FULL_SCALE_V, _FULL_SCALE_CODES = 10.0, 32767.0
_LAST_CODE = 1.0 - 0.5**11  # of full scale: last code of the coarsest converter, 12 bits
_MIN_AMPLITUDE_V = 1e-6  # below any converter's step: a channel that is not connected
_MIN_AMPLITUDE_CODES = 5.0
_RATE_ROWS = 4096  # number of times that are compared with --rate-hz
_CHUNK_ROWS = 1 << 20  # 8 MB per column in double precision


@dataclass(frozen=True)
class Request:
    """The options, besides those for file and output; None: not given."""

    carrier_hz: float | None
    rate_hz: float | None
    block_s: float | None
    method: str
    skew_s: float | None
    blank_s: float | None
    volt_per_monitor_volt: float | None
    ampere_per_monitor_volt: float | None
    reactance_scale: float
    capacitance_scale: float
    calibration: Path | None
    amplifier: str | None
    full_scale_v: float | None
    current_limit_a: float | None
    experiment: str | None
    v_column: str
    i_column: str
    unverified: bool
    columns: ColumnOptions = AS_THE_FILE_STATES


@dataclass(frozen=True)
class Source:
    """Both monitors, and the configuration of the method.

    Args:
        stream: voltage, then current.
        config: for the method.
        volt_per_reading: 1 for records in volts.
        session: of these blocks, if there is one.
        in_monitor_volts: the scale of the voltage was not stated; the default is used.
        start_s: time of the first sample of a file, by its column of times.
    """

    stream: ColumnStream
    config: LockinConfig | ChargeConfig
    volt_per_reading: float
    session: SessionColumns | None = None
    in_monitor_volts: bool = False
    start_s: float = 0.0

    def chunks(self) -> Iterator[tuple[NDArray[Any], ...]]:
        """Yield both columns in parts; all but the last consist of whole blocks."""
        blocks = max(1, _CHUNK_ROWS // self.config.block_samples)
        return self.stream.chunks(blocks * self.config.block_samples)

    def block_start_s(self, first: int, count: int) -> NDArray[np.float64]:
        """Time of each block's first sample, shape `(count,)`, by the clock of session or file."""
        if self.session is not None:
            return self.session.block_start_s(first, count)
        start_s = self.config.block_s * np.arange(first, first + count, dtype=np.float64)
        return self.start_s + start_s


def open_source(path: Path, request: Request, opened: ExitStack) -> Source:
    """Open a file or a session.

    Args:
        path: of it.
        request: the options.
        opened: exit stack that closes the file.
    Returns:
        The monitors, and the configuration.
    Raises:
        InputError: the file cannot be sensed, or options are missing.
    """
    if session_file(path).is_file():
        path = session_file(path)
    if request.method == "charge":
        _refuse_with_charge(request, path)
    experiment = request.experiment
    if experiment is None and path.suffix.lower() in (".h5", ".hdf5"):
        experiment = _only_experiment(path, request)
    if experiment is not None:
        from haselab.store.columns.session import SessionColumns

        session = opened.enter_context(
            SessionColumns(path, experiment, unverified=request.unverified)
        )
        source = _of_session(session, request, path)
    else:
        source = _of_file(path, request, opened)
    if request.calibration is None:
        return source
    return replace(source, config=_calibrated(request.calibration, request, source))


def _refuse_with_charge(request: Request, path: Path) -> None:
    """Refuse options about the carrier."""
    given = {
        "--carrier-hz": request.carrier_hz,
        "--blank-s": request.blank_s,
        "--calibration": request.calibration,
        "--experiment": request.experiment,
    }
    for name, value in given.items():
        if value is not None:
            raise InputError(
                f"{name} is {value}, but --method charge senses plain files without a carrier. "
                f"Leave out {name}, or use --method lockin. {path}"
            )


def _only_experiment(path: Path, request: Request) -> str | None:
    """The only experiment of a session; None for a file that is no session."""
    from haselab.store.columns.session import session_experiments

    experiments = session_experiments(path, unverified=request.unverified)
    if experiments is not None and len(experiments) == 1 and request.method != "charge":
        return experiments[0]
    if experiments is not None:
        raise InputError(
            f"The file is a session with the experiments {', '.join(experiments) or 'none'}. Name "
            f"one with --experiment. {path}"
        )
    return None


def _calibrated(path: Path, request: Request, source: Source) -> LockinConfig:
    from haselab.pipelines.calibration_file import load_calibration

    calibration = load_calibration(path)
    amplifier = request.amplifier
    if amplifier is None and source.session is not None and not _is_imported(source.session):
        amplifier = str(source.session.stated("rig", "amplifier"))
    assert isinstance(source.config, LockinConfig)  # a calibration is refused without a carrier
    return calibration.apply(
        source.config,
        amplifier=calibration.amplifier if amplifier is None else amplifier,
        volt_per_reading=source.volt_per_reading,
    )


def _ohm_per_ratio(request: Request, volt: float, ampere: float) -> tuple[float, float]:
    """Impedance for equal readings, and amperes per volt of the current monitor."""
    volt = request.volt_per_monitor_volt or volt
    ampere = request.ampere_per_monitor_volt or ampere
    return volt / ampere, ampere


def _limit(request: Request, ampere: float, volt_per_reading: float) -> float:
    if request.current_limit_a is None:
        return float("inf")
    return request.current_limit_a / ampere / volt_per_reading


def _of_file(path: Path, request: Request, opened: ExitStack) -> Source:
    """Open a record in volts."""
    stream = opened.enter_context(
        open_columns(
            path, (request.v_column, request.i_column),
            use_times=request.rate_hz is None, options=request.columns,
        )
    )  # fmt: skip
    request = at_the_actuator((stream.units[0], stream.units[1]), request, path)
    rate_hz, start_s = _rate_hz(stream, request, path)
    charge = request.method == "charge"
    if request.carrier_hz is None and not charge:
        raise InputError(
            "The file states no carrier. Add --carrier-hz, or sense a record without a "
            f"carrier with --method charge. {path}"
        )
    if rate_hz is None:
        raise InputError(
            "The file states no sampling rate. Add --rate-hz, or name the column of the times with "
            f"--time. {path}"
        )
    block_s = request.block_s or (_CHARGE_BLOCK_S if charge else _BLOCK_S)
    block_samples = round(block_s * rate_hz)
    shortest = _SHORTEST_CHARGE if charge else _SHORTEST
    if not shortest <= block_samples <= _MOST_SAMPLES:
        where = "--rate-hz" if request.rate_hz else "the file"
        unit = "" if request.rate_hz else ", or convert the file's times if they are not in s"
        raise InputError(
            f"--block-s {block_s:g} gives a block of {block_samples:.3g} samples at the rate of "
            f"{where}, {rate_hz:.6g} Hz, but a block needs {shortest} to {_MOST_SAMPLES} samples. "
            f"Choose another --block-s{unit}. {path}"
        )
    if stream.rows is not None and stream.rows < block_samples:
        raise too_short(stream.rows, block_samples, rate_hz, path)
    if charge:
        config: LockinConfig | ChargeConfig = _charge_config(request, rate_hz, block_samples)
    else:
        config = lockin_config(request, rate_hz, block_samples)
    unscaled = request.volt_per_monitor_volt is None
    return Source(stream, config, 1.0, in_monitor_volts=unscaled, start_s=start_s)


def at_the_actuator(
    units: tuple[Unit | None, Unit | None], request: Request, source: Path | str
) -> Request:
    """Derive scales from stated units: kV and A are actuator values, V may be a monitor voltage.

    Args:
        units: of the columns of voltage and current; None where none is stated.
        request: scales that it states are kept.
        source: of the columns, for messages.
    Returns:
        The request with the scales.
    Raises:
        InputError: a unit of another quantity.
    """
    v, i = units
    for option, unit, good in (("--v", v, ("V",)), ("--i", i, ("V", "A"))):
        if unit is not None and unit.si not in good:
            raise InputError(
                f"The column of {option} is in {unit.symbol}, but must be in {' or '.join(good)}. "
                f"Name another column, or state its unit with --unit. {source}"
            )
    if v is not None and v.factor > 1.0 and request.volt_per_monitor_volt is None:
        request = replace(
            request, volt_per_monitor_volt=1.0, full_scale_v=request.full_scale_v or _NO_CONVERTER_V
        )
    if i is not None and i.si == "A" and request.ampere_per_monitor_volt is None:
        request = replace(request, ampere_per_monitor_volt=1.0)
    return request


def _rate_hz(stream: ColumnStream, request: Request, path: Path) -> tuple[float | None, float]:
    """Rate as given, else from the file, which must agree; and the time of the first row."""
    given = request.rate_hz
    if given is None:
        return stream.rate_hz, stream.start_s
    if stream.rate_hz is not None:
        check_rate(given, stream.rate_hz, _RATE_ROWS, "the file's own rate", path)
        return given, stream.start_s
    names = request.v_column, request.i_column
    return given, check_times(path, given, request.columns, names)


def _charge_config(request: Request, rate_hz: float, block_samples: int) -> ChargeConfig:
    ohm, ampere = _ohm_per_ratio(request, _VOLT_PER_MONITOR_VOLT, _AMPERE_PER_MONITOR_VOLT)
    return ChargeConfig(
        rate_hz=rate_hz,
        block_samples=block_samples,
        ohm_per_ratio=ohm,
        skew_s=request.skew_s or 0.0,
        full_scale=(request.full_scale_v or _FULL_SCALE_V) * _LAST_CODE,
        current_limit=_limit(request, ampere, 1.0),
    )


def lockin_config(request: Request, rate_hz: float, block_samples: int) -> LockinConfig:
    """Settings of the demodulation for monitors in volts, the usual ones where none is given.

    Args:
        request: with a carrier.
        rate_hz: samples a second, in Hz.
        block_samples: samples in a block.
    Returns:
        The settings.
    """
    assert request.carrier_hz is not None
    ohm, ampere = _ohm_per_ratio(request, _VOLT_PER_MONITOR_VOLT, _AMPERE_PER_MONITOR_VOLT)
    return LockinConfig(
        rate_hz=rate_hz,
        block_samples=block_samples,
        carrier_hz=request.carrier_hz,
        skew_s=request.skew_s or 0.0,
        ohm_per_ratio=ohm,
        blank=(0, round((request.blank_s or 0.0) * rate_hz)),
        search_updates=request.blank_s is None and request.method == "lockin",
        min_amplitude_codes=_MIN_AMPLITUDE_V,
        full_scale=(request.full_scale_v or _FULL_SCALE_V) * _LAST_CODE,
        current_limit=_limit(request, ampere, 1.0),
    )


def _of_session(session: SessionColumns, request: Request, path: Path) -> Source:
    """Open the codes of an experiment; options override the settings of the session."""
    config = session_config(session, session.block_samples, request, path)
    volt_per_code = float(session.stated("rig", "volt_per_code"))
    return Source(session.columns(), config, volt_per_code, session)


def session_config(
    session: SessionReader, block_samples: int, request: Request, path: Path
) -> LockinConfig:
    """Configuration for sensing the codes of a session.

    Args:
        session: open.
        block_samples: samples of a channel in one of its blocks.
        request: the options.
        path: of the session, for messages.
    Returns:
        The configuration of the lock-in, in codes.
    Raises:
        InputError: settings are missing, or the options contradict the session.
    """
    rate_hz = float(session.stated("rig", "rate_hz"))
    if request.rate_hz is not None:
        check_rate(request.rate_hz, rate_hz, _RATE_ROWS, "the session's own rate", path)
    volt_per_code = float(session.stated("rig", "volt_per_code"))
    if request.block_s is not None and round(request.block_s * rate_hz) != block_samples:
        raise InputError(
            f"--block-s is {request.block_s:g}, but the session's blocks, with one output each, "
            f"have {block_samples / rate_hz:g} s. Leave out --block-s. {path}"
        )
    ohm, ampere = _ohm_per_ratio(
        request,
        1.0 / _number(session, 1.0 / _VOLT_PER_MONITOR_VOLT, "rig", "v_monitor_v_per_v"),
        1.0 / _number(session, 1.0 / _AMPERE_PER_MONITOR_VOLT, "rig", "i_monitor_v_per_a"),
    )
    full_scale = _FULL_SCALE_CODES
    if session.states("rig", "top_code"):  # older sessions lack it
        full_scale = float(session.stated("rig", "top_code"))
    if request.full_scale_v is not None:
        full_scale = request.full_scale_v * _LAST_CODE / volt_per_code
    search = request.blank_s is None and request.method == "lockin" and _is_imported(session)
    return LockinConfig(
        rate_hz=rate_hz,
        block_samples=block_samples,
        carrier_hz=request.carrier_hz or _carrier_hz(session, path),
        skew_s=_skew_s(session, request),
        ohm_per_ratio=ohm,
        blank=_blank(session, request, rate_hz),
        search_updates=search,
        min_amplitude_codes=_MIN_AMPLITUDE_CODES,
        full_scale=full_scale,
        current_limit=_limit(request, ampere, volt_per_code),
    )


def _is_imported(session: SessionReader) -> bool:
    """Whether the session was imported from a file, without the blocks of a rig."""
    return not session.states("rig", "switch_sample")


def _number(session: SessionReader, default: float, *keys: str) -> float:
    """A setting of an imported session, or the default for files."""
    if _is_imported(session) and not session.states(*keys):
        return default
    return float(session.stated(*keys))


def _skew_s(session: SessionReader, request: Request) -> float:
    return _number(session, 0.0, "rig", "skew_s") if request.skew_s is None else request.skew_s


def _carrier_hz(session: SessionReader, path: Path) -> float:
    if session.states("sensing", "carrier_hz"):
        return float(session.stated("sensing", "carrier_hz"))
    if _is_imported(session) and not session.states("study", "sensing", "carrier_hz"):
        raise InputError(f"The imported session states no carrier. Add --carrier-hz. {path}")
    return float(session.stated("study", "sensing", "carrier_hz"))


def _blank(session: SessionReader, request: Request, rate_hz: float) -> tuple[int, int]:
    """Samples to ignore: from a block's start, or from the recorded update of the output."""
    if request.method == "paper":
        return (0, 0)  # the paper's chain has no blanking
    if request.blank_s is not None:
        return (0, round(request.blank_s * rate_hz))
    if _is_imported(session):
        return (0, 0)  # its updates are searched
    from haselab.runtime.lockin import BLANKING_S  # imports the rig, for sessions only

    switch = int(session.stated("rig", "switch_sample"))
    switch %= int(session.stated("rig", "block_samples"))
    return (switch, switch + round(BLANKING_S * rate_hz))


def too_short(samples: int, block_samples: int, rate_hz: float, path: Path) -> InputError:
    """Make the error for a record that is shorter than one block."""
    shorter = f", or shorten --block-s to {samples / rate_hz:g} s or less"
    return InputError(
        f"The record has {samples} samples, but a block has {block_samples}. Record longer"
        f"{shorter if samples >= _SHORTEST else ''}. {path}"
    )
