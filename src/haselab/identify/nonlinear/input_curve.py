"""The curve of the input ahead of the linear part of a Hammerstein model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.identify.record import Record

__all__ = ["InputCurve"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class InputCurve:
    r"""Input of the linear part of a Hammerstein model: $d + b_2 d^2 + b_3 d^3$ with $d = u - u_0$.

    A constant is subtracted, so that the curve is 0 at the input 0.

    Args:
        operating_input: u0, in the unit of the input.
        coefficients: of $d, d^2, \dots$. Shape `(D,)`.
    """

    operating_input: float
    coefficients: tuple[float, ...]

    def at(self, u: ArrayLike) -> Floats:
        """Values of the curve. Shape of `u`.

        Example:
            >>> InputCurve(1.0, (1.0, 0.5)).at([0.0, 1.0, 2.0])
            array([0. , 0.5, 2. ])
        """
        powers = np.polynomial.Polynomial((0.0, *self.coefficients))
        return np.asarray(
            powers(np.asarray(u, dtype=float) - self.operating_input)
            - powers(-self.operating_input)
        )

    def apply_to(self, record: Record) -> Record:
        """The record with the curve's values as its input.

        Raises:
            InputError: the curve has the same value for all inputs of the record.
        """
        before = record.input_before
        before = None if before is None else float(self.at(before))
        return replace(record, u=self.at(record.u), input_before=before)
