"""Margins of many controllers for one plant, on one frequency grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from haselab.control.gains import PidGains, responses_at
from haselab.control.plants.general import AnyPlant, sampled_response_of
from haselab.control.simulate import LoopSetting
from haselab.control.stability.encirclement import axis_factor, open_loop_poles
from haselab.control.stability.margins import frequency_grid

__all__ = ["GridMargins", "PlantGrid"]

_TYPICAL = PidGains(1.0, 1.0, 0.1)  # determines the range of the grid
_REAL = 0.1  # |imaginary part| over the size of a response that counts as real
_LARGEST_TURN = 1.5  # rad between neighbours; half a turn would hide a whole one


@dataclass(frozen=True)
class GridMargins:
    """Margins, accurate to a few per mille; each has shape `(C,)`.

    Args:
        phase_margin_deg: smallest distance of the phase from -180 degrees next to a crossover.
        gain_margin_db: smallest change of gain, up or down, to a crossing of the negative
            real axis.
        peak_sensitivity: largest `|1/(1 + L)|` on the grid.
        crossover_rad_s: highest crossover, 0 without one.
        stable: whether the loop is stable by the encirclement count on the grid.
        resolved: whether the grid is fine enough for that count.
    """

    phase_margin_deg: NDArray[np.float64]
    gain_margin_db: NDArray[np.float64]
    peak_sensitivity: NDArray[np.float64]
    crossover_rad_s: NDArray[np.float64]
    stable: NDArray[np.bool_]
    resolved: NDArray[np.bool_]


@dataclass(frozen=True)
class PlantGrid:
    """A plant's sampled response on its grid, for use with many controllers.

    Args:
        plant: plant.
        rate_hz: sampling rate, in Hz.
        omega_rad_s: angular frequencies. Shape `(F,)`.
        response: including the hold and all delays. Shape `(F,)`.
    """

    plant: AnyPlant
    rate_hz: float
    omega_rad_s: NDArray[np.float64]
    response: NDArray[np.complex128]

    @classmethod
    def of(cls, plant: AnyPlant, setting: LoopSetting, points: int = 450) -> PlantGrid:
        """Create the grid of a plant; a third of `points` is added near the resonance."""
        omega = frequency_grid(plant, _TYPICAL, setting.rate_hz, points)
        sampled = sampled_response_of(
            plant, omega, setting.rate_hz, setting.measurement_delay_s, setting.feedthrough
        )
        keep = np.isfinite(sampled)
        return cls(plant, setting.rate_hz, omega[keep], sampled[keep])

    @cached_property
    def _circle(self) -> NDArray[np.complex128]:
        """Points of the unit circle."""
        return np.asarray(np.exp(1j * self.omega_rad_s * (1.0 / self.rate_hz)))

    @cached_property
    def _open_loop(self) -> tuple[int, dict[bool, NDArray[np.complex128]]]:
        """Number of poles right of the axis, and the factor for those on it.

        The factor depends on whether the controller integrates.
        """
        factors = {}
        for integrates in (True, False):
            right, axis = open_loop_poles(self.plant, PidGains(1.0, float(integrates)))
            factors[integrates] = axis_factor(axis, self.omega_rad_s, self.rate_hz, 1.0)
        return right, factors

    def margins(self, candidates: Sequence[PidGains], *, between: bool = False) -> GridMargins:
        """Margins of the loop with each candidate.

        Args:
            candidates: controllers. Length `C`.
            between: whether a crossing is interpolated between its two neighbours, for margins
                accurate to 0.1 dB and 0.5 degrees; otherwise the worse neighbour is used.
        Returns:
            The margins, in the order of the candidates.
        """
        omega = self.omega_rad_s
        loop = self.response * responses_at(candidates, self._circle, self.rate_hz)
        stable, resolved = self._count(loop, candidates)
        above = np.abs(loop) > 1.0
        crosses = above[:, 1:] != above[:, :-1]
        phase_deg = np.full(len(candidates), np.inf)
        row, at = np.nonzero(crosses)
        np.minimum.at(phase_deg, row, _phase(loop[row, at], loop[row, at + 1], between))
        upper = loop.imag > 0.0
        turns = (upper[:, 1:] != upper[:, :-1]) & (loop.real[:, 1:] < 0.0)
        gain_db = np.full(len(candidates), np.inf)
        row, at = np.nonzero(turns)
        np.minimum.at(gain_db, row, _change_db(_reach(loop[row, at], loop[row, at + 1], between)))
        for end in (loop[:, 0], loop[:, -1]):  # a response without integrator is real there
            real = np.abs(end.imag) < _REAL * np.abs(end)
            gain_db = np.minimum(gain_db, np.where(real, _change_db(-end.real), np.inf))
        return GridMargins(
            phase_margin_deg=phase_deg,
            gain_margin_db=gain_db,
            peak_sensitivity=1.0 / np.abs(1.0 + loop).min(axis=1),
            crossover_rad_s=np.where(crosses, omega[1:], 0.0).max(axis=1),
            stable=stable,
            resolved=resolved,
        )

    def _count(
        self, loop: NDArray[np.complex128], candidates: Sequence[PidGains]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """The encirclement count on the given grid, and whether a turn may be missed."""
        integrates = np.array([gains.ki > 0.0 for gains in candidates])
        function = 1.0 + loop
        right, factors = self._open_loop
        for flag, factor in factors.items():
            if (integrates == flag).any():
                function[integrates == flag] *= factor
        angle = np.angle(function)
        steps = np.diff(angle)
        steps -= 2.0 * math.pi * np.round(steps / (2.0 * math.pi))
        turned = angle[:, 0] + steps.sum(axis=1) - math.pi * np.round(angle[:, 0] / math.pi)
        resolved = np.abs(steps).max(axis=1) < _LARGEST_TURN
        return np.round(turned / math.pi) == right, resolved


def _phase(
    low: NDArray[np.complex128], high: NDArray[np.complex128], between: bool
) -> NDArray[np.float64]:
    """Distance of the phase from -180 degrees at a crossover between two responses, in degrees."""
    first, last = np.angle(-low), np.angle(-high)
    if not between:
        return np.degrees(np.minimum(np.abs(last), np.abs(first)))
    sizes = np.log(np.abs(low)), np.log(np.abs(high))
    turn = last - first
    turn -= 2.0 * math.pi * np.round(turn / (2.0 * math.pi))
    at = np.abs(first + sizes[0] / (sizes[0] - sizes[1]) * turn)
    return np.asarray(np.degrees(np.minimum(at, np.abs(2.0 * math.pi - at))))


def _change_db(reach: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change of gain that moves a crossing to -1, in dB; infinite for one right of the origin."""
    left = reach > 0.0
    return np.where(left, np.abs(20.0 * np.log10(np.where(left, reach, 1.0))), np.inf)


def _reach(
    low: NDArray[np.complex128], high: NDArray[np.complex128], between: bool
) -> NDArray[np.float64]:
    """Minus the real part where the response crosses the real axis between two responses."""
    if not between:
        return np.minimum(-high.real, -low.real)
    share = low.imag / (low.imag - high.imag)
    return np.asarray(-(low.real + share * (high.real - low.real)))
