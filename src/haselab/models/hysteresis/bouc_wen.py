"""Bouc-Wen hysteresis in its normalised form, with an inverse that has no delay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab import _models
from haselab.base import InputError
from haselab.models.hysteresis.common import NO_DEAD_ZONES, DeadZones, Hysteresis, HysteresisState

__all__ = ["BoucWen"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BoucWen(Hysteresis):
    r"""Normalised Bouc-Wen model: a line plus a memory state within $\pm 1$, then dead zones.

    $y = S(c + k_u u + k_w w),\quad \dot w = \varrho\,(\dot u - \sigma |\dot u| |w|^{n-1} w
    + (\sigma - 1)\,\dot u\,|w|^n)$

    No parameter is redundant, unlike in $\dot h = A \dot u - \beta|\dot u||h|^{n-1}h
    - \gamma\dot u|h|^n$: there $h = w_0 w$ with $w_0 = (A/(\beta+\gamma))^{1/n}$, and
    $\varrho = A/w_0$, $\sigma = \beta/(\beta+\gamma)$. Rate-independent: stepped in `u`, in
    closed form for $n = 1$, else by Runge-Kutta steps that hit $w = 0$.

    Args:
        gain: $k_u$, output per unit of input.
        weight: $k_w$, in the unit of the output; opposite in sign to `gain` if the output lags.
        sharpness: $\varrho$, per unit of input, above 0; its inverse is the length of the bend of
            a branch.
        sigma: $\sigma$, 1/2 or more.
        exponent: $n$, 1 or more.
        offset: $c$.
        dead_zones: $S$.
    Raises:
        InputError: a parameter outside its range.
    Source: Ikhouane and Rodellar, Systems with Hysteresis (2007), section 2.5; inverse by the
        multiplicative structure of Rakotondrabe, IEEE Trans. Autom. Sci. Eng. 8 (2011), 428,
        solved for the same sample instead of using the previous memory state.
    Example:
        >>> model = BoucWen(1.0, -0.2, 2.0)
        >>> bool(abs(model.simulate([0.5])[0] - (0.5 - 0.2 * (1 - np.exp(-1.0)))) < 1e-15)
        True
    """

    gain: float
    weight: float
    sharpness: float
    sigma: float = 1.0
    exponent: float = 1.0
    offset: float = 0.0
    dead_zones: DeadZones = NO_DEAD_ZONES

    def __post_init__(self) -> None:
        own = (self.gain, self.weight, self.sharpness, self.sigma, self.exponent, self.offset)
        if not np.isfinite(own).all():
            raise InputError(f"The Bouc-Wen model has the parameters {own}; they must be finite.")
        if not (self.sharpness > 0.0 and self.sigma >= 0.5 and self.exponent >= 1.0):
            raise InputError(
                f"sharpness = {self.sharpness:g}, sigma = {self.sigma:g}, exponent = "
                f"{self.exponent:g}; they must be above 0, 0.5 or more, and 1 or more."
            )

    def init(self, rate_hz: float = 1.0, input_before: float = 0.0) -> HysteresisState:
        """Initial state of a model at rest at `input_before`, without a past.

        Args:
            rate_hz: sampling rate, in Hz; the model does not depend on it.
            input_before: input before the record.
        Returns:
            State: the memory state w and the last input.
        """
        return HysteresisState(np.array([0.0, float(input_before)]), rate_hz)

    def obstacle(self, rate_hz: float = 1.0) -> str:
        """Why there is no inverse, and what to do; empty if there is one."""
        # dw/du reaches 2 sigma sharpness after a reversal, and 0 in saturation.
        added = self.weight * self.sharpness * 2.0 * self.sigma
        lowest = self.gain + added if added * self.gain < 0.0 else self.gain
        if lowest * self.gain <= 0.0:
            return (
                f"After a reversal the slope may be {lowest:.3g} at a gain of {self.gain:.3g}, "
                "so the output does not determine the input; an inverse needs slopes of one "
                "sign. Use play operators."
            )
        if not self.dead_zones.invertible:
            return (
                f"The dead zones have the slopes {self.dead_zones.slopes.tolist()}; an inverse "
                "needs slopes above 0. Fit again with fewer dead zones."
            )
        return ""

    def _run(self, memory: Floats, rate_hz: float, u: Floats, y: Floats) -> None:
        _models.run_bouc_wen(self.sharpness, self.sigma, self.exponent, memory, u, y)
        y *= self.weight
        y += self.gain * u

    def _solve(self, memory: Floats, rate_hz: float, y: Floats, u: Floats) -> None:
        _models.invert_bouc_wen(
            self.sharpness, self.sigma, self.exponent, self.gain, self.weight, memory, y, u
        )
