"""The main numbers of a run: what the actuator is like, and how its loops behave."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from haselab.report.analysis import Array, LeftOutError
from haselab.report.folder import RunFolder
from haselab.report.numbers import ABSENT, interval_text, number_text
from haselab.report.results import Quantity, Results

__all__ = ["Fact", "LoopTable", "facts", "loop_table", "own_kind"]

_HZ = 2.0 * math.pi


@dataclass(frozen=True)
class Fact:
    """One line about the actuator.

    Args:
        what: the quantity, in plain words.
        value: with its unit.
        interval: 95 % interval, or the condition of the value.
    """

    what: str
    value: str
    interval: str


@dataclass(frozen=True)
class LoopTable:
    """How the loops follow a step.

    Args:
        columns: headings of the cells.
        rows: name and cells of each loop; a missing cell is a dash.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]


# Heading of the column, and factor of its values. The first three are of a trial.
_CELLS = (
    ("Rise time 10–90 % (s)", 1.0),
    ("Overshoot (% of the step)", 100.0),
    ("Final error (% of the step)", 100.0),
    ("Phase margin (°)", 1.0),
    ("Gain margin (dB)", 1.0),
)
_OF_TRIAL = 3
# Ids in the order of the columns.
_LOOPS = {
    "Open loop": ("S24.rise_open", "", "S24.error_open", "", ""),
    "PI": ("S24.rise_closed", "S24.overshoot_closed", "S24.error_closed", "S21.phase_margin",
           "S21.gain_margin"),
    "PID": ("S25.rise_pid", "S25.overshoot_pid", "S25.error_pid", "S25.phase_margin",
            "S25.gain_margin"),
    "Controller {kind}": ("S25.rise_own", "S25.overshoot_own", "S25.error_own", "", ""),
    "Observer (physical model)": ("S25.rise_observer", "S25.overshoot_observer",
                                  "S25.error_observer", "", ""),
    "Hybrid (physical model)": ("S27.rise_own", "S27.overshoot_own", "S27.error_own", "", ""),
    "Hybrid, another mass": ("S27.rise_other", "S27.overshoot_other", "S27.error_other", "", ""),
    "Microcontroller (SIMULATED)": ("S26.rise", "S26.overshoot", "S26.error", "S26.phase_margin",
                                    ""),
    "Miniature bench (SIMULATED)": ("S28.rise", "S28.overshoot", "S28.error", "S28.phase_margin",
                                    ""),
}  # fmt: skip


def facts(run: RunFolder) -> tuple[Fact, ...]:
    """What the actuator is like.

    Args:
        run: the contents of the folder.

    Returns:
        The lines for which the run has data.
    """
    results = run.results
    return tuple(
        fact
        for found in (
            _reach(run),
            _of_row(results, ("S20.omega_n", "S19.omega_0"), "Natural frequency"),
            _of_row(results, ("S20.zeta", "S20.eq8_zeta"), "Damping ratio"),
            _of_row(results, ("S20.slow_tau",), "Slow motion (creep), time constant"),
            _map_errors(run),
            _sensing_error(run),
        )
        for fact in found
    )


def loop_table(results: Results) -> LoopTable | None:
    """How the loops follow a step; None if no loop was played or designed.

    Args:
        results: checked content of results.json.
    """
    found = {}
    for name, keys in _LOOPS.items():
        cells = tuple(
            _cell(results.get(key), factor) for key, (_, factor) in zip(keys, _CELLS, strict=True)
        )
        if set(cells) != {ABSENT}:
            played = "" if set(cells[:_OF_TRIAL]) != {ABSENT} else ", not played"
            found[name.format(kind=own_kind(results)) + played] = cells
    used = [at for at in range(len(_CELLS)) if any(row[at] != ABSENT for row in found.values())]
    if not used:
        return None
    return LoopTable(
        tuple(_CELLS[at][0] for at in used),
        tuple((name, tuple(cells[at] for at in used)) for name, cells in found.items()),
    )


def own_kind(results: Results) -> str:
    """The kind of the study's own controller, in quotation marks."""
    study = results.provenance.get("study")
    control = study.get("control") if isinstance(study, Mapping) else None
    kind = control.get("kind") if isinstance(control, Mapping) else None
    return f"'{kind}'" if kind else "of [control] kind"


def _value(row: Quantity, factor: float) -> tuple[str, str]:
    """The value with at most four digits, and its interval."""
    assert row.measured is not None
    value, std = factor * row.measured.value, factor * row.measured.std
    ends = [factor * end for end in row.measured.ci95]
    shown, interval = interval_text(value, std, ends)
    if value and math.isfinite(value) and std > 0.0:
        coarse = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
        shown, _ = interval_text(value, max(std, coarse), ends)
    return shown, interval


def _cell(row: Quantity | None, factor: float) -> str:
    return ABSENT if row is None or row.measured is None else _value(row, factor)[0]


def _of_row(results: Results, keys: tuple[str, ...], what: str) -> Iterator[Fact]:
    """The first of these results that has a value."""
    for key in keys:
        row = results.get(key)
        if row is None or row.measured is None or math.isnan(row.measured.value):
            continue
        value, interval = _value(row, 1.0)
        if row.unit == "rad/s":
            hertz, _ = _value(row, 1.0 / _HZ)
            value = f"{value} rad/s = {hertz} Hz"
        else:
            value = f"{value} {row.unit}".rstrip()
        yield Fact(what, value, f"{interval} {row.unit}".rstrip())
        return


def _reach(run: RunFolder) -> Iterator[Fact]:
    """Strains between the ends of the triangle."""
    try:
        volts = run.section("triangle").array("drive_v")
        strain = run.section("voltage_map").array("strain")
    except LeftOutError:
        return
    ends = [run.results.get(f"S18.strain_{end}") for end in ("min", "max")]
    low, high = (
        end.measured.value
        if end is not None and end.measured is not None and math.isfinite(end.measured.value)
        else other
        for end, other in zip(ends, (np.nanmin(strain), np.nanmax(strain)), strict=True)
    )
    drive = f"{number_text(np.nanmin(volts))} to {number_text(np.nanmax(volts))} V"
    yield Fact("Strain reach", f"{_per_cent(low)} to {_per_cent(high)} %", f"triangle, {drive}")


def _map_errors(run: RunFolder) -> Iterator[Fact]:
    """Distance of the measured values from both maps in the triangle."""
    try:
        section = run.section("voltage_map")
        strain, fit = section.array("strain"), section.array("fit_strain")
        order = np.argsort(fit)
        drawn = np.interp(
            strain, fit[order], section.array("fit_voltage_v", like=fit)[order], np.nan, np.nan
        )
        error = _rms(section.array("voltage_v", like=strain) - drawn)
        if error is not None:
            yield Fact("Error of the voltage map", f"{error:.2g} V rms", "hysteresis included")
    except LeftOutError:
        pass
    try:
        section = run.section("capacitance_map")
        tracked = section.array("strain_time")
        error = _rms(tracked - section.array("reconstructed_strain", like=tracked))
        if error is not None:
            text = f"{100.0 * error:.2g} % strain rms"
            yield Fact("Error of the capacitance map", text, "triangle, against the camera")
    except LeftOutError:
        pass


def _sensing_error(run: RunFolder) -> Iterator[Fact]:
    try:
        section = run.section("sensing")
        camera = section.array("camera_strain")
        error = _rms(section.array("sensed_strain", like=camera) - camera)
    except LeftOutError:
        return
    if error is not None:
        text = f"{100.0 * error:.2g} % strain rms"
        yield Fact("Error of the self-sensed strain", text, "steps, against the camera")


def _rms(difference: Array) -> float | None:
    finite = difference[np.isfinite(difference)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else None


def _per_cent(strain: float) -> str:
    return f"{100.0 * strain:.1f}".replace("-", "−")
