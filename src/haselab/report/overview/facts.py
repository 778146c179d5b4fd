"""The main numbers of a run: what the actuator is like."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from haselab.base import Estimate
from haselab.report.analysis import Array, LeftOutError
from haselab.report.folder import RunFolder
from haselab.report.numbers import interval_text, number_text
from haselab.report.results import Quantity, Results

__all__ = ["Fact", "facts", "rounded"]

_HZ = 2.0 * math.pi
_FEEDTHROUGH = (
    "Feedthrough: fraction of the sensed strain that follows the drive before the actuator moves"
)
_UNUSED = (
    "the margins use 0, because it is small or uncertain, or because the loop measures by camera"
)


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
            _slow_motion(results),
            _feedthrough(run),
            _map_errors(run),
            _sensing_error(run),
        )
        for fact in found
    )


def rounded(row: Quantity, factor: float) -> tuple[str, str]:
    """The value with at most four digits, and its interval.

    Args:
        row: with a value.
        factor: on both.

    Returns:
        Both as text.
    """
    assert row.measured is not None
    value, std = factor * row.measured.value, factor * row.measured.std
    ends = [factor * end for end in row.measured.ci95]
    shown, interval = interval_text(value, std, ends)
    if value and math.isfinite(value) and std > 0.0:
        coarse = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
        shown, _ = interval_text(value, max(std, coarse), ends)
    return shown, interval


def _of_row(results: Results, keys: tuple[str, ...], what: str) -> Iterator[Fact]:
    """The first of these results that has a value."""
    for key in keys:
        row = results.get(key)
        if row is None or row.measured is None or math.isnan(row.measured.value):
            continue
        value, interval = rounded(row, 1.0)
        if row.unit == "rad/s":
            hertz, _ = rounded(row, 1.0 / _HZ)
            value = f"{value} rad/s = {hertz} Hz"
        else:
            value = f"{value} {row.unit}".rstrip()
        yield Fact(what, value, f"{interval} {row.unit}".rstrip())
        return


def _slow_motion(results: Results) -> Iterator[Fact]:
    """What follows a fast motion: creep in its direction, or a partial return."""
    slow, fast, tau = (
        _measured(results, f"S20.{key}") for key in ("slow_gain", "gain", "slow_tau")
    )
    if tau is None:
        return
    name, amount = "Slow motion", None
    if slow is not None and fast is not None and fast.value != 0.0:
        share = slow.value / fast.value
        amount = f"{abs(100.0 * share):.2g} % of the fast motion"
        low, high = slow.ci95
        if not low * high > 0.0:
            name = "Slow motion, whose direction is not identifiable"
        elif share > 0.0:
            name = "Creep: slow further motion"
        else:
            name = "Slow partial return after the fast motion (the opposite of creep)"
    row = results.get("S20.slow_tau")
    assert row is not None
    value, interval = rounded(row, 1.0)
    parts = [amount, f"time constant {value} s"]
    yield Fact(name, ", ".join(filter(None, parts)), f"time constant: {interval} s")


def _measured(results: Results, key: str) -> Estimate | None:
    row = results.get(key)
    found = None if row is None else row.measured
    return None if found is None or math.isnan(found.value) else found


def _feedthrough(run: RunFolder) -> Iterator[Fact]:
    """How much of the sensed strain is no motion, and whether the loops are designed for it."""
    for fact in _of_row(run.results, ("S20.feedthrough",), _FEEDTHROUGH):
        try:
            used = run.section("loop").section("worst").number("feedthrough")
        except LeftOutError:
            yield fact
            return
        which = "the margins contain it" if used else _UNUSED
        yield replace(fact, interval=f"{fact.interval}; {which}")


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
