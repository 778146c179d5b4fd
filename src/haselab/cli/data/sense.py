"""`haselab sense FILE`: compute capacitance from the monitor voltages, block by block."""

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
from haselab.cli.columns import advice_on_columns, column_options, note_conversions
from haselab.cli.common import (
    REAL,
    actuator_option,
    answer_options,
    emit,
    progress_bar,
    unverified_option,
    warn_unverified,
)
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.pipelines.prefetch import map_in_order, prefetch
from haselab.pipelines.sensing.source import Request, Source, open_source, too_short
from haselab.pipelines.sensing.table import (
    BlockValidity,
    CollectedColumns,
    Columns,
    CsvRows,
    Summary,
    columns_of,
    json_parts,
)
from haselab.sensing import Charge, ChargeConfig, LockinConfig, Sensed
from haselab.store.columns.reader import pairs_of

__all__ = ["command"]

F = TypeVar("F", bound=Callable[..., Any])

_LONGEST_S = 3600.0  # limit for the length of a block, for blanking and for skew
_METHODS = {"lockin": "Lockin", "sinefit": "SineFit", "paper": "PaperChain", "charge": "Charge"}
_PARALLEL = ("lockin",)  # its blocks are independent of each other, and it is all in C
_MOST_WORKERS = 4
_TOO_FEW = 0.1  # share of valid blocks below which there is no result
_NO_MONITOR_V = 50.0  # peak to peak, more than any monitor: converters reach 10 or 20 V
_ALREADY_SCALED = (
    "If the columns are V and A at the actuator, add --volt-per-monitor-volt 1 "
    "--ampere-per-monitor-volt 1"
)
_TONE_ROWS = 1 << 18  # rows in which tones are searched
_FEW = 0.8  # share of valid blocks below which a warning gives the reason
_AMPLITUDE_LOST, _PHASE_OUT, _CLIPPED, _NOT_FINITE, _CARRIER_OFF = 1, 2, 4, 32, 64


class _Method(Protocol):
    """Any sensing method."""

    config: LockinConfig

    def sense(self, readings: NDArray[Any]) -> Sensed:
        """Sense blocks of both monitors."""

    def sense_channels(self, v: NDArray[Any], i: NDArray[Any]) -> Sensed:
        """Sense two columns, voltage and current."""


class _Sink(Protocol):
    """Takes results, some blocks at a time."""

    def write(self, columns: Columns, reason: NDArray[np.uint8], seen: Mapping[int, str]) -> None:
        """Take the columns of some blocks."""


def _positive(context: click.Context, parameter: click.Parameter, value: float | None) -> Any:
    """Refuse a number that is not above 0 and finite."""
    del context
    if value is not None and not 0.0 < value < float("inf"):
        raise click.BadParameter(f"{value:g} is not a positive number.", param=parameter)
    return value


def _not_negative(context: click.Context, parameter: click.Parameter, value: float | None) -> Any:
    """Refuse a time that is negative or not a number."""
    del context
    if value is not None and not 0.0 <= value < _LONGEST_S:
        raise click.BadParameter(
            f"{value:g} is not a time from 0 to {_LONGEST_S:g} s.", param=parameter
        )
    return value


def _finite(context: click.Context, parameter: click.Parameter, value: float | None) -> Any:
    """Refuse a time that is not a finite number."""
    del context
    if value is not None and not abs(value) < _LONGEST_S:
        raise click.BadParameter(
            f"{value:g} is not a time below {_LONGEST_S:g} s.", param=parameter
        )
    return value


def _option(name: str, detail: str) -> Callable[[F], F]:
    """A shared option that takes a positive number."""
    return shared_option(name, type=REAL, callback=_positive, detail=detail)


def _scale(name: str, default: float, text: str) -> Callable[[F], F]:
    """The scale of an equation of the paper."""
    return click.option(
        name, type=REAL, callback=_positive, default=default, show_default=True, help=text
    )


def _sense_part(method: _Method, v: NDArray[Any], i: NDArray[Any]) -> Sensed:
    """Sense the whole blocks of one part; columns of one array are not copied."""
    length = method.config.block_samples
    used = v.size // length * length
    pairs = pairs_of(v, i)
    if pairs is not None:
        return method.sense(pairs[:used].reshape(-1, length, 2))
    return method.sense_channels(v[:used], i[:used])


def _results(
    source: Source, method: _Method, request: Request
) -> Iterator[tuple[Columns, BlockValidity]]:
    """Columns and reasons of the blocks of each part."""
    length = method.config.block_samples

    def numbered() -> Iterator[tuple[int, NDArray[Any], NDArray[Any]]]:
        first = 0
        for v, i in prefetch(source.chunks()):
            if v.size >= length:
                yield first, v, i
            first += v.size // length

    def work(
        part: tuple[int, NDArray[Any], NDArray[Any]],
    ) -> tuple[Columns, BlockValidity]:
        first, v, i = part
        return _columns(_sense_part(method, v, i), source, request, first)

    workers = min(_MOST_WORKERS, os.cpu_count() or 1) if request.method in _PARALLEL else 1
    return map_in_order(work, numbered(), workers)


def _columns(
    sensed: Sensed, source: Source, request: Request, first: int
) -> tuple[Columns, BlockValidity]:
    """Columns and reasons of the blocks from number `first` on."""
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
    return columns, BlockValidity(reason, sensed.seen)


def _charge_results(
    source: Source, config: ChargeConfig, request: Request, read: Callable[[], None]
) -> Iterator[tuple[Columns, BlockValidity]]:
    """Results without a carrier: the whole record is read before its first block is known."""
    charge, length = Charge(config), config.block_samples
    blocks = 0
    for v, i in prefetch(source.chunks()):
        used = v.size // length * length
        charge.add(v[:used], i[:used])
        blocks += v.size // length
        read()
    if blocks:
        yield _columns(charge.finish(), source, request, 0)


def _run(source: Source, request: Request, sinks: list[_Sink]) -> None:
    """Sense the whole source, with a progress bar."""
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
    """What is wrong with a record without any valid block."""
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
        return f"All {blocks} blocks contain NaN or infinite values. Export the record again."
    if worst == _CLIPPED:
        if summary.largest_v > _NO_MONITOR_V:
            return (
                f"All {blocks} blocks are clipped: the voltage spans up to {summary.largest_v:.4g} "
                f"V, more than any monitor output. {_ALREADY_SCALED} and a --full-scale-v above "
                "the largest voltage."
            )
        return (
            f"All {blocks} blocks reach the converter's full scale and are clipped. Reduce the "
            "signal, or state the full scale with --full-scale-v."
        )
    if worst == _PHASE_OUT:
        return (
            f"The current does not lead the voltage in any of {blocks} blocks, as it does in a "
            "capacitor: the channels may be swapped, or one monitor inverted. Swap the columns, "
            "change the sign of one, or check --skew-s."
        )
    assert isinstance(config, LockinConfig)
    return (
        f"None of {blocks} blocks shows a carrier at {config.carrier_hz:g} Hz on both monitors. "
        f"{seen}Check --carrier-hz, --rate-hz ({config.rate_hz:g} Hz) and the sensing signal."
    )


def _tones_hz(source: Source) -> list[float]:
    """The largest tones of the voltage with a few periods per block, at most two, in order."""
    from haselab.sensing.block.tones import strongest_tones  # scipy takes half a second to import

    v, _ = next(source.stream.chunks(_TONE_ROWS))
    config = source.config
    return strongest_tones(v.astype(np.float64), config.rate_hz, 3.0 / config.block_s)


def _sense(
    path: Path, request: Request, out: Path | None, as_json: bool, plot: Path | None
) -> None:
    summary, collected = Summary(), CollectedColumns()
    with ExitStack() as opened:
        source = open_source(path, request, opened)
        if source.session is None:
            names = (request.v_column, request.i_column)
            note_conversions(dict(zip(names, source.stream.units, strict=True)), path)
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
        click.echo(
            f"haselab: the last {left_over} samples do not fill a block and are left out.", err=True
        )
    if summary.valid_blocks == 0:
        raise ResultError(f"{_nothing_valid(summary, source.config, tones_hz)} {path}")
    share = summary.valid_blocks / summary.blocks
    doubtful = f"{summary.valid_blocks} of {summary.blocks} blocks valid: {summary.why_not()}."
    if share < _TOO_FEW:
        raise ResultError(f"Too few blocks are valid: {doubtful} {path}")
    if share < _FEW:
        click.echo(f"haselab: warning: only {doubtful}", err=True)
    plain = source.session is None and request.calibration is None and source.in_monitor_volts
    if plain and summary.largest_v > _NO_MONITOR_V:
        click.echo(
            f"haselab: warning: the voltage spans up to {summary.largest_v:.4g} V, more than any "
            f"monitor output, but is treated as volts at the monitors. {_ALREADY_SCALED}.",
            err=True,
        )
    elif plain and request.method != "paper":
        click.echo(
            "haselab: no scale of the voltage monitor is stated, so that of the reference study is "
            "used: 5000 V/V. For another amplifier, state --volt-per-monitor-volt and "
            "--ampere-per-monitor-volt (0.002 A/V).",
            err=True,
        )
    save_plot(plot, lambda: _chart(collected, path))
    answer = summary.answer(request.method)
    if doubt:
        warn_unverified(doubt, path)
        answer["unverified"] = True
    if as_json:
        for text in json_parts(answer, collected):
            click.echo(text, nl=False)
    else:
        emit(answer, as_json=False, out=None)
        if out is None:
            click.echo(f"{summary.blocks} rows, one per block: use --json or --out.")


def _chart(collected: CollectedColumns, path: Path) -> Chart:
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
    """The CSV file, created with its first rows: a refused request leaves no file behind."""

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
@_option("--carrier-hz", "Default: from the session or --actuator. The method charge needs none.")
@_option("--rate-hz", "Default: the rate in the file.")
@_option("--block-s", "Default: 0.01 (method charge: 0.5), or the session's.")
@shared_option(
    "--method", type=click.Choice(list(_METHODS)), default="lockin", show_default=True,
    detail="lockin: the most accurate; sinefit: for a carrier that is not exactly known; paper: "
    "as in the paper; charge: without a carrier, from the charge of a drive that passes 0 V.",
)  # fmt: skip
@shared_option(
    "--skew-s", type=REAL, callback=_finite, detail="Default: 0, or the session's.",
)  # fmt: skip
@shared_option(
    "--blank-s", type=REAL, callback=_not_negative,
    detail="The output steps at the start of each block; 0: the output does not step. Default: "
    "search each block for a step, or use the times that a session states.",
)  # fmt: skip
@_option("--volt-per-monitor-volt", "Default: 5000, or the session's.")
@_option("--ampere-per-monitor-volt", "Default: 0.002, or the session's.")
@click.option(
    "--calibration", type=click.Path(path_type=Path), metavar="CALIBRATION.toml",
    help="Use this file of 'haselab calibrate' instead of scales and skew. Default: none.",
)  # fmt: skip
@click.option(
    "--amplifier", metavar="NAME",
    help="Refuse a calibration of an amplifier with another name. Default: accept any.",
)  # fmt: skip
@click.option(
    "--full-scale-v", type=REAL, callback=_positive,
    help="Set the full scale of the converter in V. Samples that reach it count as clipped. "
    "Default: 10.",
)  # fmt: skip
@_option("--current-limit-a", "A block whose current reaches it is not valid. Default: no limit.")
@shared_option("--v", "v_column", default="v_monitor_v", show_default=True)
@shared_option("--i", "i_column", default="i_monitor_v", show_default=True)
@shared_option(
    "--experiment",
    detail="It selects what is read; needed if the session has several. Default: its only one.",
)
@column_options
@_scale("--reactance-scale", 2.5e6, "Set the scale in eq. 2 of the paper (relative_capacitance).")
@_scale("--capacitance-scale", 10.0, "Set the scale in eq. 3 of the paper (relative_capacitance).")
@actuator_option("The command reads carrier and calibration from [sensing].")
@answer_options(None, "It is a CSV file with one row per block. Default: none.", plot=True)
@unverified_option
def command(
    file: Path,
    actuator: Path | None,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **options: Any,
) -> None:
    """Compute capacitance and series resistance from both monitors.

    FILE is a table (CSV, .mat, .npz, .h5 or .tdms) with the columns v_monitor_v and i_monitor_v, or
    those that --v and --i name; a .npy array of two columns, voltage first; or a haselab session.
    It may be larger than memory: the rows of --out are written as the blocks are computed.
    """
    if out is not None and out.is_dir():
        raise InputError(f"--out names a folder, not a file. Name a file in it. {out}")
    if actuator is not None:
        options |= _known(actuator, options)
    with advice_on_columns(["--v", "--i"]):
        _sense(file, Request(**options), out, as_json, plot)


def _known(actuator: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Carrier and calibration of an actuator file that the options do not give."""
    from haselab.cli.actuator_file import load_actuator  # `haselab sense` must start fast

    sensing = load_actuator(actuator).sensing
    known: dict[str, Any] = {}
    if options["carrier_hz"] is None and options["method"] != "charge":
        known["carrier_hz"] = sensing.carrier_hz
    if options["calibration"] is None and sensing.is_calibrated and options["method"] != "charge":
        known["calibration"] = actuator
    return known
