r"""Ends of intervals where the misfit is not quadratic.

At a distance $d$ from the estimate of one parameter, all others are fitted again. In a quadratic
misfit, its sum of squares then grows by $(d/\sigma)^2$. Where several parameters hardly differ in
their effect, such as a modulus and a locking stretch, the valley is curved, and the sum of squares
grows by less: the interval is then extended to where the growth is that of its end.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import ADDED_INERTIA, DRIFTS
from haselab.actuators.threads import in_threads
from haselab.base import HaselabError
from haselab.base.estimate import Z95
from haselab.identify.physical.information import covariance_of, vague_information
from haselab.identify.physical.misfit import Misfit
from haselab.identify.physical.result import ActuatorFit
from haselab.identify.physical.search import SearchResult, refine
from haselab.identify.physical.unknowns import Unknowns

__all__ = ["extend_intervals"]

Floats = NDArray[np.float64]
_WIDE = 0.03  # standard deviation over the width of the start, below which a misfit is quadratic
_LESS, _MORE = 0.9, 1.15  # growth over that of a quadratic misfit that counts as the same
_STEPS = 4  # of the search for the other parameters
_ROUNDS = 3  # of one end
_FARTHER = 2.0  # times, in one round


def extend_intervals(
    fit: ActuatorFit, misfit: Misfit, found: SearchResult, begun: Unknowns
) -> ActuatorFit:
    """Extend the intervals of parameters for which the sum of squares is not quadratic.

    At each end, the misfit is first compared with a quadratic one, along the covariance. Only where
    it differs are the other parameters fitted again.

    Args:
        fit: result at the minimum.
        misfit: that was minimised.
        found: its minimum.
        begun: where the user began.
    Returns:
        The fit, with intervals that are at least as wide; standard deviations and covariance stay.
    """
    if not fit.succeeded:
        return fit
    unknowns = found.unknowns
    std = np.sqrt(np.diag(fit.covariance)) / np.abs(unknowns.slopes)
    widths = unknowns.widths
    chosen = [
        (k, sign)
        for k, name in enumerate(unknowns.names)
        if std[k] > _WIDE * widths[k]
        and name in unknowns.law_names
        and name not in {ADDED_INERTIA, *DRIFTS, *fit.not_identifiable}
        for sign in (-1.0, 1.0)
    ]
    valley = _Valley(misfit, found, begun)
    ends = in_threads(
        lambda end: valley.end(end[0], end[1] * Z95 * float(std[end[0]])),
        chosen,
        os.cpu_count() or 1,
    )
    parameters = dict(fit.parameters)
    for (k, _), value in zip(chosen, ends, strict=True):
        old = parameters[unknowns.names[k]]
        low, high = old.ci95
        parameters[unknowns.names[k]] = replace(old, ci95=(min(low, value), max(high, value)))
    return replace(fit, parameters=parameters)


class _Valley:
    """The misfit about its minimum."""

    def __init__(self, misfit: Misfit, found: SearchResult, begun: Unknowns) -> None:
        self.misfit, self.unknowns = misfit, found.unknowns
        self.begun = found.unknowns.at(begun)
        self.pull = vague_information(found.unknowns)
        self.least = self._cost(found.unknowns, found.residuals)
        self.white = covariance_of([found.jacobian, np.diag(np.sqrt(self.pull))])

    def end(self, k: int, reach: float) -> float:
        """Value of a parameter where the misfit has grown as a quadratic one has at a distance."""
        wanted = reach**2 / self.white[k, k]
        along = self.white[:, k] / self.white[k, k]
        beside = self._at(k, reach, along)
        residuals = self.misfit.residuals(beside)
        if residuals is not None:
            growth = self._cost(beside, residuals) - self.least
            if _LESS * wanted <= growth <= _MORE * wanted:
                return float(beside.values[k])
        for _ in range(_ROUNDS):
            again = self._fitted(k, reach, along)
            if again is None:
                break
            grown = self._cost(*again) - self.least
            if grown >= _LESS * wanted:
                break
            along = again[0].distance(self.unknowns) / reach  # the next one starts on the curve
            reach *= min(_FARTHER, math.sqrt(wanted / max(grown, 1e-3 * wanted)))
        return float(self._at(k, reach, along).values[k])

    def _at(self, k: int, distance: float, along: Floats) -> Unknowns:
        moved = self.unknowns.moved(distance * along)
        # an inverse that would be negative is at its limit
        values = np.where(np.isnan(moved.values), moved.limits[1], moved.values)
        return replace(moved, values=values).within_limits()

    def _fitted(self, k: int, distance: float, along: Floats) -> tuple[Unknowns, Floats] | None:
        """The others fitted again at a distance of one, with their residuals."""
        beside, name = self._at(k, distance, along), self.unknowns.names[k]
        try:
            start = beside.without((name,))
        except HaselabError:  # parameters that the law cannot have together
            return None
        again = refine(self.misfit, start, steps=_STEPS, begun=self.begun.without((name,)))
        return None if again is None else (beside.at(again.unknowns), again.residuals)

    def _cost(self, unknowns: Unknowns, residuals: Floats) -> float:
        away = unknowns.distance(self.begun)
        return float(residuals @ residuals + self.pull @ away**2)
