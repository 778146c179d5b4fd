"""Intervals of a transfer function by repeated simulated experiments (bootstrap)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError, ResultError, checked
from haselab.identify.noise import noise_behind
from haselab.identify.transfer.fit import TransferFit
from haselab.identify.transfer.layout import Layout, layout_of
from haselab.identify.transfer.problem import TransferProblem
from haselab.identify.transfer.start import delay_margin_s
from haselab.models.filters import lfilter

__all__ = ["bootstrap_transfer"]

Floats = NDArray[np.float64]
_LEAST = 100
_BURN_IN = 2000  # samples of noise before the record


@checked
def bootstrap_transfer(
    fit: TransferFit, draws: int, rng: np.random.Generator
) -> dict[str, Estimate]:
    """Estimates whose intervals are percentiles over repeated, simulated experiments.

    Each draw is the fitted output with new noise, with the spectrum of the residuals; it is
    fitted again, starting from the fitted parameters. The interval therefore includes the
    curvature, which the covariance of the fit leaves out.

    Args:
        fit: a fit with a result.
        draws: number of simulated experiments, 100 or more.
        rng: random generator of the noise.
    Returns:
        All parameters of the fit by name: fitted value, standard deviation and 2.5 and 97.5
        percentiles of the draws. A parameter that is not identifiable stays NaN; a fixed one
        has no spread.
    Raises:
        InputError: too few draws.
        ResultError: the fit has no result.
    Source: Efron and Tibshirani, An Introduction to the Bootstrap (1993), chapters 6 and 13.
    Example:
        >>> from haselab.identify import Record, fit_transfer
        >>> from haselab.models import Plant
        >>> rng = np.random.default_rng(7)
        >>> u, time_s = rng.normal(size=500), np.arange(2000) / 400.0
        >>> y = Plant(0.5, 5.11, 0.09).simulate(u, 100.0, time_s) + 0.01 * rng.normal(size=2000)
        >>> fit = fit_transfer([Record(u, 100.0, y, time_s)])
        >>> drawn = bootstrap_transfer(fit, 200, rng)["damping_ratio"]
        >>> 0.7 < drawn.std / fit.parameters["damping_ratio"].std < 1.4
        True
    """
    if draws < _LEAST:
        raise InputError(
            f"draws = {draws}; it must be {_LEAST} or more, for the ends of a 95 % interval."
        )
    if fit.best is None:
        raise ResultError(f"The fit has no result: {fit.status}")
    layout = layout_of(fit.structure)
    found = np.array(list(_drawn(fit, layout, draws, rng)))
    low, high = np.percentile(found, [2.5, 97.5], axis=0)
    std = found.std(axis=0, ddof=1)
    return {
        name: old
        if not np.isfinite(old.std) or old.std == 0.0
        else Estimate(old.value, float(std[i]), (float(low[i]), float(high[i])), old.unit)
        for i, (name, old) in enumerate(fit.parameters.items())
    }


def _drawn(
    fit: TransferFit, layout: Layout, draws: int, rng: np.random.Generator
) -> Iterator[Floats]:
    """Searched parameters and factors of each simulated experiment."""
    assert fit.best is not None
    columns, start = fit.best.columns, fit.best.found.search
    polynomial, variance = noise_behind(fit.residuals, columns.sensitivities, columns.own)
    margin_s = delay_margin_s(fit.records)
    linear = np.array([name == "delay_s" for name in layout.names])
    for _ in range(draws):
        simulated = []
        for record, clean in zip(fit.records, fit.modelled, strict=True):
            white = np.sqrt(variance) * rng.normal(size=clean.size + _BURN_IN)
            noise = lfilter([1.0], polynomial, white)[_BURN_IN:]
            simulated.append(replace(record, y=clean + noise))
        found = TransferProblem(layout, simulated, margin_s).minimise(start, fit.best.bounds)
        numbers = layout.full(found.search)
        factors = layout.factor_template.copy()
        factors[np.isnan(factors)] = found.shared
        yield np.concatenate([np.where(linear, numbers, np.exp(numbers)), factors])
