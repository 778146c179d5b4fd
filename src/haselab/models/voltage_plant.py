"""From drive voltage to strain: force with the voltage squared, and one kind of creep."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError, JsonObject
from haselab.models.filters import lfilter
from haselab.models.plant import Plant, SlowMode

__all__ = ["CREEPS", "VoltagePlant", "delayed_square"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
CREEPS = ("mechanical", "electrical")


def delayed_square(
    drive_v: Floats,
    rate_hz: float,
    share: float,
    time_constant_s: float,
    slew_v_s: float = math.inf,
) -> Floats:
    r"""Mean square of the effective voltage, one value per update.

    $p = \overline{\bigl((1 - s)\,V + s\,r\bigr)^2},\quad \tau \dot r = V - r$

    A part `s` of the voltage relaxes with the charge of oil and silicone, with its sign; if the
    polarity alternates faster than the time constant, it vanishes.

    Args:
        drive_v: drive, in V, held between updates; the first value has been applied long before.
            `(N,)`.
        rate_hz: update rate, in Hz.
        share: part `s` that relaxes, 0 to below 1.
        time_constant_s: time constant, in s.
        slew_v_s: fastest change of the drive, in V/s: current limit over capacitance and gain.
    Returns:
        Mean square in each update, in V^2. Shape `(N,)`.
    Example:
        >>> drive_v = np.tile([1.0, -1.0], 500)
        >>> p = delayed_square(drive_v, 100.0, 0.5, 0.5)
        >>> float(p[0]), round(float(p[-1]), 2)
        (1.0, 0.25)
    """
    before_v = np.concatenate([drive_v[:1], drive_v[:-1]])
    ramp = np.minimum(np.abs(drive_v - before_v) * rate_hz / slew_v_s, 1.0)
    lost = ramp * (2.0 * drive_v**2 - before_v**2 - before_v * drive_v) / 3.0
    mean_v = drive_v - 0.5 * ramp * (drive_v - before_v)
    if share == 0.0:
        return np.asarray(drive_v**2 - lost)
    decay = math.exp(-1.0 / (rate_hz * time_constant_s))
    start, _ = lfilter([0.0, 1.0 - decay], [1.0, -decay], mean_v - drive_v[0], zi=[0.0])
    relaxed_v = mean_v + math.sqrt(decay) * (start + drive_v[0] - mean_v)
    pulls_v = (1.0 - share) * mean_v + share * relaxed_v
    # A change of the voltage within the update acts by its instantaneous part.
    within = drive_v**2 - lost - mean_v**2
    return np.asarray(pulls_v**2 + (1.0 - share) ** 2 * within)


class _Held:
    """A held input and the output's times, for the states of many poles.

    As `HeldInput`, without sensitivities: model comparison evaluates it most often.
    """

    def __init__(self, u: Floats, rate_hz: float, time_s: Floats) -> None:
        self._u, self._period_s = u, 1.0 / rate_hz
        index = np.floor(time_s * rate_hz + 1e-9).astype(np.intp)
        self._index = np.clip(index, 0, u.size - 1)
        self._rest_s = np.where(index < 0, 0.0, time_s - self._index * self._period_s)
        self._now = np.where(index < 0, 0.0, u[self._index])

    def state(self, pole: complex) -> Complexes:
        """State of `x' = pole x + u` from rest at the output's times."""
        step = cmath.exp(pole * self._period_s)
        edge = lfilter([0.0, (step - 1.0) / pole], [1.0, -step], self._u)
        decay = np.exp(pole * self._rest_s)
        # With a common decay: exp(p t) (x + u/p) - u/p.
        held = self._now / pole
        return np.asarray(decay * (edge[self._index] + held) - held)


def _follows(plant: Plant, held: _Held) -> Floats:
    """Output of a linear plant without its delay, pole by pole."""
    first, second, *slow = plant.poles
    scale = plant.gain * plant.natural_frequency_rad_s**2 / (first - second)
    if first.imag:
        total = 2.0 * (scale * held.state(first)).real
    else:
        total = (scale * (held.state(first) - held.state(second))).real
    for mode, pole in zip(plant.slow_modes, slow, strict=True):
        total = total - mode.gain * pole.real * held.state(pole).real
    return np.asarray(total)


@dataclass(frozen=True)
class VoltagePlant:
    r"""Model from drive voltage to output: squared voltage, one or two resonances, creep.

    $y = \sum_k g_k\, (x^k - x_0^k),\ x = G(s)\, p$; mechanical creep: $p = V^2$ and
    $G = (1 - c)\,G_0 + c/(\tau s + 1)$; electrical creep: $G = G_0$ and $p$ of
    `delayed_square`; $G_0$ is the resonance with the delay. The output is relative to that at the
    first value of the drive, at steady state; further gains make the static curve nonlinear.

    Args:
        creep: "mechanical" or "electrical".
        gains: output per V^2, per V^4, and so on: the static curve.
        natural_frequency_rad_s: undamped natural frequency, in rad/s.
        damping_ratio: damping ratio.
        delay_s: delay, in s.
        creep_share: part of a small step's response that creeps, 0 to below 1.
        creep_time_constant_s: its time constant, in s.
        second_mode: natural frequency in rad/s, damping ratio and static share of another
            resonance in addition to the first one.
    Raises:
        InputError: a value out of range, an unknown kind of creep.
    Source: square of the voltage: Maxwell stress; electrical creep: Maxwell-Wagner charging.
    Example:
        >>> plant = VoltagePlant("mechanical", (0.05,), 5.11, 0.09, 0.0, 0.3, 4.7)
        >>> drive_v = np.concatenate([np.ones(100), np.full(9900, 2.0)])
        >>> round(float(plant.simulate(drive_v, 100.0, np.array([99.0]))[0]), 6)
        0.15
    """

    creep: str
    gains: tuple[float, ...]
    natural_frequency_rad_s: float
    damping_ratio: float
    delay_s: float = 0.0
    creep_share: float = 0.0
    creep_time_constant_s: float = 5.0
    second_mode: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if self.creep not in CREEPS:
            raise InputError(f"creep = {self.creep}; it must be one of {', '.join(CREEPS)}.")
        if not 0.0 <= self.creep_share < 1.0:
            raise InputError(f"creep_share = {self.creep_share:g}; it must be 0 to below 1.")
        if not self.gains:
            raise InputError("gains is empty. Give at least one gain.")
        self._linear()

    def _linear(self) -> Plant:
        """Linear part that the squared voltage passes through."""
        share = self.creep_share if self.creep == "mechanical" else 0.0
        slow = (SlowMode(share, self.creep_time_constant_s),) if share else ()
        other = self.second_mode[2] if self.second_mode else 0.0
        return Plant(
            1.0 - share - other, self.natural_frequency_rad_s, self.damping_ratio, self.delay_s,
            slow,
        )  # fmt: skip

    def shapes(
        self, drive_v: Floats, rate_hz: float, time_s: Floats, slew_v_s: float = math.inf
    ) -> Floats:
        """Responses that the gains multiply: powers of the filtered squared voltage.

        Args:
            drive_v: drive, in V. Shape `(N,)`.
            rate_hz: update rate, in Hz.
            time_s: times of the output since the first update, in s. Shape `(M,)`.
            slew_v_s: as for `delayed_square`.
        Returns:
            Responses. Shape `(M, K)`.
        """
        share = self.creep_share if self.creep == "electrical" else 0.0
        pull = delayed_square(drive_v, rate_hz, share, self.creep_time_constant_s, slew_v_s)
        held = _Held(pull - pull[0], rate_hz, time_s - self.delay_s)
        follows = _follows(self._linear(), held)
        if self.second_mode:
            omega_rad_s, damping, gain = self.second_mode
            follows = follows + _follows(Plant(gain, omega_rad_s, damping), held)
        power = np.arange(1, len(self.gains) + 1)
        return np.asarray((follows[:, None] + pull[0]) ** power - pull[0] ** power)

    def frequency_response(self, omega_rad_s: ArrayLike, baseline_v: float) -> Complexes:
        """Complex gain for small changes about a settled baseline.

        Args:
            omega_rad_s: angular frequency, in rad/s. Shape `(...)`.
            baseline_v: drive at the operating point, in V.
        Returns:
            Output per volt. Shape `(...)`.
        """
        s = 1j * np.asarray(omega_rad_s, dtype=np.float64)
        total = self._linear().frequency_response(omega_rad_s)
        if self.second_mode:
            omega, damping, gain = self.second_mode
            other = Plant(gain, omega, damping, self.delay_s)
            total = total + other.frequency_response(omega_rad_s)
        if self.creep == "electrical":
            c = self.creep_share
            total = total * (1.0 - c + c / (self.creep_time_constant_s * s + 1.0))
        pull = baseline_v**2
        slope = sum(k * gain * pull ** (k - 1) for k, gain in enumerate(self.gains, start=1))
        return np.asarray(total * slope * 2.0 * baseline_v)

    def simulate(
        self, drive_v: ArrayLike, rate_hz: float, time_s: ArrayLike, slew_v_s: float = math.inf
    ) -> Floats:
        """Simulate the output for a held drive.

        Args:
            drive_v: drive, in V; the first value has been applied long before. Shape `(N,)`.
            rate_hz: update rate, in Hz.
            time_s: times of the output since the first update, in s. Shape `(M,)`.
            slew_v_s: fastest change of the drive, in V/s.
        Returns:
            Output relative to that at the start. Shape `(M,)`.
        """
        drive_v = np.asarray(drive_v, dtype=np.float64)
        time_s = np.asarray(time_s, dtype=np.float64)
        shapes = self.shapes(drive_v, rate_hz, time_s, slew_v_s)
        return np.asarray(shapes @ np.array(self.gains))

    def to_dict(self) -> JsonObject:
        """The model as stored in a file under the key `voltage_plant`."""
        return {
            "creep": self.creep,
            "gains": list(self.gains),
            "natural_frequency_rad_s": self.natural_frequency_rad_s,
            "damping_ratio": self.damping_ratio,
            "delay_s": self.delay_s,
            "creep_share": self.creep_share,
            "creep_time_constant_s": self.creep_time_constant_s,
            "second_mode": list(self.second_mode) if self.second_mode else None,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> VoltagePlant:
        """Create a model from `to_dict`; a missing or unusable key is an `InputError`."""
        try:
            second = data.get("second_mode")
            return cls(
                str(data["creep"]),
                tuple(float(gain) for gain in data["gains"]),
                float(data["natural_frequency_rad_s"]),
                float(data["damping_ratio"]),
                float(data["delay_s"]),
                float(data["creep_share"]),
                float(data["creep_time_constant_s"]),
                (float(second[0]), float(second[1]), float(second[2])) if second else None,
            )
        except (LookupError, TypeError, AttributeError, ValueError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"The voltage plant is incomplete or has a wrong value: {error}. It needs the "
                "keys of to_dict. Write the model again with `haselab identify model-comparison`."
            ) from error
