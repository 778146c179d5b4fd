r"""What records determine of a physical model, and which of them do.

The residuals of each segment (one channel of one experiment) have the derivatives $J_s$ by the
parameters. Before any record, a parameter is assumed to be within ten widths $w$ of the start,
which is hardly any knowledge, so that the joint information always has an inverse:

$\Sigma = \left(\sum_s J_s^\top J_s + \mathrm{diag}(10\,w)^{-2}\right)^{-1}$

Of parameters that only act together, each keeps a large variance. A segment determines a parameter
if the variance grows without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from haselab.base import JsonObject
from haselab.identify.physical.unknowns import Unknowns

__all__ = [
    "RELATIVE",
    "Source",
    "covariance_of",
    "covariance_of_runs",
    "determined_by",
    "largest_std",
    "vague_information",
]

Floats = NDArray[np.float64]
RELATIVE = 2.5  # widths that count as a relative standard deviation of 1
_VAGUE = 10.0  # widths: standard deviation before any record
_GROWS = 1.1  # of the variance, from which a segment is named
_NAMED = 3  # segments at most


@dataclass(frozen=True)
class Source:
    """A segment that determines a parameter.

    Args:
        experiment: its name; empty for what is known of an instrument beforehand.
        channel: "length", "capacitance" or "known".
        variance_growth: variance of the parameter without this segment over that with it.
    """

    experiment: str
    channel: str
    variance_growth: float

    @property
    def text(self) -> str:
        """Experiment and channel, for a table."""
        return f"{self.experiment} {self.channel}" if self.experiment else "known beforehand"

    def answer(self) -> JsonObject:
        """Keys of the JSON answer."""
        return {
            "experiment": self.experiment,
            "channel": self.channel,
            "variance_growth": self.variance_growth,
        }


def vague_information(unknowns: Unknowns) -> Floats:
    """Information on what varies before any record. Shape `(P,)`."""
    return (_VAGUE * unknowns.vague_widths) ** -2.0


def largest_std(unknowns: Unknowns) -> Floats:
    """Standard deviation of what varies, above which it is not identifiable. Shape `(P,)`."""
    return RELATIVE * unknowns.widths


def covariance_of(factors: Sequence[Floats]) -> Floats:
    r"""Invert the sum of some informations, $(\sum_s F_s^\top F_s)^{-1}$.

    The sum itself is never formed, because it would lose half of the digits.

    Args:
        factors: of each. Shape `(M, P)`; together they have the rank `P`.
    Returns:
        Covariance. Shape `(P, P)`.
    Example:
        >>> covariance_of([np.eye(2), np.array([[1.0, 0.0]])]).round(3).tolist()
        [[0.5, 0.0], [0.0, 1.0]]
    """
    stacked = np.vstack(list(factors))
    scale = np.linalg.norm(stacked, axis=0)
    upper = np.linalg.qr(stacked / scale, mode="r")
    inverse = solve_triangular(upper, np.eye(scale.size)) / scale[:, None]
    return np.asarray(inverse @ inverse.T)


def covariance_of_runs(jacobian: Floats, runs: NDArray[np.int64], prior: Floats) -> Floats:
    r"""Covariance of estimates if all residuals of a run have the same error.

    $A\left(\sum_g s_g^\top s_g + D\right)A$, with $A = (J^\top J + D)^{-1}$, the sum $s_g$ of the
    derivatives over the run $g$, and the information $D$ before the records. Runs of one residual
    each give $A$.

    Args:
        jacobian: of the residuals, whose variance is 1. Shape `(N, P)`.
        runs: number of the run of each residual, from 0 on. Shape `(N,)`.
        prior: information on what varies before the records. Positive, shape `(P,)`.
    Returns:
        Covariance. Shape `(P, P)`.
    Example:
        >>> prior = np.array([1e-12])
        >>> covariance_of_runs(np.ones((4, 1)), np.array([0, 0, 1, 1]), prior).round(6).tolist()
        [[0.5]]
    """
    before = np.diag(np.sqrt(prior))
    summed = np.zeros((int(runs.max(initial=-1)) + 1, prior.size))
    np.add.at(summed, runs, jacobian)
    root = np.vstack([summed, before]) @ covariance_of([jacobian, before])
    return np.asarray(root.T @ root)


def determined_by(
    unknowns: Unknowns, parts: Mapping[tuple[str, str], Floats]
) -> dict[str, tuple[Source, ...]]:
    """Find the segments that determine each parameter, by leaving out one after the other.

    Args:
        unknowns: of the model.
        parts: derivatives of the residuals of each segment, by experiment and channel. `(M, P)`.
    Returns:
        By name, the segments without which the variance grows by a tenth or more, at most three and
        at least one; none for a parameter that is not identifiable.
    """
    widths = unknowns.widths
    prior = np.diag(np.sqrt(vague_information(unknowns)) * widths)
    factors: dict[tuple[str, str], Floats] = {
        name: np.asarray(np.linalg.qr(part * widths, mode="r")) for name, part in parts.items()
    }
    joint = np.diag(covariance_of([*factors.values(), prior]))
    growth = {}
    for left_out in factors:
        others = [part for name, part in factors.items() if name != left_out]
        growth[left_out] = np.diag(covariance_of([*others, prior])) / joint
    found: dict[str, tuple[Source, ...]] = {}
    for k, name in enumerate(unknowns.names):
        ordered = sorted(growth, key=lambda segment: -growth[segment][k])
        named = [s for s in ordered if growth[s][k] >= _GROWS][:_NAMED] or ordered[:1]
        if joint[k] > RELATIVE**2:
            named = []
        found[name] = tuple(Source(*segment, float(growth[segment][k])) for segment in named)
    return found
