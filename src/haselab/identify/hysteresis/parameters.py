"""Convert a solved hysteresis problem to parameters in physical units, with intervals."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate
from haselab.identify.fit import rescaled
from haselab.identify.hysteresis.bouc_wen import BoucWenFamily, bouc_wen_model
from haselab.identify.hysteresis.prandtl_ishlinskii import PlayFamily, play_model
from haselab.identify.hysteresis.problem import (
    LEAST_GAIN,
    Family,
    HysteresisProblem,
    Numbers,
    Scale,
)
from haselab.identify.noise import coloured_covariance
from haselab.models.hysteresis.common import Hysteresis

__all__ = ["hysteresis_estimates", "model_of"]

Floats = NDArray[np.float64]
_LARGEST_STD = 3.0  # of an identifiable positive parameter, relative
_AT_BOUND = 1e-3


def model_of(family: Family, numbers: Numbers, scale: Scale) -> Hysteresis:
    """Convert the parameters to a model in physical units.

    Args:
        family: memory model.
        numbers: scaled parameters.
        scale: scaling of the problem.
    Returns:
        The model.
    """
    if isinstance(family, PlayFamily):
        return play_model(family, numbers, scale)
    return bouc_wen_model(numbers, scale)


def _names(family: Family, numbers: Numbers) -> list[str]:
    """Names of the parameters, in the order of `Numbers.vector`."""
    zones = [f"dead_zone_slope_{k + 1}" for k in range(numbers.bends.size)]
    if isinstance(family, PlayFamily):
        count = range(1, family.count + 1)
        search = [f"threshold_{k}" for k in count] + ["rate_dependence_s"] * family.rated
        return [*search, "offset", "gain", *(f"weight_{k}" for k in count), *zones]
    search = ["sharpness", "sigma", "exponent"][: numbers.search.size]
    return [*search, "offset", "gain", "weight", *zones]


def _to_physical(family: Family, numbers: Numbers, scale: Scale) -> Floats:
    """Derivative of the physical with respect to the scaled parameters. Shape `(P, P)`."""
    size = numbers.vector.size
    at, memories, zones = numbers.search.size, numbers.factors.size, numbers.bends.size
    ratio = scale.half_y / scale.half_u
    matrix = np.eye(size)
    factors = slice(at + 2, at + 2 + memories)
    offset, gain = at, at + 1
    matrix[offset, offset], matrix[gain, gain] = scale.half_y, ratio
    matrix[offset, gain] = -ratio * scale.middle_u
    if isinstance(family, PlayFamily):
        thresholds = np.arange(family.count)
        matrix[thresholds, thresholds] = scale.half_u
        matrix[offset, factors] = -ratio * scale.middle_u
        matrix[factors, factors] = ratio * np.eye(memories)
    else:
        matrix[0, 0] = math.exp(numbers.search[0]) / scale.half_u
        matrix[factors, factors] = scale.half_y * np.eye(memories)
    inverse = np.diag(-1.0 / numbers.bends**2)
    matrix[size - zones :, size - zones :] = inverse if scale.half_y > 0.0 else inverse[::-1]
    return matrix


def _values(family: Family, numbers: Numbers, scale: Scale) -> Floats:
    """Physical parameters in the order of `Numbers.vector`."""
    search = numbers.search.copy()
    ratio = scale.half_y / scale.half_u
    moved = numbers.gain
    if isinstance(family, PlayFamily):
        search[: family.count] *= scale.half_u
        factors = numbers.factors * ratio
        moved += float(numbers.factors.sum())
    else:
        search[0] = math.exp(search[0]) / scale.half_u
        factors = numbers.factors * scale.half_y
    offset = scale.middle_y + scale.half_y * numbers.offset - ratio * moved * scale.middle_u
    zones = 1.0 / (numbers.bends if scale.half_y > 0.0 else numbers.bends[::-1])
    return np.concatenate([search, [offset, ratio * numbers.gain], factors, zones])


def hysteresis_estimates(
    problem: HysteresisProblem, family: Family, numbers: Numbers
) -> tuple[dict[str, Estimate], Floats]:
    """All parameters with intervals, and their covariance.

    Those at a bound or beyond the data's reach are NaN.

    Args:
        problem: records and rows.
        family: memory model.
        numbers: the solution.
    Returns:
        Estimates by name, play operators in the order of their thresholds, and the covariance in
        the same order, infinite where a number is NaN.
    """
    residuals, columns = problem.linearised(family, numbers)
    inner = coloured_covariance(
        np.split(columns, problem.ends), np.split(residuals, problem.ends), numbers.vector.size
    )
    matrix = _to_physical(family, numbers, problem.scale)
    blind = ~np.isfinite(np.diag(inner))
    inner = np.where(np.isfinite(inner), inner, 0.0)
    blind |= _at_bound(family, numbers)
    covariance = matrix @ inner @ matrix.T
    lost = (np.abs(matrix[:, blind]) > 0.0).any(axis=1)
    std = np.where(lost, math.inf, np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    values = _values(family, numbers, problem.scale)
    names = _names(family, numbers)
    estimates = {
        name: _estimate(name, value, spread)
        for name, value, spread in zip(names, values, std, strict=True)
    }
    order = np.arange(len(names))
    if isinstance(family, PlayFamily):
        estimates, order = _ordered(estimates, numbers.search[: family.count])
    spread = np.array([entry.std for entry in estimates.values()])
    return estimates, rescaled(covariance[np.ix_(order, order)], spread)


def _at_bound(family: Family, numbers: Numbers) -> NDArray[np.bool_]:
    """Searched parameters at a bound, except an exponent or a sigma, which may be there."""
    marks = np.zeros(numbers.vector.size, dtype=bool)
    low, high = family.bounds()
    near = _AT_BOUND * np.where(np.isfinite(high), high - low, 1.0)
    marks[: numbers.search.size] = numbers.search > high - near
    marks[numbers.search.size + 1] = numbers.gain <= LEAST_GAIN
    if isinstance(family, BoucWenFamily):
        marks[0] |= bool(numbers.search[0] < low[0] + near[0])
    return marks


def _estimate(name: str, value: float, std: float) -> Estimate:
    unit = "s" if name.endswith("_s") else ""
    positive = name.startswith(("threshold", "sharpness", "sigma", "exponent"))
    if not math.isfinite(std) or (positive and std > _LARGEST_STD * abs(value)):
        return Estimate(math.nan, math.inf, (-math.inf, math.inf), unit)
    return Estimate.normal(value, std, unit)


def _ordered(
    estimates: dict[str, Estimate], thresholds: Floats
) -> tuple[dict[str, Estimate], NDArray[np.intp]]:
    """Play operators renumbered by threshold, and the place that each number had before."""
    before = {name: name for name in ("gain", "offset")}
    for number, k in enumerate(np.argsort(thresholds) + 1, start=1):
        for what in ("threshold", "weight"):
            before[f"{what}_{number}"] = f"{what}_{k}"
    before |= {name: name for name in estimates if name not in before}
    places = list(estimates)
    order = np.array([places.index(name) for name in before.values()])
    return {name: estimates[old] for name, old in before.items()}, order
