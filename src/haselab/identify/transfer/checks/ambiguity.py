"""Whether another delay, or another set of poles, explains the records as well."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from haselab.base import Estimate
from haselab.identify.noise import autoregression
from haselab.identify.record import Record
from haselab.identify.transfer.layout import Layout
from haselab.identify.transfer.problem import Found, TransferProblem
from haselab.models.filters import lfilter

__all__ = ["OtherMinimum", "ambiguity", "find_other_minima", "has_unique_delay", "whitened_energy"]

Floats = NDArray[np.float64]
_ALIKE = 0.9  # correlation of the modelled output with itself at a later time
_APART = 5.0  # standard deviations between two solutions that count as different
_LIKELY = 16.0  # twice the difference of logarithmic likelihoods below which both are possible
_LISTED = 60.0
_MOST = 5
_LEFT = 6.0  # standard deviations of the correlation of white residuals with any signal


def has_unique_delay(
    layout: Layout, residuals: Sequence[Floats], records: Sequence[Record]
) -> bool:
    """Whether no other delay explains the output and the residuals contain nothing of it.

    Another minimum at another delay has to reproduce the modelled output, shifted and with other
    poles, up to the noise. Where the output's correlation with itself beyond its first zero stays
    below 0.9, no other delay comes close; and residuals that contain a shifted part of the output
    are correlated with it.
    """
    if not math.isnan(float(layout.template[-1])):
        return True
    for record, residual in zip(records, residuals, strict=True):
        modelled = record.y - residual
        modelled = modelled - modelled.mean()
        size = next_fast_len(2 * modelled.size, real=True)
        spectrum = rfft(modelled, size)
        energy = float(modelled @ modelled)
        if not energy > 0.0:
            return False
        alike = irfft(np.abs(spectrum) ** 2, size)[: modelled.size] / energy
        below = np.flatnonzero(alike <= 0.0)
        if below.size and np.abs(alike[below[0] :]).max() > _ALIKE:
            return False
        left = irfft(rfft(residual, size) * np.conj(spectrum), size)
        std = math.sqrt(float(residual @ residual) / residual.size * energy)
        if np.abs(left).max() > _LEFT * std:
            return False
    return True


@dataclass(frozen=True)
class OtherMinimum:
    """Another minimum of the same structure.

    Args:
        numbers: its numbers, by name.
        log_likelihood_below: how far its logarithmic likelihood is below that of the best fit.
        differs: which identifiable numbers are more than 5 standard deviations from the best's.
    """

    numbers: dict[str, float]
    log_likelihood_below: float
    differs: tuple[str, ...]

    @property
    def possible(self) -> bool:
        """Whether the data cannot decide which of the two is right.

        Where the truth is twice as far above the other minimum in logarithmic likelihood as this
        limit, noise reverses the order with a probability of 3e-5 (a normal deviate of 4).
        """
        return 2.0 * self.log_likelihood_below < _LIKELY


def find_other_minima(
    layout: Layout,
    problem: TransferProblem,
    residuals: Sequence[Floats],
    others: Sequence[Found],
    estimates: dict[str, Estimate],
) -> tuple[OtherMinimum, ...]:
    """Other minima that differ from the estimates, the most likely first.

    All likelihoods use the noise model of the best fit's residuals.

    Args:
        layout: order of the parameters.
        problem: least squares over the records.
        residuals: of the best solution.
        others: other solutions.
        estimates: parameters of the best solution.
    """
    polynomial = autoregression(residuals)[0]
    count = sum(e.size for e in residuals)
    least = whitened_energy(residuals, polynomial)
    found: list[OtherMinimum] = []
    for other in others:
        columns = problem.columns(other)
        energy = max(whitened_energy(columns.residuals, polynomial), 1e-300)
        below = 0.5 * count * math.log(energy / least)
        numbers = _numbers(layout, other)
        differs = tuple(
            name
            for name, value in numbers.items()
            if name in estimates and _apart(estimates[name], value, name)
        )
        known = any(numbers == minimum.numbers for minimum in found)
        if differs and not known and below < _LISTED:
            found.append(OtherMinimum(numbers, below, differs))
    return tuple(sorted(found, key=lambda minimum: minimum.log_likelihood_below)[:_MOST])


def ambiguity(minima: Sequence[OtherMinimum], estimates: dict[str, Estimate]) -> str | None:
    """Status naming another minimum that explains the records as well, or None."""
    possible = [minimum for minimum in minima if minimum.possible]
    if not possible:
        return None
    minimum = possible[0]
    shown = ", ".join(
        f"{name} {estimates[name].value:.4g} or {minimum.numbers[name]:.4g}"
        for name in minimum.differs[:3]
    )
    ratio = math.exp(-max(minimum.log_likelihood_below, 0.0))
    return (
        f"ambiguous: two models explain the records, {shown} (likelihood ratio {ratio:.2g}); "
        "add a record that excites more frequencies, or give the delay"
    )


def whitened_energy(residuals: Sequence[Floats], polynomial: Floats) -> float:
    """Sum of the squared residuals, whitened."""
    whitened = (lfilter(polynomial, [1.0], e) for e in residuals)
    return sum(float(e @ e) for e in whitened)


def _numbers(layout: Layout, found: Found) -> dict[str, float]:
    """Parameters of a solution by name."""
    inner = layout.full(found.search)
    numbers = {
        name: float(value) if name == "delay_s" else math.exp(value)
        for name, value in zip(layout.names, inner, strict=True)
    }
    factors = layout.factor_template.copy()
    factors[np.isnan(factors)] = found.shared
    return numbers | dict(zip(layout.factor_names, factors.tolist(), strict=True))


def _apart(estimate: Estimate, value: float, name: str) -> bool:
    if not (0.0 < estimate.std < math.inf):
        return False
    if name == "delay_s" or "gain" in name or name.startswith("numerator"):
        return abs(value - estimate.value) > _APART * estimate.std
    return abs(math.log(value / estimate.value)) > _APART * estimate.std / estimate.value
