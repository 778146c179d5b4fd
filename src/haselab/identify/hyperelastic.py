"""Hyperelastic law from stress and stretch, with the stiffness of electrodes beside it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError, ResultError
from haselab.identify.noise import coloured_covariance, r_squared
from haselab.identify.projection import Basis, Solution, minimise, project
from haselab.identify.record import finite_vector
from haselab.models import LAWS, HyperelasticLaw, law_from_parameters

__all__ = ["Candidate", "HyperelasticFit", "fit_hyperelastic"]

Floats = NDArray[np.float64]
_DEFORMATIONS = ("uniaxial", "fixed_lateral")

_ELECTRODES = ("electrode_spring_pa",)


@dataclass(frozen=True)
class Candidate:
    """One law, fitted.

    Args:
        model: name of the law.
        estimates: its numbers, and those of the electrodes when asked for.
        covariance: of the numbers, in their order. Shape `(P, P)`.
        r_squared: share of the variance that is explained.
        aic: Akaike's criterion; the lowest of the candidates is the best.
        modelled_pa: fitted nominal stress, in Pa. Shape `(N,)`.
        settled: whether the search came to rest inside its range.
    """

    model: str
    estimates: dict[str, Estimate]
    covariance: Floats
    r_squared: float
    aic: float
    modelled_pa: Floats
    settled: bool


@dataclass(frozen=True)
class HyperelasticFit:
    """The chosen law and its rivals.

    Args:
        status: "ok", or why there is no result.
        best: the chosen candidate.
        candidates: all that were fitted, the lowest criterion first.
        stretch_range: lowest and highest stretch of the data; the numbers depend on it.
        lateral_stretch: fixed lateral stretch; None for uniaxial data.
    """

    status: str
    best: Candidate
    candidates: tuple[Candidate, ...]
    stretch_range: tuple[float, float]
    lateral_stretch: float | None

    @property
    def succeeded(self) -> bool:
        """Whether the numbers may be used."""
        return self.status == "ok"

    @property
    def law(self) -> HyperelasticLaw:
        """The chosen law with its fitted numbers, without the electrode spring.

        Raises:
            ResultError: the fit has no result.
        """
        if not self.succeeded:
            raise ResultError(f"The fit has no result: {self.status}")
        numbers = {
            name: estimate.value
            for name, estimate in self.best.estimates.items()
            if name not in (*_ELECTRODES, "chain_segments")
        }
        return law_from_parameters(self.best.model, numbers)

    def answer(self) -> dict[str, Any]:
        """The keys of the public contract."""
        return {
            "model": self.best.model,
            "parameters": dict(self.best.estimates),
            "stretch_range": list(self.stretch_range),
            "lateral_stretch": self.lateral_stretch,
            "r_squared": self.best.r_squared,
            "aic": self.best.aic,
            "candidates": [
                {
                    "model": candidate.model,
                    "aic": candidate.aic,
                    "r_squared": candidate.r_squared,
                    "parameters": dict(candidate.estimates),
                }
                for candidate in self.candidates
            ],
            "status": self.status,
        }


@dataclass(frozen=True)
class _Shape:
    """How a law depends on its one nonlinear number, searched without bounds of its own."""

    name: str
    factor: str
    low: float
    high: float
    to_number: Callable[[float], float]
    slope: Callable[[float], float]


def fit_hyperelastic(
    stretch: object,
    nominal_stress_pa: object,
    model: str = "auto",
    *,
    deformation: str = "uniaxial",
    lateral_stretch: float = 3.0,
    electrode_natural: float | None = None,
) -> HyperelasticFit:
    r"""Least squares of nominal stress, the modulus solved for, the shape number searched.

    $\min \sum_i (P_i - P(\lambda_i) - k\,(\lambda_i - \lambda_e))^2$

    The last term is that of the electrodes, natural at $\lambda_e$, if it is asked for.

    Args:
        stretch: stretch along the length, 1 at the natural length. Shape `(N,)`.
        nominal_stress_pa: force over natural cross-section, in Pa. Shape `(N,)`.
        model: name of a law, or "auto" for all of them and the lowest AIC.
        deformation: "uniaxial" (the width is free) or "fixed_lateral".
        lateral_stretch: the fixed lateral stretch, where the width is clamped.
        electrode_natural: stretch at which electrodes bonded to the sheet are free of force; their
            linear spring is then fitted beside the law. None: no electrodes.
    Returns:
        The chosen law and all candidates.
    Raises:
        InputError: unequal lengths, a stretch not above zero, unknown names.
    Source: unweighted least squares; Akaike, IEEE Trans. Autom. Control 19 (1974), 716.
    Example:
        >>> from haselab.models import Ogden
        >>> stretch = np.linspace(1.0, 3.0, 40)
        >>> noise_pa = 20.0 * np.random.default_rng(2).normal(size=40)
        >>> fit = fit_hyperelastic(stretch, Ogden(15e3, 2.4).nominal_stress_pa(stretch) + noise_pa)
        >>> fit.best.r_squared > 0.999
        True
    """
    x, y = finite_vector("stretch", stretch, 6), finite_vector("stress", nominal_stress_pa, 6)
    if x.size != y.size:
        raise InputError(
            f"stretch has {x.size} values and nominal_stress_pa {y.size}; allowed are equal "
            "lengths. Give one stress for each stretch."
        )
    if not (x > 0.0).all() or np.ptp(x) == 0.0:
        raise InputError(
            f"stretch lies in [{x.min():g}, {x.max():g}]; allowed are values above 0 that differ "
            "(1 is the natural length). Give stretch, not strain."
        )
    if model != "auto" and model not in LAWS:
        raise InputError(f"model = {model}; allowed are auto, {', '.join(LAWS)}. Choose one.")
    if deformation not in _DEFORMATIONS:
        raise InputError(
            f"deformation = {deformation}; allowed are {', '.join(_DEFORMATIONS)}. Choose one."
        )
    lateral = lateral_stretch if deformation == "fixed_lateral" else None
    names = list(LAWS) if model == "auto" else [model]
    fitted = [_fit_law(name, x, y, lateral, electrode_natural) for name in names]
    fitted.sort(key=lambda candidate: (not candidate.settled, candidate.aic))
    best = fitted[0]
    status = "ok"
    if not best.settled:
        status = f"no result: {best.model} ran to the end of its range; take a wider stretch range"
    elif not best.r_squared > 0.0:
        status = "no result: no law explains the data better than their mean; check the columns"
    return HyperelasticFit(status, best, tuple(fitted), (float(x.min()), float(x.max())), lateral)


def _shape_of(name: str, x: Floats, lateral: float | None) -> _Shape | None:
    """The nonlinear number of a law; None for laws that are linear in all of them."""
    side = 1.0 / np.sqrt(x) if lateral is None else np.full(x.size, lateral)
    invariant = float((x**2 + side**2 + 1.0 / (x * side) ** 2).max())
    if name in ("arruda-boyce", "gent"):
        # Above the largest value that the data need: limit (1 + e^s).
        label = "lambda_m" if name == "arruda-boyce" else "jm"
        limit = math.sqrt(invariant / 3.0) if name == "arruda-boyce" else invariant - 3.0
        return _Shape(
            label, "mu_pa", -9.0, 7.0,
            lambda s: limit * (1.0 + math.exp(s)), lambda s: limit * math.exp(s),
        )  # fmt: skip
    if name == "arruda-boyce-series":
        reach = math.sqrt(invariant / 3.0)
        return _Shape(
            "lambda_m", "mu_pa", -3.0, 7.0,
            lambda s: reach * math.exp(s), lambda s: reach * math.exp(s),
        )  # fmt: skip
    if name == "ogden":
        return _Shape("alpha", "mu_pa", 0.05, 20.0, lambda s: s, lambda s: 1.0)
    return None


def _linear_names(name: str) -> list[str]:
    return {"neo-hooke": ["mu_pa"], "yeoh": ["c10_pa", "c20_pa", "c30_pa"],
            "yeoh-2": ["c10_pa", "c20_pa"]}.get(name, ["mu_pa"])  # fmt: skip


def _basis(
    name: str, shape: _Shape | None, search: Floats, x: Floats, y: Floats,
    lateral: float | None, spring: float | None,
) -> Basis:  # fmt: skip
    """Stress of each linear number set to 1, with the shape number of the search."""
    linear = _linear_names(name)

    def columns(s: float | None) -> Floats:
        fixed = {} if s is None or shape is None else {shape.name: shape.to_number(s)}
        unit = [{n: float(n == chosen) for n in linear} for chosen in linear]
        stress = [law_from_parameters(name, {**u, **fixed}).nominal_stress_pa(x, lateral)
                  for u in unit]  # fmt: skip
        if spring is not None:
            stress.append(x - spring)
        return np.stack(stress, axis=1)

    known, known_slope = np.zeros(x.size), np.zeros((search.size, x.size))
    if shape is None:
        values = columns(None)
        slopes = np.zeros((0, *values.shape))
    else:
        # Central difference; its error of 1e-10 moves an interval, not the estimate.
        step, s = 1e-5, float(search[0])
        values = columns(s)
        slopes = ((columns(s + step) - columns(s - step)) / (2.0 * step))[None]
    return Basis(y, values, np.zeros((x.size, 0)), slopes, known, known_slope)


def _fit_law(
    name: str, x: Floats, y: Floats, lateral: float | None, spring: float | None
) -> Candidate:
    """Grid of the shape number, then Gauss-Newton."""
    shape = _shape_of(name, x, lateral)

    def evaluate(search: Floats) -> list[Basis]:
        return [_basis(name, shape, search, x, y, lateral, spring)]

    if shape is None:
        solution, settled = minimise(evaluate, np.zeros(0), (np.zeros(0), np.zeros(0)))
    else:
        low, high = np.array([shape.low]), np.array([shape.high])
        grid = np.linspace(shape.low, shape.high, 33)[1:-1]
        starts = [project(np.array([s]), evaluate(np.array([s]))) for s in grid]
        best = min(starts, key=lambda candidate: candidate.cost)
        solution, settled = minimise(evaluate, best.search, (low, high))
        inside = shape.low + 1e-6 < solution.search[0] < shape.high - 1e-6
        settled = settled and bool(inside)
    return _candidate(name, shape, solution, x, y, spring, settled)


def _candidate(
    name: str, shape: _Shape | None, solution: Solution, x: Floats, y: Floats,
    spring: float | None, settled: bool,
) -> Candidate:  # fmt: skip
    order = np.argsort(x, kind="stable")
    count = solution.search.size + solution.shared.size
    covariance = coloured_covariance(
        [solution.columns[0][order]], [solution.residuals[0][order]], count
    )
    names = [*_linear_names(name), *(_ELECTRODES if spring is not None else ())]
    values = list(solution.shared)
    if shape is not None:
        slope = np.ones(count)
        slope[0] = shape.slope(float(solution.search[0]))
        covariance = np.roll(covariance * np.outer(slope, slope), -1, axis=(0, 1))
        names.append(shape.name)
        values.append(shape.to_number(float(solution.search[0])))
    std = np.sqrt(np.diag(covariance))
    estimates = {
        n: Estimate.normal(v, s, "Pa" if n.endswith("_pa") else "")
        for n, v, s in zip(names, values, std, strict=True)
    }
    if shape is not None and shape.name == "lambda_m":
        stretch_limit = estimates["lambda_m"]
        estimates["chain_segments"] = Estimate.normal(
            stretch_limit.value**2, 2.0 * stretch_limit.value * stretch_limit.std, ""
        )
    modelled = y - solution.residuals[0]
    mean_square = max(solution.cost / x.size, 1e-300)
    aic = x.size * math.log(mean_square) + 2.0 * (count + 1)
    return Candidate(name, estimates, covariance, r_squared(y, modelled), aic, modelled, settled)
