"""Cycles of the triangle test: repeatability, and the length at a voltage (row S13)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, ResultError
from haselab.rig import RigDescription
from haselab.study.definition import Study
from haselab.study.fits.observe import Observation
from haselab.study.fits.resolution import POSITION_PX, with_resolution
from haselab.study.tables import Triangle

__all__ = ["LEAST_FRAMES", "Cycles", "drive_at", "near_v", "repeatability"]

_NEAR = 0.03  # of the span of the triangle, around a voltage, where length is linear in voltage
LEAST_FRAMES = 8  # near a voltage, on each edge

Floats = NDArray[np.float64]


def drive_at(seen: Observation, time_s: Floats, rig: RigDescription) -> Floats:
    """Drive voltage at given times: the staircase, delayed by the output's delay."""
    starts_s = seen.block_start_s + rig.switch_sample / rig.rate_hz
    index = np.searchsorted(starts_s, time_s, side="right") - 1
    return np.asarray(seen.drive_v[np.clip(index, 0, None)])


def near_v(triangle: Triangle) -> float:
    """Distance from a voltage within which the length is taken as linear in the voltage.

    Args:
        triangle: of the study.
    Returns:
        The distance, in V.
    """
    return _NEAR * (triangle.high_v - triangle.low_v)


@dataclass(frozen=True)
class Cycles:
    """A triangle test and the times of its cycles.

    Args:
        seen: the test.
        starts_s: start of each cycle and end of the last, by the clock, shape `(cycles + 1,)`.
        left_out: number of first cycles that are not fitted.
        near_v: distance from a voltage within which the length is linear in it.
        rig: for the output's delay.
    """

    seen: Observation
    starts_s: Floats
    left_out: int
    near_v: float
    rig: RigDescription

    @classmethod
    def of(cls, seen: Observation, study: Study, rig: RigDescription) -> Cycles:
        """Find the cycles of a study's triangle, counted back from the end of the record."""
        t = study.triangle
        end_s = float(seen.block_start_s[-1]) + rig.block_s
        before = np.arange(t.cycles, -1, -1) / t.frequency_hz
        return cls(seen, end_s - before, t.skipped_cycles, near_v(t), rig)

    @property
    def from_s(self) -> float:
        """Start of the first cycle that is fitted."""
        return float(self.starts_s[self.left_out])

    @property
    def kept(self) -> NDArray[np.bool_]:
        """Frames of the cycles that are fitted, shape `(F,)`."""
        time_s = self.seen.frame_time_s
        return np.asarray((time_s >= self.from_s) & (time_s <= self.starts_s[-1]))

    def ramp_at(self, time_s: Floats) -> Floats:
        """The triangle without the steps of the staircase."""
        seen, rig = self.seen, self.rig
        middle_s = seen.block_start_s + rig.switch_sample / rig.rate_hz + 0.5 * rig.block_s
        return np.interp(time_s, middle_s, seen.drive_v)

    def length_at(self, drive_v: float) -> float:
        """Mean over both edges of the length at a voltage, in m.

        Raises:
            ResultError: there are too few frames near the voltage.
        """
        kept = self.kept
        ramp_v, length_m = self.ramp_at(self.seen.frame_time_s[kept]), self.seen.length_m[kept]
        found = []
        rising = np.gradient(ramp_v) > 0.0
        for edge in (rising, ~rising):
            near = edge & (np.abs(ramp_v - drive_v) < self.near_v)
            if near.sum() < LEAST_FRAMES:
                raise ResultError(
                    f"Only {int(near.sum())} frames are near the baseline of {drive_v:g} V, but "
                    f"{LEAST_FRAMES} are needed. Record faster, or a triangle that crosses the "
                    "baseline."
                )
            line = np.polynomial.Polynomial.fit(ramp_v[near] - drive_v, length_m[near], 1)
            found.append(float(line(0.0)))
        return float(np.mean(found))


def _farthest(strain: Floats, start: float) -> float:
    """The strain farthest from that at the start, of an elongation or of a contraction."""
    return float(strain[np.abs(strain - start).argmax()])


def repeatability(cycles: Cycles, zero_length_m: float) -> dict[str, Estimate]:
    """Residual strain after the first cycle, and drift of the others.

    Args:
        cycles: of the triangle test.
        zero_length_m: length at zero strain.
    Returns:
        Results S13; the drifts only if at least two cycles are kept.
    """
    seen = cycles.seen
    strain = seen.length_m / zero_length_m - 1.0
    ends = np.interp(cycles.starts_s, seen.frame_time_s, strain)
    peaks = np.array(
        [
            _farthest(strain[(seen.frame_time_s >= low) & (seen.frame_time_s < high)], start)
            for low, high, start in zip(
                cycles.starts_s[:-1], cycles.starts_s[1:], ends[:-1], strict=True
            )
        ]
    )
    finest = math.sqrt(2.0) * POSITION_PX * cycles.rig.scale_m_per_px / zero_length_m

    def estimate(value: float) -> Estimate:
        return with_resolution(Estimate.normal(float(value), 0.0, ""), finest)

    found = {"S13.residual_first": estimate(ends[1] - ends[0])}
    kept = peaks[cycles.left_out :]
    if kept.size > 1:
        found["S13.peak_drift"] = estimate(kept[-1] - kept[0])
        found["S13.residual_drift"] = estimate(ends[-1] - ends[cycles.left_out + 1])
    return found
