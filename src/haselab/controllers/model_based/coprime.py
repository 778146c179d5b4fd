r"""Loop shaping with coprime factors: the controller that is robust to their largest error.

A sampled plant with weights, $G = M^{-1} N$ with $N N^* + M M^* = 1$, stays stable for all errors
of the factors that are smaller than

$\epsilon = \left\|\begin{bmatrix} K \\ 1 \end{bmatrix} (1 - G K)^{-1} M^{-1}\right\|_\infty^{-1}
\le \sqrt{1 - \|[N\ M]\|_H^2} = (1 + \rho(X Z))^{-1/2}$

The bilinear map $z = (1 + s)/(1 - s)$ keeps all these norms, so the two Riccati equations of
continuous time are solved, and nothing is approximated: neither the hold nor the delay.

Source: D. C. McFarlane and K. Glover, IEEE Trans. Automat. Contr. 37 (1992), 759; S. Skogestad and
I. Postlethwaite, Multivariable Feedback Control, 2nd ed. (2005), eqs. 9.66 to 9.72.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_continuous_are

from haselab.base import ResultError

__all__ = ["Sampled", "guaranteed_margins", "in_series", "robust_controller", "stability_margin"]

Floats = NDArray[np.float64]
_GRID = 400
_SLOWEST = 1e-4  # of half the rate of the updates


@dataclass(frozen=True)
class Sampled:
    """A linear system of one input and one output, from one update to the next.

    Args:
        a: of the states. Shape `(n, n)`.
        b: of the input. Shape `(n,)`.
        c: of the output. Shape `(n,)`.
        d: of the input on the output, in the same update.
    """

    a: Floats
    b: Floats
    c: Floats
    d: float = 0.0

    def response(self, turns: Floats) -> NDArray[np.complex128]:
        """Response to waves.

        Args:
            turns: of the wave in an update, in rad. Shape `(N,)`.
        """
        z = np.exp(1j * turns)[:, None, None]
        into = np.broadcast_to(self.b[:, None], (turns.size, self.b.size, 1))
        states = np.linalg.solve(z * np.eye(self.b.size) - self.a, into)[:, :, 0]
        return np.asarray(states @ self.c + self.d)


def in_series(first: Sampled, second: Sampled) -> Sampled:
    """One system that consists of two, the output of the first being the input of the second.

    Args:
        first: whose input is that of the whole.
        second: whose output is that of the whole.
    """
    size = first.b.size
    a = np.zeros((size + second.b.size,) * 2)
    a[:size, :size], a[size:, size:] = first.a, second.a
    a[size:, :size] = np.outer(second.b, first.c)
    return Sampled(a, np.r_[first.b, second.b * first.d], np.r_[second.d * first.c, second.c],
                   second.d * first.d)  # fmt: skip


def robust_controller(shaped: Sampled, slack: float = 1.1) -> tuple[Sampled, float, float]:
    r"""The controller whose stability margin is nearly the largest one.

    Args:
        shaped: plant with weights, whose input and output have the same unit.
        slack: how many times the least norm the controller may have, above 1.
    Returns:
        The controller $K$ of positive feedback, $u = K y$; its margin $\epsilon$, at least; and
        the largest margin that any controller has.
    Raises:
        ResultError: The equations have no solution, or one that rounding errors spoil.
    """
    try:
        found, epsilon, largest = _solved(shaped, slack)
        poles = np.linalg.eigvals(_closed(shaped, found))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ResultError(f"The equations of the loop shaping have no solution: {error}") from error
    if not np.abs(poles).max() < 1.0:
        raise ResultError(
            f"The loop shaping gives no stable loop: with a stability margin of {epsilon:.2g}, "
            "rounding errors spoil it. Change the weight."
        )
    return found, epsilon, largest


def _solved(shaped: Sampled, slack: float) -> tuple[Sampled, float, float]:
    """See `robust_controller`; rounding errors may leave the loop unstable."""
    a, b, c, d = _to_continuous(shaped)
    s, r = 1.0 + d * d, 1.0 + d * d
    drift = a - np.outer(b, c) * (d / s)
    one = np.eye(1)
    x = solve_continuous_are(drift, b[:, None], np.outer(c, c) / r, s * one)
    z = solve_continuous_are(drift.T, c[:, None], np.outer(b, b) / s, r * one)
    least = math.sqrt(1.0 + float(np.abs(np.linalg.eigvals(x @ z)).max()))
    gamma = slack * least
    f = -(d * c + b @ x) / s
    l_matrix = (1.0 - gamma**2) * np.eye(b.size) + x @ z
    inject = gamma**2 * np.linalg.solve(l_matrix.T, z @ c)
    closed = a + np.outer(b, f) + np.outer(inject, c + d * f)
    found = _to_sampled(closed, inject, b @ x, -d)
    return found, 1.0 / gamma, 1.0 / least


def _closed(shaped: Sampled, controller: Sampled) -> Floats:
    """Matrix of the closed loop of positive feedback."""
    share = 1.0 / (1.0 - shaped.d * controller.d)
    k = controller
    return np.block([
        [shaped.a + share * k.d * np.outer(shaped.b, shaped.c), share * np.outer(shaped.b, k.c)],
        [share * np.outer(k.b, shaped.c), k.a + share * shaped.d * np.outer(k.b, k.c)],
    ])  # fmt: skip


def stability_margin(shaped: Sampled, controller: Sampled) -> float:
    r"""Smallest distance $|1 - GK| / \sqrt{(1 + |G|^2)(1 + |K|^2)}$ over all frequencies.

    Args:
        shaped: plant with weights.
        controller: of positive feedback; the loop is stable.
    """
    turns = math.pi * np.geomspace(_SLOWEST, 1.0, _GRID)
    g, k = shaped.response(turns), controller.response(turns)
    distance = np.abs(1.0 - g * k) / np.sqrt((1.0 + np.abs(g) ** 2) * (1.0 + np.abs(k) ** 2))
    return float(distance.min())


def guaranteed_margins(epsilon: float) -> tuple[float, float]:
    """Gain and phase margin that any loop with this stability margin has.

    Args:
        epsilon: stability margin.
    Returns:
        Factor of the gain (up, and its inverse down), and the phase, in rad.
    Source: K. Glover, G. Vinnicombe and G. Papageorgiou, Proc. 39th IEEE CDC (2000), 177.
    Example:
        >>> factor, phase_rad = guaranteed_margins(0.3)
        >>> round(factor, 2), round(math.degrees(phase_rad))
        (1.86, 35)
    """
    return (1.0 + epsilon) / (1.0 - epsilon), 2.0 * math.asin(epsilon)


def _to_continuous(system: Sampled) -> tuple[Floats, Floats, Floats, float]:
    """By the bilinear map; no state may alternate from update to update for ever."""
    inverse = np.linalg.inv(system.a + np.eye(system.b.size))
    a = inverse @ (system.a - np.eye(system.b.size))
    b, c = math.sqrt(2.0) * inverse @ system.b, math.sqrt(2.0) * system.c @ inverse
    return a, b, c, system.d - float(system.c @ inverse @ system.b)


def _to_sampled(a: Floats, b: Floats, c: Floats, d: float) -> Sampled:
    inverse = np.linalg.inv(np.eye(b.size) - a)
    return Sampled(
        inverse @ (a + np.eye(b.size)),
        math.sqrt(2.0) * inverse @ b,
        math.sqrt(2.0) * c @ inverse,
        d + float(c @ inverse @ b),
    )
