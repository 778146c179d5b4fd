"""Differences of a run from the reference study: missing results and changed settings."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from haselab.base import JsonObject
from haselab.rig.protocols import PLANAR_HASEL
from haselab.study.definition import Study, builtin_study
from haselab.study.results import rows_of
from haselab.study.simulated.truth import identified_as, with_default_twin

__all__ = ["changes_text", "not_played"]

_MOST_SHOWN = 12  # changed settings in one sentence
# Settings of the study, and the rows of the table that they affect.
_ROWS = {
    "sensing": "S3, S6 to S9",
    "operating_point": "S18",
    "triangle": "S13 to S15",
    "static_load": "S16, S17",
    "free_response": "S19",
    "chirp": "S20",
    "steps": "S10, S21 to S25",
    "control": "S21, S22",
}
# Results of step trials that a study may leave out, and the setting for their number.
_COUNTED = {
    "paper_chain_trials": ("S10.rise_printed_chain", "S10.error_printed_chain"),
    "extra_delay_trials": ("S24.rise_delayed", "S24.error_delayed"),
    "saturating_trials": ("S22.saturated_fraction", "S22.recovery_time"),
    "pi_trials": ("S24.rise_closed", "S24.rise_closed_raw", "S24.error_closed",
                  "S24.overshoot_closed"),
    "pid_trials": ("S25.rise_pid", "S25.overshoot_pid", "S25.error_pid"),
}  # fmt: skip
_EXTRA = ("paper_chain_trials", "extra_delay_trials", "saturating_trials")  # 0 by default
_ON_CHIP = {"chip": "S26", "miniature": "S28"}  # sections of analysis.json, see `chip_rows`


def not_played(
    measured: Collection[str],
    figures: Mapping[str, Any],
    study: Study,
    missing: Mapping[str, str] | None = None,
    kind: str = PLANAR_HASEL,
) -> list[JsonObject]:
    """List results of a study's experiments that a run does not have, with the reasons.

    Args:
        measured: ids of the results that the run has.
        figures: sections of analysis.json, which state why a chip's experiment is missing.
        study: the study that was played.
        missing: why a fit did not give a result, by id.
        kind: of the actuator.
    Returns:
        Section `not_played` of results.json: `ids` and `reason`, grouped by reason. Trials in
        addition to the usual ones, such as those with the paper's sensing, are no part of another
        study that does not request them.
    """
    found: dict[str, list[str]] = {}
    known = missing or {}
    for key in rows_of(study, kind):
        if key not in measured and (study.is_reference or not _is_extra(key, study)):
            reason = _left_out(key, study) or known.get(key) or _reason(key, figures, study)
            found.setdefault(reason, []).append(key)
    return [{"ids": ids, "reason": reason} for reason, ids in found.items()]


def _is_extra(key: str, study: Study) -> bool:
    """Whether a result is that of additional trials that a study does not request."""
    return any(
        key in _COUNTED[setting] and study.has("steps") and not getattr(study.steps, setting)
        for setting in _EXTRA
    )


def _left_out(key: str, study: Study) -> str:
    """Which number of trials is 0, a cause before any that a fit states; empty if none is."""
    for setting, keys in _COUNTED.items():
        if key in keys and study.has("steps") and not getattr(study.steps, setting):
            return f"steps.{setting} is 0 in this study."
    return ""


def _reason(key: str, figures: Mapping[str, Any], study: Study) -> str:
    row = key.partition(".")[0]
    for name, on_chip in _ON_CHIP.items():
        if row == on_chip:
            section = figures.get(name)
            reason = section.get("left_out") if isinstance(section, Mapping) else ""
            return str(reason or "not played")
    if row == "S16" and (left_out := figures.get("static", {}).get("left_out")):
        return str(left_out)
    if key.startswith("S19.eq6_decay_"):
        return "too few peaks exceed creep and noise (S19.eq6_omega_0)."
    return "no result from the recorded data."


def changes_text(header: Mapping[str, Any]) -> str:
    """Describe in one sentence how a run differs from the study in the table of rows.

    Args:
        header: of the session.
    Returns:
        Plain text; empty for the reference study on a default twin.
    """
    study = header["study"]
    full, quick = (builtin_study(quick=value).model_dump(mode="json") for value in (False, True))
    parts = []
    if changed := list(_changed(full, study)):
        rows = [rows for name, rows in _ROWS.items() if any(c.startswith(name) for c in changed)]
        what = "the quick form of the study" if study == quick else "another study"
        parts.append(f"{what}, which changes rows {', '.join(rows) or '(none)'}: {_shown(changed)}")
    twins = with_default_twin(header["rig_config"])
    if twins is None:
        parts.append("another rig than the twin, which rows S1 and S4 describe")
    elif changed := list(_changed(*twins)):
        which = identified_as(header["rig_config"]) or "another twin"
        parts.append(f"{which} instead of the default twin of row S1: {_shown(changed)}")
    return f"This run used {', and '.join(parts)}." if parts else ""


def _changed(default: Any, own: Any, name: str = "") -> Iterator[str]:
    """Yield each setting that differs, with both values."""
    if isinstance(default, Mapping) and isinstance(own, Mapping):
        for key in dict.fromkeys([*default, *own]):
            if key not in ("name", "origin"):
                yield from _changed(default.get(key), own.get(key), f"{name}.{key}".strip("."))
    elif default != own:
        yield f"{name} {_text(own)} instead of {_text(default)}"


def _text(value: Any) -> str:
    if value is None:
        return "found from the data"
    if isinstance(value, (list, tuple)):
        return f"{len(value)} values" if len(value) > 3 else str(list(value))
    return f"{value:g}" if isinstance(value, (int, float)) else str(value)


def _shown(changed: list[str]) -> str:
    more = len(changed) - _MOST_SHOWN
    return ", ".join(changed[:_MOST_SHOWN]) + (f" and {more} more" if more > 0 else "")
