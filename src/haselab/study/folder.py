"""The folder of a run: results, analysis for the report, model, controller, firmware header."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from haselab.control import PidGains
from haselab.store.claim import refuse_linked_folders
from haselab.store.folder import write_json, write_text
from haselab.study.analysis import experiments_of
from haselab.study.definition import Study
from haselab.study.fits.dynamics import Dynamics
from haselab.study.fits.loops import Loops
from haselab.study.fits.maps import Maps
from haselab.study.fits.trials import Comparison
from haselab.study.paper.paper_check import recompute_paper, recompute_steps
from haselab.study.paper.row_table import CITATION, study_rows
from haselab.study.paper.scope import changes_text, not_played
from haselab.study.pipeline import Findings
from haselab.study.results import VERDICT_RULE, quantity_rows, reading_verdict
from haselab.study.simulated.truth import is_simulated

__all__ = ["marked_unverified", "results_of", "write_design", "write_findings"]


def results_of(
    found: Findings,
    study: Study,
    header: Mapping[str, Any],
    noise_free: Mapping[str, float] | None,
    doubt: str = "",
) -> dict[str, Any]:
    """results.json: one row an id, where it all comes from, and whether that could be verified."""
    trials = found.find(Comparison)
    results = {
        "quantities": quantity_rows(
            found.quantities, found.notes, header["rig_config"], noise_free, study
        ),
        "not_played": not_played(found.quantities, found.figures, study, found.missing),
        "simulated": is_simulated(header["rig_config"]),
        "verdict_rule": VERDICT_RULE,
        "sensing_error": None if trials is None else trials.sensing_error,
        "provenance": {
            key: header[key] for key in ("versions", "seed", "study_sha256", "study", "rig_config")
        },
    }
    return marked_unverified(results, doubt)


def marked_unverified(results: dict[str, Any], doubt: str) -> dict[str, Any]:
    """The same results; where their session could not be verified, with a mark and the reason.

    Args:
        results: content of results.json.
        doubt: why the session is not verified; empty where it is.
    """
    if not doubt:
        return results
    provenance = {"unverified": doubt} | results["provenance"]
    return results | {"unverified": True, "provenance": provenance}


def write_findings(
    folder: Path,
    found: Findings,
    study: Study,
    header: Mapping[str, Any],
    noise_free: Mapping[str, float] | None = None,
    doubt: str = "",
) -> dict[str, Any]:
    """Write results.json, analysis.json, model.json, controller.toml and firmware/controller.h.

    Args:
        folder: of the run.
        found: all findings.
        study: saturation and names.
        header: of the session, for the provenance.
        noise_free: of the same experiment on the twin without noise, by id.
        doubt: why the session could not be verified; empty where it could.
    Returns:
        What results.json holds.
    Raises:
        InputError: `firmware` or `figures` is a link; nothing was written.
        DeviceError: the disk refuses.
    """  # fmt: skip
    refuse_linked_folders(folder, "firmware", "figures")
    results = results_of(found, study, header, noise_free, doubt)
    write_json(folder / "results.json", results)
    write_json(folder / "analysis.json", _sections(found, study, header))
    maps, dynamics, loops = found.find(Maps), found.find(Dynamics), found.find(Loops)
    if maps and dynamics and loops:
        write_design(folder, maps, dynamics, loops, study)
        write_text(folder / "firmware" / "controller.h", _header_file(maps, loops, study))
    return results


def _sections(found: Findings, study: Study, header: Mapping[str, Any]) -> dict[str, Any]:
    """analysis.json: data of the figures, and for the reference study what concerns the paper."""
    charts = [chart.to_dict() for chart in found.charts]
    sections: dict[str, Any] = {**found.figures, **({"charts": charts} if charts else {})}
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
        "reading": reading_verdict(found.quantities, header["rig_config"]),
        "d_rows": rows,
        "reconciling": reconciling,
        "rows": [asdict(row) for row in study_rows()],
        "rows_changed": changes_text(header),
        "citation": CITATION,
    }


def _without_paper(found: Findings, study: Study) -> dict[str, Any]:
    """Sections that differ in a study that is not compared with the paper."""
    figures = [name for one in experiments_of(study) for name in one.report_figures]
    changed: dict[str, Any] = {"only": [name for name in figures if name != "chain"]}
    if drawn := found.figures.get("voltage_map"):
        changed["voltage_map"] = {**drawn, "paper_voltage_v": None}
    return changed


def write_design(folder: Path, maps: Maps, dynamics: Dynamics, loops: Loops, study: Study) -> None:
    """Write model.json and controller.toml, which is all that a chip's firmware is built from.

    Args:
        folder: of the run.
        maps: of the triangle test.
        dynamics: the plant.
        loops: the controllers.
        study: its name.
    Raises:
        DeviceError: the disk refuses.
    """
    write_json(folder / "model.json", _model(maps, dynamics, loops))
    write_text(folder / "controller.toml", _controller(loops, study))


def _model(maps: Maps, dynamics: Dynamics, loops: Loops) -> dict[str, Any]:
    v, s = maps.voltage_map, maps.strain_map
    return {
        "plant": {
            **dynamics.plant.to_dict(),
            "covariance": dynamics.posterior.to_dict(),
        },
        "loop_delay_s": loops.setting.measurement_delay_s,
        "rate_hz": loops.setting.rate_hz,
        "voltage_map": {"a1_v": v.a1_v, "b1": v.b1, "a2_v": v.a2_v, "b2": v.b2},
        "strain_map": {
            "slope_per_f": s.slope_per_f,
            "offset": s.offset,
            "curvature_per_f2": s.curvature_per_f2,
        },
        "zero_strain_length_m": maps.length_m,
    }


def _controller(loops: Loops, study: Study) -> str:
    parts = [f"# Controllers of {study.name}, on the plant in model.json"]
    for title, gains, key in (("pi", loops.pi, "S21"), ("pid", loops.pid, "S25")):
        margin = loops.quantities
        parts += [
            f"\n[{title}]",
            f"kp = {gains.kp!r}",
            f"ki = {gains.ki!r}  # 1/s",
            f"kd = {gains.kd!r}  # s",
            f"derivative_filter_s = {gains.derivative_filter_s!r}",
            f"phase_margin_deg = {margin[f'{key}.phase_margin'].value:.6g}",
            f"gain_margin_db = {margin[f'{key}.gain_margin'].value:.6g}",
        ]
    parts += [
        "\n[saturation]",
        f"low = {loops.setting.saturation.low!r}",
        f"high = {loops.setting.saturation.high!r}",
        "\n[loop]",
        f"rate_hz = {loops.setting.rate_hz!r}",
        f"measurement_delay_s = {loops.setting.measurement_delay_s!r}",
    ]
    return "\n".join(parts) + "\n"


def _single(value: float) -> str:
    """A C float literal that reads back as the nearest float."""
    return f"{np.format_float_scientific(np.float32(value), unique=True)}f"


def _header_file(maps: Maps, loops: Loops, study: Study) -> str:
    v, s = maps.voltage_map, maps.strain_map
    period_s = 1.0 / loops.setting.rate_hz
    saturation = loops.setting.saturation

    def pid(name: str, g: PidGains) -> str:
        share = period_s / (period_s + g.derivative_filter_s)
        numbers = (g.kp, g.ki, g.kd, period_s, share, saturation.low, saturation.high)  # fmt: skip
        return f"static const hs_pid_config {name} = {{{', '.join(map(_single, numbers))}}};"

    voltage = ", ".join(map(_single, (v.a1_v, v.b1, v.a2_v, v.b2)))
    strain = ", ".join(map(_single, (s.slope_per_f, s.offset, s.curvature_per_f2)))
    return "\n".join(
        [
            f"/* Generated from model.json and controller.toml of {study.name}. */",
            "#ifndef CONTROLLER_H",
            "#define CONTROLLER_H",
            '#include "hs.h"',
            pid("controller_pi", loops.pi),
            pid("controller_pid", loops.pid),
            f"static const hs_voltage_map controller_voltage_map = {{{voltage}}};",
            f"static const hs_strain_map controller_strain_map = {{{strain}}};",
            "#endif",
            "",
        ]
    )
