"""Check what [controller] and [model] state against the rest of their file."""

from __future__ import annotations

import math
from pathlib import Path

import click

from haselab.base import InputError
from haselab.cli.actuator_file import load_run
from haselab.cli.model.feedback import feedback_of
from haselab.cli.model.model_file import loop_of, read_any_plant, read_origin
from haselab.control import margins
from haselab.models.actuator import ControllerSection
from haselab.store.actuator_file import ACTUATOR

__all__ = ["controller_doubt", "model_doubt", "warn_doubts"]

_DEG, _DB = 1.0, 0.5  # above the rounding of numbers typed by hand, below what matters to a loop
_SAME = 1e-6  # relative difference of a map's coefficients


def controller_doubt(path: Path, kind: str | None = None) -> str:
    """Why the margins that a controller states are not those of `[model]` in the same file.

    They are computed again, at the rate and the delay in the controller's own `loop`. They differ
    if the model or the gains changed after the design, or were typed by hand.

    Args:
        path: an actuator file, or the folder of a run.
        kind: kind or name of the controller; None: that of `[controller]`.
    Returns:
        What is wrong and what to do; empty if the margins are right, or if none are stated.
    """
    section = load_run(path).controller
    held = section if kind is None or section is None else section.all_kinds.get(kind)
    file = path / ACTUATOR if path.is_dir() else path
    if held is None or not held.margins or not file.exists():  # an older run states no margins
        return ""
    design = f"haselab design {file}" + ("" if held.kind == "pid" else f" --controller {held.kind}")
    stated = held.margins.get("phase_margin_deg"), held.margins.get("gain_margin_db")
    try:
        found = _margins(held, file)
    except InputError as error:
        return f"The margins of [controller] cannot be verified. {error}"
    if all(map(_agree, stated, found, (_DEG, _DB))):
        return ""
    return (
        f"[controller] states {_text(*stated)}, but with [model] of the same file the "
        f"{held.name or held.kind} has {_text(*found)}. Design it again with: {design}"
    )


def _margins(held: ControllerSection, file: Path) -> tuple[float, float]:
    """Phase margin, in degrees, and gain margin, in dB, with the model of the file."""
    loop = held.loop
    rate_hz, delay_s = loop_of(
        file,
        None if loop is None else loop.rate_hz,
        None if loop is None else loop.measurement_delay_s,
    )
    feedback = feedback_of(held, rate_hz)
    found = margins(read_any_plant(file), feedback, loop_delay_s=delay_s, rate_hz=rate_hz)
    return found.phase_margin_deg, found.gain_margin_db


def _agree(stated: float | None, found: float, tolerance: float) -> bool:
    """Whether two margins are the same; one that is not stated agrees with any."""
    return stated is None or stated == found or abs(stated - found) <= tolerance


def _text(phase_deg: float | None, gain_db: float | None) -> str:
    both = (("a phase margin of", phase_deg, "deg"), ("a gain margin of", gain_db, "dB"))
    return " and ".join(
        f"{name} {value:.3g} {unit}" for name, value, unit in both if value is not None
    )


def model_doubt(path: Path) -> str:
    """Why `[model]` does not describe the loop with the voltage map of its file.

    Args:
        path: an actuator file, or the folder of a run.
    Returns:
        What is wrong and what to do; empty if the model was identified through this map, or if
        the file does not say through which one.
    """
    tables = load_run(path)
    file, table = path / ACTUATOR if path.is_dir() else path, tables.drive.voltage_map
    if table is None or tables.model is None or not tables.model.model_extra or not file.exists():
        return ""
    used, now = read_origin(file).through_voltage_map, table.coefficients
    if not used or all(math.isclose(a, b, rel_tol=_SAME) for a, b in zip(used, now, strict=True)):
        return ""
    return (
        "[model] was identified through another [drive.voltage_map] than the one in the file. "
        "Identify it again with: haselab identify transfer FILE --through-voltage-map --actuator "
        f"{file}"
    )


def warn_doubts(path: Path, kind: str | None = None) -> None:
    """Warn of margins that are not those of the model, and of a model for another voltage map.

    Args:
        path: an actuator file, or the folder of a run.
        kind: kind or name of the controller; None: that of `[controller]`.
    """
    for doubt in (model_doubt(path), controller_doubt(path, kind)):
        if doubt:
            click.echo(f"haselab: warning: {doubt}", err=True)
