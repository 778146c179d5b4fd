"""How the loops of a run behave: played steps, margins, and predicted steps beside the played."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from haselab.base import is_real, table_at
from haselab.report.analysis import LeftOutError, Section
from haselab.report.folder import RunFolder
from haselab.report.numbers import ABSENT, interval_text
from haselab.report.overview.facts import rounded
from haselab.report.results import Quantity, Results
from haselab.store.actuator_file import ACTUATOR, read_actuator

__all__ = ["LoopTable", "loop_table", "prediction_table"]

_PERCENT = 100.0
_SAME_GAIN = 0.01
_OF_FILE = " (controller of actuator.toml)"
_SETTLING, _UNSETTLED = "settling_time_s", "not settled"
_NOTE_UNSETTLED = (
    "Not settled: the strain does not stay within 2 % of the way around the final strain before "
    "the last tenth of the record begins, because of creep, ringing or noise, so there is no "
    "settling time."
)


@dataclass(frozen=True)
class LoopTable:
    """Numbers of the loops.

    Args:
        columns: headings of the cells.
        rows: name and cells of each loop; a missing cell is a dash.
        notes: sentences below the table.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]
    notes: tuple[str, ...] = ()


# Heading of the column, and factor of its values. The first three are of a trial.
_CELLS = (
    ("Rise time 10–90 % (s)", 1.0),
    ("Overshoot (% of the step)", _PERCENT),
    ("Final error (% of the step)", _PERCENT),
    ("Phase margin (°)", 1.0),
    ("Gain margin (dB)", 1.0),
)
_OF_TRIAL = 3
_WORST = (("Worst phase margin (°)", "worst_phase_margin_deg"),
          ("Worst gain margin (dB)", "worst_gain_margin_db"))  # fmt: skip
_OPEN = "Open loop"
# Ids in the order of the columns.
_LOOPS = {
    _OPEN: ("S24.rise_open", "", "S24.error_open", "", ""),
    "PI": ("S24.rise_closed", "S24.overshoot_closed", "S24.error_closed", "S21.phase_margin",
           "S21.gain_margin"),
    "PID": ("S25.rise_pid", "S25.overshoot_pid", "S25.error_pid", "S25.phase_margin",
            "S25.gain_margin"),
    "Controller {kind}": ("S25.rise_own", "S25.overshoot_own", "S25.error_own", "", ""),
    "Observer (physical model)": ("S25.rise_observer", "S25.overshoot_observer",
                                  "S25.error_observer", "", ""),
    "Hybrid (physical model)": ("S27.rise_own", "S27.overshoot_own", "S27.error_own", "", ""),
    "Hybrid, another mass": ("S27.rise_other", "S27.overshoot_other", "S27.error_other", "", ""),
    "Microcontroller (SIMULATED)": ("S26.rise", "S26.overshoot", "S26.error", "S26.phase_margin",
                                    ""),
    "Miniature bench (SIMULATED)": ("S28.rise", "S28.overshoot", "S28.error", "S28.phase_margin",
                                    ""),
}  # fmt: skip
# Heading and key of a metric of the steps, and its factor.
_COMPARED = (
    ("Rise time 10–90 % (s)", "rise_time_s", 1.0),
    ("Overshoot (% of the step)", "overshoot", _PERCENT),
    ("Settling time (s)", _SETTLING, 1.0),
    ("Final error (% of the step)", "error", _PERCENT),
)
_OF_MAP = "Final error by the strain map (% of the step)"
_PREDICTION_NOTES = (
    "Predicted: the step of the identified plant (S20) from rest, with the gains, rate, delay, "
    "limits and feedthrough of the loop. Played: mean of the trials, by the camera. Both by the "
    "definitions at figure 6, ringing in the overshoot. The prediction has no noise, no hysteresis "
    "and no errors of the maps; the voltage map has a part in the open loop.",
    "By the strain map: strain sensed by capacitance minus strain by the camera at the end of the "
    "step. A controller removes the error of the sensed strain only, so this part stays in the "
    "final error.",
)


def loop_table(run: RunFolder) -> LoopTable | None:
    """How the loops follow a step; None if no loop was played or designed.

    Args:
        run: the contents of the folder.
    """
    results, found = run.results, {}
    loop = _section(run, "loop")
    for name, keys in _LOOPS.items():
        cells = [
            _cell(results.get(key), factor, interval=at < _OF_TRIAL)
            for at, (key, (_, factor)) in enumerate(zip(keys, _CELLS, strict=True))
        ]
        if name == _OPEN:
            cells[1] = _played(run, "open loop", "overshoot", _PERCENT)
        if set(cells) == {ABSENT}:
            continue
        played = "" if set(cells[:_OF_TRIAL]) != {ABSENT} else ", not played"
        worst = [_number(loop, f"controllers.{name}.{key}") for _, key in _WORST]
        # each worst margin stands beside its nominal one
        ordered = (*cells[:4], worst[0], cells[4], worst[1])
        mark = _OF_FILE if name == _loop_of_file(run) else ""
        found[name.format(kind=_own_kind(results)) + played + mark] = ordered
    heads = [head for head, _ in _CELLS]
    columns = (*heads[:4], _WORST[0][0], heads[4], _WORST[1][0])
    used = [at for at in range(len(columns)) if any(row[at] != ABSENT for row in found.values())]
    if not used:
        return None
    return LoopTable(
        tuple(columns[at] for at in used),
        tuple((name, tuple(cells[at] for at in used)) for name, cells in found.items()),
        _worst_note(loop),
    )


def prediction_table(run: RunFolder) -> LoopTable | None:
    """Predicted beside played steps; None if nothing was predicted.

    Args:
        run: the contents of the folder.
    """
    steps = _section(run, "steps")
    if steps is None or "predicted" not in steps:
        return None
    rows = []
    for name, predicted in steps.sections("predicted").items():
        cells: list[str] = []
        for _, key, factor in _COMPARED:
            cells += [_number(predicted, key, factor), _played(run, name, key, factor)]
            if key == _SETTLING:
                tables = _raw(run, "predicted", name), _raw(run, "metrics", name).get(key)
                cells[-2:] = map(_or_unsettled, cells[-2:], (key, "value"), tables)
        cells.append(_number(steps, f"map_error.{name}", _PERCENT))
        rows.append((name[0].upper() + name[1:], tuple(cells)))
    columns = [f"{head}: {which}" for head, _, _ in _COMPARED for which in ("predicted", "played")]
    columns.append(_OF_MAP)
    used = [at for at in range(len(columns)) if any(cells[at] != ABSENT for _, cells in rows)]
    if not used:
        return None
    with_map = _OF_MAP in (columns[at] for at in used)
    notes = _PREDICTION_NOTES if with_map else _PREDICTION_NOTES[:1]
    if any(_UNSETTLED in cells for _, cells in rows):
        notes = (*notes, _NOTE_UNSETTLED)
    return LoopTable(
        tuple(columns[at] for at in used),
        tuple((name, tuple(cells[at] for at in used)) for name, cells in rows),
        notes,
    )


def _raw(run: RunFolder, table: str, name: str) -> Mapping[str, Any]:
    """A table of a loop in the section `steps` of analysis.json; empty if there is none."""
    found: Any = run.analysis.get("steps")
    for key in (table, name):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def _or_unsettled(cell: str, key: str, table: Any) -> str:
    """The cell; a number that is not known, written as null, was not reached."""
    unknown = isinstance(table, Mapping) and key in table and table[key] is None
    return _UNSETTLED if cell == ABSENT and unknown else cell


def _section(run: RunFolder, name: str) -> Section | None:
    try:
        return run.section(name)
    except LeftOutError:
        return None


def _number(section: Section | None, path: str, factor: float = 1.0) -> str:
    """A number by its dotted place, with three digits; a dash if there is none."""
    *tables, key = path.split(".")
    try:
        for table in tables:
            if section is None:
                return ABSENT
            section = section.section(table)
        return ABSENT if section is None else _three_digits(section.number(key), factor)
    except LeftOutError:
        return ABSENT


def _three_digits(value: float, factor: float) -> str:
    """A number without uncertainty, with three digits; at most four decimals, of a percentage two.

    Args:
        value: as in the file.
        factor: on it, see `_PERCENT`.
    """
    value, most = factor * value, 2 if factor == _PERCENT else 4
    if not math.isfinite(value):
        return ABSENT
    size = math.floor(math.log10(abs(value))) if value else 0
    text = f"{value:z.{min(max(2 - size, 0), most)}f}".replace("-", "−")
    return "0" if not float(text.replace("−", "-")) else text


def _played(run: RunFolder, group: str, key: str, factor: float) -> str:
    """A metric of a group of trials, as it stands in the table below figure 6."""
    steps = run.analysis.get("steps")
    table: Any = steps
    for name in ("metrics", group, key):
        table = table.get(name) if isinstance(table, Mapping) else None
    if not isinstance(table, Mapping) or not isinstance(table.get("value"), (int, float)):
        return ABSENT
    std = table.get("std")
    std = factor * std if isinstance(std, (int, float)) else math.nan
    value = factor * float(table["value"])
    return interval_text(value, std, (None, None))[0]


def _worst_note(loop: Section | None) -> tuple[str, ...]:
    """What the worst margins are over."""
    if loop is None or "worst" not in loop:
        return ()
    try:
        worst = loop.section("worst")
        spread = _PERCENT * worst.number("frequency_spread")
        nominal = worst.number("feedthrough")
        ends = worst.optional("feedthrough_range")
    except LeftOutError:
        return ()
    over = f"the natural frequency {spread:.3g} % lower or higher"
    if ends is not None:
        over += f", or a feedthrough of {ends[0]:.3g} to {ends[-1]:.3g}"
    with_ = f"The margins contain a feedthrough of {nominal:.3g}. " if nominal else ""
    return (f"{with_}Worst margins: the smallest ones with {over}; the PID is designed for them.",)


def _own_kind(results: Results) -> str:
    """The kind of the study's own controller, in quotation marks."""
    study = results.provenance.get("study")
    control = study.get("control") if isinstance(study, Mapping) else None
    kind = control.get("kind") if isinstance(control, Mapping) else None
    return f"'{kind}'" if kind else "of [control] kind"


def _cell(row: Quantity | None, factor: float, *, interval: bool) -> str:
    if row is None or row.measured is None:
        return ABSENT
    value, ends = rounded(row, factor)
    return f"{value} {ends}" if interval and ends != ABSENT else value


def _loop_of_file(run: RunFolder) -> str:
    """The loop whose controller is that of the folder's actuator file; `""` if none is."""
    path = run.path / ACTUATOR
    if not path.is_file():
        return ""
    section = table_at(read_actuator(path), "controller")
    kind, gains = section.get("kind"), table_at(section, "parameters")
    row, name = {"pid": ("S25", "PID"), "pi": ("S21", "PI")}.get(str(kind), ("", ""))
    if not row:
        own = "Controller {kind}"
        return own if kind and _own_kind(run.results) == f"'{kind}'" else ""
    for gain in ("kp", "ki"):
        used, written = run.results.get(f"{row}.{gain}"), gains.get(gain)
        if used is None or used.measured is None or not is_real(written):
            return ""
        # of a later design, the gains differ
        if not math.isclose(used.measured.value, written, rel_tol=_SAME_GAIN, abs_tol=1e-9):
            return ""
    return name
