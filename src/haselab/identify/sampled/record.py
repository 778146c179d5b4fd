"""The record that a model in samples takes: input and output at the same, even moments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.base.chart import Chart
from haselab.identify.charts import time_chart
from haselab.identify.fit import several
from haselab.identify.record import Record

__all__ = ["check_same_rate", "sampled_chart", "single_driven_record", "single_record"]

Floats = NDArray[np.float64]
_OFF = 1e-3  # of a sample: times as far off count as another clock


def single_record(records: Record | Sequence[Record]) -> Record:
    """The one record that a sampled model is fitted to or compared with.

    Args:
        records: a record, or a sequence that holds one.
    Returns:
        The record.
    Raises:
        InputError: several records, or an input and an output of other times.
    """
    found = several(records)
    if len(found) > 1:
        raise InputError(
            f"{len(found)} records were given, but a sampled model takes one. Fit each, or use "
            "fit_transfer, which fits several together."
        )
    record = found[0]
    late = record.output_time_s * record.input_rate_hz - np.arange(record.y.size)
    if record.u.size != record.y.size or np.abs(late).max() > _OFF:
        raise InputError(
            f"The record has {record.u.size} inputs at {record.input_rate_hz:g} Hz and "
            f"{record.y.size} outputs at other times, but a sampled model needs both at the same "
            "moments. Resample the record, or use fit_transfer."
        )
    return record


def single_driven_record(records: Record | Sequence[Record]) -> Record:
    """The same, where the input must change within the record.

    Args:
        records: a record, or a sequence that holds one.
    Returns:
        The record.
    Raises:
        InputError: as `single_record`, or a constant input.
    """
    record = single_record(records)
    if np.ptp(record.u) == 0.0:
        raise InputError(
            f"The input is {record.u[0]:g} throughout, so it excites nothing. It "
            "must change. Name the right column, or record a chirp or a step."
        )
    return record


def check_same_rate(given_hz: float | None, fitted_hz: float) -> None:
    """Refuse a rate other than that of the fit.

    Args:
        given_hz: rate of the new input, in Hz. None: that of the fit.
        fitted_hz: rate of the record of the fit, in Hz.
    Raises:
        InputError: they differ.
    """
    if given_hz is not None and abs(given_hz - fitted_hz) > 1e-6 * fitted_hz:
        raise InputError(
            f"The rate is {given_hz:g} Hz, but the model was fitted at {fitted_hz:g} Hz and is "
            "valid at that rate only. Resample the input."
        )


def sampled_chart(
    title: str, record: Record, residuals: Floats, names: tuple[str, str] | None
) -> Chart:
    """The last outputs of a record, those that have residuals, with the model.

    Args:
        title: of the figure.
        record: that was fitted.
        residuals: measured minus modelled. Shape `(M,)`, at most that of the output.
        names: of input and output.
    Returns:
        The chart.
    """
    measured = record.y[record.y.size - residuals.size :]
    time_s = record.output_time_s[-measured.size :]
    return time_chart(
        title, time_s, measured, measured - residuals, ((names or ("", "Output"))[1], "model")
    )
