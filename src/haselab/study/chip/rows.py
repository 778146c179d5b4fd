"""Rows S26 and S28 of a study, from the chip's recordings in its folder."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from haselab.base import Estimate, InputError, JsonObject, table_at
from haselab.control import LoopSetting, PidGains
from haselab.control.feedthrough import with_measured_feedthrough
from haselab.firmware import RATE_HZ
from haselab.rig.chip import SupplyModel
from haselab.store.folder import read_json
from haselab.store.session.writer import SessionReader
from haselab.study.chip.loops import CHIP_DELAY_S
from haselab.study.chip.miniature import relay_setting
from haselab.study.chip.trials import Chip, analyse_chip_session, recorded_row
from haselab.study.fits.dynamics import Dynamics
from haselab.study.fits.loops import margin_estimates
from haselab.study.fits.trials import ONE_TRIAL, Comparison
from haselab.study.pipeline import Findings

__all__ = ["CHIP", "EXPERIMENTS", "MINIATURE", "ChipRows", "chip_rows", "with_chip_rows"]

CHIP, MINIATURE = "chip", "miniature"  # folders of their recordings, sections of analysis.json
EXPERIMENTS = Path("firmware", "experiments.json")  # what is known besides the recordings
_NAMES = {CHIP: "chip, 1000 Hz", MINIATURE: "chip and serial supply, 100 Hz"}
_SHOWN_FROM_S = -1.0
_NOT_HERE = (
    "only 'haselab reproduce' plays it, and this session has no folder {folder}/ with its "
    "recording."
)


@dataclass(frozen=True)
class ChipRows:
    """Results of the chip's experiments.

    Args:
        quantities: estimates by id.
        notes: by id, remarks for the reader.
        figures: sections of analysis.json; for an experiment that was left out, the reason.
    """

    quantities: dict[str, Estimate]
    notes: dict[str, str]
    figures: JsonObject


def with_chip_rows(found: Findings, folder: Path | None) -> Findings:
    """Add the chip's experiments to the findings of a study, if its folder has any.

    Args:
        found: of the study.
        folder: of its run; None: the session is not in one.
    Returns:
        The findings; for a missing experiment, a section of analysis.json gives the reason.
    """
    if folder is None:
        missing = {name: {"left_out": _NOT_HERE.format(folder=name)} for name in (CHIP, MINIATURE)}
        return replace(found, figures={**found.figures, **missing})
    dynamics = found.find(Dynamics)
    if dynamics is None:  # without a plant there is no loop on a chip
        return found
    rows = chip_rows(folder, dynamics)
    return replace(
        found,
        quantities={**found.quantities, **rows.quantities},
        notes={**found.notes, **rows.notes},
        figures={**found.figures, **rows.figures},
    )


def chip_rows(folder: Path, dynamics: Dynamics) -> ChipRows:
    """Rows S26 and S28 from the recordings in a run's folder.

    Args:
        folder: of the run.
        dynamics: the plant, for the margins.
    """
    known = _known(folder)
    rows = ChipRows({}, {}, {})
    for name in (CHIP, MINIATURE):
        left_out = str(known.get("left_out", {}).get(name, "")) or _NOT_HERE.format(folder=name)
        if (folder / name / "session.h5").is_file() and not known.get("left_out", {}).get(name):
            try:
                _add(rows, name, folder / name, dynamics, known)
                continue
            except InputError as error:
                left_out = f"no result from its recording. {error}"
        rows.figures[name] = {"left_out": left_out}
    return rows


def _known(folder: Path) -> dict[str, Any]:
    path = folder / EXPERIMENTS
    found = read_json(path) if path.is_file() else {}
    return found if isinstance(found, dict) else {}


def _add(
    rows: ChipRows, name: str, folder: Path, dynamics: Dynamics, known: Mapping[str, Any]
) -> None:
    with SessionReader(folder / "session.h5") as session:
        found, header = analyse_chip_session(session)
    row, settings = recorded_row(header), Chip.from_dict(table_at(header, "chip")).settings
    gains = PidGains(settings.kp, settings.ki, settings.kd, settings.derivative_filter_s)
    loop = with_measured_feedthrough(_setting(header), dynamics.significant_feedthrough)
    margins = margin_estimates(gains, dynamics, loop, ("phase_margin",))
    rows.quantities.update(found.quantities)
    rows.quantities[f"{row}.phase_margin"] = margins["phase_margin"]
    trials = len(next(iter(found.groups.values())).strain)
    rows.notes[f"{row}.rise"] = _note(trials, known.get("notes", {}).get(name, ""))
    if math.isnan(found.quantities[f"{row}.settling"].value):
        rows.notes[f"{row}.settling"] = "no value: a trial does not stay within 2 % of the step"
    section = _section(name, found, loop, margins["phase_margin"].value)
    rows.figures[name] = _after_desktop(section, known.get("desktops", {}).get(name))


def _note(trials: int, known: str) -> str:
    counted = f"{trials} trials" if trials > 1 else ONE_TRIAL
    return f"{counted}; {known}" if known else counted


def _setting(header: Mapping[str, Any]) -> LoopSetting:
    """Rate and delay of the loop that was recorded."""
    supply = header["rig_config"].get("simulator", {}).get("supply")
    if supply is not None:
        return relay_setting(SupplyModel.model_validate(supply))
    return LoopSetting(rate_hz=float(RATE_HZ), measurement_delay_s=CHIP_DELAY_S)


def _section(
    name: str, found: Comparison, loop: LoopSetting, phase_margin_deg: float
) -> dict[str, Any]:
    steps = table_at(found.figures, "steps")
    groups, by_loop = table_at(steps, "groups"), table_at(steps, "metrics")
    drawn, metrics = table_at(groups, next(iter(groups))), table_at(by_loop, *by_loop)
    time_s, desired, mean = (
        np.asarray(values) for values in (steps["time_s"], steps["desired"], drawn["mean"])
    )
    shown = time_s > _SHOWN_FROM_S
    return {
        "desired": {"time_s": time_s[shown], "strain": desired[shown]},
        "loops": {_NAMES[name]: {"time_s": time_s[shown], "strain": mean[shown]}},
        "metrics": {
            _NAMES[name]: {
                **metrics,
                "delay_s": loop.measurement_delay_s,
                "phase_margin_deg": phase_margin_deg,
            }
        },
    }


def _after_desktop(section: dict[str, Any], desktops: Mapping[str, Any] | None) -> dict[str, Any]:
    """Put the chip's response after those of the desktop."""
    if desktops is None:
        return section
    return {
        "desired": section["desired"],
        "loops": {**desktops["loops"], **section["loops"]},
        "metrics": {**desktops["metrics"], **section["metrics"]},
    }
