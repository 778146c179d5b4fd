"""A rational transfer function with a delay: the form for exchange with other tools."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError, JsonObject
from haselab.models.held_input import HeldInput
from haselab.models.plant import Plant, SlowMode

__all__ = ["RationalModel"]

Floats = NDArray[np.float64]
_REAL = 1e-7
_NO_ZERO = 1e-6
_EQUAL = 1e-6


@dataclass(frozen=True)
class RationalModel:
    r"""$y = \frac{b_m s^m + \dots + b_0}{s^n + \dots + a_0}\, e^{-s T_d}\, u$.

    Args:
        numerator: coefficients of falling powers of `s`, in rad/s; leading zeros are dropped.
        denominator: coefficients of falling powers, normalised to a leading 1.
        delay_s: delay, in s.
        input_name: name of the input.
        output_name: name of the output.
    Raises:
        InputError: coefficients that are not finite, no denominator, more zeros than poles, a
            negative delay.
    Example:
        >>> model = RationalModel.from_plant(Plant(0.5, 5.0, 0.1))
        >>> [round(factor, 9) for factor in model.denominator]
        [1.0, 1.0, 25.0]
        >>> round(model.to_plant().damping_ratio, 9)
        0.1
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    delay_s: float = 0.0
    input_name: str = "u"
    output_name: str = "y"

    def __post_init__(self) -> None:
        top, bottom = _trimmed("numerator", self.numerator), _trimmed(
            "denominator", self.denominator
        )  # fmt: skip
        if not bottom.any():
            raise InputError("The denominator is 0. Give a nonzero polynomial.")
        if top.size > bottom.size:
            raise InputError(
                f"The model has {top.size - 1} zeros and {bottom.size - 1} poles; it must have at "
                "most as many zeros as poles."
            )
        if not 0.0 <= self.delay_s < math.inf:
            raise InputError(f"delay_s = {self.delay_s:g} s; it must be 0 s or above.")
        object.__setattr__(self, "numerator", tuple((top / bottom[0]).tolist()))
        object.__setattr__(self, "denominator", tuple((bottom / bottom[0]).tolist()))

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Poles, in rad/s."""
        return np.asarray(np.roots(self.denominator), dtype=np.complex128)

    @property
    def zeros(self) -> NDArray[np.complex128]:
        """Zeros, in rad/s."""
        return np.asarray(np.roots(self.numerator), dtype=np.complex128)

    def frequency_response(self, omega_rad_s: ArrayLike) -> NDArray[np.complex128]:
        """Complex gain at angular frequencies.

        Args:
            omega_rad_s: angular frequency, in rad/s. Shape `(...)`.
        Returns:
            Complex gain, in the unit of the output per unit of the input. Shape `(...)`.
        """
        s = 1j * np.asarray(omega_rad_s, dtype=np.float64)
        ratio = np.polyval(self.numerator, s) / np.polyval(self.denominator, s)
        return np.asarray(ratio * np.exp(-s * self.delay_s), dtype=np.complex128)

    def simulate(self, u: ArrayLike, input_rate_hz: float, time_s: ArrayLike) -> Floats:
        """Simulate the exact output from rest for a held input.

        The input is zero before `t = 0` and keeps its last value after its end. Equal poles, and
        one at 0, are moved apart by a millionth of the fastest pole.

        Args:
            u: input. Shape `(N,)`.
            input_rate_hz: update rate of the input, in Hz.
            time_s: times of the output after the update of `u[0]`, in s. Shape `(M,)`.
        Returns:
            Output. Shape `(M,)`.
        Source: partial fractions, and variation of constants for each pole.
        """
        held = HeldInput(np.ascontiguousarray(u, dtype=np.float64), input_rate_hz)
        after_s = np.asarray(time_s, dtype=np.float64) - self.delay_s
        through = self.numerator[0] if len(self.numerator) == len(self.denominator) else 0.0
        rest = np.polysub(self.numerator, through * np.array(self.denominator))
        poles = _apart(self.poles)
        index = np.clip(
            np.floor(after_s * input_rate_hz + 1e-9).astype(np.intp), 0, held.u.size - 1
        )
        total = np.where(after_s < 0.0, 0.0, through * held.u[index]).astype(np.complex128)
        for k, pole in enumerate(poles):
            residue = np.polyval(rest, pole) / np.prod(pole - np.delete(poles, k))
            total += residue * held.response(complex(pole), after_s).state
        return np.ascontiguousarray(total.real)

    def without_delay(self, order: int) -> RationalModel:
        r"""Replace the delay by an all-pass, or remove it.

        $e^{-sT} \approx \sum_k c_k (-sT)^k / \sum_k c_k (sT)^k,\quad
        c_k = \frac{(2n - k)!\, n!}{(2n)!\, k!\, (n - k)!}$

        Args:
            order: of the all-pass, 0 to 10; 0 removes the delay. The magnitude is exact; the
                phase is right to 0.1 degrees up to `omega T` of 0.27, 1.0, 3.4 at orders 1, 2, 4.
        Raises:
            InputError: an order out of range.
        Source: Padé's approximant of the exponential function.
        """
        if not 0 <= order <= 10:
            raise InputError(f"order = {order}; it must be 0 to 10.")
        if self.delay_s == 0.0 or order == 0:
            return replace(self, delay_s=0.0)
        powers = np.arange(order, -1, -1)
        factors = np.array(
            [math.comb(order, k) / math.perm(2 * order, k) * self.delay_s**k for k in powers]
        )
        return replace(
            self,
            numerator=tuple(np.polymul(self.numerator, factors * (-1.0) ** powers).tolist()),
            denominator=tuple(np.polymul(self.denominator, factors).tolist()),
            delay_s=0.0,
        )

    @classmethod
    def from_plant(cls, plant: Plant) -> RationalModel:
        """Convert a plant to a rational model."""
        wn, zeta = plant.natural_frequency_rad_s, plant.damping_ratio
        resonance = cls((plant.gain * wn**2,), (1.0, 2.0 * zeta * wn, wn**2), plant.delay_s)
        return resonance.beside(plant.slow_modes)

    def beside(self, slow_modes: Sequence[SlowMode]) -> RationalModel:
        """Add parallel slow branches, with the same delay."""
        top, bottom = np.array(self.numerator), np.array(self.denominator)
        for mode in slow_modes:
            branch = np.array([1.0, 1.0 / mode.time_constant_s])
            slow = bottom * mode.gain / mode.time_constant_s
            top, bottom = np.polyadd(np.polymul(top, branch), slow), np.polymul(bottom, branch)
        return replace(self, numerator=tuple(top.tolist()), denominator=tuple(bottom.tolist()))

    @classmethod
    def from_poles(
        cls, poles: ArrayLike, zeros: ArrayLike, gain: float, delay_s: float = 0.0
    ) -> RationalModel:
        """Create a model from its poles and zeros, in rad/s, and its static gain.

        Raises:
            InputError: a pole or zero at 0, or without its conjugate.
        """
        polynomials = []
        for name, roots in (("zeros", zeros), ("poles", poles)):
            values = np.atleast_1d(np.asarray(roots, dtype=np.complex128))
            polynomial = np.atleast_1d(np.poly(values))
            size = max(float(np.abs(values).max(initial=0.0)), 1e-300) ** np.arange(values.size + 1)
            conjugate = bool((np.abs(np.imag(polynomial)) <= _REAL * size).all())
            if not conjugate or not np.isfinite(polynomial).all() or (values == 0.0).any():
                raise InputError(
                    f"{name} = {values.tolist()}; they must be finite and other than 0, complex "
                    "ones with their conjugates."
                )
            polynomials.append(np.real(polynomial))
        top, bottom = polynomials
        top = top * gain * bottom[-1] / top[-1]
        return cls(tuple(top.tolist()), tuple(bottom.tolist()), delay_s)

    def to_plant(self) -> Plant:
        """Convert to one resonance with slow branches, by partial fractions.

        Raises:
            InputError: not two fast poles with real slow ones, an unstable pole, equal
                slow poles, or a zero in the resonance.
        """
        fast, slow = self._fast_and_slow()
        slope = np.polyder(self.denominator)
        residues = [np.polyval(self.numerator, p) / np.polyval(slope, p) for p in slow]
        rest = np.array(self.numerator)
        for pole, residue in zip(slow, residues, strict=True):
            others = np.polydiv(self.denominator, np.array([1.0, -pole]))[0]
            rest = np.polysub(rest, residue * others)
        for pole in slow:
            rest = np.polydiv(rest, np.array([1.0, -pole]))[0]
        rest = np.concatenate([np.zeros(max(0, 3 - rest.size)), rest])[-3:]
        wn = math.sqrt(float(fast[-1]))
        if max(abs(rest[0]) * wn**2, abs(rest[1]) * wn) > _NO_ZERO * abs(rest[2]):
            raise InputError(
                f"The resonance at {wn:g} rad/s has a zero at {_zero(rest):g} rad/s; a Plant must "
                "not have one. Keep the rational form, or fit without zeros."
            )
        branches = [
            SlowMode(float(-r / p), float(-1.0 / p)) for p, r in zip(slow, residues, strict=True)
        ]
        gain, zeta = float(rest[-1]) / wn**2, float(fast[1]) / (2.0 * wn)
        return Plant(gain, wn, zeta, self.delay_s, tuple(branches[::-1]))

    def _fast_and_slow(self) -> tuple[Floats, Floats]:
        """Denominator of the two fast poles, and the slow poles, the fastest first."""
        poles = self.poles
        upper = poles[poles.imag > _REAL * np.abs(poles)]
        real = np.sort(poles.real[np.abs(poles.imag) <= _REAL * np.abs(poles)])
        if poles.size < 2 or upper.size > 1 or (poles.real >= 0.0).any():
            raise InputError(
                f"The poles are {_listed(poles)} rad/s; a Plant needs two fast, stable ones and "
                "real slow ones. Keep the rational form."
            )
        if upper.size:
            fast = np.array([1.0, -2.0 * upper[0].real, abs(upper[0]) ** 2])
        else:
            fast, real = np.poly(real[:2]), real[2:]
        if (np.diff(real) <= _EQUAL * np.abs(real[1:])).any():
            raise InputError(
                f"The slow poles are {_listed(real)} rad/s, two of them equal; a Plant needs "
                "different ones. Keep the rational form."
            )
        return np.asarray(fast, dtype=np.float64), real

    def to_dict(self) -> JsonObject:
        """The model as stored in JSON."""
        return {
            "numerator": list(self.numerator),
            "denominator": list(self.denominator),
            "delay_s": self.delay_s,
            "input": self.input_name,
            "output": self.output_name,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> RationalModel:
        """Create a model from `to_dict`; a missing or unusable key is an `InputError`."""
        try:
            return cls(
                tuple(float(factor) for factor in data["numerator"]),
                tuple(float(factor) for factor in data["denominator"]),
                float(data.get("delay_s", 0.0)),
                str(data.get("input", "u")),
                str(data.get("output", "y")),
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"The model is incomplete or has a wrong value: {error}. It needs numerator and "
                "denominator, lists of numbers. Write the model again with `haselab export`."
            ) from error


def _trimmed(name: str, factors: tuple[float, ...]) -> Floats:
    """The coefficients without leading zeros."""
    values = np.asarray(factors, dtype=np.float64)
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise InputError(
            f"{name} = {factors}; it must be a list of finite numbers, for falling powers of s."
        )
    leading = np.flatnonzero(values)
    return values[leading[0] :] if leading.size else values[-1:]


def _apart(poles: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Poles for partial fractions: none at 0, no two of them equal."""
    least = _EQUAL * float(np.abs(poles).max(initial=1.0))
    moved = poles.copy()
    for k in range(moved.size):
        while abs(moved[k]) < least or (np.abs(moved[:k] - moved[k]) < least).any():
            moved[k] -= least
    return moved


def _zero(rest: Floats) -> float:
    return float(-rest[-1] / rest[-2]) if rest[-2] != 0.0 else math.inf


def _listed(values: NDArray[Any]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)
