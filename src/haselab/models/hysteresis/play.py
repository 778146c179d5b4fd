"""Prandtl-Ishlinskii hysteresis: play operators, rate-dependent or not, with the inverse."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab._models import Plays
from haselab.base import InputError
from haselab.models.hysteresis.common import NO_DEAD_ZONES, DeadZones, Hysteresis, HysteresisState

__all__ = ["PrandtlIshlinskii"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PrandtlIshlinskii(Hysteresis):
    r"""Parallel play operators, optionally with rate-dependent thresholds, then dead zones.

    $x_i(t_k) = \min(u_k + r_i,\ \max(u_k - r_i,\ x_i(t_{k-1}))),\quad
    r_i = \alpha_i + \beta\,\varrho_{k-1},\quad
    y = S\bigl(c + p_0 u + \textstyle\sum_i p_i x_i\bigr)$

    $\varrho$ is $|\dot u|$ behind a first-order filter. It is that of the sample before, so that
    the inverse can compute the thresholds before its own output. All thresholds grow equally:
    their distances never shrink, which is required for an exact inverse.

    Args:
        gain: $p_0$, output per unit of input.
        thresholds: $\alpha_i$, ascending, above 0, in the unit of the input. Shape `(n,)`.
        weights: $p_i$; with the sign of `gain` if the output lags, opposite if it leads.
            Shape `(n,)`.
        offset: $c$.
        rate_dependence_s: $\beta$, threshold per unit of rate, in s. 0: rate-independent.
        rate_filter_s: time constant of the filter of the rate, in s. 0: the difference of
            successive inputs.
        dead_zones: $S$.
    Raises:
        InputError: unequal lengths, NaN, thresholds that do not ascend from above 0, a negative
            time.
    Source: Kuhnen, Eur. J. Control 9 (2003), 407; Al Janaideh and Krejci, IEEE/ASME Trans.
        Mechatron. 18 (2013), 1498, for thresholds in time and the condition on their distances.
    Example:
        >>> model = PrandtlIshlinskii(1.0, (0.2,), (1.0,))
        >>> model.simulate([1.0, 0.9, 0.0]).tolist()
        [1.8, 1.7000000000000002, 0.2]
        >>> model.invert([1.8, 1.7, 0.2]).round(9).tolist()
        [1.0, 0.9, 0.0]
    """

    gain: float
    thresholds: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()
    offset: float = 0.0
    rate_dependence_s: float = 0.0
    rate_filter_s: float = 0.0
    dead_zones: DeadZones = NO_DEAD_ZONES

    def __post_init__(self) -> None:
        times = (self.rate_dependence_s, self.rate_filter_s)
        numbers = np.array([self.gain, self.offset, *self.thresholds, *self.weights, *times])
        if len(self.thresholds) != len(self.weights) or not np.isfinite(numbers).all():
            raise InputError(
                f"The play operators have {len(self.thresholds)} thresholds and "
                f"{len(self.weights)} weights. "
                "Give one finite weight for each threshold."
            )
        if not (np.diff([0.0, *self.thresholds]) > 0.0).all():
            raise InputError(
                f"The play operators have the thresholds {self.thresholds}; they must "
                "ascend from above 0. Sort them; a threshold of 0 belongs to the gain."
            )
        if min(times) < 0.0:
            raise InputError(
                f"rate_dependence_s = {times[0]:g} s, rate_filter_s = {times[1]:g} s; both must be "
                "0 s or more."
            )

    def pull(self, rate_hz: float) -> float:
        """Coefficient of the rate's filter for one sample, at `rate_hz` in Hz."""
        if self.rate_filter_s == 0.0:
            return 1.0
        return -math.expm1(-1.0 / (rate_hz * self.rate_filter_s))

    def plays(self, rate_hz: float) -> Plays:
        """The operators at a sampling rate in Hz, in the form of the extension."""
        return Plays(
            np.asarray(self.thresholds, dtype=np.float64),
            np.asarray(self.weights, dtype=np.float64),
            self.gain,
            self.rate_dependence_s,
            self.pull(rate_hz),
            rate_hz,
        )

    def init(self, rate_hz: float = 1.0, input_before: float = 0.0) -> HysteresisState:
        """Initial state of a model at rest at `input_before`, without a past.

        Args:
            rate_hz: sampling rate, in Hz; used only by a rate-dependent model.
            input_before: input before the record.
        Returns:
            State: the play operators, the filtered rate and the last input.
        Raises:
            InputError: a rate that is not above 0 Hz.
        """
        if not 0.0 < rate_hz < math.inf:
            raise InputError(
                f"rate_hz = {rate_hz:g} Hz; it must be above 0 Hz. Give the sampling rate."
            )
        memory = np.full(len(self.thresholds) + 2, float(input_before))
        memory[-2] = 0.0
        return HysteresisState(memory, rate_hz)

    def feedback(self, rate_hz: float = 1.0) -> float:
        r"""Feedback factor of the inverse's own rate; the inverse is stable below 1.

        $\beta\,g f\,\max_m |p_1 + \dots + p_m| / |p_0 + \dots + p_m|$, from the characteristic
        polynomial $\lambda^2 - (1 - g + c)\lambda + c$ of the inverse on a monotone branch

        Args:
            rate_hz: sampling rate, in Hz.
        Returns:
            The product $c$, dimensionless; 0 when rate-independent.
        """
        moved = np.cumsum(self.weights)
        if self.rate_dependence_s == 0.0 or moved.size == 0:
            return 0.0
        share = float(np.max(np.abs(moved) / np.abs(self.gain + moved)))
        return self.rate_dependence_s * self.pull(rate_hz) * rate_hz * share

    def obstacle(self, rate_hz: float = 1.0) -> str:
        """Why there is no inverse at this rate, and what to do; empty if there is one."""
        slopes = np.cumsum([self.gain, *self.weights])
        if not (slopes * np.sign(self.gain) > 0.0).all():
            return (
                f"The model's slopes after a reversal are {slopes.tolist()}; an inverse needs "
                "slopes other than 0, of one sign. Fit again with fewer operators."
            )
        if not self.dead_zones.invertible:
            return (
                f"The dead zones have the slopes {self.dead_zones.slopes.tolist()}; an inverse "
                "needs slopes above 0. Fit again with fewer dead zones."
            )
        if self.feedback(rate_hz) >= 1.0:
            return (
                f"The feedback factor of the inverse is {self.feedback(rate_hz):.3g}, so it "
                "diverges; it must be below 1. Raise rate_filter_s, or set rate_dependence_s to "
                "0 for a rate-independent inverse."
            )
        return ""

    def _run(self, memory: Floats, rate_hz: float, u: Floats, y: Floats) -> None:
        self.plays(rate_hz).run(memory, u, y)

    def _solve(self, memory: Floats, rate_hz: float, y: Floats, u: Floats) -> None:
        self.plays(rate_hz).invert(memory, y, u)
