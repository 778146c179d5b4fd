"""The linear plant: one resonance, parallel slow branches and a delay."""

from __future__ import annotations

import cmath
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError, JsonObject, check_fields, checked, real_array
from haselab.models.held_input import HeldInput

__all__ = ["Plant", "SlowMode"]

# The modal form is singular for two equal poles; if the damping ratio is closer to 1 than this,
# the pair is moved apart, which changes a response by about 1e-9 of its magnitude.
_CRITICAL_BAND = 1e-9


def _require(name: str, value: float, unit: str, *, positive: bool) -> None:
    allowed = "above 0" if positive else "0 or above"
    if not (value > 0.0 if positive else value >= 0.0) or value == float("inf"):
        raise InputError(f"{name} = {value:g} {unit}; it must be {allowed} and finite.")


@dataclass(frozen=True)
class SlowMode:
    """A slow branch `gain / (time_constant_s s + 1)`: creep of the shell, or charging of the oil.

    Args:
        gain: static gain, in the unit of the output per unit of the input.
        time_constant_s: time constant, in s.
    """

    gain: float
    time_constant_s: float

    def __post_init__(self) -> None:
        check_fields(self)
        _require("time_constant_s", self.time_constant_s, "s", positive=True)


@dataclass(frozen=True)
class Plant:
    r"""A resonance with parallel slow branches and a delay.

    $y = \left[\frac{g\,\omega_n^2}{s^2 + 2\zeta\omega_n s + \omega_n^2}
    + \sum_i \frac{c_i}{\tau_i s + 1}\right] e^{-s T_d} u$

    Args:
        gain: static gain of the resonance, in the unit of the output per unit of the input.
        natural_frequency_rad_s: undamped natural frequency, in rad/s.
        damping_ratio: damping ratio; 1 and above give real poles.
        delay_s: delay, in s.
        slow_modes: slow branches.
    Raises:
        InputError: a frequency or time constant not above zero, a negative damping or delay.
    Source: reference study, eqs. 8 to 10; the slow branches are an extension of this project.
    Example:
        >>> plant = Plant(0.5, 5.11, 0.09, slow_modes=(SlowMode(0.4, 4.7),))
        >>> plant.static_gain, round(float(abs(plant.frequency_response(5.11))), 2)
        (0.9, 2.79)
    """

    gain: float
    natural_frequency_rad_s: float
    damping_ratio: float
    delay_s: float = 0.0
    slow_modes: tuple[SlowMode, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)
        _require("natural_frequency_rad_s", self.natural_frequency_rad_s, "rad/s", positive=True)
        _require("damping_ratio", self.damping_ratio, "", positive=False)
        _require("delay_s", self.delay_s, "s", positive=False)

    @property
    def static_gain(self) -> float:
        """Static gain, including the slow branches."""
        return self.gain + sum(mode.gain for mode in self.slow_modes)

    @property
    def poles(self) -> tuple[complex, ...]:
        """Poles, in rad/s: the pair of the resonance, then one per slow branch."""
        slow = (complex(-1.0 / mode.time_constant_s) for mode in self.slow_modes)
        return (*self._pair(), *slow)

    def _pair(self) -> tuple[complex, complex]:
        zeta, omega_rad_s = self.damping_ratio, self.natural_frequency_rad_s
        spread = zeta * zeta - 1.0
        if abs(spread) < 2.0 * _CRITICAL_BAND:
            spread = 2.0 * _CRITICAL_BAND
        root = cmath.sqrt(spread)
        fast = -omega_rad_s * (zeta + root)
        return (omega_rad_s * omega_rad_s / fast, fast)

    @checked
    def frequency_response(self, omega_rad_s: ArrayLike) -> NDArray[np.complex128]:
        """Complex gain at angular frequencies.

        Args:
            omega_rad_s: angular frequency, in rad/s. Shape `(...)`.
        Returns:
            Complex gain, in the unit of the output per unit of the input. Shape `(...)`.
        """
        s = 1j * real_array("omega_rad_s", omega_rad_s)
        wn = self.natural_frequency_rad_s
        total = self.gain * wn**2 / (s * s + 2.0 * self.damping_ratio * wn * s + wn**2)
        for mode in self.slow_modes:
            total = total + mode.gain / (mode.time_constant_s * s + 1.0)
        return np.asarray(total * np.exp(-s * self.delay_s), dtype=np.complex128)

    @checked
    def simulate(
        self,
        u: ArrayLike,
        input_rate_hz: float,
        time_s: ArrayLike,
        initial_state: Sequence[float] | None = None,
    ) -> NDArray[np.float64]:
        """Simulate the exact output for a held input.

        The input is zero before `t = 0` and keeps its last value after its end.

        Args:
            u: input. Shape `(N,)`.
            input_rate_hz: update rate of the input, in Hz.
            time_s: times of the output after the update of `u[0]`, in s. Shape `(M,)`.
            initial_state: at `t = 0`: output of the resonance, its rate per second, output of each
                slow branch. Zero when not given. Shape `(2 + slow branches,)`.
        Returns:
            Output. Shape `(M,)`.
        Raises:
            InputError: `u` or the times are not finite vectors, or the state has a wrong length.
        Source: variation of constants, pole by pole; no step-size error.
        """
        held = HeldInput(np.ascontiguousarray(real_array("u", u)), input_rate_hz)
        time_s = real_array("time_s", time_s)
        if time_s.ndim != 1 or not np.isfinite(time_s).all():
            raise InputError(
                f"time_s has shape {time_s.shape} or contains NaN; it must be a finite vector. "
                "Give one time for each output."
            )
        after_s = time_s - self.delay_s
        slow_pole, fast_pole = self._pair()
        scale = self.gain * self.natural_frequency_rad_s**2 / (slow_pole - fast_pole)
        total = scale * held.response(slow_pole, after_s).state
        total = total - scale * held.response(fast_pole, after_s).state
        for mode in self.slow_modes:
            rate_per_s = 1.0 / mode.time_constant_s
            state = held.response(complex(-rate_per_s), after_s).state
            total = total + mode.gain * rate_per_s * state
        output: NDArray[np.float64] = np.ascontiguousarray(total.real)
        return output if initial_state is None else output + self._free(time_s, initial_state)

    def _free(self, time_s: NDArray[np.float64], state: Sequence[float]) -> NDArray[np.float64]:
        """Free response from a state at `t = 0`."""
        if len(state) != 2 + len(self.slow_modes):
            raise InputError(
                f"initial_state has {len(state)} values; this plant needs "
                f"{2 + len(self.slow_modes)}. Give output, rate, and one for each slow branch."
            )
        a, b = self._pair()
        first = (b * state[0] - state[1]) / (b - a)
        total = first * np.exp(a * time_s) + (state[0] - first) * np.exp(b * time_s)
        for mode, value in zip(self.slow_modes, state[2:], strict=True):
            total = total + value * np.exp(-time_s / mode.time_constant_s)
        return np.ascontiguousarray(total.real)

    def to_dict(self) -> JsonObject:
        """The plant as stored in `model.json` under the key `plant`."""
        return {
            "gain": self.gain,
            "natural_frequency_rad_s": self.natural_frequency_rad_s,
            "damping_ratio": self.damping_ratio,
            "delay_s": self.delay_s,
            "slow_modes": [
                {"gain": mode.gain, "time_constant_s": mode.time_constant_s}
                for mode in self.slow_modes
            ],
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Plant:
        """Create a plant from `to_dict`; a missing or unusable key is an `InputError`."""
        try:
            return cls(
                float(data["gain"]),
                float(data["natural_frequency_rad_s"]),
                float(data["damping_ratio"]),
                float(data.get("delay_s", 0.0)),
                tuple(
                    SlowMode(float(mode["gain"]), float(mode["time_constant_s"]))
                    for mode in data.get("slow_modes", ())
                ),
            )
        except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"The plant is incomplete or has a wrong value: {error}. It needs gain, "
                "natural_frequency_rad_s, damping_ratio. Write the model again with `haselab "
                "identify transfer`."
            ) from error
