"""`haselab identify`: models with uncertainty from recorded files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import click
import numpy as np

from haselab.app.common import answer_options, emit
from haselab.base import InputError, ResultError
from haselab.identify.capacitance_map import fit_capacitance_map
from haselab.identify.free_response import FreeTrial, fit_free_response
from haselab.identify.frequency_response import estimate_frequency_response
from haselab.identify.hyperelastic import fit_hyperelastic
from haselab.identify.record import Record
from haselab.identify.regions import find_regions
from haselab.identify.transfer import TransferStructure, fit_transfer
from haselab.identify.voltage_map import fit_voltage_map
from haselab.models import LAWS
from haselab.store.tables import Table, read_table

__all__ = ["command"]

_FILE = click.argument("file", type=click.Path(path_type=Path))
_FILES = click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
_RATE = click.option("--rate-hz", type=float, help="Rows a second, where the file does not tell.")
_INPUT = click.option("--input", "source", default="u", show_default=True, help="Input column.")
_OUTPUT = click.option("--output", default="y", show_default=True, help="Output column.")
_LOWEST = click.option("--stretch-min", type=float, help="Leave out lower stretches.")
_HIGHEST = click.option("--stretch-max", type=float, help="Leave out higher stretches.")


class _Fit(Protocol):
    """What all fits have in common."""

    @property
    def status(self) -> str:
        """The word ok, or why there is no result."""

    @property
    def succeeded(self) -> bool:
        """Whether the numbers may be used."""

    def answer(self) -> dict[str, Any]:
        """Keys of the public contract."""


@click.group("identify")
def command() -> None:
    """Models with uncertainty from records.

    FILE is CSV (a header row, SI units), .mat, .npz, .h5 or .tdms.
    """


def _give(fit: _Fit, files: Sequence[Path], as_json: bool, out: Path | None) -> None:
    """Print the answer; a fit without a result ends the command with exit code 3."""
    if not fit.succeeded:
        listed = " ".join(str(file) for file in files)
        if as_json:
            emit(fit.answer(), as_json=True, out=out)
        raise ResultError(f"{fit.status}: {listed}")
    emit(fit.answer(), as_json=as_json, out=out)


def _rate_hz(table: Table, given: float | None, file: Path) -> float:
    rate_hz = table.rate_hz if given is None else given
    if rate_hz is None:
        raise InputError(
            "The file does not tell its rate. Give --rate-hz, add a line '# rate_hz = ...', "
            f"or add a column time_s: {file}"
        )
    if not 0.0 < rate_hz < float("inf"):
        raise InputError(f"--rate-hz = {rate_hz:g} Hz; allowed is above 0 Hz. Correct it.")
    return rate_hz


def _delay(text: str) -> str | float:
    if text == "auto":
        return text
    try:
        return float(text)
    except ValueError as error:
        raise InputError(
            f"--delay = {text}; allowed is auto or a number of seconds. Correct the option."
        ) from error


def _fixed(pairs: Sequence[str]) -> dict[str, float]:
    """`name=value` options."""
    fixed = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            fixed[name.strip()] = float(value)
        except ValueError as error:
            raise InputError(
                f"--fix = {pair}; allowed is name=number, for example damping_ratio=0.09. "
                "Correct the option."
            ) from error
    return fixed


@command.command("transfer")
@_FILES
@_INPUT
@_OUTPUT
@_RATE
@click.option("--poles", default=2, show_default=True, help="Poles of the fast part, 1 to 6.")
@click.option("--zeros", default=0, show_default=True, help="Its zeros, fewer than the poles.")
@click.option("--delay", default="auto", show_default=True, help="auto, or a known one in s.")
@click.option("--slow-modes", default=0, show_default=True, help="Slow branches beside it, 0 to 3.")
@click.option("--fix", multiple=True, metavar="NAME=VALUE", help="A known number; repeat it.")
@click.option("--at-rest", is_flag=True, help="Each record starts at rest, for sure.")
@click.option("--no-offset", is_flag=True, help="The output has no constant of its own.")
@answer_options
def _transfer(
    files: tuple[Path, ...],
    source: str,
    output: str,
    rate_hz: float | None,
    as_json: bool,
    out: Path | None,
    **structure: Any,
) -> None:
    """Transfer function in continuous time, with intervals.

    Several FILES give one model, each with its own initial state and offset: a chirp for the
    resonance, steps for the slow branches.
    """
    wanted = TransferStructure(
        poles=structure["poles"],
        zeros=structure["zeros"],
        delay=_delay(structure["delay"]),
        slow_modes=structure["slow_modes"],
        offset=not structure["no_offset"],
        initial_state=not structure["at_rest"],
        fixed=_fixed(structure["fix"]),
    )
    records = []
    for file in files:
        table = read_table(file, [source, output])
        rate = _rate_hz(table, rate_hz, file)
        records.append(Record.sampled(table[source], table[output], rate))
    _give(fit_transfer(records, wanted), files, as_json, out)


@command.command("frequency-response")
@_FILE
@_INPUT
@_OUTPUT
@_RATE
@click.option(
    "--method", type=click.Choice(["rational", "polynomial", "welch"]), default="rational",
    show_default=True, help="How leakage is treated.",
)  # fmt: skip
@click.option("--measured-input", is_flag=True, help="The input was measured, not held.")
@answer_options
def _frequency_response(
    file: Path,
    source: str,
    output: str,
    rate_hz: float | None,
    method: str,
    measured_input: bool,
    *,
    as_json: bool,
    out: Path | None,
) -> None:
    """Bode estimate with coherence and standard deviations."""
    table = read_table(file, [source, output])
    rate = _rate_hz(table, rate_hz, file)
    response = estimate_frequency_response(
        table[source], table[output], rate, method=method, held=not measured_input
    )
    emit(response.answer(), as_json=as_json, out=out)


@command.command("free-response")
@_FILES
@click.option("--output", default="x", show_default=True, help="Column of the motion.")
@_RATE
@click.option(
    "--creep/--no-creep", default=None, help="Fit an exponential beside the oscillation, or not; "
    "the data decide when not given.",
)  # fmt: skip
@answer_options
def _free_response(
    files: tuple[Path, ...],
    output: str,
    rate_hz: float | None,
    creep: bool | None,
    *,
    as_json: bool,
    out: Path | None,
) -> None:
    """Decay, damped and natural frequency (eqs. 6 and 7), hull curves; several FILES are trials."""
    trials = []
    for file in files:
        table = read_table(file, [output])
        rate = _rate_hz(table, rate_hz, file)
        trials.append(FreeTrial(table[output], np.arange(table[output].size) / rate))
    _give(fit_free_response(trials, creep=creep), files, as_json, out)


def _between(
    table: Table, load: str, low: float | None, high: float | None, file: Path
) -> tuple[Any, Any]:
    """Stretch and load inside the asked range."""
    stretch = table["stretch"]
    kept = np.ones(stretch.size, dtype=bool)
    kept &= stretch >= (-np.inf if low is None else low)
    kept &= stretch <= (np.inf if high is None else high)
    if not kept.any():
        raise InputError(
            f"No stretch of the file lies in the asked range; it has [{stretch.min():g}, "
            f"{stretch.max():g}]. Widen --stretch-min and --stretch-max: {file}"
        )
    return stretch[kept], table[load][kept]


@command.command("hyperelastic")
@_FILE
@click.option("--model", type=click.Choice(["auto", *LAWS]), default="auto", show_default=True)
@_LOWEST
@_HIGHEST
@click.option(
    "--lateral-stretch", type=float, help="The width is clamped at this stretch; 1 is pure shear."
)
@click.option(
    "--electrode-natural", type=float, help="Fit electrodes too, natural at this stretch."
)
@answer_options
def _hyperelastic(
    file: Path,
    model: str,
    stretch_min: float | None,
    stretch_max: float | None,
    lateral_stretch: float | None,
    electrode_natural: float | None,
    *,
    as_json: bool,
    out: Path | None,
) -> None:
    """Hyperelastic law from the columns stretch and nominal_stress_pa."""
    table = read_table(file, ["stretch", "nominal_stress_pa"])
    stretch, stress_pa = _between(table, "nominal_stress_pa", stretch_min, stretch_max, file)
    fit = fit_hyperelastic(
        stretch,
        stress_pa,
        model,
        deformation="uniaxial" if lateral_stretch is None else "fixed_lateral",
        lateral_stretch=1.0 if lateral_stretch is None else lateral_stretch,
        electrode_natural=electrode_natural,
    )
    _give(fit, [file], as_json, out)


@command.command("regions")
@_FILE
@click.option("--pieces", type=int, help="Number of pieces; chosen by BIC when not given.")
@_LOWEST
@_HIGHEST
@answer_options
def _regions(
    file: Path,
    pieces: int | None,
    stretch_min: float | None,
    stretch_max: float | None,
    *,
    as_json: bool,
    out: Path | None,
) -> None:
    """Linear regions, the longest first, from the columns stretch and load_n."""
    table = read_table(file, ["stretch", "load_n"])
    stretch, load_n = _between(table, "load_n", stretch_min, stretch_max, file)
    _give(find_regions(stretch, load_n, pieces), [file], as_json, out)


@command.command("voltage-map")
@_FILE
@answer_options
def _voltage_map(file: Path, *, as_json: bool, out: Path | None) -> None:
    """Voltage from strain (eq. 4) from the columns strain and voltage_v, in order of time."""
    table = read_table(file, ["strain", "voltage_v"])
    _give(fit_voltage_map(table["strain"], table["voltage_v"]), [file], as_json, out)


@command.command("capacitance-map")
@_FILE
@answer_options
def _capacitance_map(file: Path, *, as_json: bool, out: Path | None) -> None:
    """Strain from capacitance (eq. 5) from the columns relative_capacitance and strain."""
    table = read_table(file, ["relative_capacitance", "strain"])
    _give(fit_capacitance_map(table["relative_capacitance"], table["strain"]), [file], as_json, out)
