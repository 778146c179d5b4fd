"""The PID controller: gains, saturation, and continuous and sampled frequency response."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError
from haselab.controllers import ChosenController, pid_controller

__all__ = ["PidGains", "Saturation", "gain_units", "responses_at", "sampled_responses"]


@dataclass(frozen=True)
class Saturation:
    """Range of the controller's output, in strain.

    Args:
        low: smallest output strain.
        high: largest output strain.
    Raises:
        InputError: the range is empty or not finite.
    Source: reference study, section V: -0.05 <= u <= 0.1, to prevent dielectric breakdown.
    Example:
        >>> Saturation().high
        0.1
    """

    low: float = -0.05
    high: float = 0.1

    def __post_init__(self) -> None:
        if not -math.inf < self.low < self.high < math.inf:
            raise InputError(
                f"saturation = [{self.low:g}, {self.high:g}] is not a range; it must be finite, "
                "with low < high."
            )

    @property
    def start(self) -> float:
        """Strain at which a loop starts: 0, or the end of the range that is nearest to 0.

        Example:
            >>> Saturation().start, Saturation(0.001, 0.08).start
            (0.0, 0.001)
        """
        return min(max(0.0, self.low), self.high)


@dataclass(frozen=True)
class PidGains:
    r"""PI or PID controller; the derivative acts on the filtered measurement.

    $C(s) = k_p + k_i/s + k_d s/(\tau_f s + 1)$. At the sampling instants, with period $T$,
    $I_k = I_{k-1} + k_i e_k T$, $f_k = f_{k-1} + \frac{T}{T+\tau_f}(y_k - f_{k-1})$ and
    $u_k = k_p e_k + I_k - k_d (f_k - f_{k-1})/T$.

    Args:
        kp: proportional gain, in units of the output per unit of the input; a pure number from
            strain to strain.
        ki: integral gain, in the unit of `kp` per second.
        kd: derivative gain, in the unit of `kp` times seconds.
        derivative_filter_s: time constant of the measurement's filter, in s.
    Raises:
        InputError: a gain is negative or not finite.
    Example:
        >>> PidGains(kp=0.85, ki=1.5).frequency_response(1.5)
        array(0.85-1.j)
    """

    kp: float
    ki: float
    kd: float = 0.0
    derivative_filter_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("kp", "ki", "kd", "derivative_filter_s"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise InputError(f"{name} = {value!r}; it must be finite, 0 or more.")

    def controller(self) -> ChosenController:
        """The same PID as a registered controller for the runner."""
        return pid_controller(self.kp, self.ki, self.kd, self.derivative_filter_s)

    def jump_gain(self, rate_hz: float) -> float:
        """Change of the output when one measurement changes by 1: the noise gain.

        Example:
            >>> round(PidGains(1.0, 0.0, 0.5, 0.04).jump_gain(100.0), 6)
            11.0
        """
        period_s = 1.0 / rate_hz
        derivative = self.kd / (period_s + self.derivative_filter_s)
        return self.kp + self.ki * period_s + derivative

    def frequency_response(self, omega_rad_s: ArrayLike) -> NDArray[np.complex128]:
        """Response from error to output of the continuous controller.

        Args:
            omega_rad_s: positive angular frequencies, in rad/s. Shape `(...)`.
        Returns:
            Complex response of the same shape.
        """
        s = 1j * np.asarray(omega_rad_s, dtype=float)
        derivative = self.kd * s / (self.derivative_filter_s * s + 1.0)
        return np.asarray(self.kp + self.ki / s + derivative)

    def sampled_response(self, omega_rad_s: ArrayLike, rate_hz: float) -> NDArray[np.complex128]:
        """Response of the controller as the C core computes it, in discrete time.

        Args:
            omega_rad_s: angular frequencies in (0, pi * rate_hz], in rad/s. Shape `(...)`.
            rate_hz: sampling rate, in Hz.
        Returns:
            Complex response of the same shape.
        Example:
            >>> complex(PidGains(0.85, 1.5).sampled_response(314.159265358979, 100.0).round(6))
            (0.8575-0j)
        """
        return np.asarray(sampled_responses([self], omega_rad_s, rate_hz)[0])


def sampled_responses(
    gains: Sequence[PidGains], omega_rad_s: ArrayLike, rate_hz: float
) -> NDArray[np.complex128]:
    """Responses of many controllers as the C core computes them, in discrete time.

    Args:
        gains: controllers. Length `C`.
        omega_rad_s: angular frequencies in (0, pi * rate_hz], in rad/s. Shape `(...)`.
        rate_hz: sampling rate, in Hz.
    Returns:
        Complex responses. Shape `(C, ...)`.
    """
    z = np.exp(1j * np.asarray(omega_rad_s, dtype=float) * (1.0 / rate_hz))
    return responses_at(gains, z, rate_hz)


def responses_at(
    gains: Sequence[PidGains], z: NDArray[np.complex128], rate_hz: float
) -> NDArray[np.complex128]:
    """`sampled_responses` at points of the unit circle, `z = exp(j omega / rate)`."""
    period_s = 1.0 / rate_hz
    numbers = np.array([(g.kp, g.ki, g.kd, g.derivative_filter_s) for g in gains])
    kp, ki, kd, tau = numbers.T.reshape(4, len(gains), *(1,) * z.ndim)
    response = kp + ki * period_s * z / (z - 1.0)
    if kd.any():
        response = response + kd * (z - 1.0) / ((tau + period_s) * z - tau)
    return np.asarray(response)


def gain_units(source: str, output: str, *, strains: bool = False) -> dict[str, str]:
    """Units of a design's gains, limits and step, by the units of the model that it controls.

    Args:
        source: SI unit of the model's input; "1": a pure number; empty: not known.
        output: likewise of its output.
        strains: whether input and output are known to be strains.
    Returns:
        Units by name; without those that are not known.
    """
    relative = ("overshoot", "steady_state_error", "worst_overshoot")
    known = dict.fromkeys(relative, "of the step")
    if strains:
        return known | {"limits": "strain", "step": "strain", "kp": "strain/strain", "ki": "1/s",
                        "kd": "s"}  # fmt: skip
    known |= {"limits": source, "step": output}
    if source and output:
        over = "" if output == "1" else f"/{output}"
        above = "1" if source == output else source
        under = over if source != output else ""
        known["kp"] = above + under if above + under != "1" else ""
        known["ki"] = f"{above}/({output} s)" if under else f"{above}/s"
        known["kd"] = f"{above} s{under}" if above != "1" else f"s{under}"
    return {name: unit for name, unit in known.items() if unit}
