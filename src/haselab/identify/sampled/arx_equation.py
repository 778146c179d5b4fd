"""Least squares of a difference equation, and the choice of its orders."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, check_fields
from haselab.identify.noise import coloured_covariance
from haselab.identify.sampled.arx_bias import regressors

__all__ = ["ArxOrders", "Solved", "chosen_orders", "criteria_of", "has_constant", "solve"]

Floats = NDArray[np.float64]
_MOST = {"na": 12, "nb": 64, "nk": 1000}
_SEARCH_ORDER = 4
SEARCH_DELAY = 12
_CONSTANT = 2.5  # standard deviations of a constant that is part of the equation


@dataclass(frozen=True)
class ArxOrders:
    """Size of a difference equation.

    Args:
        na: number of earlier outputs.
        nb: number of inputs.
        nk: delay in samples from an input to the first output that depends on it.
    Raises:
        InputError: an order out of range.
    """

    na: int = 2
    nb: int = 2
    nk: int = 1

    def __post_init__(self) -> None:
        check_fields(self)
        for name, least in (("na", 0), ("nb", 1), ("nk", 0)):
            value, most = getattr(self, name), _MOST[name]
            if not least <= value <= most:
                raise InputError(f"{name} = {value}; it must be {least} to {most}.")

    @property
    def memory(self) -> int:
        """Number of samples before the first predicted one."""
        return max(self.na, self.nb + self.nk - 1)

    @property
    def numbers(self) -> tuple[int, int, int]:
        """na, nb and nk."""
        return self.na, self.nb, self.nk


@dataclass(frozen=True)
class Solved:
    """Least-squares solution.

    Args:
        coefficients: `a`, then `b`.
        covariance: of them.
        errors: prediction errors.
        columns: regressors. Shape `(M, P)`, with a column of ones if there is a constant.
        constant: the constant of the equation and its standard deviation; 0 if it has none.
    """

    coefficients: Floats
    covariance: Floats
    errors: Floats
    columns: Floats
    constant: tuple[float, float] = (0.0, math.inf)

    @cached_property
    def coloured_covariance(self) -> Floats:
        """Covariance of the coefficients for coloured prediction errors."""
        wide = coloured_covariance([self.columns], [self.errors], self.columns.shape[1])
        return wide[: self.coefficients.size, : self.coefficients.size]


def solve(u: Floats, y: Floats, orders: ArxOrders, *, constant: bool) -> Solved:
    """Solve the difference equation for its coefficients by least squares.

    Args:
        u: inputs. Shape `(N,)`.
        y: outputs. Shape `(N,)`.
        orders: size of the equation.
        constant: whether the equation has a constant.
    Returns:
        The solution; coefficients that the record does not determine have an infinite variance.
    """
    columns = regressors(u, y, orders.numbers, orders.memory)
    columns = np.hstack([columns, np.ones((columns.shape[0], int(constant)))])
    target = y[orders.memory :]
    scale = np.sqrt((columns**2).sum(axis=0))
    scale[scale == 0.0] = 1.0
    left, sizes, right = np.linalg.svd(columns / scale, full_matrices=False)
    regular = sizes > 1e-12 * sizes[0]
    sizes = np.where(regular, sizes, np.inf)
    coefficients = right.T @ ((left.T @ target) / sizes) / scale
    errors = target - columns @ coefficients
    freedom = max(target.size - coefficients.size, 1)
    covariance = (right.T / sizes**2) @ right * float(errors @ errors) / freedom
    blind = (np.abs(right[~regular]) > 1e-6).any(axis=0)
    covariance[blind, blind] = np.inf
    covariance = covariance / np.outer(scale, scale)
    if not constant:
        return Solved(coefficients, covariance, errors, columns)
    fitted = float(coefficients[-1]), math.sqrt(max(float(covariance[-1, -1]), 0.0))
    return Solved(coefficients[:-1], covariance[:-1, :-1], errors, columns, fitted)


def has_constant(u: Floats, y: Floats, orders: ArxOrders) -> bool:
    """Return whether the equation needs a constant: the record begins far from its means.

    Args:
        u: inputs. Shape `(N,)`.
        y: outputs. Shape `(N,)`.
        orders: size of the equation.
    """
    value, std = solve(u, y, orders, constant=True).constant
    return abs(value) > _CONSTANT * std


def chosen_orders(
    u: Floats, y: Floats, criterion: str, *, constant: bool, least_delay: int
) -> ArxOrders:
    """Choose the orders of the lowest criterion.

    All are compared on the samples that the largest orders leave.

    Args:
        u: inputs. Shape `(N,)`.
        y: outputs. Shape `(N,)`.
        criterion: "aic" or "bic".
        constant: whether the equation has a constant.
        least_delay: smallest `nk`.
    Returns:
        The orders.
    """
    most_delay = min(SEARCH_DELAY, max(1, y.size // 8))
    drives = most_delay + _SEARCH_ORDER - least_delay
    largest = ArxOrders(_SEARCH_ORDER, drives, least_delay)
    columns = regressors(u, y, largest.numbers, largest.memory)
    ones = np.ones((columns.shape[0], int(constant)))
    all_columns = np.column_stack([ones, columns, y[largest.memory :]])
    # Least squares on the triangular factor equals that on the record for any choice of columns.
    triangle: Floats = np.asarray(np.linalg.qr(all_columns, mode="r"))
    count = all_columns.shape[0]
    floor = count * (1e-12 * float(np.ptp(y))) ** 2
    best, lowest = ArxOrders(1, 1, 1), math.inf
    counts = range(1, _SEARCH_ORDER + 1)
    delays = range(least_delay, most_delay + 1)
    for na, nb, nk in itertools.product(counts, range(1, _SEARCH_ORDER + 2), delays):
        if nb > na + (nk == 0) or nb + nk - least_delay > drives:
            continue
        kept = np.concatenate([np.arange(na), _SEARCH_ORDER + nk - least_delay + np.arange(nb)])
        kept = np.concatenate([np.arange(int(constant)), constant + kept])
        coefficients = np.linalg.lstsq(triangle[:, kept], triangle[:, -1], rcond=None)[0]
        cost = float(((triangle[:, -1] - triangle[:, kept] @ coefficients) ** 2).sum())
        score = criteria_of(cost + floor, count, na + nb)[criterion]
        if score < lowest:
            best, lowest = ArxOrders(na, nb, nk), score
    return best


def criteria_of(cost: float, count: int, coefficients: int) -> dict[str, float]:
    """Compute the criteria of Akaike ("aic") and Schwarz ("bic").

    Args:
        cost: sum of the squared prediction errors.
        count: number of these errors.
        coefficients: number of coefficients.
    """
    likelihood = count * math.log(max(cost / count, 1e-300))
    return {
        "aic": likelihood + 2.0 * (coefficients + 1),
        "bic": likelihood + math.log(count) * (coefficients + 1),
    }
