"""Fit one hyperelastic law to several tests: moduli solved for, shape parameters searched."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate
from haselab.identify.independent import spread_of, student_estimate
from haselab.identify.noise import r_squared
from haselab.identify.projection import Basis, Solution, minimise
from haselab.models import law_from_parameters

__all__ = ["ELECTRODE_NAMES", "Candidate", "Electrodes", "Sample", "fit_law"]

Floats = NDArray[np.float64]
ELECTRODE_NAMES = ("electrode_spring_pa", "electrode_cubic_pa")
_EXPONENTS = (-10.0, 20.0)
_ONE_EXPONENT = (0.05, 20.0)  # one term of negative exponent is far too stiff in biaxial tension
_LEAST_APART = 0.1  # of two exponents: closer ones count as one term
_LARGEST_STD = 0.5  # of a limiting stretch, relative; above, its interval is infinite
_WIDEST = 10.0  # largest half interval of an identifiable exponent
_GROUPS = 40  # samples of a test for the many starts
_POLISHED = 4
_EDGE = 1e-6


@dataclass(frozen=True)
class Electrodes:
    """Electrodes bonded to the sheet: a spring parallel to the sheet.

    Args:
        natural: stretch of the length at which they are free of force.
        stiffening: whether a cubic term of that spring is fitted too.
    """

    natural: float
    stiffening: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Of the fitted parameters, in Pa for each unit of stretch, or of its cube."""
        return ELECTRODE_NAMES if self.stiffening else ELECTRODE_NAMES[:1]

    def columns(self, length: Floats) -> list[Floats]:
        """Stress for each parameter set to 1; `length` has shape `(N,)`."""
        beyond = length - self.natural
        return [beyond, beyond**3][: len(self.names)]


@dataclass(frozen=True)
class Sample:
    """One test in the order of its stretch.

    Args:
        stretch: as recorded. Shape `(N,)`.
        length: stretch along the length, from the natural length. Shape `(N,)`.
        width: stretch across the width. Shape `(N,)`.
        stress_pa: nominal stress. Shape `(N,)`.
    """

    stretch: Floats
    length: Floats
    width: Floats
    stress_pa: Floats

    def taken(self, rows: NDArray[np.bool_]) -> Sample:
        """The marked rows."""
        return Sample(self.stretch[rows], self.length[rows], self.width[rows], self.stress_pa[rows])

    def grouped(self) -> Sample:
        """Means of neighbours, few enough to try many starting points."""
        parts = np.array_split(np.arange(self.stretch.size), min(_GROUPS, self.stretch.size))
        columns = (self.stretch, self.length, self.width, self.stress_pa)
        return Sample(*(np.array([column[part].mean() for part in parts]) for column in columns))


@dataclass(frozen=True)
class Candidate:
    """One law, fitted.

    Args:
        model: name of the law.
        parameters: its parameters and those of the electrodes, if fitted; one that is not
            identifiable is NaN with an infinite interval.
        numbers: the same parameters as used by the fitted curve, identifiable or not.
        covariance: of `numbers`, in their order, linearised about the fit. Shape `(P, P)`.
        r_squared: share of the variance that is explained.
        aic: Akaike's criterion.
        aicc: the same, corrected for few samples; the lowest of the candidates is the best.
        bic: Schwarz's criterion.
        modelled_pa: fitted nominal stress of each test in the order given, in Pa.
        settled: whether the search converged at a curve, not at the end of its range.
        softens_at: recorded stretch within the range from which the stress falls; None: nowhere.
    """

    model: str
    parameters: dict[str, Estimate]
    numbers: dict[str, float]
    covariance: Floats
    r_squared: float
    aic: float
    aicc: float
    bic: float
    modelled_pa: tuple[Floats, ...]
    settled: bool
    softens_at: float | None = None


@dataclass(frozen=True)
class _Shape:
    """The nonlinear parameters of a law, transformed so that the search needs no bounds."""

    names: tuple[str, ...]
    low: Floats
    high: Floats
    to_number: Callable[[float], float]
    slope: Callable[[float], float]

    @property
    def exponents(self) -> bool:
        """Whether they are exponents; one at the end of its range is then not identifiable."""
        return self.names[0].startswith("alpha")


def _growing(limit: float) -> tuple[Callable[[float], float], Callable[[float], float]]:
    """Map an unbounded parameter to one above `limit`; return the map and its slope."""
    return (lambda s: limit * (1.0 + math.exp(s))), (lambda s: limit * math.exp(s))


def _shape_of(name: str, samples: Sequence[Sample]) -> _Shape | None:
    """The nonlinear parameters of a law; None for laws that are linear in all of them."""
    invariant = max(
        float((t.length**2 + t.width**2 + 1.0 / (t.length * t.width) ** 2).max()) for t in samples
    )
    reach = math.sqrt(invariant / 3.0)
    if name in ("arruda-boyce", "gent"):
        # Larger than any value that the data require.
        label = "lambda_m" if name == "arruda-boyce" else "jm"
        limit = reach if name == "arruda-boyce" else invariant - 3.0
        return _Shape((label,), np.array([-9.0]), np.array([14.0]), *_growing(limit))
    if name == "arruda-boyce-series":

        def grown(s: float) -> float:
            return reach * math.exp(s)

        return _Shape(("lambda_m",), np.array([-3.0]), np.array([7.0]), grown, grown)
    if name.startswith("ogden"):
        count = _terms(name)
        names = ("alpha",) if count == 1 else tuple(f"alpha{i + 1}" for i in range(count))
        low, high = _ONE_EXPONENT if count == 1 else _EXPONENTS
        return _Shape(names, np.full(count, low), np.full(count, high), lambda s: s, lambda s: 1.0)
    return None


def _terms(name: str) -> int:
    """Number of terms of an Ogden law."""
    return int(name.partition("-")[2] or 1)


def _linear_names(name: str) -> list[str]:
    if name.startswith("ogden-"):
        return [f"mu{i + 1}_pa" for i in range(_terms(name))]
    return {"yeoh": ["c10_pa", "c20_pa", "c30_pa"], "yeoh-2": ["c10_pa", "c20_pa"]}.get(
        name, ["mu_pa"]
    )


def _columns(
    name: str, shape: _Shape | None, search: Floats, test: Sample, electrodes: Electrodes | None
) -> Floats:
    """Stress for each linear parameter set to 1, at given shape parameters."""
    linear = _linear_names(name)
    fixed = {}
    if shape is not None:
        values = [shape.to_number(float(s)) for s in search]
        fixed = dict(zip(shape.names, values, strict=True))
    units = [{other: float(other == chosen) for other in linear} for chosen in linear]
    stress = [
        law_from_parameters(name, {**unit, **fixed}).nominal_stress_pa(test.length, test.width)
        for unit in units
    ]
    if electrodes is not None:
        stress += electrodes.columns(test.length)
    return np.stack(stress, axis=1)


def _bases(
    name: str, shape: _Shape | None, electrodes: Electrodes | None, samples: Sequence[Sample],
    search: Floats,
) -> list[Basis]:  # fmt: skip
    found = []
    for test in samples:
        values = _columns(name, shape, search, test, electrodes)
        slopes = np.zeros((search.size, *values.shape))
        for k in range(search.size):
            # Central difference; its error of 1e-10 affects an interval, not the estimate.
            step = np.zeros(search.size)
            step[k] = 1e-5
            above, below = (
                _columns(name, shape, search + way * step, test, electrodes) for way in (1.0, -1.0)
            )
            slopes[k] = (above - below) / 2e-5
        none, flat = np.zeros((test.length.size, 0)), np.zeros((search.size, test.length.size))
        found.append(Basis(test.stress_pa, values, none, slopes, np.zeros(test.length.size), flat))
    return found


def fit_law(name: str, samples: Sequence[Sample], electrodes: Electrodes | None) -> Candidate:
    """Fit one law: grid of the shape parameters, then Gauss-Newton.

    Args:
        name: of the law.
        samples: the tests; they share all parameters.
        electrodes: fitted together with the law, or None.
    Returns:
        The fitted law.
    """
    shape = _shape_of(name, samples)
    evaluate = partial(_bases, name, shape, electrodes, samples)
    if shape is None:
        solution, settled = minimise(evaluate, np.zeros(0), (np.zeros(0), np.zeros(0)))
        return _candidate(name, None, solution, samples, electrodes, settled)
    few = [test.grouped() for test in samples]
    several, bounds = len(shape.names) > 1, (shape.low, shape.high)
    rough = partial(_bases, name, shape, electrodes, few)
    starts = _starts(name, shape, few, electrodes)[: _POLISHED if several else 1]
    polished = [minimise(rough, start, bounds)[0] for start in starts]
    # A term of negative modulus can be unstable; then the best law has one term less.
    polished = [s for s in polished if not several or _positive(s, shape)]
    if not polished:
        return _with_idle_term(name, fit_law(_fewer_terms(name), samples, electrodes))
    best = min(polished, key=lambda candidate: candidate.cost)
    solution, settled = minimise(evaluate, best.search, bounds, iterations=200)
    if several and not _positive(solution, shape):
        return _with_idle_term(name, fit_law(_fewer_terms(name), samples, electrodes))
    at_low = bool((solution.search < shape.low + _EDGE).any())
    return _candidate(
        name, shape, _ordered(solution, len(shape.names)), samples, electrodes,
        settled and (shape.exponents or not at_low),
    )  # fmt: skip


def _starts(
    name: str, shape: _Shape, samples: Sequence[Sample], electrodes: Electrodes | None
) -> list[Floats]:
    """Starting points of lowest cost first; for several terms those with positive moduli."""
    target = np.concatenate([test.stress_pa for test in samples])
    several, found = len(shape.names) > 1, []
    for search in _grid(shape):
        columns = np.vstack([_columns(name, shape, search, test, electrodes) for test in samples])
        factors = np.linalg.lstsq(columns, target, rcond=None)[0]
        if not several or (factors[: len(shape.names)] > 0.0).all():
            found.append((float(((target - columns @ factors) ** 2).sum()), search))
    return [search for _, search in sorted(found, key=lambda pair: pair[0])]


def _positive(solution: Solution, shape: _Shape) -> bool:
    """Whether the moduli of all terms are positive."""
    return bool((solution.shared[: len(shape.names)] > 0.0).all())


def _fewer_terms(name: str) -> str:
    """Name of the Ogden law with one term fewer."""
    count = _terms(name) - 1
    return "ogden" if count == 1 else f"ogden-{count}"


def _with_idle_term(name: str, fewer: Candidate) -> Candidate:
    """The law with one more term of zero modulus, since no other term improves the fit."""
    count = _terms(name)
    single = {"mu_pa": "mu1_pa", "alpha": "alpha1"}
    extra = {f"mu{count}_pa": 0.0, f"alpha{count}": 2.0}
    estimates = {single.get(k, k): v for k, v in fewer.parameters.items()}
    estimates |= {label: _unknown("Pa" if "_pa" in label else "") for label in extra}
    numbers = {single.get(k, k): v for k, v in fewer.numbers.items()} | extra
    size = len(fewer.numbers)
    covariance = np.full((size + 2, size + 2), np.inf)
    covariance[:size, :size] = fewer.covariance
    samples = sum(part.size for part in fewer.modelled_pa)
    likelihood = fewer.aic - 2.0 * (size + 1)
    return Candidate(
        name, estimates, numbers, covariance, fewer.r_squared,
        *_criteria(likelihood, samples, size + 2), fewer.modelled_pa, fewer.settled,
    )  # fmt: skip


def _unknown(unit: str) -> Estimate:
    """Estimate of a parameter that is not identifiable."""
    return Estimate(math.nan, math.inf, (-math.inf, math.inf), unit)


def _grid(shape: _Shape) -> list[Floats]:
    """Starting points: 31 for one parameter; rising combinations for several exponents."""
    count = len(shape.names)
    if count == 1:
        return [np.array([s]) for s in np.linspace(shape.low[0], shape.high[0], 33)[1:-1]]
    few = (-8.0, -5.0, -3.0, -2.0, -1.0, 0.5, 1.3, 2.0, 3.0, 4.5, 6.5, 9.0, 13.0)
    return [np.array(chosen) for chosen in itertools.combinations(few, count)]


def _ordered(solution: Solution, count: int) -> Solution:
    """Sort the terms by rising exponent."""
    order = np.argsort(solution.search)
    if count == 1 or (np.diff(order) > 0).all():
        return solution
    factors = np.concatenate([order, np.arange(count, solution.shared.size)])
    columns = np.concatenate([order, count + factors])
    return Solution(
        solution.search[order], solution.shared[factors], solution.own, solution.residuals,
        tuple(part[:, columns] for part in solution.columns), solution.cost,
    )  # fmt: skip


def _candidate(
    name: str, shape: _Shape | None, solution: Solution, samples: Sequence[Sample],
    electrodes: Electrodes | None, settled: bool,
) -> Candidate:  # fmt: skip
    names = [*_linear_names(name), *(electrodes.names if electrodes is not None else ())]
    numbers = dict(zip(names, (float(f) for f in solution.shared), strict=True))
    searched = solution.search.size
    count = searched + solution.shared.size
    free = np.ones(count, dtype=bool)
    scale = np.ones(count)
    if shape is not None:
        # A parameter at the end of its range has no slope from which to estimate its spread.
        inside = (solution.search > shape.low + _EDGE) & (solution.search < shape.high - _EDGE)
        free[:searched] = inside
        scale[:searched] = [shape.slope(float(s)) for s in solution.search]
        for label, s in zip(shape.names, solution.search, strict=True):
            numbers[label] = shape.to_number(float(s))
    covariance = np.full((count, count), np.inf)
    within, quantile = spread_of(
        [part[:, free] for part in solution.columns], solution.residuals, count
    )
    covariance[np.ix_(free, free)] = within * np.outer(scale, scale)[np.ix_(free, free)]
    order = np.concatenate([np.arange(searched, count), np.arange(searched)])
    covariance = covariance[np.ix_(order, order)]
    std = dict(zip(numbers, np.sqrt(np.maximum(np.diag(covariance), 0.0)), strict=True))
    unknown = _not_identifiable(numbers, std)
    estimates = {
        label: student_estimate(value, std[label], quantile, "Pa" if label.endswith("_pa") else "")
        if label not in unknown
        else _unknown("Pa" if label.endswith("_pa") else "")
        for label, value in numbers.items()
    }
    if "lambda_m" in numbers:
        limit = estimates["lambda_m"]
        estimates["chain_segments"] = (
            _unknown("") if "lambda_m" in unknown
            else student_estimate(limit.value**2, 2.0 * limit.value * limit.std, quantile, "")
        )  # fmt: skip
    modelled = tuple(t.stress_pa - e for t, e in zip(samples, solution.residuals, strict=True))
    measured = np.concatenate([test.stress_pa for test in samples])
    likelihood = measured.size * math.log(max(solution.cost / measured.size, 1e-300))
    return Candidate(
        name, estimates, numbers, covariance, r_squared(measured, np.concatenate(modelled)),
        *_criteria(likelihood, measured.size, count), modelled, settled,
    )  # fmt: skip


def _not_identifiable(numbers: dict[str, float], std: dict[str, float]) -> set[str]:
    """Names of the parameters that are not identifiable."""
    found = {label for label in numbers if not math.isfinite(std[label])}
    for label in ("lambda_m", "jm"):
        # These parameters are above a limit: an interval down to zero means one up to infinity.
        if label in numbers and not std[label] < _LARGEST_STD * numbers[label]:
            found.add(label)
    exponents = [label for label in numbers if label.startswith("alpha")]
    for label in exponents:
        apart = min(
            (abs(numbers[label] - numbers[other]) for other in exponents if other != label),
            default=math.inf,
        )
        if not 1.96 * std[label] < _WIDEST or apart < _LEAST_APART:
            found.add(label)
            if len(exponents) > 1:
                found.add(label.replace("alpha", "mu") + "_pa")
    return found


def _criteria(likelihood: float, samples: int, numbers: int) -> tuple[float, float, float]:
    """AIC, AICc and BIC; the variance of the noise counts as a parameter.

    `likelihood` is twice the negative logarithm of the likelihood, without its constant.
    """
    unknowns = numbers + 1
    aic = likelihood + 2.0 * unknowns
    spare = samples - unknowns - 1
    correction = 2.0 * unknowns * (unknowns + 1) / spare if spare > 0 else math.inf
    return aic, aic + correction, likelihood + math.log(samples) * unknowns
