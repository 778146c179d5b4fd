"""A linear state-space model in discrete time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError
from haselab.models.filters import lfilter

__all__ = ["StateSpaceModel"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True)
class StateSpaceModel:
    r"""Discrete-time model of one input and one output, about its operating point.

    $x_{k+1} = A x_k + b\,u_k,\quad y_k = c\,x_k + d\,u_k$

    Args:
        a: state matrix. Shape `(n, n)`.
        b: input vector. Shape `(n,)`.
        c: output vector. Shape `(n,)`.
        d: feed-through.
        rate_hz: sampling rate, in Hz.
    Raises:
        InputError: inconsistent shapes, or values that are not finite.
    Example:
        >>> plant = StateSpaceModel([[0.5]], [1.0], [2.0], 0.0, 10.0)
        >>> plant.static_gain, plant.simulate([1.0, 1.0, 1.0]).tolist()
        (4.0, [0.0, 2.0, 3.0])
    """

    a: Floats
    b: Floats
    c: Floats
    d: float
    rate_hz: float

    def __post_init__(self) -> None:
        for name in ("a", "b", "c"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        size = self.b.size
        shapes = (self.a.shape, self.b.shape, self.c.shape)
        numbers = np.concatenate([self.a.ravel(), self.b, self.c, [self.d, self.rate_hz]])
        if shapes != ((size, size), (size,), (size,)) or not np.isfinite(numbers).all():
            raise InputError(
                f"The state model has shapes {shapes}; they must be (n, n), (n,), (n,), with "
                "finite values. Fit the model again."
            )

    @property
    def poles(self) -> Complexes:
        """Eigenvalues of `a`, in the z-plane. Shape `(n,)`."""
        return np.asarray(np.linalg.eigvals(self.a), dtype=np.complex128)

    @property
    def is_stable(self) -> bool:
        """Whether all poles are inside the unit circle."""
        return bool((np.abs(self.poles) < 1.0).all())

    @property
    def static_gain(self) -> float:
        """Static gain: output per input in steady state."""
        still = np.eye(self.b.size) - self.a
        return float(self.c @ np.linalg.solve(still, self.b) + self.d)

    def simulate(self, u: ArrayLike, state: ArrayLike | None = None) -> Floats:
        """Simulate the output.

        Args:
            u: input. Shape `(N,)`.
            state: at the first sample. None: zero. Shape `(n,)`.
        Returns:
            Output. Shape `(N,)`.
        """
        drive = np.asarray(u, dtype=np.float64)
        driven, free = self.responses(drive)
        output = driven @ self.b + self.d * drive
        return np.asarray(output if state is None else output + free @ np.asarray(state))

    def responses(self, u: Floats) -> tuple[Floats, Floats]:
        """Output of each element of `b`, and of each element of the first state, set to 1.

        Args:
            u: input. Shape `(N,)`.
        Returns:
            Both responses. Shape `(N, n)` each.
        """
        below = np.poly(self.a)
        impulse = np.zeros(u.size)
        impulse[:1] = 1.0
        driven, free = [], []
        for i in range(self.b.size):
            unit = np.zeros((self.b.size, 1))
            unit[i] = 1.0
            above = np.poly(self.a - unit @ self.c[None, :]) - below
            driven.append(lfilter(above, below, u))
            free.append(lfilter(above[1:], below, impulse))
        return np.stack(driven, axis=1), np.stack(free, axis=1)
