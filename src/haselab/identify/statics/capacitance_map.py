"""Strain from relative capacitance: a straight line through the averaged edges, eq. 5."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import Estimate, JsonObject, checked
from haselab.base.chart import Chart
from haselab.identify.charts import curve_chart
from haselab.identify.clipped import clipping_of
from haselab.identify.fit import CurveFit, rescaled
from haselab.identify.noise import autoregression, coloured_covariance, r_squared
from haselab.identify.statics.columns import check_pair, plausible_strain
from haselab.identify.statics.cycles import loop_cells, rising_edges, trend
from haselab.models.filters import lfilter
from haselab.models.maps import LinearMap

__all__ = ["CapacitanceMapFit", "fit_capacitance_map"]

Floats = NDArray[np.float64]
_ONE_EDGE = "The record has one edge only, so rising and falling edges could not be averaged."


@dataclass(frozen=True, kw_only=True)
class CapacitanceMapFit(CurveFit):
    """A fitted capacitance map; see `Fit` for what all fits have.

    Its `parameters` are `slope` and `offset`, strain per unit of capacitance and strain.

    Args:
        r_squared: share of the variance of all strains that the line explains.
        x: capacitances that were fitted, in any unit. Shape `(N,)`.
        strain: strains at these. Shape `(N,)`.
    """

    r_squared: float = math.nan
    x: Floats = field(repr=False)
    strain: Floats = field(repr=False)

    @property
    def map(self) -> LinearMap:
        """The linear map with the fitted parameters.

        Raises:
            ResultError: the fit has no result.
        """
        self._require()
        return LinearMap(self.parameters["slope"].value, self.parameters["offset"].value)

    @checked
    def simulate(self, x: ArrayLike) -> Floats:
        """Strain at capacitances; see `CurveFit`."""
        return np.asarray(self.map.strain(x), dtype=np.float64)

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`."""
        grid = np.linspace(self.x.min(), self.x.max(), 400)
        return curve_chart(
            "Capacitance map", names or ("Capacitance (as in the file, SI)", "Strain"),
            (self.x, self.strain), (grid, self.simulate(grid)),
        )  # fmt: skip

    def answer(self) -> JsonObject:
        """The result under its public JSON keys."""
        return {
            "slope": self.parameters.get("slope"),
            "offset": self.parameters.get("offset"),
            "r_squared": self.r_squared,
            "status": self.status,
            "notes": list(self.notes),
        }


@checked
def fit_capacitance_map(relative_capacitance: ArrayLike, strain: ArrayLike) -> CapacitanceMapFit:
    r"""Fit strain as a straight line of the capacitance, rising and falling edges averaged.

    $\varepsilon = k\,C_r + \varepsilon_0$. The samples of each edge are averaged in cells of equal
    strain, the two edges of a cell are averaged, and the line goes through these means, each
    with the same weight. The time spent at a strain and the hysteresis therefore do not shift it.

    Args:
        relative_capacitance: in order of time, any unit. Shape `(N,)`.
        strain: at the same times, dimensionless. Shape `(N,)`.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: fewer than 8 samples, unequal lengths, NaN, a constant column.
    Source: reference study, eq. 5. Intervals: the larger of two, from the misfit along the line
        and from the noise in time, each with its own noise model.
    Example:
        >>> rng = np.random.default_rng(3)
        >>> strain = 0.05 - 0.1 * np.cos(2 * np.pi * 0.25 * np.arange(1600) / 100.0)
        >>> capacitance = (strain + 0.276) / 4.923e6 + 2e-10 * rng.normal(size=1600)
        >>> fit = fit_capacitance_map(capacitance, strain)
        >>> low, high = fit.parameters["slope"].ci95
        >>> fit.status, low < 4.923e6 < high
        ('ok', True)
    """
    c, e, doubts = _checked(relative_capacitance, strain)
    clipped = clipping_of(c, "capacitances") or clipping_of(e, "strains")
    if clipped or trend(c, e) == 0:
        why = clipped or "the strain does not depend on the capacitance; check the columns"
        reason = f"no result: {why}"
        return CapacitanceMapFit(status=reason, x=c, strain=e)
    middle, half = float(c.mean()), 0.5 * float(np.ptp(c))
    columns = np.column_stack([(c - middle) / half, np.ones_like(c)])
    cells = _Cells.of(e)
    means, targets = cells.means(columns), cells.means(e)
    factors = np.linalg.lstsq(means, targets, rcond=None)[0]
    residuals = e - columns @ factors
    along = coloured_covariance([means], [targets - means @ factors], 2)
    in_time = _time_covariance(cells, means, residuals)
    # From the line about the middle to the line about zero capacitance.
    about_zero = np.array([[1.0 / half, 0.0], [-middle / half, 1.0]])
    slope, offset = about_zero @ factors
    covariances = [about_zero @ part @ about_zero.T for part in (along, in_time)]
    spread = np.sqrt([np.diag(part) for part in covariances]).max(axis=0)
    estimates = {
        "slope": Estimate.normal(slope, spread[0], ""),
        "offset": Estimate.normal(offset, spread[1], ""),
    }
    notes = doubts if cells.both else (_ONE_EDGE, *doubts)
    larger = max(covariances, key=lambda part: float(part[0, 0]))
    return CapacitanceMapFit(
        status="ok",
        parameters=estimates,
        covariance=rescaled(larger, spread),
        residuals=(residuals,),
        notes=notes,
        r_squared=r_squared(e, e - residuals),
        x=c,
        strain=e,
    )


def _checked(
    relative_capacitance: ArrayLike, strain: ArrayLike
) -> tuple[Floats, Floats, tuple[str, ...]]:
    c, e = check_pair(
        "relative_capacitance", relative_capacitance, "strain", strain, least=8,
        record="record a triangle test",
    )  # fmt: skip
    return c, e, plausible_strain(e, "relative_capacitance", c)


@dataclass(frozen=True)
class _Cells:
    """Weights that average the samples in cells of equal strain, with equal weight for both edges.

    Args:
        index: row of the mean that a sample belongs to; -1 outside. Shape `(N,)`.
        weight: of a sample in its mean; 0 outside. Shape `(N,)`.
        both: whether the record has two edges.
    """

    index: NDArray[np.intp]
    weight: Floats
    both: bool

    @classmethod
    def of(cls, strain: Floats) -> _Cells:
        edges = rising_edges(strain)
        cells = loop_cells(strain, edges)
        shared = [
            [here & (edges == way) for way in (1, -1)]
            for here in (cells == cell for cell in range(int(cells.max()) + 1))
        ]
        rows = [pair for pair in shared if pair[0].any() and pair[1].any()]
        both = len(rows) >= 3
        if not both:
            rows = [[cells == cell] for cell in np.unique(cells)]
        index, weight = np.full(strain.size, -1, dtype=np.intp), np.zeros(strain.size)
        for row, members in enumerate(rows):
            for member in members:
                index[member] = row
                weight[member] = 1.0 / (len(members) * member.sum())
        return cls(index, weight, both)

    def means(self, values: Floats) -> Floats:
        """Weighted means of the rows of `values`. First axis: the cells."""
        inside = self.index >= 0
        total = np.zeros((int(self.index.max()) + 1, *values.shape[1:]))
        np.add.at(total, self.index[inside], (self.weight * values.T).T[inside])
        return total


def _time_covariance(cells: _Cells, means: Floats, residuals: Floats) -> Floats:
    """Covariance of slope and offset for noise that is coloured in time."""
    hold = means[cells.index] * cells.weight[:, None]
    polynomial, variance = autoregression([residuals])
    padded = np.vstack([hold[::-1], np.zeros_like(hold)])
    filtered = np.asarray(lfilter([1.0], polynomial, padded, axis=0))
    inverse = np.linalg.inv(means.T @ means)
    return np.asarray(variance * inverse @ (filtered.T @ filtered) @ inverse)
