"""Rows of results.json, their agreement with the paper, and the frequency axis that fits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from haselab.base import Estimate, Json, JsonObject
from haselab.rig.protocols import PLANAR_HASEL
from haselab.study.analysis import experiments_of
from haselab.study.definition import Study
from haselab.study.experiments.foreign import rows_of_experiment
from haselab.study.paper.quantity_table import paper_rows, quantities
from haselab.study.quantity import Quantity
from haselab.study.simulated.truth import (
    follows_from_twin,
    is_simulated,
    parameters,
    set_in_twin,
    twin_of,
)

__all__ = [
    "VERDICT_RULE",
    "Quantity",
    "axis_interpretation",
    "quantities",
    "quantity_rows",
    "rows_of",
    "verdict",
]

VERDICT_RULE = (
    "Agrees: the whole 95 % interval is within 10 % of the printed number (within 0.1 if that "
    "number is 0), or within the printed range. Disagrees: the whole interval is outside. "
    "Inconclusive: the interval is partly inside."
)
# The only reason for which `step_metrics` gives no rise time.
_NO_RISE = (
    "no value: averaging out the ringing also removed the rise, because the first swing is most of "
    "the rise (see the overshoot, and the figure of the steps)"
)
_PRINTED_ZETA = 0.09  # eq. 10
# Played by `reproduce` beside the experiments.
_APART = (
    "S25.rise_observer",
    "S25.overshoot_observer",
    "S25.error_observer",
    "S26.",
    "S27.",
    "S28.",
    "S30.",
)


def verdict(quantity: Quantity, measured: Estimate) -> str:
    """Compare a result with the paper's number, by `VERDICT_RULE`.

    Args:
        quantity: with the paper's value.
        measured: with its 95 % interval; without one it counts as a point.
    Returns:
        "agrees", "disagrees", "inconclusive" or "not in paper".
    Example:
        >>> row = Quantity("damping ratio", "", 0.09)
        >>> [verdict(row, Estimate.normal(0.09, std, "")) for std in (0.001, 0.1)]
        ['agrees', 'inconclusive']
    """
    if quantity.agreed is None:
        return "not in paper"
    if not math.isfinite(measured.value):
        return "inconclusive"
    low, high = measured.ci95
    if not (math.isfinite(low) and math.isfinite(high)):
        low = high = measured.value
    least, most = quantity.agreed
    if least <= low and high <= most:
        return "agrees"
    return "disagrees" if high < least or low > most else "inconclusive"


def quantity_rows(
    measured: Mapping[str, Estimate],
    notes: Mapping[str, str],
    rig_config: Mapping[str, Any],
    noise_free: Mapping[str, float] | None = None,
    study: Study | None = None,
    direct: Mapping[str, Estimate] | None = None,
    kind: str = PLANAR_HASEL,
) -> list[JsonObject]:
    """Rows of results.json.

    Args:
        measured: estimates by id.
        notes: by id, placed before those of the table.
        rig_config: of the session's header, for what was set in a twin.
        noise_free: results of the same experiments without noise, by id; None: not on a twin.
        study: that was played, whose experiments name the rows; None: the reference study.
        direct: results of the experiments' own fits, by id, where `measured` has those of the
            identified physical model.
        kind: of the actuator, see `rows_of`.
    Returns:
        One row per id, in the table's order.
    """
    twin = twin_of(rig_config)
    fixed = {} if study is None else _fixed_by(study)
    compared = study is None or study.is_reference
    true = {} if twin is None else parameters(twin)
    rows = []
    for key, named in (quantities() if study is None else rows_of(study, kind)).items():
        if key not in measured:
            continue
        quantity = named if compared else named.without_paper()
        estimate = measured[key]
        parts = [notes[key]] if key in notes else []
        if quantity.name.startswith("rise time") and math.isnan(estimate.value):
            parts.insert(0, _NO_RISE)
        parts += [note for note in (quantity.note, quantity.paper_note) if note]
        row: dict[str, Any] = {
            "id": key,
            "name": quantity.name,
            "unit": quantity.unit,
            "paper": quantity.paper,
            "recomputed": quantity.recomputed,
            "measured": Estimate(estimate.value, estimate.std, estimate.ci95, quantity.unit),
            "verdict": verdict(quantity, estimate),
            "note": "; ".join(parts),
        }
        if direct and key in direct:
            row["direct"] = replace(direct[key], unit=quantity.unit)
        if noise_free is not None and key in noise_free:
            row["noise_free"] = noise_free[key]
        if key in true:
            row["truth"] = true[key]
        if not compared:
            pass
        elif why := fixed.get(key, quantity.setting):
            row["set_in_study"] = why
        elif twin is not None and not fixed and (why := set_in_twin(twin, key)):
            row["set_in_twin"] = why
        elif twin is not None and (why := follows_from_twin(key)):
            row["follows_from_twin"] = why
        if quantity.same_as:
            row["same_as"] = quantity.same_as
        rows.append(row)
    return rows


def rows_of(study: Study, kind: str = PLANAR_HASEL) -> dict[str, Quantity]:
    """All results that a study may have, by id, in the order of the report.

    Args:
        study: the reference study also has the rows that `reproduce` plays beside it.
        kind: of the actuator; results in units of the paper are those of a planar HASEL alone.
    """
    found: dict[str, Quantity] = {}
    for experiment in experiments_of(study):
        found |= rows_of_experiment(experiment)
    if study.is_reference:
        found = paper_rows(*_APART) | found
        return {key: found[key] for key in (*quantities(), *found) if key in found}
    planar = kind == PLANAR_HASEL
    return {
        key: row
        for key, row in found.items()
        if not row.reference_only and (planar or not row.planar_only)
    }


def _fixed_by(study: Study) -> dict[str, str]:
    """Results that the settings of a study fix, but the built-in study finds from data, by id.

    The default twin's parameters were chosen for the operating point found from the data. With
    another, fixed one nothing was set in the twin, but results still follow from its parameters.
    """
    fixed = {}
    if study.operating_point.baseline_v is not None:
        fixed["S18.baseline"] = "operating_point.baseline_v"
        fixed["S18.centre_offset"] = "at operating_point.baseline_v"
    if study.has("static_load") and study.static_load.segments is not None:
        fixed["S17.region_low"] = "number of segments: static_load.segments"
        fixed["S17.region_high"] = fixed["S17.region_low"]
        fixed.setdefault("S18.baseline", "centre of a region by static_load.segments")
        fixed.setdefault("S18.centre_offset", fixed["S18.baseline"])
    return fixed


def axis_interpretation(
    measured: Mapping[str, Estimate], rig_config: Mapping[str, Any]
) -> JsonObject:
    """Decide which interpretation of the paper's frequency axis, rad/s or Hz, the data support.

    The criterion is the relative distance of a measured frequency from the printed number in either
    unit, with the interval of the printed digits; a frequency near neither supports neither. A twin
    was set to one interpretation, so its data are no evidence.

    Args:
        measured: estimates by id.
        rig_config: of the session's header.
    Returns:
        Section `reading` of analysis.json; empty without both frequencies.
    """
    if not {"S20.omega_n", "S19.omega_0", "S19.decay_1", "S19.decay_2"} <= set(measured):
        return {}
    votes = []
    evidence: list[Json] = []
    for key, what, printed in (
        ("S20.omega_n", "natural frequency, chirp", 5.11),
        ("S19.omega_0", "natural frequency, free response", 5.1),
    ):
        value = measured[key].value
        evidence.append(
            {
                "what": f"{what} (rad/s)",
                "rad": printed,
                "hz": 2.0 * math.pi * printed,
                "data": measured[key],
            }
        )
        off = {
            "rad": abs(math.log(value / printed)),
            "hz": abs(math.log(value / (2.0 * math.pi * printed))),
        }
        best = min(off, key=lambda name: off[name])
        votes.append(best if off[best] < 0.2 else "neither")
    decays = (measured["S19.decay_1"].value, measured["S19.decay_2"].value)
    evidence.append(
        {
            "what": "decay of the free response (1/s), printed 3.6 and 4.2; expected with each "
            "interpretation: the printed damping ratio 0.09 times 5.11",
            "rad": _PRINTED_ZETA * 5.11,
            "hz": _PRINTED_ZETA * 2.0 * math.pi * 5.11,
            "data": f"{decays[0]:.2f} and {decays[1]:.2f}",
        }
    )
    agreed = votes[0] if len(set(votes)) == 1 else "cannot tell"
    words = {
        "rad": "The data support rad/s, as printed.",
        "hz": "The data support Hz: the printed number times 2 pi.",
        "neither": "The data support neither interpretation: the frequency is near neither number.",
        "cannot tell": "Inconclusive: chirp and free response support different interpretations.",
    }
    said = words[agreed]
    if is_simulated(rig_config):
        said = (
            "No conclusion: this bench is simulated and was set to one interpretation, so its data "
            "cannot show which one the paper means. As a test of the method: "
            f"{said[0].lower()}{said[1:]}"
        )
    return {"verdict": said, "evidence": evidence}
