"""A creep record prepared for the fit, and a law that was fitted to it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from haselab.identify.creep.laws import CreepLaw, Span
from haselab.identify.noise import coloured_covariance
from haselab.identify.projection import Basis, Solution
from haselab.identify.training_output import grid_step

__all__ = ["Fitted", "Setting"]

Floats = NDArray[np.float64]
_ROWS = 800  # used to compare starts
_REPEATED = 0.5  # share of the samples that repeat the one before: quantisation hides the noise


@dataclass(frozen=True)
class Setting:
    """A record prepared for the fit.

    Args:
        span: its input minus the input before the record.
        y: outputs. Shape `(N,)`.
        kept: samples that are fitted. Shape `(N,)`.
        offset: whether the output before the first step is fitted besides the instantaneous
            response.
    """

    span: Span
    y: Floats
    kept: NDArray[np.bool_]
    offset: bool

    @cached_property
    def step(self) -> float:
        """Quantisation step of the output, if most samples repeat the one before; else 0."""
        held = self.y[self.kept]
        return grid_step(held) if np.mean(np.diff(held) == 0.0) > _REPEATED else 0.0

    @cached_property
    def runs(self) -> NDArray[np.int64]:
        """Index of the run of equal outputs to which each fitted sample belongs."""
        return np.cumsum(np.diff(self.y[self.kept], prepend=self.y[self.kept][0]) != 0.0)

    def thinned(self) -> Setting:
        """At most 800 of the fitted samples."""
        rows = np.flatnonzero(self.kept)
        kept = np.zeros_like(self.kept)
        kept[rows[:: max(1, math.ceil(rows.size / _ROWS))]] = True
        return Setting(self.span, self.y, kept, self.offset)

    def before(self, cut: int) -> Setting:
        """The samples before index `cut`."""
        return Setting(self.span, self.y, self.kept & (np.arange(self.y.size) < cut), self.offset)

    def bases(self, law: CreepLaw, search: Floats) -> list[Basis]:
        """Offset, input and creep on the fitted samples."""
        columns, slopes = law.columns(search, self.span)
        fixed = [self.span.inputs, np.ones(self.y.size)][: 1 + self.offset]
        shared = np.column_stack([*fixed, columns])[self.kept]
        by_search = np.zeros((search.size, *shared.shape))
        by_search[:, :, len(fixed) :] = slopes[:, self.kept]
        count = shared.shape[0]
        return [
            Basis(
                self.y[self.kept],
                shared,
                np.zeros((count, 0)),
                by_search,
                np.zeros(count),
                np.zeros((search.size, count)),
            )
        ]


@dataclass(frozen=True)
class Fitted:
    """A law with its parameters.

    Args:
        law: law of the creep.
        solution: `shared` is the instantaneous response, the offset if it is fitted, and gains.
        bic: Bayesian information criterion; NaN before it is computed.
    """

    law: CreepLaw
    solution: Solution
    bic: float = math.nan

    def gains(self, setting: Setting) -> Floats:
        """Gains of the creep terms, without the instantaneous response and the offset."""
        return self.solution.shared[1 + setting.offset :]

    @property
    def parameters(self) -> int:
        """Number of fitted parameters."""
        return self.solution.search.size + self.solution.shared.size

    def covariance(self, setting: Setting) -> Floats:
        """Covariance of the search and shared parameters, rounding errors included.

        A rounding error has the variance `step**2 / 12`. It depends on the output alone, so all
        samples of a run of equal outputs are assumed to have the same one.
        """
        solution = self.solution
        covariance = coloured_covariance(solution.columns, solution.residuals, self.parameters)
        step, runs = setting.step, setting.runs
        if step == 0.0 or not np.isfinite(covariance).all():
            return covariance
        inverse = np.linalg.pinv(np.vstack(list(solution.columns)))
        by_run = np.zeros((inverse.shape[0], int(runs[-1]) + 1))
        np.add.at(by_run.T, runs, inverse.T)
        return np.asarray(covariance + step**2 / 12.0 * by_run @ by_run.T)
