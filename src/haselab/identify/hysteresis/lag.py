"""A linear lag as an alternative to hysteresis: at one rate its loops look the same."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from haselab.identify.hysteresis.loops import LoopRecord
from haselab.identify.model_choice import bic, effective_count
from haselab.models.filters import lfilter

__all__ = ["LagAlternative", "fit_lag"]

Floats = NDArray[np.float64]
_PARAMETERS = 4  # offset, both gains, time constant
_ROUNDING = 1e-9  # of the output's span
_STARTS = 12


@dataclass(frozen=True)
class LagAlternative:
    """A first-order lag with feed-through, fitted to loops.

    Args:
        time_constant_s: of the lag, in s.
        lead: BIC of the hysteresis model minus that of the lag; positive: the lag is better.
    """

    time_constant_s: float
    lead: float

    @property
    def how(self) -> str:
        """How well it explains the loops, compared with the hysteresis model."""
        return "better" if self.lead > 0.0 else "about as well"


def fit_lag(
    records: Sequence[LoopRecord], residuals: Sequence[Floats], parameters: int
) -> LagAlternative | None:
    r"""The best $y = c + a\,u + b\,u/(\tau s + 1)$, compared with a hysteresis model.

    Args:
        records: loops.
        residuals: of the hysteresis model, on all samples. Shape `(N_r,)` each.
        parameters: number of parameters of that model.
    Returns:
        The lag; None if no time constant between the sampling interval and the record length fits.
    """
    masks = [record.settled() for record in records]
    y = np.concatenate([r.y[mask] for r, mask in zip(records, masks, strict=True)])

    def fitted(log_tau: float) -> Floats:
        parts = []
        for r, mask in zip(records, masks, strict=True):
            share = -math.expm1(-1.0 / (r.rate_hz * math.exp(log_tau)))
            moved = r.u - r.u[0]
            lagging = lfilter([share], [1.0, share - 1.0], moved) + r.u[0]
            parts.append(np.column_stack([np.ones(r.u.size), r.u, lagging])[mask])
        columns = np.concatenate(parts)
        return np.asarray(y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0])

    def cost(log_tau: float) -> float:
        left = fitted(log_tau)
        return float(left @ left)

    low = math.log(0.5 / max(r.rate_hz for r in records))
    high = math.log(max(r.u.size / r.rate_hz for r in records))
    grid = np.linspace(low, high, _STARTS)
    at = int(np.argmin([cost(value) for value in grid]))
    if at in (0, _STARTS - 1):
        return None
    found = minimize_scalar(cost, bounds=(grid[at - 1], grid[at + 1]), method="bounded")
    counted = [e[mask] for e, mask in zip(residuals, masks, strict=True)]
    lag = np.split(fitted(found.x), np.cumsum([e.size for e in counted])[:-1])
    richer = min((counted, lag), key=lambda parts: sum(float(e @ e) for e in parts))
    effective, floor = effective_count(richer), (_ROUNDING * float(np.ptp(y))) ** 2
    ours = sum(float(e @ e) for e in counted)
    lead = bic(ours, y.size, effective, parameters, floor) - bic(
        float(found.fun), y.size, effective, _PARAMETERS, floor
    )
    return LagAlternative(math.exp(float(found.x)), lead)
