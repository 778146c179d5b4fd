"""What records must have before a transfer function is fitted to them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from haselab.base import InputError
from haselab.identify.frequency.steady_tone import steady_tone_hz
from haselab.identify.record import Record
from haselab.identify.transfer.layout import Layout

__all__ = ["check_size", "count_outputs", "runs_away", "too_few_tones"]

_MOST_RECORDS = 64
_RUNAWAY = 1.3  # growth per eighth of a record


def check_size(layout: Layout, records: Sequence[Record]) -> None:
    """Refuse too many records, and fewer than two outputs for each number.

    Raises:
        InputError: such records.
    """
    if len(records) > _MOST_RECORDS:
        raise InputError(
            f"There are {len(records)} records; at most {_MOST_RECORDS} are possible. "
            "Fit groups of records and compare the results, or leave some out."
        )
    count = count_outputs(records)
    own = layout.structure.offset + sum(s.order for s in layout.sections)
    wanted = layout.free.size + len(layout.factor_names) + own * len(records)
    if count < 2 * wanted:
        raise InputError(
            f"The records have {count} outputs; {wanted} parameters need at least {2 * wanted}. "
            "Record longer, or fit fewer poles."
        )


def count_outputs(records: Sequence[Record]) -> int:
    """Number of outputs in all records."""
    return sum(record.y.size for record in records)


def too_few_tones(layout: Layout, records: Sequence[Record]) -> str | None:
    """Why steady tones cannot determine the parameters; None when the records suffice."""
    if not layout.structure.initial_state:
        return None
    tones: set[float] = set()
    for record in records:
        tone = steady_tone_hz(record)
        if tone is None:
            return None
        if not any(abs(tone - other) * record.duration_s < 1.0 for other in tones):
            tones.add(tone)
    numbers = layout.free.size + int(np.isnan(layout.factor_template).sum())
    if not tones or numbers <= 2 * len(tones):
        return None
    shown = " and ".join(f"{tone:.4g} Hz" for tone in sorted(tones))
    return (
        f"input and output are steady tones of {shown}, which determine {2 * len(tones)} "
        f"parameters, not {numbers}; excite more frequencies, or include the start from rest"
    )


def runs_away(record: Record) -> bool:
    """Whether the output grows by a third or more in each of the last eighths of the record."""
    parts = np.array_split(record.y - np.median(record.y[: max(1, record.y.size // 8)]), 8)
    size = np.sqrt([float(part @ part) / part.size for part in parts])
    return bool((size[4:] > _RUNAWAY * size[3:-1]).all())
