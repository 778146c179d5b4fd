"""Transfer function fitted to a measured frequency response by weighted least squares."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.special import chdtrc

from haselab.base import Estimate, InputError, JsonObject, ResultError, checked
from haselab.base.chart import Chart
from haselab.identify.charts import lines_chart
from haselab.identify.fit import RecordFit
from haselab.identify.frequency.line_noise import IndependentLines, LineNoise, MixedLines
from haselab.identify.frequency.problem import ResponseProblem
from haselab.identify.prediction import fitted_output
from haselab.identify.projection import Solution, minimise, project
from haselab.identify.record import Record, finite_vector
from haselab.identify.transfer.layout import Layout, TransferStructure, layout_of
from haselab.models import Plant, SlowMode

__all__ = ["ResponseFit", "fit_response"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_CANDIDATES = 3
_APART = 0.15
_POOR = 10.0
_RULED_OUT = 300.0  # twice the difference of logarithmic likelihoods
_MOST_TOGETHER = 600
_LIKELY = 16.0  # twice the difference of logarithmic likelihoods, as for a transfer function
_LEAST_RATIO = 1e-2
_DIFFERENT = 5.0  # standard deviations between solutions that count as different
_LARGEST_STD = 1.0
_LARGEST_STD_TIME = 0.5
_WRONG_P = 1e-3
_HOPELESS = 10.0  # misfit relative to the given std: beyond it intervals are meaningless
_UNRELATED_P = 1e-6


@dataclass(frozen=True, kw_only=True)
class ResponseFit(RecordFit[Record]):
    """A transfer function fitted to a frequency response; see `Fit` for what all fits have.

    Its `parameters` are named as those of `TransferFit`; its `residuals` are the real parts, then
    the imaginary parts, of the lines.

    Args:
        structure: what was fitted; its `offset` and `initial_state` are not used here.
        frequency_hz: lines that were fitted, in Hz. Shape `(K,)`.
        modelled: fitted response on the lines. Shape `(K,)`.
        chi_squared_ratio: mean squared misfit over the given variance; 1 when the
            standard deviations and the structure are right.
        chi_squared_p: probability of a ratio at least as far from 1.
    """

    structure: TransferStructure
    frequency_hz: Floats = field(default_factory=lambda: np.zeros(0), repr=False)
    modelled: Complexes = field(default_factory=lambda: np.zeros(0, np.complex128), repr=False)
    chi_squared_ratio: float = math.nan
    chi_squared_p: float = math.nan

    @property
    def slow_modes(self) -> tuple[tuple[Estimate, Estimate], ...]:
        """Gain and time constant of each slow branch."""
        gains = [e for name, e in self.parameters.items() if name.startswith("slow_gain")]
        taus = [e for name, e in self.parameters.items() if name.startswith("slow_time_constant")]
        return tuple(zip(gains, taus, strict=True))

    @property
    def plant(self) -> Plant:
        """The plant with the fitted parameters; a delay estimated below zero becomes zero.

        Raises:
            ResultError: no result, a parameter is not identifiable, or not one resonance without
                zeros.
        """
        self._require()
        if self.structure.poles != 2 or self.structure.zeros:
            raise ResultError(
                f"The fit has {self.structure.poles} poles and {self.structure.zeros} zeros; a "
                "Plant needs 2 and 0. Fit again with poles = 2, zeros = 0 and slow modes."
            )
        number = {name: estimate.value for name, estimate in self.parameters.items()}
        unknown = [name for name, value in number.items() if not math.isfinite(value)]
        if unknown:
            raise ResultError(
                f"Not identifiable from these lines: {', '.join(unknown)}. A Plant needs a value "
                "for each. Give them as fixed, or fit a simpler structure."
            )
        return Plant(
            number["gain"],
            number["natural_frequency_rad_s"],
            number["damping_ratio"],
            max(number["delay_s"], 0.0),
            tuple(SlowMode(gain.value, tau.value) for gain, tau in self.slow_modes),
        )

    @checked
    def simulate(self, u: ArrayLike, rate_hz: float | None = None) -> Floats:
        """See `RecordFit`; lines have no rate, so `rate_hz` is needed."""
        inputs = finite_vector("u", u, 1)
        if rate_hz is None:
            raise InputError("A frequency response has no sampling rate. Give rate_hz.")
        return self.plant.simulate(inputs, rate_hz, np.arange(inputs.size) / rate_hz)

    def _modelled(self, record: Record) -> tuple[Floats, Floats]:
        return record.y, fitted_output(self.plant, record)

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`; magnitude and phase over frequency."""
        del names
        self._present(self.residuals or None)
        measured = self.modelled + self.residuals[0] + 1j * self.residuals[1]
        return lines_chart("Frequency response and fit", self.frequency_hz, measured, self.modelled)

    def answer(self) -> JsonObject:
        """The result under the JSON keys of a transfer function, with the chi-square test."""
        keys = ("natural_frequency_rad_s", "damping_ratio", "gain", "delay_s")
        return {
            **{key: self.parameters.get(key) for key in keys},
            "slow_modes": [{"gain": gain, "time_constant_s": tau} for gain, tau in self.slow_modes],
            "chi_squared_ratio": self.chi_squared_ratio,
            "chi_squared_p": self.chi_squared_p,
            "status": self.status,
            "notes": list(self.notes),
        }


@checked
def fit_response(
    frequency_hz: object,
    response: object,
    std: object,
    structure: TransferStructure | None = None,
    *,
    mixing: csr_array | None = None,
) -> ResponseFit:
    r"""Weighted complex least squares of a transfer function to the lines of a frequency response.

    $\min_\theta \sum_k |\hat G_k - G(i\omega_k; \theta)|^2/\sigma_k^2$

    No initial guess is needed. Neighbouring lines of one estimate share noise (overlapping windows,
    local models). With `mixing`, all lines are weighted jointly by their covariance;
    otherwise the intervals use a noise model of the misfits along frequency. The magnitude of the
    noise is estimated from the misfits in both cases.

    Args:
        frequency_hz: rising frequencies above zero, in Hz. Shape `(K,)`.
        response: complex gain. Shape `(K,)`.
        std: standard deviation of the complex gain. Lines with an infinite value are left out.
            Shape `(K,)`.
        structure: model structure. Default: one resonance with a delay.
        mixing: correlation of the errors, as `FrequencyResponse.mixing`. With it, the 600 lines
            with the largest signal-to-noise ratio are fitted. Shape `(2K, M)`.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: unequal lengths, frequencies that do not rise, a std that is not above zero,
            fewer lines than parameters to fit.
    Source: Pintelon and Schoukens, System Identification (2012), chapter 9; variable projection.
    Example:
        >>> from haselab.models import Plant
        >>> frequency_hz = np.linspace(0.1, 5.0, 50)
        >>> true = Plant(0.5, 5.11, 0.09, 0.012).frequency_response(2 * np.pi * frequency_hz)
        >>> noise = np.random.default_rng(1).normal(size=(2, 50)) @ np.eye(50) * 0.01
        >>> fit = fit_response(frequency_hz, true + noise[0] + 1j * noise[1], np.full(50, 0.0141))
        >>> low, high = fit.parameters["damping_ratio"].ci95
        >>> fit.status, low < 0.09 < high
        ('ok', True)
    """
    layout = layout_of(structure or TransferStructure())
    problem = _problem(layout, (frequency_hz, response, std), mixing)
    ends = _search(problem)
    if not ends or not ends[0][1]:
        return _no_result(layout, "the search did not converge; give more lines or fit fewer poles")
    return _describe(problem, ends)


def _problem(
    layout: Layout, lines: tuple[object, object, object], mixing: csr_array | None
) -> ResponseProblem:
    frequency_hz, response, std = lines
    at_hz = finite_vector("frequency_hz", frequency_hz, 4)
    gains: Complexes = np.asarray(response, dtype=np.complex128)
    finite_vector("response", np.abs(gains), 4)
    deviations = np.asarray(std, dtype=np.float64)
    if not at_hz.shape == gains.shape == deviations.shape:
        raise InputError(
            f"frequency_hz has {at_hz.size} values, response {gains.size} and std "
            f"{deviations.size}, but they must be equally long. Give all three for each line."
        )
    if not (at_hz[0] > 0.0 and (np.diff(at_hz) > 0.0).all()):
        raise InputError(
            f"frequency_hz begins at {at_hz[0]:g} Hz or does not rise; it must be rising "
            "frequencies above 0 Hz. Sort the lines."
        )
    if np.isnan(deviations).any() or not (deviations > 0.0).all():
        raise InputError(
            f"std contains {deviations[~(deviations > 0.0)][0]:g}; each value must be above 0, "
            "or infinite for a line to be left out."
        )
    finite = np.isfinite(deviations)
    if mixing is not None and finite.sum() > _MOST_TOGETHER:
        clarity = np.where(finite, np.abs(gains) / deviations, 0.0)
        finite[np.argsort(clarity)[:-_MOST_TOGETHER]] = False
    wanted = layout.free.size + int(np.isnan(layout.factor_template).sum())
    if finite.sum() < wanted:
        raise InputError(
            f"{finite.sum()} lines have a finite std; {wanted} parameters need at least {wanted}. "
            "Give more lines, or fit fewer poles."
        )
    if mixing is not None and mixing.shape[0] != 2 * at_hz.size:
        raise InputError(
            f"mixing has {mixing.shape[0]} rows; it must be {2 * at_hz.size}, two per line. Give "
            "the mixing of the same response."
        )
    noise: LineNoise = IndependentLines(deviations[finite])
    if mixing is not None:
        noise = MixedLines(mixing[np.tile(finite, 2)])
    s = np.asarray(2j * np.pi * at_hz[finite], dtype=np.complex128)
    return ResponseProblem(layout, s, gains[finite], math.sqrt(2.0) / deviations[finite], noise)


def _search(problem: ResponseProblem) -> list[tuple[Solution, bool]]:
    """Distinct solutions from the best initial guesses, and whether each search converged.

    A minimum at a delay that is wrong by half a period has a gain of the wrong sign, and at a low
    signal-to-noise ratio it fits nearly as well, so guesses at all delays are compared.
    """
    bounds = problem.bounds
    # Covariances between lines are expensive and hardly change the ranking of initial guesses.
    alone = replace(problem, noise=IndependentLines(math.sqrt(2.0) / problem.weight))

    def ranked(starts: Iterable[Floats]) -> list[Solution]:
        clipped = (np.clip(start, *bounds) for start in starts)
        found = (project(at, [alone.basis(at)]) for at in clipped)
        return sorted((s for s in found if math.isfinite(s.cost)), key=lambda s: s.cost)

    guesses = chain(problem.starting_points(), problem.later_starting_points())
    found = _polished(problem, alone, ranked(guesses))
    if not found or found[0][0].cost > _POOR * problem.s.size:
        again = _polished(problem, alone, ranked(problem.more_starting_points()))
        found = sorted([*found, *again], key=lambda end: end[0].cost)
    return found


def _polished(
    problem: ResponseProblem, alone: ResponseProblem, solutions: Sequence[Solution]
) -> list[tuple[Solution, bool]]:
    """Distinct solutions from the first few guesses, the best first.

    Solutions that the independent lines rule out are not refined with the full covariance.
    """
    scale = np.ones(problem.layout.free.size)
    if math.isnan(float(problem.layout.template[-1])):
        scale[-1] = problem.middle_rad_s
    chosen: list[Solution] = []
    for solution in solutions:
        gaps = [(scale * np.abs(solution.search - o.search)).max(initial=0.0) for o in chosen]
        if all(gap > _APART for gap in gaps):
            chosen.append(solution)
        if len(chosen) == _CANDIDATES * max(1, problem.layout.free.size - 2):
            break
    bounds = problem.bounds
    polished = [
        minimise(lambda search: [alone.basis(search)], start.search, bounds) for start in chosen
    ]
    if polished and isinstance(problem.noise, MixedLines):
        least = min(end.cost for end, _ in polished)
        most = least * (1.0 + _RULED_OUT / problem.s.size)
        polished = [
            minimise(lambda search: [problem.basis(search)], end.search, bounds)
            for end, _ in polished
            if end.cost <= most
        ]
    return sorted(polished, key=lambda end: end[0].cost)


def _ambiguity(
    problem: ResponseProblem,
    ends: Sequence[tuple[Solution, bool]],
    estimates: dict[str, Estimate],
    ratio: float,
) -> str | None:
    """Status naming another minimum that explains the lines as well, or None."""
    least = ends[0][0].cost
    size = problem.layout.free.size + ends[0][0].shared.size
    for other, settled in ends[1:]:
        below = (other.cost - least) / max(ratio, _LEAST_RATIO)
        if not settled or below > _LIKELY:
            continue
        numbers, _ = _estimates(problem, other, np.zeros((size, size)))
        differs = [
            name
            for name, estimate in estimates.items()
            if math.isfinite(estimate.std)
            and estimate.std > 0.0
            and abs(numbers[name].value - estimate.value) > _DIFFERENT * estimate.std
        ]
        if differs:
            shown = ", ".join(
                f"{name} {estimates[name].value:.4g} or {numbers[name].value:.4g}"
                for name in differs[:3]
            )
            return (
                f"ambiguous: two models explain the response, {shown} (likelihood ratio "
                f"{math.exp(-0.5 * max(below, 0.0)):.2g}); measure more frequencies, or give the "
                "delay"
            )
    return None


def _no_result(layout: Layout, reason: str) -> ResponseFit:
    return ResponseFit(status=f"no result: {reason}", structure=layout.structure)


def _describe(problem: ResponseProblem, ends: Sequence[tuple[Solution, bool]]) -> ResponseFit:
    layout, solution = problem.layout, ends[0][0]
    residuals, columns = solution.residuals[0], solution.columns[0]
    covariance = problem.noise.covariance(columns, residuals)
    factors = solution.shared.size
    if factors and not _related(solution.shared, covariance[-factors:, -factors:]):
        reason = "no significant response; use a larger drive or a longer record"
        return _no_result(layout, reason)
    estimates, notes = _estimates(problem, solution, covariance)
    ratio, p = problem.noise.chi_squared(columns, residuals)
    if ratio > _HOPELESS**2:
        return _no_result(
            layout,
            f"the misfits are {math.sqrt(ratio):.2g} times the given std; the std are far too "
            "small, or another structure is needed",
        )
    if p < _WRONG_P:
        size = "small" if ratio > 1.0 else "large"
        notes.append(
            f"The misfits are {math.sqrt(ratio):.2g} times the given std: the std are too {size}"
            + (", or the structure leaves something out." if ratio > 1.0 else ".")
        )
    delay = estimates["delay_s"]
    if delay.value < 0.0:
        shown = "not above zero" if delay.ci95[1] >= 0.0 else "below zero (check the clocks)"
        notes.append(f"The delay is {shown}; the plant uses 0 s.")
    modelled = problem.modelled(solution.search, solution.shared)
    status = _ambiguity(problem, ends, estimates, ratio) or "ok"
    misfit = problem.response - modelled
    return ResponseFit(
        status=status,
        structure=layout.structure,
        parameters=estimates,
        covariance=_covariance(layout, estimates, covariance),
        residuals=(misfit.real, misfit.imag),
        notes=tuple(notes),
        frequency_hz=problem.s.imag / (2.0 * math.pi),
        modelled=modelled,
        chi_squared_ratio=ratio,
        chi_squared_p=p,
    )


def _covariance(layout: Layout, estimates: dict[str, Estimate], inner: Floats) -> Floats:
    """Covariance of the numbers from that of what was searched: logarithms, but for the delay."""
    values = np.array([estimate.value for estimate in estimates.values()])
    free = np.concatenate([np.isnan(layout.template), np.isnan(layout.factor_template)])
    logarithmic = np.array([name != "delay_s" for name in layout.names])
    slope = np.ones(values.size)
    slope[: logarithmic.size][logarithmic] = values[: logarithmic.size][logarithmic]
    covariance = np.zeros((values.size, values.size))
    covariance[np.outer(free, free)] = inner.ravel()
    blind = ~np.isfinite([estimate.std for estimate in estimates.values()])
    covariance *= np.outer(np.where(blind, 0.0, slope), np.where(blind, 0.0, slope))
    covariance[blind] = covariance[:, blind] = np.inf
    return covariance


def _related(factors: Floats, covariance: Floats) -> bool:
    """Whether the gains differ significantly from zero (Wald's test)."""
    if not np.isfinite(covariance).all():
        return False
    wald = float(factors @ np.linalg.pinv(covariance, hermitian=True) @ factors)
    return float(chdtrc(factors.size, wald)) < _UNRELATED_P


def _estimates(
    problem: ResponseProblem, solution: Solution, inner: Floats
) -> tuple[dict[str, Estimate], list[str]]:
    """All parameters by name, and a note for each that is not identifiable."""
    layout = problem.layout
    low, high = problem.bounds
    searched = dict(zip(layout.free, range(layout.free.size), strict=True))
    estimates: dict[str, Estimate] = {}
    notes = []
    for i, (name, number) in enumerate(
        zip(layout.names, layout.full(solution.search), strict=True)
    ):
        unit = "rad/s" if name.endswith("_rad_s") else "s" if name.endswith("_s") else ""
        at = searched.get(i)
        std = 0.0 if at is None else math.sqrt(max(float(inner[at, at]), 0.0))
        inside = at is None or bool(low[at] < number < high[at])
        if name == "delay_s":
            most = math.pi / float(problem.s.imag.min())
            estimates[name] = Estimate.normal(number, std, unit)
        else:
            most = _LARGEST_STD_TIME if "time_constant" in name else _LARGEST_STD
            estimates[name] = Estimate.lognormal(math.exp(number), std, unit)
        if not (inside and std <= most):
            estimates[name] = Estimate(math.nan, math.inf, (-math.inf, math.inf), unit)
            notes.append(f"{name} is not identifiable from these lines.")
    free = iter(range(solution.search.size, inner.shape[0]))
    factors = iter(solution.shared)
    for name, given in zip(layout.factor_names, layout.factor_template, strict=True):
        known = not math.isnan(given)
        value = float(given) if known else float(next(factors))
        at = None if known else next(free)
        std = 0.0 if at is None else math.sqrt(max(float(inner[at, at]), 0.0))
        constant = f"{name.replace('gain', 'time_constant')}_s"
        unknown = name.startswith("slow") and not math.isfinite(estimates[constant].value)
        estimates[name] = Estimate.normal(value, std, "")
        if unknown or not math.isfinite(std):
            estimates[name] = Estimate(math.nan, math.inf, (-math.inf, math.inf), "")
            notes.append(f"{name} is not identifiable from these lines.")
    return estimates, notes
