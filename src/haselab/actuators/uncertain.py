"""Parameters of a law as they vary: by logarithm, by a power of the inverse, or by value.

What is positive varies by its logarithm, so that it stays positive; what the forces follow nearly
linearly in a power of its inverse varies by that (see `parameter`); all others vary by their value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.actuators.law import ActuatorLaw
from haselab.actuators.losses import DRIFT_TIMES

__all__ = ["Scales", "draw_parameters"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Scales:
    """How each of some parameters varies.

    Args:
        by_logarithm: Shape `(P,)`.
        inverse_exponent: of those that vary by a power of their inverse; 0 of others. Shape `(P,)`.
    """

    by_logarithm: NDArray[np.bool_]
    inverse_exponent: Floats

    @classmethod
    def of(cls, law: ActuatorLaw, names: Sequence[str]) -> Scales:
        """Those of parameters of a law; other names, such as an added inertia, vary by value."""
        powers = {about.key: about.inverse_exponent for about in law.described()}
        powers |= dict.fromkeys(DRIFT_TIMES, 0)
        inverse = [powers.get(name.partition("[")[0]) for name in names]
        return cls(
            np.array([power == 0 for power in inverse], dtype=bool),
            np.array([power or 0 for power in inverse], dtype=np.float64),
        )

    @property
    def by_inverse(self) -> NDArray[np.bool_]:
        """Which of them vary by a power of their inverse. Shape `(P,)`."""
        return self.inverse_exponent > 0.0

    def slopes(self, values: Floats) -> Floats:
        """Change of the values per change of what varies.

        Args:
            values: Shape `(P,)`.
        Returns:
            Slopes. Shape `(P,)`.
        """
        found = np.where(self.by_logarithm, values, 1.0)
        inverse, power = self.by_inverse, self.inverse_exponent[self.by_inverse]
        found[inverse] = -(values[inverse] ** (power + 1.0)) / power
        return found

    def varying(self, values: Floats) -> Floats:
        """What varies.

        Args:
            values: Shape `(P,)`.
        Returns:
            Logarithms, powers of inverses and values. Shape `(P,)`.
        """
        found = values.astype(np.float64)
        found[self.by_logarithm] = np.log(values[self.by_logarithm])
        inverse = self.by_inverse
        found[inverse] = values[inverse] ** -self.inverse_exponent[inverse]
        return found

    def moved(self, values: Floats, step: Floats) -> Floats:
        """Change what varies.

        Args:
            values: Shape `(P,)`.
            step: changes. Shape `(P,)`.
        Returns:
            The new values; not a number where an inverse became negative. Shape `(P,)`.
        """
        logarithm, inverse = self.by_logarithm, self.by_inverse
        power = self.inverse_exponent[inverse]
        found = values + step
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            found[logarithm] = values[logarithm] * np.exp(np.minimum(step[logarithm], 50.0))
            found[inverse] = (values[inverse] ** -power + step[inverse]) ** (-1.0 / power)
        return found


def draw_parameters(
    scales: Scales,
    values: Floats,
    covariance: Floats,
    known: Mapping[int, float],
    rng: np.random.Generator,
) -> Floats:
    r"""Draw parameters from their joint distribution, some of them at known values.

    What varies is normal, $z \sim N(\hat z, \Sigma)$. With the known part $z_k$ the others have

    $\hat z_o + \Sigma_{ok}\Sigma_{kk}^{-1}(z_k - \hat z_k),\quad
    \Sigma_{oo} - \Sigma_{ok}\Sigma_{kk}^{-1}\Sigma_{ko}$

    Args:
        scales: of the parameters.
        values: estimates. Shape `(P,)`.
        covariance: of the values. Shape `(P, P)`. The variance of a known one
            may be infinite: it is then correlated with no other.
        known: values by the index of the parameter.
        rng: random generator.
    Returns:
        Values. Shape `(P,)`.
    Example:
        >>> from haselab.actuators import DeaStack
        >>> scales = Scales.of(DeaStack(), ["actuator.shear_modulus_pa", "actuator.permittivity"])
        >>> spread = np.array([[1e8, 0.0], [0.0, 1e-4]])
        >>> rng = np.random.default_rng(1)
        >>> draw_parameters(scales, np.array([1e5, 2.8]), spread, {1: 3.0}, rng).round(2).tolist()
        [103516.25, 3.0]
    """
    slopes = scales.slopes(values)
    spread = covariance / np.outer(slopes, slopes)
    spread[:, ~np.isfinite(np.diag(spread))] = 0.0
    spread[~np.isfinite(spread)] = 0.0
    fixed = np.array(sorted(known), dtype=np.int64)
    free = np.setdiff1d(np.arange(values.size), fixed)
    step = np.zeros(values.size)
    if fixed.size:
        wanted = values.copy()
        wanted[fixed] = [known[k] for k in fixed.tolist()]
        step[fixed] = (scales.varying(wanted) - scales.varying(values))[fixed]
        unit = np.sqrt(np.maximum(np.diag(spread)[fixed], np.finfo(np.float64).tiny))
        inner = spread[np.ix_(fixed, fixed)] / np.outer(unit, unit)
        gain = np.linalg.pinv(inner, hermitian=True) / unit[:, None]
        gain = spread[np.ix_(free, fixed)] / unit @ gain.T
        step[free] = gain @ step[fixed]
        left = spread[np.ix_(free, free)] - gain @ spread[np.ix_(fixed, free)]
    else:
        left = spread
    unit = np.sqrt(np.maximum(np.diag(left), 0.0))
    unit[unit == 0.0] = 1.0
    size, axes = np.linalg.eigh(0.5 * (left + left.T) / np.outer(unit, unit))
    step[free] += unit * (axes @ (np.sqrt(np.maximum(size, 0.0)) * rng.standard_normal(free.size)))
    found = scales.moved(values, step)
    found[fixed] = [known[k] for k in fixed.tolist()]
    return found
