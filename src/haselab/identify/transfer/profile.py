"""Standard deviations checked against the profile likelihood, which may not be a parabola."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab.identify.transfer.layout import Layout
from haselab.identify.transfer.problem import TransferProblem
from haselab.identify.transfer.search import Best, settled
from haselab.identify.transfer.start import delay_margin_s

__all__ = ["profile_std"]

Floats = NDArray[np.float64]
_NARROW = 0.01  # relative standard deviation, or phase, below which the parabola is assumed
_FAR = 4.0  # standard deviations at which the profile is compared with it
_FARTHEST = 64.0
_FLAT = 0.7  # of the parabola's rise: a smaller rise is a flatter profile
_LESS = 1e-5  # relative decrease of the cost that counts as a better solution
_GAIN = 1e-7


def profile_std(layout: Layout, best: Best, std: Floats) -> tuple[Floats, Best | None]:
    """Compare the cost with its parabola at 4 standard deviations to both sides of each parameter.

    One parameter is fixed there and the others are searched again. Where the cost rises less than
    the parabola, the deviation is widened to a quarter of the distance at which it has risen as
    much.

    Args:
        layout: order of the numbers.
        best: the solution.
        std: standard deviations of the searched parameters, from the sensitivities. Shape `(S,)`.
    Returns:
        Factors for the deviations, infinite where the cost never rises, shape `(S,)`; and a
        solution of lower cost, if the search found one.
    Source: Bates and Watts, Nonlinear Regression Analysis (1988), chapter 6 (profile t plots).
    """
    found, size = best.found, std.size
    factors = np.ones(size)
    gram = sum((z.T @ z for z in best.columns.sensitivities), np.zeros(()))
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    rise = 1.0 / np.maximum(
        np.diag(np.linalg.pinv(gram / np.outer(scale, scale)))[:size] / scale[:size] ** 2, 1e-300
    )
    fastest = max(abs(p) for s in layout.sections for p in s.poles(layout.full(found.search)))
    problem = TransferProblem(layout, best.records, delay_margin_s(best.records))
    for i, at in enumerate(layout.free):
        unit = fastest if layout.names[at] == "delay_s" else 1.0
        if not _NARROW < std[i] * unit < math.inf:
            continue
        for side in (-1.0, 1.0):
            factor, lower = _side(problem, best, i, side * float(std[i]), float(rise[i]))
            if lower is not None:
                better = settled(problem, best.records, lower, best.bounds)
                if better is not None and better.found.cost < found.cost * (1.0 - _LESS):
                    return factors, replace(better, others=(found, *best.others))
            factors[i] = max(factors[i], factor)
    return factors, None


def _side(
    problem: TransferProblem, best: Best, at: int, std: float, rise: float
) -> tuple[float, Floats | None]:
    """Factor for a deviation on one side; parameters of lower cost that were found on the way."""
    low, high = best.bounds
    start, least = best.found.search, best.found.cost
    wanted = (_FAR * std) ** 2 * rise
    before, height, away = 0.0, 0.0, _FAR
    while away <= _FARTHEST:
        held = start.copy()
        held[at] = start[at] + away * std
        if not low[at] < held[at] < high[at]:
            return max(before / _FAR, 1.0), None
        bounds = low.copy(), high.copy()
        bounds[0][at] = bounds[1][at] = held[at]
        other = problem.minimise(held, bounds, gain=_GAIN)
        if other.cost < least * (1.0 - _LESS):
            return 1.0, other.search
        risen = other.cost - least
        if not math.isfinite(risen) or risen >= (_FLAT if away == _FAR else 1.0) * wanted:
            if away == _FAR:
                return 1.0, None
            # The root of the cost is near a line between two places.
            share = (math.sqrt(wanted) - math.sqrt(height)) / (
                math.sqrt(max(risen, wanted)) - math.sqrt(height)
            )
            return (before + share * (away - before)) / _FAR, None
        before, height, away = away, max(risen, 0.0), 2.0 * away
    return math.inf, None
