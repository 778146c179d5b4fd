"""Remarks on what a transfer function and its records leave undetermined."""

from __future__ import annotations

import numpy as np

from haselab.base import Estimate
from haselab.identify.record import Record
from haselab.identify.transfer.layout import TransferStructure
from haselab.identify.transfer.search import Best

__all__ = ["remarks_of"]

_NOT_WHITE = (
    "The residuals are not white: the model does not explain everything, and the intervals are "
    "valid only if its structure is right. Try {}--choose nonlinear (such as the square of a "
    "voltage), or --choose all."
)
_NOISY_INPUT = (
    "If none of them helps, the cause may be noise of the measured input, which the model "
    "passes on to the output; identify from the commanded drive to exclude this."
)
_CREEP = "--slow-modes 1 (creep), "
_EARLY = 0.1  # share of the output's range
_LEAST_EARLY = 20  # outputs before the input first changes
_SAME_LEVEL = 0.02  # of the input's range: noise of a measured input
_EARLY_CHANGE = (
    "The output changes by {:.0f} % of its range before the input first changes: the plant was not "
    "at rest at the start, or the sensor drifts. The initial state is estimated, so this change "
    "says little about the slow modes. Begin the record with some seconds at another, settled "
    "level, or remove the drift."
)


def remarks_of(
    structure: TransferStructure, best: Best, estimates: dict[str, Estimate]
) -> list[str]:
    """Notes on the limitations of a fit.

    Args:
        structure: of the model.
        best: the solution.
        estimates: its parameters.
    Returns:
        One sentence or two for each.
    """
    notes = []
    delay = estimates["delay_s"]
    if delay.value < 0.0:
        zero = delay.ci95[1] >= 0.0
        shown = "not significantly above zero" if zero else "below zero (check the clocks)"
        notes.append(f"The delay is {shown}; the plant uses 0 s.")
    if structure.zeros == structure.poles and structure.delay == "auto":
        notes.append("With as many zeros as poles the delay is assumed to be 0 s.")
    slow_s = max(
        (e.value for n, e in estimates.items() if n.endswith("time_constant_s")), default=0.0
    )
    early = max(_early_change(record, slow_s) for record in best.records)
    if structure.slow_modes and structure.initial_state and early > _EARLY:
        notes.append(_EARLY_CHANGE.format(100.0 * early))
    if best.whiteness_p < 0.05:
        measured = any(record.hold == "band-limited" for record in best.records)
        note = _NOT_WHITE.format("" if structure.slow_modes else _CREEP)
        notes.append(f"{note} {_NOISY_INPUT}" if measured else note)
    return notes


def _early_change(record: Record, slow_s: float) -> float:
    """Change of the output before the input first changes, over the range of the output.

    Args:
        record: of an experiment.
        slow_s: time constant of the slowest mode; a change in less than half of it is fast.
    """
    changes = np.flatnonzero(np.abs(record.u - record.u[0]) > _SAME_LEVEL * np.ptp(record.u))
    held_s = changes[0] / record.input_rate_hz if changes.size else record.duration_s
    held = record.y[record.output_time_s < held_s]
    if held.size < _LEAST_EARLY or held_s < 0.5 * slow_s:
        return 0.0
    tenth = max(1, held.size // 10)
    change = float(held[-tenth:].mean() - held[:tenth].mean())
    return abs(change) / max(float(np.ptp(record.y)), 1e-300)
