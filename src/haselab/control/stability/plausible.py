"""Margins for plausible plants: share of the plants drawn from a posterior that keeps them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError
from haselab.base.estimate import Z95
from haselab.control.gains import PidGains
from haselab.control.plants.general import AnyPlant
from haselab.control.simulate import LoopSetting
from haselab.control.spec import DesignSpec
from haselab.control.stability.grid import PlantGrid
from haselab.control.stability.margins import loop_margins

__all__ = ["Chance", "PlausibleMargins", "binomial_proportion", "plausible_margins"]

_NEAR_DEG, _NEAR_DB = 0.5, 0.1  # closer to a limit the exact margins are computed
_NEAR_PEAK = 30.0  # sensitivity above which the count of a coarse grid is checked
_SEARCH_POINTS = 180
_MOST_MISS = 3.0
_TIE = 0.01


@dataclass(frozen=True)
class PlausibleMargins:
    """Margins of one controller for many plausible plants.

    A loop keeps a margin if it is stable and the margin is at least the required one.

    Args:
        stable: whether each loop is stable. Shape `(N,)`, as the two that follow.
        phase_margin_deg: phase margins, negative where unstable, in degrees.
        gain_margin_db: gain margins, in dB; minus infinity for an unstable loop.
        least_phase_deg: required phase margin, in degrees.
        least_gain_db: required gain margin, in dB.
    """

    stable: NDArray[np.bool_]
    phase_margin_deg: NDArray[np.float64]
    gain_margin_db: NDArray[np.float64]
    least_phase_deg: float
    least_gain_db: float

    @property
    def keeps_phase(self) -> NDArray[np.bool_]:
        """Whether each loop is stable with the required phase margin. Shape `(N,)`."""
        return self.stable & (self.phase_margin_deg >= self.least_phase_deg)

    @property
    def keeps_gain(self) -> NDArray[np.bool_]:
        """Whether each loop is stable with the required gain margin. Shape `(N,)`."""
        return self.stable & (self.gain_margin_db >= self.least_gain_db)

    @property
    def share(self) -> Estimate:
        """Share of the plants that keep both margins."""
        return binomial_proportion(self.keeps_phase & self.keeps_gain)


def binomial_proportion(kept: NDArray[np.bool_]) -> Estimate:
    """Estimate a share, with the binomial standard error and Wilson's 95 % interval.

    Args:
        kept: one value per draw. Shape `(N,)`.
    Returns:
        The share. If all draws agree, its standard error is 0, but the interval has a width.
    Raises:
        InputError: no draw.
    Source: E. B. Wilson, Journal of the American Statistical Association 22 (1927).
    Example:
        >>> share = binomial_proportion(np.arange(400) < 388)
        >>> share.value, round(share.std, 4), [round(end, 3) for end in share.ci95]
        (0.97, 0.0085, [0.948, 0.983])
    """
    count = kept.size
    if count == 0:
        raise InputError("kept is empty. Pass at least one draw.")
    share = float(np.count_nonzero(kept)) / count
    z = Z95**2 / count
    centre = (share + 0.5 * z) / (1.0 + z)
    half = math.sqrt(share * (1.0 - share) * z + 0.25 * z * z) / (1.0 + z)
    ends = (centre - half if kept.any() else 0.0, 1.0 if kept.all() else centre + half)
    return Estimate(share, math.sqrt(share * (1.0 - share) / count), ends, "")


def plausible_margins(
    plants: Sequence[AnyPlant], gains: PidGains, setting: LoopSetting, spec: DesignSpec
) -> PlausibleMargins:
    """Compute the margins of one controller for many plants.

    Each plant is evaluated on a grid. If its error could change whether a margin is kept, or
    whether the loop is stable, the exact margins are computed instead.

    Args:
        plants: plausible plants. Length `N`, 1 or more.
        gains: controller.
        setting: rate, measurement delay.
        spec: required phase and gain margins.
    Returns:
        The margins, in the order of the plants.
    Raises:
        InputError: no plant.
    Example:
        >>> from haselab.models import Plant
        >>> plants = [Plant(1.0, omega, 0.3) for omega in (25.0, 32.0, 40.0)]
        >>> found = plausible_margins(plants, PidGains(0.0, 5.0), LoopSetting(), DesignSpec())
        >>> found.phase_margin_deg.round(1), found.keeps_gain
        (array([79.6, 81.5, 82.7]), array([ True,  True,  True]))
    """
    if not plants:
        raise InputError("plants is empty. Pass at least one plant.")
    rows = [_margins(plant, gains, setting, spec) for plant in plants]
    stable, phase, gain = zip(*rows, strict=True)
    return PlausibleMargins(
        np.array(stable, dtype=bool),
        np.array(phase),
        np.array(gain),
        spec.phase_margin_deg,
        spec.gain_margin_db,
    )


def _margins(
    plant: AnyPlant, gains: PidGains, setting: LoopSetting, spec: DesignSpec
) -> tuple[bool, float, float]:
    """Stability, phase margin in degrees and gain margin in dB of each plant."""
    grid = PlantGrid.of(plant, setting).margins([gains], between=True)
    phase_deg, gain_db = float(grid.phase_margin_deg[0]), float(grid.gain_margin_db[0])
    sure = (
        bool(grid.resolved[0])
        and bool(grid.peak_sensitivity[0] < _NEAR_PEAK)
        and abs(phase_deg - spec.phase_margin_deg) > _NEAR_DEG
        and abs(gain_db - spec.gain_margin_db) > _NEAR_DB
    )
    if sure:
        return (True, phase_deg, gain_db) if grid.stable[0] else (False, -phase_deg, -math.inf)
    found = loop_margins(plant, gains, setting)
    gain_db = found.gain_margin_db if found.stable else -math.inf
    return found.stable, found.phase_margin_deg, gain_db


@dataclass(frozen=True)
class Chance:
    """A required share of plausible plants, for a search over many candidates.

    Args:
        grids: responses of the plausible plants.
        share: required share that keeps the margins.
    """

    grids: tuple[PlantGrid, ...]
    share: float

    @classmethod
    def of(cls, plants: Sequence[AnyPlant], setting: LoopSetting, share: float) -> Chance:
        """Compute the responses of `plants` once."""
        grids = tuple(PlantGrid.of(plant, setting, _SEARCH_POINTS) for plant in plants)
        return cls(grids, share)

    def miss(self, candidates: Sequence[PidGains], spec: DesignSpec) -> NDArray[np.float64]:
        """Distance of each candidate from the required share: 0 if it is reached. Shape `(C,)`.

        The missing share counts most; among equal shares, the miss of the margins by the last plant
        required to keep them.
        """
        if not candidates:
            return np.zeros(0)
        missed = np.array([self._missed(grid, candidates, spec) for grid in self.grids])
        wanted = math.ceil(self.share * len(self.grids) - 1e-9)
        share = (missed == 0.0).sum(axis=0) / len(self.grids)
        last = np.sort(missed, axis=0)[wanted - 1]
        return np.where(last > 0.0, np.maximum(self.share - share, 0.0) + _TIE * last, 0.0)

    def _missed(
        self, grid: PlantGrid, candidates: Sequence[PidGains], spec: DesignSpec
    ) -> NDArray[np.float64]:
        """Relative miss of the margins on one plant, at most `_MOST_MISS`. Shape `(C,)`."""
        found = grid.margins(candidates, between=True)
        missed = np.zeros(len(candidates))
        for value, least in (
            (found.phase_margin_deg, spec.phase_margin_deg),
            (found.gain_margin_db, spec.gain_margin_db),
        ):
            missed += np.maximum(0.0, 1.0 - np.minimum(value, 1e9) / max(least, 1e-9))
        return np.where(found.stable, np.minimum(missed, _MOST_MISS), _MOST_MISS)
