"""Margins of many controllers on one plant between the neighbours of one frequency grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.control.encirclement import axis_factor, open_loop_poles
from haselab.control.gains import PidGains
from haselab.control.general_plant import AnyPlant, sampled_response_of
from haselab.control.margins import frequency_grid
from haselab.control.simulate import LoopSetting

__all__ = ["GridMargins", "PlantGrid"]

_TYPICAL = PidGains(1.0, 1.0, 0.1)  # sets the range of the grid
_LARGEST_TURN = 1.5  # rad between neighbours; half a turn would hide a whole one


@dataclass(frozen=True)
class GridMargins:
    """Margins, good to a few per mille; each has shape `(C,)`.

    Args:
        phase_margin_deg: smallest distance of the phase from -180 degrees beside a crossover.
        gain_margin_db: smallest increase of gain to a crossing of the negative real axis.
        peak_sensitivity: largest `|1/(1 + L)|` on the grid.
        crossover_rad_s: highest crossover, 0 without one.
        stable: whether the encirclement count on the grid says so.
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
    """A plant's sampled response on its grid, ready for many controllers.

    Args:
        plant: plant.
        rate_hz: sampling rate, in Hz.
        omega_rad_s: angular frequencies. Shape `(F,)`.
        response: behind the hold, with all delays. Shape `(F,)`.
    """

    plant: AnyPlant
    rate_hz: float
    omega_rad_s: NDArray[np.float64]
    response: NDArray[np.complex128]

    @classmethod
    def of(cls, plant: AnyPlant, setting: LoopSetting, points: int = 450) -> PlantGrid:
        """The grid of a plant; a third more points than `points` lie about the resonance."""
        omega = frequency_grid(plant, _TYPICAL, setting.rate_hz, points)
        sampled = sampled_response_of(plant, omega, setting.rate_hz, setting.measurement_delay_s)
        keep = np.isfinite(sampled)
        return cls(plant, setting.rate_hz, omega[keep], sampled[keep])

    def margins(self, candidates: Sequence[PidGains]) -> GridMargins:
        """Margins of the loop with each candidate. Length `C`."""
        omega = self.omega_rad_s
        laws = np.array([gains.sampled_response(omega, self.rate_hz) for gains in candidates])
        loop = self.response * laws
        stable, resolved = self._count(loop, candidates)
        above = np.abs(loop) > 1.0
        crosses = above[:, 1:] != above[:, :-1]
        phase_deg = np.full(len(candidates), np.inf)
        row, at = np.nonzero(crosses)
        sides = (np.abs(np.angle(-loop[row, at + side])) for side in (1, 0))
        np.minimum.at(phase_deg, row, np.degrees(np.minimum(*sides)))
        upper = loop.imag > 0.0
        turns = (upper[:, 1:] != upper[:, :-1]) & (loop.real[:, 1:] < 0.0)
        reach = np.minimum(-loop.real[:, 1:], -loop.real[:, :-1])
        reach = np.where(turns & (reach > 0.0) & (reach < 1.0), reach, 0.0).max(axis=1)
        with np.errstate(divide="ignore"):
            gain_db = -20.0 * np.log10(reach)
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
        """The encirclement count on the grid as it is, and whether a turn may be missed."""
        integrates = np.array([gains.ki > 0.0 for gains in candidates])
        function = 1.0 + loop
        for flag in (True, False):
            if (integrates == flag).any():
                right, axis = open_loop_poles(self.plant, PidGains(1.0, float(flag)))
                function[integrates == flag] *= axis_factor(
                    axis, self.omega_rad_s, self.rate_hz, 1.0
                )
        angle = np.angle(function)
        steps = np.diff(angle)
        steps -= 2.0 * math.pi * np.round(steps / (2.0 * math.pi))
        turned = angle[:, 0] + steps.sum(axis=1) - math.pi * np.round(angle[:, 0] / math.pi)
        resolved = np.abs(steps).max(axis=1) < _LARGEST_TURN
        return np.round(turned / math.pi) == right, resolved
