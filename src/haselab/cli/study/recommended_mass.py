"""Check whether a study can be played with the mass recommended for its operating point (S18)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import describe
from haselab.safety.feasibility import Feasibility
from haselab.study.definition import Study
from haselab.study.feasibility import check_study, rating_of_twin
from haselab.study.pipeline import Findings
from haselab.study.simulated.truth import twin_of

__all__ = ["with_mass_limit"]

_GRID_KG = 0.01


def with_mass_limit(found: Findings, study: Study, rig_config: Mapping[str, Any]) -> Findings:
    """Add to the findings whether the recommended mass is within the limits of the bench.

    Args:
        found: of a study.
        study: that was played.
        rig_config: of the session's header.
    Returns:
        The same findings where no mass is recommended.
    """
    point = found.figures.get("static", {}).get("operating_point", {})
    mass_kg = point.get("recommended_mass_kg")
    if mass_kg is None:
        return found
    twin = twin_of(rig_config)
    remark = (
        "check current and field at that mass with 'haselab plan feasibility' first"
        if twin is None
        else _remark(twin, study, float(mass_kg))
    )
    note = f"{found.notes['S18.baseline']}; {remark}"
    return replace(found, notes={**found.notes, "S18.baseline": note})


def _remark(twin: TwinConfig, study: Study, mass_kg: float) -> str:
    judged = _judged(twin, study, mass_kg)
    if judged.ok:
        return "the study can be played with that mass"
    fault = next(check for check in reversed(judged.checks) if not check.ok).fault
    best = _largest(twin, study, mass_kg)
    limit = "" if best is None else f"; the largest mass that is accepted is {best:.2f} kg"
    return f"with that mass the study would be refused ({fault}){limit}"


def _largest(twin: TwinConfig, study: Study, refused_kg: float) -> float | None:
    """The largest mass, to 0.01 kg, from that of the twin to one that is refused."""
    low, high = round(twin.load.mass_kg / _GRID_KG), round(refused_kg / _GRID_KG)
    if low >= high or not _judged(twin, study, low * _GRID_KG).ok:
        return None
    while high - low > 1:
        middle = (low + high) // 2
        if _judged(twin, study, middle * _GRID_KG).ok:
            low = middle
        else:
            high = middle
    return low * _GRID_KG


def _judged(twin: TwinConfig, study: Study, mass_kg: float) -> Feasibility:
    load = twin.load.model_copy(update={"mass_kg": mass_kg})
    heavier = twin.model_copy(update={"load": load})
    return check_study(study, describe(heavier), rating_of_twin(heavier, study))
