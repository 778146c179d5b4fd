"""`haselab sense FILE`: monitor voltages to capacitance, block by block."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol, TypeVar

import click
import numpy as np
from numpy.typing import NDArray

from haselab import sensing
from haselab.base import InputError, ResultError
from haselab.base.chart import Chart, Curve, Panel
from haselab.cli.columns import advice_on_columns, column_options
from haselab.cli.common import (
    REAL,
    actuator_option,
    answer_options,
    emit,
    progress_bar,
    tell_doubt,
    unverified_option,
)
from haselab.cli.plot import save_plot
from haselab.pipelines.prefetch import ahead, in_order
from haselab.pipelines.sensing.source import Request, Source, open_source, too_short
from haselab.pipelines.sensing.table import (
    Collected,
    Columns,
    CsvRows,
    Judged,
    Summary,
    columns_of,
    json_pieces,
)
from haselab.sensing import Charge, ChargeConfig, LockinConfig, Sensed
from haselab.store.columns.reader import pairs_of

__all__ = ["command"]

F = TypeVar("F", bound=Callable[..., Any])

_LONGEST_S = 3600.0  # of a block, a blanking, a skew
_METHODS = {"lockin": "Lockin", "sinefit": "SineFit", "paper": "PaperChain", "charge": "Charge"}
_EACH_FOR_ITSELF = ("lockin",)  # its blocks know nothing of each other, and it is all in C
_MOST_WORKERS = 4
_TOO_FEW = 0.1  # share of valid blocks below which there is no result
_NO_MONITOR_V = 50.0  # peak to peak: converters end at 10 or 20 V
_AT_THE_ACTUATOR = (
    "If the columns are V and A at the actuator, add --volt-per-monitor-volt 1 "
    "--ampere-per-monitor-volt 1"
)
_TONE_ROWS = 1 << 18  # of the record in which tones are looked for
_FEW = 0.8  # below which a warning says why
_AMPLITUDE_LOST, _PHASE_OUT, _CLIPPED, _NOT_FINITE, _CARRIER_OFF = 1, 2, 4, 32, 64


class _Method(Protocol):
    """A sensing method, whichever it is."""

    config: LockinConfig

    def sense(self, readings: NDArray[Any]) -> Sensed:
        """Blocks of both monitors."""

    def sense_channels(self, v: NDArray[Any], i: NDArray[Any]) -> Sensed:
        """The same from two columns."""


class _Sink(Protocol):
    """Where results go, some blocks at a time."""

    def write(self, columns: Columns, reason: NDArray[np.uint8], seen: Mapping[int, str]) -> None:
        """Take the columns of some blocks."""


def _positive(context: click.Context, parameter: click.Parameter, value: float | None) -> Any:
    """Refuse a number that is not above 0 and finite."""
    del context
    if value is not None and not 0.0 < value < float("inf"):
        raise click.BadParameter(f"{value:g} is not a positive number.", param=parameter)
    return value


def _not_negative(context: click.Context, parameter: click.Parameter, value: float | None) -> Any:
    """Refuse a time that is negative or no number."""
    del context
    if value is not None and not 0.0 <= value < _LONGEST_S:
        raise click.BadParameter(
            f"{value:g} is not a time from 0 to {_LONGEST_S:g} s.", param=parameter
        )
    return value


def _finite(context: click.Context, parameter: click.Parameter, value: float | None) -> Any:
    """Refuse what is no number."""
    del context
    if value is not None and not abs(value) < _LONGEST_S:
        raise click.BadParameter(
            f"{value:g} is not a time below {_LONGEST_S:g} s.", param=parameter
        )
    return value


def _option(name: str, text: str, **settings: Any) -> Callable[[F], F]:
    return click.option(name, type=REAL, callback=_positive, help=text, **settings)


def _scale(name: str, default: float, text: str) -> Callable[[F], F]:
    return _option(name, text, default=default, show_default=True)


def _sense_piece(method: _Method, v: NDArray[Any], i: NDArray[Any]) -> Sensed:
    """The whole blocks of one piece; columns of one array go through without a copy."""
    length = method.config.block_samples
    used = v.size // length * length
    pairs = pairs_of(v, i)
    if pairs is not None:
        return method.sense(pairs[:used].reshape(-1, length, 2))
    return method.sense_channels(v[:used], i[:used])


def _results(source: Source, method: _Method, request: Request) -> Iterator[tuple[Columns, Judged]]:
    """Columns and words of the blocks of each piece."""
    length = method.config.block_samples

    def numbered() -> Iterator[tuple[int, NDArray[Any], NDArray[Any]]]:
        first = 0
        for v, i in ahead(source.pieces()):
            if v.size >= length:
                yield first, v, i
            first += v.size // length

    def work(
        piece: tuple[int, NDArray[Any], NDArray[Any]],
    ) -> tuple[Columns, Judged]:
        first, v, i = piece
        return _columns(_sense_piece(method, v, i), source, request, first)

    workers = min(_MOST_WORKERS, os.cpu_count() or 1) if request.method in _EACH_FOR_ITSELF else 1
    return in_order(work, numbered(), workers)


def _columns(
    sensed: Sensed, source: Source, request: Request, first: int
) -> tuple[Columns, Judged]:
    """Columns and words of blocks from one on."""
    config, count = source.config, sensed.valid.size
    inside_s = sensed.time_s - config.block_s * np.arange(count)
    columns = columns_of(
        sensed,
        time_s=inside_s + source.block_start_s(first, count),
        volt_per_reading=source.volt_per_reading,
        frequency_hz=config.carrier_hz if isinstance(config, LockinConfig) else float("nan"),
        reactance_scale=request.reactance_scale,
        capacitance_scale=request.capacitance_scale,
    )
    reason = np.where(sensed.valid, 0, sensed.reason).astype(np.uint8)
    return columns, Judged(reason, sensed.seen)


def _charge_results(
    source: Source, config: ChargeConfig, request: Request, read: Callable[[], None]
) -> Iterator[tuple[Columns, Judged]]:
    """The same without a carrier: the whole record is read before its first block is known."""
    charge, length = Charge(config), config.block_samples
    blocks = 0
    for v, i in ahead(source.pieces()):
        used = v.size // length * length
        charge.add(v[:used], i[:used])
        blocks += v.size // length
        read()
    if blocks:
        yield _columns(charge.finish(), source, request, 0)


def _run(source: Source, request: Request, sinks: list[_Sink]) -> None:
    """Sense all of it."""
    bar, share = progress_bar(), 0.0
    bar.start(1.0)

    def advance() -> None:
        nonlocal share
        read = source.stream.share_read()
        bar.advance(read - share, "sensing")
        share = read

    if isinstance(source.config, ChargeConfig):
        results = _charge_results(source, source.config, request, advance)
    else:
        method = getattr(sensing, _METHODS[request.method])(source.config)
        results = _results(source, method, request)
    try:
        for columns, judged in results:
            for sink in sinks:
                sink.write(columns, judged.reason, judged.seen)
            advance()
    finally:
        bar.stop()


def _nothing_valid(
    summary: Summary, config: LockinConfig | ChargeConfig, tones_hz: list[float]
) -> str:
    """What is wrong with a record none of whose blocks is valid."""
    blocks = summary.blocks
    tones = " and ".join(f"{hz:.5g}" for hz in tones_hz)
    seen = f"The voltage has tones at {tones} Hz. " if tones else ""
    counts = {
        bit: sum(count for mask, count in summary.masks.items() if mask & bit)
        for bit in (_NOT_FINITE, _CLIPPED, _PHASE_OUT, _AMPLITUDE_LOST, _CARRIER_OFF)
    }
    worst = max(counts, key=lambda bit: counts[bit])
    by_charge = isinstance(config, ChargeConfig) and worst not in (_NOT_FINITE, _CLIPPED)
    if 2 * counts[worst] < blocks or by_charge:
        return f"None of {blocks} blocks is valid: {summary.why_not()}. {seen}".rstrip()
    if worst == _NOT_FINITE:
        return f"All {blocks} blocks hold values that are not finite. Export the record again."
    if worst == _CLIPPED:
        if summary.largest_v > _NO_MONITOR_V:
            return (
                f"All {blocks} blocks are clipped: the voltage spans up to {summary.largest_v:.4g} "
                f"V, more than a monitor has. {_AT_THE_ACTUATOR} and a --full-scale-v above the "
                "largest voltage."
            )
        return (
            f"All {blocks} blocks reach the converter's full scale and are clipped. Lower the "
            "signal, or state the range by --full-scale-v."
        )
    if worst == _PHASE_OUT:
        return (
            f"The current does not lead the voltage in any of {blocks} blocks, as it does in a "
            "capacitor: the channels seem swapped, or one monitor inverted. Swap the columns, "
            "turn the sign of one, or check --skew-s."
        )
    assert isinstance(config, LockinConfig)
    return (
        f"No block of {blocks} shows a carrier at {config.carrier_hz:g} Hz on both monitors. {seen}"
        f"Check --carrier-hz, --rate-hz ({config.rate_hz:g} Hz) and the sensing signal."
    )


def _tones_hz(source: Source) -> list[float]:
    """The largest tones of the voltage above a few periods a block, at most two, in order."""
    from haselab.sensing.block.tones import strongest_tones  # scipy: half a second at the start

    v, _ = next(source.stream.pieces(_TONE_ROWS))
    config = source.config
    return strongest_tones(v.astype(np.float64), config.rate_hz, 3.0 / config.block_s)


def _sense(
    path: Path, request: Request, out: Path | None, as_json: bool, plot: Path | None
) -> None:
    summary, collected = Summary(), Collected()
    with ExitStack() as opened:
        source = open_source(path, request, opened)
        doubt = "" if source.session is None else source.session.doubt
        sinks: list[_Sink] = [summary]
        if as_json or plot is not None:
            sinks.append(collected)
        if out is not None:
            sinks.append(_Out(out, opened))
        _run(source, request, sinks)
        left_over = source.stream.rows_read - summary.blocks * source.config.block_samples
        tones_hz = []
        if summary.blocks and not summary.valid_blocks and isinstance(source.config, LockinConfig):
            tones_hz = _tones_hz(source)
    if summary.blocks == 0:
        raise too_short(left_over, source.config.block_samples, source.config.rate_hz, path)
    if left_over:
        click.echo(f"haselab: {left_over} samples at the end fill no block and are left.", err=True)
    if summary.valid_blocks == 0:
        raise ResultError(f"{_nothing_valid(summary, source.config, tones_hz)} {path}")
    share = summary.valid_blocks / summary.blocks
    doubtful = f"{summary.valid_blocks} of {summary.blocks} blocks valid: {summary.why_not()}."
    if share < _TOO_FEW:
        raise ResultError(f"Hardly any block can be used, {doubtful} {path}")
    if share < _FEW:
        click.echo(f"haselab: warning: only {doubtful}", err=True)
    plain = source.session is None and request.calibration is None and source.in_monitor_volts
    if plain and summary.largest_v > _NO_MONITOR_V:
        click.echo(
            f"haselab: warning: the voltage spans up to {summary.largest_v:.4g} V, more than a "
            f"monitor has, and is taken as volts at the monitors. {_AT_THE_ACTUATOR}.",
            err=True,
        )
    save_plot(plot, lambda: _chart(collected, path))
    answer = summary.answer(request.method)
    if doubt:
        tell_doubt(doubt, path)
        answer["unverified"] = True
    if as_json:
        for text in json_pieces(answer, collected):
            click.echo(text, nl=False)
    else:
        emit(answer, as_json=False, out=None)
        if out is None:
            click.echo(f"{summary.blocks} rows, one a block: use --json or --out.")


def _chart(collected: Collected, path: Path) -> Chart:
    """Capacitance and resistance of all valid blocks."""
    good = collected.column("valid") > 0.0
    time_s = collected.column("time_s")[good]

    def curve(name: str, factor: float) -> Curve:
        quantity, _, unit = name.rpartition("_")
        std = factor * collected.column(f"{quantity}_std_{unit}")[good]
        return Curve(time_s, factor * collected.column(name)[good], "", "line", std)

    return Chart(f"Capacitance of {path.name}", (
        Panel("Time (s)", "Capacitance (pF)", (curve("capacitance_f", 1e12),)),
        Panel("Time (s)", "Series resistance (kΩ)", (curve("resistance_ohm", 1e-3),)),
    ))  # fmt: skip


class _Out:
    """The CSV file, made when its first rows come: a refused request leaves nothing behind."""

    def __init__(self, path: Path, opened: ExitStack) -> None:
        self._path, self._opened = path, opened
        self._rows: CsvRows | None = None

    def write(self, columns: Columns, reason: NDArray[np.uint8], seen: Mapping[int, str]) -> None:
        """Add the rows of some blocks."""
        if self._rows is None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            file = self._opened.enter_context(self._path.open("w", newline="", encoding="utf-8"))
            self._rows = CsvRows(file)
        self._rows.write(columns, reason, seen)


@click.command("sense")
@click.argument("file", metavar="FILE", type=click.Path(path_type=Path))
@_option(
    "--carrier-hz", "Frequency of the sensing signal; needed but for a session and for charge."
)
@_option("--rate-hz", "Samples per second and channel. Default: from the file.")
@_option(
    "--block-s",
    "Length of a block, one result each; default: 0.01 (charge: 0.5), or the session's.",
)
@click.option(
    "--method",
    type=click.Choice(list(_METHODS)),
    default="lockin",
    show_default=True,
    help="lockin: best; sinefit: carrier not exactly known; paper: the study's own chain; charge: "
    "no carrier, the charge of a drive that passes 0 V.",
)
@click.option(
    "--skew-s",
    type=REAL,
    callback=_finite,
    help="Time from a voltage sample to its current sample; default: 0, or the session's.",
)
@click.option(
    "--blank-s",
    type=REAL,
    callback=_not_negative,
    help="Start of each block that does not count, after an output's step; 0: no steps. Default: "
    "each block is searched for a step at an unknown time; a session states where its steps are.",
)
@_option(
    "--volt-per-monitor-volt", "Scale of the voltage monitor; default: 5000, or the session's."
)
@_option(
    "--ampere-per-monitor-volt", "Scale of the current monitor; default: 0.002, or the session's."
)
@click.option(
    "--calibration",
    type=click.Path(path_type=Path),
    help="File of 'haselab calibrate': takes the place of scales and skew.",
)
@click.option("--amplifier", help="Refuse a calibration of another one than this.")
@_option("--full-scale-v", "Range of the converter; beyond it is clipped. Default: 10.")
@_option("--current-limit-a", "A block whose current reaches it is not valid; default: none.")
@click.option(
    "--v",
    "v_column",
    default="v_monitor_v",
    show_default=True,
    help="Voltage monitor's column.",
)
@click.option(
    "--i",
    "i_column",
    default="i_monitor_v",
    show_default=True,
    help="Current monitor's column.",
)
@click.option("--experiment", metavar="NAME", help="FILE is a session: sense this experiment.")
@column_options
@_scale("--reactance-scale", 2.5e6, "Of eq. 2, for relative_capacitance alone.")
@_scale("--capacitance-scale", 10.0, "Of eq. 3, for relative_capacitance alone.")
@actuator_option("carrier and calibration are read from [sensing].")
@answer_options(plot=True)
@unverified_option
def command(
    file: Path,
    actuator: Path | None,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **options: Any,
) -> None:
    """Capacitance and series resistance from the records of both monitors.

    FILE has the columns v_monitor_v and i_monitor_v, or those that --v and --i name (CSV, .mat,
    .npz, .h5 or .tdms), or is a .npy array of two columns, voltage first, or a haselab session; it
    may be larger than memory. --out names a CSV file with one row a block, written as the blocks
    are sensed.
    """
    if out is not None and out.is_dir():
        raise InputError(f"--out names a folder, not a file. Name a file in it. {out}")
    if actuator is not None:
        options |= _known(actuator, options)
    with advice_on_columns(["--v", "--i"]):
        _sense(file, Request(**options), out, as_json, plot)


def _known(actuator: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Carrier and calibration of an actuator file, where the options do not give them."""
    from haselab.cli.actuator_file import load_actuator  # `haselab sense` must start at once

    sensing = load_actuator(actuator).sensing
    known: dict[str, Any] = {}
    if options["carrier_hz"] is None and options["method"] != "charge":
        known["carrier_hz"] = sensing.carrier_hz
    if options["calibration"] is None and sensing.is_calibrated and options["method"] != "charge":
        known["calibration"] = actuator
    return known
