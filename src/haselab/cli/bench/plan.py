"""`haselab plan carrier`: choose the sensing frequency, and show its sources of error."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

import click
import numpy as np

from haselab.base import to_plain
from haselab.base.chart import Chart, Curve, Panel
from haselab.cli.common import REAL, answer_options
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.cli.study.feasibility import command as feasibility
from haselab.sensing.carrier_plan import (
    CarrierChoice,
    CarrierPlan,
    CarrierRequest,
    evaluate_carrier,
    plan_carrier,
)
from haselab.store.folder import write_json

__all__ = ["command"]

F = TypeVar("F", bound=Callable[..., Any])

_PAPER_HZ = 2000.0
_NEGLIGIBLE = 1e-7  # relative error that is shown as 0
_BANDS = 8  # rows of the table besides the chosen and the given carrier

# field of CarrierRequest: help of its option; None: an option shared with other commands
_OPTIONS = {
    "rate_hz": None,
    "update_hz": "Set the update rate of the output in Hz.",
    "block_s": None,
    "blank_s": None,
    "step_v": "Set the typical step of the voltage monitor at an update, in V.",
    "mains_hz": "Set the mains frequency in Hz.",
    "mains_v": "Set the peak of the mains hum on each monitor, in V.",
    "distortion": "Set the second harmonic of the carrier, relative to the carrier.",
    "bandwidth_hz": "Set the bandwidth of the amplifier in Hz.",
    "damping_ratio": "Set the damping ratio of the amplifier.",
    "capacitance_f": None,
    "series_ohm": "Set the series resistance of the electrodes in ohm.",
    "noise_v": "Set the rms noise of one sample on each monitor, in V.",
    "carrier_v": None,
    "gain": "Set the gain of the amplifier in V/V.",
    "volt_per_monitor_volt": None,
    "ampere_per_monitor_volt": None,
    "current_limit_a": None,
    "range_v": "Set the range of the converter in V: -range to +range.",
    "strain_per_relative": "Set the strain per relative change of capacitance. The default is the "
    "reference study's map at zero strain.",
}


def _request_options(function: F) -> F:
    defaults = {field.name: field.default for field in fields(CarrierRequest)}
    for name, text in reversed(_OPTIONS.items()):
        option = f"--{name.replace('_', '-')}"
        settings: dict[str, Any] = {"type": REAL, "default": defaults[name], "show_default": True}
        added = (
            shared_option(option, **settings)
            if text is None
            else click.option(option, help=text, **settings)
        )
        function = added(function)
    return function


def _row(choice: CarrierChoice, mark: str) -> str:
    c = choice
    parts = (c.noise, c.step, c.step_average, c.mains, c.alias, c.total)
    numbers = " ".join(f"{100.0 * part if part > _NEGLIGIBLE else 0.0:9.2g}" for part in parts)
    return (
        f"{c.carrier_hz:9.6g} {1e3 * c.v_peak_v:8.3g} {1e3 * c.i_peak_v:8.3g} {numbers} "
        f"{c.strain_std:9.2g}  {mark}"
    ).rstrip()


def _table(plan: CarrierPlan, given: CarrierChoice) -> list[CarrierChoice]:
    """The chosen and the given carrier, and the best of each part of the band."""
    count = len(plan.candidates)
    parts = [
        plan.candidates[count * k // _BANDS : count * (k + 1) // _BANDS] for k in range(_BANDS)
    ]
    shown = {min(part, key=lambda c: c.total).carrier_hz: part for part in parts if part}
    best = [c for c in plan.candidates if c.carrier_hz in shown]
    others = [plan.chosen, given]
    kept = [c for c in best if all(c.carrier_hz != other.carrier_hz for other in others)]
    unique = others if given.carrier_hz != plan.chosen.carrier_hz else others[:1]
    return sorted([*kept, *unique], key=lambda c: c.carrier_hz)


def _page(plan: CarrierPlan, given: CarrierChoice) -> str:
    """The answer as a table to read."""
    lines = [
        " carrier monitors, mV peak     one block, % of C, rms                          "
        "                strain",
        "      Hz  voltage  current     noise     steps  over 1 s     mains    folded     total"
        "       std",
    ]
    for choice in _table(plan, given):
        marks = {plan.chosen.carrier_hz: "<- chosen", given.carrier_hz: "<- given"}
        mark = marks.get(choice.carrier_hz, "" if choice.usable else "too much current or voltage")
        if choice.carrier_hz == plan.chosen.carrier_hz:
            mark = "<- chosen"
        lines.append(_row(choice, mark))
    lines += ["", f"{plan.chosen.carrier_hz:g} Hz"]
    lines += [f"  {text}" for text in (*plan.reasons, *plan.chosen.remarks)]
    if given.carrier_hz != plan.chosen.carrier_hz:
        lines += ["", f"Disadvantages of {given.carrier_hz:g} Hz"]
        lines += [f"  {text}" for text in _warnings(plan, given)]
    return "\n".join(lines)


def _warnings(plan: CarrierPlan, given: CarrierChoice) -> list[str]:
    """The disadvantages of the given carrier."""
    warnings = list(given.remarks)
    factor = given.total / plan.chosen.total
    if factor > 1.1:
        warnings.append(
            f"{given.carrier_hz:g} Hz has {factor:.2g} times the error of "
            f"{plan.chosen.carrier_hz:g} Hz."
        )
    return warnings


@click.group("plan")
def command() -> None:
    """Choose the carrier and check a study's feasibility."""


@command.command("carrier")
@shared_option(
    "--carrier-hz", type=REAL, default=_PAPER_HZ, show_default=True,
    detail="It is compared with the chosen one.",
)  # fmt: skip
@click.option(
    "--update-s", type=REAL, default=0.0, show_default=True,
    help="Set the time of the output's update within its block, in s.",
)  # fmt: skip
@click.option("--update-unknown", is_flag=True, help="Treat the time of the update as unknown.")
@_request_options
@answer_options(plot=True)
def _carrier(
    carrier_hz: float,
    update_s: float,
    update_unknown: bool,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **options: float,
) -> None:
    """Choose the sensing frequency with the smallest error.

    The error includes the monitors' noise (Cramer-Rao bound), the steps of the output, mains
    harmonics, and aliased harmonics of the carrier.
    """
    request = CarrierRequest(update_s=None if update_unknown else update_s, **options)
    given = evaluate_carrier(request, carrier_hz)
    plan = plan_carrier(request)
    answer: dict[str, Any] = {
        "carrier_hz": plan.chosen.carrier_hz,
        "reasons": plan.reasons,
        "chosen": asdict(plan.chosen),
        "asked": asdict(given),
        "warnings": _warnings(plan, given),
        "request": asdict(request),
        "candidates": [asdict(choice) for choice in plan.candidates],
    }
    if out is not None:
        write_json(out, answer)
    click.echo(json.dumps(to_plain(answer), indent=2) if as_json else _page(plan, given))
    save_plot(plot, lambda: _chart(plan, given))


def _chart(plan: CarrierPlan, given: CarrierChoice) -> Chart:
    """Error of the capacitance over the carrier; the chosen and the given one are marked."""
    hz = np.array([choice.carrier_hz for choice in plan.candidates])
    marked = [(plan.chosen, "chosen"), (given, "given")]
    curves = [Curve(hz, 100.0 * np.array([c.total for c in plan.candidates]), "all")]
    curves += [
        Curve(np.array([c.carrier_hz, c.carrier_hz]), 100.0 * np.array([c.total, c.total]),
              f"{name}, {c.carrier_hz:g} Hz", "points")
        for c, name in marked
    ]  # fmt: skip
    panel = Panel("Carrier (Hz)", "Error of one block (% of C, rms)", curves, log_y=True)
    return Chart("Sensing frequency", (panel,))


command.add_command(feasibility)
