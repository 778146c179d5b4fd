"""The folder of a run: results, analysis for the report, the actuator file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from haselab.base import JsonObject, table_at
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.actuator.tables import strain_map_section, voltage_map_section
from haselab.models.maps import VoltageMap
from haselab.rig.protocols import PLANAR_HASEL
from haselab.store.actuator_file import ACTUATOR, write_sections
from haselab.store.claim import refuse_linked_folders
from haselab.store.folder import write_json
from haselab.study.analysis import experiments_of
from haselab.study.definition import Study
from haselab.study.experiments.foreign import rows_of_experiment
from haselab.study.fits.dynamics import Dynamics
from haselab.study.fits.loops import Loops, pid_demands
from haselab.study.fits.maps import Maps
from haselab.study.fits.trials import Comparison
from haselab.study.paper.paper_check import recompute_paper, recompute_steps
from haselab.study.paper.row_table import CITATION, study_rows
from haselab.study.paper.scope import changes_text, not_played
from haselab.study.pipeline import Findings
from haselab.study.results import VERDICT_RULE, axis_interpretation, quantity_rows
from haselab.study.simulated.truth import is_simulated, used_configuration
from haselab.study.tables import Control

__all__ = [
    "marked_unverified",
    "results_of",
    "sections_found",
    "write_actuator",
    "write_design",
    "write_findings",
]

_FOUND: Mapping[type, tuple[str, ...]] = {  # sections by the type of the finding in them
    Maps: ("sensing.strain_map", "drive.voltage_map"),
    Dynamics: ("model",),
    Loops: ("controller",),
}
# Keys of a model and a design that are removed from the file that the run started from.
_OF_AN_OLDER_MODEL = (
    "poles", "zeros", "numerator", "denominator", "slow_modes", "delay_s", "fit_percent",
    "fitted_to", "training_output", "input_range", "input_unit", "output_unit",
)  # fmt: skip
_OF_AN_OLDER_DESIGN = ("name", "predicted", "plausible", "uncertainty")
_RELATIVE = "relative_capacitance"  # in the paper's unit; other studies show it in F
_START = """\
# Findings of a study about its actuator, in SI units. Use it with haselab design, compare, firmware
# and run. Your own comments and keys are kept.

[actuator]

[actuator.geometry]

[sensing]

[drive]

[model]

[controller]
"""


def results_of(
    found: Findings,
    study: Study,
    header: Mapping[str, Any],
    noise_free: Mapping[str, float] | None,
    doubt: str = "",
) -> JsonObject:
    """Content of results.json: one row per id, provenance, and whether it could be verified."""
    trials = found.find(Comparison)
    kind = header["rig"].get("actuator_kind", PLANAR_HASEL)
    results: JsonObject = {
        "quantities": quantity_rows(
            found.quantities,
            found.notes,
            header["rig_config"],
            noise_free,
            study,
            found.direct,
            kind,
        ),
        "not_played": not_played(found.quantities, found.figures, study, found.missing, kind),
        "simulated": is_simulated(header["rig_config"]),
        "verdict_rule": VERDICT_RULE,
        "sensing_error": None if trials is None else trials.sensing_error,
        "provenance": {
            key: header[key]
            for key in ("recorded", "versions", "seed", "study_sha256", "study", "rig_config")
            if key in header
        }
        | {"rig_config": used_configuration(header["rig_config"])},
    }
    return marked_unverified(results, doubt)


def marked_unverified(results: JsonObject, doubt: str) -> JsonObject:
    """Mark results whose session could not be verified, and add the reason.

    Args:
        results: content of results.json.
        doubt: why the session could not be verified; empty if it was.
    """
    if not doubt:
        return results
    provenance = {"unverified": doubt, **table_at(results, "provenance")}
    return results | {"unverified": True, "provenance": provenance}


def write_findings(
    folder: Path,
    found: Findings,
    study: Study,
    header: Mapping[str, Any],
    noise_free: Mapping[str, float] | None = None,
    doubt: str = "",
) -> JsonObject:
    """Write results.json, analysis.json and actuator.toml.

    Args:
        folder: of the run.
        found: all findings.
        study: saturation and names.
        header: of the session, for the provenance.
        noise_free: results of the same experiments on the twin without noise, by id.
        doubt: why the session could not be verified; empty if it was.
    Returns:
        The content of results.json.
    Raises:
        InputError: `firmware` or `figures` is a link; nothing was written.
        DeviceError: a file cannot be written.
    """  # fmt: skip
    refuse_linked_folders(folder, "firmware", "figures")
    results = results_of(found, study, header, noise_free, doubt)
    write_json(folder / "results.json", results)
    write_json(folder / "analysis.json", _sections(found, study, header))
    limits = header["rig"]["drive_limits"]
    ends = (float(limits["low"]), float(limits["high"]))
    write_actuator(folder, found, study, ends, header["rig"].get("actuator_kind", PLANAR_HASEL))
    return results


def write_actuator(
    folder: Path,
    found: Findings,
    study: Study,
    drive_limits: tuple[float, float],
    kind: str = PLANAR_HASEL,
) -> None:
    """Write what a study found of its actuator to actuator.toml.

    Args:
        folder: of the run.
        found: all findings.
        study: saturation and names.
        drive_limits: of the rig, in V.
        kind: of the actuator.
    Raises:
        DeviceError: a file cannot be written.
    """
    maps, dynamics, loops = found.find(Maps), found.find(Dynamics), found.find(Loops)
    write_design(folder, maps, dynamics, loops, study, drive_limits, kind)


def _sections(found: Findings, study: Study, header: Mapping[str, Any]) -> dict[str, Any]:
    """Content of analysis.json: data of the figures; for the reference study also the paper."""
    charts = [chart.to_dict() for chart in found.charts]
    sections: dict[str, Any] = {**found.figures, **({"charts": charts} if charts else {})}
    sections["experiments"] = [
        {"title": one.title, "ids": list(rows_of_experiment(one))} for one in experiments_of(study)
    ]
    if not study.is_reference:
        return {**sections, **_without_paper(found, study)}
    rows = [
        {"id": r.id, "claim": r.claim, "paper": r.paper, "recomputed": r.recomputed,
         "verdict": r.verdict}
        for r in recompute_paper()
    ]  # fmt: skip
    reconciling = [
        {"reading": r.reading, "fast_gain": r.plant.gain, "slow_gain": r.plant.slow_modes[0].gain,
         "slow_time_constant_s": r.plant.slow_modes[0].time_constant_s,
         "rise_open_s": r.rise_open_s, "error_open": r.error_open,
         "rise_closed_s": r.rise_closed_s, "limit_cycle_delay_s": r.limit_cycle_delay_s}
        for r in recompute_steps()
    ]  # fmt: skip
    return {
        **sections,
        "reading": axis_interpretation(found.quantities, header["rig_config"]),
        "d_rows": rows,
        "reconciling": reconciling,
        "rows": [asdict(row) for row in study_rows()],
        "rows_changed": changes_text(header),
        "citation": CITATION,
    }


def _without_paper(found: Findings, study: Study) -> dict[str, Any]:
    """Sections that differ in a study that is not compared with the paper."""
    figures = [
        name
        for one in experiments_of(study)
        if any(key in found.quantities for key in one.rows())
        for name in one.report_figures
    ]
    changed: dict[str, Any] = {"only": [name for name in figures if name != "chain"]}
    for name, key in (("voltage_map", "paper_voltage_v"), ("capacitance_map", _RELATIVE)):
        if drawn := found.figures.get(name):
            changed[name] = {**drawn, key: None}
    return changed


def write_design(
    folder: Path,
    maps: Maps | None,
    dynamics: Dynamics | None,
    loops: Loops | None,
    study: Study,
    drive_limits: tuple[float, float] | None = None,
    kind: str = PLANAR_HASEL,
) -> None:
    """Write actuator.toml: maps, model and controllers, from which firmware is built.

    Args:
        folder: of the run.
        maps: of the triangle test; None: the study has none.
        dynamics: the plant; None: the study has none.
        loops: the controllers; None: the study has none.
        study: its name, sensing and controllers.
        drive_limits: of the rig, in V; None: not written.
        kind: of the actuator.
    Raises:
        DeviceError: a file cannot be written.
    """
    path = folder / ACTUATOR
    sections: dict[str, Mapping[str, object]] = {
        "sensing": {"carrier_hz": study.sensing.carrier_hz}
    }
    if maps is not None:
        sections |= {
            "actuator.geometry": {"zero_length_m": maps.length_m},
            "sensing.strain_map": strain_map_section(_strain_map(maps, dynamics)),
            "drive.voltage_map": voltage_map_section(maps.voltage_map),
        }
    if dynamics is not None:
        sections["model"] = _model(dynamics, loops, maps)
    if loops is not None:
        sections["controller"] = _controllers(loops, study)
    elif maps is not None and drive_limits is not None and not path.exists():
        sections["controller"] = _own_alone(study, maps.voltage_map, drive_limits)
    if drive_limits is not None:
        sections["drive"] = {"low_v": drive_limits[0], "high_v": drive_limits[1]}
    if not path.exists():
        sections = {"actuator": {"name": study.name, "kind": kind}, **sections}
    write_sections(path, sections, _START)


def _strain_map(maps: Maps, dynamics: Dynamics | None) -> StrainMap:
    """The map from capacitance to strain, with the feedthrough that the chirp determines."""
    found = None if dynamics is None else dynamics.significant_feedthrough
    if found is None:
        return maps.strain_map
    return replace(maps.strain_map, feedthrough=found.value, feedthrough_std=found.std)


def sections_found(found: Findings) -> list[str]:
    """Names of the sections of actuator.toml for a study's findings."""
    return [name for kind, names in _FOUND.items() if found.find(kind) for name in names]


def _model(dynamics: Dynamics, loops: Loops | None, maps: Maps | None) -> Mapping[str, object]:
    setting = None if loops is None else loops.setting
    to_volt = None if maps is None else maps.voltage_map
    return {
        **dict.fromkeys(_OF_AN_OLDER_MODEL),
        "input": "strain",
        "output": "strain",
        **dynamics.plant.to_dict(),
        "rate_hz": None if setting is None else setting.rate_hz,
        "loop_delay_s": None if setting is None else setting.measurement_delay_s,
        "residual_std": dynamics.residual_std,
        "through_voltage_map": None
        if to_volt is None
        else (to_volt.a1_v, to_volt.b1, to_volt.a2_v, to_volt.b2),
        "covariance": dynamics.posterior.to_dict(),
    }


def _own_alone(
    study: Study, to_volt: VoltageMap, drive_limits: tuple[float, float]
) -> Mapping[str, object]:
    """The study's own controller as an alternative, where the study designs no other one."""
    control = study.control if study.has("control") else Control()
    if control.kind is None:
        return {}
    wanted = (control.saturation_low, control.saturation_high)
    low, high = to_volt.reach(wanted, *drive_limits) or wanted
    limits = {"low": low, "high": high}
    own = {"kind": control.kind, "parameters": control.parameters, "limits": limits}
    return {"alternatives": [own]}


def _controllers(loops: Loops, study: Study) -> Mapping[str, object]:
    """The designed PID, and as alternatives the paper's PI and the study's own controller.

    The designed one has margins, so an own controller never replaces it: one of the same kind gets
    the name "own".
    """
    control = study.control
    demands = {key: value for key, value in asdict(pid_demands(study)).items() if value is not None}
    tables: list[dict[str, object]] = []
    for kind, gains, key in (("pid", loops.pid, "S25"), ("pi", loops.pi, "S21")):
        phase, gain = (loops.quantities[f"{key}.{name}_margin"] for name in ("phase", "gain"))
        tables.append(
            {
                "kind": kind,
                "parameters": asdict(gains),
                "limits": {
                    "low": loops.setting.saturation.low,
                    "high": loops.setting.saturation.high,
                },
                "loop": {
                    "rate_hz": loops.setting.rate_hz,
                    "measurement_delay_s": loops.setting.measurement_delay_s,
                },
                "margins": {
                    "phase_margin_deg": phase.value,
                    "phase_margin_deg_std": phase.std,
                    "gain_margin_db": gain.value,
                    "gain_margin_db_std": gain.std,
                },
            }
        )
    if control.kind is not None:
        own: dict[str, object] = {"kind": control.kind, "parameters": control.parameters}
        if control.kind in (table["kind"] for table in tables):
            own["name"] = "own"
        tables.append(own | {key: tables[0][key] for key in ("limits", "loop")})
    designed = {**tables[0], "demands": demands, "alternatives": tables[1:]}
    return {**dict.fromkeys(_OF_AN_OLDER_DESIGN), **designed}
