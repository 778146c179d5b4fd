"""The page of one actuator: the content of its file, with intervals, and what is missing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import resources
from types import MappingProxyType
from typing import Any

import jinja2
import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate
from haselab.base.chart import Chart, Curve, Panel
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.sections import PhysicalTable
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.models.plant import Plant
from haselab.models.posterior import PlantPosterior
from haselab.models.rational import RationalModel
from haselab.report.chart_file import draw_chart
from haselab.report.numbers import value_text
from haselab.report.style import figure_style, inline_svg, to_svg

__all__ = ["ActuatorReport", "actuator_page", "missing_sections"]

_POINTS, _DRAWS = 300, 300
_SPAN = (0.02, 5.0)  # frequencies of the Bode plot, as multiples of the fastest pole's size
_TITLES = {
    "actuator": "Actuator",
    "sensing": "Calibration of the monitors",
    "sensing.strain_map": "Map from capacitance to strain",
    "drive": "Drive and limits",
    "drive.voltage_map": "Map from strain to drive voltage",
    "model": "Model",
    "model.physical": "Physical model",
    "controller": "Controller",
}
_KEY = {"sensing": "sensing.scale_s"}  # key that a section lacks; the others are whole tables
_COMMANDS = {
    "sensing.scale_s": "calibrate in Python, see docs/measure/sensing.md (not for the twin)",
    "sensing.strain_map": "haselab identify capacitance-map FILE --actuator A.toml",
    "drive.voltage_map": "haselab identify voltage-map FILE --actuator A.toml",
    "model": "haselab identify transfer FILE --actuator A.toml",
    "controller": "haselab design A.toml",
}
_UNITS = (
    ("_rad_s", "rad/s"), ("_per_f3", "1/F³"), ("_per_f2", "1/F²"), ("_per_f", "1/F"),
    ("_v_per_v", "V/V"), ("_v_per_m", "V/m"), ("_hz", "Hz"), ("_kg", "kg"), ("_deg", "°"),
    ("_db", "dB"), ("scale_s", "S"), ("scale_std_s", "S"), ("stray_s", "S"), ("_s", "s"),
    ("_n_s_per_m", "N s/m"), ("_n_per_m", "N/m"), ("_n_m2", "N m²"), ("_pa", "Pa"), ("_n", "N"),
    ("_m", "m"), ("_v", "V"), ("_f", "F"),
)  # fmt: skip
_NOT_SHOWN = {"covariance", "alternatives", "reference"}  # matrices, raw readings; own tables

Floats = NDArray[np.float64]
Row = tuple[str, str, str, str]  # name, unit, value, 95 % interval
_PHYSICAL = "model.physical"
# Kept as tables of the section: the rows of its parameters have what matters of them.
_OF_PARAMETERS = {"parameters", "std", "measured", "determined_by", "not_identifiable", "residuals",
                  "records"}  # fmt: skip
_SIGNED = ("camera.", "sensing.", "load.", "drift.", "start.")  # whose parameters may be negative


@dataclass(frozen=True)
class ActuatorReport:
    """Input of the page.

    Args:
        sections: of the actuator file, unchecked.
        tables: the same, checked.
        plant: of `[model]`; None: there is no model yet.
        posterior: parameters of the plant with their covariance; None: there is none.
        doubts: by section, why its numbers are not those of this actuator.
        units: of the controller's gains and limits, by name, see `gain_units`.
    """

    sections: Mapping[str, Any]
    tables: ActuatorTables
    plant: Plant | RationalModel | None = None
    posterior: PlantPosterior | None = None
    doubts: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Part:
    """One section of the page."""

    name: str
    title: str
    rows: list[Row]
    missing: str
    doubt: str
    svg: str
    caption: str
    sources: dict[str, str] = field(default_factory=dict)  # what determines a row, by its name


def missing_sections(report: ActuatorReport) -> dict[str, str]:
    """List what the file does not have yet, and the command that writes each.

    Args:
        report: input of the page.
    Returns:
        Commands by the name of the section, or of its key.
    """
    tables, controller = report.tables, report.tables.controller
    known = {
        "sensing.scale_s": tables.sensing.is_calibrated,
        "sensing.strain_map": tables.sensing.strain_map is not None,
        "drive.voltage_map": tables.drive.voltage_map is not None,
        "model": report.plant is not None,
        "controller": controller is not None and bool(controller.all_kinds),
    }
    return {name: _COMMANDS[name] for name, there in known.items() if not there}


def actuator_page(report: ActuatorReport) -> str:
    """Compose one self-contained HTML document.

    Args:
        report: input of the page.
    Returns:
        The page; the same input gives the same bytes.
    """
    absent = missing_sections(report)
    charts = _charts(report)
    parts = []
    for name, title in _TITLES.items():
        svg, caption = "", ""
        if name in charts:
            chart, caption = charts[name]
            with figure_style():
                svg = inline_svg(to_svg(draw_chart(chart), name.replace(".", "-"), chart.title))
        if name == _PHYSICAL and _physical(report) is None:
            continue  # no actuator needs one
        rows = list(_rows_of(report, name))
        missing, doubt = absent.get(_KEY.get(name, name), ""), report.doubts.get(name, "")
        sources = _sources(report) if name == _PHYSICAL else {}
        parts.append(_Part(name, title, rows, missing, doubt, svg, caption, sources))
    provenance = dict(_provenance(report.sections.get("provenance")))
    simulated = any(origin.get("simulated") is True for origin in provenance.values())
    about = report.tables.actuator
    title = about.name or "Actuator without a name"
    text = _packaged("actuator.html.j2")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["value"] = value_text
    return environment.from_string(text).render(
        title=f"SIMULATED: {title}" if simulated else title,
        kind=about.kind,
        style=_packaged("style.css"),
        parts=parts,
        provenance=provenance,
    )


def _packaged(name: str) -> str:
    return resources.files("haselab.report").joinpath("templates", name).read_text(encoding="utf-8")


def _provenance(table: Any, name: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The tables of `[provenance]` by section."""
    if not isinstance(table, Mapping):
        return
    if "command" in table:
        yield name, {key: item for key, item in table.items() if not isinstance(item, Mapping)}
    for key, item in table.items():
        yield from _provenance(item, f"{name}.{key}" if name else str(key))


# ---- numbers ------------------------------------------------------------------------------------


def _rows_of(report: ActuatorReport, name: str) -> Iterator[Row]:
    table: Any = report.sections
    for part in name.split("."):
        table = table.get(part, {}) if isinstance(table, Mapping) else {}
    if not isinstance(table, Mapping):
        return
    left_out = {"strain_map", "voltage_map", "physical"} | _NOT_SHOWN
    if name == _PHYSICAL:
        left_out |= _OF_PARAMETERS
    shown = {key: item for key, item in table.items() if key not in left_out}
    known, units = _intervals(report, name), report.units if name == "controller" else {}
    for key, estimate in known.items():
        yield _row(key, estimate)
    for key, item in _flat(shown):
        if key not in known:
            yield _row(key, item, units)
    if name == _PHYSICAL:
        yield from _stated(report)
    for alternative in table.get("alternatives", ()) if name == "controller" else ():
        title = f"alternative {alternative.get('kind', '')}"
        for key, item in _flat({"parameters": alternative.get("parameters", {})}):
            yield _row(f"{title}: {key}", item, units)


def _physical(report: ActuatorReport) -> PhysicalTable | None:
    model = report.tables.model
    return None if model is None else model.physical


def _stated(report: ActuatorReport) -> Iterator[Row]:
    """Parameters that were not fitted, and how well the model explains its records."""
    physical = _physical(report)
    if physical is None:
        return
    for key, value in physical.measured.items():
        yield key, _unit(key), value_text(value), "stated, not fitted"
    residuals = physical.residuals
    for what, unit, rms, noise in (
        ("length", "m", residuals.length_rms_m, residuals.length_noise_m),
        ("capacitance", "F", residuals.capacitance_rms_f, residuals.capacitance_noise_f),
    ):
        if rms is not None and noise is not None:
            shown = f"{value_text(rms)}, of which noise {value_text(noise)}"
            yield f"residuals of the {what}, rms", unit, shown, ""
    if physical.records is not None:
        yield "experiments of the records", "", value_text(list(physical.records.experiments)), ""


def _sources(report: ActuatorReport) -> dict[str, str]:
    """Which experiments and signals determine each parameter of the physical model."""
    physical = _physical(report)
    if physical is None:
        return {}
    return {key: ", ".join(found) for key, found in physical.determined_by.items()}


def _flat(table: Mapping[str, Any], name: str = "") -> Iterator[tuple[str, Any]]:
    """Values by dotted name; a standard deviation follows its value."""
    for key, item in table.items():
        place = f"{name}.{key}" if name else str(key)
        if key in _NOT_SHOWN:
            continue
        if isinstance(item, Mapping):
            yield from _flat(item, place)
        elif isinstance(item, list) and any(isinstance(part, Mapping) for part in item):
            for k, part in enumerate(item, start=1):
                if isinstance(part, Mapping):
                    yield from _flat(part, f"{place}.{k}")
        elif not (key.endswith("_std") and key.removesuffix("_std") in table):
            std = table.get(f"{key}_std")
            if isinstance(std, float) and isinstance(item, float):
                item = Estimate.normal(item, std, _unit(key))
            yield place, item


def _row(key: str, item: Any, units: Mapping[str, str] = MappingProxyType({})) -> Row:
    """One row; `units` has those that a name does not end with."""
    if isinstance(item, Estimate):
        shown = value_text(item.to_dict() | {"unit": ""})
        value, _, interval = shown.partition(" [")
        return key, item.unit, value, f"[{interval}" if interval else "—"
    parts = item if isinstance(item, list) else [item]
    is_number = not any(isinstance(part, (str, bool)) for part in parts)
    table, _, last = key.rpartition(".")
    unit = _unit(key) or units.get(last if last not in ("low", "high") else table, "")
    return key, unit if is_number else "", value_text(item), ""


def _unit(key: str) -> str:
    name = key.partition("[")[0]  # one of several branches
    return next((unit for ending, unit in _UNITS if name.endswith(ending)), "")


def _intervals(report: ActuatorReport, name: str) -> dict[str, Estimate]:
    """Parameters of a section whose covariance is in the file."""
    tables = report.tables
    if name == _PHYSICAL:
        return _of_physical(report)
    if name == "model" and report.posterior is not None:
        p = report.posterior
        std = np.sqrt(np.maximum(np.diag(p.covariance), 0.0))
        return {
            key: (Estimate.lognormal if logarithmic else Estimate.normal)(value, s, _unit(key))
            for key, logarithmic, value, s in zip(
                p.names, p.logarithmic, p.values, std, strict=True
            )
        }
    maps = {
        "sensing.strain_map": (tables.sensing.strain_map,
                               ("slope_per_f", "offset", "curvature_per_f2", "cubic_per_f3")),
        "drive.voltage_map": (tables.drive.voltage_map, ("a1_v", "b1", "a2_v", "b2")),
    }  # fmt: skip
    table, keys = maps.get(name, (None, ()))
    if table is None or table.covariance is None or len(table.covariance) != len(keys):
        return {}
    std = np.sqrt(np.maximum(np.diag(np.asarray(table.covariance)), 0.0))
    return {
        key: Estimate.normal(getattr(table, key), s, _unit(key))
        for key, s in zip(keys, std, strict=True)
    }


def _of_physical(report: ActuatorReport) -> dict[str, Estimate]:
    """Fitted parameters of the physical model; one that is not identifiable has no ends."""
    physical = _physical(report)
    found: dict[str, Estimate] = {}
    for key, value in ({} if physical is None else physical.parameters).items():
        assert physical is not None
        std = physical.std.get(key, np.nan)
        if key in physical.not_identifiable or not np.isfinite(std):
            found[key] = Estimate(value, np.nan, (np.nan, np.nan), _unit(key))
        elif value > 0.0 and not key.startswith(_SIGNED):
            found[key] = Estimate.lognormal(value, std / value, _unit(key))
        else:
            found[key] = Estimate.normal(value, std, _unit(key))
    return found


# ---- figures ------------------------------------------------------------------------------------


def _charts(report: ActuatorReport) -> dict[str, tuple[Chart, str]]:
    """Figure and caption by section."""
    found = {}
    tables = report.tables
    if tables.sensing.strain_map is not None and tables.sensing.strain_map.range_f is not None:
        to_strain = tables.strain_map()
        caption = "The map over the capacitances of the fitted record"
        if to_strain.band is not None:
            caption += f", with the band that contains {100 * to_strain.coverage:g} % of the record"
        found["sensing.strain_map"] = _strain_chart(to_strain), f"{caption}."
    if tables.drive.voltage_map is not None:
        found["drive.voltage_map"] = (
            _voltage_chart(tables.voltage_map()),
            "The drive voltage, before the amplifier, at a constant strain.",
        )
    if report.plant is not None:
        caption = "Frequency response of the model"
        if report.posterior is not None:
            caption += ", with its 95 % interval from the covariance"
        found["model"] = _bode_chart(report.plant, report.posterior), f"{caption}."
    return found


def _strain_chart(to_strain: StrainMap) -> Chart:
    assert to_strain.range_f is not None
    capacitance_f = np.linspace(*to_strain.range_f, _POINTS)
    percent = 100.0 * to_strain.strain(capacitance_f)
    pico = 1e12 * capacitance_f
    curves = [Curve(pico, percent, "map")]
    for end, label in zip(to_strain.band or (), ("band", ""), strict=False):
        curves.append(Curve(pico, percent + 100.0 * end, label))
    return Chart("Strain from capacitance", (Panel("Capacitance (pF)", "Strain (%)", curves),))


def _voltage_chart(to_volt: VoltageMap) -> Chart:
    strain = np.linspace(to_volt.strain_low, to_volt.strain_high, _POINTS)
    curve = Curve(100.0 * strain, np.asarray(to_volt.voltage_v(strain)))
    return Chart("Drive voltage from strain", (Panel("Strain (%)", "Drive (V)", (curve,)),))


def _bode_chart(plant: Plant | RationalModel, posterior: PlantPosterior | None) -> Chart:
    sizes = np.abs(np.asarray(plant.poles, dtype=complex))
    fastest = float(sizes.max()) if sizes.size and sizes.max() > 0.0 else 1.0
    omega = np.geomspace(_SPAN[0] * fastest, _SPAN[1] * fastest, _POINTS)
    hz = omega / (2.0 * np.pi)
    response = plant.frequency_response(omega)
    size, phase = np.abs(response), np.degrees(np.unwrap(np.angle(response)))
    sizes_drawn, phases_drawn = [Curve(hz, size, "model")], [Curve(hz, phase)]
    if posterior is not None:
        plants = posterior.draw(_DRAWS, np.random.default_rng(1))
        draws = np.array([each.frequency_response(omega) for each in plants])
        turns = np.degrees(np.angle(draws / response))
        for share, label in ((2.5, "95 % interval"), (97.5, "")):
            sizes_drawn.append(Curve(hz, np.percentile(np.abs(draws), share, axis=0), label))
            phases_drawn.append(Curve(hz, phase + np.percentile(turns, share, axis=0)))
    axis = "Frequency (Hz)"
    return Chart("Frequency response", (
        Panel(axis, "Magnitude", sizes_drawn, log_x=True, log_y=True),
        Panel(axis, "Phase (°)", phases_drawn, log_x=True),
    ))  # fmt: skip
