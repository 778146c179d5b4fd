"""Simulation of many closed loops, each with the microcontroller's controller bit for bit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab import _loops
from haselab.base import InputError
from haselab.control.gains import PidGains
from haselab.control.plants.loop_table import Disturbance, LoopTable, WhiteNoise
from haselab.control.simulate import LoopSetting
from haselab.models.plant import Plant

__all__ = ["LoopSummaries", "LoopTraces", "simulate_ensemble", "trace_ensemble"]

_SETTLED = 0.02
_TENTHS = 10
_LONGEST_STRETCH = 1000  # samples: sums in single precision have at most 1000 rounding errors


@dataclass(frozen=True)
class LoopSummaries:
    """Summaries of many loops' responses to the last change of the reference.

    The output is the one that arrives at the controller, before the noise. Errors and
    times are relative to the last change of the reference on (from the first sample where it is
    constant; the step is then relative to 0, the operating point).

    Args:
        absolute_error_s: integral of the absolute error, in s. Shape `(B,)`, as all that follow.
        highest: largest output.
        lowest: smallest output.
        overshoot: largest excess over the last reference, relative to the step; NaN without a step.
        settling_time_s: time after which the error stays within 2 % of the step, in s; NaN where
            it still leaves that band in the last tenth, or without a step.
        limited_time_s: time with the controller's output at a limit, in s.
        swing: peak to peak over the last tenth.
        unstable: whether the loop does not settle: over the last tenth it swings by more than the
            band, about the same level as in the previous tenth, and by at least 0.9 of that.
    """

    absolute_error_s: NDArray[np.float64]
    highest: NDArray[np.float64]
    lowest: NDArray[np.float64]
    overshoot: NDArray[np.float64]
    settling_time_s: NDArray[np.float64]
    limited_time_s: NDArray[np.float64]
    swing: NDArray[np.float64]
    unstable: NDArray[np.bool_]


@dataclass(frozen=True)
class LoopTraces:
    """Every sample of many loops, in the controller's single precision.

    Args:
        sample_time_s: sampling instants, in s. Shape `(N,)`.
        measured: measurements that the controllers used. Shape `(B, N)`.
        u: outputs of the controllers. Shape `(B, N)`.
    """

    sample_time_s: NDArray[np.float64]
    measured: NDArray[np.float32]
    u: NDArray[np.float32]


def simulate_ensemble(
    plants: Sequence[Plant],
    gains: Sequence[PidGains],
    reference: ArrayLike,
    setting: LoopSetting,
    *,
    measurement_noise: ArrayLike | WhiteNoise | None = None,
    threads: int = 0,
) -> LoopSummaries:
    """Simulate many closed loops with one reference, and summarise each.

    Plants in double, exact between the samples, any delay; controllers bit-identical to
    `core/hs_pid.c`. The result of a loop does not depend on the other loops, the threads, or
    the machine's vector instructions.

    Args:
        plants: plants. Length `B`.
        gains: controllers. Length `B`.
        reference: desired strain, one value per sample. Shape `(N,)`.
        setting: rate, delay, limits, initial drive.
        measurement_noise: added to the measurements, in strain: generated, or values of shape
            `(N,)` or `(B, N)`. NaN means a lost measurement: the output is then 0, and the
            controller keeps its state.
        threads: largest number of threads; 0: all of the machine.
    Returns:
        The summaries, in the order of the loops.
    Raises:
        InputError: see `LoopTable.of`; a vector that is empty, not finite or of another shape.
    Source: variation of constants; controller as in `core/hs_pid.c`.
    Example:
        >>> plants = [Plant(1.0, omega, 0.5) for omega in (25.0, 32.0, 40.0)]
        >>> found = simulate_ensemble(plants, [PidGains(0.0, 3.0)] * 3, [0.02] * 400, LoopSetting())
        >>> found.settling_time_s.round(2), bool(found.unstable.any())
        (array([1.15, 1.18, 1.2 ]), False)
    """
    loops, desired, noise = _prepared(plants, gains, reference, setting, measurement_noise)
    window = _Window.of(desired)
    kept = np.empty((len(plants), window.ends.size), _loops.SUMMARY)
    loops.summaries(desired, *noise, window.band, window.ends, kept, threads=_threads(threads))
    return window.summaries(kept, 1.0 / setting.rate_hz)


def trace_ensemble(
    plants: Sequence[Plant],
    gains: Sequence[PidGains],
    reference: ArrayLike,
    setting: LoopSetting,
    *,
    measurement_noise: ArrayLike | WhiteNoise | None = None,
    threads: int = 0,
) -> LoopTraces:
    """Simulate loops as for `simulate_ensemble`, with every sample: 8 bytes per loop and sample.

    Args:
        plants: plants. Length `B`.
        gains: controllers. Length `B`.
        reference: desired strain, one value per sample. Shape `(N,)`.
        setting: rate, delay, limits, initial drive.
        measurement_noise: as in `simulate_ensemble`.
        threads: largest number of threads; 0: all of the machine.
    Returns:
        The traces, in the order of the loops.
    Raises:
        InputError: as for `simulate_ensemble`.
    Example:
        >>> plants = [Plant(1.0, omega, 0.5) for omega in (25.0, 32.0, 40.0)]
        >>> found = trace_ensemble(plants, [PidGains(0.0, 3.0)] * 3, [0.02] * 400, LoopSetting())
        >>> found.measured[:, -1].round(4).tolist() == [np.float32(0.02)] * 3
        True
    """
    loops, desired, noise = _prepared(plants, gains, reference, setting, measurement_noise)
    measured = np.empty((len(plants), desired.size), np.float32)
    u = np.empty_like(measured)
    loops.traces(desired, *noise, measured, u, threads=_threads(threads))
    return LoopTraces(np.arange(desired.size) / setting.rate_hz, measured, u)


def _prepared(
    plants: Sequence[Plant],
    gains: Sequence[PidGains],
    reference: ArrayLike,
    setting: LoopSetting,
    noise: ArrayLike | WhiteNoise | None,
) -> tuple[_loops.Loops, NDArray[np.float32], tuple[NDArray[np.float32], NDArray[np.uint32]]]:
    """Check and prepare loops, reference and noise."""
    std = noise.std if isinstance(noise, WhiteNoise) else 0.0
    table = LoopTable.of(plants, gains, setting, std)
    desired = _reference(reference)
    disturbance = Disturbance.of(noise, len(plants), desired.size)
    return table.loops(), desired, (disturbance.values, disturbance.seeds)


@dataclass(frozen=True)
class _Window:
    """The samples from the last change of the reference on, in tenths, and segments of these."""

    start: int
    before: float
    after: float
    pieces: int  # segments per tenth
    edges: NDArray[np.int64]

    @classmethod
    def of(cls, desired: NDArray[np.float32]) -> _Window:
        changes = np.flatnonzero(np.diff(desired))
        start = int(changes[-1]) + 1 if changes.size else 0
        before = float(desired[start - 1]) if start else 0.0
        count = desired.size - start
        pieces = math.ceil(count / (_TENTHS * _LONGEST_STRETCH))
        edges = start + count * np.arange(_TENTHS * pieces + 1) // (_TENTHS * pieces)
        return cls(start, before, float(desired[-1]), pieces, edges)

    @property
    def step(self) -> float:
        return self.after - self.before

    @property
    def band(self) -> float:
        return _SETTLED * abs(self.step)

    @property
    def ends(self) -> NDArray[np.uint64]:
        """Ends of the simulated segments, with one more before the window if it is not empty."""
        return self.edges[0 if self.start else 1 :].astype(np.uint64)

    def summaries(self, kept: NDArray[np.void], period_s: float) -> LoopSummaries:
        """`kept`: a summary each loop and stretch, see `native/loops/loops.h`."""
        after = kept[:, 1 if self.start else 0 :]
        error_sum, top, bottom, last, limited = (
            after[name].astype(float, order="C")
            for name in ("error_sum", "top", "bottom", "last_outside", "limited")
        )
        tenths = (len(kept), _TENTHS, self.pieces)
        tops, bottoms = top.reshape(tenths).max(axis=2), bottom.reshape(tenths).min(axis=2)
        highest, lowest = tops.max(axis=1), bottoms.min(axis=1)
        outside = np.where(last >= 0.0, self.edges[:-1] - self.start + last + 1.0, 0.0).max(axis=1)
        settled = outside <= self.edges[-1 - self.pieces] - self.start
        beyond = highest - self.after if self.step > 0.0 else self.after - lowest
        size = abs(self.step) if self.step else math.nan
        swing = tops - bottoms
        common = tops[:, -2:].min(axis=1) - bottoms[:, -2:].max(axis=1)
        calm = (swing[:, -1] <= 2.0 * self.band) | (swing[:, -1] < 0.9 * swing[:, -2])
        return LoopSummaries(
            absolute_error_s=error_sum.sum(axis=1) * period_s,
            highest=highest,
            lowest=lowest,
            overshoot=np.maximum(beyond, 0.0) / size,
            settling_time_s=np.where(settled & (size > 0.0), outside * period_s, math.nan),
            limited_time_s=limited.sum(axis=1) * period_s,
            swing=swing[:, -1],
            unstable=~calm & (common > 0.5 * swing[:, -1]),
        )


def _reference(values: ArrayLike) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        vector = np.array(values, dtype=np.float32)
    if vector.ndim != 1 or vector.size == 0 or not np.isfinite(vector).all():
        raise InputError(
            f"reference has shape {vector.shape} or contains NaN; it must be a finite vector with "
            "one value per sample."
        )
    return vector


def _threads(threads: int) -> int:
    if threads < 0:
        raise InputError(f"threads = {threads}; it must be 1 or more, or 0 for all of the machine.")
    return threads
