"""`haselab calibrate`: calibrate the monitors with reference capacitors."""

from __future__ import annotations

import cmath
import json
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, Progress, ResultError, to_plain
from haselab.base.chart import Chart, Curve, Panel
from haselab.cli.actuator_file import load_actuator, save_section
from haselab.cli.common import POSITIVE, Real, actuator_option, answer_options, progress_bar
from haselab.cli.interrupt import Interruptible
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.cli.study.run import rig_file
from haselab.pipelines.calibration_file import calibration_section, save_calibration
from haselab.rig import ReferenceFixture, Rig
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.sensing.calibration import (
    Calibration,
    Reference,
    ReferenceReading,
    fit_calibration,
    read_reference,
)

__all__ = ["command"]

_SETTLE_S = 0.1  # after the carrier comes on; amplifier and monitors need 2 ms
_WORST_GAIN = 2.0  # a larger ratio to the nominal scale is a wiring or rig file mistake
_WORST_PHASE_RAD = 0.8  # more than two monitors at half their bandwidth cause


@dataclass(frozen=True)
class _Request:
    """The options of the command."""

    references: tuple[Reference, ...]
    carrier_hz: float
    carrier_v: float
    duration_s: float


def _references(
    context: click.Context, parameter: click.Parameter, values: tuple[str, ...]
) -> tuple[Reference, ...]:
    """Parse the references, `FARAD[,OHM[,TOLERANCE]]` each."""
    del context
    found = []
    for value in values:
        try:
            numbers = [float(part) for part in value.split(",")]
        except ValueError:
            numbers = []
        if not 1 <= len(numbers) <= 3:
            raise click.BadParameter(
                f"{value!r} is not FARAD[,OHM[,TOLERANCE]]. Use for example 1e-9 or 1e-9,5,0.01.",
                param=parameter,
            )
        found.append(Reference(*numbers))
    return tuple(found)


def _rig_of(name: str) -> Rig:
    if name == "twin":
        return make_twin(twin_of_reading("hz"), 1)
    config, seed = rig_file(Path(name))
    return make_twin(config, seed)


def _record(rig: Rig, request: _Request) -> NDArray[np.int16]:
    """Record what is connected: carrier on, drive at 0 V; both off at the end."""
    d = rig.description
    rig.source.zero()
    rig.generator.sine(request.carrier_hz, request.carrier_v)
    for _ in range(max(1, math.ceil(_SETTLE_S / d.block_s))):
        rig.acquisition.read()
    blocks = [rig.acquisition.read() for _ in range(round(request.duration_s / d.block_s))]
    rig.generator.off()
    rig.source.zero()
    return np.stack(blocks)


def _measure(
    rig: Rig, fixture: ReferenceFixture, request: _Request, progress: Progress
) -> list[ReferenceReading]:
    """Measure every reference in turn; always end at 0 V with the carrier off."""
    readings = []
    progress.start(len(request.references))
    try:
        for reference in request.references:
            fixture.connect(reference.capacitance_f, reference.series_ohm)
            codes = _record(rig, request)
            readings.append(
                read_reference(
                    codes,
                    rate_hz=rig.description.rate_hz,
                    carrier_hz=request.carrier_hz,
                    volt_per_reading=rig.description.volt_per_code,
                    full_scale=rig.description.top_code,
                )
            )
            progress.advance(1.0, f"{1e9 * reference.capacitance_f:g} nF")
        rig.safe()
        fixture.connect(None)
    finally:
        rig.safe()
        progress.stop()
    return readings


def _answer(calibration: Calibration, nominal_s: float) -> dict[str, Any]:
    """The calibration, and each reference before and after it."""
    c = calibration
    rows = []
    for reference, reading in zip(c.references, c.readings, strict=True):
        measured_f = c.capacitance_f(reading.ratio)
        rows.append(
            {
                "nominal_f": reference.capacitance_f,
                "series_ohm": reference.series_ohm,
                "tolerance": reference.tolerance,
                "measured_f": measured_f,
                "std_f": c.capacitance_std_f(reference.capacitance_f, reference.series_ohm),
                "residual": measured_f / reference.capacitance_f - 1.0,
                "reading_f": nominal_s * reading.ratio.imag / (2.0 * math.pi * c.carrier_hz),
            }
        )
    return {
        "gain_error": nominal_s / abs(c.scale_s) - 1.0,
        "phase_rad": -cmath.phase(c.scale_s),
        "stray_f": c.stray_f,
        "stray_conductance_s": c.stray_s.real,
        "scale_s": c.scale_s,
        "scale_relative_std": c.scale_std_s / abs(c.scale_s),
        "stray_s": c.stray_s,
        "offsets_v": c.offsets_v,
        "residual": c.residual,
        "carrier_hz": c.carrier_hz,
        "rate_hz": c.rate_hz,
        "amplifier": c.amplifier,
        "date": c.date,
        "references": rows,
    }


def _chart(answer: dict[str, Any]) -> Chart:
    """The residual of each reference after the calibration."""
    columns = {key: np.array([row[key] for row in answer["references"]], dtype=np.float64)
               for key in ("nominal_f", "residual", "std_f")}  # fmt: skip
    order = np.argsort(columns["nominal_f"])
    nominal_f = columns["nominal_f"][order]
    left = Curve(1e9 * nominal_f, 100.0 * columns["residual"][order], "after the calibration",
                 "line", 100.0 * columns["std_f"][order] / nominal_f)  # fmt: skip
    return Chart("Calibration", (Panel("Reference (nF)", "Residual (%)", (left,)),))


def _page(answer: dict[str, Any]) -> str:
    """The answer as a table to read."""
    lines = ["nominal nF  uncalibrated nF  calibrated nF  residual %   std %"]
    for row in answer["references"]:
        std = 100.0 * row["std_f"] / row["nominal_f"]
        lines.append(
            f"{1e9 * row['nominal_f']:10.4g} {1e9 * row['reading_f']:16.5g} "
            f"{1e9 * row['measured_f']:14.5g} {100.0 * row['residual']:11.2g} {std:7.2g}"
        )
    count = len(answer["references"])
    left = (
        f"{100.0 * answer['residual']:.2g} %"
        if count > 2
        else "none: two references leave nothing to check"
    )
    exact = all(row["tolerance"] == 0.0 for row in answer["references"])
    turned = math.degrees(answer["phase_rad"])
    lines += [
        "",
        f"gain error of the monitors   {100.0 * answer['gain_error']:+.3f} %",
        f"phase between the monitors   {turned:+.3f} deg at {answer['carrier_hz']:g} Hz",
        f"stray capacitance            {1e12 * answer['stray_f']:.2f} pF",
        f"monitor offsets              {1e3 * answer['offsets_v'][0]:.2f} mV, "
        f"{1e3 * answer['offsets_v'][1]:.2f} mV",
        f"residual                     {left}",
        f"standard deviation of scale  {100.0 * answer['scale_relative_std']:.2g} %, "
        + ("references assumed exact" if exact else "tolerances of the references included"),
    ]
    return "\n".join(lines)


def _check_sane(answer: dict[str, Any]) -> None:
    factor = 1.0 + answer["gain_error"]
    if not 1.0 / _WORST_GAIN < factor < _WORST_GAIN:
        raise ResultError(
            f"The monitors have {factor:.3g} times their nominal gain, but the factor should "
            f"be {1 / _WORST_GAIN:g} to {_WORST_GAIN:g}. Check that the capacitances are stated in "
            "F (1e-9 for 1 nF), that each reference was connected in turn, and the monitors' "
            "scales in the rig file."
        )
    if abs(answer["phase_rad"]) > _WORST_PHASE_RAD:
        raise ResultError(
            f"The current monitor has a phase error of {math.degrees(answer['phase_rad']):.0f} "
            f"deg, more than {math.degrees(_WORST_PHASE_RAD):.0f}. Check the order of the "
            "references, the polarity of the monitors, and that their channels are not swapped."
        )


@click.command("calibrate")
@shared_option(
    "--rig", required=True, detail="'twin' uses the default twin. A real bench is refused."
)
@shared_option(
    "--capacitor",
    "references",
    metavar="FARAD[,OHM[,TOL]]",
    callback=_references,
    multiple=True,
    required=True,
    detail="Optionally with series resistance in ohm and relative tolerance: 1e-9,5,0.01. Repeat "
    "the option for each reference, at least two.",
)
@shared_option("--carrier-hz", type=Real(min=1.0), default=2000.0, show_default=True)
@shared_option("--carrier-v", type=POSITIVE, default=0.02, show_default=True)
@shared_option(
    "--duration-s", type=Real(min=0.1, max=600.0), default=1.0, show_default=True,
    detail="It is the recording time of each reference.",
)  # fmt: skip
@actuator_option("The command writes the calibration to [sensing].")
@answer_options(
    None, "It is a calibration file (TOML) for `haselab sense`. Default: none.", plot=True
)
def command(
    rig: str,
    actuator: Path | None,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **options: Any,
) -> None:
    """Calibrate the monitors of a simulated bench with reference capacitors.

    NO VOLTAGE IS APPLIED: --rig must be 'twin' or a rig file of kind = "twin". Therefore the
    command asks no question, arms nothing, and does not change the state of a bench that has
    tripped. A real bench is refused (exit code 2); the page 'Sensing' of the documentation
    describes its calibration in Python. Each --capacitor takes the actuator's place in turn,
    automatically. During a measurement the drive is 0 V and the carrier is on. --actuator or --out
    names the file for the calibration, which `haselab sense` reads.
    """
    if out is not None and out.is_dir():
        raise InputError(f"--out names a folder, not a file. Name a file in it. {out}")
    if actuator is not None:
        load_actuator(actuator, to_write=True)
    request = _Request(**options)
    if len(request.references) < 2:
        raise InputError(
            "Only one --capacitor was given, but scale and stray capacitance need at least 2 that "
            "differ. Add another one."
        )
    bench = _rig_of(rig)
    assert bench.fixture is not None  # a simulated one has it
    readings = _measure(bench, bench.fixture, request, Interruptible(progress_bar()))
    d = bench.description
    calibration = fit_calibration(
        request.references,
        readings,
        carrier_hz=request.carrier_hz,
        rate_hz=d.rate_hz,
        amplifier=d.amplifier,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    answer = _answer(calibration, d.v_monitor_v_per_v / d.i_monitor_v_per_a)
    _check_sane(answer)
    if out is not None:
        save_calibration(calibration, out)
    if actuator is not None:
        section = calibration_section(calibration)
        save_section(actuator, "sensing", section, [], list(section))
    click.echo(json.dumps(to_plain(answer), indent=2) if as_json else _page(answer))
    save_plot(plot, lambda: _chart(answer))
