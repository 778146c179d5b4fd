"""Parameters of an identified model with their covariance, and plants drawn from them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject
from haselab.models.plant import Plant, SlowMode
from haselab.models.rational import RationalModel

__all__ = ["PlantPosterior"]

Floats = NDArray[np.float64]
_INDEFINITE = -1e-6  # smallest eigenvalue of a correlation matrix that rounding can cause
_ADVICE = "Fit the model again, or remove the key covariance."
_ASYMMETRY = 1e-6  # of the product of the standard deviations
_SMALLEST_STEP, _LARGEST_STEP = 1e-6, 0.2  # steps of a parameter for numerical derivatives
_WIDEST = 5.0  # standard deviation of a logarithm; a factor of 150 on either side
_PAIR = re.compile(r"natural_frequency(_\d+)?_rad_s")
_SLOW = re.compile(r"slow_time_constant(_\d+)?_s")
_NUMERATOR = re.compile(r"numerator_(\d+)")
_FACTOR = re.compile(r"([ab])_(\d+)")
_POSITIVE = re.compile(r"natural_frequency.*|.*time_constant.*")


@dataclass(frozen=True)
class PlantPosterior:
    r"""A model's parameters and the covariance of their errors: a normal distribution.

    The distribution is that of the parameters used by the fit: logarithms of frequencies, damping
    ratios and time constants, and gains, numerator coefficients and the delay directly. Every draw
    therefore has positive frequencies and time constants. There are two sets of names:

    - a fit of `identify transfer`: `natural_frequency_rad_s`, `damping_ratio` (further resonances
      `natural_frequency_2_rad_s`, `damping_ratio_2`, ...), `time_constant_s` of a real pole, `gain`
      (static), `numerator_1`, ..., `slow_gain`, `slow_time_constant_s`, `delay_s`. With
      $\Omega$ the geometric mean of the fast poles' magnitudes,
      $B(s)/A(s) = \left[g + \sum_k n_k (s/\Omega)^k\right] / \prod_i (1 - s/p_i)$;
    - any rational model: `b_m`, ..., `b_0` and `a_{n-1}`, ..., `a_0` of $b_m s^m + \dots$ over
      $s^n + a_{n-1} s^{n-1} + \dots$, and `delay_s`. It may integrate or be unstable.

    Args:
        names: names of the parameters.
        logarithmic: whether the covariance is that of a parameter's natural logarithm.
        values: best values of the parameters themselves, in SI units. Shape `(P,)`.
        covariance: covariance of the parameters, or of the logarithms of the logarithmic ones.
            Zero rows and columns for known parameters. Shape `(P, P)`.
    Raises:
        InputError: an unknown or missing name, a parameter that is not identifiable (NaN, or an
            infinite deviation), a matrix that is not a covariance.
    Source: large-sample distribution of a least-squares estimate, Ljung, System Identification
        (1999), chapter 9; with a flat prior it is the posterior.
    Example:
        >>> names = ("natural_frequency_rad_s", "damping_ratio", "delay_s", "gain")
        >>> posterior = PlantPosterior(
        ...     names, (True, True, False, False), np.array([32.0, 0.1, 0.01, 1.0]),
        ...     np.diag([0.02, 0.1, 1e-3, 0.05]) ** 2)
        >>> plants = posterior.draw(1000, np.random.default_rng(1))
        >>> round(float(np.std([plant.gain for plant in plants])), 2)
        0.05
    """

    names: tuple[str, ...]
    logarithmic: tuple[bool, ...]
    values: Floats
    covariance: Floats

    def __post_init__(self) -> None:
        count = len(self.names)
        shapes = (len(self.logarithmic), *self.values.shape, *self.covariance.shape)
        if shapes != (count,) * 4 or count == 0 or len(set(self.names)) != count:
            raise InputError(
                f"The covariance has {count} names, and values and a matrix of {shapes[1:]}; it "
                "needs one value, one row and one column per name, and all names must differ. "
                f"{_ADVICE}"
            )
        self._check_names()
        self._check_identifiable()
        self._check_matrix()

    def _check_names(self) -> None:
        """Check for a complete set of names, with logarithms of frequencies and time constants."""
        wanted = _wanted(self.names)
        unknown, missing = set(self.names) - wanted, wanted - {"delay_s"} - set(self.names)
        if unknown or missing:
            found = ", ".join(sorted(unknown)) or "no unknown name"
            lacks = ", ".join(sorted(missing)) or "nothing"
            raise InputError(
                f"The covariance names {found} and lacks {lacks}. Use the names of `identify "
                "transfer`, or a_k and b_k of a rational model."
            )
        for name, flag, var in zip(
            self.names, self.logarithmic, np.diag(self.covariance), strict=True
        ):
            if _POSITIVE.fullmatch(name) and not flag and var != 0.0:
                raise InputError(
                    f"The covariance is that of {name} itself, so draws may be negative. Give the "
                    "covariance of its logarithm."
                )

    def _check_identifiable(self) -> None:
        variances = np.diag(self.covariance)
        for name, flag, value, var in zip(
            self.names, self.logarithmic, self.values, variances, strict=True
        ):
            widest = _WIDEST**2 if flag else math.inf
            if not (math.isfinite(value) and math.isfinite(var) and var <= widest):
                size = "not given" if math.isnan(var) else f"{math.sqrt(max(var, 0.0)):.3g}"
                raise InputError(
                    f"{name} is not identifiable: its value is {value:g} and the standard deviation"
                    f"{' of its logarithm' if flag else ''} is {size}. Add a record that "
                    "determines it, fit a simpler structure, or fix it to a known value (--fix)."
                )
            if flag and not value > 0.0:
                raise InputError(
                    f"{name} = {value:g} has no logarithm, but the covariance is that of its "
                    "logarithm."
                )

    def _check_matrix(self) -> None:
        std = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        size = np.outer(std, std)
        lopsided = np.abs(self.covariance - self.covariance.T) > _ASYMMETRY * size + 1e-300
        if (np.diag(self.covariance) < 0.0).any() or not np.isfinite(self.covariance).all():
            raise InputError(f"The covariance has a negative or missing variance. {_ADVICE}")
        if lopsided.any() or (np.abs(self.covariance) > (1.0 - _INDEFINITE) * size + 1e-300).any():
            raise InputError(
                f"The covariance is not symmetric, or has a correlation above 1. {_ADVICE}"
            )
        least = float(np.linalg.eigvalsh(self._correlation(std)).min())
        if least < _INDEFINITE * std.size:
            raise InputError(
                f"The covariance has a negative eigenvalue ({least:.3g} of the correlation "
                f"matrix). {_ADVICE}"
            )

    def _correlation(self, std: Floats) -> Floats:
        """Correlations, 0 for a known parameter."""
        scale = np.where(std > 0.0, std, 1.0)
        return np.asarray(self.covariance / np.outer(scale, scale))

    @property
    def nominal(self) -> Plant | RationalModel:
        """The model at the best values."""
        return self._built(self.values)

    def propagated(
        self, quantities: Callable[[Plant | RationalModel], Floats]
    ) -> tuple[Floats, Floats]:
        """Quantities of the model and their covariance, to first order.

        Each parameter is varied by its standard deviation, up and down.

        Args:
            quantities: function from a model to quantities. Shape `(Q,)`.
        Returns:
            The quantities at the best values, shape `(Q,)`, and their covariance, shape `(Q, Q)`.
        """
        flags, std = np.array(self.logarithmic), np.sqrt(np.diag(self.covariance))
        size = np.where(flags, 1.0, np.abs(self.values))
        largest = np.where(size > 0.0, _LARGEST_STEP * size, std)
        steps = np.clip(std, np.minimum(_SMALLEST_STEP * size, largest), largest)
        slopes = []
        for k in np.flatnonzero(std > 0.0):
            ends = []
            for sign in (1.0, -1.0):
                moved = self.values.copy()
                step = sign * steps[k]
                moved[k] = moved[k] * math.exp(step) if flags[k] else moved[k] + step
                ends.append(quantities(self._built(moved)))
            slopes.append((ends[0] - ends[1]) / (2.0 * steps[k]))
        centre = quantities(self.nominal)
        jacobian = np.array(slopes).reshape(-1, centre.size)
        known = std > 0.0
        return centre, jacobian.T @ self.covariance[np.ix_(known, known)] @ jacobian

    def draw(self, count: int, rng: np.random.Generator) -> tuple[Plant | RationalModel, ...]:
        """Draw plants from the distribution.

        One resonance with slow branches is a `Plant`, anything else a `RationalModel`. A delay
        drawn below zero becomes zero; a gain may change its sign.

        Args:
            count: number of plants, 1 or more.
            rng: random generator of the draws.
        Returns:
            The plants. Length `count`.
        Raises:
            InputError: `count` is below 1.
        """
        if count < 1:
            raise InputError(f"count = {count}; it must be 1 or more.")
        std = np.sqrt(np.diag(self.covariance))
        sizes, axes = np.linalg.eigh(self._correlation(std))
        root = std[:, None] * axes * np.sqrt(np.maximum(sizes, 0.0))
        errors = rng.standard_normal((count, std.size)) @ root.T
        flags = np.array(self.logarithmic)
        # A known parameter keeps its exact value.
        drawn = np.where(flags, self.values * np.exp(np.where(flags, errors, 0.0)), self.values)
        drawn = np.where(flags, drawn, drawn + errors)
        return tuple(self._built(row) for row in drawn)

    def _built(self, values: Floats) -> Plant | RationalModel:
        number = dict(zip(self.names, values.tolist(), strict=True))
        delay_s = max(number.get("delay_s", 0.0), 0.0)
        if any(name.startswith("a_") for name in self.names):
            return _of_factors(number, delay_s)
        slow = tuple(
            SlowMode(number[f"slow_gain{k}"], number[f"slow_time_constant{k}_s"])
            for k in _numbers(_SLOW, self.names)
        )
        pairs = _numbers(_PAIR, self.names)
        shape = [number[name] for name in self.names if _NUMERATOR.fullmatch(name)]
        simple = pairs == [""] and "time_constant_s" not in number and not shape
        if simple and number["damping_ratio"] >= 0.0:
            omega, zeta = number["natural_frequency_rad_s"], number["damping_ratio"]
            return Plant(number["gain"], omega, zeta, delay_s, slow)
        bottom = np.ones(1)
        for k in pairs:
            omega, zeta = number[f"natural_frequency{k}_rad_s"], number[f"damping_ratio{k}"]
            bottom = np.polymul(bottom, [1.0, 2.0 * zeta * omega, omega * omega])
        if "time_constant_s" in number:
            bottom = np.polymul(bottom, [1.0, 1.0 / number["time_constant_s"]])
        omega = float(bottom[-1]) ** (1.0 / (bottom.size - 1))
        rising = [number["gain"], *(number[f"numerator_{k + 1}"] for k in range(len(shape)))]
        top = np.array(rising) * bottom[-1] / omega ** np.arange(len(rising))
        model = RationalModel(tuple(top[::-1].tolist()), tuple(bottom.tolist()), delay_s)
        return model.beside(slow)

    def to_dict(self) -> JsonObject:
        """The distribution as stored in a model file under the key `covariance`."""
        return {
            "names": list(self.names),
            "logarithmic": list(self.logarithmic),
            "values": self.values,
            "matrix": self.covariance,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PlantPosterior:
        """Create from `to_dict`; null means a parameter that is not identifiable.

        Raises:
            InputError: a missing key, or as for the class.
        """
        try:
            lengths = [len(row) for row in data["matrix"]]
            if lengths != [len(data["names"])] * len(data["names"]):
                raise InputError(
                    f"The matrix of the covariance has rows of {lengths} numbers, but its "
                    f"{len(data['names'])} names need as many rows of as many numbers. {_ADVICE}"
                )
            # fmt: off
            return cls(
                tuple(str(name) for name in data["names"]),
                tuple(bool(flag) for flag in data["logarithmic"]),
                np.array([math.nan if v is None else v for v in data["values"]], dtype=float),
                np.array([[math.inf if v is None else v for v in row] for row in data["matrix"]],
                         dtype=float),
            )
            # fmt: on
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"The covariance of the model is incomplete or has a wrong value: {error}. It "
                "needs names, logarithmic, values and matrix. Write the model again with `haselab "
                "identify transfer`."
            ) from error


def _numbers(pattern: re.Pattern[str], names: tuple[str, ...]) -> list[str]:
    """Suffixes of the parameters of one kind: "", "_2", ..."""
    return [found.group(1) or "" for found in map(pattern.fullmatch, names) if found]


def _wanted(names: tuple[str, ...]) -> set[str]:
    """The complete set of names that some names belong to."""
    factors = [found.groups() for found in map(_FACTOR.fullmatch, names) if found]
    if factors:
        top = max((int(power) for kind, power in factors if kind == "b"), default=0)
        bottom = max((int(power) for kind, power in factors if kind == "a"), default=0)
        wanted = {f"b_{k}" for k in range(top + 1)} | {f"a_{k}" for k in range(bottom + 1)}
        return wanted | {"delay_s"}
    wanted = {"gain", "delay_s"}
    pairs = _numbers(_PAIR, names)
    for k in pairs:
        wanted |= {f"natural_frequency{k}_rad_s", f"damping_ratio{k}"}
    if "time_constant_s" in names or not pairs:
        wanted.add("time_constant_s")
    for k in _numbers(_SLOW, names):
        wanted |= {f"slow_time_constant{k}_s", f"slow_gain{k}"}
    last = max((int(f.group(1)) for f in map(_NUMERATOR.fullmatch, names) if f), default=0)
    return wanted | {f"numerator_{k}" for k in range(1, last + 1)}


def _of_factors(number: Mapping[str, float], delay_s: float) -> RationalModel:
    top, bottom = (
        [number[f"{kind}{k}"] for k in reversed(range(sum(n.startswith(kind) for n in number)))]
        for kind in ("b_", "a_")
    )
    return RationalModel(tuple(top), (1.0, *bottom), delay_s)
