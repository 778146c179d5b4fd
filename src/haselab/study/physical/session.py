"""The session of rows S25 (observer), S27 and S30, which a run plays with its identified model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from haselab.actuators import GRAVITY_M_S2
from haselab.base import HaselabError, ResultError
from haselab.controllers import KnownActuator
from haselab.study.definition import Study, builtin_table
from haselab.study.experiments.model_control import ModelControlTest
from haselab.study.fits.maps import Maps
from haselab.study.fits.static import Static
from haselab.study.pipeline import Findings
from haselab.study.run import analyse_session
from haselab.study.tables import ModelControl

__all__ = ["FOLDER", "NOT_HERE", "analysed", "model_study", "with_model_rows"]

FOLDER = "model-control"  # of the session, in that of the run
NOT_HERE = (
    f"only 'haselab reproduce' plays it, and this session has no folder {FOLDER}/ with its "
    "recording."
)
_OTHER_MASS = 0.8  # of the rig's own: it can be held at all strains of the step
_BEYOND = 0.02  # strain beyond the linear region, at 0 V with the outer mass
_DIGITS = 4  # of the numbers in the file of the study


def model_study(study: Study, found: Findings, known: KnownActuator) -> Study:
    """The study that is played with the identified model, after the reference study.

    Args:
        study: that was played.
        found: its findings, for the linear region of the load-stretch curve.
        known: the identified actuator, with the rig's own mass.
    Returns:
        The study, with all numbers that it needs.
    Raises:
        ResultError: the linear region or the zero strain was not found.
    """
    maps, static = found.find(Maps), found.find(Static)
    if maps is None or static is None:
        raise ResultError("needs [triangle] and [static_load], which are not in this study.")
    end = static.quantities["S17.region_high"].value
    high = end * static.free_length_m / maps.length_m - 1.0
    outer_kg = known.elastic_n(known.length_m(high + _BEYOND)) / GRAVITY_M_S2
    table = builtin_table("model-control", ModelControl).model_copy(
        update={
            "step": study.steps.step,
            "other_mass_kg": round(_OTHER_MASS * known.mass_kg, _DIGITS),
            "outer_mass_kg": round(outer_kg, _DIGITS),
            "linear_high": round(high, _DIGITS),
        }
    )
    return Study(
        name=f"{study.name}, with the physical model",
        sensing=study.sensing,
        model_control=table.model_dump(),
    )


def analysed(folder: Path) -> Findings | str:
    """Repeat the fits of the session in a run's folder.

    Args:
        folder: of the run.
    Returns:
        The findings, or why there are none.
    """
    if not (folder / FOLDER / "session.h5").is_file():
        return NOT_HERE
    try:
        return analyse_session(folder / FOLDER)[0]
    except HaselabError as error:
        return f"no result from its recording. {error}"


def with_model_rows(found: Findings, played: Findings | str) -> Findings:
    """Add the results of the session to those of the reference study.

    Args:
        found: of the study.
        played: findings of the session, or why there are none.
    Returns:
        All findings.
    """
    if isinstance(played, str):
        absent = dict.fromkeys(ModelControlTest.all_rows(), played)
        return replace(found, missing={**found.missing, **absent})
    return replace(
        found,
        quantities={**found.quantities, **played.quantities},
        notes={**found.notes, **played.notes},
        charts=(*found.charts, *played.charts),
        missing={**found.missing, **played.missing},
        failed=(*found.failed, *played.failed),
    )
