r"""Hyperelastic laws of incompressible rubber, as nominal stress along the length.

Lateral stretch is free (uniaxial) or fixed (1 is pure shear; the actuator is clamped at 3), and
the thickness follows from the constant volume: $\lambda_3 = 1/(\lambda_1 \lambda_2)$.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError, LimitError

__all__ = [
    "LAWS",
    "ArrudaBoyce",
    "ArrudaBoyceSeries",
    "Gent",
    "HyperelasticLaw",
    "NeoHooke",
    "Ogden",
    "Yeoh",
    "YeohTwoTerms",
    "inverse_langevin",
    "law_from_parameters",
]

Floats = NDArray[np.float64]
_SERIES = (1.0 / 2.0, 1.0 / 20.0, 11.0 / 1050.0, 19.0 / 7000.0, 519.0 / 673750.0)


def inverse_langevin(y: ArrayLike) -> Floats:
    r"""Inverse of the Langevin function $L(x) = \coth x - 1/x$, to rounding error.

    Args:
        y: value of the Langevin function, in (-1, 1). Shape `(...)`.
    Returns:
        Argument. Shape `(...)`.
    Raises:
        LimitError: a value outside (-1, 1).
    Source: start from the rational form of Cohen (1991), then Newton's method.
    Example:
        >>> round(float(inverse_langevin(1 / np.tanh(2.0) - 0.5)), 12)
        2.0
    """
    y = np.asarray(y, dtype=np.float64)
    if not (np.abs(y) < 1.0).all():
        raise LimitError(
            f"The inverse Langevin function was asked at {np.abs(y).max():g}; allowed is below 1. "
            "The chains are at their full length: lower the stretch or raise lambda_m."
        )
    x = y * (3.0 - y * y) / (1.0 - y * y)
    for _ in range(6):
        value, slope = _langevin(x)
        x = x - (value - y) / slope
    return np.asarray(x)


def _langevin(x: Floats) -> tuple[Floats, Floats]:
    """Langevin function and its slope."""
    small = np.abs(x) < 0.05
    z = np.where(small, 1.0, x)
    x2 = x * x
    value = np.where(small, x * (1 / 3 - x2 * (1 / 45 - 2 * x2 / 945)), 1 / np.tanh(z) - 1 / z)
    with np.errstate(over="ignore"):
        far = 1 / (z * z) - 1 / np.sinh(z) ** 2
    return value, np.where(small, 1 / 3 - x2 * (1 / 15 - 2 * x2 / 189), far)


def _stretches(stretch: ArrayLike, lateral_stretch: float | None) -> tuple[Floats, Floats, Floats]:
    length = np.asarray(stretch, dtype=np.float64)
    if not (length > 0.0).all():
        raise LimitError(
            f"stretch = {float(length.min()):g}; allowed is above 0 (1 is the natural length). "
            "Give stretch, not strain."
        )
    if lateral_stretch is None:
        side = 1.0 / np.sqrt(length)
        return length, side, side
    if not lateral_stretch > 0.0:
        raise LimitError(
            f"lateral_stretch = {lateral_stretch:g}; allowed is above 0. "
            "Give None for a free width, 1 for pure shear."
        )
    side = np.full(length.shape, float(lateral_stretch))
    return length, side, 1.0 / (length * side)


@dataclass(frozen=True)
class HyperelasticLaw:
    """A law of incompressible rubber; the subclasses are final and differ in `name` and numbers.

    Args: those of the subclass.
    """

    name: ClassVar[str]

    def nominal_stress_pa(self, stretch: ArrayLike, lateral_stretch: float | None = None) -> Floats:
        r"""Force along the length over the natural cross-section.

        $P_1 = 2 W_1 (\lambda_1 - \lambda_3^2/\lambda_1)$ for a law of the first invariant $I_1$

        Args:
            stretch: stretch along the length. Shape `(...)`.
            lateral_stretch: fixed lateral stretch; None when the width is free (uniaxial).
        Returns:
            Nominal stress, in Pa. Shape `(...)`.
        Raises:
            LimitError: a stretch not above zero, or beyond the full length of the chains.
        """
        length, side, thickness = _stretches(stretch, lateral_stretch)
        first_invariant = length**2 + side**2 + thickness**2
        return self._twice_w1_pa(first_invariant) * (length - thickness**2 / length)

    def _twice_w1_pa(self, first_invariant: Floats) -> Floats:
        """Twice the derivative of the energy density by the first invariant."""
        raise NotImplementedError(f"{type(self).__name__} is no law of the first invariant")

    def parameters(self) -> Mapping[str, float]:
        """Numbers of the law by name."""
        return {field.name: float(getattr(self, field.name)) for field in fields(self)}


def _check_extension(name: str, got: float, allowed: float) -> None:
    if not got < allowed:
        raise LimitError(
            f"The stretch needs {name} = {got:g}; allowed is below {allowed:g}, where the chains "
            "are at their full length. Lower the stretch."
        )


@dataclass(frozen=True)
class NeoHooke(HyperelasticLaw):
    """Neo-Hooke: `W = mu/2 (I1 - 3)`.

    Args:
        mu_pa: shear modulus, in Pa.
    Source: Treloar, The Physics of Rubber Elasticity (1975).
    Example:
        >>> float(NeoHooke(1000.0).nominal_stress_pa(2.0))
        1750.0
    """

    name = "neo-hooke"
    mu_pa: float

    def _twice_w1_pa(self, first_invariant: Floats) -> Floats:
        return np.full(first_invariant.shape, self.mu_pa)


@dataclass(frozen=True)
class ArrudaBoyce(HyperelasticLaw):
    r"""Eight chains, exact inverse Langevin function.

    $2 W_1 = \frac{\mu}{3} \frac{\lambda_m}{\lambda_c} L^{-1}(\lambda_c/\lambda_m),\quad
    \lambda_c = \sqrt{I_1/3}$

    Args:
        mu_pa: modulus of the chains, in Pa.
        lambda_m: stretch at the full length of the chains; `lambda_m**2` is the segment count N.
    Source: Arruda and Boyce, J. Mech. Phys. Solids 41 (1993), 389.
    Example:
        >>> round(float(ArrudaBoyce(15.6e3, 3.95).nominal_stress_pa(3.0)) / 1e3, 1)
        52.0
    """

    name = "arruda-boyce"
    mu_pa: float
    lambda_m: float

    def _twice_w1_pa(self, first_invariant: Floats) -> Floats:
        chain = np.sqrt(first_invariant / 3.0)
        _check_extension("lambda_m", float(chain.max(initial=0.0)), self.lambda_m)
        ratio = chain / self.lambda_m
        return np.asarray(self.mu_pa / 3.0 * inverse_langevin(ratio) / ratio)


@dataclass(frozen=True)
class ArrudaBoyceSeries(HyperelasticLaw):
    r"""Eight chains, the series of five terms that finite-element codes use.

    $2 W_1 = 2\mu \sum_{i=1}^{5} i\,C_i (I_1/\lambda_m^2)^{i-1}$

    Args:
        mu_pa: modulus of the chains, in Pa.
        lambda_m: stretch at the full length of the chains.
    Source: Arruda and Boyce (1993), eq. 19; coefficients 1/2, 1/20, 11/1050, 19/7000, 519/673750.
    Example:
        >>> round(float(ArrudaBoyceSeries(15.6e3, 3.92).nominal_stress_pa(3.0)) / 1e3, 1)
        52.2
    """

    name = "arruda-boyce-series"
    mu_pa: float
    lambda_m: float

    def _twice_w1_pa(self, first_invariant: Floats) -> Floats:
        ratio = first_invariant / self.lambda_m**2
        total = np.zeros(first_invariant.shape)
        for order, coefficient in reversed(list(enumerate(_SERIES, start=1))):
            total = total * ratio + order * coefficient
        return np.asarray(2.0 * self.mu_pa * total)


@dataclass(frozen=True)
class Ogden(HyperelasticLaw):
    r"""Ogden, one term: $W = \frac{2\mu}{\alpha^2} \sum_i (\lambda_i^\alpha - 1)$.

    Args:
        mu_pa: shear modulus, in Pa.
        alpha: exponent; 2 is neo-Hooke.
    Source: Ogden, Proc. R. Soc. A 326 (1972), 565, with the shear modulus as first number.
    Example:
        >>> float(Ogden(1000.0, 2.0).nominal_stress_pa(2.0))
        1750.0
    """

    name = "ogden"
    mu_pa: float
    alpha: float

    def nominal_stress_pa(self, stretch: ArrayLike, lateral_stretch: float | None = None) -> Floats:
        """As in the other laws; `2 mu/alpha (l1^alpha - l3^alpha) / l1`."""
        length, _, thickness = _stretches(stretch, lateral_stretch)
        power = length**self.alpha - thickness**self.alpha
        return np.asarray(2.0 * self.mu_pa / self.alpha * power / length)


@dataclass(frozen=True)
class YeohTwoTerms(HyperelasticLaw):
    """Yeoh with two terms: `W = c10 (I1 - 3) + c20 (I1 - 3)^2`.

    Args:
        c10_pa: first coefficient, in Pa; half the shear modulus.
        c20_pa: second coefficient, in Pa.
    Source: Yeoh, Rubber Chem. Technol. 66 (1993), 754.
    Example:
        >>> float(YeohTwoTerms(500.0, 0.0).nominal_stress_pa(2.0))
        1750.0
    """

    name = "yeoh-2"
    c10_pa: float
    c20_pa: float

    def _twice_w1_pa(self, first_invariant: Floats) -> Floats:
        return np.asarray(2.0 * (self.c10_pa + 2.0 * self.c20_pa * (first_invariant - 3.0)))


@dataclass(frozen=True)
class Yeoh(HyperelasticLaw):
    """Yeoh with three terms: `W = c10 (I1 - 3) + c20 (I1 - 3)^2 + c30 (I1 - 3)^3`.

    Args:
        c10_pa: first coefficient, in Pa; half the shear modulus.
        c20_pa: second coefficient, in Pa.
        c30_pa: third coefficient, in Pa.
    Source: Yeoh, Rubber Chem. Technol. 66 (1993), 754.
    Example:
        >>> float(Yeoh(500.0, 0.0, 0.0).nominal_stress_pa(2.0))
        1750.0
    """

    name = "yeoh"
    c10_pa: float
    c20_pa: float
    c30_pa: float

    def _twice_w1_pa(self, first_invariant: Floats) -> Floats:
        j = first_invariant - 3.0
        return np.asarray(2.0 * (self.c10_pa + j * (2.0 * self.c20_pa + 3.0 * self.c30_pa * j)))


@dataclass(frozen=True)
class Gent(HyperelasticLaw):
    r"""Gent: $W = -\frac{\mu J_m}{2} \ln(1 - (I_1 - 3)/J_m)$.

    Args:
        mu_pa: shear modulus, in Pa.
        jm: largest value of `I1 - 3`.
    Source: Gent, Rubber Chem. Technol. 69 (1996), 59.
    Example:
        >>> round(float(Gent(1000.0, 1e9).nominal_stress_pa(2.0)), 3)
        1750.0
    """

    name = "gent"
    mu_pa: float
    jm: float

    def _twice_w1_pa(self, first_invariant: Floats) -> Floats:
        j = first_invariant - 3.0
        _check_extension("jm", float(j.max(initial=0.0)), self.jm)
        return np.asarray(self.mu_pa * self.jm / (self.jm - j))


LAWS: Mapping[str, type[HyperelasticLaw]] = {
    law.name: law
    for law in (NeoHooke, ArrudaBoyce, ArrudaBoyceSeries, Ogden, Yeoh, YeohTwoTerms, Gent)
}


def law_from_parameters(name: str, parameters: Mapping[str, float]) -> HyperelasticLaw:
    """The law called `name` with its numbers.

    Args:
        name: key of `LAWS`.
        parameters: numbers of the law by name.
    Returns:
        The law.
    Raises:
        InputError: an unknown name, or a number that the law does not take.
    """
    if name not in LAWS:
        raise InputError(f"model = {name}; allowed are {', '.join(LAWS)}. Choose one of them.")
    try:
        return LAWS[name](**parameters)
    except TypeError as error:
        wanted = ", ".join(field.name for field in fields(LAWS[name]))
        raise InputError(
            f"The law {name} got {', '.join(parameters)}; it takes {wanted}. Correct the model."
        ) from error
