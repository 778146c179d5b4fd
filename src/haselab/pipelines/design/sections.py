"""The sections [model] and [controller] of the actuator file, made from a fit or a design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from haselab.base import Estimate, InputError, ResultError, table_at
from haselab.control import Design, DesignSpec, Saturation
from haselab.control.reach import reachable_range
from haselab.control.stability.plausible import PlausibleMargins
from haselab.identify.transfer.fit import TransferFit
from haselab.models.actuator import ActuatorTables
from haselab.pipelines.design.answer import design_answer
from haselab.pipelines.design.model_file import read_origin, read_tables
from haselab.store.actuator_file import read_actuator
from haselab.store.toml import read_toml

__all__ = [
    "CONTROLLER_KEYS",
    "MODEL_KEYS",
    "controller_section",
    "default_limits_note",
    "demands_of",
    "limits_of",
    "model_section",
    "other_controllers",
]

MODEL_KEYS = (
    "gain", "natural_frequency_rad_s", "damping_ratio", "delay_s", "slow_modes", "poles", "zeros",
    "numerator", "denominator", "covariance", "residual_std", "fit_percent", "input", "output",
    "input_unit", "output_unit", "training_output", "fitted_to", "through_voltage_map",
    "input_range",
)  # fmt: skip
CONTROLLER_KEYS = (
    "kind", "name", "parameters", "limits", "loop", "margins", "demands", "predicted", "plausible",
    "uncertainty", "alternatives",
)  # fmt: skip
_STRAIN_TOLERANCE = 1e-3
_DEFAULT = (Saturation().low, Saturation().high)  # strain, the study's
_NO_UNCERTAINTY = "no uncertainty: [model] has no covariance"


def model_section(
    fit: TransferFit, names: tuple[str, str], units: tuple[str, str]
) -> dict[str, object]:
    """`[model]` of a transfer function, its full covariance included.

    Args:
        fit: with a result.
        names: of input and output.
        units: of input and output; "" where they are not known.
    Returns:
        The keys of the section.
    Raises:
        ResultError: a number is not identifiable.
    """
    unknown = [name for name, estimate in fit.parameters.items() if np.isnan(estimate.value)]
    if unknown:
        slow = any(name.startswith("slow_") for name in unknown)
        raise ResultError(
            f"[model] was not written: {', '.join(unknown)} not identifiable from these records. "
            + (
                "Add a record with a step that is held for several time constants before and after "
                "it, or leave out --slow-modes, or give them with --fix"
                if slow
                else "Add a record that determines it, fit a simpler structure, or give it with "
                "--fix"
            )
        )
    value = {name: estimate.value for name, estimate in fit.parameters.items()}
    simple = fit.structure.poles == 2 and not fit.structure.zeros
    resonance = ("natural_frequency_rad_s", "damping_ratio")
    roots = {} if simple else {"poles": list(fit.poles), "zeros": list(fit.zeros)}
    residuals, known = np.concatenate(fit.residuals), fit.training_output
    return {
        "input": names[0],
        "input_unit": units[0],
        "output": names[1],
        "output_unit": units[1],
        "gain": value["gain"],
        **{name: value[name] for name in resonance if name in value},
        "delay_s": max(value["delay_s"], 0.0),
        "slow_modes": [
            {"gain": gain.value, "time_constant_s": tau.value} for gain, tau in fit.slow_modes
        ]
        or None,
        **roots,
        "fit_percent": fit.fit_percent,
        "residual_std": float(np.sqrt(np.mean(residuals**2))),
        "covariance": fit.posterior.to_dict(),
        "training_output": None if known is None else known.to_dict(),
        "input_range": fit.input_range,
    }


def limits_of(path: Path, given: tuple[float, float] | None) -> Saturation:
    """Range of a controller's output: as given, else from the actuator file, else the study's.

    The range is narrowed to the strains that the voltage map reaches within `[drive]`.

    Args:
        path: of the model.
        given: on the command line.
    Returns:
        The range.
    Raises:
        InputError: the file has impossible values, or the model's input is a voltage and the limits
            or the map are those of a strain, or its output is a length and the maps are of strain.
        ResultError: the drive does not reach zero strain.
    """
    origin = read_origin(path)
    in_volts = origin.input_unit == "V"
    own = path.suffix.lower() == ".toml"
    known = read_tables(path) if own else ActuatorTables()
    typed = None if known.controller is None else known.controller.limits
    drive, ends_v = known.drive, known.drive_ends_v()
    if in_volts and drive.voltage_map is not None:
        raise InputError(
            "The input of [model] is a voltage, but [drive.voltage_map] expects a strain. Identify "
            f"the model again with --through-voltage-map, or remove the map. {path}"
        )
    if in_volts and given is None and typed is None:
        raise InputError(
            f"The model's input is a voltage, but the default limits {_DEFAULT[0]:g} to "
            f"{_DEFAULT[1]:g} are strains. Give the limits in V with --limits LOW HIGH. {path}"
        )
    loop_of_strain = drive.voltage_map is not None or known.sensing.strain_map is not None
    if origin.output_unit not in ("", "1") and loop_of_strain:
        raise InputError(
            f"The output of [model] is in {origin.output_unit}, but the maps of this file are for "
            "a loop that measures strain. Identify the model again with the strain as output. "
            f"{path}"
        )
    wanted = Saturation(*(given or _DEFAULT))
    if given is None and typed is not None:
        wanted = Saturation(typed.low, typed.high)
    if drive.voltage_map is None or ends_v == (None, None):
        return wanted
    return reachable_range(wanted, drive.voltage_map.map(), *ends_v)


def default_limits_note(path: Path, given: tuple[float, float] | None, used: Saturation) -> str:
    """Say that nobody stated the limits, if the drive reaches further than they do.

    Args:
        path: of the model.
        given: on the command line.
        used: see `limits_of`.
    Returns:
        A sentence; empty if the limits are stated, or the reach is not known.
    """
    if given is not None or path.suffix.lower() != ".toml":
        return ""
    known = read_tables(path)
    stated = known.controller is not None and known.controller.limits is not None
    if stated or known.drive.voltage_map is None or known.drive_ends_v() == (None, None):
        return ""
    to_volt = known.voltage_map()
    map_ends = (min(to_volt.strain_low, 0.0), max(to_volt.strain_high, 0.0))
    reach = reachable_range(Saturation(*map_ends), to_volt, *known.drive_ends_v())
    if reach.low > used.low - _STRAIN_TOLERANCE and reach.high < used.high + _STRAIN_TOLERANCE:
        return ""
    return (
        f"No limits are stated, so the controller's output is limited to strains of {used.low:.3g} "
        f"to {used.high:.3g}. The voltage map reaches {reach.low:.3g} to {reach.high:.3g} within "
        f"[drive]. To use more of it, add --limits LOW HIGH. {path}"
    )


def controller_section(design: Design, kind: str) -> dict[str, object]:
    """`[controller]` of a design.

    Args:
        design: what was found.
        kind: of the controller.
    Returns:
        The keys of the section.
    """
    limits, setting, answer = design.setting.saturation, design.setting, design_answer(design)
    margins = ("phase_margin_deg", "gain_margin_db", "delay_margin_s", "peak_sensitivity",
               "crossover_rad_s", "worst_phase_margin_deg", "worst_gain_margin_db")  # fmt: skip
    step = ("rise_time_s", "overshoot", "settling_time_s", "steady_state_error", "worst_overshoot")
    demands = {name: value for name, value in asdict(design.spec).items() if value is not None}
    return {
        "kind": kind,
        "uncertainty": _NO_UNCERTAINTY if design.plausible is None else None,
        "parameters": asdict(design.gains),
        "limits": {"low": limits.low, "high": limits.high},
        "loop": {
            "rate_hz": setting.rate_hz,
            "measurement_delay_s": setting.measurement_delay_s,
        },
        "margins": {name: answer[name] for name in margins},
        "predicted": {name: answer[name] for name in step}
        | {"shortfalls": list(design.shortfalls) or None},
        "plausible": None if design.plausible is None else _plausible(design.plausible, answer),
        "demands": demands,
    }


def _plausible(found: PlausibleMargins, answer: Mapping[str, object]) -> dict[str, object]:
    """Shares of the plausible plants that keep the margins, with their standard deviations."""
    shares = answer["posterior"]
    assert isinstance(shares, Mapping)
    values: dict[str, object] = {"draws": found.stable.size}
    for name, value in shares.items():
        if isinstance(value, Estimate):
            values |= {name: value.value, f"{name}_std": value.std}
    return values


def demands_of(model: Path, spec: Path | None = None) -> DesignSpec:
    """Read the demands on a loop.

    Args:
        model: file of the model.
        spec: a specification; None: that of the model's file, if it is an actuator file that has
            one, else the built-in one.
    Returns:
        The specification.
    Raises:
        InputError: an unknown demand, or an impossible value.
    """
    table: Mapping[str, object] = {}
    if spec is not None:
        table = read_toml(spec, "specification")
    elif model.suffix.lower() == ".toml" and (typed := read_tables(model).controller):
        table = typed.demands
    try:
        return DesignSpec.from_mapping(table)
    except InputError as error:
        raise InputError(f"{error} {spec or model}") from None


def other_controllers(path: Path, name: str) -> list[dict[str, object]]:
    """Read the controllers of an actuator file that a design keeps as alternatives.

    Args:
        path: of the actuator file.
        name: name or kind of the new design, which replaces one of the same name.
    Returns:
        Their tables as they are in the file.
    """
    typed = read_tables(path).controller
    if typed is None:
        return []
    table = table_at(read_actuator(path), "controller")
    others = table.get("alternatives", ())
    held = [{key: table[key] for key in table if key not in ("alternatives", "demands")}]
    if isinstance(others, Sequence):
        held += [dict(other) for other in others if isinstance(other, Mapping)]
    every = zip((typed, *typed.alternatives), held, strict=True)
    return [dict(raw) for one, raw in every if one.is_known and (one.name or one.kind) != name]
