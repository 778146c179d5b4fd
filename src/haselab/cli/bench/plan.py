"""`haselab plan carrier`: which sensing frequency, and what leaks into it."""

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
from haselab.cli.plot import save_plot
from haselab.cli.study.feasibility import command as feasibility
from haselab.sensing.carrier_plan import (
    CarrierChoice,
    CarrierPlan,
    CarrierRequest,
    judge_carrier,
    plan_carrier,
)
from haselab.store.folder import write_json

__all__ = ["command"]

F = TypeVar("F", bound=Callable[..., Any])

_PAPER_HZ = 2000.0
_NOTHING = 1e-7  # relative errors that no one will see
_BANDS = 8  # rows of the table beside choice and question

# option of CarrierRequest: what it is
_OPTIONS = {
    "rate_hz": "Samples per second and channel.",
    "update_hz": "New outputs per second.",
    "block_s": "Length of a block: one capacitance each.",
    "blank_s": "Time after each update that does not count.",
    "step_v": "Typical step of the voltage monitor at an update.",
    "mains_hz": "Mains frequency.",
    "mains_v": "Peak of the mains' fundamental on each monitor.",
    "distortion": "Second harmonic of the carrier, relative.",
    "bandwidth_hz": "Of the amplifier.",
    "damping_ratio": "Of the amplifier.",
    "capacitance_f": "Of the actuator.",
    "series_ohm": "Of its electrodes.",
    "noise_v": "Rms of one reading on each monitor.",
    "carrier_v": "Peak of the carrier ahead of the amplifier.",
    "gain": "Of the amplifier.",
    "volt_per_monitor_volt": "Scale of the voltage monitor.",
    "ampere_per_monitor_volt": "Scale of the current monitor.",
    "current_limit_a": "Of the amplifier.",
    "range_v": "Of the converter, either sign.",
    "strain_per_relative": "Strain per relative change of C; the study's line at zero strain.",
}


def _request_options(function: F) -> F:
    defaults = {field.name: field.default for field in fields(CarrierRequest)}
    for name, text in reversed(_OPTIONS.items()):
        function = click.option(
            f"--{name.replace('_', '-')}",
            type=REAL,
            default=defaults[name],
            show_default=True,
            help=text,
        )(function)
    return function


def _row(choice: CarrierChoice, mark: str) -> str:
    c = choice
    parts = (c.noise, c.step, c.step_average, c.mains, c.alias, c.total)
    numbers = " ".join(f"{100.0 * part if part > _NOTHING else 0.0:9.2g}" for part in parts)
    return (
        f"{c.carrier_hz:9.6g} {1e3 * c.v_peak_v:8.3g} {1e3 * c.i_peak_v:8.3g} {numbers} "
        f"{c.strain_std:9.2g}  {mark}"
    ).rstrip()


def _table(plan: CarrierPlan, asked: CarrierChoice) -> list[CarrierChoice]:
    """The choice, the question, and the best of each part of the band."""
    count = len(plan.candidates)
    parts = [
        plan.candidates[count * k // _BANDS : count * (k + 1) // _BANDS] for k in range(_BANDS)
    ]
    shown = {min(part, key=lambda c: c.total).carrier_hz: part for part in parts if part}
    best = [c for c in plan.candidates if c.carrier_hz in shown]
    others = [plan.chosen, asked]
    kept = [c for c in best if all(c.carrier_hz != other.carrier_hz for other in others)]
    unique = others if asked.carrier_hz != plan.chosen.carrier_hz else others[:1]
    return sorted([*kept, *unique], key=lambda c: c.carrier_hz)


def _page(plan: CarrierPlan, asked: CarrierChoice) -> str:
    """The answer for a reader."""
    lines = [
        " carrier monitors, mV peak     one block, % of C, rms                          "
        "                strain",
        "      Hz  voltage  current     noise     steps  over 1 s     mains    folded     total"
        "       std",
    ]
    for choice in _table(plan, asked):
        marks = {plan.chosen.carrier_hz: "<- chosen", asked.carrier_hz: "<- asked"}
        mark = marks.get(choice.carrier_hz, "" if choice.usable else "too much current or voltage")
        if choice.carrier_hz == plan.chosen.carrier_hz:
            mark = "<- chosen"
        lines.append(_row(choice, mark))
    lines += ["", f"{plan.chosen.carrier_hz:g} Hz"]
    lines += [f"  {text}" for text in (*plan.reasons, *plan.chosen.remarks)]
    if asked.carrier_hz != plan.chosen.carrier_hz:
        lines += ["", f"Against {asked.carrier_hz:g} Hz"]
        lines += [f"  {text}" for text in _warnings(plan, asked)]
    return "\n".join(lines)


def _warnings(plan: CarrierPlan, asked: CarrierChoice) -> list[str]:
    """What speaks against the carrier that was asked about."""
    warnings = list(asked.remarks)
    factor = asked.total / plan.chosen.total
    if factor > 1.1:
        warnings.append(
            f"{asked.carrier_hz:g} Hz has {factor:.2g} times the error of "
            f"{plan.chosen.carrier_hz:g} Hz."
        )
    return warnings


@click.group("plan")
def command() -> None:
    """Choices that are made before an experiment."""


@command.command("carrier")
@click.option(
    "--carrier-hz",
    type=REAL,
    default=_PAPER_HZ,
    show_default=True,
    help="A carrier to judge beside the choice; the default is the study's.",
)
@click.option(
    "--update-s",
    type=REAL,
    default=0.0,
    show_default=True,
    help="Time of the output's update in its block.",
)
@click.option("--update-unknown", is_flag=True, help="The time of the update is not known.")
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
    """The sensing frequency with the smallest error, and what leaks into it.

    Judged are the monitors' noise (Cramer-Rao bound), the steps of the output, mains harmonics and
    harmonics of the carrier that the converter folds back. --out names a JSON file.
    """
    request = CarrierRequest(update_s=None if update_unknown else update_s, **options)
    asked = judge_carrier(request, carrier_hz)
    plan = plan_carrier(request)
    answer: dict[str, Any] = {
        "carrier_hz": plan.chosen.carrier_hz,
        "reasons": plan.reasons,
        "chosen": asdict(plan.chosen),
        "asked": asdict(asked),
        "warnings": _warnings(plan, asked),
        "request": asdict(request),
        "candidates": [asdict(choice) for choice in plan.candidates],
    }
    if out is not None:
        write_json(out, answer)
    click.echo(json.dumps(to_plain(answer), indent=2) if as_json else _page(plan, asked))
    save_plot(plot, lambda: _chart(plan, asked))


def _chart(plan: CarrierPlan, asked: CarrierChoice) -> Chart:
    """Error of the capacitance over the carrier, the choice and the question marked."""
    hz = np.array([choice.carrier_hz for choice in plan.candidates])
    marked = [(plan.chosen, "chosen"), (asked, "asked about")]
    curves = [Curve(hz, 100.0 * np.array([c.total for c in plan.candidates]), "all")]
    curves += [
        Curve(np.array([c.carrier_hz, c.carrier_hz]), 100.0 * np.array([c.total, c.total]),
              f"{name}, {c.carrier_hz:g} Hz", "points")
        for c, name in marked
    ]  # fmt: skip
    panel = Panel("Carrier (Hz)", "Error of one block (% of C, rms)", curves, log_y=True)
    return Chart("Sensing frequency", (panel,))


command.add_command(feasibility)
