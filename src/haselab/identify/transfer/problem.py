"""Records and a structure in the form of the C code (`native/identification/transfer.h`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab import _identify
from haselab.identify.hold import fine_input
from haselab.identify.record import Record
from haselab.identify.transfer.layout import Layout

__all__ = ["LEAST_GAIN", "Columns", "Found", "TransferProblem"]

Floats = NDArray[np.float64]
_ITERATIONS = 100
LEAST_GAIN = 1e-9  # of the cost: a thousandth of a standard deviation with 1,000 outputs


@dataclass(frozen=True)
class Found:
    """Best factors for given searched parameters.

    Args:
        search: searched parameters. Shape `(L,)`.
        shared: common factors. Shape `(S,)`.
        own: factors of each record. Shape `(Q,)` each.
        cost: sum of the squared residuals.
        settled: whether the search converged.
    """

    search: Floats
    shared: Floats
    own: list[Floats]
    cost: float
    settled: bool


@dataclass(frozen=True)
class Columns:
    """Residuals and sensitivities of a solution, record by record.

    Args:
        residuals: measured minus modelled. Shape `(M_r,)` each.
        sensitivities: to searched parameters and common factors, orthogonal to the record's own
            functions. Shape `(M_r, L + S)` each.
        own: the record's own functions, orthonormal. Shape `(M_r, Q)` each.
    """

    residuals: tuple[Floats, ...]
    sensitivities: tuple[Floats, ...]
    own: tuple[Floats, ...]


class TransferProblem:
    """Least-squares problem over several records.

    Args:
        layout: order of the parameters.
        records: experiments.
        margin_s: how far below zero the delay may go.
        share: share of each record's outputs that is used, from its start.
    """

    def __init__(
        self, layout: Layout, records: Sequence[Record], margin_s: float, share: float = 1.0
    ) -> None:
        self.layout = layout
        cuts = [int(share * record.y.size) for record in records]
        self._ends = np.cumsum(cuts)[:-1]
        structure = layout.structure
        self._native = _identify.Transfer(
            pairs=structure.poles // 2,
            reals=structure.poles % 2,
            zeros=structure.zeros,
            slow=structure.slow_modes,
            initial_state=structure.initial_state,
            offset=structure.offset,
            numbers=layout.template.tolist(),
            factors=layout.factor_template.tolist(),
            records=[_held(r, margin_s, cut) for r, cut in zip(records, cuts, strict=True)],
        )

    def project(self, search: Floats) -> Found:
        """Factors and cost at `search`."""
        return Found(*self._native.project(search.tolist()))

    def minimise(
        self, search: Floats, bounds: tuple[Floats, Floats], gain: float = LEAST_GAIN
    ) -> Found:
        """Levenberg-Marquardt search from `search`, until a step gains less than `gain`."""
        low, high = (bound.tolist() for bound in bounds)
        return Found(*self._native.minimise(search.tolist(), low, high, _ITERATIONS, gain))

    def columns(self, found: Found) -> Columns:
        """Residuals and sensitivities of a solution."""
        residuals, columns = self._native.columns(found.search.tolist())
        count = found.search.size + found.shared.size
        parts = np.split(columns, self._ends, axis=1)
        return Columns(
            tuple(np.split(residuals, self._ends)),
            tuple(part[:count].T for part in parts),
            tuple(part[count:].T for part in parts),
        )

    def predict(self, found: Found) -> list[Floats]:
        """Output of each record for a solution that was found on other data."""
        own = [factors.tolist() for factors in found.own]
        output = self._native.predict(found.search.tolist(), found.shared.tolist(), own)
        return np.split(output, self._ends)


def _held(record: Record, margin_s: float, cut: int) -> _identify.Record:
    """A record for the C code."""
    u, rate_hz = fine_input(record)
    return _identify.Record(
        u,
        rate_hz,
        record.input_before or 0.0,
        record.hold != "zero",
        np.ascontiguousarray(record.y[:cut]),
        np.ascontiguousarray(record.output_time_s[:cut]),
        margin_s,
    )
