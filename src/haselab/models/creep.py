"""Creep: the slow response to a held input, as exponentials, power law or logarithm."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError
from haselab.models.filters import fftconvolve, lfilter

__all__ = [
    "Creep",
    "FractionalCreep",
    "LogarithmicCreep",
    "PowerCreep",
    "PronyCreep",
    "lagged_response",
    "mittag_leffler",
    "superpose",
]

Floats = NDArray[np.float64]
_NODES = 32
_FEW = 32  # number of input changes up to which their responses are summed directly


def mittag_leffler(order: float, x: ArrayLike) -> Floats:
    r"""Mittag-Leffler function of a negative argument, $E_\alpha(-x)$.

    $E_\alpha(-x) = \frac{1}{2\pi i}\int e^z \frac{z^{\alpha-1}}{z^\alpha + x}\,dz$ on a parabola
    about the negative axis; the error is below 1e-12.

    Args:
        order: $\alpha$, above 0, at most 1.
        x: 0 or more. Shape `(...)`.
    Returns:
        Values between 1 and 0. Shape `(...)`.
    Raises:
        InputError: an order or an argument outside its range.
    Source: parabola of Trefethen, Weideman and Schmelzer, BIT 46 (2006), 653; integral of
        Garrappa, SIAM J. Numer. Anal. 53 (2015), 1350.
    Example:
        >>> from scipy.special import erfcx
        >>> x = np.array([0.0, 1.0, 9.0])
        >>> bool(np.abs(mittag_leffler(0.5, x) - erfcx(x)).max() < 1e-12)
        True
    """
    values = np.asarray(x, dtype=np.float64)
    if not 0.0 < order <= 1.0 or not (values >= 0.0).all():
        raise InputError(
            f"The Mittag-Leffler function got the order {order:g} and arguments down to "
            f"{values.min(initial=0.0):g}; the order must be above 0 and at most 1, and the "
            "arguments 0 or more."
        )
    theta = (2.0 * np.arange(_NODES // 2) + 1.0) * math.pi / _NODES
    z = _NODES * (0.1309 - 0.1194 * theta**2 + 0.2500j * theta)
    slope = _NODES * (-0.2388 * theta + 0.2500j)
    # Conjugate nodes give the conjugate, so half of them suffice.
    factor = np.exp(z) * z ** (order - 1.0) * slope
    power = z**order
    total = np.zeros(values.shape)
    for node, weight in zip(power, factor, strict=True):
        total += (weight / (node + values)).imag
    return 2.0 / _NODES * total


class Creep(ABC):
    """Linear creep: `compliance` is the response to a unit step; superposition does the rest."""

    @abstractmethod
    def compliance(self, time_s: ArrayLike) -> Floats:
        """Response to a unit step at time 0, per unit of input.

        Args:
            time_s: times since the step, 0 or more, in s. Shape `(...)`.
        Returns:
            Compliance. Shape `(...)`.
        """

    def simulate(self, u: ArrayLike, rate_hz: float) -> Floats:
        """Simulate the exact output right after each update of a held input.

        Args:
            u: inputs; before the first one the input was 0. Shape `(N,)`.
            rate_hz: update rate, in Hz.
        Returns:
            Outputs. Shape `(N,)`.
        Raises:
            InputError: an input that is not a finite vector, a rate not above 0 Hz.
        """
        inputs = _held(u, rate_hz)
        answer = self.compliance(np.arange(inputs.size) / rate_hz)
        return superpose(inputs, answer)


def superpose(inputs: Floats, answer: Floats) -> Floats:
    """Sum of the responses to all changes of the input. Shape `(N,)` each."""
    changes = np.diff(inputs, prepend=0.0)
    at = np.flatnonzero(changes)
    if at.size > _FEW:
        return np.asarray(fftconvolve(changes, answer)[: inputs.size])
    total = np.zeros(inputs.size)
    for k in at:
        total[k:] += changes[k] * answer[: inputs.size - k]
    return total


def _held(u: ArrayLike, rate_hz: float) -> Floats:
    inputs = np.asarray(u, dtype=np.float64)
    if inputs.ndim != 1 or not np.isfinite(inputs).all() or not 0.0 < rate_hz < math.inf:
        raise InputError(
            f"The held input has shape {inputs.shape} at {rate_hz:g} Hz, or contains NaN; it must "
            "be a finite vector at a rate above 0 Hz. Remove rows without a value."
        )
    return inputs


def _checked(names: str, numbers: tuple[float, ...], positive: tuple[float, ...]) -> None:
    if not np.isfinite(numbers).all() or not all(value > 0.0 for value in positive):
        raise InputError(
            f"The creep has {names} = {numbers}; they must be finite, and time constants and "
            "orders above 0."
        )


@dataclass(frozen=True)
class PronyCreep(Creep):
    r"""A spring and Kelvin-Voigt branches: $J(t) = J_0 + \sum_i J_i\,(1 - e^{-t/\tau_i})$.

    Args:
        instant: $J_0$, output per unit of input.
        gains: $J_i$, the same unit. Shape `(n,)`.
        time_constants_s: $\tau_i$, in s. Shape `(n,)`.
    Raises:
        InputError: unequal lengths, NaN, a time constant that is not above 0 s.
    Source: Kelvin-Voigt branches in series, Findley, Lai and Onaran, Creep and Relaxation (1976).
    Example:
        >>> creep = PronyCreep(1.0, (0.5,), (2.0,))
        >>> bool(abs(creep.simulate(np.ones(5), 1.0)[4] - (1.5 - 0.5 * np.exp(-2.0))) < 1e-15)
        True
    """

    instant: float
    gains: tuple[float, ...] = ()
    time_constants_s: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.gains) != len(self.time_constants_s):
            raise InputError(
                f"The creep has {len(self.gains)} gains and {len(self.time_constants_s)} time "
                "constants. Give one time constant for each gain."
            )
        numbers = (self.instant, *self.gains, *self.time_constants_s)
        _checked("instant, gains, time_constants_s", numbers, self.time_constants_s)

    def compliance(self, time_s: ArrayLike) -> Floats:
        """Response to a unit step at time 0, per unit of input. Shape of `time_s`, in s."""
        t = np.asarray(time_s, dtype=np.float64)
        branches = zip(self.gains, self.time_constants_s, strict=True)
        grown = sum((-gain * np.expm1(-t / tau_s) for gain, tau_s in branches), np.zeros(t.shape))
        return np.asarray(self.instant + grown)

    def simulate(self, u: ArrayLike, rate_hz: float) -> Floats:
        """Simulate the output as `Creep.simulate`, by one recursion per branch."""
        inputs = _held(u, rate_hz)
        total = self.instant * inputs
        for gain, tau_s in zip(self.gains, self.time_constants_s, strict=True):
            total = total + gain * lagged_response(inputs, rate_hz, tau_s)
        return total

    def invert(self, y: ArrayLike, rate_hz: float) -> Floats:
        """Compute the held input whose output is `y` after each update: the feed-forward.

        Args:
            y: desired outputs. Shape `(N,)`.
            rate_hz: update rate, in Hz.
        Returns:
            Inputs. Shape `(N,)`.
        Raises:
            InputError: no instantaneous response, or branches of opposite sign that exceed it:
                no input, or only a growing one, gives the output at once.
        """
        outputs = _held(y, rate_hz)
        # Each branch is a filter b/(1 - a z^-1) of the previous input.
        numerator, denominator = np.array([self.instant]), np.array([1.0])
        for gain, tau_s in zip(self.gains, self.time_constants_s, strict=True):
            stay = math.exp(-1.0 / (rate_hz * tau_s))
            branch = gain * np.array([0.0, -math.expm1(-1.0 / (rate_hz * tau_s))])
            numerator = np.polyadd(
                np.convolve(numerator, [1.0, -stay])[::-1], np.convolve(branch, denominator)[::-1]
            )[::-1]
            denominator = np.convolve(denominator, [1.0, -stay])
        if self.instant == 0.0 or (np.abs(np.roots(numerator)) >= 1.0).any():
            raise InputError(
                f"The instantaneous response is {self.instant:g}, so there is no stable inverse; "
                "it must exceed the opposing creep. Let the controller compensate the creep."
            )
        return np.asarray(lfilter(denominator, numerator, outputs))


def lagged_response(inputs: Floats, rate_hz: float, tau_s: float) -> Floats:
    """Response of `1 - exp(-t/tau)` to a held input, from rest. Shape `(N,)`."""
    step = math.exp(-1.0 / (rate_hz * tau_s))
    push = -math.expm1(-1.0 / (rate_hz * tau_s))
    return np.asarray(lfilter([0.0, push], [1.0, -step], inputs))


@dataclass(frozen=True)
class PowerCreep(Creep):
    r"""A spring and a spring-pot in series: $J(t) = J_0 + J_1\,t^\alpha/\Gamma(1 + \alpha)$.

    It grows without limit: there is no time constant and no final value.

    Args:
        instant: $J_0$, output per unit of input.
        gain: $J_1$, output per unit of input and $\mathrm{s}^{\alpha}$.
        order: $\alpha$, above 0, at most 1.
    Raises:
        InputError: a parameter outside its range.
    Source: Mainardi, Fractional Calculus and Waves in Linear Viscoelasticity (2010), section 3.
    Example:
        >>> float(PowerCreep(1.0, 0.5, 1.0).compliance(3.0))
        2.5
    """

    instant: float
    gain: float
    order: float

    def __post_init__(self) -> None:
        numbers = (self.instant, self.gain, self.order)
        _checked("instant, gain, order", numbers, (self.order, 1.0 + 1e-12 - self.order))

    def compliance(self, time_s: ArrayLike) -> Floats:
        """Response to a unit step at time 0, per unit of input. Shape of `time_s`, in s."""
        t = np.asarray(time_s, dtype=np.float64)
        return np.asarray(self.instant + self.gain * t**self.order / math.gamma(1.0 + self.order))


@dataclass(frozen=True)
class LogarithmicCreep(Creep):
    r"""Logarithmic creep: $J(t) = J_0 + J_1\,\ln(1 + t/\tau)$.

    It grows without limit, by the same amount in each decade of time after $\tau$.

    Args:
        instant: $J_0$, output per unit of input.
        gain: $J_1$, the same unit, per factor e of time.
        time_constant_s: $\tau$, in s.
    Raises:
        InputError: a parameter outside its range.
    Source: Phillips, Phil. Mag. 9 (1905), 513; usual for piezoelectric and polymer actuators.
    Example:
        >>> round(float(LogarithmicCreep(1.0, 0.5, 2.0).compliance(2.0)), 6)
        1.346574
    """

    instant: float
    gain: float
    time_constant_s: float

    def __post_init__(self) -> None:
        numbers = (self.instant, self.gain, self.time_constant_s)
        _checked("instant, gain, time_constant_s", numbers, (self.time_constant_s,))

    def compliance(self, time_s: ArrayLike) -> Floats:
        """Response to a unit step at time 0, per unit of input. Shape of `time_s`, in s."""
        t = np.asarray(time_s, dtype=np.float64)
        return np.asarray(self.instant + self.gain * np.log1p(t / self.time_constant_s))


@dataclass(frozen=True)
class FractionalCreep(Creep):
    r"""A spring and a fractional Kelvin-Voigt branch (Cole-Cole):
    $J(t) = J_0 + J_1\,(1 - E_\alpha(-(t/\tau)^\alpha))$.

    It covers a band of time constants about $\tau$; order 1 is one Prony branch.

    Args:
        instant: $J_0$, output per unit of input.
        gain: $J_1$, the same unit.
        order: $\alpha$, above 0, at most 1.
        time_constant_s: $\tau$, in s.
    Raises:
        InputError: a parameter outside its range.
    Source: Mainardi, Fractional Calculus and Waves in Linear Viscoelasticity (2010), section 3.
    Example:
        >>> whole = FractionalCreep(1.0, 0.5, 1.0, 2.0).compliance(4.0)
        >>> bool(abs(whole - PronyCreep(1.0, (0.5,), (2.0,)).compliance(4.0)) < 1e-12)
        True
    """

    instant: float
    gain: float
    order: float
    time_constant_s: float

    def __post_init__(self) -> None:
        numbers = (self.instant, self.gain, self.order, self.time_constant_s)
        positive = (self.order, 1.0 + 1e-12 - self.order, self.time_constant_s)
        _checked("instant, gain, order, time_constant_s", numbers, positive)

    def compliance(self, time_s: ArrayLike) -> Floats:
        """Response to a unit step at time 0, per unit of input. Shape of `time_s`, in s."""
        t = np.asarray(time_s, dtype=np.float64)
        left = mittag_leffler(self.order, (t / self.time_constant_s) ** self.order)
        return np.asarray(self.instant + self.gain * (1.0 - left))
