r"""Hyperelastic laws of incompressible rubber, as nominal stress along the length.

Lateral stretch is free (uniaxial) or given (1 is pure shear; the actuator is clamped at 3; that of
the length itself is equibiaxial; see `Deformation`), and the thickness follows from the constant
volume: $\lambda_3 = 1/(\lambda_1 \lambda_2)$.
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
    "OgdenThreeTerms",
    "OgdenTwoTerms",
    "Yeoh",
    "YeohTwoTerms",
    "inverse_langevin",
    "law_from_parameters",
    "ogden_term",
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
            f"The inverse Langevin function was evaluated at {np.abs(y).max():g}; the argument "
            "must be below 1. The chains are at their full length. Lower the stretch or raise "
            "lambda_m."
        )
    x = y * (3.0 - y * y) / (1.0 - y * y)
    for _ in range(6):
        value, slope = _langevin(x)
        x = x - (value - y) / slope
    return np.asarray(x)


def _langevin(x: Floats) -> tuple[Floats, Floats]:
    """Langevin function and its derivative."""
    small = np.abs(x) < 0.05
    z = np.where(small, 1.0, x)
    x2 = x * x
    value = np.where(small, x * (1 / 3 - x2 * (1 / 45 - 2 * x2 / 945)), 1 / np.tanh(z) - 1 / z)
    with np.errstate(over="ignore"):
        far = 1 / (z * z) - 1 / np.sinh(z) ** 2
    return value, np.where(small, 1 / 3 - x2 * (1 / 15 - 2 * x2 / 189), far)


def _stretches(
    stretch: ArrayLike, lateral_stretch: ArrayLike | None
) -> tuple[Floats, Floats, Floats]:
    length = np.asarray(stretch, dtype=np.float64)
    if not (length > 0.0).all():
        raise LimitError(
            f"stretch = {float(length.min()):g}; it must be above 0 (1 is the natural length). "
            "Give stretch, not strain."
        )
    if lateral_stretch is None:
        side = 1.0 / np.sqrt(length)
        return length, side, side
    side = np.broadcast_to(np.asarray(lateral_stretch, dtype=np.float64), length.shape)
    if not (side > 0.0).all():
        raise LimitError(
            f"lateral_stretch = {float(side.min()):g}; it must be above 0. "
            "Give None for a free width, 1 for pure shear."
        )
    return length, side, 1.0 / (length * side)


@dataclass(frozen=True)
class HyperelasticLaw:
    """A law of incompressible rubber; the subclasses are final and differ in `name` and parameters.

    Args: parameters of the subclass.
    """

    name: ClassVar[str]

    def nominal_stress_pa(
        self, stretch: ArrayLike, lateral_stretch: ArrayLike | None = None
    ) -> Floats:
        r"""Force along the length over the natural cross-section.

        $P_1 = 2 W_1 (\lambda_1 - \lambda_3^2/\lambda_1)$ for a law of the first invariant $I_1$

        Args:
            stretch: stretch along the length. Shape `(...)`.
            lateral_stretch: given lateral stretch, a number or the shape of `stretch`; None when
                the width is free (uniaxial).
        Returns:
            Nominal stress, in Pa. Shape `(...)`.
        Raises:
            LimitError: a stretch not above zero, or beyond the full length of the chains.
        """
        length, side, thickness = _stretches(stretch, lateral_stretch)
        first_invariant = length**2 + side**2 + thickness**2
        return self._twice_w1_pa(first_invariant) * (length - thickness**2 / length)

    def _twice_w1_pa(self, first_invariant: Floats) -> Floats:
        """Twice the derivative of the energy density with respect to the first invariant."""
        raise NotImplementedError(f"{type(self).__name__} is not a law of the first invariant")

    def parameters(self) -> Mapping[str, float]:
        """Parameters of the law by name."""
        return {field.name: float(getattr(self, field.name)) for field in fields(self)}


def _check_extension(name: str, got: float, allowed: float) -> None:
    if not got < allowed:
        raise LimitError(
            f"The stretch requires {name} = {got:g}; it must be below {allowed:g}, where the "
            "chains are at their full length. Lower the stretch."
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
    r"""Arruda-Boyce eight-chain model with the exact inverse Langevin function.

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
    r"""Arruda-Boyce eight-chain model as the five-term series of finite-element codes.

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


def ogden_term(stretch: Floats, thickness: Floats, alpha: float) -> Floats:
    r"""Nominal stress of an Ogden term of modulus 1.

    $\frac{2}{\alpha} (\lambda_1^\alpha - \lambda_3^\alpha)/\lambda_1$, its limit at $\alpha = 0$

    Args:
        stretch: along the length. Shape `(...)`.
        thickness: stretch of the thickness. Shape of `stretch`.
        alpha: exponent.
    Returns:
        Stress per modulus. Shape of `stretch`.
    Example:
        >>> ogden_term(np.array(2.0), np.array(0.5), 0.0).round(6).tolist()
        1.386294
    """
    ratio = np.log(stretch / thickness)
    if abs(alpha) < 1e-12:
        return np.asarray(2.0 * ratio / stretch)
    return np.asarray(2.0 / alpha * thickness**alpha * np.expm1(alpha * ratio) / stretch)


@dataclass(frozen=True)
class Ogden(HyperelasticLaw):
    r"""Ogden, one term: $W = \frac{2\mu}{\alpha^2} \sum_i (\lambda_i^\alpha - 1)$.

    Args:
        mu_pa: shear modulus, in Pa.
        alpha: exponent; 2 is neo-Hooke.
    Source: Ogden, Proc. R. Soc. A 326 (1972), 565, with the shear modulus as first parameter.
    Example:
        >>> round(float(Ogden(1000.0, 2.0).nominal_stress_pa(2.0)), 9)
        1750.0
    """

    name = "ogden"
    mu_pa: float
    alpha: float

    def nominal_stress_pa(
        self, stretch: ArrayLike, lateral_stretch: ArrayLike | None = None
    ) -> Floats:
        """Nominal stress, in Pa: `2 mu/alpha (l1^alpha - l3^alpha) / l1`."""
        length, _, thickness = _stretches(stretch, lateral_stretch)
        return self.mu_pa * ogden_term(length, thickness, self.alpha)


@dataclass(frozen=True)
class OgdenTwoTerms(HyperelasticLaw):
    r"""Ogden, two terms: $W = \sum_p \frac{2\mu_p}{\alpha_p^2} \sum_i (\lambda_i^{\alpha_p} - 1)$.

    Args:
        mu1_pa: modulus of the first term, in Pa; the sum of all is the shear modulus.
        alpha1: its exponent.
        mu2_pa: modulus of the second term, in Pa.
        alpha2: its exponent.
    Source: Ogden, Proc. R. Soc. A 326 (1972), 565; his `mu` is ours times 2/alpha.
    Example:
        >>> round(float(OgdenTwoTerms(400.0, 2.0, 600.0, 2.0).nominal_stress_pa(2.0)), 9)
        1750.0
    """

    name = "ogden-2"
    mu1_pa: float
    alpha1: float
    mu2_pa: float
    alpha2: float

    def nominal_stress_pa(
        self, stretch: ArrayLike, lateral_stretch: ArrayLike | None = None
    ) -> Floats:
        """Nominal stress, in Pa: the sum of the terms."""
        length, _, thickness = _stretches(stretch, lateral_stretch)
        first = self.mu1_pa * ogden_term(length, thickness, self.alpha1)
        return np.asarray(first + self.mu2_pa * ogden_term(length, thickness, self.alpha2))


@dataclass(frozen=True)
class OgdenThreeTerms(HyperelasticLaw):
    """Ogden with three terms, as with two.

    Args:
        mu1_pa: modulus of the first term, in Pa; the sum of all is the shear modulus.
        alpha1: its exponent.
        mu2_pa: modulus of the second term, in Pa.
        alpha2: its exponent.
        mu3_pa: modulus of the third term, in Pa.
        alpha3: its exponent.
    Source: Ogden, Proc. R. Soc. A 326 (1972), 565; his `mu` is ours times 2/alpha. The example is
        his fit of Treloar's rubber: 6.3, 0.012, -0.1 kg/cm2 and 1.3, 5.0, -2.0.
    Example:
        >>> kgf_cm2 = 98066.5
        >>> law = OgdenThreeTerms(
        ...     6.3 * 0.65 * kgf_cm2, 1.3, 0.012 * 2.5 * kgf_cm2, 5.0, 0.1 * kgf_cm2, -2.0)
        >>> round(float(law.nominal_stress_pa(4.0)) / 1e6, 2)
        1.18
    """

    name = "ogden-3"
    mu1_pa: float
    alpha1: float
    mu2_pa: float
    alpha2: float
    mu3_pa: float
    alpha3: float

    def nominal_stress_pa(
        self, stretch: ArrayLike, lateral_stretch: ArrayLike | None = None
    ) -> Floats:
        """Nominal stress, in Pa: the sum of the terms."""
        length, _, thickness = _stretches(stretch, lateral_stretch)
        pairs = ((self.mu1_pa, self.alpha1), (self.mu2_pa, self.alpha2), (self.mu3_pa, self.alpha3))
        terms = [mu_pa * ogden_term(length, thickness, alpha) for mu_pa, alpha in pairs]
        return np.asarray(sum(terms))


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
    for law in (
        NeoHooke,
        ArrudaBoyce,
        ArrudaBoyceSeries,
        Ogden,
        OgdenTwoTerms,
        OgdenThreeTerms,
        Yeoh,
        YeohTwoTerms,
        Gent,
    )
}


def law_from_parameters(name: str, parameters: Mapping[str, float]) -> HyperelasticLaw:
    """Create the law called `name` with given parameters.

    Args:
        name: key of `LAWS`.
        parameters: parameters of the law by name.
    Returns:
        The law.
    Raises:
        InputError: an unknown name, or a parameter that the law does not have.
    """
    if name not in LAWS:
        raise InputError(f"model = {name}; it must be one of {', '.join(LAWS)}.")
    try:
        return LAWS[name](**parameters)
    except TypeError as error:
        wanted = ", ".join(field.name for field in fields(LAWS[name]))
        raise InputError(
            f"The law {name} got {', '.join(parameters)}; it needs {wanted}."
        ) from error
